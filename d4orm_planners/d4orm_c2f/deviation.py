"""Deviation of robots from the model, the margin inflation that it calls for, and a filter of states."""

from __future__ import annotations

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray, Floats
from d4orm_env.core.problem import Problem
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.engine.types import Engine
from d4orm_env.envs.joint_state import JointState
from d4orm_planners.d4orm_c2f.direct_final_approach import arrival_radius
from d4orm_planners.d4orm_c2f.estimators import (
    DECAY,
    ActuatorGainEstimator,
    LatencyEstimator,
    PacketLossEstimator,
    StallEstimator,
)
from d4orm_planners.d4orm_c2f.settings import D4ormC2FConfig
from d4orm_planners.tracking.steering import by_model, limit_controls, present_velocities, short_way_round

MIN_DIFFERENCES = 40  #: Number of differences needed to estimate how noisy a component is
MIN_NOISE_SHARE = 0.1  #: Least share of measurements in the variance of differences for these to be filtered
MIN_FILTER_GAIN = 0.1  #: Least gain of a measurement


class StateFilter:
    """A filter of the team's states, component by component, in the models' own motion.

    A state moves as its model says, but for a random walk of variance ``Q`` per step, and is measured with white noise
    of variance ``R``. Differences of a measurement from what the one before it leads to then have the variance ``Q + 2
    R`` and the covariance ``-R`` with the ones before them, which is how the two are told apart (Mehra, On the
    identification of variances and adaptive Kalman filtering, IEEE Trans. Automatic Control 15, 1970). The gain is that
    of the steady state, ``K = P / (P + R)`` with ``P = (Q + sqrt(Q^2 + 4 Q R)) / 2`` (Bar-Shalom, Li, Kirubarajan,
    Estimation with Applications to Tracking and Navigation, section 5.2.5). Robots of one model share it. As long as
    nothing tells of noise in what is measured it is one: measurements are taken as they are.
    """

    def __init__(self, problem: Problem) -> None:
        self._problem, self._models = problem, list(by_model(problem))
        shape = len(self._models), problem.state_size
        self._variance, self._covariance = np.zeros((2, *shape))
        self._count = np.zeros(len(self._models))
        self._before: Floats | None = None

    def gains(self) -> Floats:
        """``(models, n)`` gains of the measurements."""
        count = np.maximum(self._count, 1)[:, None]
        total = self._variance / count
        noise = np.maximum(-self._covariance / count, 0)
        walk = np.maximum(total - 2 * noise, 0)
        ahead = (walk + np.sqrt(walk**2 + 4 * walk * noise)) / 2
        believed = np.maximum(ahead / np.maximum(ahead + noise, np.finfo(np.float64).tiny), MIN_FILTER_GAIN)
        known = (count >= MIN_DIFFERENCES) & (noise > MIN_NOISE_SHARE * total)
        return np.where(known, believed, 1.0)

    def update(self, measured: FloatArray, led_to: FloatArray, expected: FloatArray, going: BoolArray) -> FloatArray:
        """``(K, n)`` the states; ``measured`` itself as long as nothing tells of noise.

        What those seen a step ago have ``led_to``, and what is ``expected`` of those estimated then, are ``(K, n)``;
        robots ``going`` ``(K,)`` have not arrived.
        """
        seen = np.asarray(measured, np.float64)
        difference = short_way_round(self._problem, seen - led_to)
        before, self._before = self._before, difference
        innovation, states = short_way_round(self._problem, seen - expected), measured.copy()
        for number, (_, robots) in enumerate(self._models):
            moving = np.array(robots)[going[robots]]
            self._variance[number] = DECAY * self._variance[number] + (difference[moving] ** 2).sum(axis=0)
            if before is not None:
                products = difference[moving] * before[moving]
                self._covariance[number] = DECAY * self._covariance[number] + products.sum(axis=0)
            self._count[number] = DECAY * self._count[number] + len(moving)
        gains = self.gains()
        if (gains == 1).all():
            return measured
        for gain, (_, robots) in zip(gains, self._models):
            filtered = gain < 1
            columns = np.ix_(robots, filtered)
            states[columns] = expected[columns] + gain[filtered] * innovation[columns]
        return states


MAX_INFLATION = 1.0  #: Largest margin inflation, in radii of the largest robot
REACTION_STEPS = 5  #: Time steps over which changes of velocity add up before a robot is seen to have reacted
DRIFT_DEADBAND = 0.02  #: Drift that counts as none, as a share of the largest speed limit
SINGLE_STEP_FACTOR = 1.5  #: Weight of the largest change of velocity in a single step
MAX_SPEED_SLACK = 0.4  #: Largest drift that is believed, as a share of the largest speed limit


class Deviation:
    """Compares an episode with the model, and estimates what the settings say; ``docks`` if robots stay at their goals.

    Its ``problem`` has the limits that the robots are believed to have now, its ``drift`` is the largest recent change
    of a robot's velocity from the expected one within a few steps [m/s].
    """

    def __init__(self, problem: Problem, engine: Engine, config: D4ormC2FConfig, docks: bool) -> None:
        self.problem = self._first = problem
        self._engine, self._docks = engine, docks
        self.latency = LatencyEstimator(problem.team, config.delay)  #: Estimator of the latency of commands
        #: Estimator of lost commands, or ``None``
        self.packet_loss = PacketLossEstimator(problem) if config.expect_losses else None
        self._gain = ActuatorGainEstimator(problem) if config.learn_limits else None
        self.stall = StallEstimator(problem) if config.stalls else None  #: Estimator of stalled robots, or ``None``
        self._filter = StateFilter(problem) if config.filter_states else None
        self._measured: JointState | None = None
        self._estimated: JointState | None = None
        self._expected: tuple[FloatArray, FloatArray] | None = None
        self._changes = np.zeros((REACTION_STEPS, problem.num_robots, problem.dimension), np.float32)
        #: ``(K,)`` the largest recent deviation of each robot in a time step, over its length [m/s]
        self.speed = np.zeros(problem.num_robots)
        self._first_order = np.array([model.first_order for model in problem.team.robot_models])
        self.drift, self._speed = 0.0, float(problem.team.max_speed.max())

    def observe(self, joint: JointState) -> JointState:
        """Compare the robots with the model, and return their state when the next command arrives."""
        commanded = self.latency.observe(joint.controls, ~joint.arrived)
        joint = self._filtered(joint)
        going = ~joint.arrived if self.stall is None else ~joint.arrived & ~self.stall.robots
        if self.packet_loss is not None:
            going &= ~self.packet_loss.observe(commanded, joint.controls, going)
        if self._gain is not None:
            self._gain.observe(commanded, joint.controls, going)
            self.problem = self._gain.problem
        if self.stall is not None:
            joint = self.stall.observe(joint, commanded)
        if self._expected is not None:
            self._compare(joint, *self._expected)
        self._seen = joint
        for controls in self.latency.under_way:
            joint = self._moved(joint, controls + self._added)
        return joint

    @property
    def _added(self) -> FloatArray:
        return np.zeros_like(self._seen.controls) if self._gain is None else self._gain.added

    def _compare(self, joint: JointState, positions: FloatArray, velocities: FloatArray) -> None:
        """Note how far robots are from the ``positions`` and the ``velocities`` ``(K, d)`` that were expected."""
        d, going = self.problem.dimension, ~joint.arrived[:, None]
        away = np.linalg.norm(np.where(going, joint.states[:, :d] - positions, 0), axis=1)
        self.speed = np.maximum(DECAY * self.speed, away.astype(np.float64) / self.problem.dt)
        change = np.where(going, present_velocities(self.problem, joint.states, joint.controls) - velocities, 0)
        self._changes = np.concatenate([change[None], self._changes[:-1]])
        sums = np.linalg.norm(np.cumsum(self._changes, axis=0), axis=2)
        self.drift = max(DECAY * self.drift, float(sums.max()), SINGLE_STEP_FACTOR * float(sums[0].max()))

    def _filtered(self, joint: JointState) -> JointState:
        """The joint state with less noise on it, where measurements are noisy."""
        if self._filter is None:
            return joint
        estimated = joint
        if self._measured is not None and self._estimated is not None:
            # What was executed is known, so that noise on controls is not taken for noise on states.
            led_to = self._moved(self._measured, joint.controls).states
            same = self._estimated.states is self._measured.states
            expected = led_to if same else self._moved(self._estimated, joint.controls).states
            states = self._filter.update(joint.states, led_to, expected, ~joint.arrived)
            if states is not joint.states:
                estimated = joint._replace(states=states)
        self._measured, self._estimated = joint, estimated
        return estimated

    def send(self, controls: FloatArray) -> FloatArray:
        """The commands ``(K, m)`` by which robots do these controls ``(K, m)``, against what is added to commands.

        Remembered is where that should lead in a time step.
        """
        step = self._engine.step(self.arrays(self._seen), self._seen.states, self._seen.arrived, controls)
        commands, added = step.controls, self._added
        if added.any():
            controls = commands = limit_controls(self._first, step.controls - added)
        now = self.latency.send(commands)
        states, done = step.states, step.controls
        if now is not commands:
            done = now + added
            states = self._moved(self._seen, done).states
        self._expected = states[:, : self.problem.dimension], present_velocities(self.problem, states, done)
        return controls

    def arrays(self, joint: JointState) -> ProblemArrays:
        """The problem from this state on, with the limits that robots are believed to have now, as arrays."""
        radius = arrival_radius(self.problem, self._docks)
        return self.problem.with_state(joint.states, joint.goals, goal_radius=radius).arrays

    def _moved(self, joint: JointState, controls: FloatArray) -> JointState:
        d = self.problem.dimension
        step = self._engine.step(self.arrays(joint), joint.states, joint.arrived, controls)
        bodies = joint.bodies.copy()
        if len(bodies):
            bodies[:, :d] += self.problem.dt * bodies[:, d : 2 * d]
        return joint._replace(states=step.states, arrived=step.arrived & self.problem.docks, bodies=bodies)

    @property
    def speed_slack(self) -> float:
        """Largest speed that disturbances may soon add to a robot, in any direction [m/s]."""
        return 0.0 if self.drift < DRIFT_DEADBAND * self._speed else min(self.drift, MAX_SPEED_SLACK * self._speed)

    def margin_inflation(self, reaction_time: float) -> float:
        """Return the distance by which robots deviate within a reaction time [s], at most :data:`MAX_INFLATION` radii.

        A robot of first order deviates until the next command arrives only.
        """
        next_command = min((1 + len(self.latency.under_way)) * self.problem.dt, reaction_time)
        within = np.where(self._first_order, next_command, reaction_time)
        return min(float((within * self.speed).max()), MAX_INFLATION * self.problem.team.largest_radius)
