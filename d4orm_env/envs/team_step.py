"""Results of a step for a team, the infos that environments make of it, and numbers of an episode."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import BoolArray, FloatArray, Floats

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


Counts = NDArray[np.int64]


class EpisodeCounts(NamedTuple):
    """Counts of an episode of one world or, with leading axes, of many.

    Attributes:
        steps: ``(...)`` steps taken.
        reward: ``(...)`` sum over steps and robots.
        goals: ``(..., K)`` goals reached by each robot.
        contacts: ``(..., K)`` steps in contact.
        violations: ``(..., K)`` steps within the margin.
        arrival_step: ``(..., K)`` step since which a robot is at its goal, infinite where it is not; ``None`` in
            lifelong mode.
        lost: ``(..., K)`` robots that a disturbance keeps from ever arriving, if there can be any.
    """

    steps: int | Counts
    reward: float | Floats
    goals: Counts | BoolArray
    contacts: Counts
    violations: Counts
    arrival_step: Floats | None
    lost: BoolArray | None = None


def episode_metrics(counts: EpisodeCounts, dt: float) -> dict[str, Floats]:
    """Episodes in numbers; ``dt`` is the time step [s].

    Returns:
        ``steps``; ``reward``: mean over steps and robots; ``goals_reached``; ``goals_per_robot_minute``;
        ``collisions`` and ``margin_violations``: robot-steps in contact, or within the margin; ``collided`` and
        ``margin_violated``: robots that ever were. Unless lifelong also ``arrived``: robots docked; ``success``:
        1.0 when all have docked, but for those that are lost, and none was ever in contact; ``travel_time`` and
        ``makespan``: mean and latest arrival [s], with the time so far for a robot that has not docked. Each ``(...)``
        float64.
    """
    team_size, steps = counts.contacts.shape[-1], np.asarray(counts.steps, np.float64)
    robot_steps = team_size * np.maximum(steps, 1)
    reached = counts.goals.sum(axis=-1).astype(np.float64)
    collided = np.count_nonzero(counts.contacts, axis=-1)
    metrics = {
        "steps": steps,
        "reward": np.asarray(counts.reward / robot_steps),
        "goals_reached": reached,
        "goals_per_robot_minute": 60 * reached / (robot_steps * dt),
        "collisions": counts.contacts.sum(axis=-1).astype(np.float64),
        "margin_violations": counts.violations.sum(axis=-1).astype(np.float64),
        "collided": np.asarray(collided, np.float64),
        "margin_violated": np.asarray(np.count_nonzero(counts.violations, axis=-1), np.float64),
    }
    if counts.arrival_step is None:
        return metrics
    times = np.minimum(counts.arrival_step * dt, (steps * dt)[..., None])
    there = counts.goals > 0 if counts.lost is None else (counts.goals > 0) | counts.lost
    success = (there.all(axis=-1) & (np.asarray(collided) == 0)).astype(np.float64)
    arrivals = {"travel_time": times.mean(axis=-1), "makespan": times.max(axis=-1)}
    return metrics | {"arrived": reached.copy(), "success": success} | arrivals
