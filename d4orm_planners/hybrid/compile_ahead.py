"""Kernels compiled ahead of planning: each is called once, on the smallest problem, in this process or another.

numba compiles one kernel at a time in a process, so that two processes do it in half the time.
"""

from __future__ import annotations

import subprocess
from collections.abc import Callable

import numpy as np

from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.engine.caching import has_to_be_compiled
from d4orm_env.engine.cpu import roll_out_of
from d4orm_env.engine.threads import Threads
from d4orm_env.engine.units import another_process
from d4orm_env.scenarios import make_problem
from d4orm_planners.base.planner import Planner
from d4orm_planners.base.planner_registry import make_planner
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.engine.cpu_sampling import Sampling
from d4orm_planners.engine.path_index import check_alone, team_index
from d4orm_planners.engine.sampling_types import SamplingRules, SamplingTask, get_sampling_engine
from d4orm_planners.engine.score import score_kernel
from d4orm_planners.hybrid.planner import Hybrid
from d4orm_planners.mapf.planner import compile_path_finding
from d4orm_planners.sampling.weights import SoftmaxWeights
from d4orm_planners.tracking.steering import at_rest, prepare_drives

_RULES = SamplingRules(weights=SoftmaxWeights(1.0))


def compile_for_planning(planner: Planner, problem: Problem, announce: Callable[[], None] = lambda: None) -> None:
    """Compile what a planner's first plan on the CPU needs, in this process and another, unless it is on disk already.

    ``announce`` is called before it begins, if there is anything to do.
    """
    models = problem.team.models
    if not has_to_be_compiled(roll_out_of(models)):
        if has_to_be_compiled(score_kernel(models)) and _samples_first(planner, problem):
            announce()
            sample_once((models,))
        return
    announce()
    # Either takes about half of the time. Should the other fail, its kernels are compiled when they are needed.
    if isinstance(planner, Hybrid) and _has_walls(problem):
        other = in_another_process(f"find_paths(); index_paths({models!r})")
        roll_out_once(models)
        spread_waves()
        drive_once(models)
    elif planner.drives_straight:
        other = in_another_process(f"drive_once({models!r}, {planner.name!r})")
        if _samples_first(planner, problem):
            sample_once((models,))
            average_once(models)
        index_paths(models)  # the other has this left to do, too
    else:
        other = in_another_process(f"average_once({models!r}); roll_out_once({models!r})")
        sample_once((models,))
    other.wait()


def _samples_first(planner: Planner, problem: Problem) -> bool:
    """Check whether the first iteration samples, unless it improves a plan."""
    if not isinstance(planner, Hybrid):
        return True
    return not _has_walls(problem) and planner.straight_start(problem) is None


def _has_walls(problem: Problem) -> bool:
    return len(problem.arrays.boxes) + len(problem.arrays.triangles) > 0


def in_another_process(call: str) -> subprocess.Popen[bytes]:
    """Start a process that calls functions of this module."""
    # What ends it, as Ctrl-C, ends this process too, which says so.
    return another_process(__name__, call)


def roll_out_once(models: tuple[str, ...]) -> None:
    """Roll out a plan of the smallest problem of a team of these models on the CPU."""
    problem = smallest_problem(models)
    get_sampling_engine("cpu").rollout(problem, no_controls(problem))


def average_once(models: tuple[str, ...]) -> None:
    """Weigh and average samples, which a process that scores them needs last."""
    problem = smallest_problem(models)
    rewards = np.zeros((1, 2), np.float32)
    run = Sampling(SamplingTask(problem, no_controls(problem)), rewards.size, 0, Threads(1))
    run.moments(_RULES.weights(rewards, np), with_second=False)


def drive_once(models: tuple[str, ...], driver: str = "hybrid") -> None:
    """Do what a planner begins with, in the smallest problem of a team of these models."""
    planner = make_planner(driver, engine="cpu")
    planner.init(SolveRun(planner, smallest_problem(models), seed=0))
    index_paths(models)


def index_paths(models: tuple[str, ...]) -> None:
    """Drive straight to the goals, and look for meetings and faults of robots that stay where they are."""
    problem = smallest_problem(models)
    prepare_drives(problem)
    states, robots = at_rest(problem)[0], np.arange(problem.num_robots)
    index = team_index(problem.team, states[..., : problem.dimension], problem.margin)
    paths = states.swapaxes(0, 1)[:, None]
    check_alone(problem.arrays, robots, paths)
    index.count_meetings(robots, paths)
    index.move(robots, index.positions)
    index.pairs()


def sample_once(teams: tuple[tuple[str, ...], ...]) -> None:
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
    # First what needs no roll-out, which another process compiles meanwhile.
    compile_path_finding(_doorway())
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
