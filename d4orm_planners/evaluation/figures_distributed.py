"""The paper's figures of D-D4orm: its selections, and the number of nodes."""

from __future__ import annotations

from typing import Any

from d4orm_planners.distributed.selection import SELECTIONS
from d4orm_planners.evaluation.reproduction import Figure, Section

SAMPLES = 2048
"""Of all nodes together."""
PAPER: dict[str, Any] = {"preset": "paper", "max_iterations": 20}
"""A budget of iterations, not of seconds, so that what is solved does not depend on how busy the machine is."""
ENVIRONMENTS: tuple[tuple[str, str, str | None], ...] = (
    ("Differential Drive", "circle", "differential_drive"),
    ("2D Holonomic", "circle", None),
    ("2D Heterogeneous", "heterogeneous", None),
    ("3D Holonomic", "circle", "holonomic3d"),
)
"""The figure's environments in its order: title, scenario, model."""
METRICS = ("success", "iterations", "runtime", "waiting_share", "messages", "message_bytes")
PLOTS = ("iterations", "runtime", "success", "waiting_share")
REMARKS = (
    "The paper shows iterations to the first solution, in a plot without numbers in its text. The policies without "
    "`defaults` have its parameters, and 20 iterations.",
    "Iterations are a mean over the successes: where trials failed it is too good.",
    "All nodes are threads of one machine, and share its cores. On machines of their own they would be quicker.",
    "Messages are those that nodes send; each goes to all others.",
)


def _policies(**settings: Any) -> dict[str, dict[str, Any]]:
    """All selections with the paper's settings and with the defaults."""
    kinds: tuple[tuple[str, dict[str, Any]], ...] = (
        ("", PAPER), (", defaults", {"num_samples": SAMPLES, "nodes": None}),
    )  # fmt: skip
    return {
        f"{selection}{kind}": {"policy": "d-d4orm", **given, "selection": selection, **settings}
        for kind, given in kinds
        for selection in SELECTIONS
    }


def selections() -> Figure:
    """A node per robot, against the planner without nodes."""
    policies = {
        "d4orm": {**PAPER, "num_samples": SAMPLES},
        "d4orm, defaults": {"policy": "d4orm", "num_samples": SAMPLES},
        **_policies(),
    }
    return Figure(
        name="selections",
        title="D-D4orm with a node per robot",
        source="section VIII-D, figure of D-D4orm, upper row",
        sections=tuple(
            Section(title=title, policies=policies, scenarios=(scenario,), model=model, robots=(4, 8, 12, 16),
                    quick_robots=(2, 3))
            for title, scenario, model in ENVIRONMENTS
        ),
        across="robots",
        metrics=METRICS,
        plots=PLOTS,
        remarks=REMARKS,
    )  # fmt: skip


def nodes() -> Figure:
    """More and more nodes share the same samples."""
    return Figure(
        name="nodes",
        title="D-D4orm and the number of its nodes, 16 robots",
        source="section VIII-D, figure of D-D4orm, lower row",
        sections=tuple(
            Section(title=title, policies=_policies(), scenarios=(scenario,), model=model, robots=(16,),
                    nodes=(1, 2, 4, 8, 16))
            for title, scenario, model in ENVIRONMENTS
        ),
        across="nodes",
        metrics=METRICS,
        plots=PLOTS,
        remarks=(*REMARKS, "With one node there is nothing to select: all are the planner without nodes."),
    )  # fmt: skip
