"""Disturbances of what is seen: of observations and of ``env.state()`` alike, as by one tracking system for all. The
truth stays in infos, rewards and metrics.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np

from d4orm_env.core.arrays import LARGEST, FloatArray, positive_number, whole_number
from d4orm_env.core.observation_layout import BoundsSlack, ObservationLayout
from d4orm_env.core.problem import Problem
from d4orm_env.disturbances.disturbance import (
    MAX_DELAY,
    Disturbance,
    Memory,
    Observed,
    Scene,
    level,
    standard_deviation,
    unless,
)
from d4orm_env.disturbances.draws import Draws

_FARTHEST = 6.0
"""No normal that is drawn lies so many standard deviations from zero."""


class Scales(NamedTuple):
    """Standard deviations of what is seen of robots ``(B, K, n)``, and of bodies ``(B, N, 2 d + 1)``."""

    states: FloatArray
    bodies: FloatArray


@dataclass(frozen=True)
class StateNoise(Disturbance[Scales]):
    """Gaussian noise on what is measured of the robots, independent over steps, robots and components.

    Bodies that are no robots are measured likewise. What the model of a robot has no state for is not measured but
    known from its controls, as the velocity of ``velocity2d``.
    """

    position_std: float = level(standard_deviation)  #: Standard deviation of positions, per axis [m]
    #: Of velocities per axis, or of the speed where the model has only that [m/s]
    velocity_std: float = level(standard_deviation, 0.0)
    heading_std: float = level(standard_deviation, 0.0)  #: Of headings [rad]

    @property
    def negligible(self) -> bool:
        return not (self.position_std or self.velocity_std or self.heading_std)

    def check(self, problem: Problem) -> None:
        models, names = problem.team.robot_models, ", ".join(sorted(set(problem.team.models)))
        held = {
            "velocity": (self.velocity_std, any(model.speed_indices for model in models)),
            "heading": (self.heading_std, any(model.heading_index is not None for model in models)),
        }
        for what, (std, is_held) in held.items():
            if std and not is_held:
                raise ValueError(
                    f"StateNoise {what}_std is {std:g}, and no state of {names} holds a {what}; leave it out, or use a "
                    "model that has one"
                )

    def slack(self, problem: Problem) -> BoundsSlack:
        return BoundsSlack(*(_FARTHEST * std for std in (self.position_std, self.velocity_std, self.heading_std)))

    def begin(self, scene: Scene, draws: Draws) -> Scales:
        scales, d = Scales(np.zeros_like(scene.states), np.zeros_like(scene.bodies)), scene.problem.dimension
        scales.states[..., :d] = scales.bodies[..., :d] = self.position_std
        scales.bodies[..., d : 2 * d] = self.velocity_std
        for robot, model in enumerate(scene.problem.team.robot_models):
            scales.states[:, robot, list(model.speed_indices)] = self.velocity_std
            if model.heading_index is not None:
                scales.states[:, robot, model.heading_index] = self.heading_std
        return scales

    def see(self, seen: Observed, memory: Scales, scene: Scene, draws: Draws) -> Observed:
        states, bodies = draws.normal(*seen.states.shape[1:]), seen.bodies
        states *= memory.states
        states += seen.states
        if bodies.shape[1]:
            bodies = bodies + memory.bodies * draws.normal(*bodies.shape[1:])
        return Observed(states, seen.controls, bodies)


class Past(NamedTuple):
    """Last measurements, in rings ``(B, L, ...)``; moment ``t`` has position ``t mod L``."""

    states: FloatArray
    controls: FloatArray
    bodies: FloatArray


@dataclass(frozen=True)
class StateDelay(Disturbance[Past]):
    """Delay of measurements: states, and the controls executed last. Goals, who has arrived and the clock are known at
    once. Until the first measurement has come everything is seen as it began.
    """

    steps: int = level(partial(whole_number, minimum=0, maximum=MAX_DELAY), off=0)  #: Time steps, at most 1000

    def begin(self, scene: Scene, draws: Draws) -> Past:
        parts, length = (scene.states, scene.controls, scene.bodies), self.steps + 1
        return Past(*(np.zeros((len(part), length, *part.shape[1:]), np.float32) for part in parts))

    def see(self, seen: Observed, memory: Past, scene: Scene, draws: Draws) -> Observed:
        worlds, length = np.arange(len(scene.steps)), self.steps + 1
        for past, present in zip(memory, seen):
            past[worlds, scene.steps % length] = present
        # What is older than the episode stands where its first moment was written.
        then = np.maximum(scene.steps - self.steps, 0) % length
        return Observed(*(past[worlds, then] for past in memory))


@dataclass(frozen=True)
class Occlusion(Disturbance[Memory]):
    """Sensors that do not reach far: a robot observes neither robots, bodies nor obstacles beyond their range.

    Robots tell each other where they are, so that ``env.state()`` lacks only the bodies that no robot has in range.
    """

    #: Distance of centres, for obstacles of the centre from their surface [m]
    range: float = level(unless(math.inf, partial(positive_number, most=LARGEST)), math.inf, off=math.inf)

    def see(self, seen: Observed, memory: Memory, scene: Scene, draws: Draws) -> Observed:
        if not seen.bodies.shape[1]:
            return seen
        d = scene.problem.dimension
        gaps = seen.bodies[:, :, None, :d] - seen.states[:, None, :, :d]
        hidden = ((gaps * gaps).sum(axis=-1) > self.range**2).all(axis=-1)
        return seen._replace(bodies=np.where(hidden[..., None], np.float32(0), seen.bodies))

    def observe(self, observations: FloatArray, layout: ObservationLayout, draws: Draws) -> FloatArray:
        observations = observations.copy()
        rays = observations[..., layout.rays]
        np.copyto(rays, layout.high[layout.rays], where=rays > self.range)
        for rows, parts in (
            (layout.neighbors(observations), layout.neighbor),
            (layout.obstacles(observations), layout.obstacle),
        ):
            offsets = rows[..., parts.position]
            rows *= (offsets * offsets).sum(axis=-1, keepdims=True) <= self.range**2
        return observations


@dataclass(frozen=True)
class RayNoise(Disturbance[Memory]):
    """Gaussian noise on what range sensors measure, independent over steps, robots and rays.

    A ray that meets nothing reads the range as it is.
    """

    std: float = level(standard_deviation, off=0)  #: Standard deviation [m]

    def observe(self, observations: FloatArray, layout: ObservationLayout, draws: Draws) -> FloatArray:
        rays = observations[..., layout.rays]
        noise = np.float32(self.std) * draws.normal(*rays.shape[1:])
        observations = observations.copy()
        observations[..., layout.rays] = np.where(rays < layout.high[layout.rays], rays + noise, rays)
        return observations
