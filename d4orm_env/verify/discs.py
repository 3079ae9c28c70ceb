"""Discs and balls against the obstacles of a world, kind by kind, and its bounds."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from d4orm_env.verify.contact import StaticDiscs, Watch, side_names
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


class Round(StaticDiscs):
    """Robots against circles, spheres or vertical cylinders."""

    def __init__(self, robot: Indices, radius: Floats, obstacles: Floats, shape: str) -> None:
        super().__init__("obstacle contact", robot, radius, [f"{shape}[{index}]" for index in range(len(obstacles))])
        self._centres, self._sizes = obstacles[:, :-1], obstacles[:, -1]

    def distance(self, positions: Floats, columns: Indices) -> Floats:
        return norm(self._offset(positions, columns)) - self._sizes[columns]

    def pass_by(self, start: Floats, end: Floats, columns: Indices) -> tuple[Floats, Floats]:
        distance, fraction = closest_approach(self._offset(start, columns), self._offset(end, columns))
        return distance - self._sizes[columns], fraction

    def _offset(self, positions: Floats, columns: Indices) -> Floats:
        # A cylinder is a circle seen from above.
        return positions[..., : self._centres.shape[1]] - self._centres[columns]


class Boxes(StaticDiscs):
    """Robots against axis-aligned boxes."""

    def __init__(self, robot: Indices, radius: Floats, boxes: Floats) -> None:
        super().__init__("obstacle contact", robot, radius, [f"boxes[{index}]" for index in range(len(boxes))])
        self._boxes = boxes

    def distance(self, positions: Floats, columns: Indices) -> Floats:
        return box_distance(positions, self._boxes[columns])

    def pass_by(self, start: Floats, end: Floats, columns: Indices) -> tuple[Floats, Floats]:
        return box_approach(start, end, self._boxes[columns])


class PolygonObstacle(StaticDiscs):
    """Robots against one polygon."""

    def __init__(self, robot: Indices, radius: Floats, corners: Floats, name: str) -> None:
        super().__init__("obstacle contact", robot, radius, [name])
        self._corners = corners

    def distance(self, positions: Floats, columns: Indices) -> Floats:
        return polygon_distance(positions, self._corners)

    def pass_by(self, start: Floats, end: Floats, columns: Indices) -> tuple[Floats, Floats]:
        return polygon_approach(start, end, self._corners)


class Bounds(StaticDiscs):
    """Robots against the sides of the world."""

    def __init__(self, robot: Indices, radius: Floats, lower: Floats, upper: Floats) -> None:
        super().__init__("bounds contact", robot, radius, side_names(len(lower)))
        self._axis, self._sign = np.tile(np.arange(len(lower)), 2), np.repeat([1.0, -1.0], len(lower))
        self._position = np.concatenate([lower, -upper])

    def distance(self, positions: Floats, columns: Indices) -> Floats:
        axis = np.broadcast_to(self._axis[columns], positions.shape[:-1])
        value = np.take_along_axis(positions, axis[..., None], axis=-1)[..., 0]
        return self._sign[columns] * value - self._position[columns]

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
