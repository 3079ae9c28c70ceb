"""Result of a step for a team, and the infos that environments make of it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple, TypeAlias

from d4orm_env.core.arrays import BoolArray, FloatArray

Info: TypeAlias = dict[str, Any]
"""Results of an environment beside observations and rewards, by name."""
AgentInfos: TypeAlias = dict[str, Info]
"""The same by agent."""


class TeamStep(NamedTuple):
    """Result of a step or a reset for the team; every array is the caller's to keep.

    Attributes:
        observations: ``(K, D)`` local observations.
        rewards: ``(K,)``; zero at a reset.
        arrived: ``(K,)`` bool: docked, or in lifelong mode, reached a goal in this step.
        collided: ``(K,)`` bool, hard contact.
        margin_violated: ``(K,)`` bool.
        distances: ``(K,)`` to the present goals [m].
        partners: Robots that each robot in contact with others touches, by number.
        terms: ``(K,)`` each, what the rewards were made of, where the reward says so.
    """

    observations: FloatArray
    rewards: FloatArray
    arrived: BoolArray
    collided: BoolArray
    margin_violated: BoolArray
    distances: FloatArray
    partners: Mapping[int, list[int]] = MappingProxyType({})
    terms: Mapping[str, FloatArray] = MappingProxyType({})


def agent_infos(names: Iterable[str], robots: Iterable[int], step: TeamStep) -> AgentInfos:
    """Fresh info dictionaries of some robots, in plain Python values."""
    arrived, collided = step.arrived.tolist(), step.collided.tolist()
    margin_violated, distances = step.margin_violated.tolist(), step.distances.tolist()
    terms = {f"reward_{name}": values.tolist() for name, values in step.terms.items()}
    return {
        name: {
            "arrived": arrived[robot],
            "collided": collided[robot],
            "margin_violated": margin_violated[robot],
            "distance_to_goal": distances[robot],
            "contacts": [f"robot_{other}" for other in step.partners.get(robot, ())],
            **{name: values[robot] for name, values in terms.items()},
        }
        for name, robot in zip(names, robots)
    }
