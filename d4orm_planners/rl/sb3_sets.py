"""A network of sets (:mod:`d4orm_planners.rl.set_network`) as a features extractor of Stable-Baselines3."""

from __future__ import annotations

from typing import Any

import torch
from gymnasium.spaces import Box
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from d4orm_planners.rl.features import Features
from d4orm_planners.rl.network import EPSILON
from d4orm_planners.rl.set_network import KINDS, SUM_SCALE

WIDTHS = (64, 32)
"""Widths of the layers that neighbours go through, and of those of obstacles."""


class _Set(nn.Module):
    """Rows ``(N, R, row)`` and the robot itself ``(N, own)`` to what all rows have in common, ``(N, 2 * width)``."""

    def __init__(self, row: int, own: int, width: int) -> None:
        super().__init__()
        self.first, self.own = nn.Linear(row, width), nn.Linear(own, width, bias=False)
        self.second = nn.Linear(width, width)

    def forward(self, rows: torch.Tensor, own: torch.Tensor) -> torch.Tensor:
        hidden = torch.relu(self.first(rows) + self.own(own)[:, None])
        hidden = torch.relu(self.second(hidden)) * rows[..., :1]
        if not rows.shape[1]:
            return hidden.new_zeros(len(rows), 2 * hidden.shape[2])
        return torch.cat([hidden.amax(dim=1), SUM_SCALE * hidden.sum(dim=1)], dim=1)


class SetExtractor(BaseFeaturesExtractor):
    """Pooled features of neighbours and obstacles, beside a robot's own.

    Args:
        observation_space: Of features ``(F,)``.
        features: Their layout.
    """

    def __init__(self, observation_space: Box, features: Features) -> None:
        own = features.own_size
        super().__init__(observation_space, own + 2 * sum(WIDTHS))
        self._features = features
        rows = (features.neighbor_size, features.obstacle_size)
        self._sets = [_Set(row, own, width) for row, width in zip(rows, WIDTHS, strict=True)]
        for kind, part in zip(KINDS, self._sets, strict=True):
            self.add_module(kind, part)

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        own, *rows = self._features.parts(observations)
        return torch.cat([own, *(part(listed, own) for part, listed in zip(self._sets, rows, strict=True))], dim=1)

    def arrays(self) -> dict[str, torch.Tensor]:
        """Parameters by the names that policy files have for them."""
        named: dict[str, torch.Tensor] = {}
        for kind, part in zip(KINDS, self._sets, strict=True):
            named |= {
                f"{kind}_weight_0": part.first.weight,
                f"{kind}_own": part.own.weight,
                f"{kind}_bias_0": part.first.bias,
                f"{kind}_weight_1": part.second.weight,
                f"{kind}_bias_1": part.second.bias,
            }
        return named


def leave_as_they_are(env: VecNormalize) -> None:
    """Have features not normalised: every row of a set must be in the same units, and features are of order one."""
    fixed: Any = _Fixed(shape=env.observation_space.shape or ())
    fixed.var[:] = 1 - EPSILON
    env.obs_rms = fixed


class _Fixed(RunningMeanStd):
    def update(self, arr: Any) -> None:
        """Nothing is learned from what is seen."""
