"""Copies of policies, for episodes that leave the policy that was given as it is."""

from __future__ import annotations

import copy
from typing import Any

from d4orm_env.core.errors import describe
from d4orm_planners.base.planner_registry import PolicyLike, called, find_policy, make_policy
from d4orm_planners.base.policy import Policy


def fresh_policy(name: PolicyLike, **config: Any) -> Policy:
    """:func:`make_policy`, where that returns a given instance, a copy of it: its episodes do not change it."""
    policy = make_policy(name, **config)
    return copy_policy(policy) if policy is find_policy(name) else policy


def copy_policy(policy: Policy) -> Policy:
    """A policy like this one, whose episodes do not change it. Raises ValueError if it cannot be copied."""
    # Those of this package begin anew at every reset.
    if type(policy).__module__.startswith("d4orm_planners."):
        return copy.copy(policy)
    try:
        return copy.deepcopy(policy)
    except Exception as error:  # objects reduce themselves by methods of their own
        policy.identity()  # what cannot be told from others is to be told first
        raise ValueError(
            f"policy {called(policy)!r} cannot be copied for an episode of its own ({describe(error)}); give its "
            "class, or a function that makes it, in place of the instance"
        ) from error
