"""Robots that are weaker than their limits say: how much they do of what they are asked to, whatever the direction."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import BoolArray, FloatArray
from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.dynamics.robot_model import STANDARD_LIMITS

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


class Weakness:
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
