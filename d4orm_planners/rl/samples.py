"""Samples of robots' observations and an expert's actions: recorded, and kept in files."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Self

import numpy as np

from d4orm_env.core.arrays import FloatArray, as_float32
from d4orm_env.core.files import ArrayArchive, replaced_when_done
from d4orm_planners.base.policy import Policy, robot_indices
from d4orm_planners.rl.features import Features

if TYPE_CHECKING:
    from pettingzoo import ParallelEnv

Driver = Callable[[FloatArray, FloatArray], FloatArray]

MAX_BYTES = 2**31
"""Largest array of a file that is read."""


@dataclass(frozen=True, eq=False)
class Samples:
    """``N`` moments of robots.

    Attributes:
        observations: ``(N, D)`` float32 as the environment gave them.
        controls: ``(N, m)`` float32 of the expert, in physical units.
        limits: ``(N, m)`` float32 largest controls.
    """

    observations: FloatArray
    controls: FloatArray
    limits: FloatArray

    def __len__(self) -> int:
        return len(self.observations)

    @classmethod
    def joined(cls, parts: Sequence[Samples]) -> Self:
        """All of them, in order."""
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in _ARRAYS))

    def learnable(self, features: Features) -> tuple[FloatArray, FloatArray]:
        """A network's inputs ``(N, F)`` and the actions ``(N, m)`` that it should answer with."""
        inputs, frames = features.encode(self.observations)
        return inputs, features.actions(self.controls, frames, self.limits).astype(np.float32)

    def save(self, path: Path) -> None:
        """Write them into an ``.npz`` file, which is whole or not there."""
        with replaced_when_done(path, (".npz",)) as temporary, temporary.open("wb") as stream:
            np.savez(stream, **vars(self))

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read what :meth:`save` has written.

        Raises:
            ValueError: If it is something else.
        """
        try:
            with path.open("rb") as stream, ArrayArchive(stream, _ARRAYS) as archive:
                return cls(*(archive.array(name, MAX_BYTES) for name in _ARRAYS))
        except (ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as error:
            raise ValueError(f"{path} holds no samples ({error}); remove it to record them anew") from None


_ARRAYS = tuple(field.name for field in fields(Samples))


def record_samples(env: ParallelEnv, expert: Policy, seed: int, learner: Driver | None = None) -> Samples:
    """Run an episode and ask the expert at every step what to do.

    Args:
        env: A :mod:`d4orm_env.navigation_v0` parallel environment of a team of one model.
        expert: Policy that is asked.
        seed: Seeds both.
        learner: Policy that drives, as ``(observations (N, D), limits (N, m)) -> controls (N, m)``; by default the
            expert. With a learner the expert is asked where that has led the team.

    Returns:
        What the robots saw until they arrived, and what the expert said.
    """
    observations, _ = env.reset(seed=seed)
    expert.reset(env, seed=seed)
    limits, parts = env.unwrapped.problem.team.control_limits, []
    while env.agents:
        acting = {agent: observations[agent] for agent in env.agents}
        asked = expert.act(acting, env.state())
        seen, own = np.stack(list(acting.values())), limits[robot_indices(acting)]
        controls = as_float32([asked[agent] for agent in acting])
        parts.append(Samples(seen, controls, own))
        driven = controls if learner is None else learner(seen, own)
        observations, *_ = env.step(dict(zip(acting, driven, strict=True)))
    return Samples.joined(parts)
