"""Discs and balls against the obstacles of a world, kind by kind, and against its bounds."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from d4orm_env.verify.contact import Indices, Static, Watch
from d4orm_env.verify.geometry import (
    Floats,
    box_approach,
    box_distance,
    closest_approach,
    norm,
    polygon_approach,
    polygon_distance,
)

if TYPE_CHECKING:
    from d4orm_env.core.world import World


class Round(Static):
    """Robots against circles, spheres or vertical cylinders."""

    def __init__(self, robot: Indices, radius: Floats, obstacles: Floats, shape: str) -> None:
        super().__init__("obstacle contact", robot, radius, [f"{shape}[{index}]" for index in range(len(obstacles))])
        self._centres, self._sizes = obstacles[:, :-1], obstacles[:, -1]

    def distance(self, places: Floats, columns: Indices) -> Floats:
        return norm(self._offset(places, columns)) - self._sizes[columns]

    def pass_by(self, start: Floats, end: Floats, columns: Indices) -> tuple[Floats, Floats]:
        distance, fraction = closest_approach(self._offset(start, columns), self._offset(end, columns))
        return distance - self._sizes[columns], fraction

    def _offset(self, places: Floats, columns: Indices) -> Floats:
        # A cylinder is a circle seen from above.
        return places[..., : self._centres.shape[1]] - self._centres[columns]


class Boxes(Static):
    """Robots against axis-aligned boxes."""

    def __init__(self, robot: Indices, radius: Floats, boxes: Floats) -> None:
        super().__init__("obstacle contact", robot, radius, [f"boxes[{index}]" for index in range(len(boxes))])
        self._boxes = boxes

    def distance(self, places: Floats, columns: Indices) -> Floats:
        return box_distance(places, self._boxes[columns])

    def pass_by(self, start: Floats, end: Floats, columns: Indices) -> tuple[Floats, Floats]:
        return box_approach(start, end, self._boxes[columns])


class PolygonObstacle(Static):
    """Robots against one polygon."""

    def __init__(self, robot: Indices, radius: Floats, corners: Floats, name: str) -> None:
        super().__init__("obstacle contact", robot, radius, [name])
        self._corners = corners

    def distance(self, places: Floats, columns: Indices) -> Floats:
        return polygon_distance(places, self._corners)

    def pass_by(self, start: Floats, end: Floats, columns: Indices) -> tuple[Floats, Floats]:
        return polygon_approach(start, end, self._corners)


class Bounds(Static):
    """Robots against the sides of the world."""

    def __init__(self, robot: Indices, radius: Floats, lower: Floats, upper: Floats) -> None:
        axes = "xyz"[: len(lower)]
        names = [f"the {side} bound of {axis}" for side in ("lower", "upper") for axis in axes]
        super().__init__("bounds contact", robot, radius, names)
        self._axis, self._sign = np.tile(np.arange(len(lower)), 2), np.repeat([1.0, -1.0], len(lower))
        self._place = np.concatenate([lower, -upper])

    def distance(self, places: Floats, columns: Indices) -> Floats:
        axis = np.broadcast_to(self._axis[columns], places.shape[:-1])
        value = np.take_along_axis(places, axis[..., None], axis=-1)[..., 0]
        return self._sign[columns] * value - self._place[columns]

    def pass_by(self, start: Floats, end: Floats, columns: Indices) -> tuple[Floats, Floats]:
        before, after = self.distance(start, columns), self.distance(end, columns)
        return np.minimum(before, after), (after < before).astype(np.float64)


def surroundings(world: World, robot: Indices, radius: Floats) -> list[Watch]:
    """Return a watch for each kind of obstacle there is, and for the bounds."""
    watches: list[Watch] = []
    for shape in ("circles", "spheres", "cylinders"):
        obstacles = np.asarray(getattr(world, shape), np.float64)
        if len(obstacles):
            watches.append(Round(robot, radius, obstacles, shape))
    if len(world.boxes):
        watches.append(Boxes(robot, radius, np.asarray(world.boxes, np.float64)))
    for index, corners in enumerate(world.polygons):
        watches.append(PolygonObstacle(robot, radius, np.asarray(corners, np.float64), f"polygons[{index}]"))
    if world.lower is not None:
        lower, upper = (np.asarray(bound, np.float64) for bound in (world.lower, world.upper))
        watches.append(Bounds(robot, radius, lower, upper))
    return watches
