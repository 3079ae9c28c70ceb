"""Models of reinforcement-learning libraries as policies: one model that all robots share, asked for all at once.

No library is imported unless a model of it is given, and no file is read: load the model yourself.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from d4orm_env.core.arrays import FloatArray, as_float32
from d4orm_env.core.lazy import LazyModule
from d4orm_planners.base.policy import Actions, Observations, Policy, within_limits

if TYPE_CHECKING:
    from pettingzoo import ParallelEnv

tensordict: Any = LazyModule("tensordict")
tensordict_nn: Any = LazyModule("tensordict.nn")
torch: Any = LazyModule("torch")

__all__ = ["SharedPolicy", "from_rllib", "from_sb3", "from_torch", "from_torchrl"]

Key: TypeAlias = str | tuple[str, ...]
"""A key of a ``TensorDict``."""

Model: TypeAlias = Any
"""A model of a library that need not be installed."""


class SharedPolicy(Policy):
    """Every robot by itself maps what it observes to its control, all by one function of stacked observations.

    Args:
        predict: ``(B, n)`` float32 observations of any number of robots to ``(B, m)`` actions.
        weights: Something with a ``state_dict``, by which a store of trials tells one training's model from another's.
        normalized: Whether actions are in ``[-1, 1]``, which stand for the lowest and the highest of the environment.
    """

    def __init__(self, predict: Callable[[FloatArray], ArrayLike], weights: Model, normalized: bool = False) -> None:
        self._predict, self._weights, self._normalized = predict, weights, normalized

    def reset(self, env: ParallelEnv, seed: int = 0) -> None:
        super().reset(env, seed)
        self._spaces = {agent: env.action_space(agent) for agent in env.possible_agents}

    def act(self, observations: Observations, state: FloatArray) -> Actions:
        if not observations:
            return {}
        stacked = np.stack([np.asarray(observation, np.float32) for observation in observations.values()])
        actions = as_float32(self._predict(stacked))
        if self._normalized:
            spaces = [self._spaces[agent] for agent in observations]
            low, high = np.stack([space.low for space in spaces]), np.stack([space.high for space in spaces])
            actions = low + (np.clip(actions, -1, 1) + 1) / 2 * (high - low)
        return within_limits(self.problem, dict(zip(observations, actions)))

    def identity(self) -> dict[str, object]:
        digest = hashlib.sha256()
        for name, tensor in self._weights.state_dict().items():
            digest.update(name.encode())
            digest.update(np.ascontiguousarray(tensor.detach().cpu().numpy()).tobytes())
        settings = getattr(self._predict, "keywords", {})  # of a partial
        return {**settings, "normalized": self._normalized, "weights": digest.hexdigest()}


def from_sb3(model: Model, deterministic: bool = True) -> SharedPolicy:
    """A model of Stable-Baselines3, trained on the environment's own observations and actions, as through SuperSuit.

    Args:
        model: Result of ``PPO.load(path)`` or of the training.
        deterministic: Take the most likely action rather than draw one.
    """
    return SharedPolicy(partial(_ask_sb3, model, deterministic=deterministic), model.policy)


def from_torch(module: Model, normalized: bool = False) -> SharedPolicy:
    """A ``torch.nn.Module`` that maps observations ``(B, n)`` to actions ``(B, m)``, asked without gradients.

    Args:
        module: The module, on the CPU.
        normalized: Whether its actions are in ``[-1, 1]``.
    """
    return SharedPolicy(partial(_ask_torch, module), module, normalized)


def from_torchrl(module: Model, observation_key: Key = "observation", action_key: Key = "action") -> SharedPolicy:
    """A module of TorchRL (or TensorDict), which is asked for its deterministic action, without gradients.

    Args:
        module: Reads ``(B, n)`` observations from a ``TensorDict`` of ``B`` robots, writes ``(B, m)`` actions into it.
        observation_key: Key of the observations.
        action_key: Key of the actions.
    """
    return SharedPolicy(partial(_ask_torchrl, module, observation_key=observation_key, action_key=action_key), module)


def from_rllib(module: Model, normalized: bool = True) -> SharedPolicy:
    """An ``RLModule`` of RLlib on torch, asked by ``forward_inference``.

    Args:
        module: Result of ``algorithm.get_module(module_id)`` or ``RLModule.from_checkpoint(path)``.
        normalized: Whether its actions are in ``[-1, 1]``, as RLlib trains unless ``normalize_actions`` is off.
    """
    return SharedPolicy(partial(_ask_rllib, module), module, normalized)


def _ask_sb3(model: Model, observations: FloatArray, *, deterministic: bool) -> ArrayLike:
    return model.predict(observations, deterministic=deterministic)[0]


def _ask_torch(module: Model, observations: FloatArray) -> ArrayLike:
    with torch.no_grad():
        return module(torch.as_tensor(observations)).numpy()


def _ask_torchrl(module: Model, observations: FloatArray, *, observation_key: Key, action_key: Key) -> ArrayLike:
    asked = tensordict.TensorDict({observation_key: torch.as_tensor(observations)}, batch_size=[len(observations)])
    with torch.no_grad(), tensordict_nn.set_interaction_type(tensordict_nn.InteractionType.DETERMINISTIC):
        return module(asked)[action_key].cpu().numpy()


def _ask_rllib(module: Model, observations: FloatArray) -> ArrayLike:
    with torch.no_grad():
        answer = module.forward_inference({"obs": torch.as_tensor(observations)})
        if "actions" in answer:
            return answer["actions"].cpu().numpy()
        kind = module.get_inference_action_dist_cls()
        return kind.from_logits(answer["action_dist_inputs"]).to_deterministic().sample().cpu().numpy()
