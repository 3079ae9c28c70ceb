"""Plans and episodes that must come out the same, to the bit, on every processor: prints a digest of each as JSON.

`digests.json` beside this file holds what they are. A change of the planners or of the physics changes them: then
`python tests/portability/plans.py > tests/portability/digests.json`, and say so in the changelog.
"""

from __future__ import annotations

import hashlib
import json
import sys
from typing import Any, NamedTuple

import numpy as np

from d4orm_env import Problem, Team, World, make_problem, navigation_v0
from d4orm_env.disturbances import Disturbance, Intruder, Push
from d4orm_env.footprints import Box, Footprint
from d4orm_env.scenarios.problems import ScenarioLike
from d4orm_planners import make_planner, make_policy, run_episode


class Case(NamedTuple):
    """What to plan, or to execute under disturbances."""

    planner: str
    settings: dict[str, Any]
    scenario: ScenarioLike
    arguments: dict[str, Any]
    max_iterations: int = 2
    disturbances: tuple[Disturbance[Any], ...] = ()
    footprint: Footprint | None = None
    """Of all robots, which then have to face along x at their goals."""


def tight_gap(seed: int, num_robots: int, *, goal_speed: float) -> Problem:
    """A car parks in a gap of 1.3 lengths."""
    world = World(boxes=[[1.0, 0.0, 1.61, 0.4], [2.39, 0.0, 3.0, 0.4]], lower=[0, 0], upper=[4, 2])
    return Problem(
        Team(("car_first_order",), footprint=Box(0.6, 0.3)), [[0.7, 1.2, 0.3]], [[2.0, 0.2]], world, horizon=600,
        margin=0.02, goal_radius=0.04, goal_speed=goal_speed, goal_heading=0.0, goal_heading_tolerance=0.1,
    )  # fmt: skip


CASES = {
    "d4orm": Case("d4orm", {}, "circle", {"num_robots": 8}),
    "d4orm among obstacles": Case("d4orm", {}, "four_obstacles", {"num_robots": 8}, 4),
    "d4orm of the paper": Case(
        "d4orm", {"preset": "paper", "num_steps": 10, "random_start": True}, "circle", {"num_robots": 4}
    ),
    "hybrid": Case("hybrid", {}, "random", {"num_robots": 24, "size": 6.0}, 30),
    "d4orm-d": Case("d4orm-d", {}, "random", {"num_robots": 24, "size": 6.0}, 30),
    "d4orm-d of the paper": Case("d4orm-d", {"preset": "paper", "num_steps": 10}, "random", {"num_robots": 8}, 4),
    "d-d4orm": Case("d-d4orm", {}, "circle", {"num_robots": 6}),
    "mppi": Case("mppi", {"num_steps": 10, "importance": 0.01}, "circle", {"num_robots": 4}),
    "cem": Case("cem", {"num_steps": 10, "adapt_variance": True}, "circle", {"num_robots": 4}),
    "mbd": Case("mbd", {"num_steps": 20}, "swap", {"num_robots": 4}),
    "i-mbd": Case("i-mbd", {"num_steps": 10}, "swap", {"num_robots": 4}),
    "mixed models": Case("d4orm", {}, "heterogeneous", {"num_robots": 6}),
    "differential drives": Case("hybrid", {}, "random", {"num_robots": 8, "model": "differential_drive"}, 30),
    "first-order robots": Case("d4orm", {}, "circle", {"num_robots": 6, "model": "velocity2d"}),
    "unicycles": Case("d4orm", {}, "circle", {"num_robots": 4, "model": "unicycle"}),
    "cars": Case("d4orm", {}, "circle", {"num_robots": 4, "model": "car"}),
    "boxes that face their goals": Case(
        "d4orm", {}, "circle", {"num_robots": 6, "model": "differential_drive"}, footprint=Box(0.4, 0.2, 0.05)
    ),
    "manoeuvres of boxes": Case(
        "hybrid", {}, "four_obstacles", {"num_robots": 4, "model": "differential_drive"}, footprint=Box(0.4, 0.2, 0.05)
    ),
    "manoeuvres of cars": Case(
        "hybrid", {}, "four_obstacles", {"num_robots": 4, "model": "car_first_order"}, footprint=Box(0.4, 0.2, 0.05)
    ),
    "into a tight gap": Case("hybrid", {}, tight_gap, {"num_robots": 1}),
    "in space": Case("d4orm", {}, "sphere", {"num_robots": 8}),
    "in space with drag": Case("d4orm", {}, "sphere", {"num_robots": 4, "model": "holonomic3d_drag"}),
    "among walls": Case("hybrid", {"improve": True}, "rooms", {"num_robots": 8}, 3),
    "a roundabout": Case("hybrid", {"improve": True}, "circle", {"num_robots": 6}, 3),
    "amswarm": Case("amswarm", {}, "amswarm_3", {}, 1),
    "mmd": Case("mmd", {"improve": True}, "rooms", {"num_robots": 5}, 4),
    "under way": Case(
        "d4orm-c2f", {"refine": "sync"}, "circle", {"num_robots": 6}, 0, (Intruder(4, 0.8), Push(0.3, 0.3))
    ),
    "a crowd among walls": Case("mapf", {}, "rooms", {"num_robots": 60, "model": "differential_drive"}, 1),
    "through a corridor": Case("mapf", {"improve": True}, "corridor", {"num_robots": 6}, 2),
}

QUICK = ("d4orm", "hybrid", "mppi", "cem", "mixed models")
"""Cases that compile two sampling kernels only, and run through everything else."""


def digest(case: Case) -> str:
    """The problem, the controls and the states that they lead to, as 16 hexadecimal digits."""
    problem = make_problem(case.scenario, seed=0, goal_speed=np.inf, **case.arguments)
    if case.footprint is not None:
        team = problem.team.replace(footprint=case.footprint)
        problem = problem.replace(team=team, goal_heading=np.zeros(team.num_robots))
    if case.disturbances:
        env = navigation_v0.parallel_env(problem=problem, disturbances=case.disturbances)
        done = run_episode(env, make_policy(case.planner, engine="cpu", **case.settings), seed=1)
        controls = np.zeros(0)  # the states tell them
    else:
        planner = make_planner(case.planner, engine="cpu", **case.settings)
        done = planner.solve(problem, seed=1, max_iterations=case.max_iterations)
        controls = done.controls
    arrays = (problem.start, problem.goal, controls, done.trajectory.states, done.trajectory.rewards)
    content = b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)
    return hashlib.sha256(content).hexdigest()[:16]


if __name__ == "__main__":
    names = QUICK if "--quick" in sys.argv[1:] else tuple(CASES)
    json.dump({name: digest(CASES[name]) for name in names}, sys.stdout, indent=2)
    print()
