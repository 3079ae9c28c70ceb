"""The reward of one robot at one step, in scalar style (paper, section III-D, with the obstacle term of section IV)."""

from __future__ import annotations

from d4orm_env.dynamics.robot_model import N


def step_reward(
    distance: N, inverse_initial_distance: N, pair_violation: N, obstacle_violation: N, penalty: N, one: N
) -> N:
    """``1 - distance / initial distance``, minus a penalty for any robot and one for any obstacle within the margin.

    The violations are 0 or 1, ``penalty`` is 1 in the paper, and ``one`` is 1, all in the caller's precision.
    """
    return one - distance * inverse_initial_distance - penalty * pair_violation - penalty * obstacle_violation
