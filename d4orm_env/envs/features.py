"""Features of an observation: the same quantities, in the robot's own frame and units.

A problem that is turned or moved as a whole is the same problem. Vectors are therefore given in a frame of the robot's
own: its first axis points to the goal where controls are vectors of the world, which are turned back, and forward where
a robot turns. What matters close by is given on scales that resolve it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.observation_layout import ObservationLayout, ObservationSlices
from d4orm_env.core.team import Team
from d4orm_env.dynamics.models import get_model
from d4orm_env.paths.shortest_paths import along_paths

ArrayOrTensor: TypeAlias = Any
"""An array of NumPy or JAX, or a tensor of torch."""

Frame: TypeAlias = Literal["goal", "heading"]

_HORIZON = 5.0
"""Seconds ahead beyond which meetings do not matter."""


@dataclass(frozen=True)
class Features:
    """A map from observations to features, and from a network's actions to controls.

    The ``F`` features of an observation are all of order one: velocity (``d``) in units of the speed limit; heading
    (2); direction to the goal (``d``); two functions of the distance to it; share of the time left; radius;
    acceleration over speed limit; goal heading and hitch angles (2 each), where observations have them; two
    functions of the gap along each ray, from the frame's first axis on. For each neighbour: presence, direction
    (``d``), two functions of the gap, relative velocity (``d``), and, with velocities kept as they are, when the two
    come closest and how close. For each obstacle: presence, direction (``d``), two functions of the gap.
    """

    slices: ObservationSlices  #: Slices of an observation
    turned: bool  #: Whether controls are vectors of the world
    #: ``"goal"`` or ``"heading"``: where the first axis of a robot's frame points; with rays and without a heading
    #: along the ray nearest to the goal, so that rays of one frame are those of any other
    frame: Frame = "goal"

    @classmethod
    def of(cls, slices: ObservationSlices, model: str) -> Features:
        """Make features for the observations of robots of a model."""
        kind = get_model(model)
        if kind.heading_index is not None:
            return cls(slices, False, "heading")
        # A limit that all components of the control share bounds its norm: it is a vector of the world.
        return cls(slices, kind.control_size == kind.dimension and len(set(kind.control_limits)) == 1)

    @classmethod
    def of_team(cls, slices: ObservationSlices, team: Team) -> Features:
        """The same for a team.

        Raises:
            ValueError: If it mixes models.
        """
        if len(models := set(team.models)) > 1:
            raise ValueError(
                f"the team mixes {', '.join(sorted(models))}, which act in different frames; give model=, or leave "
                "egocentric out"
            )
        return cls.of(slices, team.models[0])

    @property
    def size(self) -> int:
        """Number of features ``F``."""
        slices = self.slices
        return self.own_size + slices.num_neighbors * self.neighbor_size + slices.num_obstacles * self.obstacle_size

    def bound(self, layout: ObservationLayout, team: Team) -> FloatArray:
        """``(F,)`` magnitude that no feature exceeds: turned, a component may be as large as its vector."""
        own, slowest = self.slices.own, team.max_speed.min()
        motion = np.concatenate([layout.high[own.velocity], layout.high[own.max_acceleration]]).max() / slowest
        largest = max(1.0, float(motion), float(layout.high[own.radius][0]))
        return np.full(self.size, 2 * largest, np.float32)

    @property
    def own_size(self) -> int:
        """Number of those of the robot itself and of its rays, which come first."""
        return 2 * self.slices.dimension + 7 + 2 * self.slices.goal_headings + 2 * self.slices.num_rays

    @property
    def neighbor_size(self) -> int:
        """Number of those of each neighbour, presence first."""
        return 2 * self.slices.dimension + 5

    @property
    def obstacle_size(self) -> int:
        """Number of those of each obstacle, likewise."""
        return self.slices.dimension + 3

    def parts(self, features: ArrayOrTensor) -> tuple[ArrayOrTensor, ArrayOrTensor, ArrayOrTensor]:
        """Features ``(N, F)`` of the robot ``(N, .)``, of its neighbours and of obstacles ``(N, rows, .)``."""
        own, slices, count = self.own_size, self.slices, len(features)
        end = own + slices.num_neighbors * self.neighbor_size
        neighbors = features[:, own:end].reshape(count, slices.num_neighbors, self.neighbor_size)
        obstacles = features[:, end:].reshape(count, slices.num_obstacles, self.obstacle_size)
        return features[:, :own], neighbors, obstacles

    def of_size(self, size: int) -> Features:
        """The same with as many neighbours as ``size`` features have.

        Raises:
            ValueError: If no number of neighbours has so many.
        """
        rows, rest = divmod(size - self.size, self.neighbor_size)
        number = self.slices.num_neighbors + rows
        if rest or number < 0:
            raise ValueError(f"{size} features are not those of any number of neighbours")
        return replace(self, slices=replace(self.slices, num_neighbors=number))

    def of_observation_size(self, size: int) -> Features | None:
        """The same with as many neighbours as observations of ``size`` numbers have; ``None`` if none does."""
        rows, rest = divmod(size - self.slices.size, self.slices.neighbor[-1].stop)
        number = self.slices.num_neighbors + rows
        return None if rest or number < 0 else replace(self, slices=replace(self.slices, num_neighbors=number))

    def along(self, observations: FloatArray, direction: NDArray[np.floating], length: NDArray[np.floating]) -> None:
        """Put the goals where the shortest paths seem to lead, as far off as these are long.

        Among walls the goal itself is a poor guide; without obstacles nothing changes. Robots at their goals and those
        without a path see their goals. Changed are ``observations`` ``(N, D)``; paths have unit vectors ``direction``
        ``(N, d)`` and a ``length`` ``(N,)`` [m].
        """
        ahead, known = along_paths(direction, length)
        observations[known, self.slices.own.goal] = ahead[known]

    def encode(self, observations: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Features ``(N, F)`` of observations ``(N, D)``, and frames ``(N, 2)``: cosine and sine of the direction of
        their first axis.
        """
        own, count = self.slices.own, len(observations)
        goal, max_speed = observations[:, own.goal], observations[:, own.max_speed]
        frame = _unit(goal[:, :2] if self.frame == "goal" else observations[:, own.heading])
        # On the goal itself any direction will do.
        xp = namespace(observations)
        frame = xp.where((frame == 0).all(axis=1)[:, None], xp.asarray([[1, 0]], np.float32), frame)
        rays = observations[:, self.slices.rays]
        if self.frame == "goal" and self.slices.num_rays:
            frame, rays = self._along_rays(frame, rays)
        parts = [
            _into(frame, observations[:, own.velocity]) / max_speed,
            _into(frame, observations[:, own.heading]),
            _into(frame, _unit(goal)),
            *_scales(_norm(goal)),
            observations[:, own.time_left],
            observations[:, own.radius],
            observations[:, own.max_acceleration] / max_speed,
            observations[:, own.goal_heading.start : own.goal_hitches.stop],
            *_scales(xp.maximum(rays - observations[:, own.radius], 0)),
            self._neighbors(frame, observations).reshape(count, -1),
            self._obstacles(frame, observations).reshape(count, -1),
        ]
        features = xp.concatenate(parts, axis=1, dtype=np.float32)
        return features, frame.astype(np.float32)

    def decode(self, actions: FloatArray, frames: FloatArray, limits: FloatArray) -> FloatArray:
        """``(..., m)`` controls in physical units, within the limits: as a vector where controls are vectors.

        A network's ``actions`` ``(..., m)`` are in units of the ``limits`` ``(..., m)``, in ``frames`` ``(..., 2)`` as
        from :meth:`encode`.
        """
        xp = namespace(actions)
        controls = xp.clip(actions, -1, 1) * limits
        if self.turned:
            controls = _out_of(frames, controls * xp.minimum(1, limits / xp.maximum(_norm(controls), 1e-6)))
        within: FloatArray = xp.clip(controls, -limits, limits)
        return within

    def actions(self, controls: FloatArray, frames: FloatArray, limits: FloatArray) -> FloatArray:
        """``(N, m)`` actions in ``[-1, 1]`` for which :meth:`decode` gives ``controls`` ``(N, m)``, clipped to the
        limits; its other arguments.
        """
        if self.turned:
            within = controls * np.minimum(1, limits / np.maximum(_norm(controls), 1e-6))
            controls = _into(frames, within.astype(np.float32))
        actions: FloatArray = np.clip(controls / limits, -1, 1)
        return actions

    def _along_rays(self, frame: FloatArray, rays: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Frames ``(N, 2)`` turned to the nearest rays, and rays ``(N, R)`` from these on, counter-clockwise."""
        xp, directions = namespace(frame), self.slices.ray_directions
        first = (frame @ directions.T).argmax(axis=1)
        order = (first[:, None] + xp.arange(len(directions))[None]) % len(directions)
        return xp.asarray(directions)[first], xp.take_along_axis(rays, order, axis=1)

    def _neighbors(self, frame: FloatArray, observations: FloatArray) -> FloatArray:
        own, part, seen = self.slices.own, self.slices.neighbor, self.slices.neighbors(observations)
        xp = namespace(observations)
        max_speed = observations[:, own.max_speed]
        position, velocity = seen[..., part.position], seen[..., part.velocity]
        radius_sum = observations[:, None, own.radius] + seen[..., part.radius]
        gap = xp.maximum(_norm(position) - radius_sum, 0)
        approach = -_dot(position, velocity)
        time = xp.clip(approach / xp.maximum(_dot(velocity, velocity), 1e-6), 0, _HORIZON)
        miss = xp.maximum(_norm(position + time * velocity) - radius_sum, 0)
        parts = [
            xp.ones_like(gap),
            _into(frame[:, None], _unit(position)),
            *_scales(gap),
            _into(frame[:, None], velocity) / (2 * max_speed[:, None]),
            time / _HORIZON,
            xp.exp(-4 * miss),
        ]
        features: FloatArray = xp.concatenate(parts, axis=2) * seen[..., part.present]
        return features

    def _obstacles(self, frame: FloatArray, observations: FloatArray) -> FloatArray:
        part, seen = self.slices.obstacle, self.slices.obstacles(observations)
        xp, present = namespace(observations), seen[..., part.present]
        if xp is np and not present.any():
            return np.zeros((*seen.shape[:2], self.slices.dimension + 3), np.float32)
        gap = xp.maximum(seen[..., part.gap], 0)
        parts = [xp.ones_like(gap), _into(frame[:, None], _unit(seen[..., part.position])), *_scales(gap)]
        features: FloatArray = xp.concatenate(parts, axis=2) * present
        return features


def namespace(array: ArrayOrTensor) -> Any:
    """The functions for an array: NumPy's, or JAX's where it is one of those."""
    return np if isinstance(array, np.ndarray) else array.__array_namespace__()


def _scales(gap: NDArray[np.floating]) -> tuple[FloatArray, FloatArray]:
    """Two functions of a distance [m], one that resolves metres and one that resolves centimetres."""
    xp = namespace(gap)
    return xp.divide(1, 1 + gap), xp.exp(-4 * gap)


def _dot(one: NDArray[np.floating], two: NDArray[np.floating]) -> FloatArray:
    """``(..., 1)`` products of ``(..., d)``; several times quicker than a sum over the short last axis."""
    products: FloatArray = namespace(one).einsum("...i,...i->...", one, two)[..., None]
    return products


def _norm(vectors: NDArray[np.floating]) -> FloatArray:
    """``(..., 1)`` lengths of ``(..., d)``."""
    length: FloatArray = namespace(vectors).sqrt(_dot(vectors, vectors))
    return length


def _unit(vectors: NDArray[np.floating]) -> FloatArray:
    """``(..., d)`` of length one; zero stays zero."""
    xp = namespace(vectors)
    unit: FloatArray = xp.divide(vectors, xp.maximum(_norm(vectors), 1e-6))
    return unit


def _into(frame: FloatArray, vectors: FloatArray) -> FloatArray:
    """Turn ``(..., d)`` vectors of the world, about the vertical axis, into frames ``(..., 2)``."""
    cos, sin, x, y = frame[..., 0], frame[..., 1], vectors[..., 0], vectors[..., 1]
    ahead, left = cos * x + sin * y, cos * y - sin * x
    if not isinstance(vectors, np.ndarray):
        xp = namespace(vectors)
        turned: FloatArray = xp.concatenate([xp.stack([ahead, left], axis=-1), vectors[..., 2:]], axis=-1)
        return turned
    turned = vectors.copy()  # several times quicker than stacking
    turned[..., 0], turned[..., 1] = ahead, left
    return turned


def _out_of(frame: FloatArray, vectors: FloatArray) -> FloatArray:
    """The reverse of :func:`_into`."""
    return _into(namespace(frame).concatenate([frame[..., :1], -frame[..., 1:]], axis=-1), vectors)
