"""Interface of an engine: its inputs and its results."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from d4orm_env.core.arrays import LARGEST_NUMBER, BoolArray, FloatArray, as_float32
from d4orm_env.core.observation_layout import ObservationLayout
from d4orm_env.core.problem import Problem
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.core.trajectory import Trajectory

if TYPE_CHECKING:
    from d4orm_env.engine.episodes import WorldBatch


class StepResult(NamedTuple):
    """One step of the whole team.

    Attributes:
        states: ``(K, n)`` after the step.
        controls: ``(K, m)`` as executed: clipped, zero for docked robots.
        arrived: ``(K,)`` bool.
        collided: ``(K,)`` bool, hard contact.
        margin_violated: ``(K,)`` bool.
        rewards: ``(K,)``.
    """

    states: FloatArray
    controls: FloatArray
    arrived: BoolArray
    collided: BoolArray
    margin_violated: BoolArray
    rewards: FloatArray

    def with_contacts(self, touched: BoolArray, near: BoolArray, penalty: np.float32) -> StepResult:
        """The step with contacts that the engine does not know of, as with dynamic obstacles.

        Args:
            touched: ``(K,)`` robots in contact.
            near: ``(K,)`` robots within the margin, which pay for it.
            penalty: What they pay.
        """
        return self._replace(
            collided=self.collided | touched,
            margin_violated=self.margin_violated | near,
            rewards=self.rewards - penalty * near.astype(np.float32),
        )


class Engine(Protocol):
    """Operations that environments and planners alike need from the physics."""

    name: str

    def step(self, arrays: ProblemArrays, states: FloatArray, arrived: BoolArray, controls: FloatArray) -> StepResult:
        """One step of the team from ``states`` ``(K, n)`` under ``controls`` ``(K, m)``, clipped here.

        ``arrays`` is ``problem.arrays``, or a copy with other goals where goals change on the way.
        """
        ...

    def rollout(self, problem: Problem, controls: ArrayLike) -> Trajectory:
        """Roll ``controls`` ``(H, K, m)`` out from the problem's start."""
        ...


class ObservationInputs(NamedTuple):
    """Inputs to the observations of ``B`` worlds.

    Attributes:
        goal: ``(B, K, d)`` [m].
        state: ``(B, K, n)``.
        control: ``(B, K, m)`` executed last.
        docked: ``(B, K)`` bool.
        bodies: ``(B, N, 2 d + 1)`` position [m], velocity [m/s] and radius [m] of what moves among the robots and is
            none; a radius of zero for one that is not seen.
        time_left: ``(B,)`` share of the time left, 1 to 0.
    """

    goal: FloatArray
    state: FloatArray
    control: FloatArray
    docked: BoolArray
    bodies: FloatArray
    time_left: FloatArray

    @classmethod
    def of_team(
        cls,
        goal: FloatArray,
        state: FloatArray,
        control: FloatArray,
        docked: BoolArray,
        time_left: float,
        bodies: FloatArray | None = None,
    ) -> ObservationInputs:
        """Make those of one world, in arrays of its own: kernels are compiled anew for read-only ones."""
        if bodies is None:
            bodies = np.empty((0, 2 * goal.shape[1] + 1), np.float32)
        one = np.newaxis
        return cls(
            np.array(goal, np.float32)[one],
            np.array(state, np.float32)[one],
            np.array(control, np.float32)[one],
            np.array(docked, np.bool_)[one],
            np.array(bodies, np.float32)[one],
            np.array([time_left], np.float32),
        )

    def of(self, worlds: slice) -> ObservationInputs:
        """The same of some of the worlds."""
        return ObservationInputs(*(part[worlds] for part in self))  # type: ignore[arg-type]


class WorldEngine(Engine, Protocol):
    """An engine with what environments need as well."""

    def contacts(self, arrays: ProblemArrays, states: FloatArray) -> tuple[BoolArray, BoolArray]:
        """``(collided (K,), margin_violated (K,))`` of a team at rest at ``states`` ``(K, n)``."""
        ...

    def observe_worlds(
        self, arrays: ProblemArrays, layout: ObservationLayout, sight: ObservationInputs, out: FloatArray
    ) -> None:
        """Fill ``out`` ``(B, K, D)`` with what every robot of every world sees, inside the layout's bounds."""
        ...

    def advance(
        self,
        arrays: ProblemArrays,
        layout: ObservationLayout,
        max_cycles: int,
        orders: NDArray[np.uint8],
        batch: WorldBatch,
        out: FloatArray,
    ) -> None:
        """Step, reset and observe the worlds of a batch in place, each as it is ordered to.

        Args:
            arrays: The problem that the worlds share; each has its own starts and goals.
            layout: Components of an observation, and their bounds.
            max_cycles: Steps in an episode.
            orders: ``(B,)`` one of :data:`~d4orm_env.engine.episodes.STEP` and its like for every world.
            batch: The worlds; ``batch.control`` holds what to do.
            out: ``(B, K, D)`` observations, output; those of skipped worlds are not written. ``(0, K, D)`` makes none.
        """
        ...


def checked_controls(problem: Problem, controls: ArrayLike) -> FloatArray:
    """``controls`` as a contiguous ``(H, K, m)`` float32 array.

    Raises:
        ValueError: If the shape is another, or a value is not finite or so large that its square would not be.
    """
    try:
        array = as_float32(controls)
    except ValueError as error:
        raise ValueError(f"controls must be an array of numbers; {error}") from None
    expected = (problem.horizon, problem.num_robots, problem.control_size)
    if array.shape != expected:
        raise ValueError(f"controls have shape {array.shape}; expected (H, K, m) = {expected}")
    if not np.isfinite(array).all():
        step, robot, component = (int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise ValueError(f"controls[{step}, {robot}, {component}] is not finite; every control must be")
    if (np.abs(array) > LARGEST_NUMBER).any():
        where = tuple(int(i) for i in np.argwhere(np.abs(array) > LARGEST_NUMBER)[0])
        raise ValueError(
            f"controls{where} is {array[tuple(where)]:g}; it must be at most {LARGEST_NUMBER:g} in magnitude"
        )
    return array
