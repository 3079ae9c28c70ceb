"""Choice of an environment's disturbances."""

from __future__ import annotations

from collections.abc import Iterable
from functools import reduce

from d4orm_env.core.arrays import shown
from d4orm_env.core.observation_layout import BoundsSlack
from d4orm_env.core.problem import Problem
from d4orm_env.disturbances.disturbance import AnyDisturbance, Disturbance

Disturbances = tuple[AnyDisturbance, ...]


def checked_disturbances(given: object) -> Disturbances:
    """Return what an environment was given, as a tuple.

    Raises:
        ValueError: If it is no list of disturbances.
    """
    if isinstance(given, Disturbance):
        given = (given,)
    if isinstance(given, str) or not isinstance(given, Iterable):
        raise ValueError(f"disturbances is {shown(given)}; give a list of them, as [Delay(2), Push(0.1, 0.3)]")
    listed = tuple(given)
    for one in listed:
        if not isinstance(one, Disturbance):
            raise ValueError(
                f"disturbances holds {shown(one)}, which is none; give instances, as [Delay(2), Push(0.1, 0.3)]"
            )
    return listed


def at_work(disturbances: Disturbances, problem: Problem) -> Disturbances:
    """Return those that change anything, so that all others leave the environment as it is to the bit.

    Raises:
        ValueError: If the robots or the world of the problem cannot have one of them.
    """
    for one in disturbances:
        one.check(problem)
    return tuple(one for one in disturbances if not one.negligible)


def total_slack(disturbances: Disturbances, problem: Problem) -> BoundsSlack:
    """Room that all of them need together."""
    return reduce(BoundsSlack.joined, (one.slack(problem) for one in disturbances), BoundsSlack())
