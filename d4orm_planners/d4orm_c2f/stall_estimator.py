"""Robots that do not obey any more, but brake and stop: the others drive around them."""

from __future__ import annotations

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray
from d4orm_env.core.problem import Problem
from d4orm_env.dynamics.robot_model import ACCELERATION
from d4orm_env.envs.joint_state import JointState
from d4orm_planners.d4orm_c2f.actuator_gain_estimator import effort
from d4orm_planners.tracking.steering import present_velocities, track_velocities

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


class Standing:
    """Watches an episode for robots that brake or stay at rest whatever they are commanded.

    Args:
        problem: The robots.

    Attributes:
        robots: ``(K,)`` those that do.
    """

    def __init__(self, problem: Problem) -> None:
        self._problem, self._d = problem, problem.dimension
        self._idle, self._braking = np.zeros((2, problem.num_robots), int)
        self.robots: BoolArray = np.zeros(problem.num_robots, bool)
        self._places = np.zeros((problem.num_robots, self._d), np.float32)
        self._brakes: FloatArray = np.zeros((problem.num_robots, problem.control_size), np.float32)

    def observe(self, joint: JointState, commanded: FloatArray) -> JointState:
        """The joint state, in which those that do not obey are docked where they are, or will come to rest.

        Args:
            joint: State of the robots.
            commanded: ``(K, m)`` the commands that should have been executed in the last step.
        """
        problem, places = self._problem, joint.states[:, : self._d]
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
        to_rest = places + velocity * pace / (2 * problem.team.limits[:, ACCELERATION, None])
        self._places = np.where((self.robots & rolling | new)[:, None], to_rest, self._places).astype(np.float32)
        self.robots &= rolling | (np.linalg.norm(places - self._places, axis=1) <= MOVED * problem.team.largest_radius)
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
