"""Results of a step for a team, the infos that environments make of it, and numbers of an episode."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import BoolArray, FloatArray, Floats

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


def masked(values: Mapping[str, NDArray[np.generic]], mask: BoolArray) -> Info:
    """Copies of batched values, zero outside ``mask`` ``(B,)``, each with its mask."""
    infos: Info = {}
    whole = bool(mask.all())
    for key, value in values.items():
        infos[key] = value.copy()
        if not whole:
            infos[key][~mask] = 0
        infos[f"_{key}"] = mask.copy()
    return infos


def final_infos(observations: FloatArray, infos: Info, ended: BoolArray) -> Info:
    """Last observations and infos of episodes that have ``ended`` ``(B,)``, kept before their worlds are reset.

    ``infos`` go into the result.
    """
    final_obs = np.full(len(ended), None, dtype=object)
    for world in np.flatnonzero(ended):
        final_obs[world] = observations[world].copy()
    final_info: Info = {}
    for key in [name for name in infos if not name.startswith("_")]:
        final_info[key] = infos[key]
        if isinstance(infos[key], np.ndarray):
            final_info[key][~ended] = 0
        final_info[f"_{key}"] = ended.copy()
    return {
        "final_obs": final_obs,
        "_final_obs": ended.copy(),
        "final_info": final_info,
        "_final_info": ended.copy(),
    }


Counts = NDArray[np.int64]


class EpisodeCounts(NamedTuple):
    """Counts of an episode of one world or, with leading axes, of many."""

    steps: int | Counts  #: ``(...)`` steps taken
    reward: float | Floats  #: ``(...)`` sum over steps and robots
    goals: Counts | BoolArray  #: ``(..., K)`` goals reached by each robot
    contacts: Counts  #: ``(..., K)`` steps in contact
    violations: Counts  #: ``(..., K)`` steps within the margin
    #: ``(..., K)`` step since which a robot is at its goal, infinite where it is not; ``None`` in lifelong mode
    arrival_step: Floats | None
    #: ``(..., K)`` robots that a disturbance keeps from ever arriving, if there can be any
    lost: BoolArray | None = None


def episode_metrics(counts: EpisodeCounts, dt: float) -> dict[str, Floats]:
    """Episodes in numbers; ``dt`` is the time step [s].

    Returns:
        ``steps``; ``reward``: mean over steps and robots; ``goals_reached``; ``goals_per_robot_minute``;
        ``collisions`` and ``margin_violations``: robot-steps in contact, or within the margin; ``collided`` and
        ``margin_violated``: robots that ever were. Unless lifelong also ``arrived``: robots arrived; ``success``:
        1.0 when all have docked, but for those that are lost, and none was ever in contact; ``travel_time`` and
        ``makespan``: mean and latest arrival [s], with the time so far for a robot that has not arrived. Each ``(...)``
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
    done = counts.goals > 0 if counts.lost is None else (counts.goals > 0) | counts.lost
    success = (done.all(axis=-1) & (np.asarray(collided) == 0)).astype(np.float64)
    arrivals = {"travel_time": times.mean(axis=-1), "makespan": times.max(axis=-1)}
    return metrics | {"arrived": reached.copy(), "success": success} | arrivals
