"""Results of a step for a team, the infos that environments make of it, and numbers of an episode."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import BoolArray, FloatArray, Floats
from d4orm_env.engine.types import WorldBatch

Info: TypeAlias = dict[str, Any]
"""Infos of an environment, by name."""
AgentInfos: TypeAlias = dict[str, Info]
"""The same by agent."""


class TeamStep(NamedTuple):
    """Result of a step or a reset for the team; every array is the caller's to keep."""

    observations: FloatArray  #: ``(K, D)`` local observations
    rewards: FloatArray  #: ``(K,)``; zero at a reset
    arrived: BoolArray  #: ``(K,)`` bool: docked, or in lifelong mode, reached a goal in this step
    collided: BoolArray  #: ``(K,)`` bool, hard contact
    margin_violated: BoolArray  #: ``(K,)`` bool
    distances: FloatArray  #: ``(K,)`` to the present goals [m]
    #: Robots that each robot in contact with others touches, by number
    partners: Mapping[int, list[int]] = MappingProxyType({})
    #: ``(K,)`` each, what the rewards were made of, where the reward says so
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


def episode_metrics(
    worlds: WorldBatch, dt: float, goals: NDArray[np.int64] | None, lost: BoolArray | None
) -> dict[str, Floats]:
    """Episodes in numbers, each ``(B,)`` float64, of time step ``dt`` [s].

    ``steps``; ``reward``: mean over steps and robots; ``goals_reached``, in lifelong mode ``goals`` ``(B, K)``;
    ``goals_per_robot_minute``; ``collisions`` and ``margin_violations``: robot-steps in contact, or within the margin;
    ``collided`` and ``margin_violated``: robots that ever were. Unless lifelong also ``arrived``: robots arrived;
    ``success``: 1.0 when all have docked, but for those that a disturbance keeps from ever arriving, ``lost`` ``(B,
    K)``, and none was ever in contact; ``travel_time`` and ``makespan``: mean and latest arrival [s], with the time so
    far for a robot that has not arrived.
    """
    steps = worlds.steps.astype(np.float64)
    robot_steps = worlds.contacts.shape[1] * np.maximum(steps, 1)
    reached = (worlds.arrived if goals is None else goals).sum(axis=1).astype(np.float64)
    collided = np.count_nonzero(worlds.contacts, axis=1)
    metrics = {
        "steps": steps,
        "reward": worlds.total_reward / robot_steps,
        "goals_reached": reached,
        "goals_per_robot_minute": 60 * reached / (robot_steps * dt),
        "collisions": worlds.contacts.sum(axis=1).astype(np.float64),
        "margin_violations": worlds.violations.sum(axis=1).astype(np.float64),
        "collided": collided.astype(np.float64),
        "margin_violated": np.count_nonzero(worlds.violations, axis=1).astype(np.float64),
    }
    if goals is not None:
        return metrics
    arrival = np.where(worlds.arrival > 0, worlds.arrival, np.inf)
    times = np.minimum(arrival * dt, (steps * dt)[:, None])
    done = worlds.arrived if lost is None else worlds.arrived | lost
    success = (done.all(axis=1) & (collided == 0)).astype(np.float64)
    arrivals = {"travel_time": times.mean(axis=1), "makespan": times.max(axis=1)}
    return metrics | {"arrived": reached.copy(), "success": success} | arrivals
