"""The way to a pose of a robot that turns only as it drives: the first stretch of its shortest curve.

Curves are those of J. A. Reeds and L. A. Shepp, "Optimal paths for a car that goes both forwards and backwards",
Pacific Journal of Mathematics, 1990: arcs of the smallest circle and a straight between them. Models back up on such
arcs only, so that straights are driven forwards. Lengths are in turning radii, so that an arc's is its angle; backwards
they are negative.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import numpy as np

from d4orm_env.core import portable
from d4orm_env.core.arrays import BoolArray, Floats, IntArray

LEFT, STRAIGHT, RIGHT = 1.0, 0.0, -1.0
QUARTER = np.pi / 2
Word: TypeAlias = tuple[tuple[float, ...], BoolArray, tuple[Floats | float, ...]]
"""Sides of a curve's stretches, where it exists, and their lengths."""
CUSP, WHEELS = 0.5, 0.1
"""Lengths that a change of gear and turning wheels from straight ahead as far as they go count for: of two curves as
long as each other a robot keeps to one."""


class FirstStretch(NamedTuple):
    """The first arc or straight of a curve each."""

    side: Floats  #: ``(K,)`` :data:`LEFT`, :data:`STRAIGHT` or :data:`RIGHT`
    length: Floats  #: ``(K,)`` negative backwards; zero if there is nothing to drive
    free: BoolArray  #: ``(K,)`` whether it was chosen


def first_stretches(
    ahead: Floats, left: Floats, turns: Floats, short: Floats, wheels: Floats,
    choose: Callable[[Floats, Floats], IntArray] | None = None,
) -> FirstStretch:  # fmt: skip
    """First stretches of the shortest curves.

    Args:
        ahead: ``(K,)`` from the robots to their goals.
        left: ``(K,)`` likewise, to the left.
        turns: ``(K,)`` from the robots' headings to their goals' [rad].
        short: ``(K,)`` length up to which a stretch is left out.
        wheels: ``(K,)`` present curvatures; NaN for robots that take any at once.
        choose: ``(K,)`` which is taken of the sides and lengths ``(W, K, 5)`` of all curves, the shortest first; -1
            for none, and so for the shortest.
    """
    sides, lengths = curves(ahead, left, turns, short)
    gears = np.where(np.abs(lengths) > short[:, None], np.sign(lengths), 0.0)
    costs, first = np.abs(lengths).sum(axis=-1), (gears != 0).argmax(axis=-1)
    gear, side, inert = np.zeros_like(costs), np.broadcast_to(wheels, costs.shape), ~np.isnan(wheels)
    for own_gear, own_side in zip(np.moveaxis(gears, -1, 0), np.moveaxis(sides, -1, 0), strict=True):
        driven = own_gear != 0
        costs += CUSP * (own_gear * gear < 0) + np.where(driven & inert, WHEELS * np.abs(own_side - side), 0)
        gear, side = np.where(driven, own_gear, gear), np.where(driven, own_side, side)
    best, every, found = costs.argmin(axis=0), np.arange(len(turns)), np.full(len(turns), -1)
    if choose is not None:
        order = costs.argsort(axis=0, kind="stable")
        found = choose(sides[order, every], lengths[order, every])
        best = order[np.maximum(found, 0), every]
    chosen = best, every, first[best, every]
    return FirstStretch(sides[chosen], np.where(gears[chosen] != 0, lengths[chosen], 0.0), found >= 0)


def curves(ahead: Floats, left: Floats, turns: Floats, short: Floats) -> tuple[Floats, Floats]:
    """Sides and lengths ``(W, K, 5)`` of the stretches of all curves, infinite for one that does not lead there."""
    # As they are, seen in a mirror, driven in the other gear, and from the goal to the robot.
    gear, mirror = np.array([1.0, 1.0, -1.0, -1.0])[:, None], np.array([1.0, -1.0, 1.0, -1.0])[:, None]
    x, y, turn = gear * ahead, mirror * left, gear * mirror * turns
    sine, cosine = portable.sin(turn), portable.cos(turn)
    forth, back = (
        _words(x, y, turn, sine, cosine, short),
        _words(x * cosine + y * sine, x * sine - y * cosine, turn, sine, cosine, short),
    )
    sides, lengths = [], []
    for words, order in ((forth, slice(None)), (back, slice(None, None, -1))):
        for pattern, exists, stretches in words:
            row = np.stack(np.broadcast_arrays(*stretches), axis=-1) * gear[..., None]
            side = np.array(pattern) * mirror[..., None] + np.zeros_like(row)
            exists = exists & ~((side == STRAIGHT) & (row < -short[:, None])).any(axis=-1)
            sides.append(side[..., order])
            lengths.append(np.where(exists[..., None], row, np.inf)[..., order])
    return np.concatenate(sides), np.concatenate(lengths)


def _words(x: Floats, y: Floats, turn: Floats, sine: Floats, cosine: Floats, short: Floats) -> list[Word]:
    """The paper's curves that begin forwards to the left, equations 8.1 to 8.11; those of four arcs are left out.

    The same with arcs backwards lead there too: a robot that has driven past the end of one has not lost its curve.
    """
    same, other = (x - sine, y - 1 + cosine), (x + sine, y - 1 - cosine)
    (near, bearing), (far, angle) = _polar(*same), _polar(*other)
    last = _within(turn - bearing)
    words: list[Word] = [((LEFT, STRAIGHT, LEFT, 0, 0), near >= 0, (bearing, near, last, 0, 0))]
    straight = np.sqrt(np.maximum(far * far - 4, 0))
    first = _within(angle + portable.arctan2(np.full_like(far, 2.0), straight))
    last = _within(first - turn)
    apart = far >= 2
    words.append(((LEFT, STRAIGHT, RIGHT, 0, 0), apart, (first, straight, last, 0, 0)))
    # Two cusps, the straight between quarter circles.
    straight = 4 - straight
    first = _within(
        portable.arctan2((4 - straight) * other[0] - 2 * other[1], -2 * other[0] + (straight - 4) * other[1])
    )
    last = _within(first - turn)
    exists = apart & (straight <= short)
    words.append(((LEFT, RIGHT, STRAIGHT, LEFT, RIGHT), exists, (first, -QUARTER, straight, -QUARTER, last)))
    half = np.minimum(near / 4, 1)
    middle = -2 * portable.arctan2(half, np.sqrt(1 - half * half))
    first = _within(bearing + middle / 2 + np.pi)
    last = _within(turn - first + middle)
    words.append(((LEFT, RIGHT, LEFT, 0, 0), near <= 4, (first, middle, last, 0, 0)))
    reach = np.sqrt(np.maximum(near * near - 4, 0))
    first = _within(bearing + portable.arctan2(reach, np.full_like(reach, -2.0)))
    last = _within(turn - QUARTER - first)
    exists = (near >= 2) & (reach >= 2 - short)
    words.append(((LEFT, RIGHT, STRAIGHT, LEFT, 0), exists, (first, -QUARTER, 2 - reach, last, 0)))
    first = _polar(-other[1], other[0])[1]
    last = _within(first + QUARTER - turn)
    exists = apart
    words.append(((LEFT, RIGHT, STRAIGHT, RIGHT, 0), exists, (first, -QUARTER, 2 - far, last, 0)))
    return words


def _polar(x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Length and angle of vectors."""
    return np.sqrt(x * x + y * y), portable.arctan2(y, x)


def _within(angle: Floats) -> Floats:
    """Angles from -pi to pi, without whole turns."""
    return angle - 2 * np.pi * np.floor((angle + np.pi) / (2 * np.pi))
