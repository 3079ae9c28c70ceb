"""Rollout of a policy, as the beginning of a coarse plan."""

from __future__ import annotations

import numpy as np

from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.problem import Problem
from d4orm_env.envs.joint_state import split_state
from d4orm_planners.base.episode import open_env
from d4orm_planners.base.planner_registry import make_policy


def episode_of(policy: str, problem: Problem, seed: int) -> FloatArray:
    """``(H, K, m)`` controls of an episode, zero once all have arrived.

    Args:
        policy: Name of a policy.
        problem: Its problem.
        seed: Of the policy.

    Raises:
        ValueError: If there is no such policy, or it cannot drive there.
        ImportError: If it needs a library that is not installed.
    """
    driver = make_policy(policy)
    env = open_env(problem, policy=driver)
    observations, _ = env.reset(seed=seed)
    driver.reset(env, seed=seed)
    controls = np.zeros((problem.horizon, problem.num_robots, problem.control_size), np.float32)
    for executed in controls:
        if not env.agents:
            break
        observations, *_ = env.step(driver.act(observations, env.state()))
        executed[:] = split_state(problem, env.state()).controls
    env.close()
    return controls
