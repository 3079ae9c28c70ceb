"""Kernels compiled ahead of planning: each is called once, on the smallest problem, in this process or another.

What samples and rolls out takes as long as what searches for drives. numba compiles one kernel at a time in a process,
so that two processes do it in half the time.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable

import numpy as np

from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.engine.caching import has_to_be_compiled
from d4orm_env.engine.cpu import world_kernels
from d4orm_env.engine.threads import Threads
from d4orm_env.scenarios import make_problem
from d4orm_planners.base.planner_registry import make_planner
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.engine.cpu_sampling import Sampling
from d4orm_planners.engine.path_index import PathIndex, check_alone
from d4orm_planners.engine.sampling_types import SamplingRules, SamplingTask, get_sampling_engine
from d4orm_planners.engine.score import score_kernel
from d4orm_planners.sampling.weights import SoftmaxWeights
from d4orm_planners.tracking.steering import prepare_drives, standing

_RULES = SamplingRules(weights=SoftmaxWeights(1.0))


def compile_for_planning(
    models: tuple[str, ...], announce: Callable[[], None] = lambda: None, *, driver: str = "", walls: bool = False
) -> None:
    """Compile what planning on the CPU needs, in this process and another, unless it is on disk already.

    Args:
        models: The team's.
        announce: Called before it begins, if there is anything to do.
        driver: The planner's name, if it looks for drives before it samples.
        walls: Whether it then finds paths among obstacles too.
    """
    if not (has_to_be_compiled(score_kernel(models)) and has_to_be_compiled(world_kernels(models).roll_out)):
        return
    announce()
    # Either takes about half of the time. Should the other fail, its kernels are compiled when they are needed.
    drive, paths = f"drive_once({models!r}, {driver!r})", "; find_paths()" if walls else ""
    other = in_another_process(drive + paths if driver else f"average_once({models!r}); roll_out_once({models!r})")
    if driver:
        # First what the other process needs too, later.
        roll_out_once(models)
    if driver and walls:
        spread_waves()
    sample_once((models,))
    other.wait()


def in_another_process(call: str) -> subprocess.Popen[bytes]:
    """Start a process that calls functions of this module."""
    # What ends it, as Ctrl-C, ends this process too, which says so.
    names = "average_once, drive_once, find_paths, roll_out_once, sample_once, spread_waves"
    return subprocess.Popen(
        [sys.executable, "-c", f"from {__name__} import {names}; {call}"], stderr=subprocess.DEVNULL
    )


def roll_out_once(models: tuple[str, ...]) -> None:
    """Roll out a plan of the smallest problem of a team of these models on the CPU."""
    problem = smallest_problem(models)
    get_sampling_engine("cpu").rollout(problem, no_controls(problem))


def average_once(models: tuple[str, ...]) -> None:
    """Weigh and average samples, which a process that scores them needs last."""
    problem = smallest_problem(models)
    rewards = np.zeros((1, 2), np.float32)
    run = Sampling(SamplingTask(problem, no_controls(problem)), _RULES, rewards.size, 0, Threads(1))
    run.moments(_RULES.weights(rewards, np), with_second=False)


def drive_once(models: tuple[str, ...], driver: str = "hybrid") -> None:
    """Look for drives as a planner begins with, in the smallest problem of a team of these models."""
    planner, problem = make_planner(driver, engine="cpu"), smallest_problem(models)
    prepare_drives(problem)
    _index_paths(problem)
    # Last, because this rolls out, which another process compiles meanwhile.
    planner.init(SolveRun(planner, problem, seed=0))


def _index_paths(problem: Problem) -> None:
    """Look for meetings and faults of robots that stay where they are."""
    states, robots = standing(problem)[0], np.arange(problem.num_robots)
    index = PathIndex(states[..., : problem.dimension], problem.team.radius, problem.margin)
    index.pairs()
    index.move(robots, index.positions)
    paths = states.swapaxes(0, 1)[:, None]
    index.count_meetings(robots, paths)
    check_alone(problem.arrays, robots, paths)


def sample_once(teams: tuple[tuple[str, ...], ...]) -> None:
    """Sample once for teams of these models on the CPU."""
    for models in teams:
        problem = smallest_problem(models)
        task = SamplingTask(problem, no_controls(problem))
        get_sampling_engine("cpu").prepare(task, _RULES, np.ones(1, np.float32), 2)


def _doorway() -> Problem:
    return make_problem("doorway", num_robots=4)


def spread_waves() -> None:
    """Find shortest paths among walls."""
    problem = _doorway()
    problem.shortest_paths.distance(problem.goal)


def find_paths() -> None:
    """Find paths for a team among walls, and drive along them."""
    make_planner("mapf", engine="cpu").solve(_doorway(), seed=0)


def smallest_problem(models: tuple[str, ...]) -> Problem:
    """Return a problem of five steps in which nobody meets anybody."""
    team = Team(models)
    start = np.zeros((team.num_robots, team.state_size))
    start[:, 1] = np.arange(team.num_robots)  # beside each other: trailers are behind
    return Problem(team, start=start, goal=start[:, : team.dimension] + 1, horizon=5)


def no_controls(problem: Problem) -> FloatArray:
    """Return controls ``(H, K, m)`` of zeros."""
    return np.zeros((problem.horizon, problem.num_robots, problem.control_size), np.float32)
