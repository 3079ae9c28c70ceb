"""Dynamic obstacles that drive through the team without regard for it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from d4orm_env.core.arrays import LARGEST, FloatArray, positive_number, whole_number
from d4orm_env.core.observation_layout import BoundsSlack
from d4orm_env.core.problem import Problem
from d4orm_env.disturbances.disturbance import Disturbance, DisturbanceEffect, Scene
from d4orm_env.disturbances.draws import Draws
from d4orm_env.disturbances.levels import standard_deviation

MAX_INTRUDERS = 100
_TRIES = 16


class Courses(NamedTuple):
    """Bodies ``(B, N, 2 d + 1)``, as in :class:`~d4orm_env.disturbances.Observed`, and how long ``(B, N)`` each still
    takes to leave the area [s].
    """

    bodies: FloatArray
    time: FloatArray


@dataclass(frozen=True)
class Intruder(Disturbance[Courses]):
    """Bodies, discs or balls, that cross the team's area on straight lines at constant speed, one after another.

    Robots see them as they see robots, and ``env.state()`` ends with them, see :mod:`d4orm_env.envs.joint_state`.
    Touching one is a collision, and the paper's reward of a robot within the margin of one is 1 less.

    The area is the ball round all starts and goals, and there are always ``count`` of them in it: one that has left
    enters anew somewhere else, and at first they are anywhere on their lines. Obstacles and walls do not stop them. A
    line passes through a random point between starts and goals in a random direction, but not where it would meet
    robots at rest at their starts or goals, for these cannot yield; if sixteen tries find no such line, it is the one
    that stays farthest from them.

    Attributes:
        count: Number of them, at most 100.
        speed: [m/s].
        radius: [m].
    """

    count: int = 1
    speed: float = 0.5
    radius: float = 0.15

    def __post_init__(self) -> None:
        object.__setattr__(self, "count", whole_number(self.count, "Intruder count", 0, MAX_INTRUDERS))
        object.__setattr__(self, "speed", standard_deviation(self.speed, "Intruder speed"))
        object.__setattr__(self, "radius", positive_number(self.radius, "Intruder radius", least=1e-3, most=LARGEST))

    @property
    def negligible(self) -> bool:
        return self.count == 0

    @property
    def replayable(self) -> bool:
        return True  # it changes neither states nor controls

    def slack(self, problem: Problem) -> BoundsSlack:
        faster = max(0.0, self.speed - float(problem.team.max_speed.max()))
        return BoundsSlack(distance=2 * self._room(problem) + self.speed * problem.dt, speed=faster, radius=self.radius)

    def _room(self, problem: Problem) -> float:
        """Return the distance that keeps an intruder clear of any robot [m]."""
        return self.radius + float(problem.team.radius.max()) + 2 * problem.margin

    def begin(self, scene: Scene, draws: Draws) -> Courses:
        bodies, time = self._courses(scene, draws)
        gone, d = time * draws.uniform(self.count), scene.problem.dimension
        bodies[..., :d] += gone[..., None] * bodies[..., d : 2 * d]
        return Courses(bodies, time - gone)

    def move(
        self, states: FloatArray, controls: FloatArray, memory: Courses, scene: Scene, draws: Draws
    ) -> tuple[FloatArray, FloatArray]:
        d, dt = scene.problem.dimension, np.float32(scene.problem.dt)
        memory.bodies[..., :d] += dt * memory.bodies[..., d : 2 * d]
        memory.time[:] -= dt
        out = memory.time < 0
        if out.any():
            worlds = np.flatnonzero(out.any(axis=1))
            left = out[worlds]
            for past, fresh in zip(memory, self._courses(scene.of(worlds), draws.of(worlds))):
                past[out] = fresh[left]
        return states, controls

    def effect(self, memory: Courses, scene: Scene) -> DisturbanceEffect:
        return DisturbanceEffect(bodies=memory.bodies)

    def _courses(self, scene: Scene, draws: Draws) -> Courses:
        """New lines for all worlds, their bodies at the beginning."""
        d, room = scene.problem.dimension, np.float32(self._room(scene.problem))
        stands = np.concatenate([scene.start[..., :d], scene.goal], axis=1)
        low, high = stands.min(axis=1), stands.max(axis=1)
        centre, half = (low + high) / 2, (high - low) / 2
        reach = np.sqrt((half * half).sum(axis=-1)) + room
        heading = draws.direction(self.count, _TRIES, d)
        through = low[:, None, None] + (high - low)[:, None, None] * draws.uniform(self.count, _TRIES, d)
        gaps = _distances(stands[:, None, None], through[..., None, :], heading[..., None, :]).min(axis=-1)
        best = np.minimum(gaps, room).argmax(axis=-1)
        chosen = (np.arange(len(best))[:, None], np.arange(self.count), best)
        heading, through = heading[chosen], through[chosen]
        # From where the line enters the ball to where it leaves it.
        offset = centre[:, None] - through
        middle = (offset * heading).sum(axis=-1)
        half_chord = np.sqrt(np.maximum(reach[:, None] ** 2 - (offset * offset).sum(axis=-1) + middle * middle, 0))
        places = through + (middle - half_chord)[..., None] * heading
        speed, radius = np.float32(self.speed), np.full((*places.shape[:-1], 1), self.radius, np.float32)
        time = 2 * half_chord / np.maximum(speed, np.float32(1e-6))
        return Courses(np.concatenate([places, speed * heading, radius], axis=-1), time)


def _distances(points: FloatArray, through: FloatArray, heading: FloatArray) -> FloatArray:
    """``(...)`` distances of points from lines [m]; all arguments ``(..., d)``."""
    offset = points - through
    along = (offset * heading).sum(axis=-1)
    distances: FloatArray = np.sqrt(np.maximum((offset * offset).sum(axis=-1) - along * along, 0))
    return distances
