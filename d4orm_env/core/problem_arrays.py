"""A problem as the engines read it."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core import portable
from d4orm_env.core.arrays import FloatArray, read_only
from d4orm_env.core.bodies import FootprintArrays
from d4orm_env.dynamics.models import MODEL_CODES, NUM_BUILT_IN, model_digest
from d4orm_env.dynamics.robot_model import OWN_LIMITS, UNLIMITED
from d4orm_env.dynamics.transition import docking_speed
from d4orm_env.geometry.world_index import WorldIndex

if TYPE_CHECKING:
    from d4orm_env.core.problem import Problem


class ProblemArrays(NamedTuple):
    """A problem as the engines read it: plain arrays, float32 unless said, one struct for numba and JAX alike."""

    model_codes: NDArray[np.int32]  #: ``(K,)`` int32
    limits: FloatArray  #: ``(K, L)`` see :attr:`~d4orm_env.core.team.Team.limits`
    radius: FloatArray  #: ``(K,)``
    start: FloatArray  #: ``(K, n)``
    goal: FloatArray  #: ``(K, d)``
    #: ``(K,)`` one over the distance from start to goal (at least the goal radius)
    inverse_initial_distance: FloatArray
    boxes: FloatArray  #: ``(., 2 d + 1)`` obstacles, see :class:`~d4orm_env.geometry.shapes.Shapes`
    triangles: FloatArray  #: ``(., 6)`` more of them
    grid: WorldIndex  #: Their index
    bounds: FloatArray  #: ``(2, d)``, infinite where open
    time_step: FloatArray  #: ``(4,)`` dt, dt/2, dt/3, dt/6
    margin: np.float32  #: ``()``
    squared_goal_radius: np.float32  #: ``()``
    squared_goal_speed: FloatArray  #: ``(K,)`` with the allowance for rounding; infinite without a limit
    docks: np.bool_  #: ``()`` bool: a robot that has arrived stays there for good
    collision_penalty: np.float32  #: ``()``
    #: ``()`` bool, true; ``None`` if no robot has a goal heading, and so are the next two
    turns_at_goals: np.bool_ | None
    #: ``(K, 8)`` goal headings, and hitch angles of up to three trailers, as unit vectors, zero for none
    goal_direction: FloatArray | None
    #: ``(K,)`` square of the chord by which they may be missed, infinite for none
    squared_goal_chord: FloatArray | None
    #: Of a team that is not all discs; the radii are then those of discs round them. Else ``None``: numba leaves out of
    #: a kernel what asks whether an argument is ``None`` and would go on if it were not.
    footprints: FootprintArrays | None
    wall_radius: FloatArray  #: ``(K,)`` radii of what obstacles and bounds meet, of discs the same


def inverse_initial_distance(positions: FloatArray, goal: FloatArray, goal_radius: float) -> FloatArray:
    """``(K,)`` one over the start distance; a robot that starts at its goal counts from the goal radius."""
    return (1.0 / np.maximum(np.linalg.norm(goal - positions, axis=-1), goal_radius)).astype(np.float32)


def _goal_directions(headings: FloatArray, hitches: FloatArray) -> FloatArray:
    """``(K, 8)`` goal headings ``(K,)`` and hitch angles ``(K, 3)`` as unit vectors; zero for none."""
    angles = np.column_stack([headings, hitches])
    known = ~np.isnan(angles)
    sine, cosine = portable.sin_cos(np.where(known, angles, 0).astype(np.float64))
    return (np.stack([cosine, sine], axis=2) * known[..., None]).astype(np.float32).reshape(len(headings), -1)


def _squared_chords(headings: FloatArray, tolerance: FloatArray) -> FloatArray:
    """``(K,)`` squares of the chords by which unit vectors may miss goal headings; infinite for none."""
    half = portable.sin_cos(tolerance.astype(np.float64) / 2)[0]
    return np.where(np.isnan(headings), np.inf, 4 * half * half).astype(np.float32)


def as_arrays(problem: Problem, grid: WorldIndex) -> ProblemArrays:
    """A problem with an index of its obstacles, as the engines read it."""
    positions, turns = problem.start[:, : problem.dimension], not np.isnan(problem.goal_heading).all()
    arrays = ProblemArrays(
        model_codes=np.array([MODEL_CODES[name] for name in problem.team.models], np.int32),
        limits=problem.team.limits.copy(),
        radius=problem.team.radius,
        start=problem.start,
        goal=problem.goal,
        inverse_initial_distance=inverse_initial_distance(positions, problem.goal, problem.goal_radius),
        boxes=problem.world.shapes.boxes,
        triangles=problem.world.shapes.triangles,
        grid=grid,
        bounds=problem.world.bounds,
        time_step=np.array([problem.dt, problem.dt / 2, problem.dt / 3, problem.dt / 6], np.float32),
        margin=np.float32(problem.margin),
        squared_goal_radius=np.float32(problem.goal_radius * problem.goal_radius),
        squared_goal_speed=np.square(docking_speed(problem.goal_speed, problem.team.max_speed)),
        docks=np.bool_(problem.docks),
        collision_penalty=np.float32(problem.collision_penalty),
        turns_at_goals=np.bool_(True) if turns else None,
        goal_direction=_goal_directions(problem.goal_heading, problem.goal_hitches) if turns else None,
        squared_goal_chord=_squared_chords(problem.goal_heading, problem.goal_heading_tolerance) if turns else None,
        footprints=problem.team.footprint_arrays,
        wall_radius=problem.team.wall_radius,
    )
    return read_only(arrays)


def digest_of(problem: Problem) -> str:
    """SHA-256 over everything that defines a problem, the name left out."""
    sha = hashlib.sha256(repr(problem.team.models).encode())
    arrays = problem.arrays
    if arrays.model_codes.max() >= NUM_BUILT_IN:  # such codes depend on the order of registration
        sha.update(repr([model_digest(model) for model in problem.team.robot_models]).encode())
        arrays = arrays._replace(model_codes=np.minimum(arrays.model_codes, NUM_BUILT_IN))
    # As before robots had goal speeds of their own: stored results refer to problems by this.
    goal_speed = None if np.isinf(problem.goal_speed).all() else problem.goal_speed.tolist()
    if goal_speed is None:
        arrays = arrays._replace(squared_goal_speed=np.array(np.inf, np.float32))
    # As before models had limits that bound nothing.
    bounding = {
        column
        for model, limits in zip(problem.team.robot_models, arrays.limits, strict=True)
        for column, limit in enumerate(model.own_limits, OWN_LIMITS)
        if not limits[column] == limit.default == UNLIMITED
    }
    arrays = arrays._replace(limits=arrays.limits[:, [*range(OWN_LIMITS), *sorted(bounding)]])
    world = problem.world
    obstacles = (world.balls, world.cylinders, world.boxes, *world.polygons)
    for value in (*arrays[:6], *obstacles, *arrays[9:14]):
        array: np.ndarray = np.ascontiguousarray(value)
        sha.update(f"{array.shape}{array.dtype}".encode())
        sha.update(array.tobytes())
    if world.origin.any():
        sha.update(b"origin" + world.origin.tobytes())
    sha.update(f"{problem.dt!r} {problem.horizon} {problem.margin!r} {problem.goal_radius!r} {goal_speed!r}".encode())
    if not problem.docks:
        sha.update(problem.arrival.encode())
    if arrays.goal_direction is not None and arrays.squared_goal_chord is not None:
        columns = 2 if np.isnan(problem.goal_hitches).all() else None
        sha.update(arrays.goal_direction[:, :columns].tobytes() + arrays.squared_goal_chord.tobytes())
    if problem.team.shapes:
        sha.update(repr(problem.team.shapes).encode())
    if problem.team.lag.any():
        sha.update(b"lag" + problem.team.lag.tobytes())
    if problem.collision_penalty != 1:
        sha.update(f"collision_penalty {problem.collision_penalty!r}".encode())
    return sha.hexdigest()
