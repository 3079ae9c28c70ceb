"""Observations in JAX: :mod:`d4orm_env.core.observation` as pure array functions of one world."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from d4orm_env.core.arrays import FloatArray, Ints
from d4orm_env.core.observation_layout import ObservationLayout
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.dynamics import transition
from d4orm_env.dynamics.models import MODELS
from d4orm_env.jax.jax_motion import OPS, Worlds
from d4orm_env.jax.jax_rays import are_blocked, cast_rays

T = TypeVar("T")

Columns = list[Array]
"""Arrays ``(K,)``, one for each component."""
UNROLLED = 16
"""So many things are looked at without a loop."""


def observe_team(
    models: tuple[str, ...], arrays: ProblemArrays, world: Worlds, layout: ObservationLayout, time_left: Array
) -> Array:
    """``(K, D)`` what every robot sees of one world: ``(K, n)``, ``(K,)`` and ``(K, m)``.

    ``arrays.bounds`` is ``None`` where it has none; ``time_left`` is the share of the time left, 1 to 0.
    """
    position = [world.state[:, axis] for axis in range(layout.dimension)]
    velocity, angles = _motion(models, arrays, world, max(layout.goal_headings, 1))
    heading = angles[:2]
    columns: list[Array | FloatArray] = [
        *velocity,
        *heading,
        jnp.sqrt(_square(velocity)),
        *(arrays.goal[:, axis] - own for axis, own in enumerate(position)),
        jnp.full(len(models), time_left, jnp.float32),
        world.arrived.astype(jnp.float32),
        arrays.radius,
        arrays.limits[:, 0],
        arrays.limits[:, 1],
        *(_goal_headings(arrays, angles) if layout.goal_headings else ()),
        *_neighbors(arrays, position, velocity, layout),
        *_obstacles(arrays, position, layout.num_obstacles),
        *cast_rays(arrays, world.state, position, heading, layout),
    ]
    low, high = layout.low, layout.high
    return jnp.stack([jnp.clip(column, low[i], high[i]) for i, column in enumerate(columns)], axis=1)


def _motion(models: tuple[str, ...], arrays: ProblemArrays, world: Worlds, bodies: int) -> tuple[Columns, Columns]:
    """Velocities, and cosine and sine of the headings, zeros for models without one, and of hitch angles."""
    zero = jnp.zeros(len(models), jnp.float32)
    velocity, heading = [zero] * arrays.goal.shape[1], [zero, zero] * bodies
    for name in dict.fromkeys(models):
        model = MODELS[name]
        own = np.array(models) == name
        # Of all robots, so that no array is taken apart; what is none of these robots' is not taken.
        limits = tuple(arrays.limits[:, i] for i in range(len(model.limit_names)))
        x = tuple(world.state[:, i] for i in range(model.state_size))
        u = tuple(world.control[:, i] for i in range(model.control_size))
        at_rest = transition.absorbed(world.arrived, arrays.docks)
        for axis, component in enumerate(model.functions.velocity(x, u, limits, OPS)):
            velocity[axis] = jnp.where(own & ~at_rest, component, velocity[axis])
        if model.heading_index is not None:
            for body, i in enumerate((model.heading_index, *(hitch for hitch, _ in model.trailers))[:bodies]):
                for c, turn in enumerate((jnp.cos, jnp.sin), 2 * body):
                    heading[c] = jnp.where(own, turn(x[i]), heading[c])
    return velocity, heading


def _goal_headings(arrays: ProblemArrays, angles: Columns) -> Columns:
    """Cosine and sine of the goal headings and hitch angles less robots' own, zeros for robots without one."""
    directions, columns = jnp.asarray(arrays.goal_direction), []
    for c in range(0, len(angles), 2):
        (own_cosine, own_sine), (cosine, sine) = angles[c : c + 2], (directions[:, c], directions[:, c + 1])
        columns += [cosine * own_cosine + sine * own_sine, sine * own_cosine - cosine * own_sine]
    return columns


class _Nearest(NamedTuple):
    """The nearest things so far, in order; of those with equal keys the first comes first."""

    keys: tuple[Array, ...]  #: One ``(K,)`` for each, infinite where there is nothing
    rows: tuple[tuple[Array, ...], ...]  #: Columns of each

    @classmethod
    def nothing(cls, num_robots: int, count: int, width: int) -> _Nearest:
        far, zero = jnp.full(num_robots, jnp.inf, jnp.float32), jnp.zeros(num_robots, jnp.float32)
        return cls((far,) * count, ((zero,) * width,) * count)

    def with_another(self, key: Array, columns: Sequence[Array]) -> _Nearest:
        """One more where it belongs; the last drops out for it."""
        keys, rows = [], []
        for other, row in zip(self.keys, self.rows):
            before = key < other
            keys.append(jnp.where(before, key, other))
            rows.append(tuple(jnp.where(before, new, old) for new, old in zip(columns, row)))
            key = jnp.where(before, other, key)
            columns = [jnp.where(before, old, new) for new, old in zip(columns, row)]
        return _Nearest(tuple(keys), tuple(rows))

    def with_all(self, look: Callable[[T], tuple[Array, Columns]], things: T) -> _Nearest:
        """Add all ``things``, arrays whose first axis they are on; ``look`` gives key and columns of one."""
        scan = partial(jax.lax.scan, unroll=UNROLLED)
        return scan(lambda nearest, thing: (nearest.with_another(*look(thing)), None), self, things)[0]

    def columns(self) -> Columns:
        """Presence and columns of each, zeros for those that are not there."""
        presence = [jnp.isfinite(key).astype(jnp.float32) for key in self.keys]
        return [column for present, row in zip(presence, self.rows) for column in (present, *row)]


def _neighbors(arrays: ProblemArrays, position: Columns, velocity: Columns, layout: ObservationLayout) -> Columns:
    """``2 d + 2`` for each."""
    robots = np.arange(len(arrays.radius), dtype=np.int32)

    def look(other: tuple[Ints, Columns, Array | FloatArray]) -> tuple[Array, Columns]:
        number, motion, radius = other
        relative = [theirs - own for theirs, own in zip(motion, (*position, *velocity))]
        gap2 = _square(relative[: len(position)])
        hidden = (robots == number) | (gap2 > np.float32(layout.communication_range**2))
        if layout.line_of_sight:
            hidden |= are_blocked(arrays, position, relative[:2])
        key = jnp.where(hidden, jnp.inf, gap2)
        return key, [*relative, jnp.broadcast_to(radius, key.shape)]

    nearest = _Nearest.nothing(len(robots), layout.num_neighbors, 2 * len(position) + 1)
    return nearest.with_all(look, (robots, [*position, *velocity], arrays.radius)).columns()


def _obstacles(arrays: ProblemArrays, position: Columns, count: int) -> Columns:
    """``d + 2`` for each."""

    def seen(distance: Array, vector: Columns) -> tuple[Array, Columns]:
        return distance, [*vector, distance - arrays.wall_radius]

    nearest = _Nearest.nothing(len(arrays.radius), count, len(position) + 1)
    for to_one, things in ((_to_box, arrays.boxes), (_to_triangle, arrays.triangles)):
        if len(things):
            nearest = nearest.with_all(lambda one, to_one=to_one: seen(*to_one(one, position)), things)  # type: ignore[misc]
    for distance, vector in [] if arrays.bounds is None else _to_walls(arrays.bounds, position):
        nearest = nearest.with_another(*seen(distance, vector))
    return nearest.columns()


def _square(vector: Columns) -> Array:
    return sum((component * component for component in vector), jnp.float32(0))


def _to_box(box: Array, position: Columns) -> tuple[Array, Columns]:
    """Distance of a rounded box, and the vector to its nearest point."""
    d = len(position)
    offset = [jnp.clip(own, box[axis], box[d + axis]) - own for axis, own in enumerate(position)]
    distance, radius = jnp.sqrt(_square(offset)), box[2 * d]
    # Inside a box, whose radius is zero, the vector is too.
    share = jnp.where(radius > 0, (distance - radius) / jnp.maximum(distance, 1e-6), 1)
    return distance - radius, [component * share for component in offset]


def _to_triangle(corners: Array, position: Columns) -> tuple[Array, Columns]:
    """The same of a triangle."""
    inside: Array | bool = True
    nearest: Columns = []
    for edge in range(3):
        corner, end = corners[2 * edge : 2 * edge + 2], corners[2 * ((edge + 1) % 3) :][:2]
        along, offset = end - corner, [own - corner[axis] for axis, own in enumerate(position[:2])]
        inside &= along[0] * offset[1] - along[1] * offset[0] >= 0
        share = (offset[0] * along[0] + offset[1] * along[1]) / (along * along).sum()
        gap = [jnp.clip(share, 0, 1) * along[axis] - offset[axis] for axis in range(2)]
        closer = _square(gap) < _square(nearest) if nearest else True
        nearest = [jnp.where(closer, new, old) for new, old in zip(gap, nearest or gap)]
    vector = [jnp.where(inside, 0, component) for component in nearest]
    return jnp.sqrt(_square(vector)), vector


def _to_walls(bounds: Array | FloatArray, position: Columns) -> list[tuple[Array, Columns]]:
    """The same of the bounds: each axis' lower and upper one."""
    walls = []
    for axis, own in enumerate(position):
        for side, sign in enumerate((-1, 1)):
            beyond = bounds[side, axis] - own
            walls.append((sign * beyond, [beyond if i == axis else jnp.zeros_like(own) for i in range(len(position))]))
    return walls
