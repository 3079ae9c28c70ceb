"""Scenarios, problems and controls that the tests of the environments share."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.core.world import World
from d4orm_env.footprints import Box, Disc, Train
from d4orm_env.scenarios import list_scenarios


def slow(*values: Any, **named: Any) -> Any:
    """One more case of what quick tests cover, which only ``make test-all`` runs."""
    return pytest.param(*values, marks=pytest.mark.slow, **named)


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
QUICK = ("circle", "swap", "random", "sphere", "heterogeneous", "warehouse", "four_obstacles")
"""One scenario of every kind of team and of world; the others are slow where what is tested hardly depends on it."""


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


def scenario_params(num_robots: int) -> list[Any]:
    """Arguments of every scenario; where there is a choice of models they take turns, so that all are met."""
    models: dict[str, list[str | None]] = {}
    for scenario, model in scenario_models():
        models.setdefault(scenario, []).append(model)
    cases = []
    for number, (scenario, choice) in enumerate(models.items()):
        size = {} if scenario.startswith("amswarm") else {"num_robots": num_robots}
        model = choice[number % len(choice)]
        case = {"scenario": scenario, **size, **({} if model is None else {"model": model}), **needed(scenario)}
        cases.append((pytest.param if scenario in QUICK else slow)(case, id="-".join(filter(None, (scenario, model)))))
    return cases


def line_problem(distances: list[float], model: str = "velocity2d", **changes: Any) -> Problem:
    """Robots one metre apart in y, each with its goal that far ahead in x."""
    team = Team((model,) * len(distances))
    start = np.zeros((len(distances), team.state_size))
    start[:, 1] = np.arange(len(distances))
    goal = start[:, : team.dimension] + np.eye(team.dimension)[0] * np.array(distances)[:, None]
    return Problem(team, start, goal, **({"goal_speed": np.inf} | changes))


def mixed_problem() -> Problem:
    """Models of different state sizes, radii and limits, and so with padding; goals near enough to drift into."""
    team = Team(
        ("velocity2d", "differential_drive", "holonomic2d"),
        radius=[0.1, 0.15, 0.2],
        max_speed=[0.5, 1.0, 1.5],
        max_acceleration=[1.0, 0.5, 2.0],
    )
    start = [[0, 0, 0, 0], [1, 0, 0.5, 0], [2, 0, 0.1, -0.2]]
    return Problem(team, start, [[0.1, 0.1], [1.1, 0.1], [2.0, 0.2]], horizon=60)


def trains() -> Problem:
    """Trailers, footprints, limits that are not symmetric, and goal headings and hitch angles in one team, at goals."""
    shapes = Train(Box(0.5, 0.25, 0.1), [Box(0.3, 0.25), Disc(0.1)]), Box(0.6, 0.2), Train(Disc(0.15), [Box(0.3, 0.2)])
    own = {"max_reverse_speed": [0.4, 0.2, 0.6], "max_right_turn_rate": 0.3, "hitch_length_1": 0.4}
    team = Team(("car_with_2_trailers", "unicycle1", "car_with_1_trailer"), footprint=shapes, own_limits=own)
    triangle = [[0.5, -1], [1.1, -1.2], [0.8, -0.5]]
    world = World(boxes=[[-1.2, -1, -0.8, 0.2]], polygons=[triangle], lower=[-3, -3], upper=[3.2, 3.1])
    start = [[-1.6, -0.6, 1.5, 0.1, -0.2], [0, -1.5, 1.5, 0, 0], [1.5, 0.3, 1.5, 0.5, 0]]
    goals, asked = [[-1.6, -0.55], [0, -1.45], [1.5, 0.35]], [[0.2, np.nan], [np.nan] * 2, [0.0, np.nan]]
    options: dict[str, Any] = {"goal_heading": 1.6, "goal_heading_tolerance": 0.4, "goal_hitches": asked}
    return Problem(team, start, goals, world, horizon=25, **options)


def straight_drive(problem: Problem, throttle: Any = 1.0) -> np.ndarray:
    """``(H, K, m)`` controls that drive every robot that faces its goal straight at it, at that share of its limits."""
    offsets = problem.goal - problem.start[:, : problem.dimension]
    ahead = offsets / np.linalg.norm(offsets, axis=1, keepdims=True)
    controls = np.zeros((problem.num_robots, problem.control_size), np.float32)
    for robot, model in enumerate(problem.team.robot_models):
        limit = problem.team.control_limits[robot]
        direction = [0.0, 1.0] if model.heading_index is not None else ahead[robot]
        controls[robot, : model.control_size] = limit[: model.control_size] * np.array(direction)
    controls *= np.broadcast_to(throttle, problem.num_robots)[:, None]
    return np.repeat(controls[None], problem.horizon, axis=0)


def act(env: Any, controls: np.ndarray) -> dict[str, np.ndarray]:
    """The rows of ``controls`` ``(K, m)`` as actions of the agents still in the environment."""
    return {agent: controls[env.possible_agents.index(agent)] for agent in env.agents}


def sampled_actions(env: Any) -> dict[str, np.ndarray]:
    return {agent: env.action_space(agent).sample() for agent in env.agents}
