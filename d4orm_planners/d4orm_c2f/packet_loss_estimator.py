"""Commands that do not arrive: how many of them, and for how long a robot may go on with the last one that did."""

from __future__ import annotations

import math

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray
from d4orm_env.core.problem import Problem
from d4orm_planners.d4orm_c2f.actuator_gain_estimator import effort

NOTICED = 0.3
"""A command counts if it is so far from what was executed last, as a share of a robot's limits."""

BEFORE = 5
"""So many are taken to have arrived before the first."""

RARE = 1e-4
"""Runs of losses that begin more rarely than that are not reckoned with."""

MOST = 10
"""Longer ones neither."""


class Losses:
    """Watches an episode for robots that go on with the command before instead of a new one.

    Args:
        problem: The robots.

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
            self.run = min(math.ceil(math.log(RARE) / math.log(self._lost / self._sent)), MOST)
        return lost
