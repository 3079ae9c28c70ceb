"""Closest approach of bodies over continuous time, and its time.

The motion is cut into sub-steps so short that each curve departs from its chord by at most ``CHORD_ERROR`` of the
radius, and on the chords the closest approach is solved exactly.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from d4orm_env.verify.geometry import Floats, Indices, closest_approach, norm
from d4orm_env.verify.report import Violation

_ROUNDING = 2.0**-30
"""Rounding of distances, as a share of how far any robot gets."""
WIDER = 1 + 2.0**-17
"""Factor by which boxes, and discs round bodies, are stretched for rounding."""

BLOCKS = (128, 32, 8, 1)
"""Steps that are judged at once, from many to one."""

FEW = 128
"""Pairs that are looked at closely first, those that may be nearest: they tell that many others do not matter."""

MAX_NUMBERS = 2**18
"""Numbers in the largest arrays that are worked on at once, but for those of a single step."""


@dataclass(frozen=True, eq=False)
class Stretch:
    """Some steps of all bodies."""

    path: Floats  #: ``(T, S+1, B, d)`` positions at the ends of the sub-steps [m]
    travel: Floats  #: ``(T, B)`` distance that any point of a body gets from where it began, in each step [m]
    start: float  #: Time at which it begins [s]
    dt: float  #: Length of a step [s]
    #: ``(T, S+1, B)`` headings at the ends of the sub-steps [rad]; of size zero where all bodies are discs
    turn: Floats

    def of(self, steps: Indices, bodies: Indices) -> Floats:
        """``(N, S+1, d)`` the path of one body in one step each."""
        return self.path[steps, :, bodies]

    def times(self, steps: Indices, sub_steps: Indices, fraction: Floats) -> Floats:
        """Return the time at which that fraction of that sub-step of that step has passed [s]."""
        sub_step = self.dt / (self.path.shape[1] - 1)
        return self.start + steps * self.dt + (sub_steps + fraction) * sub_step


class Watch(ABC):
    """Closest approach and first contact of every robot with every thing of a kind.

    ``rows`` and ``columns`` ``(P,)`` are the pairs of a body and a thing that are watched; ``minimum`` is the smallest
    gap between any two [m].
    """

    def __init__(self, kind: str, robot: Indices, names: Sequence[str], rows: Indices, columns: Indices) -> None:
        self.kind, self.names, self.rows, self.columns = kind, names, rows, columns
        self.minimum = np.inf
        self._robot = robot
        self._smallest, self._smallest_time, self._first = np.empty((3, 0))  # with room once anything touches

    @abstractmethod
    def gap(self, stretch: Stretch, steps: Indices, pairs: Indices, lead: Floats) -> Floats:
        """``(N,)`` gap of that pair at the beginning of that step, or some number below it that exceeds the smallest
        gap so far, and zero, by at least ``lead`` ``(N,)`` [m].
        """

    @abstractmethod
    def bodies(self, pairs: Indices) -> Sequence[Indices]:
        """Return the bodies whose motion changes the gaps of these pairs."""

    @abstractmethod
    def approach(self, stretch: Stretch, steps: Indices, pairs: Indices) -> tuple[Floats, Floats]:
        """``(N, S)`` smallest gap in every sub-step of that step and pair, and the fraction of the sub-step then."""

    @abstractmethod
    def thing(self, column: Indices) -> Indices:
        """Index into ``names`` of what the column stands for."""

    def select(self, stretch: Stretch) -> None:  # noqa: B027 - most watch the same pairs throughout
        """Choose the pairs to watch in a stretch."""

    def observe(self, stretch: Stretch) -> None:
        """Judge a stretch. Only pairs that may touch, or come closer than any so far, are looked at closely."""
        self.select(stretch)
        travelled = np.concatenate([np.zeros((1, stretch.travel.shape[1])), np.cumsum(stretch.travel, axis=0)])
        begins, pairs = np.arange(0, len(stretch.path), BLOCKS[0]), np.arange(len(self.rows))
        steps, pairs = np.repeat(begins, len(pairs)), np.tile(pairs, len(begins))
        size = max(1, MAX_NUMBERS // (stretch.path.shape[1] * stretch.path.shape[3]))
        for least, near_steps, near_pairs in self._near(stretch, travelled, BLOCKS, steps, pairs):
            order, first, count = np.argsort(least, kind="stable"), 0, min(FEW, size)
            while first < len(order) and least[order[first]] < max(self.minimum, 0.0):
                some = order[first : first + count]
                self._look(stretch, near_steps[some], near_pairs[some])
                first, count = first + count, min(2 * count, size)

    def _near(
        self, stretch: Stretch, travelled: Floats, blocks: Sequence[int], steps: Indices, pairs: Indices
    ) -> Iterator[tuple[Floats, Indices, Indices]]:
        """Some at a time, the least gaps ``(N,)`` that there may be in a step, steps and pairs, where it may matter.

        ``blocks[0]`` steps are taken at once from ``steps`` on, and fewer of those in which something may be near.
        ``travelled`` is how far the bodies get, ``(T+1, B)`` added up.
        """
        block, num_steps = blocks[0], len(stretch.path)
        # Each may leave as many as sixteen to look at, with fewer steps at once.
        size = MAX_NUMBERS // 16
        for first in range(0, len(steps), size):
            begin, pair = steps[first : first + size], pairs[first : first + size]
            end, lead = np.minimum(begin + block, num_steps), np.full(len(begin), _ROUNDING * travelled[-1].max())
            for body in self.bodies(pair):
                lead += travelled[end, body] - travelled[begin, body]
            gap = self.gap(stretch, begin, pair, lead)
            self.minimum = min(self.minimum, float(gap.min(initial=np.inf)))
            least = gap - lead
            near = least < max(self.minimum, 0.0)
            if block == 1:
                yield least[near], begin[near], pair[near]
                continue
            parts = np.arange(0, block, blocks[1])
            later, whose = (begin[near][:, None] + parts).ravel(), np.repeat(pair[near], len(parts))
            inside = later < num_steps
            yield from self._near(stretch, travelled, blocks[1:], later[inside], whose[inside])

    def _look(self, stretch: Stretch, steps: Indices, pairs: Indices) -> None:
        gap, fraction = self.approach(stretch, steps, pairs)
        self.minimum = min(self.minimum, float(gap.min()))
        touching = gap <= 0
        hit = np.flatnonzero(touching.any(axis=1))
        if len(hit) == 0:
            return
        if len(self._first) == 0:
            self._smallest, self._smallest_time, self._first = np.full(
                (3, (int(self._robot.max()) + 1) * len(self.names)), np.inf
            )
        gap, fraction, steps, pairs = gap[hit], fraction[hit], steps[hit], pairs[hit]
        each, first, lowest = np.arange(len(hit)), touching[hit].argmax(axis=1), gap.argmin(axis=1)
        key = self._robot[self.rows[pairs]] * len(self.names) + self.thing(self.columns[pairs])
        np.minimum.at(self._first, key, stretch.times(steps, first, fraction[each, first]))
        smallest, before = gap[each, lowest], self._smallest[key]
        np.minimum.at(self._smallest, key, smallest)
        closest = (smallest == self._smallest[key]) & (smallest < before)
        self._smallest_time[key[closest]] = stretch.times(steps, lowest, fraction[each, lowest])[closest]

    def violations(self) -> Iterator[Violation]:
        """One for each robot and thing that touched."""
        for key in np.flatnonzero(np.isfinite(self._first)):
            robot, thing = (int(index) for index in divmod(key, len(self.names)))
            robots = (robot, thing) if self.kind == "robot contact" else (robot,)
            gap, time = self._smallest[key], self._smallest_time[key]
            detail = f"touches {self.names[thing]}, smallest gap {gap:.4g} m at {time:.3f} s"
            yield Violation(self.kind, robots, float(self._first[key]), detail)


class Pairs(Watch):
    """Robots against each other: in every stretch those that it takes close enough to matter."""

    def __init__(self, robot: Indices, radius: Floats) -> None:
        names = [f"robot_{index}" for index in range(int(robot.max()) + 1)]
        none = np.empty(0, np.intp)
        super().__init__("robot contact", robot, names, none, none)
        self._radius = radius

    def select(self, stretch: Stretch) -> None:
        lower, upper = stretch.path.min(axis=(0, 1)), stretch.path.max(axis=(0, 1))
        axis = int((upper.max(axis=0) - lower.min(axis=0)).argmax())
        order = np.argsort(lower[:, axis], kind="stable")
        # Bodies further apart than any two are known to come do not matter.
        a, b = order[:-1], order[1:]
        gap = self.near_gap(stretch, a, b)
        least = min(self.minimum, float(gap[self._robot[a] != self._robot[b]].min(initial=np.inf)))
        widening = (WIDER * self._radius + max(least, 0.0) / 2)[:, None]
        lower, upper = lower - widening, upper + widening
        # Boxes that overlap along one axis: each with those that begin before it ends.
        order = np.argsort(lower[:, axis], kind="stable")
        lower, upper, ranks = lower[order].T, upper[order].T, np.arange(len(order))
        count = np.searchsorted(lower[axis], upper[axis], side="right") - ranks - 1
        second = np.arange(count.sum()) + np.repeat(ranks + 1 - (np.cumsum(count) - count), count)
        near = np.ones(len(second), bool)
        for low, high in zip(np.delete(lower, axis, axis=0), np.delete(upper, axis, axis=0), strict=True):
            near &= (np.repeat(low, count) <= high[second]) & (low[second] <= np.repeat(high, count))
        a, b = order[np.repeat(ranks, count)[near]], order[second[near]]
        apart = self._robot[a] != self._robot[b]  # two readings of one robot do not meet
        key = np.sort((np.minimum(a, b) * len(order) + np.maximum(a, b))[apart])
        self.rows, self.columns = np.divmod(key, len(order))
        self._size = self._radius[self.rows] + self._radius[self.columns]

    def near_gap(self, stretch: Stretch, a: Indices, b: Indices) -> Floats:
        """``(N,)`` gap of bodies ``a`` and ``b`` when the stretch begins [m]."""
        return norm(stretch.path[0, 0, a] - stretch.path[0, 0, b]) - self._radius[a] - self._radius[b]

    def gap(self, stretch: Stretch, steps: Indices, pairs: Indices, lead: Floats) -> Floats:
        position = stretch.path[:, 0]
        distance = norm(position[steps, self.rows[pairs]] - position[steps, self.columns[pairs]])
        return distance - self._size[pairs]

    def bodies(self, pairs: Indices) -> Sequence[Indices]:
        return self.rows[pairs], self.columns[pairs]

    def approach(self, stretch: Stretch, steps: Indices, pairs: Indices) -> tuple[Floats, Floats]:
        offset = stretch.of(steps, self.rows[pairs]) - stretch.of(steps, self.columns[pairs])
        distance, fraction = closest_approach(offset[:, :-1], offset[:, 1:])
        return distance - self._size[pairs][:, None], fraction

    def thing(self, column: Indices) -> Indices:
        return self._robot[column]
