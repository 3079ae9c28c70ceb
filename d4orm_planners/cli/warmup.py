"""``d4orm warmup``: compile ahead whatever planning, rolling out and the environments need, into the cache on disk."""

from __future__ import annotations

import pkgutil
import time
from collections.abc import Callable
from importlib import import_module
from typing import Any

import numpy as np
import typer
from gymnasium import make_vec
from numba.core.dispatcher import Dispatcher

from d4orm_env import engine, navigation_v0, paths
from d4orm_env.disturbances import Dropout, Intruder, StateNoise
from d4orm_env.dynamics.models import COMMON
from d4orm_env.engine.caching import Kernel, check_can_be_kept, has_to_be_compiled
from d4orm_env.engine.cpu import roll_out_of
from d4orm_env.engine.tiles import robot_unit
from d4orm_env.envs.joint_state import JointState
from d4orm_planners import d4orm_c2f, manoeuvres, mapf, tracking
from d4orm_planners import engine as sampling_engine
from d4orm_planners.base.names import PLANNERS
from d4orm_planners.base.planner_registry import make_planner
from d4orm_planners.cli.options import Quiet
from d4orm_planners.d4orm_c2f.barrier import safe_velocities
from d4orm_planners.engine.score import score_kernel
from d4orm_planners.hybrid import compile_ahead
from d4orm_planners.manoeuvres.closing import gap_closer
from d4orm_planners.manoeuvres.primitives import MOVES
from d4orm_planners.manoeuvres.rounds import compile_manoeuvres
from d4orm_planners.mapf.beam_search import search_kernel
from d4orm_planners.sampling.loop import SamplingPlanner
from d4orm_planners.tracking.tracker import follow_reference, reference_kernel, straight_kernel

TEAMS = (*((model, model) for model in COMMON), ("holonomic2d", "differential_drive"))
"""The smallest teams of common models that have kernels of their own."""
_MANOEUVRING = tuple(model for model in COMMON if model in MOVES)
"""Common models that have manoeuvres."""


def warm_up() -> None:
    """Run everything once on the smallest problems, of two robots: one compilation serves all of the same models."""
    # The last kernel, for three models, takes as long as two others.
    other = compile_ahead.in_another_process(
        f"drive_once({TEAMS[0]}); sample_once({TEAMS[1:-1]}); find_paths(); spread_waves()"
    )
    compile_ahead.sample_once((TEAMS[0], TEAMS[-1]))
    for models in TEAMS:
        compile_ahead.roll_out_once(models)
    for models in TEAMS[1:]:
        compile_ahead.drive_once(models)
    for models in TEAMS[:-1]:
        _brake(models)
    _step_environments()
    compile_manoeuvres(_MANOEUVRING)
    other.wait()
    compile_ahead.sample_once(TEAMS)
    compile_ahead.drive_once(TEAMS[0])
    compile_ahead.find_paths()
    compile_ahead.spread_waves()
    _evade()
    _plan()


def _plan() -> None:
    problem = compile_ahead.smallest_problem(TEAMS[0])
    # A planner that does not sample has nothing to compile that the others have not.
    for name in (name for name in PLANNERS.own() if issubclass(PLANNERS[name], SamplingPlanner)):
        make_planner(name, engine="cpu", num_samples=32, num_steps=1).solve(problem, max_iterations=1)


def _brake(models: tuple[str, ...]) -> None:
    """Bring robots to rest, as D4orm-C2F does after its plans."""
    problem = compile_ahead.smallest_problem(models)
    at_rest = np.zeros((1, *problem.goal.shape), np.float32)
    follow_reference(problem, problem.start, at_rest, at_rest, 0.0)


def _evade() -> None:
    """Keep two robots apart, as D4orm-C2F does in the last resort."""
    problem = compile_ahead.smallest_problem(TEAMS[0])
    colliding, acting = 10 * (problem.start[::-1] - problem.start)[:, :2], np.ones(problem.num_robots, np.bool_)
    joint = JointState(problem.start, problem.goal, compile_ahead.no_controls(problem)[0], ~acting, 0)
    safe_velocities(problem, joint, colliding, acting, problem.margin)


def _step_environments() -> None:
    disturbances = [Dropout(0.5), StateNoise(0.1), Intruder()]
    options: tuple[dict[str, Any], ...] = {}, {"lifelong": True}, {"disturbances": disturbances, "observed_rays": 4}
    for models, arguments in ((TEAMS[0], options[1]), (TEAMS[0], options[2]), *((models, {}) for models in TEAMS[:-1])):
        env = navigation_v0.parallel_env(problem=compile_ahead.smallest_problem(models), **arguments)
        env.reset(seed=0)
        zero = np.zeros(env.action_space(env.possible_agents[0]).shape, np.float32)
        env.step(dict.fromkeys(env.agents, zero))
        env.close()

    arguments = {"scenario": "doorway", "num_robots": 4}  # obstacles are seen by a kernel of their own
    vector_env = make_vec("d4orm/Navigation-v0", num_envs=2, vectorization_mode="vector_entry_point", **arguments)
    vector_env.reset(seed=0)
    vector_env.step(np.zeros(vector_env.action_space.shape, np.float32))
    vector_env.close()


def _kernels() -> list[Dispatcher[Callable[..., object]]]:
    """The kernels of engines, guided plans and D4orm-C2F that are kept on disk."""
    packages = (engine, paths, sampling_engine, tracking, manoeuvres, mapf, d4orm_c2f)
    modules = [import_module(f"{package.__name__}.{module.name}") for package in packages
               for module in pkgutil.iter_modules(package.__path__) if "jax" not in module.name]  # fmt: skip
    found = {name: value for module in modules for name, value in vars(module).items() if isinstance(value, Dispatcher)}
    kernels: list[Kernel[..., object]] = [
        *found.values(),
        *map(roll_out_of, TEAMS),
        *map(robot_unit, COMMON),
        *map(score_kernel, TEAMS),
        *map(straight_kernel, COMMON),
        *map(reference_kernel, COMMON),
    ]
    kernels += map(search_kernel, COMMON)
    kernels += map(gap_closer, _MANOEUVRING)
    return [kernel for kernel in kernels if isinstance(kernel, Dispatcher) and kernel.stats.cache_path is not None]


def warmup(quiet: Quiet = False) -> None:
    """Compile ahead what planning and the environments need, so that the next start is quick."""
    check_can_be_kept()
    begin = time.perf_counter()
    # Before anything runs: what another process compiles meanwhile is in the cache when it is needed here.
    missing = [kernel for kernel in _kernels() if has_to_be_compiled(kernel)]
    warm_up()
    seconds = time.perf_counter() - begin
    kernels = [kernel for kernel in _kernels() if kernel.signatures]
    compiled = [kernel for kernel in kernels if kernel.stats.cache_misses or kernel in missing]
    if not quiet:
        found = len(kernels) - len(compiled)
        typer.echo(f"{len(compiled)} kernels compiled, {found} found in the cache, {seconds:.1f} s")
        for folder in sorted({str(kernel.stats.cache_path) for kernel in kernels}):
            typer.echo(f"cache {folder}")
    if lost := sum(map(has_to_be_compiled, compiled)):
        raise OSError(f"{lost} kernels could not be kept; free some space, or set NUMBA_CACHE_DIR")
