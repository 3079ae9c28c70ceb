"""Robots that do not obey any more and stand: the others drive around them."""

from __future__ import annotations

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray
from d4orm_env.core.problem import Problem
from d4orm_env.joint_state import JointState
from d4orm_planners.d4orm_c2f.weakness import effort

AFTER = 8
"""Steps in a row in which a robot does nothing of what it is told, after which it has stalled."""

TOLD, DONE = 0.2, 0.1
"""What counts as being told something, as a share of a robot's limits; and as doing it, as a share of that."""

MOVED = 0.1
"""How far it gets from there to be back [m]."""

PROBE = 0.1
"""Share of its limits that a robot that has stalled is told, so that it is seen when it obeys again."""


class Standing:
    """Watches an episode for robots that stand whatever they are told.

    Args:
        problem: The robots.

    Attributes:
        robots: ``(K,)`` those that do.
    """

    def __init__(self, problem: Problem) -> None:
        self._problem, self._d = problem, problem.dimension
        self._idle = np.zeros(problem.num_robots, int)
        self.robots: BoolArray = np.zeros(problem.num_robots, bool)
        self._places = np.zeros((problem.num_robots, self._d), np.float32)

    def observe(self, joint: JointState, told: FloatArray) -> JointState:
        """The joint state, in which those that stand are docked where they are.

        Args:
            joint: Where the robots are.
            told: ``(K, m)`` the commands that should have been executed in the last step.
        """
        asked, done = effort(self._problem, told), effort(self._problem, joint.controls)
        idle = (asked > TOLD) & (done < DONE * asked)
        self._idle[idle] += 1
        self._idle[(asked > TOLD) & ~idle | joint.arrived] = 0
        places = joint.states[:, : self._d]
        new = (self._idle >= AFTER) & ~self.robots
        self._places[new] = places[new]
        self.robots = self.robots | new
        self.robots &= np.linalg.norm(places - self._places, axis=1) <= MOVED
        if not self.robots.any():
            return joint
        stand, states = self.robots[:, None], np.zeros_like(joint.states)
        states[:, : self._d] = self._places
        states[:, self._d :] = np.where(stand, 0, joint.states[:, self._d :])
        return joint._replace(
            states=np.where(stand, states, joint.states),
            goals=np.where(stand, self._places, joint.goals),
            arrived=joint.arrived | self.robots,
        )
