"""The batched environment for TorchRL (https://docs.pytorch.org/rl), in its form for teams: one group of robots.

>>> from d4orm_env.integrations.torchrl import TorchRLNavigation
>>> env = TorchRLNavigation(64, "random", num_robots=4, reward="training")
>>> rollout = env.rollout(100, break_when_any_done=False)
>>> rollout["next", "robots", "reward"].shape
torch.Size([64, 100, 4, 1])
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from d4orm_env.core.arrays import BoolArray, FloatArray
from d4orm_env.envs.team_step import Info
from d4orm_env.envs.vector_env import NavigationVectorEnv
from d4orm_env.scenarios.problems import ScenarioLike

try:
    import torch
    from tensordict import TensorDict, TensorDictBase
    from torchrl.data import Binary, Bounded, Composite, Unbounded
    from torchrl.envs import EnvBase
except ModuleNotFoundError as error:
    missing = (error.name or "torchrl").partition(".")[0]
    raise ImportError(f"this integration needs {missing}; install it with: pip install 'd4orm-env[rl]'") from None

__all__ = ["GROUP", "TorchRLNavigation"]

GROUP = "robots"
"""Name of the robots' part of a tensordict."""
_INFO = ("acting", "collided", "success")


class TorchRLNavigation(EnvBase):
    """``B`` worlds of ``K`` robots in one compiled call, with what belongs to robots under ``"robots"``.

    Under ``"robots"`` are ``observation`` ``(B, K, D)``, ``action`` ``(B, K, m)`` in physical units, ``reward``
    ``(B, K, 1)``, zero for robots that have arrived, and ``info``, flags ``(B, K, 1)``: ``acting``, whether the robot
    has yet to arrive, so that its action counts; ``collided``, whether it touches something now; and ``success``,
    whether its whole team has arrived without a collision.

    An episode is the team's: ``terminated`` when all have arrived, ``truncated`` when time is up, ``(B, 1)`` each. A
    robot that has arrived stays there until then.

    Args:
        num_worlds: ``B``.
        scenario: As for :class:`~d4orm_env.envs.vector_env.NavigationVectorEnv`, like all others but for its
            auto-reset, which is TorchRL's.
        num_robots: ``K``.
        seed: Of the first world; the others have the numbers that follow.
        device: Device of the tensors. The worlds are stepped on the CPU.
        **options: Further arguments.

    Attributes:
        worlds: The environment behind it.
        group_map: ``{"robots": ["robot_0", ...]}``.

    Raises:
        TypeError: For an argument that does not exist.
        ValueError: For a bad argument.
    """

    def __init__(
        self,
        num_worlds: int,
        scenario: ScenarioLike | None = None,
        num_robots: int | None = None,
        *,
        seed: int | None = None,
        device: torch.device | str = "cpu",
        **options: Any,
    ) -> None:
        self.worlds = NavigationVectorEnv(num_worlds, scenario, num_robots, autoreset_mode="Disabled", **options)
        super().__init__(device=device, batch_size=[num_worlds])
        self.group_map = {GROUP: [f"robot_{robot}" for robot in range(self.worlds.problem.num_robots)]}
        self._seed_at_reset = seed
        self._info = {name: np.zeros((num_worlds, self.worlds.problem.num_robots), np.bool_) for name in _INFO}
        self._make_specs()

    def _make_specs(self) -> None:
        spaces: tuple[Any, Any] = self.worlds.single_observation_space, self.worlds.single_action_space
        seen, acted = (self._box(*(end.reshape(self._shape[1], -1) for end in (box.low, box.high))) for box in spaces)
        info = self._composite({name: self._flag(*self._shape) for name in _INFO})
        self.observation_spec = self._of_robots({"observation": seen, "info": info})
        self.action_spec = self._of_robots({"action": acted})
        self.reward_spec = self._of_robots({"reward": Unbounded((*self._shape, 1), device=self.device)})
        done = {name: self._flag(self._shape[0]) for name in ("done", "terminated", "truncated")}
        self.done_spec = Composite(done, shape=self.batch_size, device=self.device)

    @property
    def _shape(self) -> tuple[int, int]:
        return self.worlds.num_envs, self.worlds.problem.num_robots

    def _flag(self, *shape: int) -> Binary:
        return Binary(1, (*shape, 1), device=self.device, dtype=torch.bool)

    def _box(self, low: FloatArray, high: FloatArray) -> Bounded:
        """Return the spec of ``n`` numbers for every robot, between bounds ``(K, n)``."""
        shape = (*self._shape, low.shape[-1])
        ends = (torch.as_tensor(np.broadcast_to(end, shape).copy(), device=self.device) for end in (low, high))
        return Bounded(*ends, shape, device=self.device, dtype=torch.float32)

    def _composite(self, parts: dict[str, object]) -> Composite:
        return Composite(parts, shape=self._shape, device=self.device)

    def _of_robots(self, parts: dict[str, object]) -> Composite:
        return Composite({GROUP: self._composite(parts)}, shape=self.batch_size, device=self.device)

    def _set_seed(self, seed: int | None) -> None:
        self._seed_at_reset = seed

    def _reset(self, tensordict: TensorDictBase | None = None, **options: object) -> TensorDictBase:
        mask = np.ones(self._shape[0], np.bool_)
        asked = None if tensordict is None else tensordict.get("_reset", None)
        if asked is not None:
            mask = asked.reshape(-1).cpu().numpy()
        observations, infos = self.worlds.reset(seed=self._seed_at_reset, options={"reset_mask": mask})
        self._seed_at_reset = None
        return self._as_tensors(observations, infos, mask, np.zeros_like(mask), np.zeros_like(mask))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        controls = tensordict[GROUP, "action"].detach().cpu().numpy().reshape(self._shape[0], -1)
        acted = self._info["acting"].copy()
        observations, _, terminated, truncated, infos = self.worlds.step(controls)
        after = self._as_tensors(observations, infos, np.ones_like(terminated), terminated, truncated)
        after[GROUP, "reward"] = self._tensor(self.worlds.robot_rewards * acted)[..., None]
        return after

    def _as_tensors(
        self, observations: FloatArray, infos: Info, mask: BoolArray, terminated: BoolArray, truncated: BoolArray
    ) -> TensorDictBase:
        """The tensors that TorchRL takes; ``mask`` ``(B,)`` says where the infos count."""
        success = np.broadcast_to(infos["is_success"][:, None], self._shape)
        now = {"acting": ~infos["arrived"], "collided": infos["collided"], "success": success}
        for name, values in now.items():
            self._info[name][mask] = values[mask]
        flags = {name: self._tensor(values)[..., None] for name, values in self._info.items()}
        robots = TensorDict(
            {
                "observation": self._tensor(observations.reshape(*self._shape, -1)),
                "info": TensorDict(flags, self._shape, device=self.device),
            },
            self._shape, device=self.device,
        )  # fmt: skip
        ends = {"done": terminated | truncated, "terminated": terminated, "truncated": truncated}
        rows = {name: self._tensor(values)[:, None] for name, values in ends.items()}
        return TensorDict({GROUP: robots, **rows}, self.batch_size, device=self.device)

    def _tensor(self, values: ArrayLike) -> torch.Tensor:
        """Copy the values as they are now."""
        return torch.as_tensor(np.array(values), device=self.device)

    def close(self, **options: object) -> None:
        """Close the environment."""
        self.worlds.close()
        super().close(**options)
