"""Moves of first-order cars, with trailers between hitch angles at which they go round in circles.

A mode is the hitch angles. At those of a circle trailers follow without swinging; from one circle to another they swing
under steering angles that are found by shooting, with as many unknowns as there are hitches.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from itertools import product

import numpy as np

from d4orm_env.core import portable
from d4orm_env.core.arrays import FloatArray, Floats
from d4orm_env.dynamics.first_order_cars import MAX_STEERING, WHEELBASE
from d4orm_planners.manoeuvres.kinds import LENGTHS, MAX_STEPS, OPS, Kind, Mode, Move, held

SHARE = 0.95
"""Share of the largest hitch and steering angles that is used."""
FINER = 0.1
"""Share of the tightest curvature in which it is sought."""
ARCS = (1, 4)
"""Sectors by which arcs turn."""
LONGEST = 2.5
"""Most that trailers swing for, in the sum of the hitches' lengths."""
ITERATIONS, EXACT = 8, 1e-7
"""Newton steps of shooting, and the hitch angles' error that ends it [rad]."""
NUDGE = 1e-4
"""By which an unknown changes to see what depends on it."""


def steering(kind: Kind, curvature: float) -> float:
    """Steering angle of a circle."""
    return float(portable.arctan2(np.float64(curvature * kind.limits[WHEELBASE]), np.float64(1.0)))


def _curvature(kind: Kind, angle: float) -> float:
    """Curvature of the circle at a steering angle."""
    sine, cosine = portable.sin_cos_of(angle)
    return sine / cosine / kind.limits[WHEELBASE]


def _most_curved(kind: Kind) -> float:
    """Curvature that the wheels can be turned to; trailers need a reserve."""
    share = SHARE if kind.model.trailers else 1.0
    return _curvature(kind, share * kind.limits[MAX_STEERING])


def _largest(kind: Kind) -> Floats:
    """``(N,)`` hitch angles that are used at most."""
    return SHARE * np.array([kind.limits[column] for _, column in kind.model.state_limits])


def _drift(kind: Kind, hitches: Floats, curvature: float) -> Floats:
    """``(N,)`` what hitch angles change by in a metre."""
    state, control = (0.0, 0.0, 0.0, *hitches.tolist()), (1.0, steering(kind, curvature))
    return np.array(kind.model.functions.derivative(state, control, kind.limits, OPS)[3:])


def circle(kind: Kind, curvature: float) -> Floats | None:
    """``(N,)`` hitch angles of a circle, ``None`` if they are too large."""
    hitches, largest = np.zeros(len(kind.model.trailers)), _largest(kind)
    for number in range(len(hitches)):  # each depends on those before it
        for _ in range(ITERATIONS):
            nudged = hitches.copy()
            nudged[number] += NUDGE
            drift = _drift(kind, hitches, curvature)[number]
            slope = (_drift(kind, nudged, curvature)[number] - drift) / NUDGE
            hitches[number] = np.clip(hitches[number] - drift / slope, -largest[number], largest[number])
        if abs(_drift(kind, hitches, curvature)[number]) > EXACT:
            return None
    return hitches


@cache
def tightest_curvature(kind: Kind) -> float | None:
    """The largest curvature of a circle that trailers can swing into and out of, in a grid of shares of that of the
    wheels or of the shortest hitch; ``None`` if hitch angles are bounded too narrowly for any.
    """
    most = min([_most_curved(kind), *(1 / kind.limits[column] for _, column in kind.model.trailers)])
    shares = np.arange(1.0, 0.0, -FINER)
    return next((curvature for curvature in (shares * most).tolist() if _is_joined(kind, curvature)), None)


def _is_joined(kind: Kind, curvature: float) -> bool:
    """Check whether there is a circle, and swings between it and straight on in both directions."""
    hitches = circle(kind, curvature)
    if hitches is None:
        return False
    bent, straight = tuple(hitches.tolist()), (0.0,) * len(hitches)
    return all(swing(kind, *ends, -1) is not None for ends in ((bent, straight), (straight, bent)))


@cache
def swing(kind: Kind, before: Mode, after: Mode, way: int) -> FloatArray | None:
    """``(n, 2)`` controls from some hitch angles to others, forwards or backwards; ``None`` if none are found."""
    if before == after:
        return held(0, 0.0, 0.0)
    if (*before, *after) < (*np.negative(before), *np.negative(after)):  # to the right as to the left
        other = swing(kind, tuple(np.negative(before).tolist()), tuple(np.negative(after).tolist()), way)
        return None if other is None else other * np.array([1, -1], np.float32)
    size, metres = len(after), sum(kind.limits[column] for _, column in kind.model.trailers)
    speed, guess = way * kind.pace(way), np.zeros(size)
    span = float(np.abs(np.array(after) - np.array(before)).sum()) / _most_curved(kind)
    if way < 0:
        # In reverse trailers drift away from what is aimed at: begin with the same path, driven the other way.
        ahead = swing(kind, after, before, 1)
        if ahead is None:
            return None
        span = len(ahead) * kind.pace(1) * kind.dt
        guess = np.array([_curvature(kind, angle) for angle in ahead[:: len(ahead) // size, 1][::-1].tolist()])
    count = kind.steps(span / size, abs(speed))
    while count <= min(kind.steps(LONGEST * metres / size, abs(speed)), MAX_STEPS // size):
        controls = _shot(kind, before, np.array(after), speed, count, guess)
        if controls is not None:
            return controls
        count += max(1, count // 4)
    return None


def _shot(kind: Kind, before: Mode, wanted: Floats, speed: float, count: int, curvatures: Floats) -> FloatArray | None:
    """Controls with a steering angle for so many steps each, from a guess on, if there are such within all limits."""
    size, largest = len(wanted), _largest(kind)

    def driven(curvatures: Floats) -> tuple[FloatArray, Floats]:
        angles = [steering(kind, value) for value in curvatures.tolist()]
        controls = np.concatenate([held(count, speed, angle) for angle in angles])
        return controls, np.array(kind.states((0.0, 0.0, 0.0, *before), controls))[:, 3:]

    for _ in range(ITERATIONS):
        controls, hitches = driven(curvatures)
        missing = wanted - hitches[-1]
        if np.abs(missing).max() < EXACT:
            bent, worst = np.abs(curvatures).max(), np.maximum(np.abs(wanted), np.maximum(largest, np.abs(before)))
            return controls if bent <= _most_curved(kind) and (np.abs(hitches) <= worst).all() else None
        slopes = [(driven(curvatures + NUDGE * unit)[1][-1] - hitches[-1]) / NUDGE for unit in np.eye(size)]
        change = _solved(np.array(slopes).T, missing)
        if change is None:
            return None
        curvatures = np.clip(curvatures + change, -2 * _most_curved(kind), 2 * _most_curved(kind))
    return None


def _solved(matrix: Floats, right: Floats) -> Floats | None:
    """Solution of linear equations by elimination, with the same bits everywhere; ``None`` if there is none."""
    rows = np.column_stack([matrix, right])
    for column in range(len(right)):
        pivot = column + int(np.abs(rows[column:, column]).argmax())
        if abs(rows[pivot, column]) < EXACT:
            return None
        rows[[column, pivot]] = rows[[pivot, column]]
        rows[column] /= rows[column, column]
        for other in range(len(right)):
            if other != column:
                rows[other] -= rows[other, column] * rows[column]
    return rows[:, -1]


def first_order_car_moves(kind: Kind) -> Iterator[Move]:
    """Straight on, in the tightest circles if there are any, between these, and from the hitch angles at the start."""
    base, straight = kind.base, (0.0,) * len(kind.model.trailers)
    curvature = tightest_curvature(base)
    hitches = None if curvature is None else circle(base, curvature)
    for way in (1, -1):
        speed = way * kind.pace(way)
        for length in LENGTHS:
            yield straight, straight, held(kind.steps(length * kind.cell, abs(speed)), speed, 0.0)
        if curvature is None or hitches is None:
            continue
        left, right = tuple(hitches.tolist()), tuple((-hitches).tolist())
        for mode, side, sectors in ((mode, side, arc) for (mode, side), arc in product(((left, 1), (right, -1)), ARCS)):
            count = kind.steps(sectors * kind.sector / curvature, abs(speed))
            yield mode, mode, held(count, speed, steering(kind, side * curvature))
        changes = [(straight, left), (left, straight), (straight, right), (right, straight)]
        changes += [(left, right), (right, left)]
        if kind.start not in (straight, left, right):
            changes += [(kind.start, mode) for mode in (straight, left, right)]
        for before, after in changes:
            controls = swing(base, before, after, way)
            if controls is not None and len(controls):
                yield before, after, controls
