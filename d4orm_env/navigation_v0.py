"""Multi-robot navigation as a PettingZoo environment: every robot is an agent.

Each robot drives to its goal without touching the others, the obstacles or the bounds (paper, section III). Actions are
controls in physical units, so that a plan's controls ``(H, K, m)`` can be stepped as they are.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress

import gymnasium
import numpy as np
from gymnasium.utils import seeding
from numpy.typing import ArrayLike
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.utils import OrderEnforcingWrapper
from pettingzoo.utils.conversions import parallel_to_aec_wrapper

from d4orm_env.core.arrays import MAX_ACTION, FloatArray, as_float32, short_repr, usable, whole_number
from d4orm_env.envs.base_env import RENDER_MODES, BaseEnv
from d4orm_env.envs.inputs import check_options, checked_cycles
from d4orm_env.envs.options import EnvOptions
from d4orm_env.envs.team_step import AgentInfos, TeamStep, agent_infos
from d4orm_env.scenarios.problems import ScenarioLike

__all__ = ["env", "parallel_env", "raw_env"]


class parallel_env(BaseEnv, ParallelEnv[str, FloatArray, FloatArray]):
    """All robots act at once.

    Agents are ``robot_0`` .. ``robot_{K-1}``. An agent that arrives is terminated and leaves ``agents``; its body stays
    in the world at its goal. When ``max_cycles`` steps have been taken the others are truncated.

    Args:
        scenario: As in :class:`~d4orm_env.envs.options.EnvOptions`, like all others.
        num_robots: Size of the team.
        **options: Further attributes of :class:`~d4orm_env.envs.options.EnvOptions`, and arguments of the scenario,
            such as ``model`` or ``seed``. ``max_cycles`` may be assigned later too.

    Raises:
        TypeError: For an argument that neither the environment nor the scenario has.
        ValueError: For a bad argument, or when both a problem and a scenario's arguments are given.
    """

    metadata: dict[str, object] = {  # noqa: RUF012 - declared mutable by PettingZoo
        "name": "d4orm_navigation_v0",
        "render_modes": list(RENDER_MODES),
        "render_fps": 10,
        "is_parallelizable": True,
    }

    def __init__(self, scenario: ScenarioLike | None = None, num_robots: int | None = None, **options: object) -> None:
        self._begin(EnvOptions.of(scenario=scenario, num_robots=num_robots, **options))
        self.possible_agents = [f"robot_{robot}" for robot in range(self.problem.num_robots)]
        self.agents: list[str] = []
        self._robots = {agent: robot for robot, agent in enumerate(self.possible_agents)}
        self._control_size = self.problem.control_size
        self._make_spaces()
        self._np_random: np.random.Generator | None = None
        self.aec_env: AECNavigationEnv | None = None

    def _make_spaces(self) -> None:
        setup, box = self._simulation.setup, gymnasium.spaces.Box
        lowest, highest = setup.action_bounds
        low, high = lowest.min(axis=0), highest.max(axis=0)
        self.observation_spaces = {agent: box(*setup.observation_bounds) for agent in self.possible_agents}
        self.action_spaces = {agent: box(low, high) for agent in self.possible_agents}
        self.state_space = box(*self._simulation.state_bounds)

    @property
    def max_cycles(self) -> int:
        """Steps until truncation; assigning it also makes a new ``state_space``, which counts steps.

        In the middle of an episode it must be more than the steps taken.
        """
        return self._simulation.max_cycles

    @max_cycles.setter
    def max_cycles(self, value: int) -> None:
        cycles, taken = checked_cycles(value), int(self._simulation.worlds.steps[0]) if self.agents else 0
        if cycles <= taken:
            raise ValueError(f"max_cycles is {cycles} after {taken} steps; give more, or assign it before the reset")
        self._simulation.max_cycles = cycles
        self.state_space = gymnasium.spaces.Box(*self._simulation.state_bounds)

    @property
    def np_random(self) -> np.random.Generator:
        """Generator that episodes draw their randomness from; seeded by :meth:`reset`."""
        if self._np_random is None:
            self._np_random = seeding.np_random()[0]
        return self._np_random

    def observation_space(self, agent: str) -> gymnasium.spaces.Box:
        """``(D,)`` float32 box, the same for all agents."""
        return self._space(self.observation_spaces, agent)

    def action_space(self, agent: str) -> gymnasium.spaces.Box:
        """``(m,)`` float32 box of the team's largest control limits, the same for all agents, in physical units.

        The step clips every control to the robot's own limits.
        """
        return self._space(self.action_spaces, agent)

    def _space(self, spaces: Mapping[str, gymnasium.spaces.Box], agent: str) -> gymnasium.spaces.Box:
        with suppress(KeyError, TypeError):
            return spaces[agent]
        raise ValueError(f"agent {short_repr(agent)} is unknown; the agents are robot_0 to {self.possible_agents[-1]}")

    def reset(
        self, seed: int | None = None, options: dict[str, object] | None = None
    ) -> tuple[dict[str, FloatArray], AgentInfos]:
        """Begin an episode.

        Args:
            seed: Seeds the noise, new goals and new instances; ``None`` goes on with the present generator.
            options: Part of the API; there are none.

        Returns:
            Observations and infos of all agents.

        Raises:
            ValueError: For any option.
        """
        check_options(options, ignored=("options",))  # PettingZoo's API tests send options={"options": 1}
        if seed is not None:
            self._np_random = seeding.np_random(whole_number(seed, "seed", 0))[0]
        step = self._simulation.reset(self.np_random)
        self.agents = self.possible_agents[:]
        self._show()
        return dict(zip(self.agents, step.observations)), agent_infos(self.agents, self._robots.values(), step)

    def step(
        self, actions: dict[str, FloatArray]
    ) -> tuple[dict[str, FloatArray], dict[str, float], dict[str, bool], dict[str, bool], AgentInfos]:
        """Advance one time step.

        Args:
            actions: ``(m,)`` control of every agent in ``agents``. Those of agents that have left are ignored.

        Returns:
            Observations, rewards, terminations, truncations and infos of the agents that acted, their last step
            included; five empty dictionaries when no agent is left.

        Raises:
            RuntimeError: Before the first reset.
            ValueError: If an action is missing, has another shape, is not finite, or beyond 1e15; the message names
                the agent. What is merely outside the action space is clipped to the robot's limits.
        """
        simulation, acting = self._simulation, self.agents
        simulation.require_reset()
        if not acting:
            return {}, {}, {}, {}, {}
        robots = [self._robots[agent] for agent in acting]
        controls = self._collect(actions)
        if len(robots) < len(self.possible_agents):
            acted, controls = controls, np.zeros((len(self.possible_agents), self._control_size), np.float32)
            controls[robots] = acted
        step = simulation.step(controls)
        observations, rewards, finished = step.observations, step.rewards.tolist(), simulation.finished.tolist()
        terminations = {agent: finished[robot] for agent, robot in zip(acting, robots)}
        out_of_time = simulation.out_of_time
        self.agents = [] if out_of_time else [agent for agent in acting if not terminations[agent]]
        self._show()
        return (
            {agent: observations[robot] for agent, robot in zip(acting, robots)},
            {agent: rewards[robot] for agent, robot in zip(acting, robots)},
            terminations,
            {agent: out_of_time and not terminated for agent, terminated in terminations.items()},
            agent_infos(acting, robots, step),
        )

    def set_state(self, states: ArrayLike) -> tuple[dict[str, FloatArray], AgentInfos]:
        """Put the robots elsewhere in the middle of an episode, to push one or to replay a log.

        Goals, clock, the controls executed last and the metrics so far are kept. A robot that has arrived stays so
        where it is put, and must be at rest; one that is put at its goal arrives with the next step, if it is still
        there.

        Args:
            states: ``(K, n)`` of all robots, padding zero; contact is allowed.

        Returns:
            Observations and infos of the agents in ``agents``, as at a reset.

        Raises:
            RuntimeError: Before the first reset.
            ValueError: If a state is none that the robot may be in; the message names it.
        """
        step = self._simulation.set_state(states)
        robots = [self._robots[agent] for agent in self.agents]
        observations = {agent: step.observations[robot] for agent, robot in zip(self.agents, robots)}
        infos = agent_infos(self.agents, robots, step)
        if self.aec_env is not None:
            self.aec_env.refresh(observations, infos)
        return observations, infos

    @property
    def last_step(self) -> TeamStep:
        """Result of the last step, reset or :meth:`set_state` for the whole team, robots that have left included.

        Raises:
            RuntimeError: Before the first reset.
        """
        self._simulation.require_reset()
        return self._simulation.last

    def _collect(self, actions: dict[str, FloatArray]) -> FloatArray:
        """``(agents, m)`` the actions of the agents still acting, checked."""
        try:
            block = as_float32([actions[agent] for agent in self.agents])
        except (KeyError, IndexError, TypeError, ValueError):
            raise ValueError(self._complaint(actions)) from None
        if block.shape != (len(self.agents), self._control_size) or not usable(block).all():
            raise ValueError(self._complaint(actions))
        if len(actions) != len(self.agents) and not actions.keys() <= self._robots.keys():
            unknown = sorted(map(str, actions.keys() - self._robots.keys()))
            raise ValueError(
                f"actions name unknown agents {', '.join(unknown)}; the agents are robot_0 to "
                f"{self.possible_agents[-1]}"
            )
        return block

    def _complaint(self, actions: object) -> str:
        if not isinstance(actions, Mapping):
            return (
                f"actions must be a dictionary with an action for every agent in env.agents, not {short_repr(actions)}"
            )
        for agent in self.agents:
            if agent not in actions:
                return f"actions lack {agent}; give one for every agent in env.agents"
            complaint = self.complaint(agent, actions[agent])
            if complaint:
                return complaint
        raise AssertionError("every action is fine")

    def complaint(self, agent: str, action: ArrayLike) -> str:
        """Describe what is wrong with an action of that agent; the empty string if nothing is."""
        shape = (self._control_size,)
        try:
            array = as_float32(action)
        except ValueError:
            return f"action of {agent} is {short_repr(action)}; it must be {shape[0]} numbers"
        if array.shape != shape or not usable(array).all():
            return (
                f"action of {agent} is {short_repr(action)}; it must be {shape[0]} finite numbers of at most "
                f"{MAX_ACTION:g} in magnitude, of shape {shape}"
            )
        return ""


class AECNavigationEnv(parallel_to_aec_wrapper):
    """PettingZoo's conversion, with a bad action refused when it is given, and by the agent's name."""

    def __init__(self, environment: parallel_env) -> None:
        super().__init__(environment)
        self._observations: dict[str, FloatArray] = {}
        self.infos: AgentInfos = {}
        environment.aec_env = self

    def refresh(self, observations: dict[str, FloatArray], infos: AgentInfos) -> None:
        """Show agents the world as it is now, before all have chosen."""
        self._observations = {**self._observations, **observations}
        self.infos = {**self.infos, **infos}

    def observe(self, agent: str) -> FloatArray:
        self.observation_space(agent)  # which refuses an unknown one
        return super().observe(agent)

    def step(self, action: FloatArray | None) -> None:
        agent = self.agent_selection
        if not (self.terminations.get(agent, True) or self.truncations.get(agent, True)):
            complaint = self.env.unwrapped.complaint(agent, action)
            if complaint:
                raise ValueError(complaint)
        super().step(action)


def raw_env(
    scenario: ScenarioLike | None = None, num_robots: int | None = None, **options: object
) -> AECEnv[str, FloatArray, FloatArray | None]:
    """The robots act in turn and move together when the last has chosen; arguments of :class:`parallel_env`."""
    return AECNavigationEnv(parallel_env(scenario, num_robots, **options))


def env(
    scenario: ScenarioLike | None = None, num_robots: int | None = None, **options: object
) -> AECEnv[str, FloatArray, FloatArray | None]:
    """:func:`raw_env`, with calls in the wrong order caught; arguments of :class:`parallel_env`."""
    return OrderEnforcingWrapper(raw_env(scenario, num_robots, **options))
