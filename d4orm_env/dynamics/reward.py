"""The reward of one robot at one step, in scalar style (paper, section III-D, with the obstacle term of section IV)."""

from __future__ import annotations

from d4orm_env.dynamics.robot_model import N


def step_reward(distance: N, inverse_initial_distance: N, pair_violation: N, obstacle_violation: N, one: N) -> N:
    """``1 - distance / initial distance``, minus one for any robot and minus one for any obstacle within the margin.

    The violations are 0 or 1 and ``one`` is 1, all in the caller's precision.
    """
    return one - distance * inverse_initial_distance - pair_violation - obstacle_violation
