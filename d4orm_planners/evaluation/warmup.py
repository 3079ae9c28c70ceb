"""Compile ahead whatever planning, rolling out and the environments need, into the cache on disk.

The two largest kernels, that which samples and that which rolls out a plan, take equally long. numba compiles one at a
time in a process, so that two processes do it in half the time.
"""

from __future__ import annotations

import pkgutil
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from d4orm_env.core.problem import Problem
from d4orm_env.engine.base import SamplingRules, SamplingTask, get_engine
from d4orm_env.engine.caching import has_to_be_compiled
from d4orm_env.scenarios import make_problem
from d4orm_planners.sampling.weights import SoftmaxWeights


@dataclass(frozen=True)
class WarmupReport:
    """What a warm-up did.

    Attributes:
        seconds: How long it took.
        compiled: Kernels that had to be compiled.
        loaded: Kernels that were in the cache already.
        folders: Where the cache is; empty if no folder can be written to, so that nothing is kept.
    """

    seconds: float
    compiled: tuple[str, ...]
    loaded: tuple[str, ...]
    folders: tuple[Path, ...]


def compile_for_planning(announce: Callable[[], None] = lambda: None) -> None:
    """Compile what planning on the CPU needs, in this process and another, unless it is on disk already.

    Args:
        announce: Called before it begins, if there is anything to do.
    """
    from d4orm_env.engine.sampling import score_tiles
    from d4orm_env.engine.worlds import roll_out

    if has_to_be_compiled(score_tiles) and has_to_be_compiled(roll_out):
        announce()
        # Should it fail, the kernel is compiled when it is needed, like any other.
        other = subprocess.Popen([sys.executable, "-c", f"from {__name__} import roll_out_once; roll_out_once()"])
        _sample_once()
        other.wait()


def roll_out_once() -> None:
    """Roll out a plan of the smallest problem on the CPU."""
    problem = _smallest_problem()
    shape = (problem.horizon, problem.num_robots, problem.control_size)
    get_engine("cpu").rollout(problem, np.zeros(shape, np.float32))


def _sample_once() -> None:
    problem = _smallest_problem()
    shape = (problem.horizon, problem.num_robots, problem.control_size)
    rules = SamplingRules(weights=SoftmaxWeights(1.0))
    task = SamplingTask(problem, np.zeros(shape, np.float32))
    get_engine("cpu").prepare(task, rules, np.ones(1, np.float32), 2)


def warm_up() -> WarmupReport:
    """Run everything once on the smallest problems.

    One compilation of a kernel serves every problem, so two robots stand for all teams.
    """
    begin = time.perf_counter()
    # Before anything runs: what the other process compiles is in the cache when it is needed here.
    missing = {kernel.__name__ for kernel in _kernels() if has_to_be_compiled(kernel)}
    compile_for_planning()
    _plan()
    _step_environments()
    seconds = time.perf_counter() - begin
    kernels = [kernel for kernel in _kernels() if kernel.signatures]
    compiled = tuple(kernel.__name__ for kernel in kernels if kernel.stats.cache_misses or kernel.__name__ in missing)
    loaded = tuple(kernel.__name__ for kernel in kernels if kernel.__name__ not in compiled)
    return WarmupReport(seconds, compiled, loaded, tuple(sorted({Path(kernel.stats.cache_path) for kernel in kernels})))


def _smallest_problem() -> Problem:
    return make_problem("circle", num_robots=2, horizon=5)


def _plan() -> None:
    from d4orm_planners.registry import PLANNERS, make_planner
    from d4orm_planners.sampling.optimizer import SamplingPlanner

    problem = _smallest_problem()
    # A planner that does not sample has nothing to compile that the others have not.
    for name in (name for name, kind in PLANNERS.items() if issubclass(kind, SamplingPlanner)):
        make_planner(name, engine="cpu", num_samples=32, num_steps=1).solve(problem, max_iterations=1)


def _step_environments() -> None:
    from d4orm_env import navigation_v0

    for arguments in ({}, {"lifelong": True}, {"control_noise_std": 0.1}):
        env = navigation_v0.parallel_env(problem=_smallest_problem(), **arguments)
        env.reset(seed=0)
        zero = np.zeros(env.action_space(env.possible_agents[0]).shape, np.float32)
        env.step(dict.fromkeys(env.agents, zero))
        env.close()

    from gymnasium import make_vec

    vector_env = make_vec("d4orm/Navigation-v0", num_envs=2, vectorization_mode="vector_entry_point", num_robots=2)
    vector_env.reset(seed=0)
    vector_env.step(np.zeros(vector_env.action_space.shape, np.float32))
    vector_env.close()


def _kernels() -> list[Any]:
    """The kernels of the engines that are kept on disk."""
    from numba.core.dispatcher import Dispatcher

    from d4orm_env import engine

    modules = [import_module(f"{engine.__name__}.{module.name}") for module in pkgutil.iter_modules(engine.__path__)
               if module.name != "jax"]  # fmt: skip
    found = {name: value for module in modules for name, value in vars(module).items() if isinstance(value, Dispatcher)}
    return [kernel for kernel in found.values() if kernel.stats.cache_path is not None]
