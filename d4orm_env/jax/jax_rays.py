"""Range sensors in JAX: :mod:`d4orm_env.engine.ray_casting` as pure array functions of one world."""

from __future__ import annotations

from typing import TypeAlias

import jax
import jax.numpy as jnp
from jax import Array

from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.bodies import FootprintArrays
from d4orm_env.core.observation_layout import ObservationLayout
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.jax.jax_footprints import PlacedBodies, place_robots

OtherBodies: TypeAlias = tuple[Array, Array, Array, PlacedBodies | None]
"""Bodies of all robots, seen from one of them: ``(F,)`` reference points x and y, and radii of discs, -1 of its own
bodies; and footprints, as ``(.., F)``, ``None`` of a team of discs."""


def cast_rays(
    arrays: ProblemArrays, state: Array, position: list[Array], heading: list[Array], layout: ObservationLayout
) -> list[Array]:
    """``R`` columns ``(K,)``: how far each ray of every robot reaches [m].

    Positions are two columns ``(K,)``, and headings cosines and sines, both zero for robots without.
    ``arrays.bounds`` is ``None`` where the world has none.
    """
    if not layout.num_rays:
        return []
    fan, (x, y), (cosine, sine) = layout.ray_directions, position, heading
    robots, f = jnp.arange(len(x)), arrays.footprints
    bodies, owner, cores = position, robots, None
    radius: Array | FloatArray = arrays.radius
    if f is not None:
        cores = jax.tree.map(lambda part: part[..., 0], place_robots(f, state[..., None], 2))
        bodies, radius, owner = [*cores.position], cores.rounding, jnp.asarray(f.robot)
    cosine = jnp.where((cosine == 0) & (sine == 0), 1, cosine)

    def of_robot(robot: Array, x: Array, y: Array, cosine: Array, sine: Array) -> Array:
        own = owner == robot
        others = bodies[0] - x, bodies[1] - y, jnp.where(own, -1, radius), cores
        aim = cosine * fan[:, 0] - sine * fan[:, 1], sine * fan[:, 0] + cosine * fan[:, 1]
        distances = jax.vmap(lambda ray_x, ray_y: _nearest(arrays, others, x, y, ray_x, ray_y))(*aim)
        return jnp.minimum(distances, layout.ray_range)

    distances = jax.vmap(of_robot)(robots, x, y, cosine, sine)
    return [distances[:, i] for i in range(layout.num_rays)]


def _nearest(arrays: ProblemArrays, others: OtherBodies, x: Array, y: Array, ray_x: Array, ray_y: Array) -> Array:
    """Distance from ``(x, y)`` along a ray to whatever comes first; the other robots' positions are relative."""
    found = [_to_others(arrays.footprints, others, ray_x, ray_y), *_to_obstacles(arrays, x, y, ray_x, ray_y)]
    if arrays.bounds is not None:
        (low_x, low_y), (high_x, high_y) = arrays.bounds
        leave = jnp.minimum(_through(low_x - x, high_x - x, ray_x)[1], _through(low_y - y, high_y - y, ray_y)[1])
        found.append(jnp.maximum(leave, 0)[None])
    return jnp.concatenate(found).min()


def are_blocked(arrays: ProblemArrays, position: list[Array], gap: list[Array]) -> Array:
    """``(K,)`` bool: an obstacle lies between positions and what is this vector away from them, columns ``(K,)``."""
    distance = jnp.sqrt(gap[0] * gap[0] + gap[1] * gap[1])
    length = jnp.where(distance > 0, distance, 1)

    def to_obstacle(x: Array, y: Array, ray_x: Array, ray_y: Array) -> Array:
        return jnp.concatenate([jnp.full(1, jnp.inf), *_to_obstacles(arrays, x, y, ray_x, ray_y)]).min()

    return jax.vmap(to_obstacle)(position[0], position[1], gap[0] / length, gap[1] / length) < distance


def _to_others(f: FootprintArrays | None, others: OtherBodies, ray_x: Array, ray_y: Array) -> Array:
    """``(F,)`` distances to bodies: to discs about the corners of a core that is widened, and to the core."""
    x, y, radius, cores = others
    if f is None or cores is None:
        return _to_discs(x, y, radius, ray_x, ray_y)
    corners, widened = cores.corners, jnp.where(radius > 0, radius, -1)
    found = [_to_discs(x + corners[0, j], y + corners[1, j], widened, ray_x, ray_y) for j in range(2)]
    enter, leave = jnp.zeros(len(x)), jnp.full(len(x), jnp.inf)
    for j in range(cores.axes.shape[1]):
        along_x, along_y = cores.axes[:, j]
        # Beyond the sides of a segment, not beyond its ends; zeros are no axes.
        extent = cores.extents[j] + jnp.where(j < jnp.asarray(f.num_corners), cores.rounding, 0)
        inside, growth = extent + (along_x * x + along_y * y), -(along_x * ray_x + along_y * ray_y)
        enter, leave = _cut(enter, leave, inside, growth)
    solid = (jnp.asarray(f.num_axes) > 0) & (radius >= 0)
    return jnp.minimum(jnp.minimum(*found), jnp.where(solid & (leave >= enter), enter, jnp.inf))


def _cut(enter: Array, leave: Array, inside: Array | FloatArray, growth: Array | FloatArray) -> tuple[Array, Array]:
    """Cut rays to the inner side of lines: ``inside`` at their beginning is positive there, and grows so fast."""
    cut = -inside / jnp.where(growth == 0, 1, growth)
    outside = (growth == 0) & (inside < 0)
    enter = jnp.maximum(enter, jnp.where(growth > 0, cut, 0))
    return enter, jnp.minimum(leave, jnp.where(growth < 0, cut, jnp.where(outside, -jnp.inf, jnp.inf)))


def _to_obstacles(arrays: ProblemArrays, x: Array, y: Array, ray_x: Array, ray_y: Array) -> list[Array]:
    """Distances from ``(x, y)`` along a ray to all obstacles."""
    found = []
    if len(arrays.boxes):
        low_x, low_y, high_x, high_y, radius = arrays.boxes.T
        discs = _to_discs(low_x - x, low_y - y, radius, ray_x, ray_y)
        (enter_x, leave_x), (enter_y, leave_y) = (
            _through(low_x - x, high_x - x, ray_x),
            _through(low_y - y, high_y - y, ray_y),
        )
        enter, leave = jnp.maximum(jnp.maximum(enter_x, enter_y), 0), jnp.minimum(leave_x, leave_y)
        found.append(jnp.where(radius > 0, discs, jnp.where(leave < enter, jnp.inf, enter)))
    if len(arrays.triangles):
        found.append(_to_triangles(arrays.triangles, x, y, ray_x, ray_y))
    return found


def _to_discs(x: Array, y: Array, radius: Array | FloatArray, ray_x: Array, ray_y: Array) -> Array:
    """``(N,)`` distances to discs; infinite for a negative radius."""
    along, across = x * ray_x + y * ray_y, x * ray_y - y * ray_x
    rest = radius * radius - across * across
    # The square root of zero has no slope, so that what is not needed has another argument.
    half = jnp.where(rest > 0, jnp.sqrt(jnp.where(rest > 0, rest, 1)), 0)
    missed = (rest < 0) | (along + half < 0) | (radius < 0)
    return jnp.where(missed, jnp.inf, jnp.maximum(along - half, 0))


def _to_triangles(triangles: Array | FloatArray, x: Array, y: Array, ray_x: Array, ray_y: Array) -> Array:
    """``(N,)`` distances to triangles ``(N, 6)``."""
    enter, leave = jnp.zeros(len(triangles)), jnp.full(len(triangles), jnp.inf)
    for edge in range(3):
        corner_x, corner_y, end_x, end_y = (triangles[:, (2 * edge + i) % 6] for i in range(4))
        along_x, along_y = end_x - corner_x, end_y - corner_y
        inside = along_x * (y - corner_y) - along_y * (x - corner_x)
        growth = along_x * ray_y - along_y * ray_x
        enter, leave = _cut(enter, leave, inside, growth)
    return jnp.where(leave < enter, jnp.inf, enter)


def _through(low: Array, high: Array, ray: Array) -> tuple[Array, Array]:
    """Distances at which a ray enters and leaves the strip between parallel lines; negative behind its beginning."""
    still, inside = ray == 0, (low <= 0) & (high >= 0)
    a, b = low / jnp.where(still, 1, ray), high / jnp.where(still, 1, ray)
    enter = jnp.where(still, jnp.where(inside, -jnp.inf, jnp.inf), jnp.minimum(a, b))
    return enter, jnp.where(still, jnp.where(inside, jnp.inf, -jnp.inf), jnp.maximum(a, b))
