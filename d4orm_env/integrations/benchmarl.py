"""A task for BenchMARL (https://github.com/facebookresearch/BenchMARL), whose algorithms then learn to drive teams.

>>> from d4orm_env.integrations.benchmarl import NavigationTask
>>> task = NavigationTask("random", {"num_robots": 8, "reward": "training"})
>>> Experiment(task=task, algorithm_config=MappoConfig.get_from_yaml(), ...).run()
"""

from __future__ import annotations

from collections.abc import Callable

from d4orm_env.integrations.torchrl import GROUP, TorchRLNavigation

try:
    from benchmarl.environments.common import TaskClass
    from tensordict import TensorDictBase
    from torchrl.data import Composite
except ModuleNotFoundError as error:
    missing = (error.name or "benchmarl").partition(".")[0]
    raise ImportError(
        f"this integration needs {missing}; give BenchMARL an environment of its own, with: pip install d4orm-env "
        "benchmarl"
    ) from None
except ImportError as error:
    raise ImportError(
        f"BenchMARL does not work with the TorchRL that is installed ({error}); give the two an environment of their "
        "own, with: pip install d4orm-env benchmarl"
    ) from None

__all__ = ["NavigationTask"]


class NavigationTask(TaskClass):
    """A scenario, in as many worlds as an experiment asks for, stepped in one compiled call.

    Its success rate, the share of finished episodes in which all arrived without a collision, is logged as
    ``success_rate``.

    Args:
        name: Of the scenario.
        config: Further arguments of :class:`~d4orm_env.integrations.torchrl.TorchRLNavigation`, as ``num_robots``.
    """

    def get_env_fun(
        self, num_envs: int, continuous_actions: bool, seed: int | None, device: str
    ) -> Callable[[], TorchRLNavigation]:
        """Return a function that makes the environment; see BenchMARL."""
        config = dict(self.config)
        return lambda: TorchRLNavigation(num_envs, self.name, seed=seed, device=device, **config)

    def supports_continuous_actions(self) -> bool:
        return True

    def supports_discrete_actions(self) -> bool:
        return False

    def has_render(self, env: TorchRLNavigation) -> bool:
        return False

    def max_steps(self, env: TorchRLNavigation) -> int:
        return env.worlds.max_cycles

    def group_map(self, env: TorchRLNavigation) -> dict[str, list[str]]:
        return env.group_map

    def observation_spec(self, env: TorchRLNavigation) -> Composite:
        return _only(env.observation_spec_unbatched, "observation")

    def info_spec(self, env: TorchRLNavigation) -> Composite:
        return _only(env.observation_spec_unbatched, "info")

    def action_spec(self, env: TorchRLNavigation) -> Composite:
        return env.full_action_spec_unbatched

    def state_spec(self, env: TorchRLNavigation) -> None:
        return None

    def action_mask_spec(self, env: TorchRLNavigation) -> None:
        return None

    @staticmethod
    def env_name() -> str:
        return "d4orm"

    @staticmethod
    def log_info(batch: TensorDictBase) -> dict[str, float]:
        """The success rate of the episodes that end in a batch."""
        ended = batch["next", "done"][..., 0]
        if not ended.any():
            return {}
        success = batch["next", GROUP, "info", "success"][ended][:, 0, 0]
        return {"collection/info/success_rate": float(success.float().mean())}


def _only(spec: Composite, part: str) -> Composite:
    """A spec with one part of what robots have."""
    left = spec.clone()
    for name in list(left[GROUP].keys()):
        if name != part:
            del left[GROUP, name]
    return left
