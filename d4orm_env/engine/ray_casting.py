"""Kernel of range sensors: distances along the rays of every robot of many worlds.

Whatever is in range is intersected with all rays of a robot at once, in loops without branches, which vectorise.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from d4orm_env.core.arrays import FloatArray, IntArray
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.dynamics.models import MODELS, names_of_codes
from d4orm_env.engine import elementary
from d4orm_env.engine.caching import cached_kernel
from d4orm_env.engine.compiling import ONE, OPTIONS, ZERO, compiled, inlined
from d4orm_env.engine.simd import TILE, use_wide_registers

_FAR = np.float32(1e15)
"""Farther than anything."""
_PARALLEL = np.float32(1e-15)
"""Component of a direction in place of zero, so that dividing by it gives a number."""


class Surroundings(NamedTuple):
    """Parts of a planar problem that rays meet, and the sensor.

    Attributes:
        radius: ``(K,)`` of the robots [m].
        heading_index: ``(K,)`` components of the states that are headings, -1 for a robot without one.
        boxes: See :class:`~d4orm_env.core.problem_arrays.ProblemArrays`; in the plane a round one is a disc.
        triangles: Likewise.
        bounds: ``(2, 2)``.
        directions: ``(R, 2)`` unit vectors of the rays in the robots' frames.
        range: ``()`` of the sensor [m].
    """

    radius: FloatArray
    heading_index: IntArray
    boxes: FloatArray
    triangles: FloatArray
    bounds: FloatArray
    directions: FloatArray
    range: np.float32

    @classmethod
    def of(cls, arrays: ProblemArrays, directions: FloatArray, reach: float) -> Surroundings:
        """The surroundings of a problem's robots that have these rays of so many metres."""
        heading = _heading_indices(arrays.model_codes.tobytes())
        return cls(arrays.radius, heading, arrays.boxes, arrays.triangles, arrays.bounds, directions, np.float32(reach))


@lru_cache(maxsize=256)
def _heading_indices(codes: bytes) -> IntArray:
    indices = [MODELS[name].heading_index for name in names_of_codes(np.frombuffer(codes, np.int32))]
    return np.array([-1 if index is None else index for index in indices])


@compiled
def _meet_disc(x: np.float32, y: np.float32, radius: np.float32, fan: FloatArray, row: FloatArray) -> None:
    """Shorten rays by a disc at a relative position; ``fan`` ``(4, R)`` has their directions, and one over these."""
    use_wide_registers()
    for i in range(row.shape[0]):
        along, across = x * fan[0, i] + y * fan[1, i], x * fan[1, i] - y * fan[0, i]
        rest = radius * radius - across * across
        half = np.sqrt(rest if rest > ZERO else ZERO)
        distance = along - half
        distance = distance if distance > ZERO else ZERO
        distance = distance if (rest >= ZERO) & (along + half >= ZERO) else _FAR
        row[i] = distance if distance < row[i] else row[i]


@compiled
def _meet_box(
    low_x: np.float32, low_y: np.float32, high_x: np.float32, high_y: np.float32, fan: FloatArray, row: FloatArray
) -> None:
    """Shorten rays by a box between two relative corners."""
    use_wide_registers()
    for i in range(row.shape[0]):
        one_x, other_x, one_y, other_y = low_x * fan[2, i], high_x * fan[2, i], low_y * fan[3, i], high_y * fan[3, i]
        enter_x, leave_x = (one_x, other_x) if one_x < other_x else (other_x, one_x)
        enter_y, leave_y = (one_y, other_y) if one_y < other_y else (other_y, one_y)
        enter, leave = enter_x if enter_x > enter_y else enter_y, leave_x if leave_x < leave_y else leave_y
        enter = enter if enter > ZERO else ZERO
        distance = enter if leave >= enter else _FAR
        row[i] = distance if distance < row[i] else row[i]


@inlined
def _cut(enter: np.float32, leave: np.float32, inside: np.float32, growth: np.float32) -> tuple[np.float32, np.float32]:
    """Cut a ray to the inner side of a line: ``inside`` at its beginning is positive there, and grows so fast."""
    parallel = (growth < _PARALLEL) & (growth > -_PARALLEL)
    cut = -inside / (ONE if parallel else growth)
    later, sooner = (growth > ZERO) & (cut > enter) & ~parallel, (growth < ZERO) & (cut < leave) & ~parallel
    outside = parallel & (inside < ZERO)
    return cut if later else enter, -ONE if outside else cut if sooner else leave


@compiled
def _meet_triangle(x: np.float32, y: np.float32, c: FloatArray, fan: FloatArray, row: FloatArray) -> None:
    """Shorten rays from ``(x, y)`` by a triangle of three corners counter-clockwise, ``c`` ``(6,)``."""
    use_wide_registers()
    x0, y0, x1, y1, x2, y2 = c[2] - c[0], c[3] - c[1], c[4] - c[2], c[5] - c[3], c[0] - c[4], c[1] - c[5]
    inside0, inside1, inside2 = (
        x0 * (y - c[1]) - y0 * (x - c[0]),
        x1 * (y - c[3]) - y1 * (x - c[2]),
        x2 * (y - c[5]) - y2 * (x - c[4]),
    )
    for i in range(row.shape[0]):
        ray_x, ray_y = fan[0, i], fan[1, i]
        enter, leave = _cut(ZERO, _FAR, inside0, x0 * ray_y - y0 * ray_x)
        enter, leave = _cut(enter, leave, inside1, x1 * ray_y - y1 * ray_x)
        enter, leave = _cut(enter, leave, inside2, x2 * ray_y - y2 * ray_x)
        distance = enter if leave >= enter else _FAR
        row[i] = distance if distance < row[i] else row[i]


@compiled
def _meet_bounds(x: np.float32, y: np.float32, bounds: FloatArray, fan: FloatArray, row: FloatArray) -> None:
    use_wide_registers()
    low_x, low_y, high_x, high_y = bounds[0, 0] - x, bounds[0, 1] - y, bounds[1, 0] - x, bounds[1, 1] - y
    for i in range(row.shape[0]):
        leave_x = (high_x if fan[2, i] > ZERO else low_x) * fan[2, i]
        leave_y = (high_y if fan[3, i] > ZERO else low_y) * fan[3, i]
        distance = leave_x if leave_x < leave_y else leave_y
        distance = distance if distance > ZERO else ZERO
        row[i] = distance if distance < row[i] else row[i]


@compiled
def _invert(fan: FloatArray) -> None:
    """Fill one over the components of the directions."""
    for i in range(fan.shape[1]):
        for axis in range(2):
            component = fan[axis, i]
            parallel = (component < _PARALLEL) & (component > -_PARALLEL)
            fan[2 + axis, i] = ONE / (_PARALLEL if parallel else component)


@compiled
def _aim(directions: FloatArray, heading: np.float32, fan: FloatArray) -> None:
    """Turn the rays by a heading, and take one over their components."""
    cosine, sine = elementary.cosine(heading), elementary.sine(heading)
    for i in range(directions.shape[0]):
        fan[0, i] = cosine * directions[i, 0] - sine * directions[i, 1]
        fan[1, i] = sine * directions[i, 0] + cosine * directions[i, 1]
    _invert(fan)


@inlined
def _meet_round(
    x: np.float32, y: np.float32, radius: np.float32, reach: np.float32, fan: FloatArray, row: FloatArray
) -> None:
    """Shorten rays by a disc, if that is in range."""
    if x * x + y * y <= (reach + radius) * (reach + radius):
        _meet_disc(x, y, radius, fan, row)


@compiled
def _meet_obstacles(
    x: np.float32,
    y: np.float32,
    boxes: FloatArray,
    triangles: FloatArray,
    reach: np.float32,
    fan: FloatArray,
    row: FloatArray,
) -> None:
    for j in range(boxes.shape[0]):
        low_x, low_y, high_x, high_y = boxes[j, 0] - x, boxes[j, 1] - y, boxes[j, 2] - x, boxes[j, 3] - y
        if boxes[j, 4] > ZERO:
            _meet_round(low_x, low_y, boxes[j, 4], reach, fan, row)
            continue
        gap_x, gap_y = max(low_x, -high_x, ZERO), max(low_y, -high_y, ZERO)
        if gap_x * gap_x + gap_y * gap_y <= reach * reach:
            _meet_box(low_x, low_y, high_x, high_y, fan, row)
    for j in range(triangles.shape[0]):
        c = triangles[j]
        gap_x = max(min(c[0], c[2], c[4]) - x, x - max(c[0], c[2], c[4]), ZERO)
        gap_y = max(min(c[1], c[3], c[5]) - y, y - max(c[1], c[3], c[5]), ZERO)
        if gap_x * gap_x + gap_y * gap_y <= reach * reach:
            _meet_triangle(x, y, c, fan, row)


@compiled
def is_blocked(
    place: FloatArray, other: FloatArray, boxes: FloatArray, triangles: FloatArray, scratch: FloatArray
) -> bool:
    """Check whether an obstacle lies between two positions; ``scratch`` ``(5, 1)`` is overwritten."""
    fan, row = scratch[:4], scratch[4]
    x, y = other[0] - place[0], other[1] - place[1]
    distance = np.sqrt(x * x + y * y)
    fan[0, 0], fan[1, 0], row[0] = x / distance, y / distance, distance
    _invert(fan)
    _meet_obstacles(place[0], place[1], boxes, triangles, distance, fan, row)
    return row[0] < distance


@cached_kernel(**OPTIONS)
def cast_rays(
    s: Surroundings, state: FloatArray, bodies: FloatArray, first: int, part: IntArray, out: FloatArray
) -> None:
    """Fill ``R`` components from ``first`` on of observations with distances along the rays [m].

    Args:
        s: What rays meet.
        state: ``(B, K, n)``.
        bodies: ``(B, N, 5)`` position, velocity and radius of what moves among the robots and is none.
        first: Component of the first ray.
        part: First tile of worlds and the one after the last.
        out: ``(B, K, D)`` observations, output.
    """
    num_rays = s.directions.shape[0]
    fan, row = np.empty((4, num_rays), np.float32), np.empty(num_rays, np.float32)
    bounded = np.isfinite(s.bounds[0, 0])
    aimed = ZERO
    _aim(s.directions, aimed, fan)
    for b in range(part[0] * TILE, min(part[1] * TILE, state.shape[0])):
        for k in range(state.shape[1]):
            x, y = state[b, k, 0], state[b, k, 1]
            for i in range(num_rays):
                row[i] = s.range
            heading = state[b, k, s.heading_index[k]] if s.heading_index[k] >= 0 else ZERO
            if heading != aimed:
                _aim(s.directions, heading, fan)
                aimed = heading
            if bounded:
                _meet_bounds(x, y, s.bounds, fan, row)
            for j in range(state.shape[1]):
                if j != k:
                    _meet_round(state[b, j, 0] - x, state[b, j, 1] - y, s.radius[j], s.range, fan, row)
            for j in range(bodies.shape[1]):
                if bodies[b, j, 4] > ZERO:
                    _meet_round(bodies[b, j, 0] - x, bodies[b, j, 1] - y, bodies[b, j, 4], s.range, fan, row)
            _meet_obstacles(x, y, s.boxes, s.triangles, s.range, fan, row)
            for i in range(num_rays):
                out[b, k, first + i] = row[i]
