"""Policies: what acts in an ``env.step`` loop, from observations and ``env.state()`` alone."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import numpy as np

from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.problem import Problem
from d4orm_env.core.seeds import Stream, generator
from d4orm_env.joint_state import JointState, split_state
from d4orm_planners.base import Planner
from d4orm_planners.plan import Plan
from d4orm_planners.settings import Settings
from d4orm_planners.steering import drive_to_goal

Actions = dict[str, FloatArray]


class Policy(ABC):
    """Something that chooses every robot's control at every step.

    Attributes:
        name: Registry name.
        config_class: :class:`~d4orm_planners.settings.Settings` of the policy, of which the constructor takes an
            instance; ``None`` for a policy without settings, whose constructor takes nothing.
    """

    name: ClassVar[str]
    config_class: ClassVar[type[Settings] | None] = None

    def reset(self, env: Any, seed: int = 0) -> None:
        """Get ready for an episode that ``env.reset()`` has begun.

        Args:
            env: A :mod:`d4orm_env.navigation_v0` parallel environment, wrapped or not.
            seed: Seeds whatever the policy draws.
        """
        self.problem: Problem = env.unwrapped.problem
        self._begin(env, seed)

    def act(self, observations: dict[str, Any], state: Any) -> Actions:
        """Controls for the agents in ``observations``.

        Args:
            observations: The environment's observations; their keys are the agents that act.
            state: ``env.state()``.

        Returns:
            ``{agent: (m,) float32 control}``.

        Raises:
            RuntimeError: Before the first reset.
        """
        if not hasattr(self, "problem"):
            raise RuntimeError("the policy has seen no environment yet; call reset(env) before act()")
        joint = split_state(self.problem, state)
        controls = self._controls(joint)
        return {agent: controls[int(agent.rsplit("_", 1)[1])] for agent in observations}

    def _begin(self, env: Any, seed: int) -> None:  # noqa: B027 - a hook that most policies need not fill
        """What the policy does at a reset beyond looking at the problem."""

    @abstractmethod
    def _controls(self, joint: JointState) -> FloatArray:
        """``(K, m)`` controls of the whole team."""


class OpenLoop(Policy):
    """Plans once at the reset and executes the plan, whatever happens.

    Attributes:
        planner: What makes the plan.
        plan: The plan of the present episode.
    """

    name = "open-loop"

    def __init__(
        self, planner: Planner | None = None, plan: Plan | None = None, time_limit: float | None = None
    ) -> None:
        if (planner is None) == (plan is None):
            raise ValueError("an open-loop policy needs either a planner or a plan")
        self.planner = planner
        self.plan = plan
        self.time_limit = time_limit

    def _begin(self, env: Any, seed: int) -> None:
        if self.planner is not None:
            self.plan = self.planner.solve(self.problem, seed=seed, time_limit=self.time_limit)
        elif self.plan is not None and self.plan.problem != self.problem:
            raise ValueError(
                "the plan was made for another problem than the environment's; plan for this one, or keep one with "
                "randomize_instance=False"
            )

    def _controls(self, joint: JointState) -> FloatArray:
        assert self.plan is not None
        if joint.steps >= len(self.plan.controls):
            return np.zeros_like(self.plan.controls[0])
        return self.plan.controls[joint.steps]


class RandomControls(Policy):
    """Controls drawn uniformly from the box of each robot's limits."""

    name = "random"

    def _begin(self, env: Any, seed: int) -> None:
        self._generator = generator(seed, Stream.RANDOM_CONTROLS)

    def _controls(self, joint: JointState) -> FloatArray:
        limit = self.problem.team.control_limits
        return self._generator.uniform(-limit, limit).astype(np.float32)


class DriveToGoal(Policy):
    """Drives straight to the goal and brakes for it, as if nobody else were there."""

    name = "goal"

    def _controls(self, joint: JointState) -> FloatArray:
        return drive_to_goal(self.problem, joint.states, joint.goals)
