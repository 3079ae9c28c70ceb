"""Exact contacts of footprints in JAX, as :mod:`d4orm_env.engine.footprint_contacts` finds them.

Robots' axes come first, samples last; the corners or axes of a core, or x, y and z, are one more axis in front.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.bodies import FootprintArrays
from d4orm_env.core.goal_poses import MOST_TRAILERS
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.engine.convex_cores import BISECTIONS

Given: TypeAlias = Array | FloatArray | np.float32
"""Numbers of the problem: inside a compiled function they are traced."""


class MovingBodies(NamedTuple):
    """Bodies that are not simulated, at one time."""

    positions: Array | FloatArray  #: ``(O, d)``
    headings: Array | FloatArray | None  #: ``(F,)`` of the bodies and their trailers, or ``None`` where all are discs
    radius: Array | FloatArray  #: ``(O,)`` outer radii
    footprints: FootprintArrays | None  #: Theirs; ``None`` where all are discs


class PlacedBodies(NamedTuple):
    """Placed bodies: ``R`` robots in ``S`` samples, or one."""

    position: Array  #: ``(d, R, S)`` reference points
    corners: Array  #: ``(2, n, R, S)`` of the cores, relative to them; ``None`` in space
    axes: Array  #: ``(2, m, R, S)``; zeros for none
    extents: Array  #: ``(m, R, S)`` how far the cores reach along them
    rounding: Array  #: ``(R, 1)``
    semi_axes: Array  #: ``(3, R, 1)`` of ellipsoids
    wall_axes: Array  #: ``(3, R, 1)`` of what obstacles and bounds meet of them


def place_robots(f: FootprintArrays | None, state: Array, dimension: int, radius: Given | None = None) -> PlacedBodies:
    """Bodies of robots in ``state`` ``(K, n, S)``; discs of this ``radius`` ``(K,)`` if there are no footprints."""
    position = jnp.moveaxis(state[:, :dimension], 1, 0)
    if f is None:
        return _discs(position, jnp.asarray(radius))
    robot, column = jnp.asarray(f.robot), jnp.asarray(f.heading)
    turn = jnp.where(column[:, None] >= 0, state[robot, jnp.maximum(column, 0)], 0)
    if len(column) == len(state):
        return _bodies(f, position, turn)
    heading = _lagging(f, turn)
    return _bodies(f, position[:, robot] + _hitched(f, heading), heading)


def _lagging(f: FootprintArrays, turn: Array) -> Array:
    """``(F, S)`` headings of bodies from those of the robots and the hitch angles of the trailers."""
    before, heading = jnp.asarray(f.before), turn
    follows = (before != jnp.arange(len(before)))[:, None]
    for _ in range(MOST_TRAILERS):
        heading = jnp.where(follows, heading[before] - turn, turn)
    return heading


def _hitched(f: FootprintArrays, heading: Array) -> Array:
    """``(2, F, S)`` reference points of bodies relative to those of their robots."""
    before, hitch = jnp.asarray(f.before), jnp.asarray(f.hitch)[None, :, None]
    own = -hitch * jnp.stack([jnp.cos(heading), jnp.sin(heading)])
    offset = own
    for _ in range(MOST_TRAILERS):
        offset = jnp.where(hitch > 0, offset[:, before] + own, 0)
    return offset


def of_robots(f: FootprintArrays | None, touch: Array, count: int) -> Array:
    """``(K, ...)`` whether one of a robot's bodies touches, of flags ``(F, ...)``."""
    if f is None or len(touch) == count:
        return touch
    robots = jnp.zeros((count, *touch.shape[1:]), bool)
    return robots.at[jnp.asarray(f.robot)].max(touch)


def bodies_of(f: FootprintArrays | None, robot: Array, num_robots: int) -> Array:
    """Numbers of a robot's bodies, the first of them again where others may have more."""
    if f is None or len(f.robot) == num_robots:
        return robot[None]
    owner = jnp.asarray(f.robot)
    rows = jnp.argsort(owner != robot, stable=True)[: 1 + MOST_TRAILERS]
    return jnp.where(owner[rows] == robot, rows, robot)


def place_bodies(bodies: MovingBodies) -> PlacedBodies:
    """Other bodies, the same in all samples."""
    position = jnp.asarray(bodies.positions).T[..., None]
    if bodies.footprints is None or bodies.headings is None:
        return _discs(position, jnp.asarray(bodies.radius))
    f, heading = bodies.footprints, jnp.asarray(bodies.headings)[:, None]
    if len(f.robot) > len(bodies.positions):
        position = position[:, jnp.asarray(f.robot)] + _hitched(f, heading)
    return _bodies(f, position, heading)


def _discs(position: Array, radius: Array) -> PlacedBodies:
    size = radius[:, None]
    nothing = jnp.zeros((2, 1, *size.shape), jnp.float32)
    axes = jnp.broadcast_to(size, (3, *size.shape))
    return PlacedBodies(position, nothing, nothing, nothing[0], size, axes, axes)


def _bodies(f: FootprintArrays, position: Array, heading: Array) -> PlacedBodies:
    turns = jnp.asarray(f.heading)[:, None] >= 0
    cosine, sine = jnp.where(turns, jnp.cos(heading), 1), jnp.where(turns, jnp.sin(heading), 0)

    def turned(vectors: Given) -> Array:
        x, y = jnp.moveaxis(jnp.asarray(vectors), (2, 1), (0, 1))[..., None]
        return jnp.stack([cosine[None] * x - sine[None] * y, sine[None] * x + cosine[None] * y])

    extents = jnp.asarray(f.extents).T[..., None]
    rounding, axes = (
        jnp.asarray(f.rounding)[:, None],
        (jnp.asarray(own).T[..., None] for own in (f.semi_axes, f.wall_axes)),
    )
    return PlacedBodies(position, turned(f.corners), turned(f.axes), extents, rounding, *axes)


def pairs_within(bodies: PlacedBodies, others: PlacedBodies, extra: Given) -> Array:
    """``(R, O, S)`` whether bodies are within ``extra`` of others."""
    a = PlacedBodies(*(jnp.expand_dims(part, part.ndim - 1) for part in bodies))
    b = PlacedBodies(*(jnp.expand_dims(part, part.ndim - 2) for part in others))
    offset, extra = b.position - a.position, jnp.asarray(extra)
    if len(offset) == 3:
        return _balls_within(offset, a.semi_axes + extra / 2, b.semi_axes + extra / 2)
    return _cores_within(a, b, offset, extra)


def _cores_within(a: PlacedBodies, b: PlacedBodies, offset: Array, extra: Array) -> Array:
    """Check whether widened cores, those of ``b`` offset by ``(2, ...)``, are within ``extra`` of each other."""
    total = a.rounding + b.rounding + extra
    corners = b.corners + offset[:, None]
    apart = jnp.maximum(
        _separation(a.axes, a.extents, corners), _separation(b.axes, b.extents, a.corners - offset[:, None])
    )
    near = _corner_near_edge(a.corners, corners, total) | _corner_near_edge(corners, a.corners, total)
    return (apart <= total) & (((apart <= 0) & (apart > -jnp.inf)) | near)


def _separation(axes: Array, extents: Array, corners: Array) -> Array:
    """The widest gap between a core and the corners along the core's axes."""
    widest = jnp.full((), -jnp.inf, jnp.float32)
    for i in range(axes.shape[1]):
        least = (axes[0, None, i] * corners[0] + axes[1, None, i] * corners[1]).min(axis=0)
        is_axis = axes[0, i] ** 2 + axes[1, i] ** 2 > 0
        widest = jnp.where(is_axis, jnp.maximum(widest, least - extents[i]), widest)
    return widest


def _corner_near_edge(corners: Array, others: Array, distance: Array) -> Array:
    """Check whether one of the first corners is within ``distance`` of an edge between the others."""
    near = jnp.zeros((), bool)
    for j in range(others.shape[1]):
        begin, along = others[:, j], others[:, (j + 1) % others.shape[1]] - others[:, j]
        square, offset = (along * along).sum(axis=0), corners - begin[:, None]
        share = (
            jnp.clip((offset * along[:, None]).sum(axis=0), 0, square[None]) / jnp.where(square > 0, square, 1)[None]
        )
        gap = offset - share[None] * along[:, None]
        near = near | ((gap * gap).sum(axis=0) <= (distance * distance)[None]).any(axis=0)
    return near


def _balls_within(offset: Array, a: Array, b: Array) -> Array:
    """Check whether ellipsoids with these semi-axes touch (Perram and Wertheim, 1985)."""
    square, a2, b2 = offset * offset, a * a, b * b

    def halve(_: Array, carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        low, high, most = carry
        middle = (low + high) / 2
        s = middle[None]
        mixed = (1 - s) * a2 + s * b2
        value = (s * (1 - s) * square / mixed).sum(axis=0)
        rising = (square * ((1 - s) ** 2 * a2 - s * s * b2) / (mixed * mixed)).sum(axis=0) > 0
        return jnp.where(rising, middle, low), jnp.where(rising, high, middle), jnp.maximum(most, value)

    zero = jnp.zeros(jnp.broadcast_shapes(offset.shape[1:], a.shape[1:], b.shape[1:]), jnp.float32)
    return jax.lax.fori_loop(0, BISECTIONS, halve, (zero, zero + 1, zero))[2] <= 1


def static_contacts(arrays: ProblemArrays, state: Array, extra: Given) -> Array:
    """``(K, S)`` whether robots in ``state`` ``(K, n, S)`` come within ``extra`` of an obstacle or a bound."""
    dimension, extra = arrays.goal.shape[1], jnp.asarray(extra)
    bodies = place_robots(arrays.footprints, state, dimension)
    if dimension == 3:
        low, high = bodies.wall_axes, bodies.wall_axes
    else:
        rounding = bodies.rounding[None]
        low, high = rounding - bodies.corners.min(axis=1), rounding + bodies.corners.max(axis=1)
    lower, upper = (bound[:, None, None] for bound in jnp.asarray(arrays.bounds))
    hit = ((bodies.position - (low + extra) <= lower) | (bodies.position + (high + extra) >= upper)).any(axis=0)
    boxes, triangles = jnp.asarray(arrays.boxes), jnp.asarray(arrays.triangles).reshape(-1, 3, 2)

    def meet_triangle(i: Array, hit: Array) -> Array:
        return hit | _cores_within(bodies, _polygon(triangles[i].T, jnp.float32(0)), -bodies.position, extra)

    if len(boxes):
        hit = jax.lax.fori_loop(0, len(boxes), lambda i, hit: hit | _meets_box(bodies, boxes[i], extra), hit)
    if len(triangles):
        hit = jax.lax.fori_loop(0, len(triangles), meet_triangle, hit)
    return of_robots(arrays.footprints, hit, len(state))


def _meets_box(bodies: PlacedBodies, box: Array, extra: Array) -> Array:
    """``(R, S)`` whether bodies are within ``extra`` of a rounded box."""
    dimension = len(bodies.position)
    lower, upper, rounding = box[:dimension], box[dimension:-1], box[-1]
    if dimension == 2:
        corners = jnp.stack([lower, jnp.stack([upper[0], lower[1]]), upper, jnp.stack([lower[0], upper[1]])], axis=1)
        return _cores_within(bodies, _polygon(corners, rounding), -bodies.position, extra)
    gap = jnp.clip(bodies.position, lower[:, None, None], upper[:, None, None]) - bodies.position
    axes = bodies.wall_axes + extra
    sharp = ((gap / axes) ** 2).sum(axis=0) <= 1
    ball = jnp.where(rounding > 0, rounding, 1)
    return jnp.where(rounding > 0, _balls_within(gap, axes, jnp.broadcast_to(ball, (3, 1, 1))), sharp)


def _polygon(corners: Array, rounding: Array) -> PlacedBodies:
    """A polygon of these corners ``(2, n)``, counterclockwise, in all samples; of no size it is a point."""
    edges = jnp.roll(corners, -1, axis=1) - corners
    length = jnp.sqrt((edges * edges).sum(axis=0))
    axes = jnp.stack([edges[1], -edges[0]]) / jnp.where(length > 0, length, 1)[None]
    extents = (axes[:, :, None] * corners[:, None]).sum(axis=0).max(axis=1)
    parts = corners[..., None, None], axes[..., None, None], extents[:, None, None]
    nowhere = jnp.zeros((2, 1, 1), jnp.float32)
    return PlacedBodies(nowhere, *parts, jnp.full((1, 1), rounding, jnp.float32), nowhere, nowhere)
