"""Disturbances of controls: what the motors do is not what was commanded.

Levels are in the controls' units: m/s^2 for double integrators, m/s for ``velocity2d``, and so on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from d4orm_env.core.arrays import LARGEST, SMALLEST, FloatArray, positive_number, short_repr, truth, whole_number
from d4orm_env.core.problem import Problem
from d4orm_env.disturbances.disturbance import (
    MAX_DELAY,
    Disturbance,
    Kept,
    M,
    Memory,
    Scene,
    check_components,
    level,
    per_component,
    scaled,
    share,
    standard_deviation,
)
from d4orm_env.disturbances.draws import Draws


@dataclass(frozen=True)
class _Spread(Disturbance[M]):
    """Standard deviation ``std``: one number or one per component."""

    std: float | tuple[float, ...] = level(per_component)

    @property
    def negligible(self) -> bool:
        return not np.any(self.std)

    def check(self, problem: Problem) -> None:
        check_components(self.std, f"{type(self).__name__} std", problem.control_size)


@dataclass(frozen=True)
class ControlNoise(_Spread[Memory]):
    """Gaussian noise on the controls, independent over steps, robots and components; the paper's (section V-D).

    Attributes:
        std: Standard deviation, one number or one per component [control units].
    """

    def command(self, controls: FloatArray, memory: Memory, scene: Scene, draws: Draws) -> FloatArray:
        return controls + scaled(self.std, draws.normal(*controls.shape[1:]))


@dataclass(frozen=True)
class CorrelatedNoise(_Spread[Kept]):
    """Gaussian noise on the controls that is correlated over time: an Ornstein-Uhlenbeck process per component.

    It is stationary from the beginning, with autocorrelation ``exp(-t / time_constant)`` (G. E. Uhlenbeck and L. S.
    Ornstein, Physical Review 36, 1930), and is drawn exactly: ``x <- r x + std sqrt(1 - r^2) n`` with
    ``r = exp(-dt / time_constant)``.

    Attributes:
        std: Standard deviation, one number or one per component [control units].
        time_constant: [s].
    """

    time_constant: float = level(partial(positive_number, most=LARGEST), 1.0)

    def begin(self, scene: Scene, draws: Draws) -> Kept:
        return Kept(draws.normal(*scene.controls.shape[1:]))

    def command(self, controls: FloatArray, memory: Kept, scene: Scene, draws: Draws) -> FloatArray:
        disturbed = controls + scaled(self.std, memory.values)
        kept = math.exp(-scene.problem.dt / self.time_constant)
        fresh = draws.normal(*controls.shape[1:])
        fresh *= np.float32(math.sqrt(1 - kept * kept))
        np.add(np.float32(kept) * memory.values, fresh, out=memory.values)
        return disturbed


@dataclass(frozen=True)
class Bias(_Spread[Kept]):
    """A constant added to the controls of a robot, Gaussian, drawn per robot, component and episode.

    Attributes:
        std: Standard deviation, one number or one per component [control units].
    """

    def begin(self, scene: Scene, draws: Draws) -> Kept:
        return Kept(scaled(self.std, draws.normal(*scene.controls.shape[1:])))

    def command(self, controls: FloatArray, memory: Kept, scene: Scene, draws: Draws) -> FloatArray:
        return controls + memory.values


@dataclass(frozen=True)
class Gain(Disturbance[Kept]):
    """Weaker or stronger motors: the controls of a robot times ``1 + std n``, at least zero, drawn per robot and
    episode. They are clipped to the limits afterwards.
    """

    std: float = level(standard_deviation, off=0)  #: Standard deviation of the factor

    def begin(self, scene: Scene, draws: Draws) -> Kept:
        factors = 1 + np.float32(self.std) * draws.normal(scene.problem.num_robots, 1)
        return Kept(np.maximum(factors, np.float32(0)))

    def command(self, controls: FloatArray, memory: Kept, scene: Scene, draws: Draws) -> FloatArray:
        return controls * memory.values


@dataclass(frozen=True)
class Quantisation(Disturbance[Memory]):
    """Controls in steps: each component is rounded to the nearest multiple of ``step``, halves to even."""

    #: At least 1e-7, or zero [control units]
    step: float = level(partial(positive_number, zero_allowed=True, least=SMALLEST, most=LARGEST), off=0)

    def command(self, controls: FloatArray, memory: Memory, scene: Scene, draws: Draws) -> FloatArray:
        step = np.float32(self.step)
        return np.rint(controls / step) * step


def _steps_or_range(value: Any, name: str) -> int | tuple[int, int]:
    ends = value if isinstance(value, tuple | list) else (value, value)
    if len(ends) != 2:
        raise ValueError(f"{name} is {short_repr(value)}; give a number of steps, or a range as (1, 3)")
    least = whole_number(ends[0], name, 0, MAX_DELAY)
    most = whole_number(ends[1], name, least, MAX_DELAY)
    return least if least == most else (least, most)


@dataclass(frozen=True)
class Delay(Disturbance[Kept]):
    """Commands are executed some time steps late; until the first one arrives, the control is zero."""

    #: Time steps, at most 1000. ``(1, 3)`` draws from 1, 2 and 3 anew for every robot and step.
    steps: int | tuple[int, int] = level(_steps_or_range, off=0)

    @property
    def _range(self) -> tuple[int, int]:
        return self.steps if isinstance(self.steps, tuple) else (self.steps, self.steps)

    def begin(self, scene: Scene, draws: Draws) -> Kept:
        worlds, *shape = scene.controls.shape  # of the last commands, the newest first
        return Kept(np.zeros((worlds, self._range[1] + 1, *shape), np.float32))

    def command(self, controls: FloatArray, memory: Kept, scene: Scene, draws: Draws) -> FloatArray:
        least, most = self._range
        memory.values[:, 1:] = memory.values[:, :-1]
        memory.values[:, 0] = controls
        if least == most:
            return memory.values[:, most].copy()
        worlds, robots = np.arange(len(controls))[:, None], np.arange(controls.shape[1])
        return memory.values[worlds, draws.whole(least, most, len(robots)), robots]


@dataclass(frozen=True)
class Lag(Disturbance[Kept]):
    """Slow actuators: what a robot does follows what it is told as a first-order system, from rest.

    A time step executes the mean of what happens in it.
    """

    #: After it 63% of a change have happened; zero for none [s]
    time_constant: float = level(standard_deviation, off=0)

    def begin(self, scene: Scene, draws: Draws) -> Kept:
        return Kept(np.zeros_like(scene.controls))

    def command(self, controls: FloatArray, memory: Kept, scene: Scene, draws: Draws) -> FloatArray:
        steps = scene.problem.dt / self.time_constant
        left = math.exp(-steps)
        gap = memory.values - controls
        mean: FloatArray = controls + np.float32((1 - left) / steps) * gap
        np.add(controls, np.float32(left) * gap, out=memory.values)
        return mean


@dataclass(frozen=True)
class Dropout(Disturbance[Kept]):
    """Commands get lost on their way, independently for every robot and step."""

    probability: float = level(share, off=0)  #: That one is lost, from 0 to 1
    #: Whether the robot goes on with the command that it got last, zero before the first; otherwise it brakes
    hold: bool = level(truth, True)

    def begin(self, scene: Scene, draws: Draws) -> Kept:
        return Kept(np.zeros_like(scene.controls))

    def command(self, controls: FloatArray, memory: Kept, scene: Scene, draws: Draws) -> FloatArray:
        lost = draws.uniform(controls.shape[1]) < self.probability
        np.copyto(memory.values, controls, where=~lost[..., None])
        if not self.hold:
            np.copyto(memory.values, scene.brake(scene.states, lost), where=lost[..., None])
        return memory.values.copy()
