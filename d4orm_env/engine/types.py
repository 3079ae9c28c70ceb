"""What an engine is: what it is asked for, and what it answers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, TypeAlias

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


class MovingObstacles(NamedTuple):
    """Bodies that move along known paths, such as the robots outside a group that is replanned.

    Attributes:
        positions: ``(H, O, d)`` where each body is after every step [m].
        radius: ``(O,)`` [m].
    """

    positions: FloatArray
    radius: FloatArray


@dataclass(frozen=True, eq=False)
class SamplingTask:
    """What to sample around and how to score it.

    Attributes:
        problem: The robots that are sampled, their world and horizon.
        base: ``(H, K, m)`` controls that the sampled deformation is added to; zeros to sample controls themselves.
        collisions: Whether robots are penalised for coming near each other and near ``moving``.
        credit: ``"team"`` weights samples by the mean reward of the team (the paper), ``"robot"`` weights each robot's
            part of a sample by that robot's own reward.
        moving: Bodies to avoid that are not sampled, or ``None``.
        arrived: ``(K,)`` robots docked from the beginning, or ``None`` for none.
        penalty: What a violation of the margin costs per step, against a reward of one for standing at the goal.
        reference_distance: Distances count relative to the initial one (paper, section III-D), or to this if that is
            less: a robot that starts next to its goal then loses no more by waiting than others do. ``None`` for the
            paper's.
    """

    problem: Problem
    base: FloatArray
    collisions: bool = True
    credit: str = "team"
    moving: MovingObstacles | None = None
    arrived: BoolArray | None = None
    penalty: float = 1.0
    reference_distance: float | None = None

    @property
    def arrays(self) -> ProblemArrays:
        """The problem as this task scores it."""
        arrays = self.problem.arrays
        if self.reference_distance is None:
            return arrays
        inverse = np.minimum(arrays.inverse_initial_distance, np.float32(1 / self.reference_distance))
        inverse.setflags(write=False)
        return arrays._replace(inverse_initial_distance=inverse)


Rule: TypeAlias = Callable[..., Any]
"""It returns what the array library makes of its arrays."""


class SamplingRules(NamedTuple):
    """The rules that tell one sampling method from another: pure functions of arrays, in NumPy or JAX alike.

    Attributes:
        weights: ``(rewards, array library) -> weights``: from ``(1, M)`` or ``(K, M)`` rewards to weights that sum to
            one over the last axis. Rewards that are not finite arrive as minus infinity and must get weight zero.
        adapt: ``(noise, mean square deviation, array library) -> noise``: the noise of the next step, ``(H, K, m)``
            factors on the schedule; ``None`` leaves the schedule alone and saves the second moment.
        importance: Share of the importance-sampling term of MPPI (paper, Eq. 11) in the weights: ``weights`` then gets
            it as ``log_ratio``, like the rewards in shape. It is the logarithm of how much likelier a sample ``U``
            would be around zero than around ``U_hat``, the mean that it was drawn around, but for a constant:
            ``-U_hat / sigma^2 * (U - U_hat)``, summed over time and components, and over robots for team credit.
    """

    weights: Rule
    adapt: Rule | None = None
    importance: float = 0.0


class SamplingResult(NamedTuple):
    """One denoising run.

    Attributes:
        mean: ``(H, K, m)`` the last weighted mean of the deformations.
        rewards: ``(N,)`` mean reward of the samples at each step done: fewer than asked for where the run was stopped.
        excluded: Samples left out because their reward was not finite.
    """

    mean: FloatArray
    rewards: FloatArray
    excluded: int


class DenoisingStep(NamedTuple):
    """One step of a denoising run, for whoever watches it.

    Attributes:
        task: What is sampled around, and how it is scored.
        noise_scale: Standard deviation of the samples.
        mean: ``(H, K, m)`` the weighted mean of the deformations, which the next step samples around.
        samples: ``(S, H, K, m)`` the first deformations that it is the mean of, at most :data:`WATCHED_SAMPLES`.
        weights: ``(S,)`` what they count for with team credit, ``(K, S)`` with robot credit; those of all ``M`` samples
            add up to one.
    """

    task: SamplingTask
    noise_scale: float
    mean: FloatArray
    samples: FloatArray
    weights: FloatArray


WATCHED_SAMPLES = 8
"""Samples of a :class:`DenoisingStep`, where as many are drawn."""

StepWatcher = Callable[[DenoisingStep], object]


class Engine(Protocol):
    """The operations that the environment and the planners need from the physics."""

    name: str

    def step(self, arrays: ProblemArrays, states: FloatArray, arrived: BoolArray, controls: FloatArray) -> StepResult:
        """One step of the team from ``states`` ``(K, n)`` under ``controls`` ``(K, m)``, clipped here.

        ``arrays`` is ``problem.arrays``, or a copy with other goals where goals change on the way.
        """
        ...

    def rollout(self, problem: Problem, controls: ArrayLike) -> Trajectory:
        """Roll ``controls`` ``(H, K, m)`` out from the problem's start."""
        ...

    def prepare(self, task: SamplingTask, rules: SamplingRules, noise_scale: FloatArray, num_samples: int) -> None:
        """Compile all that rolling out and :meth:`denoise` with arguments of this kind need, if it is not yet."""
        ...

    def denoise(
        self,
        task: SamplingTask,
        rules: SamplingRules,
        mean: FloatArray,
        noise_scale: FloatArray,
        num_samples: int,
        seed: int,
        should_stop: Callable[[], bool] | None = None,
        watcher: StepWatcher | None = None,
    ) -> SamplingResult:
        """Run ``len(noise_scale)`` sample-score-update steps (paper, Algorithm 1, lines 2 to 7).

        Each step draws ``num_samples`` deformations around ``mean`` ``(H, K, m)`` with the step's standard deviation,
        rolls them out on top of ``task.base``, and replaces the mean by the weighted mean of the deformations.
        The noise is a function of ``seed`` and the step alone. Between steps ``should_stop`` is asked whether to leave
        the rest out; the result is then that of the steps done. After every step ``watcher`` is told of it.

        Raises:
            ValueError: If there is a watcher and the engine cannot look into its run.
        """
        ...


class Sight(NamedTuple):
    """What there is to see of ``B`` worlds.

    Attributes:
        goal: ``(B, K, d)`` [m].
        state: ``(B, K, n)``.
        control: ``(B, K, m)`` executed last.
        docked: ``(B, K)`` bool.
        bodies: ``(B, N, 2 d + 1)`` position [m], velocity [m/s] and radius [m] of what moves among the robots and is
            none; a radius of zero stands for one that is not seen.
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
    ) -> Sight:
        """Of one world, in arrays of its own: kernels are compiled anew for read-only ones."""
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

    def of(self, worlds: slice) -> Sight:
        """The same of some of the worlds."""
        return Sight(*(part[worlds] for part in self))  # type: ignore[arg-type]


class WorldEngine(Engine, Protocol):
    """An engine with what environments need as well."""

    def contacts(self, arrays: ProblemArrays, states: FloatArray) -> tuple[BoolArray, BoolArray]:
        """``(collided (K,), margin_violated (K,))`` of a team standing at ``states`` ``(K, n)``."""
        ...

    def observe_worlds(self, arrays: ProblemArrays, layout: ObservationLayout, sight: Sight, out: FloatArray) -> None:
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
            layout: Which components an observation has, and their bounds.
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
