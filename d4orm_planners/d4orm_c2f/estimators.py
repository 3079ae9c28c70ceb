"""Estimators of actuator gains, latency, packet loss and stalls, from commands as sent and as executed."""

from __future__ import annotations

import math

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray, Floats
from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.dynamics.robot_model import ACCELERATION
from d4orm_env.envs.joint_state import JointState
from d4orm_planners.tracking.steering import by_model, present_velocities, track_velocities, weaker

AT_LIMIT = 0.95  #: Share of its limits from which on a command asks a robot for all that it can do
MIN_FULL_COMMANDS = 5  #: Number of such commands before a robot may be believed to be weak
FULL_GAIN = 0.97  #: Gain from which on a robot counts as strong as its limits say
MIN_GAIN = 0.3  #: Lowest gain that is believed
FORGETTING_RATE = 0.1  #: Share that the mean of the disturbances of commands forgets in a time step, later on
PRIOR_STEPS = 4  #: Number of steps without a disturbance that the mean begins with
SIGNIFICANCE = 3.0  #: Number of standard errors up to which that mean may be noise
MAX_CORRELATION = 0.9  #: Largest correlation of one disturbance of commands with the one before that is believed
NO_VARIANCE = 1e-12  #: Variance, in shares of the limits, below which there is none
GAIN_STEP = 0.05  #: Resolution of the shares of the limits that are kept back


def shares_of_limits(problem: Problem, controls: FloatArray | Floats) -> Floats:
    """``(K, m)`` controls ``(K, m)`` in shares of the robots' limits."""
    limits = np.asarray(problem.team.control_limits, np.float64)
    return np.divide(controls, limits, out=np.zeros_like(limits), where=limits > 0)


def efforts(problem: Problem, controls: FloatArray | Floats) -> Floats:
    """``(K, m)`` norms of controls ``(K, m)`` in shares of the limits, over the components that one limit bounds."""
    squares = shares_of_limits(problem, controls) ** 2
    for model, robots in by_model(problem):
        for column in set(model.control_limits):
            together = np.ix_(robots, [i for i, own in enumerate(model.control_limits) if own == column])
            squares[together] = squares[together].sum(axis=1, keepdims=True)
    return np.sqrt(squares)


def effort(problem: Problem, controls: FloatArray | Floats) -> Floats:
    """``(K,)`` sizes of controls ``(K, m)``: one at any of the robots' limits."""
    most: Floats = efforts(problem, controls).max(axis=1)
    return most


class ActuatorGainEstimator:
    """Estimates the limits of robots that never do as much as they are asked to, or are held back.

    What they do at most of what they are asked to is what they are able to. A robot that is weak in one of its controls
    counts as no faster than that. Something that is added to commands for some time, such as a bias, takes away from
    that against its direction; so much is kept back to make up for it, as tightened limits of control do in robust
    predictive control (Chisci, Rossiter, Zappa, Systems with persistent disturbances: predictive control with
    restricted constraints, Automatica 37, 2001). Noise comes to nothing on average: a mean that may be chance is not
    kept back, and one of noise that lasts may be chance for longer.
    """

    def __init__(self, problem: Problem) -> None:
        self._first = self.problem = problem  #: The robots with the limits that are believed now
        shape = problem.num_robots, problem.control_size
        self._most, self._asked = np.zeros(shape), np.zeros(shape, int)
        self._share = self._control_share = np.ones(shape)
        self._seen, (self._added, self._apart) = np.zeros(problem.num_robots), np.zeros((2, *shape))
        self._variance, self._covariance = np.zeros((2, problem.num_robots))
        self.added = np.zeros(shape, np.float32)  #: ``(K, m)`` lasting additions to commands; zero if by chance

    def observe(self, commanded: FloatArray, executed: FloatArray, going: BoolArray) -> None:
        """Compare commands ``(K, m)`` with what those ``going`` ``(K,)`` executed of them."""
        asked = efforts(self._first, commanded)
        most = going[:, None] & (asked >= AT_LIMIT)
        self._asked += most
        done = efforts(self._first, executed) / np.where(most, asked, 1.0)
        # Also what they do when asked for less: nobody asks a robot for more than it is believed to do.
        self._most[going] = np.maximum(self._most, done)[going]
        weak = (self._asked >= MIN_FULL_COMMANDS) & (self._most < FULL_GAIN)
        share = np.where(weak, self._most, 1.0)
        # A weak robot does that share of everything, or all that it is asked to up to that share of its limits.
        capped = np.where(weak, share / np.maximum(np.maximum(asked, share), 1e-9), 1.0)
        scaled, cut = (np.asarray(executed, np.float64) - factor * commanded for factor in (share, capped))
        self._persist(np.where(efforts(self._first, cut) < efforts(self._first, scaled), cut, scaled), going)
        held_back = GAIN_STEP * np.floor(efforts(self._first, self.added) / GAIN_STEP)
        share, control_share = (np.maximum(part, MIN_GAIN) for part in (share, share - held_back))
        if (control_share != self._control_share).any() or (share != self._share).any():
            self._share, self._control_share = share, control_share
            team = weaker(self._first.team, share.min(axis=1), control_share)
            self.problem = self._first.with_state(self._first.start, self._first.goal, team=team)

    def _persist(self, added: Floats, going: BoolArray) -> None:
        """Note what is ``added`` ``(K, m)`` now to commands of those ``going`` ``(K,)``."""
        self._seen += going
        rate = np.maximum(FORGETTING_RATE, 1 / (PRIOR_STEPS + self._seen))
        apart, new = shares_of_limits(self._first, added - self._added), rate * going
        self._variance += new * ((apart**2).sum(axis=1) - self._variance)
        self._covariance += new * ((apart * self._apart).sum(axis=1) - self._covariance)
        self._apart[going] = apart[going]
        self._added += new[:, None] * (added - self._added)
        correlation = (self._covariance / np.maximum(self._variance, NO_VARIANCE)).clip(0, MAX_CORRELATION)
        # Of a mean that forgets exponentially, of values of which each is like the one before by the correlation.
        error = np.sqrt(rate / (2 - rate) * self._variance * (1 + correlation) / (1 - correlation))
        significant = effort(self._first, self._added) > SIGNIFICANCE * error
        self.added = np.where(significant[:, None], self._added, 0.0).astype(np.float32)


MAX_LATENCY = 10  #: Largest latency that is recognised [steps]
DECAY = 0.98  #: Share of a difference that is left after a time step
CONFIDENCE = 0.5  #: A latency is believed once its commands miss what was executed by this share of the present one's


class LatencyEstimator:
    """Estimates the latency of commands by comparing those sent with those executed, unless it is ``known`` [steps]."""

    def __init__(self, team: Team, known: int | None) -> None:
        self._units = team.control_units
        self._known = known is not None
        self.steps = known or 0  #: The latency [steps]
        # Before the first there were none, which is as if they were zero.
        self._sent = [np.zeros_like(self._units)] * (max(MAX_LATENCY, self.steps) + 1)
        self._apart = np.zeros(MAX_LATENCY + 1)

    @property
    def under_way(self) -> list[FloatArray]:
        """Commands ``(K, m)`` each that are still to be executed, the next one first."""
        return self._sent[-self.steps :] if self.steps else []

    def observe(self, executed: FloatArray, going: BoolArray) -> FloatArray:
        """``(K, m)`` the commands that should have been executed in the last step.

        Args:
            executed: ``(K, m)`` those that were.
            going: ``(K,)`` robots that execute commands, having neither arrived nor stalled.
        """
        if not self._known:
            sent = np.stack(self._sent[: -MAX_LATENCY - 2 : -1])
            self._apart = DECAY * self._apart + (((sent - executed) / self._units)[:, going] ** 2).sum(axis=(1, 2))
            best = int(self._apart.argmin())
            if self._apart[best] < CONFIDENCE * self._apart[self.steps]:
                self.steps = best
        return self._sent[-1 - self.steps]

    def send(self, controls: FloatArray) -> FloatArray:
        """Remember commands ``(K, m)``, inside the limits, and return those ``(K, m)`` that are executed now."""
        self._sent = [*self._sent[1:], controls]
        return self._sent[-1 - self.steps]


MIN_CHANGE = 0.3  #: Least distance of a command that counts from what was executed last, in shares of a robot's limits
PRIOR_COMMANDS = 5  #: Number of commands taken to have arrived before the first
NEGLIGIBLE = 1e-4  #: Probability of a run of losses up to which it is neglected
MAX_RUN = 10  #: Longest run of losses that is expected


class PacketLossEstimator:
    """Detects robots that repeat the command before instead of a new one, and estimates how often that happens."""

    def __init__(self, problem: Problem) -> None:
        self._problem, self._last = problem, np.zeros((problem.num_robots, problem.control_size), np.float32)
        self._sent, self._lost = PRIOR_COMMANDS, 0
        self.run = 0  #: Number of commands that may get lost in a row

    def observe(self, commanded: FloatArray, executed: FloatArray, going: BoolArray) -> BoolArray:
        """``(K,)`` robots that go on with the command before, or stay at rest, whatever they were told.

        Args:
            commanded: ``(K, m)`` the commands that should have been executed in the last step.
            executed: ``(K, m)`` those that were.
            going: ``(K,)`` robots that execute commands, having neither arrived nor stalled.
        """
        lost: BoolArray = going & (executed == self._last).all(axis=1) & (executed != commanded).any(axis=1)
        new = going & (effort(self._problem, commanded - self._last) > MIN_CHANGE)
        # A robot at rest may be kept from moving by something else.
        self._lost += int((lost & new & executed.any(axis=1)).sum())
        self._sent += int(new.sum())
        self._last = executed
        if self._lost:
            self.run = min(math.ceil(math.log(NEGLIGIBLE) / math.log(self._lost / self._sent)), MAX_RUN)
        return lost


IDLE_STEPS = 8  #: Steps in a row without a response to commands after which a robot has stalled
BRAKING_STEPS = 3  #: Steps in a row of braking as hard as it can against its commands after which it has stalled
MIN_BRAKING = 0.5  #: Least braking that counts, and least distance of the command from it, in shares of the limits
MIN_COMMAND, MIN_RESPONSE = 0.2, 0.1
"""Least command that counts, as a share of a robot's limits, and least response to it, as a share of the command."""
RECOVERED = 2 / 3  #: Distance from where it stalled at which a robot moves again, in radii of the largest robot
PROBE = 0.1  #: Command of a stalled robot, as a share of its limits, which shows when it obeys again


class StallEstimator:
    """Detects robots that brake or stay at rest whatever they are commanded."""

    def __init__(self, problem: Problem) -> None:
        self._problem, self._d = problem, problem.dimension
        self._idle, self._braking = np.zeros((2, problem.num_robots), int)
        self.robots: BoolArray = np.zeros(problem.num_robots, bool)  #: ``(K,)`` stalled robots
        self._positions = np.zeros((problem.num_robots, self._d), np.float32)
        self._brakes: FloatArray = np.zeros((problem.num_robots, problem.control_size), np.float32)

    def observe(self, joint: JointState, commanded: FloatArray) -> JointState:
        """The joint state, in which stalled robots have arrived where they are, or will come to rest.

        Args:
            joint: State of the robots.
            commanded: ``(K, m)`` the commands that should have been executed in the last step.
        """
        problem, positions = self._problem, joint.states[:, : self._d]
        asked, done = effort(problem, commanded), effort(problem, joint.controls)
        idle = (asked > MIN_COMMAND) & (done < MIN_RESPONSE * asked)
        self._idle[idle] += 1
        self._idle[(asked > MIN_COMMAND) & ~idle | joint.arrived] = 0
        braking = effort(problem, joint.controls - self._brakes) < MIN_RESPONSE
        hard = (effort(problem, self._brakes) > MIN_BRAKING) & (effort(problem, commanded - self._brakes) > MIN_BRAKING)
        self._braking = np.where(braking & hard & ~joint.arrived, self._braking + 1, 0)
        new = ((self._idle >= IDLE_STEPS) | (self._braking >= BRAKING_STEPS)) & ~self.robots
        self.robots = self.robots | new
        still = np.zeros_like(joint.goals)
        self._brakes = track_velocities(problem, joint.states, still)
        rolling = braking & (effort(problem, self._brakes) > MIN_RESPONSE)
        velocity = present_velocities(problem, joint.states, joint.controls)
        pace = np.linalg.norm(velocity, axis=1, keepdims=True)
        to_rest = positions + velocity * pace / (2 * problem.team.limits[:, ACCELERATION, None])
        self._positions = np.where((self.robots & rolling | new)[:, None], to_rest, self._positions).astype(np.float32)
        self.robots &= rolling | (
            np.linalg.norm(positions - self._positions, axis=1) <= RECOVERED * problem.team.largest_radius
        )
        if not self.robots.any():
            return joint
        stalled, states = self.robots[:, None], np.zeros_like(joint.states)
        states[:, : self._d] = self._positions
        states[:, self._d :] = np.where(stalled, 0, joint.states[:, self._d :])
        return joint._replace(
            states=np.where(stalled, states, joint.states),
            goals=np.where(stalled, self._positions, joint.goals),
            arrived=joint.arrived | self.robots,
        )
