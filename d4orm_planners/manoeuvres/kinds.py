"""Kinds of robots: model, limits and time step, on which motion primitives depend."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import ceil, pi, sqrt

import numpy as np

from d4orm_env.core import portable
from d4orm_env.core.arrays import FloatArray, Floats
from d4orm_env.dynamics.models import MODELS
from d4orm_env.dynamics.robot_model import ACCELERATION, PYTHON_OPS, SPEED, Model, TimeStep

SECTORS = 32  #: Number of headings that are told apart
SECTOR = 2 * pi / SECTORS  #: Angle between two of them [rad]
FINER_SECTORS = 4 * SECTORS  #: The number where cells are finest
LENGTHS = (1.5, 6.0)  #: Lengths of straight primitives, in cells
MAX_STEPS = 2**14  #: Most steps of a move

OPS = PYTHON_OPS._replace(
    cos=lambda x: portable.sin_cos_of(x)[1],
    sin=lambda x: portable.sin_cos_of(x)[0],
)

Mode = tuple[float, ...]  #: Components of a state beside position and heading: speeds, steering and hitch angles
Move = tuple[Mode, Mode, FloatArray]  #: Mode before, mode after, and ``(n, m)`` controls
State = tuple[float, ...]


@dataclass(frozen=True)
class Kind:
    """Model, limits and time step, on which primitives depend."""

    name: str
    limits: tuple[float, ...]  #: ``(L,)`` of the robot, in the order of the model
    dt: float  #: Time step [s]
    cell: float  #: Distance that should be told apart [m]
    start: Mode  #: Mode that the robot starts in
    #: The same near to its start and its goal, where it has shorter moves besides, all from rest to rest; zero for none
    finest: float = 0.0

    @property
    def model(self) -> Model:
        """The model."""
        return MODELS[self.name]

    @property
    def base(self) -> Kind:
        """The same, whatever the cells and the start are."""
        return replace(self, cell=0.0, start=(), finest=0.0)

    @property
    def usual(self) -> Kind:
        """The same with usual cells everywhere."""
        return replace(self, finest=0.0)

    @property
    def parts(self) -> tuple[Kind, ...]:
        """Those whose moves it has: usual ones, and with finer cells those that fit these and some in between."""
        if not self.finest:
            return (self,)
        return self.usual, self.careful, replace(self, finest=sqrt(self.cell * self.finest)).careful

    @property
    def careful(self) -> Kind:
        """The same with moves as short as the finer cells need, and slower where a step at full speed leads farther."""
        limits = list(self.limits)
        if self.model.first_order:
            limits[SPEED] = min(limits[SPEED], LENGTHS[0] * self.finest / self.dt)
        return replace(self, limits=tuple(limits), cell=self.finest)

    @property
    def sectors(self) -> int:
        """Headings that are told apart where cells are finest; one for a robot without a heading."""
        return (FINER_SECTORS if self.finest else SECTORS) if self.model.heading_index is not None else 1

    @property
    def sector(self) -> float:
        """Angle between two of them [rad]."""
        return 2 * pi / FINER_SECTORS if self.finest else SECTOR

    @property
    def lower(self) -> list[float]:
        """Magnitudes that bound negative values."""
        return self.model.lower_bounds(list(self.limits))

    def pace(self, way: int) -> float:
        """Speed limit forwards (``way`` is 1) or backwards (-1)."""
        return self.limits[SPEED] if way > 0 else self.lower[SPEED]

    def steps(self, amount: float, rate: float) -> int:
        """Steps that an amount takes at this rate, at least one."""
        return max(1, ceil(amount / (rate * self.dt) - 1e-6))

    def speeding_up(self, speed: float) -> int:
        """Steps from rest to a speed."""
        return self.steps(speed, self.limits[ACCELERATION])

    def hop(self, length: float, acceleration: float) -> tuple[int, float]:
        """Steps to speed up, and as many to brake, so that a robot moves so far; and the speed in between."""
        count = self.steps(sqrt(length / acceleration), 1.0)
        return count, length / (count * self.dt)

    def states(self, state: State, controls: FloatArray | Floats) -> list[State]:
        """The ``n + 1`` states under ``(n, m)`` controls, by the model's own integration."""
        h = TimeStep(self.dt, self.dt / 2, self.dt / 3, self.dt / 6)
        states = [state]
        for control in controls.astype(np.float64).tolist():
            states.append(self.model.functions.integrate(states[-1], tuple(control), self.limits, h, OPS))
        return states


def held(count: int, *control: float) -> FloatArray:
    """``(n, m)`` a control, for so many steps, or more than a move may have."""
    return np.tile(np.array(control, np.float32), (min(count, MAX_STEPS + 1), 1))
