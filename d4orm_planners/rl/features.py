"""What a learned policy sees of an observation: the same things, seen from the robot and in its own measure.

A problem that is turned or moved as a whole is the same problem. Vectors are therefore given in a frame whose first
axis points to the goal, and controls that are vectors of the world are turned back. What matters close by is given on
scales that resolve it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.observation import ObservationLayout

TURNED_MODELS = frozenset({"holonomic2d", "holonomic3d", "velocity2d"})
"""Models whose controls are vectors of the world."""

_HORIZON = 5.0
"""Seconds ahead beyond which meetings do not matter."""


@dataclass(frozen=True)
class Features:
    """A map from observations to features, and from a network's actions to controls.

    An observation is laid out as :class:`d4orm_env.core.observation.ObservationLayout` says. Its ``F`` features are
    all of order one: velocity (``d``) in units of the speed limit; heading (2); direction to the goal (``d``); two
    functions of the distance to it; share of the time left; radius; acceleration over speed limit. For each
    neighbour: presence, direction (``d``), two functions of the gap, relative velocity (``d``), and, with velocities
    kept as they are, when the two come closest and how close. For each obstacle: presence, direction (``d``), two
    functions of the gap.

    Attributes:
        dimension: Position dimensions ``d``.
        num_neighbors: Neighbours in an observation.
        num_obstacles: Obstacles in an observation.
        turned: Whether controls are vectors of the world.
    """

    dimension: int
    num_neighbors: int
    num_obstacles: int
    turned: bool

    @classmethod
    def of(cls, layout: ObservationLayout, model: str) -> Features:
        """For an :class:`~d4orm_env.core.observation.ObservationLayout` and the model of the robots."""
        return cls(layout.dimension, layout.num_neighbors, layout.num_obstacles, model in TURNED_MODELS)

    @property
    def observation_size(self) -> int:
        """Components of an observation."""
        d = self.dimension
        return 2 * d + 8 + self.num_neighbors * (2 + 2 * d) + self.num_obstacles * (2 + d)

    @property
    def size(self) -> int:
        """Number of features ``F``."""
        d = self.dimension
        return 2 * d + 7 + self.num_neighbors * (2 * d + 5) + self.num_obstacles * (d + 3)

    def encode(self, observations: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Features of ``N`` robots.

        Args:
            observations: ``(N, D)``.

        Returns:
            Features ``(N, F)``, and frames ``(N, 2)``: cosine and sine of the direction to the goal.
        """
        d, count = self.dimension, len(observations)
        goal = observations[:, d + 3 : 2 * d + 3]
        frame = _unit(goal[:, :2])
        # On the goal itself any direction will do.
        frame[(frame == 0).all(axis=1), 0] = 1
        max_speed = observations[:, 2 * d + 6, None]
        distance = _norm(goal)
        heading = observations[:, d : d + 2]
        parts = [
            _into(frame, observations[:, :d]) / max_speed,
            _into(frame, heading),
            _into(frame, _unit(goal)),
            *_scales(distance),
            observations[:, 2 * d + 3, None],
            observations[:, 2 * d + 5, None],
            observations[:, 2 * d + 7, None] / max_speed,
        ]
        begin = 2 * d + 8
        end = begin + self.num_neighbors * (2 + 2 * d)
        neighbors = observations[:, begin:end].reshape(count, self.num_neighbors, 2 + 2 * d)
        obstacles = observations[:, end:].reshape(count, self.num_obstacles, 2 + d)
        parts.append(self._neighbors(frame, neighbors, observations[:, 2 * d + 5], max_speed).reshape(count, -1))
        parts.append(self._obstacles(frame, obstacles).reshape(count, -1))
        features = np.concatenate(parts, axis=1, dtype=np.float32)
        return features, frame.astype(np.float32)

    def decode(self, actions: FloatArray, frames: FloatArray, limits: FloatArray) -> FloatArray:
        """Controls for a network's actions.

        Args:
            actions: ``(N, m)`` in units of the limits, in the robots' frames.
            frames: ``(N, 2)`` as from :meth:`encode`.
            limits: ``(N, m)`` largest controls.

        Returns:
            ``(N, m)`` controls in physical units, within the limits: as a vector where controls are vectors.
        """
        controls = np.clip(actions, -1, 1) * limits
        if self.turned:
            controls = _out_of(frames, controls * np.minimum(1, limits / np.maximum(_norm(controls), 1e-6)))
        within: FloatArray = np.clip(controls, -limits, limits)
        return within

    def _neighbors(self, frame: FloatArray, seen: FloatArray, radius: FloatArray, max_speed: FloatArray) -> FloatArray:
        d = self.dimension
        present, position, velocity = seen[..., :1], seen[..., 1 : 1 + d], seen[..., 1 + d : 1 + 2 * d]
        reach = radius[:, None, None] + seen[..., 1 + 2 * d :]
        gap = np.maximum(_norm(position) - reach, 0)
        approach = -_dot(position, velocity)
        time = np.clip(approach / np.maximum(_dot(velocity, velocity), 1e-6), 0, _HORIZON)
        miss = np.maximum(_norm(position + time * velocity) - reach, 0)
        parts = [
            np.ones_like(gap),
            _into(frame[:, None], _unit(position)),
            *_scales(gap),
            _into(frame[:, None], velocity) / (2 * max_speed[:, None]),
            time / _HORIZON,
            np.exp(-4 * miss),
        ]
        features: FloatArray = np.concatenate(parts, axis=2) * present
        return features

    def _obstacles(self, frame: FloatArray, seen: FloatArray) -> FloatArray:
        d = self.dimension
        if not seen[..., 0].any():
            return np.zeros((*seen.shape[:2], d + 3), np.float32)
        gap = np.maximum(seen[..., 1 + d :], 0)
        parts = [np.ones_like(gap), _into(frame[:, None], _unit(seen[..., 1 : 1 + d])), *_scales(gap)]
        features: FloatArray = np.concatenate(parts, axis=2) * seen[..., :1]
        return features


def _scales(gap: Any) -> tuple[FloatArray, FloatArray]:
    """Two functions of a distance [m], one that resolves metres and one that resolves centimetres."""
    return 1 / (1 + gap), np.exp(-4 * gap)


def _dot(one: Any, two: Any) -> FloatArray:
    """``(..., 1)`` products of ``(..., d)``; several times quicker than a sum over the short last axis."""
    products: FloatArray = np.einsum("...i,...i->...", one, two)[..., None]
    return products


def _norm(vectors: Any) -> FloatArray:
    """``(..., 1)`` lengths of ``(..., d)``."""
    return np.sqrt(_dot(vectors, vectors))


def _unit(vectors: Any) -> FloatArray:
    """``(..., d)`` of length one; zero stays zero."""
    units: FloatArray = vectors / np.maximum(_norm(vectors), 1e-6)
    return units


def _into(frame: FloatArray, vectors: FloatArray) -> FloatArray:
    """Turn ``(..., d)`` vectors of the world, about the vertical axis, into frames ``(..., 2)``."""
    cos, sin, x, y = frame[..., 0], frame[..., 1], vectors[..., 0], vectors[..., 1]
    turned = vectors.copy()
    turned[..., 0], turned[..., 1] = cos * x + sin * y, cos * y - sin * x
    return turned


def _out_of(frame: FloatArray, vectors: FloatArray) -> FloatArray:
    """The reverse of :func:`_into`."""
    return _into(frame * np.array([1, -1], frame.dtype), vectors)
