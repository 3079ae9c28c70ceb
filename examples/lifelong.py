"""Robots that get a new goal whenever they arrive, under D4orm-C2F, for some minutes of simulated time.

    python examples/lifelong.py --minutes 1
    python examples/lifelong.py --minutes 5 --scenario warehouse --num-robots 32

The throughput is compared with a bound that robots cannot beat in the long run: if nobody were in its way, a robot
would accelerate to each of the goals that it was given, from the velocity that it had then, up to its top speed, and
pass through. It would drive straight, or among walls along the shortest free way, wherever it was heading before.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from outputs import argument_parser, count, save_gif, save_table

from d4orm_env import Problem, make_problem, navigation_v0
from d4orm_env.joint_state import JointState, split_state
from d4orm_env.lifelong import goal_region
from d4orm_env.render import FrameRenderer
from d4orm_planners import make_policy


def least_times(problem: Problem, joint: JointState) -> np.ndarray:
    """``(K,)`` seconds within which no double integrator gets from a joint state to its goal."""
    d = problem.dimension
    speed, acceleration, _ = np.asarray(problem.team.limits, np.float64).T
    to_goal = joint.goals.astype(np.float64) - joint.states[:, :d]
    distance = np.linalg.norm(to_goal, axis=1)
    velocity = joint.states[:, d : 2 * d]
    towards = (velocity * to_goal).sum(axis=1) / np.maximum(distance, 1e-9)
    if problem.world.num_obstacles:
        distance = problem.resumed_at(joint.states, joint.goals).ways.length
        towards = np.linalg.norm(velocity, axis=1)
    way = np.maximum(distance - problem.goal_radius, 0)
    to_top_speed = (speed**2 - towards**2) / (2 * acceleration)
    accelerating = (np.sqrt(towards**2 + 2 * acceleration * np.minimum(way, to_top_speed)) - towards) / acceleration
    return accelerating + np.maximum(way - to_top_speed, 0) / speed


class Drive(NamedTuple):
    """What came of driving a team from goal to goal."""

    seconds: float
    metrics: Mapping[str, float]
    bounds: list[float]
    act_times: list[float]
    robots_that_touched: int
    replanned: int
    frames: list[NDArray[np.uint8]]


def drive(problem: Problem, seed: int, minutes: float, film: float) -> Drive:
    """Drive for so many minutes, and film the first seconds."""
    env = navigation_v0.parallel_env(problem=problem, lifelong=True)
    env.max_cycles = max(round(60 * minutes / problem.dt), 1)
    observations, _ = env.reset(seed=seed)
    policy: Any = make_policy("d4orm-c2f")
    policy.reset(env, seed=seed)

    joint = split_state(problem, env.state())
    bounds = list(least_times(problem, joint))
    nobody = np.zeros(problem.num_robots, bool)
    trail, frames, act_times, touched = [joint.states[:, :2]], [], [], nobody
    # With a view of all places that a goal may come to lie.
    renderer = FrameRenderer(problem, (520, 540), goal_region(problem))
    while env.agents:
        begin = time.perf_counter()
        actions = policy.act(observations, env.state())
        act_times.append(time.perf_counter() - begin)
        observations, _, _, _, infos = env.step(actions)
        before, joint = joint, split_state(problem, env.state())
        bounds.extend(least_times(problem, joint)[(joint.goals != before.goals).any(axis=1)])
        collided = np.array([infos[agent]["collided"] for agent in env.possible_agents])
        touched = touched | collided
        trail = [*trail[-30:], joint.states[:, :2]]
        seconds = joint.steps * problem.dt
        if seconds <= film:
            caption = f"{seconds:.1f} s    {len(bounds) - problem.num_robots} goals reached"
            frames.append(renderer.draw(joint.states, nobody, collided, joint.goals, np.stack(trail), caption=caption))
    renderer.close()
    metrics, replanned = env.unwrapped.metrics(), sum(loop.replanned for loop in policy.loops)
    env.close()
    return Drive(seconds, metrics, bounds, act_times, int(touched.sum()), replanned, frames)


def main() -> None:
    """Run the loop, print the throughput and write the table and the animation."""
    parser = argument_parser(__doc__)
    parser.add_argument("--minutes", type=float, default=1.0, help="simulated time")
    parser.add_argument("--scenario", default="random")
    parser.add_argument("--num-robots", "--robots", type=count, default=16)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--film", type=float, default=20.0, help="seconds of the animation")
    arguments = parser.parse_args()
    num_robots, minutes, film = arguments.num_robots, arguments.minutes, arguments.film
    if arguments.quick:
        num_robots, minutes, film = 4, 0.1, 2.0

    problem = make_problem(arguments.scenario, num_robots=num_robots, seed=arguments.seed)
    driven = drive(problem, arguments.seed, minutes, film)
    rate, bound = driven.metrics["goals_per_robot_minute"], 60 / float(np.mean(driven.bounds))
    loops = 1000 * np.array(driven.act_times)
    row = {
        "scenario": arguments.scenario,
        "robots": num_robots,
        "simulated [s]": f"{driven.seconds:.1f}",
        "goals reached": int(driven.metrics["goals_reached"]),
        "goals per robot-minute": f"{rate:.2f}",
        "bound": f"{bound:.2f}",
        "share of the bound": f"{rate / bound:.0%}",
        "robots that touched": driven.robots_that_touched,
        "robot-steps in contact": int(driven.metrics["collisions"]),
        "loop, median [ms]": f"{np.median(loops):.0f}",
        "loop, 95th percentile [ms]": f"{np.percentile(loops, 95):.0f}",
        "loop, slowest [ms]": f"{loops.max():.0f}",
        "guidance planned anew": driven.replanned,
    }
    save_table([row], arguments.out / "lifelong.csv")
    save_gif(driven.frames, arguments.out / "lifelong.gif", problem.dt)


if __name__ == "__main__":
    main()
