"""Models of reinforcement-learning libraries as policies: one model that all robots share, asked for all at once.

No library is imported unless a model of it is given, and no file is read: load the model yourself.
"""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from d4orm_env.core.arrays import FloatArray, as_float32, short_repr
from d4orm_env.core.lazy import LazyModule
from d4orm_env.envs.features import Features
from d4orm_env.envs.joint_state import split_state
from d4orm_planners.base.measured_states import acting_robots, stacked_observations
from d4orm_planners.base.policy import Actions, Observations, Policy, within_limits
from d4orm_planners.tracking.steering import brake_to_dock

if TYPE_CHECKING:
    from pettingzoo import ParallelEnv

tensordict: Any = LazyModule("tensordict")
tensordict_nn: Any = LazyModule("tensordict.nn")
torch: Any = LazyModule("torch")

__all__ = ["SharedPolicy", "from_rllib", "from_sb3", "from_torch", "from_torchrl"]

Key: TypeAlias = str | tuple[str, ...]
"""A key of a ``TensorDict``."""

Shapes: TypeAlias = tuple[tuple[int, ...], tuple[int, ...]]
"""Shapes of observations and of actions."""

Model: TypeAlias = Any
"""A model of a library that need not be installed."""


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
    """

    def __init__(
        self,
        predict: Callable[[FloatArray], ArrayLike],
        weights: Model | None,
        normalized: bool = False,
        egocentric: bool = False,
        trained: Shapes | None = None,
        joint: bool = False,
    ) -> None:
        if weights is not None and not hasattr(weights, "state_dict"):
            raise ValueError(f"the model is {short_repr(weights)}; load it first, and give what acts")
        self._predict, self._weights, self._normalized, self._egocentric = predict, weights, normalized, egocentric
        self._trained, self._joint = trained, joint

    def reset(self, env: ParallelEnv, seed: int = 0) -> None:
        """See :meth:`Policy.reset`.

        Raises:
            ValueError: If the model was trained for other observations or actions, as far as it tells.
        """
        super().reset(env, seed)
        spaces = [env.action_space(agent) for agent in env.possible_agents]
        self._low, self._high = np.stack([space.low for space in spaces]), np.stack([space.high for space in spaces])
        self._features = Features.of_team(env.unwrapped.layout, self.problem.team) if self._egocentric else None
        seen = env.observation_space(env.possible_agents[0]).shape
        (self._seen_size,) = seen
        shapes = seen if self._features is None else (self._features.size,), self._low.shape[1:]
        self._env, self._is_joint = env, self._steers_team(shapes)

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

    def act(self, observations: Observations, state: FloatArray) -> Actions:
        robots = acting_robots(self, observations)
        if not observations:
            return {}
        seen = stacked_observations(observations, self._seen_size)
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


@dataclass(frozen=True)
class _Normalised:
    """The weights of a network, and the running statistics by which what it observes is normalised."""

    network: Model
    statistics: Model

    def state_dict(self) -> dict[str, Any]:
        statistics = {name: torch.as_tensor(getattr(self.statistics, name)) for name in ("mean", "var")}
        return {**self.network.state_dict(), **statistics}


def from_sb3(model: Model, deterministic: bool = True, egocentric: bool = False) -> SharedPolicy:
    """A model of Stable-Baselines3, trained on the environment's own observations and actions: each robot's, as
    through SuperSuit, or the team's, in the joint Gymnasium environment.

    Args:
        model: Result of ``PPO.load(path)`` or of the training. If its environment is a ``VecNormalize``, it is asked
            for what that makes of the observations.
        deterministic: Take the most likely action rather than draw one.
        egocentric: Whether it was trained in ``egocentric`` environments, see :class:`SharedPolicy`.

    Raises:
        ValueError: If it is no model.
    """
    if not hasattr(model, "policy"):
        raise ValueError(
            f"model is {short_repr(model)}; give a model of Stable-Baselines3, as PPO.load(path), or use "
            "make_policy('ppo', path=...)"
        )
    normalising = model.get_vec_normalize_env()
    changed = normalising is not None and normalising.norm_obs
    weights = _Normalised(model.policy, normalising.obs_rms) if changed else model.policy
    ask = partial(_ask_sb3, model, deterministic=deterministic)
    trained = model.observation_space.shape, model.action_space.shape
    return SharedPolicy(ask, weights, egocentric=egocentric, trained=trained)


def from_torch(module: Model, normalized: bool = False, egocentric: bool = False, joint: bool = False) -> SharedPolicy:
    """A ``torch.nn.Module`` that maps observations ``(B, n)`` to actions ``(B, m)``, asked without gradients.

    Args:
        module: The module, on the CPU.
        normalized: Whether its actions are in ``[-1, 1]``.
        egocentric: Whether it was trained in ``egocentric`` environments, see :class:`SharedPolicy`.
        joint: Whether it steers the whole team at once, see :class:`SharedPolicy`.
    """
    return SharedPolicy(partial(_ask_torch, module), module, normalized, egocentric, joint=joint)


def from_torchrl(
    module: Model,
    observation_key: Key = "observation",
    action_key: Key = "action",
    egocentric: bool = False,
    joint: bool = False,
) -> SharedPolicy:
    """A module of TorchRL (or TensorDict), which is asked for its deterministic action, without gradients.

    Args:
        module: Reads ``(B, n)`` observations from a ``TensorDict`` of ``B`` robots, writes ``(B, m)`` actions into it.
        observation_key: Key of the observations.
        action_key: Key of the actions.
        egocentric: Whether it was trained in ``egocentric`` environments, see :class:`SharedPolicy`.
        joint: Whether it steers the whole team at once, see :class:`SharedPolicy`.
    """
    ask = partial(_ask_torchrl, module, observation_key=observation_key, action_key=action_key)
    return SharedPolicy(ask, module, egocentric=egocentric, joint=joint)


def from_rllib(module: Model, normalized: bool = True, egocentric: bool = False) -> SharedPolicy:
    """An ``RLModule`` of RLlib on torch, asked by ``forward_inference``.

    Args:
        module: Result of ``algorithm.get_module(module_id)`` or ``RLModule.from_checkpoint(path)``.
        normalized: Whether its actions are in ``[-1, 1]``, as RLlib trains unless ``normalize_actions`` is off.
        egocentric: Whether it was trained in ``egocentric`` environments, see :class:`SharedPolicy`.
    """
    return SharedPolicy(partial(_ask_rllib, module), module, normalized, egocentric)


def _checked_actions(answer: Any, count: int) -> FloatArray:
    """Actions ``(count, m)`` that a model answers with.

    Raises:
        ValueError: If it is anything else, as actions with the state of a recurrent network.
    """
    with contextlib.suppress(ValueError):
        if not isinstance(answer, tuple) and (actions := as_float32(answer)).shape[:-1] == (count,):
            return actions
    shape = f" of shape {tuple(answer.shape)}" if hasattr(answer, "shape") else ""
    raise ValueError(
        f"the model answers with a {type(answer).__name__}{shape} for {count} observations; it must be actions alone, "
        f"({count}, m), so give a module or function that returns these"
    )


def _ask_sb3(model: Model, observations: FloatArray, *, deterministic: bool) -> ArrayLike:
    if (normalising := model.get_vec_normalize_env()) is not None:
        observations = normalising.normalize_obs(observations)
    return model.predict(observations, deterministic=deterministic)[0]


def _ask_torch(module: Model, observations: FloatArray) -> ArrayLike:
    with torch.no_grad():
        return module(torch.as_tensor(observations))


def _ask_torchrl(module: Model, observations: FloatArray, *, observation_key: Key, action_key: Key) -> ArrayLike:
    asked = tensordict.TensorDict({observation_key: torch.as_tensor(observations)}, batch_size=[len(observations)])
    with torch.no_grad(), tensordict_nn.set_interaction_type(tensordict_nn.InteractionType.DETERMINISTIC):
        return module(asked)[action_key]


def _ask_rllib(module: Model, observations: FloatArray) -> ArrayLike:
    with torch.no_grad():
        answer = module.forward_inference({"obs": torch.as_tensor(observations)})
        if "actions" in answer:
            return answer["actions"]
        kind = module.get_inference_action_dist_cls()
        return kind.from_logits(answer["action_dist_inputs"]).to_deterministic().sample()
