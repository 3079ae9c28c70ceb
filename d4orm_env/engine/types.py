"""Interface of an engine: its inputs and its results."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from d4orm_env.core.arrays import LARGEST_NUMBER, BoolArray, FloatArray, Floats, IntArray, as_float32
from d4orm_env.core.observation_layout import ObservationLayout
from d4orm_env.core.problem import Problem
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.core.trajectory import Trajectory


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


class Engine(Protocol):
    """Operations that environments and planners alike need from the physics."""

    name: str

    def step(self, arrays: ProblemArrays, states: FloatArray, arrived: BoolArray, controls: FloatArray) -> StepResult:
        """One step of the team from ``states`` ``(K, n)`` under ``controls`` ``(K, m)``, clipped here.

        ``arrays`` is ``problem.arrays``, or a copy with other goals where goals change on the way.
        """
        ...

    def move(self, arrays: ProblemArrays, states: FloatArray, arrived: BoolArray, controls: FloatArray) -> FloatArray:
        """``(T+1, K, n)`` states of the team from ``states`` ``(K, n)`` on under ``controls`` ``(T, K, m)``.

        As in :meth:`step`, but contacts are not looked for.
        """
        ...

    def rollout(self, problem: Problem, controls: ArrayLike) -> Trajectory:
        """Roll ``controls`` ``(H, K, m)`` out from the problem's start."""
        ...

    def score(self, problem: Problem, controls: ArrayLike) -> FloatArray:
        """Roll ``M`` samples of controls ``(M, H, K, m)`` out; ``(M, K)`` rewards, the mean over the steps."""
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

    def select(self, worlds: slice) -> ObservationInputs:
        """The same of some of the worlds."""
        return ObservationInputs(*(part[worlds] for part in self))  # type: ignore[arg-type]


OWN_ARRAYS = ("start", "goal", "inverse_initial_distance")
"""Arrays of a problem that differ from world to world in one kernel call."""
STEP, MOVED, RESET, LOOK, SKIP = (np.uint8(order) for order in range(5))
"""Orders for a world: step it, count a step in which another physics has moved it, put it back to its start, only
observe it, or leave it alone altogether."""


class WorldBatch(NamedTuple):
    """``B`` worlds in the middle of their episodes; kernels change them in place.

    Attributes:
        start: ``(B, K, n)`` where an episode begins.
        goal: ``(B, K, d)``.
        inverse: ``(B, K)`` one over the start distances.
        state: ``(B, K, n)``.
        control: ``(B, K, m)``; what to do goes in, what was executed comes out.
        docked: ``(B, K)`` bool.
        steps: ``(B,)`` int64 steps since the reset.
        distance: ``(B, K)`` to the goals.
        bodies: ``(B, N, 2 d + 1)`` position, velocity and radius of dynamic obstacles, after the step.
        collided: ``(B, K)`` bool, hard contact; after ``MOVED``, what was in contact within the step goes in.
        violated: ``(B, K)`` bool, within the margin.
        rewards: ``(B, K)`` of each robot where it is now.
        reward: ``(B,)`` float64 mean of the team in the last step; zero at a reset.
        terminated: ``(B,)`` bool: all have docked.
        truncated: ``(B,)`` bool: out of time before that.
        total_reward: ``(B,)`` float64 sum over robots and steps of the episode.
        arrival: ``(B, K)`` int64 step since which a robot is at its goal, 0 for not there.
        contacts: ``(B, K)`` int64 steps in contact.
        violations: ``(B, K)`` int64 steps within the margin.
    """

    start: FloatArray
    goal: FloatArray
    inverse: FloatArray
    state: FloatArray
    control: FloatArray
    docked: BoolArray
    steps: IntArray
    distance: FloatArray
    bodies: FloatArray
    collided: BoolArray
    violated: BoolArray
    rewards: FloatArray
    reward: Floats
    terminated: BoolArray
    truncated: BoolArray
    total_reward: Floats
    arrival: IntArray
    contacts: IntArray
    violations: IntArray

    @classmethod
    def from_problem(cls, problem: Problem, num_worlds: int, num_bodies: int = 0) -> WorldBatch:
        """Worlds of one problem, all values but those of :data:`OWN_ARRAYS` still to be set by a reset."""
        start, goal, inverse = (np.repeat(getattr(problem.arrays, name)[None], num_worlds, 0) for name in OWN_ARRAYS)
        flags, counts = np.zeros(inverse.shape, np.bool_), np.zeros(inverse.shape, np.int64)
        return cls(
            start=start,
            goal=goal,
            inverse=inverse,
            state=start.copy(),
            control=np.zeros((*inverse.shape, problem.control_size), np.float32),
            docked=flags.copy(),
            steps=np.zeros(num_worlds, np.int64),
            distance=np.zeros_like(inverse),
            bodies=np.zeros((num_worlds, num_bodies, 2 * problem.dimension + 1), np.float32),
            collided=flags.copy(),
            violated=flags.copy(),
            rewards=np.zeros_like(inverse),
            reward=np.zeros(num_worlds),
            terminated=np.zeros(num_worlds, np.bool_),
            truncated=np.zeros(num_worlds, np.bool_),
            total_reward=np.zeros(num_worlds),
            arrival=counts.copy(),
            contacts=counts.copy(),
            violations=counts.copy(),
        )

    def select(self, worlds: slice) -> WorldBatch:
        """Some of the worlds, which share their memory with these."""
        return WorldBatch(*(part[worlds] for part in self))  # type: ignore[arg-type]


class WorldEngine(Engine, Protocol):
    """An engine with what environments need as well."""

    def observe_worlds(
        self, arrays: ProblemArrays, layout: ObservationLayout, sight: ObservationInputs, out: FloatArray
    ) -> None:
        """Fill ``out`` ``(B, K, D)`` with what every robot of every world sees, inside the layout's bounds."""
        ...

    def cast_rays(
        self, arrays: ProblemArrays, layout: ObservationLayout, state: FloatArray, bodies: FloatArray, out: FloatArray
    ) -> None:
        """Fill the rays of ``out`` ``(B, K, D)``, for states ``(B, K, n)`` among bodies ``(B, N, 2 d + 1)``."""
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
            orders: ``(B,)`` one of :data:`STEP` and its like for every world.
            batch: The worlds; ``batch.control`` holds what to do.
            out: ``(B, K, D)`` observations, output; those of skipped worlds are not written. ``(0, K, D)`` makes none.
        """
        ...


def checked_controls(problem: Problem, controls: ArrayLike, *, batch: bool = False) -> FloatArray:
    """``controls`` as a contiguous ``(H, K, m)`` float32 array, or with ``batch`` as ``(M, H, K, m)``.

    Raises:
        ValueError: If the shape is another, or a value is not finite or so large that its square would not be.
    """
    try:
        array = as_float32(controls)
    except ValueError as error:
        raise ValueError(f"controls must be an array of numbers; {error}") from None
    expected = (problem.horizon, problem.num_robots, problem.control_size)
    if array.ndim != 3 + batch or array.shape[batch:] != expected:
        asked = f"(M, H, K, m) = (M, {', '.join(map(str, expected))})" if batch else f"(H, K, m) = {expected}"
        raise ValueError(f"controls have shape {array.shape}; expected {asked}")
    if not np.isfinite(array).all():
        where = [int(i) for i in np.argwhere(~np.isfinite(array))[0]]
        raise ValueError(f"controls{where} is not finite; every control must be")
    if (np.abs(array) > LARGEST_NUMBER).any():
        where = [int(i) for i in np.argwhere(np.abs(array) > LARGEST_NUMBER)[0]]
        raise ValueError(
            f"controls{where} is {array[tuple(where)]:g}; it must be at most {LARGEST_NUMBER:g} in magnitude"
        )
    return array
