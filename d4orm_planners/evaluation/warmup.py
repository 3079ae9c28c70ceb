"""Compile ahead whatever planning, rolling out and the environments need, into the cache on disk."""

from __future__ import annotations

import pkgutil
import time
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np


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


def warm_up() -> WarmupReport:
    """Run everything once on the smallest problems.

    One compilation of a kernel serves every problem, so two robots stand for all teams.
    """
    begin = time.perf_counter()
    _plan()
    _step_environments()
    seconds = time.perf_counter() - begin
    kernels = [kernel for kernel in _kernels() if kernel.signatures]
    compiled = tuple(kernel.__name__ for kernel in kernels if kernel.stats.cache_misses)
    loaded = tuple(kernel.__name__ for kernel in kernels if not kernel.stats.cache_misses)
    return WarmupReport(seconds, compiled, loaded, tuple(sorted({Path(kernel.stats.cache_path) for kernel in kernels})))


def _plan() -> None:
    from d4orm_env import make_problem
    from d4orm_planners.registry import PLANNERS, make_planner
    from d4orm_planners.sampling.optimizer import SamplingPlanner

    problem = make_problem("circle", num_robots=2, horizon=5)
    # A planner that does not sample has nothing to compile that the others have not.
    for name in (name for name, kind in PLANNERS.items() if issubclass(kind, SamplingPlanner)):
        make_planner(name, engine="cpu", num_samples=32, num_steps=1).solve(problem, max_iterations=1)


def _step_environments() -> None:
    from d4orm_env import make_problem, navigation_v0

    for arguments in ({}, {"lifelong": True}, {"control_noise_std": 0.1}):
        env = navigation_v0.parallel_env(problem=make_problem("circle", num_robots=2, horizon=5), **arguments)
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
