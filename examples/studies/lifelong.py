"""Robots that get a new goal whenever they arrive, under D4orm-C2F, for some minutes of simulated time.

    python -m examples.studies lifelong --minutes 1
    python -m examples.studies lifelong --minutes 10 --seeds 10
    python -m examples.studies lifelong --minutes 5 --scenario warehouse --num-robots 32

The throughput is compared with that of straight drives at the speed limit, beyond which a step goes by a twentieth with
the default limits. Without others in its way, a robot would accelerate to each of the goals that it was given, from the
velocity that it had then, up to its top speed, and pass through. It would drive straight, or among walls along the
shortest path, wherever it was heading before.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from examples.common import count, film, save_gif, save_table, study_parser, study_rows
from examples.studies import AS_IN_THE_PAPER

from d4orm_env import Problem, make_problem, navigation_v0
from d4orm_env.envs.joint_state import JointState, split_state
from d4orm_env.envs.lifelong import goal_region
from d4orm_planners import make_policy
from d4orm_planners.evaluation.summary import mean_interval


def least_times(problem: Problem, joint: JointState) -> np.ndarray:
    """``(K,)`` seconds within which no double integrator gets from a joint state to its goal."""
    d = problem.dimension
    speed, acceleration, _ = np.asarray(problem.team.limits, np.float64).T
    to_goal = joint.goals.astype(np.float64) - joint.states[:, :d]
    distance = np.linalg.norm(to_goal, axis=1)
    velocity = joint.states[:, d : 2 * d]
    towards = (velocity * to_goal).sum(axis=1) / np.maximum(distance, 1e-9)
    if problem.world.num_obstacles:
        distance = problem.with_state(joint.states, joint.goals).shortest_paths.length
        towards = np.linalg.norm(velocity, axis=1)
    distance = np.maximum(distance - problem.goal_radius, 0)
    to_top_speed = (speed**2 - towards**2) / (2 * acceleration)
    reached = np.sqrt(towards**2 + 2 * acceleration * np.minimum(distance, to_top_speed))
    return (reached - towards) / acceleration + np.maximum(distance - to_top_speed, 0) / speed


def drive(problem: Problem, seed: int, minutes: float, seconds: float) -> tuple[dict[str, Any], list[Any]]:
    """Drive for so many minutes, and film the first seconds: what was measured, and the film."""
    env = navigation_v0.parallel_env(problem=problem, lifelong=True)
    env.max_cycles = max(round(60 * minutes / problem.dt), 1)
    observations, _ = env.reset(seed=seed)
    policy: Any = make_policy("d4orm-c2f", refine="background")
    policy.reset(env, seed=seed)

    joint = split_state(problem, env.state())
    bounds = list(least_times(problem, joint))
    act_times, joints, goals_reached = [], [joint], [0]
    collided = [np.zeros(problem.num_robots, bool)]
    while env.agents:
        begin = time.perf_counter()
        actions = policy.act(observations, env.state())
        act_times.append(time.perf_counter() - begin)
        observations, _, _, _, infos = env.step(actions)
        joint = split_state(problem, env.state())
        bounds.extend(least_times(problem, joint)[(joint.goals != joints[-1].goals).any(axis=1)])
        joints.append(joint)
        collided.append(np.array([infos[agent]["collided"] for agent in env.possible_agents]))
        goals_reached.append(len(bounds) - problem.num_robots)
    metrics, replanned = env.unwrapped.metrics(), sum(loop.replanned for loop in policy.loops)
    env.close()
    row = {
        "robots": problem.num_robots,
        "seconds": joint.steps * problem.dt,
        "goals": int(metrics["goals_reached"]),
        "least_time": float(np.mean(bounds)),
        "touched": int(np.any(collided, axis=0).sum()),
        "contacts": int(metrics["collisions"]),
        "replanned": replanned,
        "loop_seconds": act_times,
    }
    shown = joints[: 1 + int(seconds / problem.dt)]
    captions = [f"{j.steps * problem.dt:.1f} s    {count} goals reached" for j, count in zip(shown, goals_reached)]
    faded = np.zeros((len(shown), problem.num_robots), bool)
    # With a view of all positions that a goal may have.
    return row, film(problem, shown, faded, collided[: len(shown)], captions, goal_region(problem))


def summary(drives: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The table's row of drives that differ in their seeds: means, sums, and all loops taken together."""
    rates = [60 * drive["goals"] / (drive["robots"] * drive["seconds"]) for drive in drives]
    bounds = [60 / drive["least_time"] for drive in drives]
    share, lower, upper = mean_interval([rate / bound for rate, bound in zip(rates, bounds, strict=True)])
    loops = 1000 * np.concatenate([drive["loop_seconds"] for drive in drives])
    return {
        "scenario": drives[0]["scenario"],
        "robots": drives[0]["robots"],
        "seeds": len(drives),
        "simulated [s]": f"{sum(drive['seconds'] for drive in drives):.1f}",
        "goals reached": sum(drive["goals"] for drive in drives),
        "goals per robot-minute": f"{np.mean(rates):.2f}",
        "bound": f"{np.mean(bounds):.2f}",
        "share of the bound": f"{share:.1%}",
        "interval": "-" if lower is None else f"{lower:.1%} to {upper:.1%}",
        "robots that touched": sum(drive["touched"] for drive in drives),
        "robot-steps in contact": sum(drive["contacts"] for drive in drives),
        "loop, median [ms]": f"{np.median(loops):.0f}",
        "loop, 95th percentile [ms]": f"{np.percentile(loops, 95):.0f}",
        "loop, slowest [ms]": f"{loops.max():.0f}",
        "guidance planned anew": sum(drive["replanned"] for drive in drives),
    }


def main() -> None:
    parser = study_parser(__doc__)
    parser.add_argument("--minutes", type=float, default=1.0, help="simulated time per seed")
    parser.add_argument("--scenario", default="random")
    parser.add_argument("--num-robots", "--robots", type=count, default=16)
    parser.add_argument("--seed", type=int, default=0, help="the first")
    parser.add_argument("--seeds", type=count, default=1, help="how many, one after the other")
    parser.add_argument("--film", type=float, default=20.0, help="seconds of the animation")
    arguments = parser.parse_args()
    num_robots, minutes, seconds = arguments.num_robots, arguments.minutes, arguments.film
    if arguments.quick:
        num_robots, minutes, seconds = 4, 0.1, 2.0

    def measure() -> list[dict[str, Any]]:
        drives: list[dict[str, Any]] = []
        for seed in range(arguments.seed, arguments.seed + arguments.seeds):
            problem = make_problem(arguments.scenario, num_robots=num_robots, seed=seed, **AS_IN_THE_PAPER)
            row, frames = drive(problem, seed, minutes, 0.0 if drives else seconds)
            drives.append({"scenario": arguments.scenario, "seed": seed, **row})
            if seed == arguments.seed:
                save_gif(frames, arguments.out / "lifelong.gif", problem.dt)
        return drives

    drives = study_rows(arguments, "lifelong", measure)
    save_table([summary(drives)], arguments.out / "lifelong.csv")
