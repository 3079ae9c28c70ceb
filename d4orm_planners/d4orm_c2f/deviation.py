"""Deviation of robots from where they are expected, and the margin inflation that it calls for."""

from __future__ import annotations

import numpy as np

from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.problem import Problem
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.engine.types import Engine
from d4orm_env.envs.joint_state import JointState
from d4orm_planners.d4orm_c2f.actuator_gain_estimator import Weakness
from d4orm_planners.d4orm_c2f.direct_final_approach import docking_radius
from d4orm_planners.d4orm_c2f.latency_estimator import Lateness
from d4orm_planners.d4orm_c2f.packet_loss_estimator import Losses
from d4orm_planners.d4orm_c2f.settings import D4ormC2FConfig
from d4orm_planners.d4orm_c2f.stall_estimator import Standing
from d4orm_planners.d4orm_c2f.state_filter import StateFilter
from d4orm_planners.tracking.steering import present_velocities

DECAY = 0.98
"""Share of the largest deviation seen that is left after a time step."""

MOST = 1.0
"""No more room than this is called for, in radii of the largest robot."""

RUN = 5
"""Time steps whose changes of velocity add up before a robot is seen to have reacted."""

STEADY = 0.02
"""Changes of velocity that add up to no more are none, as a share of the largest speed limit."""

AT_ONCE = 1.5
"""Factor by which the largest change in a single step may exceed that."""

FASTEST = 0.4
"""Changes are not believed to come to more, as a share of the largest speed limit."""


class Deviation:
    """Watches how well an episode follows the model.

    Args:
        problem: The robots.
        engine: Engine for rollouts.
        config: To be found out: how late commands and how noisy states are, which robots are weak or do not obey.
        docks: Whether robots dock at their goals, rather than drive through them to others.

    Attributes:
        speed: ``(K,)`` the largest deviation of each robot in a time step, over its length, of late [m/s].
        drift: The largest change of a robot's velocity from what was expected within a few steps of late [m/s].
        problem: The robots with the limits that they are believed to have now.
        lateness: Estimator of the latency of commands.
        losses: Estimator of the share of commands that are lost.
        standing: Robots that have stalled.
    """

    def __init__(self, problem: Problem, engine: Engine, config: D4ormC2FConfig, docks: bool) -> None:
        self.problem, self._engine, self._docks = problem, engine, docks
        self.lateness = Lateness(problem.team, config.delay)
        self.losses = Losses(problem) if config.expect_losses else None
        self._weakness = Weakness(problem) if config.learn_limits else None
        self.standing = Standing(problem) if config.stalls else None
        self._filter = StateFilter(problem) if config.filter_states else None
        self._measured: JointState | None = None
        self._estimated: JointState | None = None
        self._expected: tuple[FloatArray, FloatArray] | None = None
        self._changes = np.zeros((RUN, problem.num_robots, problem.dimension), np.float32)
        self.speed = np.zeros(problem.num_robots)
        self._first_order = np.array([model.first_order for model in problem.team.robot_models])
        self.drift, self._speed = 0.0, float(problem.team.max_speed.max())

    def observe(self, joint: JointState) -> JointState:
        """Compare where the robots are with where they were expected; where they will be once commands arrive."""
        commanded = self.lateness.observe(joint.controls, ~joint.arrived)
        joint = self._filtered(joint)
        going = ~joint.arrived if self.standing is None else ~joint.arrived & ~self.standing.robots
        if self.losses is not None:
            going &= ~self.losses.observe(commanded, joint.controls, going)
        if self._weakness is not None:
            self._weakness.observe(commanded, joint.controls, going)
            self.problem = self._weakness.problem
        if self.standing is not None:
            joint = self.standing.observe(joint, commanded)
        if self._expected is not None:
            self._compare(joint, *self._expected)
        self._seen = joint
        for controls in self.lateness.under_way:
            joint = self._moved(joint, controls)
        return joint

    def _compare(self, joint: JointState, places: FloatArray, velocities: FloatArray) -> None:
        """Note how far robots are from the ``places`` and the ``velocities`` ``(K, d)`` that were expected."""
        d, going = self.problem.dimension, ~joint.arrived[:, None]
        away = np.linalg.norm(np.where(going, joint.states[:, :d] - places, 0), axis=1)
        self.speed = np.maximum(DECAY * self.speed, away.astype(np.float64) / self.problem.dt)
        change = np.where(going, present_velocities(self.problem, joint.states, joint.controls) - velocities, 0)
        self._changes = np.concatenate([change[None], self._changes[:-1]])
        sums = np.linalg.norm(np.cumsum(self._changes, axis=0), axis=2)
        self.drift = max(DECAY * self.drift, float(sums.max()), AT_ONCE * float(sums[0].max()))

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

    def expect(self, controls: FloatArray) -> None:
        """Remember where the robots should be in a time step, now that these controls ``(K, m)`` are sent."""
        step = self._engine.step(self.arrays(self._seen), self._seen.states, self._seen.arrived, controls)
        now = self.lateness.send(step.controls)
        states = step.states if now is step.controls else self._moved(self._seen, now).states
        self._expected = states[:, : self.problem.dimension], present_velocities(self.problem, states, now)

    def arrays(self, joint: JointState) -> ProblemArrays:
        """Return the arrays to step on from there: with the limits that robots are believed to have now."""
        radius = docking_radius(self.problem, self._docks)
        return self.problem.with_state(joint.states, joint.goals, goal_radius=radius).arrays

    def _moved(self, joint: JointState, controls: FloatArray) -> JointState:
        d = self.problem.dimension
        step = self._engine.step(self.arrays(joint), joint.states, joint.arrived, controls)
        bodies = joint.bodies.copy()
        if len(bodies):
            bodies[:, :d] += self.problem.dt * bodies[:, d : 2 * d]
        return joint._replace(states=step.states, arrived=step.arrived & self.problem.docks, bodies=bodies)

    @property
    def caution(self) -> float:
        """Speed by which a robot may soon be too fast, whichever way it goes [m/s]."""
        return 0.0 if self.drift < STEADY * self._speed else min(self.drift, FASTEST * self._speed)

    def room(self, reaction_time: float) -> float:
        """Return how far robots get from where they are expected within so many seconds [m].

        What makes a robot of first order stray is over with the next command to arrive.
        """
        next_command = min((1 + len(self.lateness.under_way)) * self.problem.dt, reaction_time)
        within = np.where(self._first_order, next_command, reaction_time)
        return min(float((within * self.speed).max()), MOST * self.problem.team.largest_radius)
