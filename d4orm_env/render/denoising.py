"""How a plan came about, as pictures and replays show it: a candidate at a time, from noise to clean ways."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from d4orm_env.core.arrays import FloatArray

__all__ = ["Denoising"]


@dataclass(frozen=True, eq=False)
class Denoising:
    """Candidates of some denoising steps ``S``, each at ``P`` points of its time.

    Attributes:
        labels: ``S`` texts, one for every step shown.
        paths: ``(S, P, K, d)`` where the candidate leads [m].
        samples: ``(S, N, P, K, d)`` where some of the samples lead that it was made of [m].
        alpha: ``(S, N)`` how opaque each sample is drawn, 0 to 1.
        seconds_per_step: How long a replay shows each.

    Raises:
        ValueError: If the shapes do not go together.
    """

    labels: tuple[str, ...]
    paths: FloatArray
    samples: FloatArray
    alpha: FloatArray
    seconds_per_step: float = 0.06

    def __post_init__(self) -> None:
        steps, expected = len(self.labels), (len(self.labels), self.alpha.shape[-1], *self.paths.shape[1:])
        if not steps or len(self.paths) != steps or self.samples.shape != expected or self.alpha.shape != expected[:2]:
            raise ValueError(
                f"labels, paths, samples and alpha have lengths and shapes {steps}, {self.paths.shape}, "
                f"{self.samples.shape} and {self.alpha.shape}; they must be S, (S, P, K, d), (S, N, P, K, d) and (S, N)"
            )
        if not (np.isfinite(self.paths).all() and np.isfinite(self.samples).all()):
            raise ValueError("paths and samples must be finite")
