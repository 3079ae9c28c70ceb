"""The state of a solve, and the sequence of its iterations."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from d4orm_env.core.arrays import FloatArray, whole_number
from d4orm_env.core.problem import Problem
from d4orm_env.core.seeds import Stream, derived_seed
from d4orm_env.core.trajectory import trajectory_metrics
from d4orm_env.engine.types import checked_controls
from d4orm_planners.base.candidate import Candidate, evaluate_controls
from d4orm_planners.base.plan import IterationRecord, Plan, Status
from d4orm_planners.base.provenance import Provenance
from d4orm_planners.base.working_plan import drive_further_in
from d4orm_planners.engine.sampling_types import (
    DenoisingStep,
    SamplingEngine,
    SamplingResult,
    SamplingRules,
    SamplingTask,
    StepWatcher,
    get_sampling_engine,
)

if TYPE_CHECKING:
    from d4orm_planners.base.planner import Planner, State


class Stopwatch:
    """Wall time since its construction, without pauses."""

    def __init__(self) -> None:
        self._start = time.perf_counter()
        self._paused = 0.0
        self._paused_since: float | None = None

    @property
    def elapsed(self) -> float:
        """Seconds so far."""
        return time.perf_counter() - self._start - self._paused

    @property
    def paused_seconds(self) -> float:
        """Seconds of all pauses so far, the present one included; other threads may read it."""
        since = self._paused_since
        return self._paused if since is None else self._paused + time.perf_counter() - since

    def leave_out(self, seconds: float) -> None:
        self._paused += seconds

    @contextmanager
    def paused(self) -> Iterator[None]:
        begin = self._paused_since = time.perf_counter()
        try:
            yield
        finally:
            self._paused_since = None
            self._paused += time.perf_counter() - begin


def _first_controls(problem: Problem, given: ArrayLike | None) -> FloatArray:
    """``(H, K, m)`` as given, or zeros."""
    if given is None:
        return np.zeros((problem.horizon, problem.num_robots, problem.control_size), np.float32)
    try:
        return checked_controls(problem, given)
    except ValueError as error:
        raise ValueError(f"initial_controls: {error}") from None


class SolveRun:
    """The state of a solve.

    Args:
        planner: Planner that iterates.
        problem: The problem.
        seed: Of the solve, non-negative.
        initial_controls: ``(H, K, m)`` to start from; zeros by default.
        engine: Engine for rollouts and samples, if not the planner's own.
        evaluate: Function that makes a candidate of an iteration's controls, if not :func:`evaluate_controls`.
        check_interval: Number of steps between checks for failures (paper, section VI-A); a solution keeps the margin
            at all steps.
        judged: Whether a solution must pass :func:`d4orm_env.verify` too.
    """

    def __init__(
        self,
        planner: Planner,
        problem: Problem,
        seed: int,
        initial_controls: ArrayLike | None = None,
        engine: SamplingEngine | None = None,
        evaluate: Callable[[FloatArray], Candidate] | None = None,
        check_interval: int = 1,
        judged: bool = True,
    ) -> None:
        self.planner = planner
        self.problem = problem
        self.engine = engine or get_sampling_engine(planner.config.engine)
        self.seed = whole_number(seed, "seed", 0)
        controls = _first_controls(problem, initial_controls)
        self.watch = Stopwatch()  #: Time used
        with self.watch.paused():
            # The first rollout may compile.
            self.engine.rollout(problem, controls)
        # A shorter plan is checked at its end.
        self.check_interval = min(check_interval, problem.horizon)
        of_controls = partial(
            evaluate_controls, self.engine, problem, check_interval=self.check_interval, judged=judged
        )
        self.current = self.best = of_controls(controls)  #: What the next iteration starts from, and the best so far
        self._evaluate = evaluate or of_controls
        self.iteration = self.denoising_steps = 0  #: Done so far
        self.denoising_time = 0.0  #: Seconds that were spent denoising
        self.history: list[IterationRecord] = []
        self.state: State = None  #: The planner's, of a type of its own; ``None`` before its first iteration
        self._began = False
        self.metrics: dict[str, float] = {}  #: Numbers of the method's own that the plan's metrics will have
        self.time_limit: float | None = None  #: Seconds that the solve may take, or ``None``
        self.watcher: StepWatcher | None = None  #: Observer of every denoising step, or ``None``
        #: Once set, by whatever thread, the iteration under way is left as if its time were over
        self.cancelled = threading.Event()

    @property
    def time_left(self) -> float | None:
        """Seconds left, zero when they are used up; ``None`` without a limit."""
        return None if self.time_limit is None else max(self.time_limit - self.watch.elapsed, 0.0)

    @property
    def is_over(self) -> bool:
        """True if there is a solution, and no better one is asked for."""
        return self.best.solved and not self.planner.config.improve

    def should_stop(self) -> bool:
        """Check whether the present iteration must end early."""
        return self.time_left == 0 or self.cancelled.is_set()

    def score(self, controls: ArrayLike) -> FloatArray:
        """``(M, K)`` rewards of ``M`` samples of controls ``(M, H, K, m)``, the mean over the steps.

        Raises:
            ValueError: If the controls have another shape or are not finite.
        """
        return self.engine.score(self.problem, controls)

    def denoise(
        self,
        task: SamplingTask,
        rules: SamplingRules,
        mean: FloatArray,
        noise_scale: FloatArray,
        num_samples: int,
        seed: int,
    ) -> SamplingResult:
        """See :meth:`SamplingEngine.denoise`; compiling is not counted, and time may end it."""
        with self.watch.paused():
            self.engine.prepare(task, rules, noise_scale, num_samples)
        # Engines of others need not know of watchers.
        watched = {} if self.watcher is None else {"watcher": self._tell}
        with self.denoising():
            return self.engine.denoise(task, rules, mean, noise_scale, num_samples, seed, self.should_stop, **watched)

    @contextmanager
    def denoising(self) -> Iterator[None]:
        """Count the time of the block as spent denoising."""
        begin = self.watch.elapsed
        try:
            yield
        finally:
            self.denoising_time += self.watch.elapsed - begin

    def _tell(self, step: DenoisingStep) -> None:
        with self.watch.paused():
            assert self.watcher is not None
            self.watcher(step)

    def iteration_seed(self, stream: Stream = Stream.SAMPLES, number: int = 0) -> int:
        """A seed for the present iteration's use of a stream with this number."""
        return derived_seed(self.seed, stream, self.iteration, number)

    def advance(self) -> IterationRecord:
        """Run one iteration, evaluate it and remember the best; the record that is kept has no arrays."""
        if not self._began:
            self.state, self._began = self.planner.init(self), True
        result = self.planner.iterate(self, self.state)
        if not (isinstance(result, tuple) and len(result) == 2 and hasattr(result[1], "controls")):
            kinds = [type(part).__name__ for part in (result if isinstance(result, tuple) else (result,))]
            raise ValueError(
                f"iterate() of planner {self.planner.name!r} returned {', '.join(kinds)}; write: return state, "
                "Iteration(controls)"
            )
        self.state, iteration = result
        candidate = iteration.evaluated or self._evaluate(checked_controls(self.problem, iteration.controls))
        self.current = drive_further_in(self, candidate, self._evaluate)
        self.iteration += 1
        self.denoising_steps += iteration.denoising_steps
        if self.current.rank > self.best.rank:
            self.best = self.current
        trajectory = self.current.trajectory
        record = IterationRecord(
            iteration=self.iteration,
            wall_time=self.watch.elapsed,
            denoising_steps=self.denoising_steps,
            reward=self.current.reward,
            solved=self.current.solved,
            num_failed=int(self.current.unsolved.sum()),
            num_margin_violated=int(trajectory.margin_violated[1:].any(axis=0).sum()),
            num_not_arrived=int((~trajectory.arrived[-1]).sum()),
            best_reward=self.best.reward,
            best_solved=self.best.solved,
            excluded=iteration.excluded,
            note=iteration.note,
            unreachable=iteration.unreachable,
            denoising_time=self.denoising_time,
        )
        self.history.append(record)
        return replace(record, controls=self.current.controls, trajectory=trajectory)

    def close(self) -> None:
        """Let the planner finish what it has begun."""
        if self._began:
            self._began = False
            self.planner.finish(self, self.state)

    def plan(self, status: Status) -> Plan:
        # Nodes may have reported a solution while they were closed.
        if self.is_over and status in ("iteration_limit", "time_limit"):
            status = "solved"
        return Plan(
            planner=self.planner.name,
            problem=self.problem,
            seed=self.seed,
            controls=self.best.controls,
            solved=self.best.solved,
            status=status,
            iterations=self.iteration,
            denoising_steps=self.denoising_steps,
            wall_time=self.watch.elapsed,
            history=tuple(self.history),
            trajectory=self.best.trajectory,
            metrics=trajectory_metrics(self.problem, self.best.trajectory) | self._denoising() | self.metrics,
            provenance=Provenance.here(self.planner.preset, self.planner.config.keywords()),
        )

    def _denoising(self) -> dict[str, float]:
        """Denoising steps done, and the share of the iterations that did some."""
        steps = [record.denoising_steps for record in self.history]
        denoised = np.diff(steps, prepend=0) > 0
        share = denoised.mean() if steps else 0.0
        return {"denoising_steps": float(self.denoising_steps), "denoising_share": float(share)}
