"""D4orm-C2F: receding-horizon control along a coarse plan (paper, section VI, Algorithm 4)."""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np

from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.problem import Problem
from d4orm_env.core.seeds import Stream, derived_seed, generator
from d4orm_env.core.trajectory import Trajectory
from d4orm_env.engine.base import SamplingRules, SamplingTask
from d4orm_env.engine.choice import get_engine
from d4orm_env.joint_state import JointState, split_state
from d4orm_planners.base import Search
from d4orm_planners.d4orm_d import D4ormD, D4ormDConfig
from d4orm_planners.guidance import (
    Guidance,
    coarse_problem,
    interpolate,
    nearest_indices,
    passes_checks,
    rest_of,
    subgoal_indices,
)
from d4orm_planners.policy import StatePolicy
from d4orm_planners.sampling.schedule import annealed
from d4orm_planners.sampling.weights import SoftmaxWeights
from d4orm_planners.settings import (
    CheckedSettings,
    Count,
    EngineName,
    NotNegative,
    Positive,
    Samples,
    Steps,
    Variance,
    one_of,
)
from d4orm_planners.steering import straight_drives, track_velocities

Credit = Annotated[str, one_of(("robot", "team"))]
Refinement = Annotated[str, one_of(("background", "sync", "off"))]

NOT_AT_SUBGOALS = 1e-6
"""Goal radius while everyone is on the way: a robot drives through its subgoal [m]."""

LAG = 5
"""Waypoints that a robot may be behind the others without its subgoal staying behind too."""

SHORTER = 3
"""How many times fewer fresh steps a robot takes before it stops if it would violate the margin otherwise."""

NEARER = 0.05
"""What counts as coming nearer to the goals, all robots together [m]."""


@dataclass(frozen=True, kw_only=True)
class D4ormC2FConfig(CheckedSettings):
    """Settings of :class:`D4ormC2F`.

    Attributes:
        engine: ``"auto"``, ``"cpu"`` or ``"jax"``.
        coarse_factor: ``f``, fine time steps per coarse one.
        check_interval: ``o``: the coarse plan must keep the margin at every so-manyth coarse step.
        coarse_samples: ``M`` of the coarse plan.
        coarse_steps: ``N`` of the coarse plan.
        coarse_repair_steps: The same of repairs of the coarse plan.
        coarse_iterations: Iterations after which the coarse plan is taken as it is.
        replan_iterations: The same when only some robots have new goals.
        predict_horizon: ``H_predict``, steps that a control loop looks ahead.
        execute_horizon: ``H_execute``, steps executed before the next control loop.
        subgoal_offset: ``m``, waypoints from where the team is to its subgoal.
        num_samples: ``M`` of a control loop.
        num_steps: ``N`` of a control loop.
        temperature: ``lambda`` of the softmax.
        beta_start: First variance of the diffusion schedule of a control loop.
        beta_end: Last variance.
        credit: ``"robot"`` or ``"team"``: whose reward weights the samples of a control loop.
        penalty: What a violation costs per step in a control loop, against the paper's one.
        extra_margin: Added to the problem's margin in control loops, as room for disturbances [m].
        refine: Whether the guidance is refined while it is followed: in a ``"background"`` thread, ``"sync"`` between
            control loops, which gives the same controls every time, or ``"off"``.
        refine_every: At most every so-manyth control loop a refinement begins: it takes time from control loops.
        replan_distance: The guidance is planned anew when the robots are this far from it on average [m].
        patience: Or when they have come no nearer to their goals for so many steps.
        deadline: Seconds that a control loop may take; one that takes longer is left behind, and the last plan goes on.
            ``None`` waits for every loop.
        control_noise_std: Gaussian noise that the controller adds to its controls, in their units.

    Raises:
        ValueError: If a value makes no sense; the message names it.
    """

    engine: EngineName = "auto"
    coarse_factor: Steps = 2
    check_interval: Steps = 1
    coarse_samples: Samples = 256
    coarse_steps: Steps = 50
    coarse_repair_steps: Steps = 20
    coarse_iterations: Count = 20
    replan_iterations: Count = 2
    predict_horizon: Steps = 20
    execute_horizon: Steps = 1
    subgoal_offset: Steps = 15
    num_samples: Samples = 128
    num_steps: Steps = 20
    temperature: Positive = 0.3
    beta_start: Variance = 1e-4
    beta_end: Variance = 2e-2
    credit: Credit = "robot"
    penalty: Positive = 10.0
    extra_margin: NotNegative = 0.0
    refine: Refinement = "background"
    refine_every: Count = 5
    replan_distance: Positive = 1.0
    patience: Count = 15
    deadline: Positive | None = None
    control_noise_std: NotNegative = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.beta_start > self.beta_end:
            raise ValueError(f"beta_start {self.beta_start:g} is above beta_end {self.beta_end:g}; swap them")
        if self.execute_horizon > self.predict_horizon:
            raise ValueError(
                f"execute_horizon is {self.execute_horizon}, more than the {self.predict_horizon} steps predicted; "
                "raise predict_horizon"
            )


@dataclass(frozen=True)
class LoopRecord:
    """What one control loop did.

    Attributes:
        step: The environment's step at which it began.
        wall_time: Time used [s].
        subgoal_index: Waypoint of the guidance that the team headed for.
        predicted_margin: Least gap between the surfaces of any two robots over the prediction [m]; infinite for one
            robot.
        missed: Whether it took longer than the deadline, so that the last plan went on.
        replanned: Whether the guidance was planned anew.
        refined: Whether a refined guidance was taken over.
    """

    step: int
    wall_time: float
    subgoal_index: int
    predicted_margin: float
    missed: bool
    replanned: bool
    refined: bool


class D4ormC2F(StatePolicy):
    """Follows a coarse plan of the whole team by short fine plans from wherever the robots are, loop by loop.

    Attributes:
        config: The settings.
        loops: A :class:`LoopRecord` per control loop of the present episode.
        coarse_time: Time that the first coarse plan took [s].
        guidance: What is followed at present.
    """

    name = "d4orm-c2f"
    config_class: ClassVar[type[CheckedSettings] | None] = D4ormC2FConfig
    guidance: Guidance

    def __init__(self, config: D4ormC2FConfig | None = None) -> None:
        self.config = config or D4ormC2FConfig()
        self._engine = get_engine(self.config.engine)
        self._rules = SamplingRules(SoftmaxWeights(self.config.temperature, 1e-3))
        self._noise_scale = annealed(self.config.num_steps, self.config.beta_start, self.config.beta_end)
        self._planner = D4ormD(
            D4ormDConfig(
                engine=self.config.engine,
                num_samples=self.config.coarse_samples,
                num_steps=self.config.coarse_steps,
                repair_steps=self.config.coarse_repair_steps,
                improve=True,
            )
        )
        # On one thread the refinement leaves the other cores, and their threads, to the control loop.
        self._refiner = get_engine(self.config.engine, 1 if self.config.refine == "background" else None)
        self._refinement = _Background(yielding=True)
        self._control = _Background()

    @property
    def missed(self) -> int:
        """Control loops that missed the deadline."""
        return sum(loop.missed for loop in self.loops)

    def _begin(self, env: Any, seed: int) -> None:
        self._seed = seed
        self._random = generator(seed, Stream.CONTROLLER_NOISE)
        self._refinement.forget()
        self._control.forget()
        self.loops: list[LoopRecord] = []
        joint = split_state(self.problem, env.state())
        self._docks = not env.unwrapped.lifelong
        self._prepare(joint)
        limits = self.problem.team.limits
        self._stop_steps = int(np.ceil(np.max(limits[:, 0] / (limits[:, 1] * self.problem.dt))))
        self._plan, self._next = self._no_controls(), 0
        begin = time.perf_counter()
        self._follow(
            joint, self._coarse_plan(joint, None, self.config.coarse_iterations), np.ones(self.problem.num_robots, bool)
        )
        self.coarse_time = time.perf_counter() - begin

    def _prepare(self, joint: JointState) -> None:
        """Compile, so that the first control loop is as quick as the others."""
        window = self.problem.moment(joint.states, joint.goals, horizon=self.config.predict_horizon)
        task = SamplingTask(window, self._no_controls(), arrived=joint.arrived)
        self._engine.prepare(task, self._rules, self._noise_scale, self.config.num_samples)

    def _no_controls(self) -> FloatArray:
        shape = (self.config.predict_horizon, self.problem.num_robots, self.problem.control_size)
        return np.zeros(shape, np.float32)

    # The guidance.

    def _follow(self, joint: JointState, guidance: Guidance, anew: Any) -> None:
        """Begin at the beginning of a guidance, which sends the robots ``anew`` ``(K,)`` another way than before."""
        self._anew = anew
        self.guidance = guidance
        self._index, self._indices = 0, np.zeros(len(joint.goals), int)
        self._goals = joint.goals
        self._nearest, self._nearest_at = float("inf"), joint.steps

    def _coarse_plan(self, joint: JointState, initial: Any, iterations: int) -> Guidance:
        """Plan for the whole team from where it is, until a plan passes the checks (Algorithm 4, lines 1 to 3)."""
        present = self.problem.moment(joint.states, joint.goals)
        coarse = coarse_problem(present, self.config.coarse_factor)
        search = Search(self._planner, coarse, derived_seed(self._seed, Stream.COARSE_PLAN, joint.steps), initial)
        chosen = search.current
        for _ in range(iterations):
            if passes_checks(chosen.trajectory, self.config.check_interval):
                break
            search.advance()
            chosen = search.current if search.current.rank >= search.best.rank else search.best
            if passes_checks(search.current.trajectory, self.config.check_interval):
                chosen = search.current
        return self._guidance(coarse, chosen.trajectory)

    def _guidance(self, coarse: Problem, trajectory: Trajectory) -> Guidance:
        path = interpolate(trajectory.positions, self.config.coarse_factor)
        return Guidance(coarse, trajectory.controls, trajectory.states, path)

    def _refined(self, guidance: Guidance, index: int, seed: int) -> Guidance:
        """The guidance with what is left of it from a waypoint on made better, if that succeeds (line 4)."""
        factor = self.config.coarse_factor
        left, controls = rest_of(guidance, index, factor)
        search = Search(self._planner, left, seed, controls, self._refiner)
        search.advance()
        done = guidance.problem.horizon - left.horizon
        before, after = guidance.states[: done + 1], search.best.trajectory
        states = np.concatenate([before, after.states[1:]])
        positions = np.concatenate([before[..., : left.dimension], after.positions[1:]])
        all_controls = np.concatenate([guidance.controls[:done], after.controls])
        return Guidance(guidance.problem, all_controls, states, interpolate(positions, factor))

    def _refine(self, step: int) -> bool:
        """Take over what the refinement has done meanwhile, and give it more to do."""
        index = self._index + self.config.subgoal_offset
        if self.config.refine == "off" or index >= len(self.guidance.path) - 1:
            return False
        guidance, seed = self.guidance, derived_seed(self._seed, Stream.REFINEMENT, step)
        due = len(self.loops) % self.config.refine_every == 0
        if self.config.refine == "sync":
            if due:
                self.guidance = self._refined(guidance, index, seed)
            return self.guidance is not guidance
        done, refined = self._refinement.result()
        # What was refined may have been replanned since.
        if refined is not None and refined.problem is guidance.problem:
            self.guidance = guidance = refined
        if done and due:
            self._refinement.start(lambda: self._refined(guidance, index, seed))
        return self.guidance is refined

    # The control loop.

    def _controls(self, joint: JointState) -> FloatArray:
        executed = self._next
        if not self.loops or executed >= self.config.execute_horizon:
            self._loop(joint)
        controls = self._plan[min(self._next, len(self._plan) - 1)]
        self._next += 1
        if self.config.control_noise_std:
            noise = self._random.normal(0, self.config.control_noise_std, controls.shape)
            limit = self.problem.team.control_limits
            controls = np.clip(controls + noise, -limit, limit).astype(np.float32)
        return controls

    def _loop(self, joint: JointState) -> None:
        """One control loop (Algorithm 4, lines 6 to 9)."""
        begin = time.perf_counter()
        docked = joint.arrived & self._at_goal(joint)
        replanned = self._replan_if_needed(joint, docked)
        refined = not replanned and self._refine(joint.steps)
        targets = self._targets(joint, docked)
        subgoals = self.guidance.path[targets, np.arange(len(targets))]
        base = self._base()
        seed = derived_seed(self._seed, Stream.CONTROL_LOOP, joint.steps)

        def predict() -> tuple[FloatArray, float]:
            return self._predict(joint, docked, subgoals, base, seed)

        if self.config.deadline is None:
            result = predict()
        else:
            left = self.config.deadline - (time.perf_counter() - begin)
            result = self._control.run(predict, left)
        missed = result is None
        if result is not None:
            self._plan, self._next = result[0], 0
        margin = result[1] if result is not None else float("nan")
        used = time.perf_counter() - begin
        self.loops.append(LoopRecord(joint.steps, used, int(targets.max()), margin, missed, replanned, refined))

    def _targets(self, joint: JointState, docked: Any) -> Any:
        """``(K,)`` waypoints that the robots head for; finds out where on the path they are (Algorithm 4, line 6)."""
        path, offset = self.guidance.path, self.config.subgoal_offset
        positions = joint.states[:, : self.problem.dimension]
        self._indices = nearest_indices(path, positions, self._indices, offset)
        if not docked.all():
            self._index = round(float(self._indices[~docked].mean()))
        return subgoal_indices(self._indices, self._index, offset, LAG, len(path) - 1)

    def _base(self) -> FloatArray:
        """``(H_predict, K, m)`` controls to deform: the last plan's, moved on in time."""
        base = self._no_controls()
        horizon = self.config.predict_horizon
        ahead = self._plan[self._next : horizon]
        base[: len(ahead)] = ahead
        if self._anew.any():
            # Those that are sent another way begin with the coarse plan's, each held for as long as it stands for.
            held = np.repeat(self.guidance.controls, self.config.coarse_factor, axis=0)[:horizon]
            base[:, self._anew] = 0
            base[: len(held), self._anew] = held[:, self._anew]
            self._anew = np.zeros_like(self._anew)
        return base

    def _at_goal(self, joint: JointState) -> Any:
        gap = joint.goals - joint.states[:, : self.problem.dimension]
        return np.linalg.norm(gap, axis=1) <= self.problem.goal_radius

    def _replan_if_needed(self, joint: JointState, docked: Any) -> bool:
        """Plan the guidance anew for robots with new goals, for a team that lost it or has come to its end."""
        changed = (joint.goals != self._goals).any(axis=1)
        moving = ~docked
        if not moving.any():
            return False
        waypoints = self.guidance.path[self._indices, np.arange(len(moving))]
        away = np.linalg.norm(joint.states[:, : self.problem.dimension] - waypoints, axis=1)[moving].mean()
        lost = away > self.config.replan_distance or self._index >= len(self.guidance.path) - 1
        lost = self._is_stuck(joint, moving) or lost
        if not changed.any() and not lost:
            return False
        present = coarse_problem(self.problem.moment(joint.states, joint.goals), self.config.coarse_factor)
        initial = straight_drives(present).controls[:, :, 0]
        keep = moving & ~changed
        if not lost and keep.any():
            step = self._index // self.config.coarse_factor
            rest = self.guidance.controls[step:]
            initial[:, keep] = 0
            initial[: len(rest), keep] = rest[:, keep]
        iterations = self.config.coarse_iterations if lost else self.config.replan_iterations
        self._follow(joint, self._coarse_plan(joint, initial, iterations), ~keep | lost)
        return True

    def _is_stuck(self, joint: JointState, moving: Any) -> bool:
        """Whether the robots under way have not come nearer to their goals for a while."""
        gap = joint.goals[moving] - joint.states[moving, : self.problem.dimension]
        distance = float(np.linalg.norm(gap, axis=1).sum())
        if distance < self._nearest - NEARER:
            self._nearest, self._nearest_at = distance, joint.steps
        return joint.steps - self._nearest_at > self.config.patience

    def _predict(
        self, joint: JointState, docked: Any, subgoals: FloatArray, base: FloatArray, seed: int
    ) -> tuple[FloatArray, float]:
        """Fine controls ``(H_predict, K, m)`` towards the subgoals, and the least gap between robots that they keep."""
        problem, config = self.problem, self.config
        near = np.linalg.norm(subgoals - joint.goals, axis=1) <= problem.goal_radius
        goals = np.where((near | docked)[:, None], joint.goals, subgoals)
        radius = problem.goal_radius if near.any() and self._docks else NOT_AT_SUBGOALS
        window = problem.moment(
            joint.states,
            goals,
            horizon=config.predict_horizon,
            margin=problem.margin + config.extra_margin,
            goal_radius=radius,
        )
        ahead = problem.dt * config.subgoal_offset * float(np.max(np.asarray(problem.team.max_speed)))
        task = SamplingTask(
            window,
            base,
            credit=config.credit,
            arrived=docked,
            penalty=config.penalty,
            reference_distance=ahead,
        )
        result = self._engine.denoise(
            task, self._rules, np.zeros_like(base), self._noise_scale, config.num_samples, seed
        )
        limit = problem.team.control_limits
        controls = np.clip(base + result.mean, -limit, limit).astype(np.float32)
        radius = problem.goal_radius if self._docks else NOT_AT_SUBGOALS
        truth = problem.moment(joint.states, joint.goals, horizon=config.predict_horizon, goal_radius=radius)
        return self._safe_mix(truth, controls, docked)

    def _with_stop(self, window: Problem, controls: FloatArray, steps: int, docked: Any) -> FloatArray:
        """The first ``steps`` controls, and after them those that bring everyone to rest as soon as can be.

        Returns:
            ``(H_predict + S, K, m)`` with the ``S`` steps that a stop may take.
        """
        stopping = np.zeros((len(controls) + self._stop_steps, *controls.shape[1:]), np.float32)
        stopping[:steps] = controls[:steps]
        states = self._engine.rollout(window, stopping[: len(controls)]).states[steps]
        still = np.zeros(window.goal.shape, np.float32)
        for t in range(steps, steps + self._stop_steps):
            stopping[t] = track_velocities(window, states, still)
            states = self._engine.step(window.arrays, states, docked, stopping[t]).states
        return stopping

    def _safe_mix(self, window: Problem, fresh: FloatArray, docked: Any) -> tuple[FloatArray, float]:
        """Fresh controls where they keep everyone apart; where not, robots stop earlier, or do as they had in mind.

        What they had in mind was free of violations, and ends at rest. So without disturbances there always is a mix
        that is free of them too: in the last resort everybody does as before.

        Returns:
            ``(H_predict + S, K, m)`` controls, and the least gap between robots that they keep.
        """
        horizon = len(fresh)
        before = np.zeros((horizon + self._stop_steps, *fresh.shape[1:]), np.float32)
        left = self._plan[self._next :]
        before[: len(left)] = left
        controls = self._with_stop(window, fresh, horizon, docked)
        window_to_rest = window.moment(window.start, window.goal, horizon=len(controls))
        # After how many fresh steps each robot stops.
        steps = np.full(window.num_robots, horizon)
        trajectory = self._engine.rollout(window_to_rest, controls)
        while (violating := trajectory.margin_violated[1:].any(axis=0) & (steps > 0)).any():
            steps[violating] //= SHORTER
            steps[steps < self.config.execute_horizon] = 0
            for number in np.unique(steps[violating]):
                fewer = self._with_stop(window, fresh, int(number), docked) if number else before
                chosen = violating & (steps == number)
                controls[:, chosen] = fewer[:, chosen]
            trajectory = self._engine.rollout(window_to_rest, controls)
        return controls, least_gap(window, trajectory.positions)


def least_gap(problem: Problem, positions: FloatArray) -> float:
    """Least gap between the surfaces of any two robots on ``(T, K, d)`` after the first moment [m]."""
    radius = np.asarray(problem.team.radius)
    first, second = np.triu_indices(problem.num_robots, 1)
    if not len(first):
        return float("inf")
    gap2 = ((positions[1:, first] - positions[1:, second]) ** 2).sum(axis=2)
    return float((np.sqrt(gap2.min(axis=0)) - radius[first] - radius[second]).min())


class _Background:
    """A job at a time in a thread of its own.

    Args:
        yielding: Whether other threads go first, where threads have priorities of their own.
    """

    def __init__(self, yielding: bool = False) -> None:
        self._initializer = _yield_to_others if yielding and sys.platform == "linux" else None
        self._pool: ThreadPoolExecutor | None = None
        self._job: Future[Any] | None = None

    def start(self, work: Callable[[], Any]) -> None:
        if self._pool is None:
            self._pool = ThreadPoolExecutor(1, thread_name_prefix="d4orm-c2f", initializer=self._initializer)
        self._job = self._pool.submit(work)

    def result(self) -> tuple[bool, Any]:
        """Whether nothing is under way, and what the last job gave, once."""
        if self._job is None:
            return True, None
        if not self._job.done():
            return False, None
        job, self._job = self._job, None
        return True, job.result()

    def run(self, work: Callable[[], Any], timeout: float) -> Any:
        """What the work gives within the time [s], or ``None``. What is late goes on, and is thrown away."""
        end = time.perf_counter() + timeout
        if timeout <= 0:
            return None
        try:
            if self._job is not None:
                self._job.result(timeout)
            self.start(work)
            assert self._job is not None
            return self._job.result(max(end - time.perf_counter(), 0))
        except TimeoutError:
            return None

    def forget(self) -> None:
        """Wait for what is under way and throw it away."""
        if self._job is not None:
            self._job.exception()
            self._job = None


def _yield_to_others() -> None:
    """Lower the priority of the calling thread; on Linux that is what a thread's number stands for here."""
    thread = threading.get_native_id()
    # Where all of the process yields more than that, only root could take some of it back.
    os.setpriority(os.PRIO_PROCESS, thread, max(10, os.getpriority(os.PRIO_PROCESS, thread)))
