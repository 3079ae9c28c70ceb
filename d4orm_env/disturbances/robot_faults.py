"""Disturbances of the world: robots are pushed, stop, or are not quite what their planner believes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import FloatArray, positive_number, whole_number
from d4orm_env.core.observation_layout import BoundsSlack
from d4orm_env.core.portable import cos, sin
from d4orm_env.core.problem import Problem
from d4orm_env.disturbances.disturbance import (
    Disturbance,
    DisturbanceEffect,
    Kept,
    Memory,
    Scene,
    level,
    share,
    standard_deviation,
    unless,
)
from d4orm_env.disturbances.draws import Draws
from d4orm_env.dynamics.robot_model import STANDARD_LIMITS

_NEVER = 2**62


@dataclass(frozen=True)
class Push(Disturbance[Kept]):
    """Random impulses: a robot gets ``speed`` more in a random direction, at the moments of a Poisson process.

    It is at most once in a time step, with probability ``1 - exp(-rate dt)``, at the step's beginning. Double
    integrators take the velocity up as a whole. A robot that is driven by wheels takes up the part along its heading if
    it has inertia there; what a robot does not take up displaces it in that one time step. Docked robots
    are not pushed.
    """

    rate: float = level(standard_deviation, 0.2, off=0)  #: Mean number of pushes of a robot per second [1/s]
    speed: float = level(standard_deviation, 0.3, off=0)  #: [m/s]

    def slack(self, problem: Problem) -> BoundsSlack:
        return BoundsSlack(drift=self.speed)

    def begin(self, scene: Scene, draws: Draws) -> Kept:
        return Kept(np.zeros(scene.goal.shape, np.float32))

    def move(
        self, states: FloatArray, controls: FloatArray, memory: Kept, scene: Scene, draws: Draws
    ) -> tuple[FloatArray, FloatArray]:
        hit = draws.uniform(states.shape[1]) < -math.expm1(-self.rate * scene.problem.dt)
        hit &= ~scene.standing
        memory.values[:] = 0
        if hit.any():
            worlds = np.flatnonzero(hit.any(axis=1))
            directions = draws.of(worlds).direction(*memory.values.shape[1:])
            memory.values[worlds] = given = np.float32(self.speed) * directions * hit[worlds, :, None]
            states = states.copy()
            states[worlds] = pushed(scene.problem, states[worlds], given)
        return states, controls

    def effect(self, memory: Kept, scene: Scene) -> DisturbanceEffect:
        return DisturbanceEffect(pushed=memory.values)


def pushed(problem: Problem, states: FloatArray, velocity: FloatArray) -> FloatArray:
    """``states`` ``(B, K, n)``, changed in place, with velocities ``(B, K, d)`` given to robots."""
    slip, d = velocity.copy(), problem.dimension
    for robot in np.flatnonzero(velocity.any(axis=(0, 2))):
        model = problem.team.robot_models[robot]
        columns = list(model.speed_indices)
        if len(columns) == d:
            states[:, robot, columns] += velocity[:, robot]
            slip[:, robot] = 0
        elif columns and model.heading_index is not None:
            heading = states[:, robot, model.heading_index]
            ahead = np.stack([cos(heading), sin(heading)], axis=-1).astype(np.float32)
            along = ahead[:, 0] * velocity[:, robot, 0] + ahead[:, 1] * velocity[:, robot, 1]
            states[:, robot, columns[0]] += along
            slip[:, robot, :2] -= along[:, None] * ahead
    states[..., :d] += np.float32(problem.dt) * slip
    return states


class Stops(NamedTuple):
    """Steps ``(B, K)`` from which and up to which robots do not obey."""

    begin: NDArray[np.int64]
    end: NDArray[np.int64]

    def now(self, scene: Scene) -> NDArray[np.bool_]:
        """``(B, K)`` bool: those that do not obey now."""
        steps = scene.steps[:, None]
        return (self.begin <= steps) & (steps < self.end) & ~scene.standing


@dataclass(frozen=True)
class Stall(Disturbance[Stops]):
    """A robot brakes and stops, whatever it is told; its body stays. It happens to a robot once in an episode at most,
    at a time uniform over the first half of the episode's longest duration.

    One that stalls for good need not arrive for the episode to be a success; all others have to.
    """

    probability: float = level(share, off=0)  #: That it happens to a robot in an episode, from 0 to 1
    #: Time for which it stalls [s]; infinite for good
    duration: float = level(unless(math.inf, standard_deviation), math.inf, off=0)
    #: It may happen to so many only, chosen at random in every episode; to all by default. ``Stall(1.0, robots=1)`` is
    #: one robot of the team that is sure to stall.
    robots: int | None = level(unless(None, partial(whole_number, minimum=1)), None)

    @property
    def replayable(self) -> bool:
        return True  # it changes controls only

    def check(self, problem: Problem) -> None:
        if (self.robots or 0) > problem.num_robots:
            raise ValueError(
                f"Stall robots is {self.robots}; the team has {problem.num_robots}, so give at most that, or None"
            )

    def begin(self, scene: Scene, draws: Draws) -> Stops:
        num_robots = scene.problem.num_robots
        happens = draws.uniform(num_robots) < self.probability
        chosen = draws.uniform(num_robots).argsort(axis=1, kind="stable").argsort(axis=1, kind="stable")
        happens &= chosen < (self.robots or num_robots)
        begin = np.floor(draws.uniform(num_robots) * (scene.max_cycles / 2)).astype(np.int64)
        begin = np.where(happens, begin, _NEVER)
        lasts = math.inf if self.duration == math.inf else math.ceil(self.duration / scene.problem.dt - 1e-9)
        end = np.full_like(begin, _NEVER) if lasts == math.inf else np.minimum(begin + int(lasts), _NEVER)
        return Stops(begin, end)

    def move(
        self, states: FloatArray, controls: FloatArray, memory: Stops, scene: Scene, draws: Draws
    ) -> tuple[FloatArray, FloatArray]:
        stalled = memory.now(scene)
        if not stalled.any():
            return states, controls
        return states, np.where(stalled[..., None], scene.brake(states, stalled), controls)

    def effect(self, memory: Stops, scene: Scene) -> DisturbanceEffect:
        stalled = memory.now(scene)
        return DisturbanceEffect(stalled=stalled, lost=stalled & (memory.end == _NEVER))


@dataclass(frozen=True)
class Drag(Disturbance[Memory]):
    """Friction of a fluid, linear in the speed: it adds ``dv/dt = -coefficient v`` to what the control does.

    Taken exactly at the beginning of every step, ``v <- exp(-coefficient dt) v``, the control after it (Lie splitting).
    """

    coefficient: float = level(standard_deviation, off=0)  #: [1/s]

    def check(self, problem: Problem) -> None:
        for robot, model in enumerate(problem.team.robot_models):
            if not model.speed_indices:
                raise ValueError(
                    f"Drag slows what has inertia, and robot_{robot}, a {model.name}, takes any velocity at once; use "
                    "LimitMismatch or Gain for it"
                )

    def move(
        self, states: FloatArray, controls: FloatArray, memory: Memory, scene: Scene, draws: Draws
    ) -> tuple[FloatArray, FloatArray]:
        states, kept = states.copy(), np.float32(math.exp(-self.coefficient * scene.problem.dt))
        for robot, model in enumerate(scene.problem.team.robot_models):
            states[:, robot, list(model.speed_indices)] *= kept
        return states, controls


@dataclass(frozen=True)
class LimitMismatch(Disturbance[Memory]):
    """Robots weaker than believed: their limits of speed, acceleration and turn rate are truly ``factor`` times those
    that the problem says and observations show.
    """

    factor: float = level(partial(positive_number, least=1e-3, most=1.0), off=1)  #: Above 0, at most 1

    def limits(self, limits: FloatArray) -> FloatArray:
        limits = limits.copy()
        limits[:, : len(STANDARD_LIMITS)] *= np.float32(self.factor)
        return limits
