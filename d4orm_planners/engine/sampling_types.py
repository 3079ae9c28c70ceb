"""Sampling engines by name, their requests and their answers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, TypeAlias

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray
from d4orm_env.core.bodies import FootprintArrays
from d4orm_env.core.lazy import LazyModule
from d4orm_env.core.problem import Problem
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.core.team import Team
from d4orm_env.engine.choice import resolve_engine
from d4orm_env.engine.types import Engine

if TYPE_CHECKING:
    from d4orm_planners.engine import cpu_sampling, jax_sampling
else:
    cpu_sampling = LazyModule("d4orm_planners.engine.cpu_sampling")
    jax_sampling = LazyModule("d4orm_planners.engine.jax_sampling")


class MovingObstacles(NamedTuple):
    """Bodies that move along known paths, such as the robots outside a group that is replanned."""

    positions: FloatArray  #: ``(H, O, d)`` where each body is after every step [m]
    radius: FloatArray  #: ``(O,)`` [m]; outer radii of bodies that are no discs
    footprints: FootprintArrays | None = None  #: Theirs; ``None`` where all are discs
    headings: FloatArray | None = None  #: ``(H, F)`` what turns them and trailers [rad]; ``None`` where all are discs


def moving_robots(team: Team, states: FloatArray) -> MovingObstacles:
    """The robots of a team as moving obstacles; ``states`` ``(H, K, n)`` are theirs after every step."""
    turning = team.body_poses(states)[..., -1].astype(np.float32) if team.shapes else None
    return MovingObstacles(states[..., : team.dimension], team.radius, team.footprint_arrays, turning)


@dataclass(frozen=True, eq=False)
class SamplingTask:
    """Distribution to sample from, and rules to score by."""

    problem: Problem  #: The robots that are sampled, their world and horizon
    base: FloatArray  #: ``(H, K, m)`` controls that the sampled deformation is added to; zeros for controls themselves
    collisions: bool = True  #: Whether robots are penalised for coming near each other and near ``moving``
    #: ``"team"`` weights samples by the mean reward of the team (the paper), ``"robot"`` weights each robot's part of a
    #: sample by that robot's own reward
    credit: str = "team"
    moving: MovingObstacles | None = None  #: Bodies to avoid that are not sampled, or ``None``
    arrived: BoolArray | None = None  #: ``(K,)`` robots arrived from the beginning, or ``None`` for none
    penalty: float | FloatArray = 1.0  #: Factor of the problem's collision penalty: of all robots, or ``(K,)`` of each
    penalty_per_pair: bool = False  #: A robot pays for every robot and moving body that it is near, not once for all
    #: Factors on the noise of the first step that go with ``(H, K, m)``: zero for robots that are not sampled, so that
    #: their base stays
    noise_factor: float | FloatArray = 1.0
    #: Distances count relative to the initial one (paper, section III-D), or to this if that is less: a robot that
    #: starts next to its goal then loses no more by waiting than others do. ``None`` for the paper's.
    reference_distance: float | None = None

    @property
    def penalties(self) -> FloatArray:
        """``(K,)`` cost of a violation to each robot per step."""
        penalties = np.asarray(self.penalty, np.float64) * self.problem.collision_penalty
        return np.full(self.problem.num_robots, penalties, np.float32)

    @property
    def first_factor(self) -> FloatArray:
        """``(H, K, m)`` factors on the noise of the first step."""
        return np.broadcast_to(np.asarray(self.noise_factor, np.float32), self.base.shape).copy()

    @property
    def arrays(self) -> ProblemArrays:
        """The problem as this task scores it, but for the penalties."""
        arrays = self.problem.arrays
        if self.reference_distance is None:
            return arrays
        inverse = np.minimum(arrays.inverse_initial_distance, np.float32(1 / self.reference_distance))
        inverse.setflags(write=False)
        return arrays._replace(inverse_initial_distance=inverse)


Rule: TypeAlias = Callable[..., Any]  #: It returns arrays of the library of its arguments


class SamplingRules(NamedTuple):
    """The rules that tell one sampling method from another: pure functions of arrays, in NumPy or JAX alike."""

    #: ``(rewards, array library) -> weights``: from ``(1, M)`` or ``(K, M)`` rewards to weights that sum to one over
    #: the last axis. Rewards that are not finite arrive as minus infinity and must get weight zero.
    weights: Rule
    #: ``(mean square deviation, array library) -> noise``: the noise of the next step, ``(H, K, m)`` factors on the
    #: schedule, the deviation being in units; ``None`` leaves the schedule alone and saves the second moment
    adapt: Rule | None = None
    #: Share of the importance-sampling term of MPPI (paper, Eq. 11) in the weights: ``weights`` then gets it as
    #: ``log_ratio``, like the rewards in shape. It is the logarithm of how much likelier a sample ``U`` would be around
    #: zero than around ``U_hat``, the mean that it was drawn around, but for a constant:
    #: ``-U_hat / sigma^2 * (U - U_hat)``, summed over time and components, and over robots for team credit.
    importance: float = 0.0


class SamplingResult(NamedTuple):
    """One denoising run."""

    mean: FloatArray  #: ``(H, K, m)`` the last weighted mean of the deformations
    rewards: FloatArray  #: ``(N,)`` mean reward of the samples at each step done: fewer where the run was stopped
    excluded: int  #: Samples left out because their reward was not finite
    noise_factor: float | FloatArray = 1.0  #: Factors on the noise of a next step, that go with ``(H, K, m)``


class DenoisingStep(NamedTuple):
    """One step of a denoising run, for observers."""

    task: SamplingTask  #: Distribution of the samples, and their scoring
    noise_scale: float  #: Standard deviation of the samples
    mean: FloatArray  #: ``(H, K, m)`` the weighted mean of the deformations, which the next step samples around
    samples: FloatArray  #: ``(S, H, K, m)`` the first deformations that it averages, up to :data:`WATCHED_SAMPLES`
    #: ``(S,)`` what they count for with team credit, ``(K, S)`` with robot credit; those of all ``M`` samples add up to
    #: one
    weights: FloatArray


WATCHED_SAMPLES = 8  #: Samples of a :class:`DenoisingStep`, where as many are drawn
StepWatcher = Callable[[DenoisingStep], object]


class SamplingEngine(Engine, Protocol):
    """An engine that can draw, roll out and score samples as well."""

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
        in :attr:`~d4orm_env.core.team.Team.control_units`, rolls them out on top of ``task.base``, and replaces the
        mean by the weighted mean of the deformations.
        The noise is a function of ``seed`` and the step alone. Between steps ``should_stop`` is asked whether to leave
        the rest out; the result is then that of the steps done. After every step ``watcher`` is told of it.

        Raises:
            ValueError: If there is a watcher and the engine cannot look into its run.
        """
        ...


def get_sampling_engine(name: str = "auto", num_threads: int | None = None) -> SamplingEngine:
    """Return the sampling engine of that name; arguments and errors as :func:`d4orm_env.engine.choice.get_engine`."""
    if resolve_engine(name) == "jax":
        return jax_sampling.JaxSamplingEngine()
    return cpu_sampling.CpuSamplingEngine(num_threads)
