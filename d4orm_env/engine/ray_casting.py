"""Kernel of range sensors: distances along the rays of every robot of many worlds.

Rays are asked whether they meet a thing only where they may meet the disc round it. Which these are is found for all
things at once, in a loop without branches, which vectorises.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from d4orm_env.core.arrays import FloatArray, IntArray, Ints, Whole
from d4orm_env.core.bodies import FootprintArrays
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.dynamics.models import MODELS, names_of_codes
from d4orm_env.engine import elementary
from d4orm_env.engine.borrowing import borrow
from d4orm_env.engine.caching import cached_kernel
from d4orm_env.engine.compiling import ONE, OPTIONS, ZERO, compiled, inlined
from d4orm_env.engine.convex_cores import place_body
from d4orm_env.engine.ray_shapes import invert, meet_bounds, meet_box, meet_core, meet_disc, meet_triangle
from d4orm_env.engine.simd import CHUNK, TILE, use_wide_registers

_FEW = 4
"""Share of the rays, one in so many, from which on all are asked about a thing, for which loops are unrolled."""
_HALF, _PER_TURN = np.float32(0.5), np.float32(0.5 / np.pi)
_ABOVE_ARCSINE = np.float32(0.571)
"""``x + 0.571 x^3`` is at least the arcsine of ``x``, from 0 to 1."""
_PI, _HALF_PI = np.float32(np.pi), np.float32(np.pi / 2)
_A0, _A1, _A2, _A3, _A4 = (np.float32(a) for a in (0.9998660, -0.3302995, 0.1801410, -0.0851330, 0.0208351))
_BELOW_CHORD = np.float32(0.2928)
"""``1 - 0.2928 x`` is at least one over the root of ``1 + x``, from 0 to 1."""
_SPARE_ANGLE, _SPARE_SHARE, _SPARE_PLACE = np.float32(2e-3), np.float32(1.0001), np.float32(1e-6)
"""Excess of the disc round a thing, for what is rounded off: seen from afar [rad], and shares of its radius and of its
coordinates."""


class Surroundings(NamedTuple):
    """Parts of a planar problem that rays meet, and the sensor."""

    radius: FloatArray  #: ``(K,)`` of the robots [m]
    heading_index: IntArray  #: ``(K,)`` components of the states that are headings, -1 for a robot without one
    boxes: FloatArray  #: See :class:`~d4orm_env.core.problem_arrays.ProblemArrays`; in the plane a round one is a disc
    triangles: FloatArray  #: Likewise
    bounds: FloatArray  #: ``(2, 2)``
    #: ``(R, 2)`` unit vectors of the rays in the robots' frames, at equal angles, the first ahead
    directions: FloatArray
    range: np.float32  #: ``()`` of the sensor [m]
    footprints: FootprintArrays | None  #: Of the robots; ``None`` where all are discs

    @classmethod
    def of(cls, arrays: ProblemArrays, directions: FloatArray, max_range: float) -> Surroundings:
        """The surroundings of a problem's robots that have these rays of so many metres."""
        heading = _heading_indices(arrays.model_codes.tobytes())
        shapes = arrays.boxes, arrays.triangles, arrays.bounds
        return cls(arrays.radius, heading, *shapes, directions, np.float32(max_range), arrays.footprints)


@lru_cache(maxsize=256)
def _heading_indices(codes: bytes) -> IntArray:
    indices = [MODELS[name].heading_index for name in names_of_codes(np.frombuffer(codes, np.int32))]
    return np.array([-1 if index is None else index for index in indices])


@compiled
def _aim(directions: FloatArray, heading: np.float32, fan: FloatArray) -> None:
    """Turn the rays by a heading, and take one over their components; all are there twice, one after the other."""
    cosine, sine, count = elementary.cosine(heading), elementary.sine(heading), directions.shape[0]
    for i in range(np.uint64(count)):
        fan[0, i] = cosine * directions[i, 0] - sine * directions[i, 1]
        fan[1, i] = sine * directions[i, 0] + cosine * directions[i, 1]
    invert(fan, count)
    for part in range(4):
        for i in range(np.uint64(count)):
            fan[part, np.uint64(count) + i] = fan[part, i]


@compiled
def _enclose(x: np.float32, y: np.float32, radius: np.float32, j: Whole, discs: FloatArray) -> None:
    """Write the disc round thing ``j``, a little wider than it is for what is rounded off."""
    discs[0, j], discs[1, j] = x, y
    discs[2, j] = radius * _SPARE_SHARE + _SPARE_PLACE * (abs(x) + abs(y))


@compiled
def _enclose_obstacles(boxes: FloatArray, triangles: FloatArray, discs: FloatArray) -> None:
    for j in range(boxes.shape[0]):
        half_x, half_y = _HALF * (boxes[j, 2] - boxes[j, 0]), _HALF * (boxes[j, 3] - boxes[j, 1])
        radius = np.sqrt(half_x * half_x + half_y * half_y) + boxes[j, 4]
        _enclose(boxes[j, 0] + half_x, boxes[j, 1] + half_y, radius, j, discs)
    for j in range(triangles.shape[0]):
        c = triangles[j]
        half_x, half_y = (
            _HALF * (max(c[0], c[2], c[4]) - min(c[0], c[2], c[4])),
            _HALF * (max(c[1], c[3], c[5]) - min(c[1], c[3], c[5])),
        )
        x, y = min(c[0], c[2], c[4]) + half_x, min(c[1], c[3], c[5]) + half_y
        _enclose(x, y, np.sqrt(half_x * half_x + half_y * half_y), boxes.shape[0] + j, discs)


@compiled
def _direction(x: np.float32, y: np.float32) -> tuple[np.float32, np.float32]:
    """Angle of a point to 2e-5 (Abramowitz and Stegun, 4.4.49), and a little more than one over its distance."""
    wide, tall = (x if x > ZERO else -x), (y if y > ZERO else -y)
    larger, smaller = (wide, tall) if wide > tall else (tall, wide)
    inverse = ONE / (larger if larger > ZERO else ONE)
    t = smaller * inverse
    t2 = t * t
    angle = t * (_A0 + t2 * (_A1 + t2 * (_A2 + t2 * (_A3 + t2 * _A4))))
    angle = _HALF_PI - angle if tall > wide else angle
    angle = _PI - angle if x < ZERO else angle
    return (-angle if y < ZERO else angle), inverse * (ONE - _BELOW_CHORD * t2)


@compiled
def _find_spans(
    discs: FloatArray, x: np.float32, y: np.float32, fan: FloatArray, num_rays: int, max_range: np.float32, spans: Ints
) -> None:
    """Fill ``spans`` ``(2, N)``, the first ray from ``(x, y)`` that may meet each thing and the one after the last.

    ``N`` is a multiple of :data:`CHUNK`, so that all of the loop vectorises.
    """
    use_wide_registers()
    cosine, sine, all_rays, none = fan[0, 0], fan[1, 0], np.int32(num_rays), np.int32(0)
    per_angle = np.float32(num_rays) * _PER_TURN
    for chunk in range(np.uint64(discs.shape[1] // CHUNK)):
        for lane in range(np.uint64(CHUNK)):
            j = chunk * np.uint64(CHUNK) + lane
            gap_x, gap_y, radius = discs[0, j] - x, discs[1, j] - y, discs[2, j]
            square, limit = gap_x * gap_x + gap_y * gap_y, max_range * _SPARE_SHARE + radius
            angle, inverse = _direction(cosine * gap_x + sine * gap_y, cosine * gap_y - sine * gap_x)
            share = radius * inverse
            half = (share + _ABOVE_ARCSINE * share * share * share + _SPARE_ANGLE) * per_angle
            begin = np.int32(np.ceil(angle * per_angle - half))
            end = np.int32(np.floor(angle * per_angle + half)) + np.int32(1)
            many = ((end - begin) * np.int32(_FEW) >= all_rays) | (square <= radius * radius)
            turns = all_rays if begin < none else none
            begin, end = none if many else begin + turns, all_rays if many else end + turns
            spans[0, j], spans[1, j] = begin, end if square <= limit * limit else begin


@compiled
def _enclose_team(
    f: FootprintArrays | None, radius: FloatArray, state: FloatArray, first: int, discs: FloatArray, poses: FloatArray
) -> None:
    """Write the discs round all bodies of the robots in ``state`` ``(K, n)``, from thing ``first`` on.

    ``poses`` ``(F, 4)`` are filled with the headings of footprints, as unit vectors, and where they are.
    """
    if f is None:
        for j in range(state.shape[0]):
            _enclose(state[j, 0], state[j, 1], radius[j], first + j, discs)
        return
    for i in range(f.robot.shape[0]):
        k, before = f.robot[i], f.before[i]
        turn = state[k, f.heading[i]] if f.heading[i] >= 0 else ZERO
        x, y, c, s = state[k, 0], state[k, 1], elementary.cosine(turn), elementary.sine(turn)
        if before != i:  # a trailer lags behind the body before it by the hitch angle
            c, s = poses[before, 0] * c + poses[before, 1] * s, poses[before, 1] * c - poses[before, 0] * s
            x, y = poses[before, 2] - f.hitch[i] * c, poses[before, 3] - f.hitch[i] * s
        poses[i, 0], poses[i, 1], poses[i, 2], poses[i, 3] = c, s, x, y
        farthest = ZERO
        for j in range(f.num_corners[i]):
            corner = f.corners[i, j]
            farthest = max(farthest, np.sqrt(corner[0] * corner[0] + corner[1] * corner[1]))
        _enclose(x, y, farthest + f.rounding[i], first + i, discs)


@compiled
def _meet_team(
    f: FootprintArrays | None, k: Whole, x: np.float32, y: np.float32, radius: FloatArray, state: FloatArray,
    poses: FloatArray, core: FloatArray, fan: FloatArray, row: FloatArray, spans: Ints,
) -> None:  # fmt: skip
    """Shorten the rays of robot ``k`` by all others; ``spans`` are those of their bodies."""
    if f is None:
        for j in range(state.shape[0]):
            if j != k and spans[1, j] > spans[0, j]:
                meet_disc(state[j, 0] - x, state[j, 1] - y, radius[j], fan, row, spans[0, j], spans[1, j])
        return
    for i in range(f.robot.shape[0]):
        if f.robot[i] != k and spans[1, i] > spans[0, i]:
            place_body(f, i, poses[i, 0], poses[i, 1], poses[i, 2] - x, poses[i, 3] - y, core)
            meet_core(core, fan, row, spans[0, i], spans[1, i])


@inlined
def _meet_obstacles(
    a: Surroundings, x: np.float32, y: np.float32, fan: FloatArray, row: FloatArray, spans: Ints
) -> None:
    """Shorten rays from ``(x, y)`` by the bounds and all obstacles."""
    boxes, triangles = a.boxes, a.triangles
    if np.isfinite(a.bounds[0, 0]):
        meet_bounds(x, y, a.bounds, fan, row, a.directions.shape[0])
    for j in range(boxes.shape[0]):
        begin, end = spans[0, j], spans[1, j]
        if end <= begin:
            continue
        low_x, low_y, high_x, high_y = boxes[j, 0] - x, boxes[j, 1] - y, boxes[j, 2] - x, boxes[j, 3] - y
        if boxes[j, 4] > ZERO:
            meet_disc(low_x, low_y, boxes[j, 4], fan, row, begin, end)
        else:
            meet_box(low_x, low_y, high_x, high_y, fan, row, begin, end)
    for j in range(triangles.shape[0]):
        begin, end = spans[0, boxes.shape[0] + j], spans[1, boxes.shape[0] + j]
        if end > begin:
            meet_triangle(x, y, triangles[j], fan, row, begin, end)


@compiled
def _meet_others(
    bodies: FloatArray, x: np.float32, y: np.float32, fan: FloatArray, row: FloatArray, spans: Ints
) -> None:
    """Shorten rays by what moves among the robots and is none."""
    for j in range(bodies.shape[0]):
        if bodies[j, 4] > ZERO and spans[1, j] > spans[0, j]:
            meet_disc(bodies[j, 0] - x, bodies[j, 1] - y, bodies[j, 4], fan, row, spans[0, j], spans[1, j])


@compiled
def _count_bodies(f: FootprintArrays | None, num_robots: int) -> int:
    return num_robots if f is None else f.robot.shape[0]


@cached_kernel(**OPTIONS)
def cast_rays(
    s: Surroundings, state: FloatArray, bodies: FloatArray, first: int, part: IntArray, out: FloatArray
) -> None:
    """Fill ``R`` components from ``first`` on of observations ``out`` ``(B, K, D)`` with distances along rays [m].

    Robots are in ``state`` ``(B, K, n)``, among ``bodies`` ``(B, N, 5)``: position, velocity and radius of moving
    obstacles. ``part`` is the first tile of worlds and the one after the last.
    """
    s = borrow(s)
    num_rays, fixed = s.directions.shape[0], s.boxes.shape[0] + s.triangles.shape[0]
    mobile = fixed + _count_bodies(s.footprints, state.shape[1])
    things = CHUNK * -(-(mobile + bodies.shape[1]) // CHUNK)
    discs, spans = np.zeros((3, things), np.float32), np.empty((2, things), np.int32)
    fan, row = np.empty((4, 2 * num_rays), np.float32), np.empty(2 * num_rays, np.float32)
    poses, core = np.empty((mobile - fixed, 4), np.float32), np.empty(TILE, np.float32)
    _enclose_obstacles(s.boxes, s.triangles, discs)
    aimed = ZERO
    _aim(s.directions, aimed, fan)
    for b in range(part[0] * TILE, min(part[1] * TILE, state.shape[0])):
        _enclose_team(s.footprints, s.radius, state[b], fixed, discs, poses)
        for j in range(bodies.shape[1]):
            _enclose(bodies[b, j, 0], bodies[b, j, 1], bodies[b, j, 4], mobile + j, discs)
        for k in range(state.shape[1]):
            x, y = state[b, k, 0], state[b, k, 1]
            heading = state[b, k, s.heading_index[k]] if s.heading_index[k] >= 0 else ZERO
            if heading != aimed:
                _aim(s.directions, heading, fan)
                aimed = heading
            row[:] = s.range
            _find_spans(discs, x, y, fan, num_rays, s.range, spans)
            _meet_obstacles(s, x, y, fan, row, spans)
            _meet_team(s.footprints, k, x, y, s.radius, state[b], poses, core, fan, row, spans[:, fixed:mobile])
            _meet_others(bodies[b], x, y, fan, row, spans[:, mobile:])
            for i in range(num_rays):
                out[b, k, first + i] = row[i] if row[i] < row[num_rays + i] else row[num_rays + i]
