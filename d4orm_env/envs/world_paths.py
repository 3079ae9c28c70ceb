"""Shortest paths from where the robots of a batch of worlds are."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import FloatArray, Floats
from d4orm_env.core.problem import Problem
from d4orm_env.paths.shortest_paths import ahead_in_each


class WorldPaths:
    """Paths of ``B`` worlds to the goals, as they were last looked for.

    Args:
        problems: Of each world; it may change.
        one_world: Whether all are one.

    Attributes:
        direction: ``(B, K, d)`` unit vectors.
        length: ``(B, K)`` [m].
    """

    def __init__(self, problems: Sequence[Problem], *, one_world: bool) -> None:
        self._problems, self._one_world = problems, one_world
        shape = len(problems), problems[0].num_robots
        self.direction: Floats = np.zeros((*shape, problems[0].dimension))
        self.length: Floats = np.zeros(shape)

    @property
    def first_length(self) -> Floats:
        """``(B, K)`` length of the paths from the starts [m]."""
        return np.stack([problem.shortest_paths.length for problem in self._problems])

    def update(self, worlds: NDArray[np.intp], states: FloatArray) -> None:
        """Look for the paths in some worlds, where the robots are in ``states`` ``(B, K, n)``."""
        self.direction[worlds], self.length[worlds] = self.look(worlds, states[worlds])

    def look(self, worlds: NDArray[np.intp], states: FloatArray) -> tuple[Floats, Floats]:
        """Directions ``(b, K, d)`` and lengths ``(b, K)`` of paths in some worlds, from ``states`` ``(b, K, n)``."""
        positions = states[..., : self.direction.shape[-1]]
        if self._one_world:
            return self._problems[0].shortest_paths.ahead(positions)
        return ahead_in_each([self._problems[world].shortest_paths for world in worlds], positions)
