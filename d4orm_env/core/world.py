"""The static world: obstacles and bounds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from d4orm_env.core.arrays import LARGEST, FloatArray, frozen_array, restore_frozen


@dataclass(frozen=True, eq=False)
class World:
    """Obstacles and bounds of a planar or spatial world; all numbers are at most 1e6 in magnitude.

    Attributes:
        dimension: 2 or 3.
        circles: ``(., 3)`` centre x, y and radius [m]; planar worlds only.
        spheres: ``(., 4)`` centre x, y, z and radius [m]; spatial worlds only.
        cylinders: ``(., 3)`` axis x, y and radius [m], vertical and unbounded in z; spatial worlds only.
        boxes: ``(., 2 * dimension)`` lower corner, then upper corner [m], axis-aligned.
        lower: ``(dimension,)`` lower bounds of the world [m], or ``None`` for an open world.
        upper: ``(dimension,)`` upper bounds, given together with ``lower``.

    Raises:
        ValueError: For a shape, radius, corner or bound that makes no sense; the message names it.
    """

    dimension: int = 2
    circles: Any = ()
    spheres: Any = ()
    cylinders: Any = ()
    boxes: Any = ()
    lower: Any = None
    upper: Any = None

    def __post_init__(self) -> None:
        if self.dimension not in (2, 3):
            raise ValueError(f"dimension of the world is {self.dimension!r}; it must be 2 or 3")
        for name, width in (("circles", 3), ("spheres", 4), ("cylinders", 3), ("boxes", 2 * self.dimension)):
            rows = frozen_array(getattr(self, name), name, (None, width), largest=LARGEST)
            object.__setattr__(self, name, rows)
        for name, dimension in (("circles", 2), ("spheres", 3), ("cylinders", 3)):
            round_obstacles = getattr(self, name)
            if len(round_obstacles) and self.dimension != dimension:
                raise ValueError(f"{name} need a world of dimension {dimension}, and this one has {self.dimension}")
            for index, radius in enumerate(round_obstacles[:, -1]):
                if radius <= 0:
                    raise ValueError(f"radius of {name}[{index}] is {radius:g}; it must be positive")
        for index, box in enumerate(self.boxes):
            if (box[: self.dimension] >= box[self.dimension :]).any():
                raise ValueError(f"boxes[{index}] is {box.tolist()}; its lower corner must lie below its upper corner")
        if (self.lower is None) != (self.upper is None):
            raise ValueError("bounds need both lower and upper; give both, or neither for an open world")
        if self.lower is not None:
            for name in ("lower", "upper"):
                bound = frozen_array(getattr(self, name), f"bounds {name}", (self.dimension,), largest=LARGEST)
                object.__setattr__(self, name, bound)
            if (self.lower >= self.upper).any():
                raise ValueError(f"bounds lower {self.lower.tolist()} must lie below upper {self.upper.tolist()}")

    def __setstate__(self, state: dict[str, Any]) -> None:
        restore_frozen(self, state)

    @property
    def num_obstacles(self) -> int:
        """Obstacles of all kinds, bounds not counted."""
        return sum(len(kind) for kind in (self.circles, self.spheres, self.cylinders, self.boxes))

    @property
    def balls(self) -> FloatArray:
        """``(., dimension + 1)`` the obstacles that are round in every dimension: circles, or spheres in space."""
        balls: FloatArray = self.circles if self.dimension == 2 else self.spheres
        return balls

    @property
    def bounds(self) -> FloatArray:
        """``(2, dimension)`` lower and upper bounds; infinite in an open world."""
        if self.lower is None:
            return np.array([[-np.inf] * self.dimension, [np.inf] * self.dimension], np.float32)
        return np.stack([self.lower, self.upper])

    def clearance(self, positions: Any) -> np.ndarray:
        """Distance from points to the nearest obstacle surface or bound, negative inside [m], in float64.

        Args:
            positions: ``(..., dimension)``.

        Returns:
            ``(...)`` distances; infinite in an empty open world.
        """
        points = np.asarray(positions, np.float64)
        gaps = [np.full(points.shape[:-1], np.inf)]
        for ball in self.balls.astype(np.float64):
            gaps.append(np.linalg.norm(points - ball[:-1], axis=-1) - ball[-1])
        for cylinder in self.cylinders.astype(np.float64):
            gaps.append(np.linalg.norm(points[..., :2] - cylinder[:2], axis=-1) - cylinder[2])
        for box in self.boxes.astype(np.float64):
            outside = np.maximum(box[: self.dimension] - points, points - box[self.dimension :])
            gaps.append(np.linalg.norm(np.maximum(outside, 0), axis=-1) + np.minimum(outside.max(axis=-1), 0))
        bounds = self.bounds.astype(np.float64)
        gaps.append(np.minimum(points - bounds[0], bounds[1] - points).min(axis=-1))
        return np.min(gaps, axis=0)
