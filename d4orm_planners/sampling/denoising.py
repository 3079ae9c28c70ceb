"""A film of a solve: the paths of the candidates of its denoising steps, and of some samples."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.problem import Problem
from d4orm_env.engine.choice import rollout
from d4orm_env.render.replay import Denoising
from d4orm_planners.engine.sampling_types import DenoisingStep

__all__ = ["DenoisingFilm"]
POINTS = 26  #: Points of a path that are kept


@dataclass(frozen=True)
class _Frame:
    noise_scale: float
    controls: FloatArray
    samples: FloatArray
    shares: FloatArray


class DenoisingFilm:
    """Records the denoising steps of a solve that deform the whole team::

        film = DenoisingFilm(problem)
        plan = planner.solve(problem, watcher=film)
        denoising = film.developed()

    Steps of parts of the team, such as D4orm-D's repairs, are left out. It keeps controls only, some 100 kB a step for
    16 robots, and rolls them out when it is developed.

    Args:
        problem: The problem that is solved.
        num_samples: Samples to keep of every step.
    """

    def __init__(self, problem: Problem, num_samples: int = 4) -> None:
        self._problem, self._num_samples = problem, num_samples
        self._frames: list[_Frame] = []

    def __call__(self, step: DenoisingStep) -> None:
        # That of a part of the team has a team of its own.
        if step.task.problem.team is not self._problem.team:
            return
        base, weights = step.task.base, np.atleast_2d(step.weights)[:, : self._num_samples]
        shares = weights.mean(axis=0) / max(float(weights.max()), 1e-12)
        samples = base + step.samples[: self._num_samples]
        self._frames.append(_Frame(step.noise_scale, base + step.mean, samples, shares))

    def __len__(self) -> int:
        return len(self._frames)

    def developed(self, most: int = 120) -> Denoising:
        """Roll out the candidates and samples.

        Args:
            most: Steps to keep, spread evenly; the last is among them.

        Raises:
            ValueError: If there was no step.
        """
        if not self._frames:
            raise ValueError(
                "no denoising of the whole team was seen; this planner found its plan otherwise, use d4orm with "
                "start='team'"
            )
        numbers = np.unique(np.linspace(0, len(self._frames) - 1, min(most, len(self._frames))).round().astype(int))
        chosen = [self._frames[number] for number in numbers]
        labels = [
            f"denoising step {number + 1} of {len(self._frames)}, sigma {frame.noise_scale:.2f}"
            for number, frame in zip(numbers, chosen)
        ]
        return Denoising(
            tuple(labels),
            np.stack([self._path(frame.controls) for frame in chosen]),
            np.stack([[self._path(sample) for sample in frame.samples] for frame in chosen]),
            np.stack([0.12 + 0.3 * frame.shares for frame in chosen]),
        )

    def _path(self, controls: FloatArray) -> FloatArray:
        whole = np.zeros((self._problem.horizon, *controls.shape[1:]), np.float32)
        whole[: len(controls)] = controls
        positions = rollout(self._problem, whole, engine="cpu").positions
        return positions[np.linspace(0, len(positions) - 1, min(POINTS, len(positions))).round().astype(int)]
