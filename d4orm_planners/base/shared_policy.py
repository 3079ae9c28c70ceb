"""A policy that all robots share, a model that maps what each observes to its control, asked for all at once; and one
of its own for each robot, as for ad-hoc teamwork.
"""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

import gymnasium
import numpy as np
from numpy.typing import ArrayLike

from d4orm_env.core.arrays import FloatArray, as_float32, short_repr, truth
from d4orm_env.core.problem import Problem
from d4orm_env.envs.features import Features
from d4orm_env.envs.joint_state import split_state
from d4orm_planners.base.measured_states import acting_robots, stacked_observations
from d4orm_planners.base.planner_registry import PolicyLike, called, copy_policy, make_policy, policy_settings
from d4orm_planners.base.policy import Actions, Observations, Policy, within_limits
from d4orm_planners.tracking.goal_drives import brake_to_dock

if TYPE_CHECKING:
    from pettingzoo import ParallelEnv

Shapes: TypeAlias = tuple[tuple[int, ...], tuple[int, ...]]  #: Shapes of observations and of actions
Model: TypeAlias = Any  #: A model of a library that need not be installed


class SharedPolicy(Policy):
    """Every robot by itself maps what it observes to its control, all by one function of stacked observations.

    Args:
        predict: ``(B, n)`` float32 observations of any number of robots to ``(B, m)`` actions.
        weights: Something with a ``state_dict``, by which a store of trials tells one training's model from another's;
            ``None`` where there is none, and a store refuses what it cannot tell.
        normalized: Whether actions are in ``[-1, 1]``, which stand for the lowest and the highest of the environment.
        egocentric: Whether it was trained in ``egocentric`` environments; the one that it drives in is not. Where the
            goal speed is limited, its robots then brake to dock as go-to-goal does, as those of the package's policies.
        trained: Shapes of the observations and actions of the training, where the model tells them. Those of a whole
            team are of a model that steers it at once, trained in the joint environment.
        joint: Whether it is one, where it does not tell: it is asked for one row, of all robots one after the other.
        actions: Space of the actions of the training, where the model tells it; wider ones are refused.
            Those of egocentric ones are all alike, so give these the robot model that they were trained on.

    Raises:
        ValueError: For a bad argument, as a model that is not loaded.
    """

    def __init__(
        self,
        predict: Callable[[FloatArray], ArrayLike],
        weights: Model | None,
        normalized: bool = False,
        egocentric: bool = False,
        trained: Shapes | None = None,
        joint: bool = False,
        actions: gymnasium.Space[Any] | None = None,
    ) -> None:
        if not callable(predict):
            raise ValueError(f"predict is {short_repr(predict)}; give a function of stacked observations")
        self._predict, self._weights = predict, None if weights is None else loaded(weights)
        self._normalized, self._egocentric = truth(normalized, "normalized"), truth(egocentric, "egocentric")
        self._trained, self._joint, self._actions = trained, truth(joint, "joint"), actions

    def reset(self, env: ParallelEnv, seed: int = 0) -> None:
        """See :meth:`Policy.reset`.

        Raises:
            ValueError: If the model was trained for other observations or actions, or bounds of these, as far as it
                tells.
        """
        super().reset(env, seed)
        spaces = [env.action_space(agent) for agent in env.possible_agents]
        self._low, self._high = np.stack([space.low for space in spaces]), np.stack([space.high for space in spaces])
        self._features = Features.of_team(env.unwrapped.layout, self.problem.team) if self._egocentric else None
        seen = env.observation_space(env.possible_agents[0]).shape
        self._seen_shape = seen
        shapes = seen if self._features is None else (self._features.size,), self._low.shape[1:]
        self._env, self._is_joint = env, self._steers_team(shapes)
        self._check_bounds()

    def _steers_team(self, own: Shapes) -> bool:
        """Check whether the model steers the whole team at once, given a robot's shapes."""
        count = self.problem.num_robots
        observed, acted = team = (count * own[0][0],), (count * own[1][0],)
        if self._trained not in (None, own, team):
            raise ValueError(
                f"the model was trained for observations and actions of shapes {self._trained[0]} and "
                f"{self._trained[1]}; a robot's here have {own[0]} and {own[1]}, and the team's {observed} and "
                f"{acted}; make the environment as it was in training, with as many robots, or give "
                f"egocentric=True for a model trained in egocentric ones"
            )
        return self._joint or (self._trained == team and count > 1)

    def _check_bounds(self) -> None:
        """Refuse bounds of actions beyond those of the training: the controls of other robots mean other things.

        Lower ones may be those of the same robots, as in a Controller, which holds back some.
        """
        if not isinstance(self._actions, gymnasium.spaces.Box):
            return
        low, high = self._low, self._high
        if self._egocentric:
            low, high = -np.ones_like(low), np.ones_like(high)
        elif self._is_joint:  # where each robot has its own limits
            own = self.problem.team.control_limits
            low, high = np.where(own > 0, -own, low), np.where(own > 0, own, high)
        if not self._is_joint:
            low, high = low[:1], high[:1]
        trained, here = (self._actions.low, self._actions.high), (low.ravel(), high.ravel())
        fits = self._actions.shape == here[0].shape and (
            np.allclose(trained, here) if self._egocentric else (np.abs(here) <= np.abs(trained) * (1 + 1e-5)).all()
        )
        if not fits:
            raise ValueError(
                f"the model was trained for actions from {trained[0].tolist()} to {trained[1].tolist()}, and those "
                f"here are from {here[0].tolist()} to {here[1].tolist()}; make the environment of robots as in "
                "training, and say whether that was egocentric"
            )

    def act(self, observations: Observations, state: FloatArray) -> Actions:
        robots = acting_robots(self, observations)
        if not observations:
            return {}
        seen = stacked_observations(observations, self._seen_shape)
        if self._is_joint:
            # It wants to see those too that have left.
            everybody = self._env.unwrapped.last_step.observations.copy()
            everybody[robots] = seen
            controls = self._controls(everybody, range(len(everybody)))[robots]
        else:
            controls = self._controls(seen, robots)
        if self._egocentric:
            controls = brake_to_dock(self.problem, robots, controls, split_state(self.problem, state))
        return within_limits(self.problem, dict(zip(observations, controls)))

    def _controls(self, seen: FloatArray, robots: Sequence[int]) -> FloatArray:
        """``(N, m)`` controls of robots that see ``(N, D)``."""
        if self._features is not None:
            seen, frames = self._features.encode(seen)
        asked = seen.reshape(1, -1) if self._is_joint else seen
        try:
            answer = self._predict(asked)
        except RuntimeError as error:  # torch's, of a module that takes something else
            raise ValueError(
                f"the model fails on observations of shape {asked.shape}, which are those of this environment: {error}"
                f"{'' if self._is_joint else '; give joint=True for one that steers the whole team at once'}"
            ) from error
        actions = _checked_actions(answer, len(asked)).reshape(len(seen), -1)
        if self._features is not None:
            return self._features.decode(actions, frames, self.problem.team.control_limits[robots])
        if self._normalized:
            low, high = self._low[robots], self._high[robots]
            return low + (np.clip(actions, -1, 1) + 1) / 2 * (high - low)
        return actions

    def identity(self) -> dict[str, object]:
        if self._weights is None:
            return super().identity()
        digest = hashlib.sha256()
        for name, tensor in self._weights.state_dict().items():
            digest.update(name.encode())
            digest.update(np.ascontiguousarray(tensor.detach().cpu().numpy()).tobytes())
        settings = getattr(self._predict, "keywords", {})  # of a partial
        own = {name: True for name in ("egocentric", "joint") if getattr(self, f"_{name}")}
        return {**settings, **own, "normalized": self._normalized, "weights": digest.hexdigest()}


def loaded(model: Model, method: str = "state_dict") -> Model:
    """A model, which must have a method: a ValueError for others, as the path of one."""
    if isinstance(model, type) or not hasattr(model, method):
        raise ValueError(f"the model is {short_repr(model)}; load it first, and give what acts and has {method}")
    return model


def _checked_actions(answer: Any, count: int) -> FloatArray:
    """Actions ``(count, m)`` that a model answers with; ValueError for all else, as recurrent networks' states."""
    with contextlib.suppress(ValueError):
        if not isinstance(answer, tuple) and (actions := as_float32(answer)).shape[:-1] == (count,):
            return actions
    shape = f" of shape {tuple(answer.shape)}" if hasattr(answer, "shape") else ""
    raise ValueError(
        f"the model answers with a {type(answer).__name__}{shape} for {count} observations; it must be actions alone, "
        f"({count}, m), so give a module or function that returns these"
    )


class MixedPolicy(Policy):
    """A policy of its own for each robot.

    Each is told the observations of its own robots and the joint state. Robots with one name, or one object, share a
    policy, which is asked for all of them at once. A planner among them plans for the whole team, and its robots
    execute their part.

    Args:
        policies: By agent, as ``{"robot_0": "orca"}``, anything that :func:`~d4orm_planners.make_policy` takes.
        others: Policy of all robots that ``policies`` does not name; ``None`` where it names them all.

    Raises:
        ValueError: If there is none, or no such policy.
    """

    name = "mixed"

    def __init__(self, policies: Mapping[str, PolicyLike], others: PolicyLike | None = None) -> None:
        if not isinstance(policies, Mapping):
            raise ValueError(f"policies is {short_repr(policies)}; give them by agent, as {{'robot_0': 'orca'}}")
        given = dict(policies) if others is None else {**policies, "others": others}
        if not given:
            raise ValueError("policies is empty; give one by agent, as {'robot_0': 'orca'}, or others=")
        keys = [kind if isinstance(kind, str) else id(kind) for kind in given.values()]
        distinct = dict(zip(keys, given.values()))
        self._given, self._members = given, [*map(make_policy, distinct.values())]
        self._member_of = {agent: [*distinct].index(key) for agent, key in zip(given, keys)}

    def __getstate__(self) -> dict[str, object]:
        # A copy drives episodes of its own.
        return {**super().__getstate__(), "_members": [*map(copy_policy, self._members)]}

    def observation_options(self, problem: Problem) -> Mapping[str, object]:
        """The most that any of them wants to observe."""
        options: dict[str, Any] = {}
        for member in self._members:
            wanted: Mapping[str, Any] = member.observation_options(problem) if isinstance(member, Policy) else {}
            options |= {name: max(value, options.get(name, value)) for name, value in wanted.items()}
        return options

    def reset(self, env: ParallelEnv, seed: int = 0) -> None:
        """See :meth:`Policy.reset`.

        Raises:
            ValueError: Also if a policy is given for no robot of the team, or a robot has none.
        """
        super().reset(env, seed)
        agents = env.possible_agents
        if unknown := [agent for agent in self._given if agent not in (*agents, "others")]:
            raise ValueError(
                f"policies are given for {', '.join(map(str, unknown))}, and this team is {agents[0]} to {agents[-1]}; "
                "leave them out"
            )
        if "others" not in self._given and (missing := [agent for agent in agents if agent not in self._given]):
            raise ValueError(f"no policy is given for {', '.join(missing)}; give theirs, or others=")
        for member in self._members:
            member.reset(env, seed=seed)

    def act(self, observations: Observations, state: FloatArray) -> Actions:
        acting_robots(self, observations)
        actions: Actions = {}
        for index, member in enumerate(self._members):
            own = {agent: seen for agent, seen in observations.items() if self._index(agent) == index}
            given = member.act(own, state) if own else {}
            actions |= {agent: given[agent] for agent in own if agent in given}
        return {agent: actions[agent] for agent in observations if agent in actions}

    def identity(self) -> dict[str, object]:
        return {agent: {"policy": called(kind), **policy_settings(kind)} for agent, kind in self._given.items()}

    def _index(self, agent: str) -> int:
        return self._member_of[agent if agent in self._member_of else "others"]
