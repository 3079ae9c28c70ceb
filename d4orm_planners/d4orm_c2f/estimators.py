"""Estimators of what is wrong with robots, from the commands that they were sent and those that they executed: weak
actuators, late commands, lost ones, and robots that have stalled.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import BoolArray, FloatArray
from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.dynamics.robot_model import ACCELERATION, STANDARD_LIMITS
from d4orm_env.envs.joint_state import JointState
from d4orm_planners.tracking.steering import present_velocities, track_velocities

AT_LIMIT = 0.95
"""Share of its limits from which a robot is asked for the most that it can do."""

ENOUGH = 5
"""Times that it has to be, before it is believed to do less."""

AS_STRONG = 0.97
"""Share of it from which on a robot is as strong as its limits say."""

WEAKEST = 0.3
"""Lowest gain that is believed."""

FORGOTTEN = 0.1
"""Share that the mean of what is added to commands loses in a time step, ..."""

FIRST = 4
"""... after the first steps, which count as if so many with nothing added had been before."""

BY_CHANCE = 3.0
"""Number of standard errors that mean may be, and still be nothing but noise."""

STEP = 0.05
"""Shares of the limits that are told apart."""


def effort(problem: Problem, controls: FloatArray | NDArray[np.float64]) -> NDArray[np.float64]:
    """``(K,)`` how large controls ``(K, m)`` are, in shares of the robots' limits."""
    limits = np.asarray(problem.team.control_limits, np.float64)
    shares = np.divide(controls, limits, out=np.zeros_like(limits), where=limits > 0)
    return np.sqrt((shares**2).sum(axis=1))


class ActuatorGainEstimator:
    """Watches an episode for robots that never do as much as they are asked to, or are held back.

    What they do at most of what they are asked to is what they are able to. Something that is added to commands for
    some time, such as a bias, takes away from that against its direction; so much is kept back, as tightened limits of
    control do in robust predictive control (Chisci, Rossiter, Zappa, Systems with persistent disturbances: predictive
    control with restricted constraints, Automatica 37, 2001). Noise comes to nothing on average: a mean that may be
    chance is not kept back.

    Args:
        problem: The robots, with the limits that are believed at first.

    Attributes:
        problem: The same with the limits of speed, acceleration and turn rate that are believed now.
    """

    def __init__(self, problem: Problem) -> None:
        self._first = self.problem = problem
        self._most, self._share = np.zeros(problem.num_robots), np.ones(problem.num_robots)
        self._asked = np.zeros(problem.num_robots, int)
        self._seen, self._added = 0, np.zeros((problem.num_robots, problem.control_size))
        self._variance = np.zeros_like(self._added)

    def observe(self, commanded: FloatArray, executed: FloatArray, going: BoolArray) -> None:
        """Compare commands ``(K, m)`` with what those ``going`` ``(K,)`` executed of them."""
        asked = effort(self._first, commanded)
        most = going & (asked >= AT_LIMIT)
        self._asked += most
        done = effort(self._first, executed) / np.maximum(asked, AT_LIMIT)
        self._most[most] = np.maximum(self._most, done)[most]
        weak = (self._asked >= ENOUGH) & (self._most < AS_STRONG)
        share = np.where(weak, self._most, 1.0)
        # A weak robot does that share of everything, or all that it is asked to up to that share of its limits.
        capped = np.where(weak, share / np.maximum(np.maximum(asked, share), 1e-9), 1.0)
        scaled, cut = (np.asarray(executed, np.float64) - factor[:, None] * commanded for factor in (share, capped))
        nearer = effort(self._first, cut) < effort(self._first, scaled)
        added = np.where(nearer[:, None], cut, scaled) * going[:, None]
        self._seen += 1
        held_back = STEP * np.floor(self._persistent(added) / STEP)
        share = np.maximum(share - held_back, WEAKEST)
        if (share != self._share).any():
            self._share = share
            self.problem = self._first.with_state(self._first.start, self._first.goal, team=self._team(share))

    def _persistent(self, added: NDArray[np.float64]) -> NDArray[np.float64]:
        """``(K,)`` effort that is added for some time, now that ``added`` ``(K, m)`` is."""
        rate = max(FORGOTTEN, 1 / (FIRST + self._seen))
        self._variance += rate * ((added - self._added) ** 2 - self._variance)
        self._added += rate * (added - self._added)
        # Of a mean that forgets exponentially, of independent values.
        error = np.sqrt(rate / (2 - rate) * self._variance)
        mean = effort(self._first, self._added)
        return np.where(mean > BY_CHANCE * effort(self._first, error), mean, 0.0)

    def _team(self, share: NDArray[np.float64]) -> Team:
        """The team that does a share ``(K,)`` of what it was believed to do."""
        team = self._first.team
        limits = {name: getattr(team, name) * share.astype(np.float32) for name in STANDARD_LIMITS}
        return Team(team.models, team.radius, own_limits=team.own_limits, **limits)


LATEST = 10
"""Steps late that commands may be and still be recognised."""

DECAY = 0.98
"""Share of a difference that is left after a time step."""

BETTER = 0.5
"""A lateness is believed once commands that late differ less than this share from those executed."""


class LatencyEstimator:
    """Remembers the commands that were sent, and compares them with those executed.

    Args:
        team: Robots that are sent commands.
        known: Steps late that commands are known to be, or ``None`` to find out.

    Attributes:
        steps: Their latency.
    """

    def __init__(self, team: Team, known: int | None) -> None:
        self._units = team.control_units
        self._known = known is not None
        self.steps = known or 0
        # Before the first there were none, which is as if they were zero.
        self._sent = [np.zeros_like(self._units)] * (max(LATEST, self.steps) + 1)
        self._apart = np.zeros(LATEST + 1)

    @property
    def under_way(self) -> list[FloatArray]:
        """Commands ``(K, m)`` each that are still to be executed, the next one first."""
        return self._sent[-self.steps :] if self.steps else []

    def observe(self, executed: FloatArray, going: BoolArray) -> FloatArray:
        """``(K, m)`` the commands that should have been executed in the last step.

        Args:
            executed: ``(K, m)`` those that were.
            going: ``(K,)`` whose tell anything: docked robots execute none.
        """
        if not self._known:
            sent = np.stack(self._sent[: -LATEST - 2 : -1])
            self._apart = DECAY * self._apart + (((sent - executed) / self._units)[:, going] ** 2).sum(axis=(1, 2))
            best = int(self._apart.argmin())
            if self._apart[best] < BETTER * self._apart[self.steps]:
                self.steps = best
        return self._sent[-1 - self.steps]

    def send(self, controls: FloatArray) -> FloatArray:
        """Remember commands ``(K, m)``, inside the limits; those ``(K, m)`` that are executed now."""
        self._sent = [*self._sent[1:], controls]
        return self._sent[-1 - self.steps]


NOTICED = 0.3
"""A command counts if it is so far from what was executed last, as a share of a robot's limits."""

BEFORE = 5
"""So many are taken to have arrived before the first."""

RARE = 1e-4
"""Runs of losses that begin more rarely than that are not reckoned with."""

LONGEST_RUN = 10
"""Longer ones neither."""


class PacketLossEstimator:
    """Watches an episode for robots that go on with the command before instead of a new one.

    Attributes:
        run: So many commands in a row may get lost.
    """

    def __init__(self, problem: Problem) -> None:
        self._problem, self._last = problem, np.zeros((problem.num_robots, problem.control_size), np.float32)
        self._sent, self._lost = BEFORE, 0
        self.run = 0

    def observe(self, commanded: FloatArray, executed: FloatArray, going: BoolArray) -> BoolArray:
        """``(K,)`` robots that go on with the command before, or stay at rest, whatever they were told.

        Args:
            commanded: ``(K, m)`` the commands that should have been executed in the last step.
            executed: ``(K, m)`` those that were.
            going: ``(K,)`` whose tell anything: docked robots execute none.
        """
        lost: BoolArray = going & (executed == self._last).all(axis=1) & (executed != commanded).any(axis=1)
        new = going & (effort(self._problem, commanded - self._last) > NOTICED)
        # Whoever stands may be kept from moving by something else.
        self._lost += int((lost & new & executed.any(axis=1)).sum())
        self._sent += int(new.sum())
        self._last = executed
        if self._lost:
            self.run = min(math.ceil(math.log(RARE) / math.log(self._lost / self._sent)), LONGEST_RUN)
        return lost


AFTER = 8
"""Steps in a row in which a robot does nothing of what it is commanded, after which it has stalled."""

BRAKING_AFTER = 3
"""The same of steps in which it brakes as hard as it can instead."""

RESISTING = 0.5
"""Braking as hard counts from this share of its limits on, and instead if what it was commanded is as far from it."""

COMMANDED, DONE = 0.2, 0.1
"""Least command that counts, as a share of a robot's limits; and least motion that obeys it, as a share of that."""

MOVED = 2 / 3
"""Distance from there at which it is back, in radii of the largest robot."""

PROBE = 0.1
"""Share of its limits that a robot that has stalled is commanded, so that it is seen when it obeys again."""


class StallEstimator:
    """Watches an episode for robots that brake or stay at rest whatever they are commanded.

    Attributes:
        robots: ``(K,)`` those that do.
    """

    def __init__(self, problem: Problem) -> None:
        self._problem, self._d = problem, problem.dimension
        self._idle, self._braking = np.zeros((2, problem.num_robots), int)
        self.robots: BoolArray = np.zeros(problem.num_robots, bool)
        self._positions = np.zeros((problem.num_robots, self._d), np.float32)
        self._brakes: FloatArray = np.zeros((problem.num_robots, problem.control_size), np.float32)

    def observe(self, joint: JointState, commanded: FloatArray) -> JointState:
        """The joint state, in which those that do not obey are docked where they are, or will come to rest.

        Args:
            joint: State of the robots.
            commanded: ``(K, m)`` the commands that should have been executed in the last step.
        """
        problem, positions = self._problem, joint.states[:, : self._d]
        asked, done = effort(problem, commanded), effort(problem, joint.controls)
        idle = (asked > COMMANDED) & (done < DONE * asked)
        self._idle[idle] += 1
        self._idle[(asked > COMMANDED) & ~idle | joint.arrived] = 0
        braking = effort(problem, joint.controls - self._brakes) < DONE
        hard = (effort(problem, self._brakes) > RESISTING) & (effort(problem, commanded - self._brakes) > RESISTING)
        self._braking = np.where(braking & hard & ~joint.arrived, self._braking + 1, 0)
        new = ((self._idle >= AFTER) | (self._braking >= BRAKING_AFTER)) & ~self.robots
        self.robots = self.robots | new
        still = np.zeros_like(joint.goals)
        self._brakes = track_velocities(problem, joint.states, still)
        rolling = braking & (effort(problem, self._brakes) > DONE)
        velocity = present_velocities(problem, joint.states, joint.controls)
        pace = np.linalg.norm(velocity, axis=1, keepdims=True)
        to_rest = positions + velocity * pace / (2 * problem.team.limits[:, ACCELERATION, None])
        self._positions = np.where((self.robots & rolling | new)[:, None], to_rest, self._positions).astype(np.float32)
        self.robots &= rolling | (
            np.linalg.norm(positions - self._positions, axis=1) <= MOVED * problem.team.largest_radius
        )
        if not self.robots.any():
            return joint
        stand, states = self.robots[:, None], np.zeros_like(joint.states)
        states[:, : self._d] = self._positions
        states[:, self._d :] = np.where(stand, 0, joint.states[:, self._d :])
        return joint._replace(
            states=np.where(stand, states, joint.states),
            goals=np.where(stand, self._positions, joint.goals),
            arrived=joint.arrived | self.robots,
        )
