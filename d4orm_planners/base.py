"""The planner interface and the one loop that drives every planner: budget, callback, stopping, best plan so far."""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from d4orm_env.core.arrays import LARGEST, LARGEST_NUMBER, FloatArray, duration, whole_number
from d4orm_env.core.metrics import trajectory_metrics
from d4orm_env.core.problem import Problem
from d4orm_env.core.seeds import Stream, derived_seed
from d4orm_env.core.trajectory import Trajectory
from d4orm_env.engine.base import Engine, SamplingResult, SamplingRules, SamplingTask, checked_controls
from d4orm_env.engine.choice import get_engine
from d4orm_env.verify import verify
from d4orm_planners.plan import IterationRecord, Plan, failed_robots
from d4orm_planners.settings import CheckedSettings, Count, EngineName

Callback = Callable[[IterationRecord], Any]

PLAN_REACH = LARGEST_NUMBER / LARGEST
"""Times its limit that a planned control may be, so that no square of it overflows: some methods scale theirs up."""


class Stopwatch:
    """Wall time of a solve, without the time spent compiling."""

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
        """Seconds left out so far, those of a pause that lasts included; other threads may look."""
        since = self._paused_since
        return self._paused if since is None else self._paused + time.perf_counter() - since

    def leave_out(self, seconds: float) -> None:
        """Leave out some seconds of the time so far."""
        self._paused += seconds

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Leave the time of the block out."""
        begin = self._paused_since = time.perf_counter()
        try:
            yield
        finally:
            self._paused_since = None
            self._paused += time.perf_counter() - begin


@dataclass(frozen=True, kw_only=True)
class PlannerConfig(CheckedSettings):
    """Settings that every planner takes.

    Attributes:
        engine: ``"auto"``, ``"cpu"`` or ``"jax"``.
        max_iterations: Iterations after which :meth:`Planner.solve` gives up, unless told otherwise in the call.
        improve: Go on improving after the first solution, until the time or iteration budget is used up. By default the
            first solution ends the search.
    """

    engine: EngineName = "auto"
    max_iterations: Count = 50
    improve: bool = False


@dataclass(frozen=True)
class Candidate:
    """Controls and what they lead to.

    Attributes:
        planned: ``(H, K, m)`` as the method left them, at most :data:`PLAN_REACH` times the limits; zero once docked.
        controls: ``(H, K, m)`` as executed: inside the limits, zero once docked.
        trajectory: Their rollout.
        solved: Whether everyone arrives, the margin is kept at every step, and :func:`d4orm_env.verify` agrees.
        failed: ``(K,)`` robots that do not arrive, or violate the margin at some step.
    """

    planned: FloatArray
    controls: FloatArray
    trajectory: Trajectory
    solved: bool
    failed: np.ndarray

    @property
    def rank(self) -> tuple[bool, int, float]:
        """Larger is better: solved before unsolved, then fewer failed robots, then more reward."""
        reward = float(self.trajectory.rewards.mean())
        return (True, 0, reward) if self.solved else (False, -int(self.failed.sum()), reward)


def evaluate_controls(engine: Engine, problem: Problem, controls: FloatArray) -> Candidate:
    """Roll controls out and judge them."""
    reach = PLAN_REACH * problem.team.control_limits
    bounded = np.clip(controls, -reach, reach)
    trajectory = engine.rollout(problem, bounded)
    planned = np.where(trajectory.arrived[:-1, :, None], np.float32(0), bounded)
    failed = failed_robots(trajectory)
    solved = not failed.any() and verify(problem, trajectory.controls).ok
    return Candidate(planned, trajectory.controls, trajectory, solved, failed)


@dataclass(frozen=True)
class Iteration:
    """What a planner's iteration hands to the loop.

    Attributes:
        controls: ``(H, K, m)`` the new candidate.
        denoising_steps: Sample-score-update steps spent.
        excluded: Samples left out because their reward was not finite.
        note: What the method itself says of how the iteration ended, where it has a word for it.
        judged: What :func:`evaluate_controls` made of these controls, if the iteration asked; else the loop does.
    """

    controls: FloatArray
    denoising_steps: int = 0
    excluded: int = 0
    note: str = ""
    judged: Candidate | None = None


class Planner(ABC):
    """A method that turns a problem into a plan. Instances hold settings only; everything else lives in a solve.

    Attributes:
        name: What its plans say they are by; that of the class unless it gives another.
        config: The settings.
    """

    name: ClassVar[str]
    config_class: ClassVar[type[PlannerConfig]] = PlannerConfig
    presets: ClassVar[dict[str, dict[str, Any]]] = {}

    def __init_subclass__(cls) -> None:
        cls.name = cls.__dict__.get("name", cls.__name__)

    def __init__(self, config: PlannerConfig) -> None:
        self.config = config

    @abstractmethod
    def iterate(self, search: Search) -> Iteration:
        """One iteration from the search's current candidate to the next."""

    def finish(self, search: Search) -> None:  # noqa: B027 - a hook that most planners need not fill
        """Let go of what the iterations left open in ``search.memory``; called however a solve ends."""

    def solve(
        self,
        problem: Problem,
        seed: int = 0,
        time_limit: float | None = None,
        max_iterations: int | None = None,
        callback: Callback | None = None,
        initial_controls: Any = None,
    ) -> Plan:
        """Plan until a solution is found (or on, with ``improve``), the budget is used up, or Ctrl-C is pressed.

        Args:
            problem: What to solve.
            seed: Non-negative seed; the same seed gives the same plan.
            time_limit: Seconds, compilation not counted; looked at before every iteration, and within one between its
                denoising steps, repairs or IPOPT's iterations. An iteration that it cuts short ends with what it has
                by then, a candidate like any other. A limit that is not reached changes nothing.
            max_iterations: Iterations; the configured number by default.
            callback: Called with an :class:`IterationRecord` after every iteration; returning ``True`` stops.
            initial_controls: ``(H, K, m)`` to start from, zeros by default.

        Returns:
            The best plan found: a solved one with the most reward, else the one with the fewest robots failing.

        Raises:
            ValueError: If an argument makes no sense; the message names it.
        """
        if time_limit is not None:
            time_limit = duration(time_limit, "time_limit")
        limit = (
            self.config.max_iterations if max_iterations is None else whole_number(max_iterations, "max_iterations", 1)
        )
        search = Search(self, problem, seed, initial_controls)
        search.time_limit = time_limit
        status = "iteration_limit"
        try:
            while True:
                if search.best.solved and not self.config.improve:
                    status = "solved"
                    break
                if search.iteration >= limit:
                    break
                if search.time_left == 0:
                    status = "time_limit"
                    break
                record = search.advance()
                if callback is not None:
                    with search.watch.paused():
                        stop = callback(record)
                    if stop is True:
                        status = "stopped"
                        break
        except KeyboardInterrupt:
            status = "interrupted"
        finally:
            self.finish(search)
        return search.plan(status)


class Search:
    """One solve on its way.

    Attributes:
        problem: The problem.
        engine: What rolls out and samples.
        seed: The solve's seed.
        watch: Time used.
        current: The candidate that the next iteration starts from.
        best: The best candidate so far.
        iteration: Iterations done.
        memory: What a planner keeps between its own iterations.
        metrics: Numbers of the method's own that the plan's metrics will have.
        time_limit: Seconds that the solve may take, or ``None``.
        cancelled: Once set, by whatever thread, the iteration under way is left as if its time were over.
    """

    def __init__(
        self, planner: Planner, problem: Problem, seed: int, initial_controls: Any, engine: Engine | None = None
    ) -> None:
        self.planner = planner
        self.problem = problem
        self.engine = engine or get_engine(planner.config.engine)
        self.seed = whole_number(seed, "seed", 0)
        shape = (problem.horizon, problem.num_robots, problem.control_size)
        if initial_controls is None:
            controls = np.zeros(shape, np.float32)
        else:
            try:
                controls = checked_controls(problem, initial_controls)
            except ValueError as error:
                raise ValueError(f"initial_controls: {error}") from None
        self.watch = Stopwatch()
        with self.watch.paused():
            # The first rollout may compile.
            self.engine.rollout(problem, controls)
        self.current = self.best = evaluate_controls(self.engine, problem, controls)
        self.iteration = 0
        self.denoising_steps = 0
        self.history: list[IterationRecord] = []
        self.memory: dict[str, Any] = {}
        self.metrics: dict[str, float] = {}
        self.time_limit: float | None = None
        self.cancelled = threading.Event()

    @property
    def time_left(self) -> float | None:
        """Seconds left, zero when they are used up; ``None`` without a limit."""
        return None if self.time_limit is None else max(self.time_limit - self.watch.elapsed, 0.0)

    def should_stop(self) -> bool:
        """Whether an iteration must come to its end as it is."""
        return self.time_left == 0 or self.cancelled.is_set()

    def denoise(
        self,
        task: SamplingTask,
        rules: SamplingRules,
        mean: FloatArray,
        noise_scale: FloatArray,
        num_samples: int,
        seed: int,
    ) -> SamplingResult:
        """See :meth:`d4orm_env.engine.base.Engine.denoise`; compiling is not counted, and time may end it."""
        with self.watch.paused():
            self.engine.prepare(task, rules, noise_scale, num_samples)
        return self.engine.denoise(task, rules, mean, noise_scale, num_samples, seed, self.should_stop)

    def iteration_seed(self, stream: Stream = Stream.SAMPLES, number: int = 0) -> int:
        """A seed for the present iteration's use of a stream with this number."""
        return derived_seed(self.seed, stream, self.iteration, number)

    def advance(self) -> IterationRecord:
        """Run one iteration, judge it and remember the best."""
        iteration = self.planner.iterate(self)
        self.current = iteration.judged or evaluate_controls(self.engine, self.problem, iteration.controls)
        self.iteration += 1
        self.denoising_steps += iteration.denoising_steps
        if self.current.rank > self.best.rank:
            self.best = self.current
        trajectory = self.current.trajectory
        record = IterationRecord(
            iteration=self.iteration,
            wall_time=self.watch.elapsed,
            denoising_steps=self.denoising_steps,
            reward=float(trajectory.rewards.mean()),
            solved=self.current.solved,
            num_failed=int(self.current.failed.sum()),
            num_margin_violated=int(trajectory.margin_violated[1:].any(axis=0).sum()),
            num_not_arrived=int((~trajectory.arrived[-1]).sum()),
            best_reward=float(self.best.trajectory.rewards.mean()),
            best_solved=self.best.solved,
            excluded=iteration.excluded,
            note=iteration.note,
        )
        self.history.append(record)
        return record

    def plan(self, status: str) -> Plan:
        """The best candidate as a plan."""
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
            metrics=trajectory_metrics(self.problem, self.best.trajectory) | self.metrics,
        )
