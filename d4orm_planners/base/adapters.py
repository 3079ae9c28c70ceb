"""Models of reinforcement-learning libraries as policies: one model that all robots share, asked for all at once.

No library is imported unless a model of it is given, and no file is read: load the model yourself.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, TypeAlias

from numpy.typing import ArrayLike

from d4orm_env.core.arrays import FloatArray, short_repr, truth
from d4orm_env.core.lazy import LazyModule
from d4orm_planners.base.shared_policy import Model, SharedPolicy, loaded

tensordict: Any = LazyModule("tensordict")
tensordict_nn: Any = LazyModule("tensordict.nn")
torch: Any = LazyModule("torch")

__all__ = ["SharedPolicy", "from_rllib", "from_sb3", "from_torch", "from_torchrl"]
Key: TypeAlias = str | tuple[str, ...]  #: A key of a ``TensorDict``


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
        ValueError: If it is no model, or another argument is neither True nor False.
    """
    if not hasattr(model, "policy"):
        raise ValueError(
            f"model is {short_repr(model)}; give a model of Stable-Baselines3, as PPO.load(path), or use "
            "make_policy('ppo', path=...)"
        )
    normalising = model.get_vec_normalize_env()
    changed = normalising is not None and normalising.norm_obs
    weights = _Normalised(model.policy, normalising.obs_rms) if changed else model.policy
    ask = partial(_ask_sb3, model, deterministic=truth(deterministic, "deterministic"))
    trained = model.observation_space.shape, model.action_space.shape
    return SharedPolicy(ask, weights, egocentric=egocentric, trained=trained, actions=model.action_space)


def from_torch(module: Model, normalized: bool = False, egocentric: bool = False, joint: bool = False) -> SharedPolicy:
    """A ``torch.nn.Module`` that maps observations ``(B, n)`` to actions ``(B, m)``, asked without gradients.

    Args:
        module: The module, on the CPU.
        normalized: Whether its actions are in ``[-1, 1]``.
        egocentric: Whether it was trained in ``egocentric`` environments, see :class:`SharedPolicy`.
        joint: Whether it steers the whole team at once, see :class:`SharedPolicy`.

    Raises:
        ValueError: If it is no module, or another argument is neither True nor False.
    """
    return SharedPolicy(partial(_ask_torch, loaded(module)), module, normalized, egocentric, joint=joint)


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

    Raises:
        ValueError: As :func:`from_torch`.
    """
    ask = partial(_ask_torchrl, loaded(module), observation_key=observation_key, action_key=action_key)
    return SharedPolicy(ask, module, egocentric=egocentric, joint=joint)


def from_rllib(module: Model, normalized: bool = True, egocentric: bool = False) -> SharedPolicy:
    """An ``RLModule`` of RLlib on torch, asked by ``forward_inference``.

    Args:
        module: Result of ``algorithm.get_module(module_id)`` or ``RLModule.from_checkpoint(path)``.
        normalized: Whether its actions are in ``[-1, 1]``, as RLlib trains unless ``normalize_actions`` is off.
        egocentric: Whether it was trained in ``egocentric`` environments, see :class:`SharedPolicy`.

    Raises:
        ValueError: As :func:`from_torch`.
    """
    return SharedPolicy(partial(_ask_rllib, loaded(module, "forward_inference")), module, normalized, egocentric)


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
