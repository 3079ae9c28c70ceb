"""Closest approach of bodies that are no discs: polygons that turn, and ellipsoids in space.

Written again from the footprints' corners, roundings and semi-axes, as everything here. Within a sub-step places and
headings change linearly, and a gap by no more than its bodies' points move: sub-steps are halved where, by that bound,
the gap may be less than what is known.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from d4orm_env.core import portable
from d4orm_env.verify.contact import Indices, Pairs, Static, Stretch, Watch
from d4orm_env.verify.geometry import Floats, ball_gap, core_gap, norm, polygon_distance

if TYPE_CHECKING:
    from d4orm_env.core.team import Team
    from d4orm_env.core.world import World

_Gap = Callable[[Indices, Indices, Floats, Floats], Floats]
"""``(N,)`` gaps of things and bodies at places and headings."""
MAX_CORNERS = 8
HALVINGS = 20
"""Most times that a sub-step is halved."""
RESOLUTION = 1 / 15_000
"""Closer to the smallest gap than this share of a radius nothing is looked for."""


@dataclass(frozen=True, eq=False)
class ConvexBodies:
    """Convex bodies, one row each."""

    corners: Floats  #: ``(B, 8, 2)`` of planar cores, the last one repeated; of no use in space
    rounding: Floats  #: ``(B,)``
    semi_axes: Floats  #: ``(B, 3)`` in space
    outer: Floats  #: ``(B,)`` radii of the discs or balls round them
    stretch: Floats  #: ``(B,)`` how much faster a gap may change than a body moves

    @classmethod
    def of(cls, team: Team) -> ConvexBodies:
        """The footprints of a team: of its robots, and then of their trailers."""
        bodies: list[Any] = [getattr(footprint, "front", footprint) for footprint in team.footprint]
        bodies += [trailer for footprint in team.footprint for trailer in getattr(footprint, "trailers", ())]
        size = len(bodies)
        corners, rounding, semi_axes = np.zeros((size, MAX_CORNERS, 2)), np.zeros(size), np.ones((size, 3))
        for robot, footprint in enumerate(bodies):
            if team.dimension == 3:
                semi_axes[robot] = footprint.semi_axes
                continue
            own, rounding[robot] = footprint.core
            corners[robot, : len(own)], corners[robot, len(own) :] = own, own[-1]
        outer = np.array([footprint.outer_radius for footprint in bodies]).astype(np.float32).astype(np.float64)
        return cls(corners, rounding, semi_axes, outer, semi_axes.max(axis=1) / semi_axes.min(axis=1))

    def take(self, index: Indices) -> ConvexBodies:
        """Some of them, in the order given."""
        return ConvexBodies(
            self.corners[index], self.rounding[index], self.semi_axes[index], self.outer[index], self.stretch[index]
        )

    def placed(self, index: Indices, place: Floats, turn: Floats) -> Floats:
        """``(N, 8, 2)`` corners of bodies at places ``(N, 2)`` turned by ``(N,)``."""
        sine, cosine = (part[:, None] for part in portable.sin_cos(turn))
        x, y = self.corners[index, :, 0], self.corners[index, :, 1]
        return place[:, None] + np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)


class Turning(Watch):
    """A watch over bodies that are no discs."""

    shapes: ConvexBodies

    def between(self, pairs: Indices, poses: Sequence[tuple[Floats, Floats]]) -> Floats:
        """``(N,)`` gap of these pairs, their bodies at places ``(N, d)`` and headings ``(N,)``."""
        raise NotImplementedError

    def gap(self, stretch: Stretch, steps: Indices, pairs: Indices) -> Floats:
        return self._gap_at(stretch, steps, pairs, np.zeros(len(steps), np.intp), np.zeros(len(steps)))

    def _gap_at(self, stretch: Stretch, steps: Indices, pairs: Indices, sub_steps: Indices, share: Floats) -> Floats:
        """``(N,)`` gap of that pair when that share of that sub-step has passed."""
        after = np.minimum(sub_steps + 1, stretch.path.shape[1] - 1)
        poses = []
        for bodies in self.bodies(pairs):
            place = stretch.path[steps, sub_steps, bodies]
            place = place + share[:, None] * (stretch.path[steps, after, bodies] - place)
            turn = stretch.turn[steps, sub_steps, bodies]
            poses.append((place, turn + share * (stretch.turn[steps, after, bodies] - turn)))
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

    def near_gap(self, stretch: Stretch, a: Indices, b: Indices) -> Floats:
        poses = [(stretch.path[0, 0, bodies], stretch.turn[0, 0, bodies]) for bodies in (a, b)]
        return self._between_bodies(a, b, poses)

    def between(self, pairs: Indices, poses: Sequence[tuple[Floats, Floats]]) -> Floats:
        return self._between_bodies(self.rows[pairs], self.columns[pairs], poses)

    def _between_bodies(self, a: Indices, b: Indices, poses: Sequence[tuple[Floats, Floats]]) -> Floats:
        (place, turn), (its_place, its_turn) = poses
        shapes = self.shapes
        if place.shape[1] == 3:
            return ball_gap(its_place - place, shapes.semi_axes[a], shapes.semi_axes[b])
        cores = shapes.placed(a, np.zeros_like(place), turn), shapes.placed(b, its_place - place, its_turn)
        return core_gap(*cores) - shapes.rounding[a] - shapes.rounding[b]


class TurningStatic(Turning, Static):
    """Robots against the obstacles of a world, or its bounds: one column each."""

    def __init__(self, kind: str, robot: Indices, shapes: ConvexBodies, names: Sequence[str]) -> None:
        super().__init__(kind, robot, shapes.outer, names)
        self.shapes = shapes

    def distance(self, places: Floats, columns: Indices) -> Floats:
        raise NotImplementedError("the gap of a footprint is not that of its place")

    pass_by = distance  # type: ignore[assignment]


class Obstacles(TurningStatic):
    """Robots against obstacles, each a convex core with a rounding, or a polygon."""

    def __init__(self, robot: Indices, shapes: ConvexBodies, world: World) -> None:
        super().__init__("obstacle contact", robot, shapes, _names(world))
        self._world = world
        self._round = np.asarray(world.circles if world.dimension == 2 else world.spheres, np.float64)
        self._cylinders, self._boxes = np.asarray(world.cylinders, np.float64), np.asarray(world.boxes, np.float64)

    def between(self, pairs: Indices, poses: Sequence[tuple[Floats, Floats]]) -> Floats:
        ((place, turn),) = poses
        gaps, column, first = np.empty(len(pairs)), self.columns[pairs], 0
        for things, gap in self._kinds():
            here = np.flatnonzero((column >= first) & (column < first + len(things)))
            if len(here):
                gaps[here] = gap(column[here] - first, self.rows[pairs[here]], place[here], turn[here])
            first += len(things)
        return gaps

    def _kinds(self) -> Sequence[tuple[Sequence[object] | Floats, _Gap]]:
        if self._world.dimension == 3:
            return (self._round, self._to_ball), (self._cylinders, self._to_cylinder), (self._boxes, self._to_box)
        return (
            (self._round, self._to_circle), (self._boxes, self._to_rectangle), (self._world.polygons, self._to_polygon),
        )  # fmt: skip

    def _to_circle(self, thing: Indices, body: Indices, place: Floats, turn: Floats) -> Floats:
        core = self.shapes.placed(body, np.zeros_like(place), turn)
        centre = (self._round[thing, :2] - place)[:, None]
        return core_gap(core, centre) - self.shapes.rounding[body] - self._round[thing, 2]

    def _to_rectangle(self, thing: Indices, body: Indices, place: Floats, turn: Floats) -> Floats:
        left, low, right, high = (self._boxes[thing] - np.tile(place, 2)).T
        corners = np.stack([left, low, right, low, right, high, left, high], axis=-1).reshape(-1, 4, 2)
        core = self.shapes.placed(body, np.zeros_like(place), turn)
        return core_gap(core, corners) - self.shapes.rounding[body]

    def _to_polygon(self, thing: Indices, body: Indices, place: Floats, turn: Floats) -> Floats:
        gaps = np.empty(len(thing))
        for polygon in np.unique(thing):
            here = np.flatnonzero(thing == polygon)
            corners = np.asarray(self._world.polygons[polygon], np.float64)
            core, least = self.shapes.placed(body[here], place[here], turn[here]), np.full(len(here), np.inf)
            for begin, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
                edge = np.broadcast_to(np.stack([begin, end]), (len(here), 2, 2))
                least = np.minimum(least, core_gap(core, edge))
            # What lies within it crosses no edge.
            inside = (least > 0) & (polygon_distance(core[:, 0], corners) < 0)
            gaps[here] = np.where(inside, -least, least) - self.shapes.rounding[body[here]]
        return gaps

    def _to_ball(self, thing: Indices, body: Indices, place: Floats, turn: Floats) -> Floats:
        del turn
        return ball_gap(self._round[thing, :3] - place, self.shapes.semi_axes[body], _ball(self._round[thing, 3]))

    def _to_cylinder(self, thing: Indices, body: Indices, place: Floats, turn: Floats) -> Floats:
        del turn
        offset = np.pad(self._cylinders[thing, :2] - place[:, :2], ((0, 0), (0, 1)))
        return ball_gap(offset, self.shapes.semi_axes[body], _ball(self._cylinders[thing, 2]))

    def _to_box(self, thing: Indices, body: Indices, place: Floats, turn: Floats) -> Floats:
        del turn
        offset = np.clip(place, self._boxes[thing, :3], self._boxes[thing, 3:]) - place
        axes = self.shapes.semi_axes[body]
        factor = np.maximum(norm(offset / axes), 1e-6)
        return np.maximum(norm(offset) * (1 - 1 / factor), -axes.min(axis=1))


class Sides(TurningStatic):
    """Robots against the sides of the world."""

    def __init__(self, robot: Indices, shapes: ConvexBodies, lower: Floats, upper: Floats) -> None:
        axes = "xyz"[: len(lower)]
        names = [f"the {side} bound of {axis}" for side in ("lower", "upper") for axis in axes]
        super().__init__("bounds contact", robot, shapes, names)
        self._place, self._dimension = np.concatenate([lower, -upper]), len(lower)

    def between(self, pairs: Indices, poses: Sequence[tuple[Floats, Floats]]) -> Floats:
        ((place, turn),) = poses
        column, body = self.columns[pairs], self.rows[pairs]
        side, axis = np.divmod(column, self._dimension)
        sign = np.where(side == 0, 1.0, -1.0)
        at = sign * place[np.arange(len(axis)), axis] - self._place[column]
        if self._dimension == 3:
            return at - self.shapes.semi_axes[body, axis]
        corners = self.shapes.placed(body, np.zeros_like(place), turn)
        along = np.take_along_axis(corners, axis[:, None, None], axis=2)[..., 0]
        return at + (sign[:, None] * along).min(axis=1) - self.shapes.rounding[body]


def _ball(radius: Floats) -> Floats:
    return np.repeat(radius[:, None], 3, axis=1)


def _names(world: World) -> list[str]:
    kinds = ("circles", "boxes", "polygons") if world.dimension == 2 else ("spheres", "cylinders", "boxes")
    return [f"{kind}[{index}]" for kind in kinds for index in range(len(getattr(world, kind)))]


def turning_watches(world: World, robot: Indices, shapes: ConvexBodies) -> list[Watch]:
    """Return a watch for the obstacles, if there are any, and for the bounds."""
    watches: list[Watch] = [Obstacles(robot, shapes, world)] if world.num_obstacles else []
    if world.lower is not None:
        lower, upper = (np.asarray(bound, np.float64) for bound in (world.lower, world.upper))
        watches.append(Sides(robot, shapes, lower, upper))
    return watches
