"""Disturbances that the tests share: at least one of every kind that there is by name, and one of a user's."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from d4orm_env.core.arrays import FloatArray
from d4orm_env.disturbances import (
    Bias,
    ControlNoise,
    CorrelatedNoise,
    Delay,
    Disturbance,
    Drag,
    Draws,
    Dropout,
    Gain,
    Intruder,
    Lag,
    LimitMismatch,
    Observed,
    Occlusion,
    Push,
    Quantisation,
    RayNoise,
    Scene,
    Stall,
    StateDelay,
    StateNoise,
)


class Gusts(NamedTuple):
    speed: FloatArray


@dataclass(frozen=True)
class Wind(Disturbance[Gusts]):
    """A user's own: gusts along x, which change from step to step, and an eye that is off by 1 cm."""

    speed: float = 0.1

    def begin(self, scene: Scene, draws: Draws) -> Gusts:
        return Gusts(self.speed * draws.uniform(1))

    def move(
        self, states: FloatArray, controls: FloatArray, memory: Gusts, scene: Scene, draws: Draws
    ) -> tuple[FloatArray, FloatArray]:
        memory.speed[:] += self.speed * draws.normal(1)
        states = states.copy()
        states[..., 0] += np.float32(scene.problem.dt) * memory.speed
        return states, controls

    def see(self, seen: Observed, memory: Gusts, scene: Scene, draws: Draws) -> Observed:
        return seen._replace(states=seen.states + np.float32(0.01) * (np.arange(seen.states.shape[2]) < 2))


CASES: dict[str, Disturbance[Any]] = {
    "control_noise": ControlNoise((0.2, 0.1)),
    "correlated_noise": CorrelatedNoise(0.2, 0.5),
    "bias": Bias(0.1),
    "delay": Delay(2),
    "delay-range": Delay((0, 3)),
    "dropout": Dropout(0.3),
    "dropout-brake": Dropout(0.3, hold=False),
    "quantisation": Quantisation(0.25),
    "gain": Gain(0.3),
    "state_noise": StateNoise(0.02, 0.05),
    "state_delay": StateDelay(2),
    "occlusion": Occlusion(1.5),
    "push": Push(2.0, 0.3),
    "stall": Stall(0.6, 0.5),
    "stall-for-good": Stall(1.0, robots=1),
    "intruder": Intruder(2, 0.8),
    "drag": Drag(0.5),
    "limit_mismatch": LimitMismatch(0.7),
    "lag": Lag(0.2),
    "ray_noise": RayNoise(0.2),
    "wind": Wind(),
}
"""By name of the kind, and more behind a hyphen."""

TOGETHER = [Delay(1), Dropout(0.2), StateNoise(0.02, 0.05), StateDelay(1), Push(1.0, 0.3), Intruder(1), Stall(0.5, 1.0)]
