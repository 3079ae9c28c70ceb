"""Rewards of a step: the paper's, one to learn from, and those of users."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from d4orm_env.core.arrays import BoolArray, FloatArray, Floats, as_float32, positive_number, read_only, short_repr
from d4orm_env.core.errors import unknown
from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.engine.types import WorldBatch
from d4orm_env.envs.features import ArrayOrTensor, namespace

__all__ = ["RewardFunction", "RewardInput", "TrainingReward"]


@dataclass(frozen=True, eq=False, kw_only=True)
class RewardInput:
    """One step of a team, or in the batched environment of ``B`` teams: what a reward is computed from.

    Every array is a read-only copy with the leading axes ``...``: none in the PettingZoo and the joint environment, so
    that ``(..., K)`` is ``(K,)``, and ``(B,)`` in the batched one, so that it is ``(B, K)``. All robots are there,
    docked ones too. Distances are straight, or along the shortest paths where the environment says so.
    """

    previous_states: FloatArray  #: ``(..., K, n)`` before the step
    states: FloatArray  #: ``(..., K, n)`` after it
    controls: FloatArray  #: ``(..., K, m)`` as executed
    goals: FloatArray  #: ``(..., K, d)`` the goals during the step [m]
    previous_distances: FloatArray  #: ``(..., K)`` to the goals before the step [m]
    distances: FloatArray  #: ``(..., K)`` after it [m]
    initial_distances: FloatArray  #: ``(..., K)`` where the path to the goal began, at least the goal radius [m]
    #: ``(..., K)`` that are left to goal headings and hitch angles before the step [rad]; see :func:`turns_left`
    previous_turns: FloatArray
    turns: FloatArray  #: ``(..., K)`` after it [rad]
    previously_arrived: BoolArray  #: ``(..., K)`` bool: docked before the step
    arrived: BoolArray  #: ``(..., K)`` bool: docked after it; in lifelong mode, reached a goal in this step
    collided: BoolArray  #: ``(..., K)`` bool, hard contact
    margin_violated: BoolArray  #: ``(..., K)`` bool, within the margin of anything
    paper: FloatArray  #: ``(..., K)`` the paper's reward, to build upon
    team: Team  #: The robots
    dt: float  #: Time step [s]

    def __post_init__(self) -> None:
        for attribute in fields(self):
            value = getattr(self, attribute.name)
            if isinstance(value, np.ndarray):
                object.__setattr__(self, attribute.name, read_only(value.copy()))

    @classmethod
    def of_worlds(
        cls,
        before: WorldBatch,
        after: WorldBatch,
        paper: FloatArray,
        arrived: BoolArray,
        problem: Problem,
        rows: int | slice,
    ) -> RewardInput:
        """The step of the worlds in ``rows``, all or one, with what :class:`WorldBatch` does not know."""
        arrays = {
            "previous_states": before.state, "states": after.state, "controls": after.control, "goals": after.goal,
            "previous_distances": before.distance, "distances": after.distance, "previously_arrived": before.arrived,
            "arrived": arrived, "collided": after.collided, "margin_violated": after.violated, "paper": paper,
        }  # fmt: skip
        parts: dict[str, Any] = {name: array[rows] for name, array in arrays.items()}
        parts["initial_distances"] = np.float32(1) / after.inverse[rows]
        for name, states in (("previous_turns", parts["previous_states"]), ("turns", parts["states"])):
            headed = problem.arrays.goal_direction is not None
            parts[name] = turns_left(problem, states, parts["goals"]) if headed else np.zeros_like(parts["distances"])
        return cls(**parts, team=problem.team, dt=problem.dt)

    @property
    def previous_positions(self) -> FloatArray:
        """``(..., K, d)`` before the step [m]."""
        return self.previous_states[..., : self.goals.shape[-1]]

    @property
    def positions(self) -> FloatArray:
        """``(..., K, d)`` after the step [m]."""
        return self.states[..., : self.goals.shape[-1]]


def turns_left(problem: Problem, states: ArrayOrTensor, goals: ArrayOrTensor) -> ArrayOrTensor:
    """``(..., K)`` turns from headings in states ``(..., K, n)`` to goal headings, and of trailers' hitch angles to
    theirs, summed up [rad]; zero for a robot without one.

    On its way a robot turns to the goal ``(..., K, d)`` first, or away from it to back up, and from there to the goal
    heading. These are the angles of M. Aicardi, G. Casalino, A. Bicchi and A. Balestrino, "Closed loop steering of
    unicycle like vehicles via Lyapunov techniques", IEEE Robotics & Automation Magazine, 1995.
    """
    xp, models = namespace(states), problem.team.robot_models
    robots, columns = np.arange(len(models)), np.array([model.heading_index or 0 for model in models])
    heading, wanted = states[..., robots, columns], xp.nan_to_num(problem.goal_heading)
    x, y = goals[..., 0] - states[..., 0], goals[..., 1] - states[..., 1]
    ahead = xp.arctan2(y, x)
    by_goal = [_between(heading, faced) + _between(faced, wanted) for faced in (ahead, ahead + np.float32(np.pi))]
    there = x * x + y * y <= problem.goal_radius**2
    left = xp.where(there, _between(heading, wanted), xp.minimum(*by_goal))
    for number in range(max(len(model.trailers) for model in models)):
        columns = np.array([model.trailers[number][0] if number < len(model.trailers) else 0 for model in models])
        missing = _between(states[..., robots, columns], problem.goal_hitches[:, number])
        left += xp.nan_to_num(missing)
    return xp.where(xp.isnan(problem.goal_heading), np.float32(0), left)


def _between(one: ArrayOrTensor, other: ArrayOrTensor) -> ArrayOrTensor:
    """Angles between directions, at most half a turn."""
    return abs((one - other + np.pi) % (2 * np.pi) - np.pi)


RewardFunction = Callable[[RewardInput], ArrayLike]
"""``(step) -> (..., K)`` rewards of all robots."""


@dataclass(frozen=True, kw_only=True)
class TrainingReward:
    """A reward to learn from, per robot and step; zero once a robot has docked.

    The paper's reward pays a robot for every step that it spends close to its goal, and an episode ends with the
    arrival: a policy that learns from it does not arrive. This one pays progress, which is a potential (A. Y. Ng,
    D. Harada and S. Russell, ICML 1999), and the arrival.

    The infos of the environments have each term as it was paid, ``reward_progress`` and so on.

    Raises:
        ValueError: If a weight is negative or no number: a negative price would pay for contacts.
    """

    #: For every step's distance at full speed towards the goal, and turn at the largest turn rate towards the goal
    #: heading, as far as the robot has to turn on its way by the goal, and of trailers towards their goal hitch angles
    progress: float = 0.3
    arrival: float = 5.0  #: Once, on arriving
    margin: float = 1.0  #: Taken off in every step within the margin of anything
    contact: float = 3.0  #: Taken off in every step in contact with anything
    time: float = 0.05  #: Taken off in every step
    term_names: ClassVar[tuple[str, ...]] = ("progress", "arrival", "margin", "contact", "time")

    def __post_init__(self) -> None:
        for name in self.term_names:
            weight = positive_number(getattr(self, name), f"{name} of TrainingReward", zero_allowed=True)
            object.__setattr__(self, name, weight)

    def __call__(self, step: RewardInput) -> FloatArray:
        """``(..., K)``, the sum of :meth:`terms`."""
        return sum(self.terms(step).values())  # type: ignore[return-value] # there are some

    def terms(self, step: RewardInput) -> dict[str, FloatArray]:
        """``(..., K)`` each, by the names of the weights."""
        longest, acting = step.team.max_speed * step.dt, ~step.previously_arrived
        turned = (step.previous_turns - step.turns) * (step.team.max_speed / step.team.max_turn_rate)
        return {
            "progress": self.progress * (step.previous_distances - step.distances + turned) / longest * acting,
            "arrival": self.arrival * step.arrived * acting,
            "margin": -self.margin * step.margin_violated * acting,
            "contact": -self.contact * step.collided * acting,
            "time": -self.time * acting,
        }


def paper_reward(step: RewardInput) -> FloatArray:
    """``(..., K)`` the paper's reward, for where its distances are not those that the engines measure."""
    return step.paper


def along_paths(step: RewardInput, initial: Floats, previous: Floats, present: Floats) -> RewardInput:
    """The same step with all distances, the paper's reward included, along the shortest paths.

    ``initial`` are lengths of the paths from the starts, ``previous`` from where robots were before the step, and
    ``present`` from where they are after it, each ``(..., K)`` [m]. A distance stays straight where a robot has got to
    that no path leads from, as inside an obstacle.
    """
    straight = step.previous_distances, step.distances
    before, after = (
        np.where(np.isfinite(length), length, instead).astype(np.float32)
        for length, instead in zip((previous, present), straight)
    )
    # It is at least the goal radius, as the straight one is.
    least: FloatArray = np.maximum(initial, step.initial_distances).astype(np.float32)
    return replace(
        step,
        previous_distances=before,
        distances=after,
        initial_distances=least,
        paper=step.paper + step.distances / step.initial_distances - after / least,
    )


REWARDS: Mapping[str, RewardFunction | None] = MappingProxyType({"paper": None, "training": TrainingReward()})
"""Rewards by name; ``None`` is what the engines compute themselves."""


def find_reward(reward: str | RewardFunction) -> RewardFunction | None:
    """The function behind ``reward=``; ``None`` for the paper's."""
    if callable(reward):
        return reward
    if not isinstance(reward, str) or reward not in REWARDS:
        raise unknown("reward", reward, REWARDS, "a function of a RewardInput")
    return REWARDS[reward]


def term_names(function: RewardFunction | None) -> tuple[str, ...]:
    """Return the names of the terms of a reward that has ``terms``; others have none."""
    return tuple(getattr(function, "term_names", ()))


def no_terms(function: RewardFunction | None, shape: tuple[int, ...]) -> dict[str, FloatArray]:
    """The terms of a reward where nothing was paid, each of a shape."""
    return {name: np.zeros(shape, np.float32) for name in term_names(function)}


def compute_rewards(function: RewardFunction, step: RewardInput) -> tuple[FloatArray, dict[str, FloatArray]]:
    """``(..., K)`` float32 rewards of a step, checked, and their terms, of which a reward that has some is the sum."""
    name, shape = getattr(function, "__name__", type(function).__name__), step.distances.shape
    names = term_names(function)
    if not names:
        return _checked(function(step), name, shape), {}
    terms = function.terms(step)  # type: ignore[attr-defined] # it has names for them
    if not (isinstance(terms, Mapping) and terms.keys() == set(names)):
        raise ValueError(
            f"terms of reward {name!r} returned {short_repr(terms)}; it must return a dictionary with an array "
            f"{shape} for each of {', '.join(names)}"
        )
    parts = {name: sum(terms.values()), **{f"{name}.{term}": terms[term] for term in names}}
    rewards, *paid = _all_checked(parts, shape)
    return rewards, dict(zip(names, paid))


def _all_checked(parts: Mapping[str, ArrayLike], expected: tuple[int, ...]) -> Sequence[FloatArray]:
    """:func:`_checked` of several, at once where they are as they should be."""
    try:
        rows = as_float32([*parts.values()])  # type: ignore[arg-type] # what is none is refused
    except ValueError:
        rows = np.empty(0, np.float32)
    if rows.shape == (len(parts), *expected) and np.isfinite(rows).all():
        return list(rows)
    return [_checked(values, name, expected) for name, values in parts.items()]


def _checked(values: ArrayLike, name: str, expected: tuple[int, ...]) -> FloatArray:
    try:
        # Of arrivals, as of all comparisons, NumPy has truth values.
        rewards = as_float32(np.asarray(values, np.float32) if getattr(values, "dtype", None) == np.bool_ else values)
    except ValueError as error:
        raise ValueError(f"reward {name!r}: {error}") from error
    if rewards.shape != expected:
        axes = "(K,)" if len(expected) == 1 else "(B, K)"
        raise ValueError(f"reward {name!r} returned shape {rewards.shape}; expected {axes} = {expected}")
    if not np.isfinite(rewards).all():
        where = tuple(int(i) for i in np.argwhere(~np.isfinite(rewards))[0])
        raise ValueError(f"reward {name!r} returned {rewards[where]} for robot_{where[-1]}; rewards must be finite")
    return rewards
