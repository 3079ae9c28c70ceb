"""A robot model: its functions, each written once in scalar style, and what they share.

A model is a handful of pure functions on tuples of numbers. They contain no loops, no array library and no float
literals, so that numba compiles them, JAX traces them over arrays whose last axis is the sample, and CasADi
differentiates them, in the caller's precision. Mathematical functions come in through :class:`Ops`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from typing import Any, NamedTuple, Protocol, Self, TypeAlias, TypeVar

from d4orm_env.core.arrays import LARGEST, FloatArray
from d4orm_env.core.winding import Unwinding

SPEED, ACCELERATION, TURN_RATE = range(3)
"""First columns of every robot's limits: speed [m/s], acceleration [m/s^2], turn rate [rad/s]."""

STANDARD_LIMITS = ("max_speed", "max_acceleration", "max_turn_rate")
OWN_LIMITS = len(STANDARD_LIMITS)
"""Column of the first limit that a model has for itself."""
UNLIMITED = LARGEST
"""Default of a limit that bounds nothing unless it is given."""

Operand: TypeAlias = Any
"""Another number, or a constant of Python; what a library accepts differs from one to the next."""


class Truth(Protocol):
    """The result of comparing two :class:`Number`."""

    def __and__(self, other: Operand, /) -> Truth: ...
    def __or__(self, other: Operand, /) -> Truth: ...


Flag: TypeAlias = Any
"""A :class:`Truth` as the library of the numbers has it."""


class Number(Protocol):
    """A number as the physics has it: of Python or numba, an array of NumPy or JAX, a symbol of CasADi."""

    def __neg__(self) -> Self: ...
    def __add__(self, other: Operand, /) -> Self: ...
    def __radd__(self, other: Operand, /) -> Self: ...
    def __sub__(self, other: Operand, /) -> Self: ...
    def __rsub__(self, other: Operand, /) -> Self: ...
    def __mul__(self, other: Operand, /) -> Self: ...
    def __rmul__(self, other: Operand, /) -> Self: ...
    def __truediv__(self, other: Operand, /) -> Self: ...
    def __gt__(self, other: Operand, /) -> Truth: ...
    def __ge__(self, other: Operand, /) -> Truth: ...
    def __le__(self, other: Operand, /) -> Truth: ...


N = TypeVar("N", bound=Number)
"""Numbers of one library."""

L = TypeVar("L", FloatArray, list[float])
"""A robot's limits."""

Vector: TypeAlias = tuple[Number, ...]
"""A state, a control, limits, a position or a velocity."""


class TimeStep(NamedTuple):
    """``dt`` and the fractions of it that Runge-Kutta needs, in the caller's precision."""

    full: Number
    half: Number
    third: Number
    sixth: Number


class Ops(NamedTuple):
    """The mathematical functions a model may call, from whichever library compiles it."""

    cos: Callable[..., Number]
    sin: Callable[..., Number]
    sqrt: Callable[..., Number]
    minimum: Callable[..., Number]
    maximum: Callable[..., Number]
    arctan2: Callable[..., Number]
    where: Callable[..., Number]
    """``(condition, a, b) -> a`` where the condition holds, ``b`` elsewhere."""


PYTHON_OPS = Ops(math.cos, math.sin, math.sqrt, min, max, math.atan2, lambda condition, a, b: a if condition else b)
"""Over Python's numbers."""

ModelFunction: TypeAlias = Callable[..., Any]
"""It returns what it is given numbers of."""


class ModelFunctions(NamedTuple):
    """The functions of a model.

    ``x`` is the state tuple, ``u`` the control tuple, ``limits`` the robot's limits: speed, acceleration and turn rate,
    and then those of :attr:`Model.own_limits`.
    """

    derivative: ModelFunction
    """``(x, u, limits, ops) -> dx/dt``."""
    limit_control: ModelFunction
    """``(u, limits, ops) -> u`` inside the robot's limits."""
    limit_state: ModelFunction
    """``(x, limits, ops) -> x`` at no more than the speed limit. :class:`Model` has it unwind the angles too."""
    velocity: ModelFunction
    """``(x, u, limits, ops) -> velocity``, a vector in the world frame [m/s]."""
    rest: ModelFunction
    """``(x, zero) -> x`` at rest at the same position and heading."""
    approach: ModelFunction
    """``(x, goal, limits, h, ops) -> velocity``, the fastest straight to the goal that lets it stop there [m/s]."""
    track: ModelFunction
    """``(x, velocity, limits, h, ops) -> u`` that would bring it to that within a step; it may exceed the limits."""
    integrate: Any = None
    """``(x, u, limits, h, ops) -> x`` after a :class:`TimeStep`: classical Runge-Kutta, the control held constant,
    written out without the terms that cancel. A model that leaves it out is integrated by :class:`RungeKutta`.
    """


class Limit(NamedTuple):
    """A limit or measure of its own that a model has, positive."""

    name: str  #: As in ``Team(own_limits={name: ...})``
    default: float  #: For robots that are given no other, in SI units; may be :data:`UNLIMITED`
    most: float = math.inf  #: Largest value


# ``x + h * k`` for states of two to six components, written out for the compiler.
def _moved2(x: Vector, h: Number, k: Vector) -> Vector:
    return (x[0] + h * k[0], x[1] + h * k[1])


def _moved3(x: Vector, h: Number, k: Vector) -> Vector:
    return (x[0] + h * k[0], x[1] + h * k[1], x[2] + h * k[2])


def _moved4(x: Vector, h: Number, k: Vector) -> Vector:
    return (x[0] + h * k[0], x[1] + h * k[1], x[2] + h * k[2], x[3] + h * k[3])


def _moved5(x: Vector, h: Number, k: Vector) -> Vector:
    return (x[0] + h * k[0], x[1] + h * k[1], x[2] + h * k[2], x[3] + h * k[3], x[4] + h * k[4])


def _moved6(x: Vector, h: Number, k: Vector) -> Vector:
    return (x[0] + h * k[0], x[1] + h * k[1], x[2] + h * k[2], x[3] + h * k[3], x[4] + h * k[4], x[5] + h * k[5])


MOVED: dict[int, ModelFunction] = {2: _moved2, 3: _moved3, 4: _moved4, 5: _moved5, 6: _moved6}


def runge_kutta(
    derivative: ModelFunction, moved: ModelFunction, x: Vector, u: Vector, limits: Vector, h: TimeStep, ops: Ops
) -> Vector:
    """One step of the classical Runge-Kutta method, the control held constant; ``moved`` is one of :data:`MOVED`."""
    k1 = derivative(x, u, limits, ops)
    k2 = derivative(moved(x, h.half, k1), u, limits, ops)
    k3 = derivative(moved(x, h.half, k2), u, limits, ops)
    k4 = derivative(moved(x, h.full, k3), u, limits, ops)
    return moved(moved(moved(moved(x, h.sixth, k1), h.third, k2), h.third, k3), h.sixth, k4)


@dataclass(frozen=True)
class RungeKutta:
    """:attr:`ModelFunctions.integrate` of a model that has none of its own."""

    derivative: ModelFunction
    state_size: int

    def __call__(self, x: Vector, u: Vector, limits: Vector, h: TimeStep, ops: Ops) -> Vector:
        return runge_kutta(self.derivative, MOVED[self.state_size], x, u, limits, h, ops)


@dataclass(frozen=True)
class Model:
    """A robot model: its sizes, the meaning of its components and its functions."""

    name: str  #: Registry name, an identifier
    dimension: int  #: Position dimensions ``d``, 2 or 3; the first ``d`` state components are the position [m]
    state_names: tuple[str, ...]  #: One name per state component; ``len`` is the model's state size ``n``, ``d`` to 6
    control_names: tuple[str, ...]  #: One name per control component; ``len`` is the model's control size ``m``, 2 or 3
    #: Column of the limits that bounds each control component; those with one column by their norm
    control_limits: tuple[int, ...]
    heading_index: int | None  #: State component holding the heading [rad], or ``None`` for a model without one
    speed_indices: tuple[int, ...]  #: State components holding velocity or speed [m/s]
    functions: ModelFunctions  #: The scalar-style functions
    #: Limits beyond the three that all models have, from column :data:`OWN_LIMITS` on
    own_limits: tuple[Limit, ...] = ()
    #: ``(state component, column of the limits)`` for components other than speeds that
    #: :attr:`ModelFunctions.limit_state` bounds; those with the same column by their norm
    state_limits: tuple[tuple[int, int], ...] = ()
    #: ``(column, column of its own)`` for limits that hold for positive values only, such as a speed forwards: the
    #: second one's bounds the magnitude of negative values, such as a speed backwards
    lower_limits: tuple[tuple[int, int], ...] = ()
    #: ``(state component of its hitch angle, column of its hitch's length)`` of each, from the front on; the angle is
    #: what its heading lags behind that of the body before it
    trailers: tuple[tuple[int, int], ...] = ()
    #: State components other than the heading that are angles, which do not wind up either
    own_angles: tuple[int, ...] = ()
    #: Those of them that are the heading where a scenario starts the robot; others are 0
    start_angles: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        functions = self.functions
        if functions.integrate is None:
            functions = functions._replace(integrate=RungeKutta(functions.derivative, self.state_size))
        limit_state = functions.limit_state
        while isinstance(limit_state, Unwinding):  # of the model that this one was copied from
            limit_state = limit_state.limit_state
        for index in self.angles:
            limit_state = Unwinding(limit_state, index)
        object.__setattr__(self, "functions", functions._replace(limit_state=limit_state))

    @property
    def angles(self) -> tuple[int, ...]:
        """State components that are angles, the heading first."""
        return self.own_angles if self.heading_index is None else (self.heading_index, *self.own_angles)

    @property
    def state_size(self) -> int:
        return len(self.state_names)

    @property
    def control_size(self) -> int:
        return len(self.control_names)

    @property
    def limit_names(self) -> tuple[str, ...]:
        """The columns of the robot's limits."""
        return (*STANDARD_LIMITS, *(limit.name for limit in self.own_limits))

    @property
    def limited_components(self) -> dict[int, list[int]]:
        """State components by the column of the limits that bounds their norm."""
        components = {SPEED: list(self.speed_indices)} if self.speed_indices else {}
        for index, column in self.state_limits:
            components.setdefault(column, []).append(index)
        return components

    def lower_bounds(self, limits: L) -> L:
        """``(L,)`` magnitudes that bound negative values in place of the limits; see :attr:`lower_limits`."""
        bounds = limits.copy()
        for column, own in self.lower_limits:
            bounds[column] = min(limits[own], limits[SPEED]) if column == SPEED else limits[own]
        return bounds

    @property
    def first_order(self) -> bool:
        """True if it takes any velocity at once, so that its state holds none."""
        return not self.speed_indices

    @property
    def turns_in_place(self) -> bool:
        """True if it can turn on the spot, or need not turn at all."""
        return self.heading_index is None or self._turn_rate([1.0] * len(self.limit_names), moving=False) > 0

    def turn_rate(self, limits: FloatArray) -> float:
        """Fastest turn of the heading that these limits allow [rad/s], zero without a heading."""
        return 0.0 if self.heading_index is None else self._turn_rate(limits.tolist(), moving=True)

    def turning_radius(self, limits: FloatArray) -> float:
        """Radius of the smallest circle that it can drive [m]: zero if it turns in place."""
        rate = math.inf if self.turns_in_place else self.turn_rate(limits)
        return float(limits[SPEED]) / rate if rate else math.inf

    def _turn_rate(self, most: list[float], *, moving: bool) -> float:
        """Sought among the states and controls at their limits, which is where models turn fastest."""
        bounds = dict(self.state_limits) | dict.fromkeys(self.speed_indices, SPEED)
        lowest = self.lower_bounds(most)

        def ends(column: int | None) -> tuple[float, ...]:
            return (0.0,) if column is None or (column == SPEED and not moving) else (-lowest[column], most[column])

        states = list(product(*(ends(bounds.get(i)) for i in range(self.state_size))))
        controls = list(product(*map(ends, self.control_limits)))
        return max(
            abs(self.functions.derivative(x, u, most, PYTHON_OPS)[self.heading_index]) for x in states for u in controls
        )
