"""Where robots are expected, how far they come from there, and what room that calls for."""

from __future__ import annotations

import numpy as np

from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.problem import Problem
from d4orm_env.engine.base import Engine
from d4orm_env.joint_state import JointState

DECAY = 0.98
"""What is left after a time step of the largest deviation seen."""

MOST = 0.15
"""No more room than this is called for [m]."""


class Deviation:
    """Watches how well an episode follows the model.

    Args:
        problem: The robots.
        engine: What knows how they should move.
        delay: Steps late that commands are executed.

    Attributes:
        speed: The largest deviation of a robot in a time step, over its length, of late [m/s].
    """

    def __init__(self, problem: Problem, engine: Engine, delay: int) -> None:
        self._problem, self._engine = problem, engine
        nothing = np.zeros((problem.num_robots, problem.control_size), np.float32)
        self._under_way = [nothing] * delay
        self._expected: FloatArray | None = None
        self.speed = 0.0

    def observe(self, joint: JointState) -> JointState:
        """Compare where the robots are with where they were expected; where they will be once commands arrive."""
        self.speed *= DECAY
        if self._expected is not None:
            d = self._problem.dimension
            away = np.linalg.norm(joint.states[:, :d] - self._expected[:, :d], axis=1)[~joint.arrived]
            self.speed = max(self.speed, float(away.max(initial=0.0)) / self._problem.dt)
        self._seen = joint
        for controls in self._under_way:
            joint = self._moved(joint, controls)
        return joint

    def expect(self, controls: FloatArray) -> None:
        """Remember where the robots should be in a time step, now that these controls ``(K, m)`` are sent."""
        self._under_way = [*self._under_way, controls]
        self._expected = self._moved(self._seen, self._under_way.pop(0)).states

    def _moved(self, joint: JointState, controls: FloatArray) -> JointState:
        arrays, d = self._problem.resumed_at(joint.states, joint.goals).arrays, self._problem.dimension
        step = self._engine.step(arrays, joint.states, joint.arrived, controls)
        bodies = joint.bodies.copy()
        if len(bodies):
            bodies[:, :d] += self._problem.dt * bodies[:, d : 2 * d]
        return joint._replace(states=step.states, arrived=step.arrived & self._problem.docks, bodies=bodies)

    def room(self, reaction_time: float) -> float:
        """How far robots get from where they are expected within so many seconds [m]."""
        return min(reaction_time * self.speed, MOST)
