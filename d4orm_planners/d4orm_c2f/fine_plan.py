"""The fine plan over the prediction horizon: the sampling of one control loop (Algorithm 4)."""

from __future__ import annotations

from time import perf_counter
from typing import NamedTuple

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray, IntArray
from d4orm_env.core.problem import Problem
from d4orm_env.core.trajectory import Trajectory
from d4orm_env.envs.joint_state import JointState
from d4orm_planners.d4orm_c2f.direct_final_approach import arrival_radius, direct_final_approach
from d4orm_planners.d4orm_c2f.settings import D4ormC2FConfig
from d4orm_planners.engine.sampling_types import MovingObstacles, SamplingEngine, SamplingRules, SamplingTask
from d4orm_planners.tracking.tracker import follow_reference

SHORTER = 3  #: Divisor of the fresh steps that a robot takes before it stops if it would violate the margin otherwise
NEAREST = 256  #: Pairs among which the least gap is looked for at first
FEWER, IN_TIME = (1, 2, 4), 0.8
"""Divisors of the denoising steps where a deadline leaves no time for all, and the share of it that is used."""


class Prediction(NamedTuple):
    """Prediction of a control loop."""

    controls: FloatArray  #: ``(H_predict + S, K, m)`` with the ``S`` steps that a stop may take
    positions: FloatArray  #: ``(1 + H_predict + S, K, d)`` where they lead, with the present position first [m]
    gap: float  #: Least gap between the surfaces of any two robots that they keep [m]; infinite for one robot
    num_steps: int = 0  #: Denoising steps made


class Situation(NamedTuple):
    """State at the beginning of a control loop."""

    joint: JointState  #: State of the robots
    arrived: BoolArray  #: ``(K,)`` robots that stay there
    subgoals: FloatArray  #: ``(K, d)`` [m]
    base: FloatArray  #: ``(H_predict, K, m)`` controls to deform
    left: FloatArray  #: ``(T, K, m)`` what is left of the last plan, with the stop after it
    careful: FloatArray | None  #: ``(H_predict, K, m)`` controls for robots that are stuck, if any are
    stuck: BoolArray  #: ``(K,)`` robots that are; they may come as near as half of the margin
    inflation: float  #: Margin inflation of the samples [m]


class Window:
    """Plans finely over the prediction horizon, from wherever the robots are; ``docks`` if they stay at their goals.

    Its ``problem`` has the limits that the robots are believed to have now.
    """

    def __init__(self, problem: Problem, config: D4ormC2FConfig, engine: SamplingEngine, docks: bool) -> None:
        self.problem, self._config, self._engine, self._docks = problem, config, engine, docks
        self._rules = SamplingRules(config.weights)
        divisors = FEWER if config.deadline is not None else FEWER[:1]
        self._schedules = [config.noise_scale(-(-config.num_steps // divisor)) for divisor in divisors]
        self._seconds = 0.0, 0.0  # of a denoising step, and of all the rest, in the last loop
        limits = problem.team.limits
        self._stop_steps = int(np.ceil(np.max(limits[:, 0] / (limits[:, 1] * problem.dt))))

    def prepare(self, joint: JointState) -> None:
        """Compile, so that the first control loop is as quick as the others."""
        window = self.problem.with_state(joint.states, joint.goals, horizon=self._config.predict_horizon)
        task = SamplingTask(window, self.no_controls(), arrived=joint.arrived)
        for schedule in self._schedules:
            self._engine.prepare(task, self._rules, schedule, self._config.num_samples)
        self.stop(joint)

    def no_controls(self) -> FloatArray:
        """``(H_predict, K, m)`` zeros."""
        shape = (self._config.predict_horizon, self.problem.num_robots, self.problem.control_size)
        return np.zeros(shape, np.float32)

    def predict(self, now: Situation, seed: int, seconds: float | None = None) -> Prediction:
        """Fine controls towards the subgoals, by as many denoising steps as there is time for if ``seconds`` are left.

        The time that steps take is that of the last loop.
        """
        step, rest = self._seconds
        left = np.inf if seconds is None else IN_TIME * seconds - rest
        schedule = next((each for each in self._schedules if len(each) * step <= left), self._schedules[-1])
        began = perf_counter()
        mean = self._engine.denoise(
            self._task(now), self._rules, np.zeros_like(now.base), schedule, self._config.num_samples, seed
        ).mean
        denoised = perf_counter()
        prediction = self._from_samples(now, mean)
        self._seconds = (denoised - began) / len(schedule), perf_counter() - denoised
        return prediction._replace(num_steps=len(schedule))

    def _from_samples(self, now: Situation, mean: FloatArray) -> Prediction:
        problem, config = self.problem, self._config
        sampled = np.clip(now.base + mean, *problem.team.control_bounds).astype(np.float32)
        controls = sampled if now.careful is None else np.where(now.stuck[:, None], now.careful, sampled)
        radius = arrival_radius(problem, self._docks)
        joint, horizon = now.joint, config.predict_horizon
        truth = problem.with_state(joint.states, joint.goals, horizon=horizon, goal_radius=radius)
        if not config.safe_mix:
            positions = self._engine.rollout(truth, controls).positions
            return Prediction(controls, positions, least_gap(truth, positions[1:]))
        not_sampled = now.stuck
        if config.direct_final_approach and self._docks:
            # Where goals are not absorbing, robots hold themselves there.
            near = self._near_goals(now) & ~(now.arrived & problem.docks) & ~now.stuck
            controls, final = direct_final_approach(truth, self._engine, controls, near, now.arrived)
            not_sampled = not_sampled | final
        return self._safe_mix(truth, controls, not_sampled, sampled, now)

    def _near_goals(self, now: Situation) -> BoolArray:
        """``(K,)`` robots whose subgoal is within the goal radius of the goal."""
        return np.linalg.norm(now.subgoals - now.joint.goals, axis=1) <= self.problem.goal_radius

    def _task(self, now: Situation) -> SamplingTask:
        """The deformation of the base towards the subgoals, or towards goals where these are near."""
        problem, config, goals = self.problem, self._config, now.joint.goals
        near = self._near_goals(now)
        window = problem.with_state(
            now.joint.states,
            np.where((near | now.arrived)[:, None], goals, now.subgoals),
            horizon=config.predict_horizon,
            margin=problem.margin + config.extra_margin + now.inflation,
            goal_radius=arrival_radius(problem, self._docks and bool(near.any())),
        )
        farthest = problem.dt * config.subgoal_offset * float(np.max(np.asarray(problem.team.max_speed)))
        return SamplingTask(
            window,
            now.base,
            credit=config.credit,
            moving=self._bodies(now.joint, config.predict_horizon),
            arrived=now.arrived,
            penalty=config.penalty,
            reference_distance=None if config.normalise_distance else farthest,
        )

    def _bodies(self, joint: JointState, horizon: int) -> MovingObstacles | None:
        """Predict the dynamic obstacles, going on as they do; ``None`` if none is seen."""
        d, bodies = self.problem.dimension, joint.bodies
        seen = bodies[bodies[:, -1] > 0] if len(bodies) else bodies
        if not len(seen):
            return None
        times = self.problem.dt * np.arange(1, horizon + 1, dtype=np.float32)[:, None, None]
        return MovingObstacles(seen[:, :d] + times * seen[:, d : 2 * d], seen[:, -1])

    def _with_stop(self, window: Problem, controls: FloatArray, states: FloatArray, steps: int) -> FloatArray:
        """``(H_predict + S, K, m)`` the first ``steps`` controls, and then those that bring everyone to rest as soon as
        can be, in ``S`` steps at most; ``states`` ``(H_predict + 1, K, n)`` are what ``controls`` lead to.
        """
        stopping = np.zeros((len(controls) + self._stop_steps, *controls.shape[1:]), np.float32)
        stopping[:steps] = controls[:steps]
        at_rest = np.zeros((self._stop_steps, *window.goal.shape), np.float32)
        stopping[steps : steps + self._stop_steps] = follow_reference(window, states[steps], at_rest, at_rest, 0.0)
        return stopping

    def _states(self, window: Problem, controls: FloatArray) -> FloatArray:
        """``(T+1, K, n)`` states that controls ``(T, K, m)`` lead to."""
        return self._engine.move(window.arrays, window.start, np.zeros(window.num_robots, bool), controls)

    def stop(self, joint: JointState) -> FloatArray:
        """``(H_predict + S, K, m)`` controls that bring everyone to rest now."""
        nothing = self.no_controls()
        present = self.problem.with_state(joint.states, joint.goals, horizon=len(nothing))
        return self._with_stop(present, nothing, present.start[None], 0)

    def _safe_mix(
        self, window: Problem, fresh: FloatArray, not_sampled: BoolArray, sampled: FloatArray, now: Situation
    ) -> Prediction:
        """Fresh controls where they keep the margin; elsewhere robots stop earlier, or go on with their last plan.

        Robots whose controls were ``not_sampled`` ``(K,)`` take the sampled ones before they stop.

        The last plan was free of violations and ends at rest. So without disturbances there always is a mix that is
        free of them too: at worst all go on with their last plans.
        """
        horizon = len(fresh)
        before = np.zeros((horizon + self._stop_steps, *fresh.shape[1:]), np.float32)
        before[: len(now.left)] = now.left
        states = self._states(window, fresh)
        controls = self._with_stop(window, fresh, states, horizon)
        window_to_rest = window.with_state(window.start, window.goal, horizon=len(controls))
        # After how many fresh steps each robot stops.
        steps = np.full(window.num_robots, horizon)
        trajectory, violated = self._violations(window_to_rest, controls, now)
        if (held := violated & not_sampled).any():
            fresh = np.where(held[:, None], sampled, fresh)
            states = self._states(window, fresh)
            controls[:, held] = self._with_stop(window, fresh, states, horizon)[:, held]
            trajectory, violated = self._violations(window_to_rest, controls, now)
        while (violating := violated & (steps > 0)).any():
            steps[violating] //= SHORTER
            steps[steps < self._config.execute_horizon] = 0
            for number in np.unique(steps[violating]):
                fewer = self._with_stop(window, fresh, states, int(number)) if number else before
                chosen = violating & (steps == number)
                controls[:, chosen] = fewer[:, chosen]
            trajectory, violated = self._violations(window_to_rest, controls, now)
        return Prediction(controls, trajectory.positions, least_gap(window, trajectory.positions[1:]))

    def _violations(self, window: Problem, controls: FloatArray, now: Situation) -> tuple[Trajectory, BoolArray]:
        """The rollout, and ``(K,)`` robots that come too near to anything in it.

        That is within the margin; of half of it for those that are stuck; nearer than now for those within it already.
        """
        trajectory, radius = self._engine.rollout(window, controls), np.asarray(window.team.wall_radius)
        violated: BoolArray = np.any(trajectory.margin_violated[1:], axis=0)
        lenient = trajectory.margin_violated[0] | now.stuck
        if lenient.any():
            positions = trajectory.positions[0]
            gap = min(least_gap(window, positions[None]), float((window.world.clearance(positions) - radius).min()))
            allowed = min(gap - window.rounding, window.margin / 2 if now.stuck.any() else window.margin)
            nearer = window.with_state(window.start, window.goal, margin=max(allowed, 0.0))
            violated[lenient] = self._engine.rollout(nearer, controls).margin_violated[1:, lenient].any(axis=0)
        return trajectory, violated | self._meets_bodies(now.joint, trajectory, window.margin)

    def _meets_bodies(self, joint: JointState, trajectory: Trajectory, margin: float) -> BoolArray:
        """``(K,)`` robots that come within a margin of a dynamic obstacle."""
        bodies = self._bodies(joint, len(trajectory.controls))
        if bodies is None:
            return np.zeros(self.problem.num_robots, bool)
        away = np.linalg.norm(trajectory.positions[1:, :, None] - bodies.positions[:, None], axis=3)
        safety_distance = np.asarray(self.problem.team.wall_radius)[:, None] + bodies.radius + margin
        return (away <= safety_distance).any(axis=(0, 2))

    def touching(self, joint: JointState, arrived: BoolArray, controls: FloatArray, gap: float) -> BoolArray:
        """``(K,)`` robots within a gap [m] of anything if all execute ``controls`` ``(T, K, m)``, and a stop."""
        radius = arrival_radius(self.problem, self._docks)
        present = self.problem.with_state(
            joint.states, joint.goals, horizon=len(controls), margin=gap, goal_radius=radius
        )
        trajectory = self._engine.rollout(present, controls)
        touches: BoolArray = trajectory.margin_violated[1:].any(axis=0) & ~arrived
        return touches | self._meets_bodies(joint, trajectory, gap) & ~arrived


def least_gap(problem: Problem, positions: FloatArray) -> float:
    """Least gap between the surfaces of any two robots on ``(T, K, d)``, or less [m]."""
    radius, positions = np.asarray(problem.team.girth), problem.team.flattened(positions, 0.0)
    first, second = np.triu_indices(problem.num_robots, 1)
    if not len(first):
        return float("inf")
    # Pairs by how far the boxes round their paths are apart; those too far apart to be the nearest are left out.
    low, high, apart2 = positions.min(axis=0), positions.max(axis=0), np.zeros(len(first), positions.dtype)
    for axis in range(positions.shape[2]):
        gap = np.maximum(low[first, axis] - high[second, axis], low[second, axis] - high[first, axis])
        apart2 += np.maximum(gap, 0) ** 2
    least = np.sqrt(apart2) - radius[first] - radius[second]
    few = np.argpartition(least, min(NEAREST, len(least)) - 1)[:NEAREST]
    near = least <= _gaps(positions, radius, first[few], second[few]).min() + problem.rounding
    return float(_gaps(positions, radius, first[near], second[near]).min())


def _gaps(positions: FloatArray, radius: FloatArray, first: IntArray, second: IntArray) -> FloatArray:
    """``(P,)`` least gaps between the surfaces of two robots each [m]."""
    gap2 = np.zeros((len(positions), len(first)), positions.dtype)
    for axis in range(positions.shape[2]):
        gap2 += (positions[:, first, axis] - positions[:, second, axis]) ** 2
    return np.sqrt(gap2.min(axis=0)) - radius[first] - radius[second]
