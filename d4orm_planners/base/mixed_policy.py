"""Teams whose robots follow different policies, as for ad-hoc teamwork."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from d4orm_env.core.arrays import FloatArray, short_repr
from d4orm_env.core.problem import Problem
from d4orm_planners.base.measured_states import acting_robots
from d4orm_planners.base.planner_registry import PolicyLike, called, make_policy, policy_settings
from d4orm_planners.base.policy import Actions, Observations, Policy
from d4orm_planners.base.policy_copies import copy_policy

if TYPE_CHECKING:
    from pettingzoo import ParallelEnv


class MixedPolicy(Policy):
    """A policy of its own for each robot.

    Each is told the observations of its own robots and the joint state. Robots with one name, or one object, share a
    policy, which is asked for all of them at once. A planner among them plans for the whole team, and its robots
    execute their part.

    Args:
        policies: By agent, as ``{"robot_0": "orca"}``, anything that :func:`~d4orm_planners.make_policy` takes.
        others: Policy of all robots that ``policies`` does not name; ``None`` where it names them all.

    Raises:
        ValueError: If there is none, or no such policy.
    """

    name = "mixed"

    def __init__(self, policies: Mapping[str, PolicyLike], others: PolicyLike | None = None) -> None:
        if not isinstance(policies, Mapping):
            raise ValueError(f"policies is {short_repr(policies)}; give them by agent, as {{'robot_0': 'orca'}}")
        given = dict(policies) if others is None else {**policies, "others": others}
        if not given:
            raise ValueError("policies is empty; give one by agent, as {'robot_0': 'orca'}, or others=")
        keys = [kind if isinstance(kind, str) else id(kind) for kind in given.values()]
        distinct = dict(zip(keys, given.values()))
        self._given, self._members = given, [*map(make_policy, distinct.values())]
        self._member_of = {agent: [*distinct].index(key) for agent, key in zip(given, keys)}

    def __getstate__(self) -> dict[str, object]:
        # A copy drives episodes of its own.
        return {**super().__getstate__(), "_members": [*map(copy_policy, self._members)]}

    def observation_options(self, problem: Problem) -> Mapping[str, object]:
        """The most that any of them wants to observe."""
        options: dict[str, Any] = {}
        for member in self._members:
            wanted: Mapping[str, Any] = member.observation_options(problem) if isinstance(member, Policy) else {}
            options |= {name: max(value, options.get(name, value)) for name, value in wanted.items()}
        return options

    def reset(self, env: ParallelEnv, seed: int = 0) -> None:
        """See :meth:`Policy.reset`.

        Raises:
            ValueError: Also if a policy is given for no robot of the team, or a robot has none.
        """
        super().reset(env, seed)
        agents = env.possible_agents
        if unknown := [agent for agent in self._given if agent not in (*agents, "others")]:
            raise ValueError(
                f"policies are given for {', '.join(map(str, unknown))}, and this team is {agents[0]} to {agents[-1]}; "
                "leave them out"
            )
        if "others" not in self._given and (missing := [agent for agent in agents if agent not in self._given]):
            raise ValueError(f"no policy is given for {', '.join(missing)}; give theirs, or others=")
        for member in self._members:
            member.reset(env, seed=seed)

    def act(self, observations: Observations, state: FloatArray) -> Actions:
        acting_robots(self, observations)
        actions: Actions = {}
        for index, member in enumerate(self._members):
            own = {agent: seen for agent, seen in observations.items() if self._index(agent) == index}
            given = member.act(own, state) if own else {}
            actions |= {agent: given[agent] for agent in own if agent in given}
        return {agent: actions[agent] for agent in observations if agent in actions}

    def identity(self) -> dict[str, object]:
        return {agent: {"policy": called(kind), **policy_settings(kind)} for agent, kind in self._given.items()}

    def _index(self, agent: str) -> int:
        return self._member_of[agent if agent in self._member_of else "others"]
