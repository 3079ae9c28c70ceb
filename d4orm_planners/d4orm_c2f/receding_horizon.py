"""D4orm-C2F: receding-horizon control along a coarse plan (paper, section VI, Algorithm 4)."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import numpy as np
from pettingzoo import ParallelEnv

from d4orm_env.core.arrays import BoolArray, FloatArray
from d4orm_env.core.seeds import Stream, derived_seed, generator
from d4orm_env.envs.joint_state import JointState, split_state
from d4orm_planners.base.planner_registry import find_policy
from d4orm_planners.base.policy import StatePolicy
from d4orm_planners.base.policy_threads import Background, TimeLimit
from d4orm_planners.base.settings import CheckedSettings
from d4orm_planners.d4orm_c2f.barrier import prepare_barriers, safe_velocities
from d4orm_planners.d4orm_c2f.coarse_plan import CoarsePlan, CoarseWaypoints
from d4orm_planners.d4orm_c2f.coarse_plan_tracker import CoarsePlanTracker
from d4orm_planners.d4orm_c2f.deviation import Deviation
from d4orm_planners.d4orm_c2f.estimators import PROBE
from d4orm_planners.d4orm_c2f.fine_plan import Prediction, Situation, Window
from d4orm_planners.d4orm_c2f.settings import PAPER_CONTROL, D4ormC2FConfig
from d4orm_planners.engine.sampling_types import get_sampling_engine
from d4orm_planners.tracking.goal_drives import drive_to_goal
from d4orm_planners.tracking.steering import present_velocities, track_velocities

GAP = 0.4  #: Share of the margin that is kept in the last resort
REMEMBERED = 10_000  #: Control loops; an episode with ever new goals has no end
NEARLY = 1e-3  #: Share of its speed limit by no more than which two velocities of a robot differ that are the same


@dataclass(frozen=True)
class LoopRecord:
    """Record of one control loop."""

    step: int  #: The environment's step at which it began
    wall_time: float  #: Time used [s]
    subgoal_index: int  #: Waypoint of the guidance that the team headed for
    predicted_margin: float  #: Least gap between two robots' surfaces over the prediction [m]; infinite for one robot
    missed: bool  #: Whether it took longer than the deadline, so that the last plan went on
    replanned: bool  #: Whether the guidance was planned anew
    refined: bool  #: Whether a refined guidance was taken over
    num_steps: int  #: Denoising steps made; fewer than the settings say where a deadline asks for it


class D4ormC2F(StatePolicy):
    """Follows a coarse plan of the whole team by short fine plans from wherever the robots are, loop by loop."""

    name = "d4orm-c2f"
    config_class: ClassVar[type[CheckedSettings] | None] = D4ormC2FConfig
    presets: ClassVar = {"paper": PAPER_CONTROL}

    def __init__(self, config: D4ormC2FConfig | None = None) -> None:
        self.config = config or D4ormC2FConfig()  #: The settings
        if self.config.warm_start is not None:
            find_policy(self.config.warm_start)
        self._engine = get_sampling_engine(self.config.engine)
        self._refinement: Background[CoarsePlan] = Background(yielding=True)
        self._replanning: Background[CoarsePlan] = Background(yielding=True)
        self._control: Background[Prediction] = Background()
        self._limit = TimeLimit()

    @property
    def missed(self) -> int:
        """Control loops that missed the deadline."""
        return sum(loop.missed for loop in self.loops)

    @property
    def guidance(self) -> CoarseWaypoints:
        """Coarse plan that is followed at present."""
        return self._tracker.guidance

    def _begin(self, env: ParallelEnv, seed: int) -> None:
        self._seed = seed
        self._random = generator(seed, Stream.CONTROLLER_NOISE)
        self._refinement.forget()
        self._replanning.forget()
        self._control.forget()
        self.loops: deque[LoopRecord] = deque(maxlen=REMEMBERED)  #: Of the control loops of the present episode
        self._begun = 0
        joint = split_state(self.problem, env.state())
        lifelong = env.unwrapped.lifelong
        self._window = Window(self.problem, self.config, self._engine, docks=not lifelong)
        self._window.prepare(joint)
        prepare_barriers()
        self._plan, self._next = self._window.no_controls(), 0
        #: ``(K, d)`` subgoals of the last control loop [m]; the start before the first
        self.subgoals: FloatArray = joint.states[:, : self.problem.dimension]
        #: ``(1 + T, K, d)`` path of its plan, without braking and evading in the last resort [m]
        self.predicted: FloatArray = self.subgoals[None]
        self._reached = np.full_like(joint.goals, np.nan)
        self._note_arrivals(joint)
        begin = time.perf_counter()
        last_step = env.unwrapped.max_cycles
        self._tracker = CoarsePlanTracker(
            self.problem, self.config, seed, self._refinement, self._replanning, lifelong, last_step
        )
        self._tracker.begin(joint, self._arrived)
        self._deviation = Deviation(self.problem, self._engine, self.config, docks=not lifelong)
        self.coarse_time = time.perf_counter() - begin  #: Time that the first coarse plan took [s]

    def _controls(self, joint: JointState) -> FloatArray:
        self._limit.begin(self.config.deadline)
        goals = joint.goals
        joint = self._deviation.observe(joint)
        self._note_arrivals(joint)
        believed = self._window.problem = self._tracker.problem = self._deviation.problem
        if not self.loops or self._next >= self.config.execute_horizon:
            self._loop(joint)
        if self._next >= len(self._plan):  # those that had to evade others may still move
            self._plan, self._next = self._window.stop(joint), 0
        controls = self._plan[self._next]
        if self.config.last_resort:
            controls = self._evading(joint, controls)
        self._next += 1
        if (stall := self._deviation.stall) is not None and stall.robots.any():
            probe = PROBE * drive_to_goal(believed, joint.states, goals)
            controls = np.where(stall.robots[:, None], probe, controls)
        if self.config.control_noise_std:
            noise = self._random.normal(0, self.config.control_noise_std, controls.shape)
            controls = np.clip(controls + noise, *self.problem.team.control_bounds).astype(np.float32)
        controls = self._deviation.send(controls)
        self._limit.end()
        return controls

    def _evading(self, joint: JointState, controls: FloatArray) -> FloatArray:
        """The controls ``(K, m)``, changed for robots that might come to touch something: these brake, or evade."""
        gap = GAP * self._deviation.problem.margin
        touching = self._window.touching(joint, self._arrived, self._plan[self._next :], gap)
        speed_slack = self._deviation.speed_slack
        if not touching.any() and not speed_slack:
            return controls
        if touching.any():
            # A new array, for a late loop may still be reading the plan; and long enough for the whole stop.
            stop, end = self._window.stop(joint), len(self._plan)
            self._plan = np.pad(self._plan, ((0, max(self._next + len(stop) - end, 0)), (0, 0), (0, 0)))
            self._plan[self._next :, touching] = stop[:, touching]
        # In the last resort they brake as their own limits allow, not as they are believed to.
        braking = track_velocities(self.problem, joint.states, np.zeros_like(joint.goals))
        controls = np.where(touching[:, None], braking, controls)
        run = 0 if (packet_loss := self._deviation.packet_loss) is None else packet_loss.run
        # Look in between too, for there may be a corner, and twice, for a robot that evades may get in another's way.
        for steps in 2 * (1 + run, 1 + run // 2, 1) if run else (1,):
            controls = self._braking_in_time(joint, controls, gap, speed_slack if steps == 1 else 0.0, steps)
        return controls

    def _braking_in_time(
        self, joint: JointState, controls: FloatArray, gap: float, speed_slack: float, steps: int
    ) -> FloatArray:
        """The controls ``(K, m)``, changed for robots that after so many steps of them could not brake in time."""
        problem = self._deviation.problem
        evading, safe = self._evasion(joint, controls, gap, speed_slack, steps)
        if steps > 1 and evading.any():
            # A robot that starts gently is not far by then: near a wall it would otherwise never start.
            gentle = np.where(evading[:, None], controls / np.float32(steps), controls)
            unsafe, _ = self._evasion(joint, gentle, gap, speed_slack, steps)
            controls, evading = np.where(unsafe[:, None], controls, gentle), evading & unsafe
            velocities = present_velocities(problem, joint.states, joint.controls)
            safe = velocities + (safe - velocities) / np.float32(steps)
        return np.where(evading[:, None], track_velocities(self.problem, joint.states, safe), controls)

    def _evasion(
        self, joint: JointState, controls: FloatArray, gap: float, speed_slack: float, steps: int
    ) -> tuple[BoolArray, FloatArray]:
        """``(K,)`` robots that could not brake in time after so many steps, and velocities ``(K, d)`` that do."""
        problem, arrived, states = self._deviation.problem, self._arrived, joint.states
        arrays = self._deviation.arrays(joint)
        for _ in range(steps):
            ahead = self._engine.step(arrays, states, arrived, controls)
            states = ahead.states
        wanted = present_velocities(problem, states, ahead.controls)
        # Velocities take effect by the next step, so that positions after the present one count.
        safe = safe_velocities(problem, joint._replace(states=states), wanted, ~arrived, gap, speed_slack)
        return np.abs(safe - wanted).max(axis=1) > NEARLY * problem.team.max_speed, safe

    def _loop(self, joint: JointState) -> None:
        """One control loop (Algorithm 4, lines 6 to 9)."""
        begin = time.perf_counter()
        tracker, arrived = self._tracker, self._arrived
        replanned = tracker.replan_if_needed(joint, arrived)
        refined = not replanned and tracker.refine(joint.steps, due=self._begun % self.config.refine_every == 0)
        self._begun += 1
        targets = tracker.subgoals(joint, arrived)
        self.subgoals = subgoals = tracker.guidance.path[targets, np.arange(len(targets))]
        left, base = self._plan[self._next :], self._base(joint)
        seed = derived_seed(self._seed, Stream.CONTROL_LOOP, joint.steps)
        stuck = tracker.stuck & ~arrived
        careful = tracker.followed(joint, len(base)) if stuck.any() else None
        inflation = self._deviation.margin_inflation(self.config.reaction_time)
        now = Situation(joint, arrived, subgoals, base, left, careful, stuck, inflation)
        result = self._limit.run(self._control, partial(self._window.predict, now, seed, self._limit.left))
        margin, num_steps = float("nan"), 0
        if result is not None:
            self._plan, self._next, self.predicted, margin, num_steps = result.controls, 0, *result[1:]
        used = time.perf_counter() - begin
        self.loops.append(
            LoopRecord(joint.steps, used, int(targets.max()), margin, result is None, replanned, refined, num_steps)
        )

    def _base(self, joint: JointState) -> FloatArray:
        """``(H_predict, K, m)`` controls to deform: what is left of the last loop's.

        Where precedence decides, the coarse plan's own pace is kept instead.
        """
        horizon = self.config.predict_horizon
        if self._tracker.guidance.ordered:
            return self._tracker.timed(joint, horizon)
        base = self._window.no_controls()
        ahead = self._plan[self._next : horizon]
        base[: len(ahead)] = ahead
        self._tracker.fresh_start(base)
        return base

    def _note_arrivals(self, joint: JointState) -> None:
        """Note the robots that have arrived at their present goals: noise on measurements sends none off again."""
        gap = np.linalg.norm(joint.goals - joint.states[:, : self.problem.dimension], axis=1)
        at_goal = joint.arrived & (gap <= self.problem.goal_radius)
        self._reached = np.where(at_goal[:, None], joint.goals, self._reached)
        self._arrived: BoolArray = joint.arrived & (joint.goals == self._reached).all(axis=1)
