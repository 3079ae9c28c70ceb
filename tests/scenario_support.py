"""What tests of all scenarios share."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from d4orm_env.scenarios import list_scenarios

MODELS_2D = ("holonomic2d", "velocity2d", "differential_drive")
WALLED = {
    "rooms": ("holonomic2d",),
    "maze": ("differential_drive",),
    "warehouse": ("velocity2d",),
    "forest": ("holonomic2d", "holonomic3d"),
    "corridor": ("differential_drive",),
    "doorway": ("velocity2d",),
    "mmd_conveyor": ("holonomic2d",),
    "mmd_highways": ("differential_drive",),
    "mmd_drop_region": ("velocity2d",),
    "map": ("holonomic2d",),
}
"""The scenarios with walls, which are tested with a model or two each."""

OPEN_3D = ("sphere", "paper_sphere", "amswarm_1", "amswarm_2", "amswarm_3", "amswarm_4", "amswarm_5")
MAP = Path(__file__).parents[1] / "examples" / "maps" / "office.map"


def scenario_models() -> list[tuple[str, str | None]]:
    """Every scenario with the models to test it with; ``None`` where it has models of its own."""
    cases: list[tuple[str, str | None]] = []
    for scenario in list_scenarios():
        if scenario.endswith("heterogeneous"):
            cases.append((scenario, None))
        elif scenario in OPEN_3D:
            cases.append((scenario, "holonomic3d"))
        elif scenario == "paper_random":
            cases += [(scenario, model) for model in MODELS_2D]
        else:
            cases += [(scenario, model) for model in WALLED.get(scenario, (*MODELS_2D, "holonomic3d"))]
    return cases


def needed(scenario: str) -> dict[str, Any]:
    """The arguments that a scenario cannot do without."""
    return {"map": MAP} if scenario == "map" else {}
