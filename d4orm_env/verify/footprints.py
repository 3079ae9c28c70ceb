"""Closest approach of bodies that are no discs: polygons that turn, and ellipsoids in space.

Written again from the footprints' corners, roundings and semi-axes, as everything here. Within a sub-step positions and
headings change linearly, and a gap by no more than its bodies' points move: sub-steps are halved where, by that bound,
the gap may be less than what is known. Shapes are asked only where the discs or balls round them leave it open.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from d4orm_env.verify.contact import WIDER, Pairs, Stretch, Watch
from d4orm_env.verify.discs import Static, Things, obstacles, sides, surroundings
from d4orm_env.verify.geometry import ConvexBodies, Floats, Indices, ball_gap, core_gap, norm, polygon_distance

if TYPE_CHECKING:
    from d4orm_env.core.world import World

_Gap = Callable[[Floats, Indices, Indices, Floats, Floats], Floats]
"""``(N,)`` gaps of things, by their table and numbers, and bodies at positions and headings."""
HALVINGS = 20
"""Most times that a sub-step is halved."""
RESOLUTION = 1 / 15_000
"""Closer to the smallest gap than this share of a radius nothing is looked for."""


class Turning(Watch):
    """A watch over bodies that are no discs."""

    shapes: ConvexBodies

    @abstractmethod
    def between(self, pairs: Indices, poses: Sequence[tuple[Floats, Floats]]) -> Floats:
        """``(N,)`` gap of these pairs, their bodies at positions ``(N, d)`` and headings ``(N,)``."""

    @abstractmethod
    def outer_gap(self, pairs: Indices, *positions: Floats) -> Floats:
        """``(N,)`` gap of the discs or balls round these pairs, no more than theirs, bodies at positions ``(N, d)``."""

    def gap(self, stretch: Stretch, steps: Indices, pairs: Indices, lead: Floats) -> Floats:
        positions = [stretch.path[steps, 0, bodies] for bodies in self.bodies(pairs)]
        gap = self.outer_gap(pairs, *positions)

        def ask(some: Indices) -> None:
            first = np.zeros(len(some), np.intp)
            gap[some] = self._gap_at(stretch, steps[some], pairs[some], first, np.zeros(len(some)))

        if np.isinf(self.minimum) and len(gap):
            nearest = int(gap.argmin())
            ask(np.array([nearest]))
            self.minimum = float(gap[nearest])
        ask(np.flatnonzero(gap - lead < max(self.minimum, 0.0)))
        return gap

    def _gap_at(self, stretch: Stretch, steps: Indices, pairs: Indices, sub_steps: Indices, share: Floats) -> Floats:
        """``(N,)`` gap of that pair when that share of that sub-step has passed."""
        after = np.minimum(sub_steps + 1, stretch.path.shape[1] - 1)
        poses = []
        for bodies in self.bodies(pairs):
            position = stretch.path[steps, sub_steps, bodies]
            position = position + share[:, None] * (stretch.path[steps, after, bodies] - position)
            turn = stretch.turn[steps, sub_steps, bodies]
            poses.append((position, turn + share * (stretch.turn[steps, after, bodies] - turn)))
        return self.between(pairs, poses)

    def _travel(self, stretch: Stretch, steps: Indices, pairs: Indices) -> Floats:
        """``(N, S)`` by how much the gap may change in each sub-step."""
        change = np.zeros((len(steps), stretch.path.shape[1] - 1))
        for bodies in self.bodies(pairs):
            path, turn = stretch.of(steps, bodies), stretch.turn[steps, :, bodies]
            moved = norm(np.diff(path, axis=1)) + self.shapes.outer[bodies, None] * np.abs(np.diff(turn, axis=1))
            change += self.shapes.stretch[bodies, None] * moved
        return change

    def approach(self, stretch: Stretch, steps: Indices, pairs: Indices) -> tuple[Floats, Floats]:
        num_sub_steps = stretch.path.shape[1] - 1
        each, sub = (index.ravel() for index in np.indices((len(steps), num_sub_steps + 1)))
        ends = self._gap_at(stretch, steps[each], pairs[each], sub, np.zeros(len(each))).reshape(len(steps), -1)
        best = np.minimum(ends[:, :-1], ends[:, 1:])
        fraction = (ends[:, 1:] < ends[:, :-1]).astype(np.float64)
        change = self._travel(stretch, steps, pairs)
        each, sub = (index.ravel() for index in np.indices(best.shape))
        low, width = np.zeros(len(each)), 1.0
        begins, finishes = ends[:, :-1].ravel(), ends[:, 1:].ravel()
        resolution = RESOLUTION * self.shapes.outer.min()
        for _ in range(HALVINGS):
            least = (begins + finishes - change[each, sub] * width) / 2
            wanted = np.flatnonzero(least < np.minimum(best[each, sub] - resolution, max(self.minimum, resolution)))
            if not len(wanted):
                break
            each, sub = each[wanted], sub[wanted]
            low, begins, finishes = low[wanted], begins[wanted], finishes[wanted]
            width /= 2
            middle = low + width
            gap = self._gap_at(stretch, steps[each], pairs[each], sub, middle)
            order = np.argsort(-gap, kind="stable")  # the smallest of a sub-step is written last
            closer = order[gap[order] < best[each[order], sub[order]]]
            best[each[closer], sub[closer]], fraction[each[closer], sub[closer]] = gap[closer], middle[closer]
            each, sub, low = np.tile(each, 2), np.tile(sub, 2), np.concatenate([low, middle])
            begins, finishes = np.concatenate([begins, gap]), np.concatenate([gap, finishes])
        return best, fraction


class TurningPairs(Turning, Pairs):
    """Robots against each other."""

    def __init__(self, robot: Indices, shapes: ConvexBodies) -> None:
        super().__init__(robot, shapes.outer)
        self.shapes = shapes

    def outer_gap(self, pairs: Indices, *positions: Floats) -> Floats:
        return norm(positions[0] - positions[1]) - WIDER * self._size[pairs]

    def near_gap(self, stretch: Stretch, a: Indices, b: Indices) -> Floats:
        poses = [(stretch.path[0, 0, bodies], stretch.turn[0, 0, bodies]) for bodies in (a, b)]
        return self._between_bodies(a, b, poses)

    def between(self, pairs: Indices, poses: Sequence[tuple[Floats, Floats]]) -> Floats:
        return self._between_bodies(self.rows[pairs], self.columns[pairs], poses)

    def _between_bodies(self, a: Indices, b: Indices, poses: Sequence[tuple[Floats, Floats]]) -> Floats:
        (position, turn), (its_position, its_turn) = poses
        shapes = self.shapes
        if position.shape[1] == 3:
            return ball_gap(its_position - position, shapes.semi_axes[a], shapes.semi_axes[b])
        cores = shapes.placed(a, np.zeros_like(position), turn), shapes.placed(b, its_position - position, its_turn)
        return core_gap(*cores) - shapes.rounding[a] - shapes.rounding[b]


class TurningStatic(Turning, Static):
    """Robots against the obstacles of a world, or its bounds: one column each."""

    def __init__(self, kind: str, robot: Indices, shapes: ConvexBodies, names: Sequence[str]) -> None:
        super().__init__(kind, robot, names)
        self.shapes = shapes


class Obstacles(TurningStatic):
    """Robots against obstacles, each a convex core with a rounding, or a polygon."""

    def __init__(self, robot: Indices, shapes: ConvexBodies, world: World) -> None:
        self._gap_to: dict[str, _Gap]
        if world.dimension == 2:
            self._gap_to = {"circles": self._to_circle, "boxes": self._to_rectangle, "polygons": self._to_polygon}
        else:
            self._gap_to = {"spheres": self._to_round, "cylinders": self._to_round, "boxes": self._to_box}
        self._kinds = [*obstacles(world)]
        sizes = [len(things.names) for _, _, things in self._kinds]
        self._kind, self._begins = np.repeat(np.arange(len(sizes)), sizes), np.cumsum([0, *sizes])
        names = [name for _, _, things in self._kinds for name in things.names]
        super().__init__("obstacle contact", robot, shapes, names)

    def outer_gap(self, pairs: Indices, *positions: Floats) -> Floats:
        gaps, (position,) = np.empty(len(pairs)), positions
        for (_, _, things), here, number in self._by_kind(pairs):
            gaps[here] = things.distance(position[here], number)
        return gaps - WIDER * self.shapes.outer[self.rows[pairs]]

    def between(self, pairs: Indices, poses: Sequence[tuple[Floats, Floats]]) -> Floats:
        ((position, turn),), gaps = poses, np.empty(len(pairs))
        for (kind, table, _), here, number in self._by_kind(pairs):
            gaps[here] = self._gap_to[kind](table, number, self.rows[pairs[here]], position[here], turn[here])
        return gaps

    def _by_kind(self, pairs: Indices) -> Iterator[tuple[tuple[str, Floats, Things], Indices, Indices]]:
        """Yield each kind of obstacle with the pairs, of ``(N,)``, that concern one, and its number."""
        column = self.columns[pairs]
        kinds = self._kind[column]
        for kind in np.unique(kinds):
            here = np.flatnonzero(kinds == kind)
            yield self._kinds[kind], here, column[here] - self._begins[kind]

    def _to_circle(self, table: Floats, number: Indices, body: Indices, position: Floats, turn: Floats) -> Floats:
        core = self.shapes.placed(body, np.zeros_like(position), turn)
        centre = (table[number, :2] - position)[:, None]
        return core_gap(core, centre) - self.shapes.rounding[body] - table[number, 2]

    def _to_rectangle(self, table: Floats, number: Indices, body: Indices, position: Floats, turn: Floats) -> Floats:
        left, low, right, high = (table[number] - np.tile(position, 2)).T
        corners = np.stack([left, low, right, low, right, high, left, high], axis=-1).reshape(-1, 4, 2)
        core = self.shapes.placed(body, np.zeros_like(position), turn)
        return core_gap(core, corners) - self.shapes.rounding[body]

    def _to_polygon(self, corners: Floats, number: Indices, body: Indices, position: Floats, turn: Floats) -> Floats:
        core, least = self.shapes.placed(body, position, turn), np.full(len(number), np.inf)
        for begin, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            edge = np.broadcast_to(np.stack([begin, end]), (len(number), 2, 2))
            least = np.minimum(least, core_gap(core, edge))
        # What lies within it crosses no edge.
        inside = (least > 0) & (polygon_distance(core[:, 0], corners) < 0)
        return np.where(inside, -least, least) - self.shapes.rounding[body]

    def _to_round(self, table: Floats, number: Indices, body: Indices, position: Floats, turn: Floats) -> Floats:
        centre, radius = table[number, :-1], table[number, -1]
        # A cylinder is as near as the ball beside the body.
        offset = np.pad(centre - position[:, : centre.shape[1]], ((0, 0), (0, 3 - centre.shape[1])))
        return ball_gap(offset, self.shapes.semi_axes[body], np.repeat(radius[:, None], 3, axis=1))

    def _to_box(self, table: Floats, number: Indices, body: Indices, position: Floats, turn: Floats) -> Floats:
        offset = np.clip(position, table[number, :3], table[number, 3:]) - position
        axes = self.shapes.semi_axes[body]
        factor = np.maximum(norm(offset / axes), 1e-6)
        return np.maximum(norm(offset) * (1 - 1 / factor), -axes.min(axis=1))


class Sides(TurningStatic):
    """Robots against the sides of the world."""

    def __init__(self, robot: Indices, shapes: ConvexBodies, world: World) -> None:
        self._sides = sides(world)
        super().__init__("bounds contact", robot, shapes, self._sides.names)

    def outer_gap(self, pairs: Indices, *positions: Floats) -> Floats:
        return self._sides.distance(positions[0], self.columns[pairs]) - WIDER * self.shapes.outer[self.rows[pairs]]

    def between(self, pairs: Indices, poses: Sequence[tuple[Floats, Floats]]) -> Floats:
        ((position, turn),), column, body = poses, self.columns[pairs], self.rows[pairs]
        axis, at = column % position.shape[1], self._sides.distance(position, column)
        if position.shape[1] == 3:
            return at - self.shapes.semi_axes[body, axis]
        corners = self.shapes.placed(body, np.zeros_like(position), turn)
        along = np.take_along_axis(corners, axis[:, None, None], axis=2)[..., 0]
        inward = np.where(column < 2, 1.0, -1.0)[:, None]
        return at + (inward * along).min(axis=1) - self.shapes.rounding[body]


def make_watches(
    world: World, robot: Indices, radius: Floats, shapes: ConvexBodies | None
) -> tuple[Pairs, list[Watch]]:
    """Return the watch over bodies of these robots ``(B,)``, and those over obstacles and bounds.

    Bodies are discs or balls of a radius ``(B,)``, but for those with ``shapes``.
    """
    if shapes is None:
        return Pairs(robot, radius), surroundings(world, robot, radius)
    pairs = TurningPairs(robot, shapes)
    if world.dimension == 3:
        shapes = shapes.at_walls()
        if (shapes.stretch == 1).all():
            return pairs, surroundings(world, robot, shapes.outer)
    watches: list[Watch] = [Obstacles(robot, shapes, world)] if world.num_obstacles else []
    if world.lower is not None:
        watches.append(Sides(robot, shapes, world))
    return pairs, watches
