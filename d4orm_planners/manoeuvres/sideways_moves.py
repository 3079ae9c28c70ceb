"""Moves of robots without a heading, in directions evenly all round."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from math import sqrt

import numpy as np

from d4orm_env.core import portable
from d4orm_env.core.arrays import FloatArray
from d4orm_env.dynamics.holonomic2d_jerk import MAX_JERK
from d4orm_env.dynamics.robot_model import ACCELERATION, SPEED
from d4orm_planners.manoeuvres.kinds import LENGTHS, Kind, Move, held

DIRECTIONS = 8
"""Directions in which they drive."""


def _compass() -> Iterator[tuple[float, float]]:
    for number in range(DIRECTIONS):
        sine, cosine = portable.sin_cos(np.float64(number * 2 * np.pi / DIRECTIONS))
        yield float(cosine), float(sine)


def velocity2d_moves(kind: Kind) -> Iterator[Move]:
    """Straight on, at full speed."""
    most = kind.limits[SPEED]
    for (x, y), length in product(_compass(), LENGTHS):
        yield (), (), held(kind.steps(length * kind.cell, most), most * x, most * y)


def holonomic2d_moves(kind: Kind) -> Iterator[Move]:
    """From rest to full speed and back, from one direction to the next, straight on, and from rest to rest."""
    most, ways, rest = kind.limits[SPEED], list(_compass()), (0.0, 0.0)
    for number, (x, y) in enumerate(ways):
        going, count = (most * x, most * y), kind.speeding_up(most)
        push = most / (count * kind.dt)
        yield rest, going, held(count, push * x, push * y)
        yield going, rest, held(count, -push * x, -push * y)
        for side in (1, -1):
            other = ways[(number + side) % DIRECTIONS]
            gap = (other[0] - x, other[1] - y)
            count = kind.speeding_up(most * sqrt(gap[0] ** 2 + gap[1] ** 2))
            push = most / (count * kind.dt)
            yield going, (most * other[0], most * other[1]), held(count, push * gap[0], push * gap[1])
        for length in LENGTHS:
            yield going, going, held(kind.steps(length * kind.cell, most), 0.0, 0.0)
        count, peak = kind.hop(LENGTHS[0] * kind.cell, kind.limits[ACCELERATION])
        if peak <= most:
            push = peak / (count * kind.dt)
            yield rest, rest, np.concatenate([held(count, push * x, push * y), held(count, -push * x, -push * y)])


def _swung(kind: Kind, x: float, y: float) -> FloatArray:
    """Controls under which the velocity changes by so much: the acceleration rises from zero, and as long falls."""
    change = sqrt(x * x + y * y)
    count = max(kind.hop(change, kind.limits[MAX_JERK])[0], kind.steps(change, kind.limits[ACCELERATION]))
    push = 1 / (count * kind.dt) ** 2
    return np.concatenate([held(count, push * x, push * y), held(count, -push * x, -push * y)])


def _half_way(kind: Kind, length: float) -> float:
    """The speed half-way along the shortest hop from rest to rest, in whole steps."""
    jerk, most, time = kind.limits[MAX_JERK], kind.limits[ACCELERATION], kind.dt
    while length / (2 * time) > min(jerk * time * time, most * time):
        time += kind.dt
    return length / (2 * time)


def holonomic2d_jerk_moves(kind: Kind) -> Iterator[Move]:
    """As those of a double integrator, but between moves the acceleration is zero."""
    most, ways, rest = kind.limits[SPEED], list(_compass()), (0.0,) * 4
    hop = _half_way(kind, LENGTHS[0] * kind.cell)
    for number, (x, y) in enumerate(ways):
        going = (most * x, most * y, 0.0, 0.0)
        yield rest, going, _swung(kind, most * x, most * y)
        yield going, rest, _swung(kind, -most * x, -most * y)
        for side in (1, -1):
            other_x, other_y = ways[(number + side) % DIRECTIONS]
            change = _swung(kind, most * (other_x - x), most * (other_y - y))
            yield going, (most * other_x, most * other_y, 0.0, 0.0), change
        for length in LENGTHS:
            yield going, going, held(kind.steps(length * kind.cell, most), 0.0, 0.0)
        if hop <= most:
            yield rest, rest, np.concatenate([_swung(kind, hop * x, hop * y), _swung(kind, -hop * x, -hop * y)])
