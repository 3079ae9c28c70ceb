"""Everything that stands still in a world, obstacles kind by kind and bounds, and discs and balls against it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from d4orm_env.verify.contact import Stretch, Watch
from d4orm_env.verify.geometry import (
    Floats,
    Indices,
    box_approach,
    box_distance,
    closest_approach,
    norm,
    polygon_approach,
    polygon_distance,
)

if TYPE_CHECKING:
    from d4orm_env.core.world import World


class Things(NamedTuple):
    """Obstacles of a kind, or the sides of a world, by number."""

    names: list[str]
    #: Signed distance from positions ``(..., d)`` to the surfaces of the things of these numbers [m]
    distance: Callable[[Floats, Indices], Floats]
    #: The smallest on the chords from these positions to those, and at what fraction of them
    pass_by: Callable[[Floats, Floats, Indices], tuple[Floats, Floats]]


def obstacles(world: World) -> Iterator[tuple[str, Floats, Things]]:
    """Yield each kind of obstacle there is, and each polygon by itself, with its table or its corners."""
    for kind, things in (("circles", _round), ("spheres", _round), ("cylinders", _round), ("boxes", _boxes)):
        if len(table := np.asarray(getattr(world, kind), np.float64)):
            yield kind, table, things([f"{kind}[{index}]" for index in range(len(table))], table)
    for index, polygon in enumerate(world.polygons):
        corners = np.asarray(polygon, np.float64)
        yield "polygons", corners, _polygon([f"polygons[{index}]"], corners)


def _round(names: list[str], table: Floats) -> Things:
    centres, sizes = table[:, :-1], table[:, -1]

    def offset(positions: Floats, columns: Indices) -> Floats:
        # A cylinder is a circle seen from above.
        return positions[..., : centres.shape[1]] - centres[columns]

    def pass_by(start: Floats, end: Floats, columns: Indices) -> tuple[Floats, Floats]:
        distance, fraction = closest_approach(offset(start, columns), offset(end, columns))
        return distance - sizes[columns], fraction

    return Things(names, lambda positions, columns: norm(offset(positions, columns)) - sizes[columns], pass_by)


def _boxes(names: list[str], table: Floats) -> Things:
    return Things(
        names,
        lambda positions, columns: box_distance(positions, table[columns]),
        lambda start, end, columns: box_approach(start, end, table[columns]),
    )


def _polygon(names: list[str], corners: Floats) -> Things:
    return Things(
        names,
        lambda positions, columns: polygon_distance(positions, corners),
        lambda start, end, columns: polygon_approach(start, end, corners),
    )


def sides(world: World) -> Things:
    """The sides of a world with bounds, the lower ones first."""
    d, (lower, upper) = world.dimension, world.bounds.astype(np.float64)
    ends = np.concatenate([lower, -upper])

    def distance(positions: Floats, columns: Indices) -> Floats:
        axis = np.broadcast_to(columns % d, positions.shape[:-1])
        value = np.take_along_axis(positions, axis[..., None], axis=-1)[..., 0]
        return np.where(columns < d, value, -value) - ends[columns]

    def pass_by(start: Floats, end: Floats, columns: Indices) -> tuple[Floats, Floats]:
        before, after = distance(start, columns), distance(end, columns)
        return np.minimum(before, after), (after < before).astype(np.float64)

    return Things(
        [f"the {side} bound of {axis}" for side in ("lower", "upper") for axis in "xyz"[:d]], distance, pass_by
    )


class Static(Watch):
    """Robots against things that stand still, one column each."""

    def __init__(self, kind: str, robot: Indices, names: Sequence[str]) -> None:
        rows, columns = (index.ravel() for index in np.indices((len(robot), len(names))))
        super().__init__(kind, robot, names, rows, columns)

    def bodies(self, pairs: Indices) -> Sequence[Indices]:
        return (self.rows[pairs],)

    def thing(self, column: Indices) -> Indices:
        return column


class StaticDiscs(Static):
    """The same of discs or balls."""

    def __init__(self, kind: str, robot: Indices, radius: Floats, things: Things) -> None:
        super().__init__(kind, robot, things.names)
        self._radius, self._things = radius[self.rows], things

    def gap(self, stretch: Stretch, steps: Indices, pairs: Indices, lead: Floats) -> Floats:
        distance = self._things.distance(stretch.path[steps, 0, self.rows[pairs]], self.columns[pairs])
        return distance - self._radius[pairs]

    def approach(self, stretch: Stretch, steps: Indices, pairs: Indices) -> tuple[Floats, Floats]:
        path = stretch.of(steps, self.rows[pairs])
        distance, fraction = self._things.pass_by(path[:, :-1], path[:, 1:], self.columns[pairs][:, None])
        return distance - self._radius[pairs][:, None], fraction


def surroundings(world: World, robot: Indices, radius: Floats) -> list[Watch]:
    """Return a watch for each kind of obstacle there is, and for the bounds."""
    watches: list[Watch] = [StaticDiscs("obstacle contact", robot, radius, own) for _, _, own in obstacles(world)]
    if world.lower is not None:
        watches.append(StaticDiscs("bounds contact", robot, radius, sides(world)))
    return watches
