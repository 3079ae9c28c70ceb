"""Interface of an engine: its inputs and its results."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from d4orm_env.core.arrays import LARGEST_NUMBER, BoolArray, FloatArray, Floats, IntArray, numbers_of
from d4orm_env.core.problem import Problem
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.core.trajectory import Trajectory


class StepResult(NamedTuple):
    """One step of the whole team."""

    states: FloatArray  #: ``(K, n)`` after the step
    controls: FloatArray  #: ``(K, m)`` as executed: clipped, zero for docked robots
    arrived: BoolArray  #: ``(K,)`` bool
    collided: BoolArray  #: ``(K,)`` bool, hard contact
    margin_violated: BoolArray  #: ``(K,)`` bool
    rewards: FloatArray  #: ``(K,)``


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
        """Roll ``controls`` ``(H, K, m)`` out from the problem's start; ``ValueError`` as :func:`checked_controls`."""
        ...

    def score(self, problem: Problem, controls: ArrayLike) -> FloatArray:
        """Roll ``M`` samples of controls ``(M, H, K, m)`` out; ``(M, K)`` rewards, the mean over the steps."""
        ...


class ObservationInputs(NamedTuple):
    """Inputs to the observations of ``B`` worlds."""

    goal: FloatArray  #: ``(B, K, d)`` [m]
    state: FloatArray  #: ``(B, K, n)``
    control: FloatArray  #: ``(B, K, m)`` executed last
    arrived: BoolArray  #: ``(B, K)`` bool
    #: ``(B, N, 2 d + 1)`` position [m], velocity [m/s] and radius [m] of what moves among the robots and is none; a
    #: radius of zero for one that is not seen
    bodies: FloatArray
    time_left: FloatArray  #: ``(B,)`` share of the time left, 1 to 0

    def select(self, worlds: slice) -> ObservationInputs:
        """The same of some of the worlds."""
        return ObservationInputs(*(part[worlds] for part in self))  # type: ignore[arg-type]


OWN_ARRAYS = ("start", "goal", "inverse_initial_distance")
"""Arrays of a problem that differ from world to world in one kernel call."""
STEP, MOVED, RESET, LOOK, SKIP = (np.uint8(order) for order in range(5))
"""Orders for a world: step it, count a step in which another physics has moved it, put it back to its start, only
observe it, or leave it alone altogether."""


class WorldBatch(NamedTuple):
    """``B`` worlds in the middle of their episodes; kernels change them in place."""

    start: FloatArray  #: ``(B, K, n)`` where an episode begins
    goal: FloatArray  #: ``(B, K, d)``
    inverse: FloatArray  #: ``(B, K)`` one over the start distances
    state: FloatArray  #: ``(B, K, n)``
    control: FloatArray  #: ``(B, K, m)``; what to do goes in, what was executed comes out
    arrived: BoolArray  #: ``(B, K)`` bool
    steps: IntArray  #: ``(B,)`` int64 steps since the reset
    distance: FloatArray  #: ``(B, K)`` to the goals
    bodies: FloatArray  #: ``(B, N, 2 d + 1)`` position, velocity and radius of dynamic obstacles, after the step
    collided: BoolArray  #: ``(B, K)`` bool, hard contact; after ``MOVED``, what was in contact within the step goes in
    violated: BoolArray  #: ``(B, K)`` bool, within the margin
    rewards: FloatArray  #: ``(B, K)`` of each robot where it is now
    reward: Floats  #: ``(B,)`` float64 mean of the team in the last step; zero at a reset
    terminated: BoolArray  #: ``(B,)`` bool: all have docked
    truncated: BoolArray  #: ``(B,)`` bool: out of time before that
    total_reward: Floats  #: ``(B,)`` float64 sum over robots and steps of the episode
    arrival: IntArray  #: ``(B, K)`` int64 step since which a robot is at its goal, 0 for not there
    contacts: IntArray  #: ``(B, K)`` int64 steps in contact
    violations: IntArray  #: ``(B, K)`` int64 steps within the margin

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
            arrived=flags.copy(),
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


def checked_controls(problem: Problem, controls: ArrayLike, *, batch: bool = False) -> FloatArray:
    """``(H, K, m)`` controls as a contiguous float32 array, or with ``batch`` ``(M, H, K, m)``, with finite squares."""
    if hasattr(controls, "controls"):
        raise ValueError(f"controls must be an array of numbers, not {type(controls).__name__}; give its controls")
    array: FloatArray = numbers_of(controls, "controls must be an array of numbers")
    expected = (problem.horizon, problem.num_robots, problem.control_size)
    if array.ndim != 3 + batch or array.shape[batch:] != expected:
        asked = f"(M, H, K, m) = (M, {', '.join(map(str, expected))})" if batch else f"(H, K, m) = {expected}"
        fits = not batch and array.size > 0 and array.shape[1:] == expected[1:]
        remedy = f"; for so many steps, give problem.replace(horizon={len(array)})" if fits else ""
        raise ValueError(f"controls have shape {array.shape}; expected {asked}{remedy}")
    if not np.isfinite(array).all():
        where = [int(i) for i in np.argwhere(~np.isfinite(array))[0]]
        raise ValueError(f"controls{where} is not finite; every control must be")
    if (np.abs(array) > LARGEST_NUMBER).any():
        where = [int(i) for i in np.argwhere(np.abs(array) > LARGEST_NUMBER)[0]]
        raise ValueError(
            f"controls{where} is {array[tuple(where)]:g}; it must be at most {LARGEST_NUMBER:g} in magnitude"
        )
    return array
