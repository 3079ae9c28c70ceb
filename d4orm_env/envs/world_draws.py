"""Instances and disturbances of the worlds of a batch, drawn by each world as by a single environment."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from gymnasium.utils import seeding
from numpy.typing import NDArray

from d4orm_env.core.arrays import whole_number
from d4orm_env.core.problem import Problem
from d4orm_env.envs.simulation import Simulation

OWN_ARRAYS = ("start", "goal", "inverse_initial_distance")
"""Arrays that differ from world to world in one kernel call."""
WORLD_ARRAYS = ("boxes", "triangles", "bounds")
"""Arrays that may differ too, at the price of a call for each world; all the rest of a problem is shared."""


class WorldDraws:
    """The random numbers of a batch.

    Args:
        template: The simulation whose problem, scenario and disturbances the worlds share.
        num_worlds: ``B``.
        num_instances: Choose among so many instances, drawn at first; ``None`` draws a new one each time.

    Attributes:
        needed: Whether anything is random.
        seeds: ``(B,)`` what each world has drawn for its present episode; all that is random in it follows from it.

    Raises:
        ValueError: If ``num_instances`` makes no sense, or instances differ in more than places and obstacles.
    """

    def __init__(self, template: Simulation, num_worlds: int, num_instances: int | None) -> None:
        if num_instances is not None and not template.redraws:
            raise ValueError(
                f"num_instances is {num_instances!r} without randomize_instance, or for a scenario that draws nothing "
                "at random; leave it out"
            )
        self._template, self._first = template, template.problem
        self._num_instances = None if num_instances is None else whole_number(num_instances, "num_instances", 1)
        self._pool: list[Problem] = []
        self.needed = bool(template.disturbances) or template.redraws
        self._generators: list[np.random.Generator | None] = [None] * num_worlds
        self.seeds: NDArray[np.int64] = np.zeros(num_worlds, np.int64)
        if template.redraws and not template.stochastic:
            self._drawn(np.random.default_rng(0))

    def seed(self, world: int, seed: int) -> None:
        """Seed a world; instances drawn with another seed are forgotten."""
        self._pool = []
        self._generators[world] = seeding.np_random(seed)[0] if self.needed else None

    def begin(self, world: int) -> Problem | None:
        """Draw what is random in the next episode of a world; a new instance, if the scenario draws them."""
        generator = self._generators[world]
        if generator is None:
            generator = self._generators[world] = seeding.np_random()[0]
        self.seeds[world] = seed = int(generator.integers(2**63))
        if not self._template.redraws:
            return None
        episode = np.random.default_rng(seed)
        if self._num_instances is None:
            return self._drawn(episode)
        if not self._pool:
            self._pool = [self._drawn(episode) for _ in range(self._num_instances)]
        return self._pool[int(episode.integers(self._num_instances))]

    def _drawn(self, random: np.random.Generator) -> Problem:
        """A new instance that differs from the first in places and obstacles only."""
        drawn = self._template.draw_instance(random)
        differing = self.differing(drawn, set(drawn.arrays._fields) - {*OWN_ARRAYS, *WORLD_ARRAYS, "grid"})
        if differing:
            raise ValueError(
                f"instances of scenario {drawn.name!r} differ in their {', '.join(differing)}, and worlds of a batch "
                "share all but starts, goals and obstacles; use vectorization_mode='sync'"
            )
        return drawn

    def differing(self, problem: Problem, names: Iterable[str] = WORLD_ARRAYS) -> list[str]:
        """Return the arrays in which a problem differs from the first."""
        one, other = problem.arrays, self._first.arrays
        return [name for name in names if not np.array_equal(getattr(one, name), getattr(other, name))]
