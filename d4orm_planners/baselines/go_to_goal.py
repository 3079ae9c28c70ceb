"""Greedy go-to-goal: the least that any planner must beat."""

from __future__ import annotations

from d4orm_env.core.arrays import FloatArray
from d4orm_env.envs.joint_state import JointState
from d4orm_planners.base.policy import StatePolicy
from d4orm_planners.tracking.steering import drive_to_goal


class GoToGoal(StatePolicy):
    """Drives straight to the goal and brakes for it, as if it were alone."""

    name = "go-to-goal"

    def _controls(self, joint: JointState) -> FloatArray:
        return drive_to_goal(self.problem, joint.states, joint.goals)
