"""Interface of a disturbance: a frozen dataclass with some of five methods, and their arguments.

Every method works on ``B`` worlds at once, of which a single environment is one, so that all environments disturb alike
to the bit. All arrays have a leading axis over the worlds.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Sequence
from dataclasses import MISSING, dataclass, field, fields
from functools import partial
from typing import Any, Generic, NamedTuple, TypeAlias, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from d4orm_env.core.arrays import LARGEST, BoolArray, FloatArray, numbers_of, positive_number, short_repr
from d4orm_env.core.observation_layout import BoundsSlack, ObservationLayout
from d4orm_env.core.portable import NUMPY_OPS
from d4orm_env.core.problem import Problem
from d4orm_env.core.trajectory import DisturbanceEvents
from d4orm_env.disturbances.draws import Draws
from d4orm_env.dynamics.robot_model import TimeStep

Memory = tuple[NDArray[np.generic], ...]
"""Memory of a disturbance over an episode: arrays ``(B, ...)``, changed in place. A ``NamedTuple`` names them."""

M = TypeVar("M", bound=Memory)


class Kept(NamedTuple):
    """A memory of one array ``(B, ...)``."""

    values: FloatArray


class Scene(NamedTuple):
    """The worlds as a disturbance finds them; nothing of it may be changed."""

    problem: Problem  #: Team, time step and obstacles; starts and goals may be those of another world
    max_cycles: int  #: Steps in an episode
    start: FloatArray  #: ``(B, K, n)`` where the robots began
    goal: FloatArray  #: ``(B, K, d)`` present goals [m]
    states: FloatArray  #: ``(B, K, n)`` true states
    controls: FloatArray  #: ``(B, K, m)`` executed last
    arrived: BoolArray  #: ``(B, K)`` bool
    steps: NDArray[np.int64]  #: ``(B,)`` int64 steps taken since the episode began
    #: ``(B, N, 2 d + 1)`` what moves among the robots and is none, as it truly is, see :class:`Observed`
    bodies: FloatArray

    def of(self, worlds: NDArray[np.intp]) -> Scene:
        """The same of some of the worlds."""
        return Scene._make([*self[:2], *(part[worlds] for part in self[2:])])

    @property
    def standing(self) -> BoolArray:
        """``(B, K)`` bool: docked, so that nothing moves it."""
        return self.arrived & self.problem.docks

    def brake(self, states: FloatArray, robots: BoolArray) -> FloatArray:
        """``(B, K, m)`` controls that stop ``robots`` ``(B, K)`` as fast as limits allow, zero for the others.

        They are in ``states`` ``(B, K, n)``.
        """
        problem = self.problem
        controls: FloatArray = np.zeros((*states.shape[:2], problem.control_size), np.float32)
        step = TimeStep(*problem.arrays.time_step)
        still = (np.float32(0),) * problem.dimension
        for robot, model in enumerate(problem.team.robot_models):
            worlds = np.flatnonzero(robots[:, robot])
            if len(worlds):
                x = tuple(states[worlds, robot, : model.state_size].T)
                wanted = model.functions.track(x, still, tuple(problem.arrays.limits[robot]), step, NUMPY_OPS)
                for component, value in enumerate(wanted):
                    controls[worlds, robot, component] = value
        return controls


class Observed(NamedTuple):
    """The worlds as they are seen, in observations and in ``env.state()``."""

    states: FloatArray  #: ``(B, K, n)`` of the robots
    controls: FloatArray  #: ``(B, K, m)`` executed last; what first-order robots' speed is read from
    #: ``(B, N, 2 d + 1)`` position [m], velocity [m/s] and radius [m] of what moves among the robots and is none; a
    #: radius of zero for one that is not seen
    bodies: FloatArray


class DisturbanceEffect(NamedTuple):
    """Effect of a disturbance, for evaluators and pictures; ``None`` for what it never does."""

    pushed: FloatArray | None = None  #: ``(B, K, d)`` velocity that the last step gave to robots [m/s]
    stalled: BoolArray | None = None  #: ``(B, K)`` bool: does not obey
    #: ``(B, K)`` bool: will not obey again, so that it need not arrive for the episode to be a success
    lost: BoolArray | None = None
    #: ``(B, N, 2 d + 1)`` what moves among the robots and is none, see :class:`Observed`. Contact with one is a
    #: collision.
    bodies: FloatArray | None = None

    def copy(self) -> DisturbanceEffect:
        """A copy, for the arrays go on with the episode."""
        return copy.deepcopy(self)


@dataclass(frozen=True)
class Disturbance(Generic[M]):
    """Base of all disturbances: it does nothing. Override what yours does.

    In a step controls pass through :meth:`command` of all disturbances in the order given, then states and controls
    through :meth:`move` of all, then the robots move; whatever looks at them sees what :meth:`see` leaves. An instance
    is shared by all worlds and keeps nothing: what an episode needs is in its memory.
    """

    def __post_init__(self) -> None:
        for attribute in fields(self):
            if "check" in attribute.metadata:
                name = f"{type(self).__name__} {attribute.name}"
                object.__setattr__(
                    self, attribute.name, attribute.metadata["check"](getattr(self, attribute.name), name)
                )

    @property
    def negligible(self) -> bool:
        """True if it changes nothing, as where an attribute is off; it is left out then."""
        neutral = ((getattr(self, one.name), one.metadata["off"]) for one in fields(self) if "off" in one.metadata)
        return any(value == off for value, off in neutral)

    @property
    def replayable(self) -> bool:
        """True if executed controls, driven again without it, make the same motion and can be judged alone."""
        kind = type(self)
        return kind.move is Disturbance.move and kind.limits is Disturbance.limits

    def check(self, problem: Problem) -> None:
        """Raise ``ValueError``, in one line, where the robots or the world cannot have this disturbance."""

    def slack(self, problem: Problem) -> BoundsSlack:
        """Return the slack by which it may lead robots, or what is seen of them, out of their usual bounds.

        The spaces grow by so much.
        """
        return BoundsSlack()

    def begin(self, scene: Scene, draws: Draws) -> M:
        """The memory of ``B`` worlds whose episodes begin."""
        return ()  # type: ignore[return-value] # of a disturbance that remembers nothing

    def limits(self, limits: FloatArray) -> FloatArray:
        """Return the true limits ``(K, L)`` of the robots, positive, see :attr:`d4orm_env.core.team.Team.limits`."""
        return limits

    def command(self, controls: FloatArray, memory: M, scene: Scene, draws: Draws) -> FloatArray:
        """``(B, K, m)`` what becomes of ``controls`` on their way to the motors; they are clipped afterwards."""
        return controls

    def move(
        self, states: FloatArray, controls: FloatArray, memory: M, scene: Scene, draws: Draws
    ) -> tuple[FloatArray, FloatArray]:
        """States ``(B, K, n)`` and controls ``(B, K, m)`` that the step truly begins from.

        States of docked robots are left as they are, whatever this returns.
        """
        return states, controls

    def see(self, seen: Observed, memory: M, scene: Scene, draws: Draws) -> Observed:
        """Return the worlds as they are seen; called once at a reset and after every step."""
        return seen

    def observe(self, observations: FloatArray, layout: ObservationLayout, draws: Draws) -> FloatArray:
        """Return the robots' observations ``(B, K, D)`` of what is seen."""
        return observations

    def effect(self, memory: M, scene: Scene) -> DisturbanceEffect:
        """Return its effect up to now."""
        return DisturbanceEffect()


AnyDisturbance: TypeAlias = Disturbance[Any]
"""Whatever its memory is."""
Disturbances: TypeAlias = tuple[AnyDisturbance, ...]


def checked_disturbances(given: object) -> Disturbances:
    """The disturbances that an environment was given, as a tuple."""
    if isinstance(given, Disturbance):
        given = (given,)
    if isinstance(given, str) or not isinstance(given, Iterable):
        raise ValueError(f"disturbances is {short_repr(given)}; give a list of them, as [Delay(2), Push(0.1, 0.3)]")
    listed = tuple(given)
    for one in listed:
        if not isinstance(one, Disturbance):
            raise ValueError(
                f"disturbances holds {short_repr(one)}, which is none; give instances, as [Delay(2), Push(0.1, 0.3)]"
            )
    return listed


def at_work(disturbances: Disturbances, problem: Problem) -> Disturbances:
    """Return those that change anything, so that all others leave the environment as it is to the bit."""
    for one in disturbances:
        one.check(problem)
    return tuple(one for one in disturbances if not one.negligible)


def total_slack(disturbances: Disturbances, problem: Problem) -> BoundsSlack:
    """Room that all of them need together."""
    total = BoundsSlack()
    for one in disturbances:
        if not isinstance(slack := one.slack(problem), BoundsSlack):
            returned = f"slack returned {short_repr(slack)}; expected a BoundsSlack"
            raise ValueError(f"disturbance {type(one).__name__}: {returned}")
        total = total.joined(slack)
    return total


def events_of(effects: Sequence[DisturbanceEffect], problem: Problem) -> DisturbanceEvents:
    """Disturbance events of one world, from its effects at the beginning and after every step."""
    still = np.zeros((1, problem.num_robots, problem.dimension), np.float32)
    obeying = np.zeros((1, problem.num_robots), np.bool_)
    nothing = np.zeros((1, 0, 2 * problem.dimension + 1), np.float32)
    return DisturbanceEvents(
        pushed=np.concatenate([still if effect.pushed is None else effect.pushed for effect in effects]),
        stalled=np.concatenate([obeying if effect.stalled is None else effect.stalled for effect in effects]),
        bodies=np.concatenate([nothing if effect.bodies is None else effect.bodies for effect in effects]),
    )


MAX_DELAY = 1000
"""Most steps of a delay: every world remembers so many."""
Check = Callable[[Any, str], object]
"""``(value, name) -> value`` as it is kept, or a ``ValueError`` that has the name."""

standard_deviation: Callable[[object, str], float] = partial(positive_number, zero_allowed=True, most=LARGEST)
"""A number of zero or more."""
share: Callable[[object, str], float] = partial(positive_number, zero_allowed=True, most=1.0)
"""A probability."""


def level(check: Check, default: object = MISSING, **neutral: object) -> Any:
    """An attribute of a disturbance that is checked; where it is ``off=``, if that is given, nothing is disturbed."""
    return field(default=default, metadata={"check": check, **neutral})


def unless(special: object, check: Check) -> Check:
    """The check of all values but a special one."""

    def checked(value: object, name: str) -> object:
        same = value is special or (isinstance(value, float | np.floating) and value == special)
        return value if same else check(value, name)

    return checked


def per_component(value: ArrayLike, name: str) -> float | tuple[float, ...]:
    """One number, or one per control component, of zero or more."""
    array = numbers_of(value, f"{name} must be a number or one per control component")
    if array.ndim > 1:
        raise ValueError(f"{name} has shape {array.shape}; give one number, or one per control component")
    if not np.isfinite(array).all() or (array < 0).any():
        raise ValueError(f"{name} is {short_repr(value)}; it must be zero or more and finite")
    if (array > LARGEST).any():
        raise ValueError(f"{name} is {short_repr(value)}; it must be at most {LARGEST:g}")
    return tuple(array.tolist()) if array.ndim else float(np.asarray(value, np.float64))


def check_components(value: float | tuple[float, ...], name: str, control_size: int) -> None:
    """Refuse levels that are neither one nor one per control component."""
    if isinstance(value, tuple) and len(value) != control_size:
        raise ValueError(
            f"{name} has shape ({len(value)},); give one number, or {control_size}, one per control component"
        )


def scaled(value: float | tuple[float, ...], numbers: FloatArray) -> FloatArray:
    """``numbers`` ``(..., m)`` times levels."""
    return np.asarray(value, np.float32) * numbers
