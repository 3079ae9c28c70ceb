"""Multi-robot navigation as a Gymnasium environment: one agent steers the whole team."""

from __future__ import annotations

import gymnasium
import numpy as np
from numpy.typing import ArrayLike

from d4orm_env.core.arrays import FloatArray, whole_number
from d4orm_env.envs import ENV_ID, register_environments
from d4orm_env.envs.base_env import RENDER_MODES, BaseEnv
from d4orm_env.envs.inputs import check_options, joint_controls
from d4orm_env.envs.options import EnvOptions
from d4orm_env.envs.setup import EnvSetup
from d4orm_env.envs.team_step import Info, TeamStep, agent_infos
from d4orm_env.scenarios.problems import ScenarioLike

__all__ = ["ENV_ID", "JointNavigationEnv", "register_environments"]


class JointNavigationEnv(BaseEnv, gymnasium.Env[FloatArray, FloatArray]):
    """The joint environment, ``gymnasium.make("d4orm/Navigation-v0", scenario=..., num_robots=...)``.

    The observation ``(K * D,)`` is all robots' local observations one after the other, the action ``(K * m,)`` all
    their controls in physical units, the reward the team's mean reward (paper, section III-D). It terminates when every
    robot has arrived, and truncates after ``max_cycles`` steps. Infos hold ``agents`` (one dictionary per robot, as in
    :mod:`d4orm_env.navigation_v0`), ``metrics`` of the episode so far, and ``is_success``.

    Args:
        scenario: As in :class:`~d4orm_env.envs.options.EnvOptions`, like all others.
        num_robots: Size of the team.
        **options: Further attributes of :class:`~d4orm_env.envs.options.EnvOptions`, and arguments of the scenario.

    Raises:
        TypeError: For an argument that neither the environment nor the scenario has.
        ValueError: For a bad argument, or when both a problem and a scenario's arguments are given.
    """

    metadata: dict[str, object] = {"render_modes": list(RENDER_MODES), "render_fps": 10}  # noqa: RUF012

    def __init__(self, scenario: ScenarioLike | None = None, num_robots: int | None = None, **options: object) -> None:
        self._begin(EnvOptions.of(scenario=scenario, num_robots=num_robots, **options))
        self._agents = [f"robot_{robot}" for robot in range(self.problem.num_robots)]
        self.observation_space, self.action_space = joint_spaces(self._simulation.setup)
        self._action_shape = (self.problem.num_robots * self.problem.control_size,)

    def reset(self, *, seed: int | None = None, options: dict[str, object] | None = None) -> tuple[FloatArray, Info]:
        """Begin an episode; there are no ``options``.

        Returns:
            Observation ``(K * D,)`` and infos.

        Raises:
            ValueError: For any option, or if the seed is no whole number of zero or more.
        """
        check_options(options)
        super().reset(seed=None if seed is None else whole_number(seed, "seed", 0))
        step = self._simulation.reset(self.np_random)
        self._show()
        return step.observations.ravel(), self._infos(step)

    def step(self, action: FloatArray) -> tuple[FloatArray, float, bool, bool, Info]:
        """Advance one time step under ``action`` ``(K * m,)``.

        Returns:
            Observation ``(K * D,)``, mean reward, whether all arrived, whether time is up, and infos.

        Raises:
            RuntimeError: Before the first reset, or after the end of an episode.
            ValueError: If the action has another shape, or a value that is not finite or beyond 1e15. What is merely
                outside the action space is clipped to the robots' limits.
        """
        simulation = self._simulation
        simulation.require_reset()
        if simulation.out_of_time or simulation.arrived.all():
            raise RuntimeError("the episode is over; call reset() to begin another")
        step = simulation.step(joint_controls(action, self._action_shape, self.problem.num_robots))
        terminated = bool(simulation.arrived.all())
        truncated = simulation.out_of_time and not terminated
        self._show()
        reward = float(simulation.worlds.reward[0])
        return step.observations.ravel(), reward, terminated, truncated, self._infos(step)

    def set_state(self, states: ArrayLike) -> tuple[FloatArray, Info]:
        """Put the robots elsewhere; see :meth:`d4orm_env.navigation_v0.parallel_env.set_state`.

        Args:
            states: ``(K, n)`` of all robots.

        Returns:
            Observation ``(K * D,)`` and infos, as at a reset.

        Raises:
            RuntimeError: Before the first reset.
            ValueError: If a state is none that the robot may be in; the message names it.
        """
        step = self._simulation.set_state(states)
        return step.observations.ravel(), self._infos(step)

    def _infos(self, step: TeamStep) -> Info:
        metrics = self._simulation.metrics()
        return {
            "agents": agent_infos(self._agents, range(len(self._agents)), step),
            "metrics": metrics,
            "is_success": bool(metrics.get("success", 0.0)),
        }


def joint_spaces(setup: EnvSetup) -> tuple[gymnasium.Space[FloatArray], gymnasium.Space[FloatArray]]:
    """Spaces of the joint observation ``(K * D,)`` and of the joint action ``(K * m,)``."""
    (low, high), (lowest, highest), count = setup.action_bounds, setup.observation_bounds, setup.problem.num_robots
    # Padding has no limit of its own; a box must not be flat.
    low, high = np.where(high > 0, low, low.min(axis=0)), np.where(high > 0, high, high.max(axis=0))
    observations = gymnasium.spaces.Box(np.tile(lowest, count), np.tile(highest, count))
    return observations, gymnasium.spaces.Box(low.ravel(), high.ravel())
