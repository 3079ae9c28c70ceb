"""Crazyflies in crazyflow, a physics that planners know nothing of: open loop from the defaults, and closed loop.

    python -m examples.studies zero_shot --seeds 20

Teams of `robot="crazyflie"`, with its radius, limits and margin: a swap of ten among obstacles, a circle of eight in a
slab of 0.5 m, and ten that rise from a grid to a figure of eight, in an order drawn anew. Plans of `hybrid` are sampled
at 100 Hz and flown as they are, in calm air, and with gusts of 0.02 N and 5% more mass than the drones' controller
reckons with, at their margin and at the one that the page advises for that. With those, D4orm-C2F flies the teams in a
`Controller`, whose reference the drones follow: in mode "nominal" without looking at them, in mode "measured" the
reference goes towards them; so they do with a low battery, which takes 12% of the thrust, in calm air. It needs
crazyflow, `--trials` does not.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from examples.common import grouped, require, save_table, study_parser, study_rows
from examples.denoising import denoising_columns, denoising_of

from d4orm_env import Problem, make_problem
from d4orm_env.core.robot_types import ROBOTS
from d4orm_planners import Controller, Plan, make_planner
from d4orm_planners.d4orm_c2f.settings import D4ormC2FConfig

ROBOT, RATE, FIRST_SEED = "crazyflie", 100, 1000
DISTURBED = {"gust": 0.02, "mass_factor": 1.05}
CONDITIONS: dict[str, dict[str, float]] = {
    "open loop": {},
    "open loop, disturbed": DISTURBED,
    "open loop, disturbed, margin 0.15": DISTURBED,
    "nominal, disturbed": DISTURBED,
    "measured, disturbed": DISTURBED,
    "nominal, low battery": {"thrust_factor": 0.88},
    "measured, low battery": {"thrust_factor": 0.88},
}
MARGINS = {"open loop, disturbed, margin 0.15": 0.15}  # of the others it is the robot's
HORIZON = 150
CALM = 10
"""Steps to fly on when the reference has arrived; drones that a gust has swing past their goals have the horizon."""


def figure(seed: int, margin: float) -> Problem:
    """Ten drones from a grid above the floor to two rings one above the other, with room for the downwash."""
    angles = 2 * np.pi * np.arange(5) / 5
    rings = [np.stack([0.5 * np.sin(angles), 0 * angles, z + side * 0.5 * np.cos(angles)], axis=1)
             for z, side in ((0.95, -1), (2.3 + margin, 1))]  # fmt: skip
    grid = [[0.6 * x, 0.6 * y, 0.5, 0, 0, 0] for x in range(-2, 3) for y in (-1, 0)]
    goals = np.random.default_rng(seed).permutation(np.concatenate(rings))
    return make_problem(
        "circle", 10, robot=ROBOT, height=1.0, horizon=HORIZON, margin=margin, bounds=[[-3, -3, 0.2], [3, 3, 3.2]]
    ).replace(start=grid, goal=goals, name="figure")


def problem_of(scenario: str, seed: int, margin: float = ROBOTS[ROBOT].margin) -> Problem:
    common: dict[str, Any] = {"robot": ROBOT, "height": 1.0, "horizon": HORIZON, "margin": margin}
    if scenario == "figure of ten":
        return figure(seed, margin)
    if scenario == "circle of eight":
        return make_problem("circle", 8, seed, diameter=4.0, bounds=[[-3, -3, 0.75], [3, 3, 1.25]], **common)
    return make_problem("swap", 10, seed, num_obstacles=4, bounds=[[-4, -3, 0.3], [4, 3, 2]], **common)


SCENARIOS = ("swap of ten", "circle of eight", "figure of ten")


def fly_plan(problem: Problem, plan: Plan, bodies: Any) -> Iterator[np.ndarray]:
    """Robots in contact in each step of a plan; nothing where it is not solved."""
    if not plan.solved:
        return
    sampled = plan.sample(rate=RATE)
    parts = [np.concatenate([part, np.repeat(part[-1:], RATE, axis=0)]) for part in
             (sampled.position, sampled.velocity, sampled.acceleration)]  # fmt: skip
    each = round(problem.dt * RATE)
    for first in range(0, len(parts[0]), each):
        yield bodies.follow(*(part[first : first + each] for part in parts))


def fly_controller(problem: Problem, seed: int, bodies: Any, mode: Any, arrived: np.ndarray) -> Iterator[np.ndarray]:
    """Robots in contact in each step of D4orm-C2F, until those that have ``arrived`` are all."""
    with Controller("d4orm-c2f", mode=mode, tracker=True, refine="sync") as controller:
        last, step, calm = bodies.states, 0, 0
        controller.begin(problem, last, seed=seed)
        while calm < CALM or (step < problem.horizon and not arrived.all()):
            setpoint = controller.step(bodies.states, step * problem.dt)
            after = np.concatenate([setpoint.position, setpoint.velocity], axis=1).astype(np.float32)
            yield bodies.lead(last, after)
            last, step, calm = after, step + 1, calm + controller.over


def fly(scenario: str, condition: str, seed: int) -> dict[str, Any]:
    """The row of a flight."""
    from d4orm_env.crazyflow import DroneBodies, DronePhysics

    problem = problem_of(scenario, seed, MARGINS.get(condition, ROBOTS[ROBOT].margin))
    mode = condition.partition(",")[0]
    bodies = DroneBodies(problem, np.zeros(0, np.float32), DronePhysics(**CONDITIONS[condition]))
    bodies.begin(seed)
    denoising: dict[str, float | None] = dict.fromkeys(denoising_of([]))
    loop_steps = None  # of a controller, whose time is not told
    touched, arrived = np.zeros((2, problem.num_robots), np.bool_)
    if mode == "open loop":
        plan = make_planner().solve(problem, seed=seed, time_limit=60)
        steps, denoising = fly_plan(problem, plan, bodies), denoising_of(plan.history)
    else:
        loop_steps = D4ormC2FConfig().num_steps
        steps = fly_controller(problem, seed, bodies, mode, arrived)
    for touching in steps:
        touched |= touching
        position, velocity = bodies.states[:, :3], bodies.states[:, 3:]
        near = np.linalg.norm(position - problem.goal, axis=1) <= problem.goal_radius
        arrived |= near & (np.linalg.norm(velocity, axis=1) <= problem.goal_speed)
    record = bodies.record
    return {
        "scenario": scenario, "condition": condition, "seed": seed, "robots": problem.num_robots,
        "flown": record.samples > 0, "arrived": int(arrived.sum()), "fallen": int(record.fallen.sum()),
        "contacts": int((touched & ~record.fallen).sum()),
        "mean_squared_error": float(record.mean_squared_error.mean()), "error": float(record.largest_error.max()),
        "gap": float(record.least_gap.min()), "clearance": float(record.least_clearance.min()),
        "radius": float(problem.team.wall_radius[0]), "seconds": record.samples / RATE, **denoising,
        "loop_steps": loop_steps,
    }  # fmt: skip


def measure(seeds: int) -> list[dict[str, Any]]:
    """A row of every flight."""
    rows = []
    for scenario in SCENARIOS:
        for condition in CONDITIONS:
            rows += [fly(scenario, condition, FIRST_SEED + seed) for seed in range(seeds)]
            print(f"{scenario}, {condition}: {sum(row['contacts'] for row in rows[-seeds:])} in contact", flush=True)
    return rows


def row_of(scenario: str, condition: str, rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The table's row of some flights."""
    flown = [row for row in rows if row["flown"]]
    drones = sum(row["robots"] for row in flown)
    told, loop_steps = denoising_columns(rows), rows[0]["loop_steps"]
    if loop_steps:
        told["denoising steps"] = f"{loop_steps} a loop"
    rms = np.sqrt(np.mean([row["mean_squared_error"] for row in flown]))
    return {
        "scenario": scenario, "flown": condition, **told, "teams": f"{len(flown)} of {len(rows)}",
        "arrived": f"{sum(row['arrived'] for row in flown)} of {drones}",
        "in contact": sum(row["contacts"] for row in flown), "fallen": sum(row["fallen"] for row in flown),
        "error RMS [m]": f"{rms:.3f}",
        "most [m]": f"{max(row['error'] for row in flown):.3f}",
        "least distance of centres [m]": f"{min(row['gap'] + 2 * row['radius'] for row in flown):.3f}",
        "least gap to obstacles [m]": f"{min(row['clearance'] for row in flown):.3f}",
    }  # fmt: skip


def main() -> None:
    arguments = study_parser(__doc__, seeds=20).parse_args()
    if arguments.trials is None:
        require("drones", "crazyflow")
    rows = study_rows(arguments, "zero_shot", lambda: measure(1 if arguments.quick else arguments.seeds))
    groups = grouped(rows, "scenario", "condition")
    save_table([row_of(*key, group) for key, group in groups.items()], arguments.out / "zero_shot.csv")
