"""A policy in a robot team's own control loop: measured states in, setpoints out, no environment needed."""

from __future__ import annotations

from collections import deque
from contextlib import AbstractContextManager
from functools import partial
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike
from pettingzoo import ParallelEnv

from d4orm_env.core.arrays import BoolArray, FloatArray, Floats, check_choice, positive_number, read_only, truth
from d4orm_env.core.problem import Problem
from d4orm_env.core.problem_checks import check_is_problem
from d4orm_env.envs.joint_state import JointState, split_state
from d4orm_planners.base.disturbance_observer import DisturbanceObserver, check_lag, with_lag_of
from d4orm_planners.base.episode import open_env
from d4orm_planners.base.measured_states import OLDEST, brought_up, completed, seconds
from d4orm_planners.base.planner_registry import PolicyLike, make_policy, setting_names
from d4orm_planners.base.policy import Actions, Observations, OpenLoop, Policy, robot_indices
from d4orm_planners.base.policy_threads import Background, TimeLimit, check_episode, keep_collections_short
from d4orm_planners.tracking.reference_feedback import (
    ActuatorLag,
    ControlSetpoint,
    LaggedReference,
    Reference,
    regulated,
)
from d4orm_planners.tracking.steering import advanced, limited_states, present_velocities, track_velocities, weaker

Mode = Literal["nominal", "measured"]
SAME_PERIOD = 0.5  #: Share of a period within which another call gets the same setpoint
LATE = 0.25  #: Share of a period by which a late step's successors may come earlier than a period after it
IN_TIME = 0.8  #: Share of a step's timeout that is a policy's deadline


class Controller(AbstractContextManager["Controller"]):
    """A policy as a controller of real or simulated robots.

    It keeps a model of the team, the reference, which is stepped as the environment would be. Robots that have reached
    their goals stay there for good, and their controls bring them back if they are measured elsewhere.

    In mode ``"nominal"`` the policy sees the reference, and robots follow it: by their own trackers, which are given
    position, velocity and acceleration, or by the controls, which have a feedback on what was measured. In mode
    ``"measured"`` the policy sees what was measured; a plan, which looks at nothing, is followed in either mode. In
    both, controls make up for what pushes a robot all the time, as a thrust that is too weak does.

    Numbers of measured states that are not finite are missing: where a robot's position or heading is, the reference
    takes its place, and what else is follows from its last state and control. Speeds and coordinates beyond what a
    robot's model allows count as the limit. A late step delays the reference; it never leaps, nor when a clock is set.

    Args:
        policy: Anything that :func:`~d4orm_planners.make_policy` takes.
        mode: ``"nominal"`` or ``"measured"``.
        reserve: Share of the robots' limits on speed, acceleration and turn rate, and of what goal headings may be
            missed by, that the reference leaves to the feedback, in mode ``"nominal"`` or with a tracker. By default
            0.5 with a tracker, which has its robot tilt or turn before it can push, 0.2 in mode ``"nominal"`` without,
            else none. With a tracker, robots also dock more slowly by that share.
        timeout: Longest time that a step is to take [s], ``None`` for any. It waits for the policy as long as what
            comes after fits in; then robots brake, and its late answer is not used. A named policy with a
            ``deadline``, as D4orm-C2F, gets four fifths of it.
        lag: Time constant of the robots' actuators [s], one or one per robot. The estimate of that allows for it, and
            setpoints come later by the largest: with it robots can drive as the reference does. In mode ``"measured"``
            the policy sees robots as they would be without it. By default it is the team's; of a team without one it is
            found, as robots driven by accelerations drive without a tracker.
        tracker: True if robots follow positions and velocities by a controller of their own, as drones do. Setpoints
            are shifted against a lasting distance from the reference, as a thrust that is too weak causes, up to the
            margin. In mode ``"measured"`` the reference goes towards what was measured by ``dt / (dt + 2 lag)`` of the
            way a step: all at once would ask again for what the robots are about to do.
        **settings: Of the policy.

    Attributes:
        states: ``(K, n)`` the last measured states, completed.
        clock_resets: Times that the clock was set back by half a period or more.

    Raises:
        ValueError: For a bad argument, or if there is no such policy.
    """

    def __init__(
        self,
        policy: PolicyLike = "d4orm-c2f",
        *,
        mode: Mode = "nominal",
        reserve: float | None = None,
        timeout: float | None = None,
        lag: ArrayLike | None = None,
        tracker: bool = False,
        **settings: Any,
    ) -> None:
        check_choice(mode, "mode", get_args(Mode))
        self.mode, default = mode, 0.5 if tracker else 0.2 if mode == "nominal" else 0.0
        self.reserve = default if reserve is None else positive_number(reserve, "reserve", zero_allowed=True, most=0.9)
        self.timeout = None if timeout is None else positive_number(timeout, "timeout")
        if self.timeout is not None and isinstance(policy, str) and "deadline" in setting_names(policy, settings):
            settings = {"deadline": IN_TIME * self.timeout} | settings
        self.policy: Policy = make_policy(policy, **settings)
        self.tracker = truth(tracker, "tracker")
        self._looks = mode == "measured" and not isinstance(self.policy, OpenLoop)
        self._given_lag = lag if lag is None else check_lag(lag)
        self._leads = self.tracker or not self._looks
        # A tracker follows by itself, and what a policy looks at is as without a lag.
        self._steers = self._leads and not self.tracker
        self._background: Background[Actions] = Background()
        self._limit = TimeLimit()
        self._env: Any = None
        self._observer: DisturbanceObserver
        self._time, self._lead, self.clock_resets = np.inf, np.zeros(0), 0
        self._ending: JointState | None = None  # the reference once the episode is over

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the policy's thread as soon as it has answered; a later step would start another."""
        self._background.close()

    def begin(self, problem: Problem, states: ArrayLike, time: float = 0.0, seed: int = 0) -> None:
        """Take over a team; policies that plan do so now, however long it takes.

        What was learned of pushes and lags is kept where the same team (``problem.team``) goes on in time.

        Args:
            problem: The team, its goals and its world.
            states: ``(K, n)`` measured states; where they are missing, those of ``problem.start``.
            time: Of the measurement [s], by any clock that goes on.
            seed: Seeds whatever the policy draws.

        Raises:
            ValueError: If there is no problem, the states have another shape, or the lag fits no team of this size.
        """
        check_is_problem(problem)
        self._background.forget()
        try:
            self._begin(problem, states, seconds(time), seed)
        except BaseException:
            self._env = None  # there is no team to step
            raise

    def _begin(self, problem: Problem, states: ArrayLike, time: float, seed: int) -> None:
        lag, known = self._given_lag, problem.team.lag
        if lag is None and (known.any() or self.tracker):  # else it is found
            lag = known
        observer, lead = DisturbanceObserver(problem, lag), np.zeros_like(problem.goal, np.float64)
        if time >= self._time and self._observer.problem.team is problem.team:
            observer.go_on_from(self._observer)
            lead = self._lead
        self._observer, self._lead, self._robots = observer, lead, problem
        self._driven: deque[FloatArray] = deque(maxlen=OLDEST)
        self._open(problem, seed)
        self.states, _ = completed(problem, self._bounds, states, problem.start, lambda: problem.start)
        start = self._possible(self.states)
        left = 1 - self.reserve
        within = {"team": weaker(problem.team, left), "goal_heading_tolerance": problem.goal_heading_tolerance * left}
        if self.tracker:  # which has no more than setpoints to stop with; controls have all that a robot can
            within["goal_speed"] = problem.goal_speed * left
        self._open(problem.with_state(start, problem.goal, **within), seed)
        self.policy.reset(self._env, seed=seed)
        own = ActuatorLag(self.lag * self._steers, problem.dt)
        self._time, self._lagged = time - problem.dt, LaggedReference(problem, start, own)
        idle = self._joint.controls
        self._setpoint = self._described(Reference(start, start, idle, idle), held=False)
        if self.timeout is not None:
            keep_collections_short()

    def step(self, states: ArrayLike, time: float, age: ArrayLike = 0.0) -> ControlSetpoint:
        """Return the setpoint for the period that begins now.

        Called more often than once every ``problem.dt`` it returns the same one again.

        Args:
            states: ``(K, n)`` measured states, NaN for what is missing.
            time: Now [s].
            age: How long ago they were measured [s], one or ``(K,)``, at most ten periods: robots are taken
                to have gone on since, as what they were told has it.

        Raises:
            RuntimeError: Before :meth:`begin`.
            ValueError: If the states have another shape, the time is no number of seconds, or one is too old.
        """
        self._limit.begin(self.timeout)
        reference, dt = self._joint.states, self.problem.dt
        expected = partial(advanced, self._robots, self.states, self._setpoint.control)
        measured, known = completed(self.problem, self._bounds, states, reference, expected)
        measured = brought_up(self._robots, measured, known, self._driven, age)
        passed = (seconds(time) - self._time) / dt
        if abs(passed) >= SAME_PERIOD:
            # Of what robots did in another time than a period nothing can be learned.
            if self._observer.observe(measured, known & (0 <= passed < 1 + SAME_PERIOD)) and self._steers:
                self._lagged.adopt(self._observer.lag)
            self._setpoint = self._advance(measured, known)
            # Periods follow each other, so that frequent calls do not make the reference faster than the clock.
            self._time = float(time) if passed < 0 else max(self._time + dt, float(time) - LATE * dt)
            self.clock_resets += passed < 0
            self._driven.append(self._observer.driven)
            self._limit.end()
        return self._setpoint

    def reset(self, env: ParallelEnv, seed: int = 0) -> None:
        """Take over the team of an environment: controllers are policies, for :func:`~d4orm_planners.run_episode`."""
        problem = with_lag_of(env)
        self.begin(problem, split_state(problem, env.state()).states, seed=seed)

    def act(self, observations: Observations, state: FloatArray) -> Actions:
        """Return the controls of all robots that are observed, from the environment's joint state."""
        joint = split_state(self._robots, state)
        control = self.step(joint.states, joint.steps * self._robots.dt).control
        return {agent: control[robot] for agent, robot in zip(observations, robot_indices(observations))}

    @property
    def lag(self) -> Floats:
        """``(K,)`` time constants of the actuators [s], given or, since :meth:`begin`, found."""
        return self._observer.lag.constants

    @property
    def arrived(self) -> BoolArray:
        """``(K,)`` bool: robots that have reached their goals."""
        return self._joint.arrived

    @property
    def over(self) -> bool:
        """True if all robots have arrived, or the problem's horizon is over; robots then brake and are held at rest."""
        return not self._opened.agents

    @property
    def _opened(self) -> Any:
        if self._env is None:
            raise RuntimeError("the controller has no team yet; call begin(problem, states) before step()")
        return self._env

    @property
    def _joint(self) -> JointState:
        env = self._opened
        return self._ending or split_state(self.problem, env.state())

    def _open(self, problem: Problem, seed: int) -> None:
        self.problem, self._ending = problem, None
        self._env = open_env(problem, policy=self.policy)
        self._observations, _ = self._env.reset(seed=seed)
        space, shape = self._env.state_space, problem.start.shape
        self._bounds = tuple(bound[: problem.start.size].reshape(shape) for bound in (space.low, space.high))

    def _possible(self, states: FloatArray) -> FloatArray:
        """``(K, n)`` states within the robots' limits and the state space."""
        return limited_states(self.problem, np.clip(states, *self._bounds))

    def _advance(self, measured: FloatArray, known: BoolArray) -> ControlSetpoint:
        rests = self.arrived & self.problem.docks
        self.states = measured
        if self.tracker:
            self._lead = self._observer.shifted(self._lead, self._joint.states, measured, known)
        if self._looks:
            observer, joint = self._observer, self._joint
            seen = observer.blended(measured, joint.states) if self.tracker else observer.undelayed(measured, known)
            if not self.over:
                self._observations, _ = self._env.set_state(
                    np.where(rests[:, None], joint.states, self._possible(seen))
                )
            if not self.tracker:
                self._lead, measured = (measured - seen)[:, : self.problem.dimension].astype(np.float64), seen
        before, actions = self._joint, self._actions()
        brakes = track_velocities(self.problem, before.states, np.zeros_like(before.goals))
        controls, held, led = brakes, not self.over and actions is None, self._leads or self.over | rests
        if self.over:
            states = advanced(self.problem, before.states, brakes)
            self._ending = before._replace(states=states, controls=brakes)
        else:
            actions = dict(zip(self._env.possible_agents, brakes)) if actions is None else actions
            self._observations, *_ = self._env.step({agent: actions[agent] for agent in self._env.agents})
            moving = before.states if self._leads else measured
            controls = self._observer.executed(moving, self._joint.states, self._joint.controls)
        reference = self._lagged.follow(before.states, self._joint.states, controls)
        # A robot that is where it is to be may still turn or move.
        error, lag, d = measured - reference.states, self._lagged.lag, self.problem.dimension
        error[:, :d] = measured[:, :d] - self._setpoint.position
        follows = known & led & ((np.abs(error).max(axis=1) > self.problem.rounding) | (lag.constants > 0))
        controls = reference.controls
        if follows.any():
            back = regulated(self._robots, measured, reference, self._observer.applied, lag)
            controls = np.where(follows[:, None], back, controls)
        return self._described(reference._replace(controls=self._observer.compensated(controls, self.arrived)), held)

    def _actions(self) -> Actions | None:
        """Return the policy's actions; ``None`` if they do not come in time, or the episode is over."""
        if self.over or self._background.is_busy:  # robots brake at once while an answer is late
            return None
        check_episode(self.policy, self._env)
        acting = {agent: self._observations[agent] for agent in self._env.agents}
        return self._limit.run(self._background, partial(self.policy.act, acting, self._env.state()))

    def _described(self, reference: Reference, held: bool) -> ControlSetpoint:
        """Return the setpoint of a reference, whose controls are those of the robots."""
        before, after, controls, applied = reference
        position, heading = after[:, : self.problem.dimension] + self._lead, self.problem.team.headings(after)
        velocity = present_velocities(self.problem, after, self._lagged.applied.astype(np.float32)).astype(np.float64)
        change = velocity - present_velocities(self.problem, before, applied)
        rest = (change / self.problem.dt, heading.astype(np.float64), controls, self.arrived.copy())
        return ControlSetpoint(*read_only((position, velocity, *rest)), held)
