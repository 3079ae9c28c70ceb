"""The CPU engine: the physics compiled with numba for all cores of one processor.

Its kernels step and observe many worlds of one problem at once. These share the team, the obstacles and the bounds;
each has its own goals, state and clock. A single environment is a batch of one.
"""

from __future__ import annotations

from functools import lru_cache, partial
from threading import local
from typing import Any

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from d4orm_env.core.arrays import BoolArray, FloatArray, IntArray
from d4orm_env.core.observation_layout import ObservationLayout
from d4orm_env.core.problem import Problem
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.core.trajectory import Trajectory
from d4orm_env.dynamics.models import names_of_codes
from d4orm_env.engine.borrowing import borrowed
from d4orm_env.engine.compiling import aligned_zeros
from d4orm_env.engine.episodes import RollOut, advance_worlds, roll_out_kernel
from d4orm_env.engine.observing import (
    SENSED_TYPES,
    ObservationSpec,
    WorldScratch,
    allocate_scratch,
    observe_world,
    observe_worlds,
    see_obstacles,
)
from d4orm_env.engine.ray_casting import Surroundings, cast_rays
from d4orm_env.engine.simd import TILE
from d4orm_env.engine.stepping import models_of_kernel
from d4orm_env.engine.threads import Threads, available_cores
from d4orm_env.engine.tiles import BOX_TYPES, STRIDE, allocate_boxes, pose_rows, robot_unit
from d4orm_env.engine.types import ObservationInputs, StepResult, WorldBatch, checked_controls
from d4orm_env.engine.units import Call, Types, address_of, compile_together, path_of
from d4orm_env.engine.world_tiles import CONTACT_TYPES, WorldArrays, check_contacts, mark_static

SHARED = 2**15  #: Steps of all robots together from which on threads share the checks of a rollout


def roll_out_of(models: tuple[str, ...]) -> RollOut:
    """The kernel that rolls teams of these models out."""
    return roll_out_kernel(models_of_kernel(models))


@lru_cache(maxsize=256)
def roll_out_of_codes(codes: bytes) -> RollOut:
    """:func:`roll_out_of` by the bytes of ``model_codes``."""
    return roll_out_of(names_of_codes(np.frombuffer(codes, np.int32)))


_UNITS: dict[tuple[object, ...], IntArray] = {}
"""By what decides what they are, up to :data:`_MOST_UNITS`."""
_MOST_UNITS = 256
_OPEN = {np.array([[-np.inf] * d, [np.inf] * d], np.float32).tobytes() for d in (2, 3)}
"""Bounds that are none."""


def _units_of(arrays: ProblemArrays, view: ObservationSpec | None, caller: Any, *arguments: object) -> IntArray:
    """``(N, 2)`` addresses of the units that a kernel calls, those of :data:`CONTACTS` and so on.

    The first time they are compiled, together with the kernel if it is a module's. These are its arguments before them.
    """
    sight = view is not None and view.line_of_sight
    closed = len(arrays.grid.clearance) > 0 or arrays.bounds.tobytes() not in _OPEN
    key = caller, arrays.model_codes.tobytes(), arrays.footprints is None, arrays.turns_at_goals is None, closed, sight
    if key not in _UNITS:
        if len(_UNITS) >= _MOST_UNITS:
            _UNITS.clear()
        units = _units(arrays, closed, view)
        kinds = (*map(numba.typeof, arguments), numba.int64[:, ::1])
        compile_together([*dict.fromkeys(filter(None, units)), (path_of(caller), kinds)] if caller else [])
        _UNITS[key] = np.array([address_of(*call) if call else (0, 0) for call in units])
    return _UNITS[key]


def _units(arrays: ProblemArrays, closed: bool, view: ObservationSpec | None) -> list[Call | None]:
    """The units of kernels for this problem, ``None`` for one that is not called."""
    problem, rows, lines = borrowed(arrays), numba.float32[:, :, ::1], numba.float32[::1]
    near, addresses = numba.uint64[:, ::1], numba.int64[:, ::1]
    kinds: Types = problem, addresses, CONTACT_TYPES, numba.int64, lines, BOX_TYPES, near
    units: list[Call | None] = [(path_of(check_contacts), kinds)]
    units.append((path_of(mark_static), (problem, numba.uint64, numba.float32, lines, near)) if closed else None)
    if view is not None:
        table = numba.float32[:, ::1]
        kinds = problem, table, numba.float32, borrowed(view), SENSED_TYPES, table, addresses
        units.append((path_of(observe_world), kinds))
        kinds = problem, SENSED_TYPES, numba.int64, table
        units.append((path_of(see_obstacles), kinds) if closed else None)
        kinds = problem, numba.int64, numba.int64, lines, rows
        units += [(path_of(robot_unit, name), kinds) for name in names_of_codes(arrays.model_codes)]
    return units


_kept = local()


def _scratch_of(arrays: ProblemArrays, view: ObservationSpec, num_bodies: int) -> WorldScratch:
    """Room for kernels, which a thread keeps from call to call."""
    poses = 0 if arrays.footprints is None else len(arrays.footprints.heading)
    # Where all are observed, none must be marked as hidden from a call before.
    size = arrays.goal.shape, poses, num_bodies, *view[1:]
    if getattr(_kept, "size", None) != size:
        _kept.size, _kept.scratch = size, allocate_scratch(arrays, view, num_bodies)
    return _kept.scratch


_PART = np.zeros(2, np.int64)
"""For its type."""


class CpuEngine:
    """The physics on the CPU, and observations for environments. Stateless: all instances are alike."""

    name = "cpu"

    def __init__(self, num_threads: int | None = None) -> None:
        self._threads = Threads(num_threads or available_cores())

    def step(self, arrays: ProblemArrays, states: FloatArray, arrived: BoolArray, controls: FloatArray) -> StepResult:
        """See :meth:`d4orm_env.engine.types.Engine.step`."""
        after = _rolled_out(arrays, states, arrived, np.asarray(controls)[None])
        return StepResult(
            after.state[1], after.control[1], after.arrived[1], after.collided[1], after.violated[1], after.rewards[1]
        )

    def move(self, arrays: ProblemArrays, states: FloatArray, arrived: BoolArray, controls: FloatArray) -> FloatArray:
        """See :meth:`d4orm_env.engine.types.Engine.move`."""
        return _rolled_out(arrays, states, arrived, controls, checked=False).state

    def observe_worlds(
        self, arrays: ProblemArrays, layout: ObservationLayout, sight: ObservationInputs, out: FloatArray
    ) -> None:
        """Fill ``out`` ``(B, K, D)`` with what every robot of every world sees, inside the layout's bounds."""
        arrays, view = typed(arrays), _view(layout)
        size = arrays, view, sight.bodies.shape[1]
        units = _units_of(arrays, view, observe_worlds, arrays, sight, view, _PART, out, _scratch_of(*size))
        self._threads.over(
            -(-len(out) // TILE),
            lambda part: observe_worlds(arrays, sight, view, part, out, _scratch_of(*size), units),
        )

    def cast_rays(
        self, arrays: ProblemArrays, layout: ObservationLayout, state: FloatArray, bodies: FloatArray, out: FloatArray
    ) -> None:
        """Fill the rays of ``out`` ``(B, K, D)``, for states ``(B, K, n)`` among bodies ``(B, N, 2 d + 1)``."""
        around, first = Surroundings.of(arrays, layout.ray_directions, layout.ray_range), layout.rays.start
        self._threads.over(-(-len(out) // TILE), lambda part: cast_rays(around, state, bodies, first, part, out))

    def advance(
        self,
        arrays: ProblemArrays,
        layout: ObservationLayout,
        max_cycles: int,
        orders: NDArray[np.uint8],
        batch: WorldBatch,
        out: FloatArray,
    ) -> None:
        """Step, reset and observe the worlds of a batch in place, each by one of ``orders`` ``(B,)`` such as ``STEP``.

        They share the problem of ``arrays``, but for starts and goals; ``batch.control`` holds their controls. ``out``
        ``(B, K, D)`` is filled with the observations of all but skipped worlds, or ``(0, K, D)`` with none.
        """
        arrays, view = typed(arrays), _view(layout)
        scratch = _scratch_of(arrays, view, 0)
        units = _units_of(arrays, view, advance_worlds, arrays, view, max_cycles, orders, batch, _PART, out, scratch)
        self._threads.over(
            -(-len(orders) // TILE),
            lambda part: advance_worlds(
                arrays, view, max_cycles, orders, batch, part, out, _scratch_of(arrays, view, 0), units
            ),
        )

    def rollout(self, problem: Problem, controls: ArrayLike) -> Trajectory:
        """See :meth:`d4orm_env.engine.types.Engine.rollout`."""
        away = np.zeros(problem.num_robots, bool)
        arrays, given = problem.arrays, checked_controls(problem, controls)
        moments = _rolled_out(arrays, problem.start, away, given, threads=self._threads)
        return Trajectory(
            states=moments.state,
            positions=np.ascontiguousarray(moments.state[..., : problem.dimension]),
            controls=moments.control[1:],
            rewards=moments.rewards[1:],
            arrived=moments.arrived,
            collided=moments.collided,
            margin_violated=moments.violated,
        )

    def score(self, problem: Problem, controls: ArrayLike) -> FloatArray:
        """See :meth:`d4orm_env.engine.types.Engine.score`."""
        samples, away = checked_controls(problem, controls, batch=True), np.zeros(problem.num_robots, bool)
        rewards = np.empty((len(samples), problem.num_robots), np.float32)

        def work(part: IntArray) -> None:
            for sample in range(*part):
                moments = _rolled_out(problem.arrays, problem.start, away, samples[sample])
                rewards[sample] = moments.rewards[1:].mean(axis=0)

        self._threads.over(len(samples), work)
        return rewards


def _view(layout: ObservationLayout) -> ObservationSpec:
    squared_range = np.float32(layout.communication_range**2)
    return ObservationSpec(
        layout.bounds, layout.num_neighbors, layout.num_obstacles, max(layout.goal_headings, 1), squared_range,
        layout.line_of_sight or None,
    )  # fmt: skip


def _rolled_out(
    arrays: ProblemArrays,
    states: FloatArray,
    before: BoolArray,
    controls: FloatArray,
    *,
    checked: bool = True,
    threads: Threads | None = None,
) -> WorldArrays:
    """The ``H+1`` moments of a team from states ``(K, n)`` on under controls ``(H, K, m)``, clipped here.

    Unless they are ``checked``, contacts are not looked for, and there are no rewards. ``threads`` share that where
    there is much to check.
    """
    arrays, rows = typed(arrays), len(controls) + 1
    state = np.empty((rows, *states.shape), np.float32)
    control = np.zeros((rows, *controls.shape[1:]), np.float32)
    arrived, collided, violated = np.zeros((3, rows, len(states)), np.bool_)
    rewards = np.empty((rows if checked else 0, len(states)), np.float32)
    state[0], arrived[0], control[1:] = states, before, controls
    goal, inverse = arrays.goal[None], arrays.inverse_initial_distance[None].copy()
    nothing = np.empty((0, 0, 2 * goal.shape[-1] + 1), np.float32)
    moments = WorldArrays(goal, inverse, state, control, arrived, nothing, collided, violated, rewards)
    kernel, num_tiles = roll_out_of_codes(arrays.model_codes.tobytes()), -(-len(rewards) // TILE)
    units = _units_of(arrays, None, None)

    def run(moves: bool, tiles: IntArray) -> None:
        w = aligned_zeros(len(states) * STRIDE + pose_rows(arrays.footprints) * TILE)
        near, boxes = np.empty((len(states), 3), np.uint64), allocate_boxes(arrays)
        kernel(arrays, moments, moves, tiles, w, near, boxes, units)

    if threads is None or rewards.size < SHARED:
        run(True, np.array((0, num_tiles)))
    else:
        run(True, np.zeros(2, np.int64))
        threads.over(num_tiles, partial(run, False))
    return moments


def typed(arrays: ProblemArrays) -> ProblemArrays:
    """The arrays with replaced goals made read-only like the rest, so that one compilation serves all."""
    goal, inverse = arrays.goal, arrays.inverse_initial_distance
    if not (goal.flags.writeable or inverse.flags.writeable):
        return arrays
    goal, inverse = goal.view(), inverse.view()
    goal.flags.writeable = inverse.flags.writeable = False
    return arrays._replace(goal=goal, inverse_initial_distance=inverse)
