"""Large-neighbourhood search on a roadmap: a few robots at a time find other paths in space and time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from d4orm_env.core.arrays import IntArray
from d4orm_planners.mapf.lns import Odds
from d4orm_planners.mapf.roadmap_team import Replanning, TeamRollout

NEARNESS = 10 / 3
"""Random distance by which a robot may be farther away and still be replanned with another, in radii of the largest."""


@dataclass
class RoadmapPaths:
    """Low-level planner of :func:`~d4orm_planners.mapf.lns.search_neighbourhoods`: paths in space and time.

    Attributes:
        replanning: Search for paths.
        solution: Rollout of the team.
        most: Robots that are replanned together, at most.
        should_stop: Asked before every path.
    """

    replanning: Replanning
    solution: TeamRollout
    most: int
    should_stop: Callable[[], bool]
    groups: int = 1

    @property
    def cost(self) -> tuple[int, int]:
        """See :meth:`TeamRollout.cost`."""
        return self.solution.cost(self.replanning.problem.horizon)

    def odds(self, random: np.random.Generator) -> Odds:
        """See :meth:`LowLevelPlanner.odds`: often one of those that come too late."""
        driven, replanning = self.solution, self.replanning
        delay = np.maximum(driven.arrivals - replanning.alone, 1.0)
        late = driven.arrivals > replanning.problem.horizon
        if late.any() and random.random() < 0.5:
            delay[~late] = 0.0
        sizes = (1, min(len(delay), self.most))
        return Odds(delay, driven.places, driven.arrivals, NEARNESS * replanning.size, sizes)

    def replan(self, groups: list[IntArray], random: np.random.Generator, temperature: float) -> None:
        """See :meth:`LowLevelPlanner.replan`; what is worse is never accepted."""
        for robots in groups:
            changed = self.replanning.replan(self.solution, robots, random, self.should_stop)
            if changed is not None and changed.cost(self.replanning.problem.horizon) < self.cost:
                self.solution = changed
