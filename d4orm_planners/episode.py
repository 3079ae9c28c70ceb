"""Running a policy through an environment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from d4orm_env.core.arrays import whole_number
from d4orm_env.core.metrics import trajectory_metrics
from d4orm_env.core.trajectory import Trajectory
from d4orm_env.joint_state import split_state
from d4orm_planners.policy import Policy


@dataclass(frozen=True, eq=False)
class Episode:
    """What happened.

    Attributes:
        trajectory: The executed motion, ``T`` steps long; ``T`` is at most the horizon.
        metrics: Of the trajectory, see :func:`d4orm_env.core.metrics.trajectory_metrics`, with the environment's own.
        observations: Observations of all agents at the reset and after every step.
        infos: Infos likewise.
    """

    trajectory: Trajectory
    metrics: dict[str, float]
    observations: tuple[dict[str, Any], ...]
    infos: tuple[dict[str, dict[str, Any]], ...]


def run_episode(env: Any, policy: Policy, seed: int = 0) -> Episode:
    """Reset ``env``, reset ``policy``, and step until no agent is left.

    Args:
        env: A :mod:`d4orm_env.navigation_v0` parallel environment, wrapped or not.
        policy: What acts.
        seed: Seeds both.

    Returns:
        The executed trajectory and its metrics.

    Raises:
        ValueError: If the seed is negative.
    """
    whole_number(seed, "seed", 0)
    observations, infos = env.reset(seed=seed)
    problem = env.unwrapped.problem
    policy.reset(env, seed=seed)
    joints = [split_state(problem, env.state())]
    all_observations, all_infos = [observations], [infos]
    rewards: list[np.ndarray] = []
    while env.agents:
        agents = list(env.agents)
        acting = {agent: observations[agent] for agent in agents}
        observations, gained, _, _, infos = env.step(policy.act(acting, env.state()))
        joints.append(split_state(problem, env.state()))
        all_observations.append(observations)
        all_infos.append(infos)
        rewards.append(_rewards(problem.num_robots, gained, rewards))
    collided, violated = (_flags(problem.num_robots, all_infos, name) for name in ("collided", "margin_violated"))
    states = np.stack([joint.states for joint in joints])
    trajectory = Trajectory(
        states=states,
        positions=states[..., : problem.dimension],
        controls=np.stack([joint.controls for joint in joints[1:]]),
        rewards=np.stack(rewards),
        arrived=np.stack([joint.arrived for joint in joints]),
        collided=collided,
        margin_violated=violated,
    )
    metrics = {**trajectory_metrics(problem, trajectory), **env.unwrapped.metrics()}
    return Episode(trajectory, metrics, tuple(all_observations), tuple(all_infos))


def _rewards(num_robots: int, gained: dict[str, float], before: list[np.ndarray]) -> np.ndarray:
    """Rewards of all robots; one that has left stands at its goal and goes on gaining what it gained last."""
    rewards = before[-1].copy() if before else np.zeros(num_robots, np.float32)
    for agent, reward in gained.items():
        rewards[int(agent.rsplit("_", 1)[1])] = reward
    return rewards


def _flags(num_robots: int, infos: list[dict[str, dict[str, Any]]], name: str) -> np.ndarray:
    flags = np.zeros((len(infos), num_robots), bool)
    for time, info in enumerate(infos):
        for agent, values in info.items():
            flags[time, int(agent.rsplit("_", 1)[1])] = values[name]
    return flags
