"""Interface of a disturbance: a frozen dataclass with some of five methods, and their arguments.

Every method works on ``B`` worlds at once, of which a single environment is one, so that all environments disturb alike
to the bit. All arrays have a leading axis over the worlds.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import BoolArray, FloatArray
from d4orm_env.core.observation_layout import BoundsSlack, ObservationLayout
from d4orm_env.core.problem import Problem
from d4orm_env.disturbances.draws import Draws

Memory = tuple[NDArray[np.generic], ...]
"""Memory of a disturbance over an episode: arrays ``(B, ...)``, changed in place. A ``NamedTuple`` names them."""

M = TypeVar("M", bound=Memory)


class Scene(NamedTuple):
    """The worlds as a disturbance finds them; nothing of it may be changed.

    Attributes:
        problem: Team, time step and obstacles; starts and goals may be those of another world.
        max_cycles: Steps in an episode.
        start: ``(B, K, n)`` where the robots began.
        goal: ``(B, K, d)`` present goals [m].
        states: ``(B, K, n)`` true states.
        controls: ``(B, K, m)`` executed last.
        arrived: ``(B, K)`` bool.
        steps: ``(B,)`` int64 steps taken since the episode began.
        bodies: ``(B, N, 2 d + 1)`` what moves among the robots and is none, as it truly is, see :class:`Observed`.
    """

    problem: Problem
    max_cycles: int
    start: FloatArray
    goal: FloatArray
    states: FloatArray
    controls: FloatArray
    arrived: BoolArray
    steps: NDArray[np.int64]
    bodies: FloatArray

    def of(self, worlds: NDArray[np.intp]) -> Scene:
        """The same of some of the worlds."""
        return self._replace(
            start=self.start[worlds],
            goal=self.goal[worlds],
            states=self.states[worlds],
            controls=self.controls[worlds],
            arrived=self.arrived[worlds],
            steps=self.steps[worlds],
            bodies=self.bodies[worlds],
        )

    @property
    def standing(self) -> BoolArray:
        """``(B, K)`` bool: docked, so that nothing moves it."""
        return self.arrived & self.problem.docks


class Observed(NamedTuple):
    """The worlds as they are seen, in observations and in ``env.state()``.

    Attributes:
        states: ``(B, K, n)`` of the robots.
        controls: ``(B, K, m)`` executed last; what first-order robots' speed is read from.
        bodies: ``(B, N, 2 d + 1)`` position [m], velocity [m/s] and radius [m] of what moves among the robots and is
            none; a radius of zero for one that is not seen.
    """

    states: FloatArray
    controls: FloatArray
    bodies: FloatArray


class DisturbanceEffect(NamedTuple):
    """Effect of a disturbance, for evaluators and pictures; ``None`` for what it never does.

    Attributes:
        pushed: ``(B, K, d)`` velocity that the last step gave to robots [m/s].
        stalled: ``(B, K)`` bool: does not obey.
        lost: ``(B, K)`` bool: will not obey again, so that it need not arrive for the episode to be a success.
        bodies: ``(B, N, 2 d + 1)`` what moves among the robots and is none, see :class:`Observed`. Contact with one
            is a collision.
    """

    pushed: FloatArray | None = None
    stalled: BoolArray | None = None
    lost: BoolArray | None = None
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

    @property
    def negligible(self) -> bool:
        """True if it changes nothing, as at level zero; it is left out then."""
        return False

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
        """Return the true limits ``(K, L)`` of the robots, see :attr:`d4orm_env.core.team.Team.limits`."""
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
