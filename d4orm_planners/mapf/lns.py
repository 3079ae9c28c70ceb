"""Large-neighbourhood search: some robots at a time, one that is late and those near to it, look for better paths.

As in MAPF-LNS (J. Li, Z. Chen, D. Harabor, P. J. Stuckey and S. Koenig, IJCAI 2021). Low-level planners find the
paths: on a roadmap (:mod:`~d4orm_planners.mapf.planner`) and under the robots' dynamics
(:mod:`~d4orm_planners.mapf.motion_lns`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np

from d4orm_env.core.arrays import FloatArray, Floats, IntArray

S_co = TypeVar("S_co", covariant=True)


class Odds(NamedTuple):
    """Chances of robots to be drawn for a neighbourhood."""

    delay: Floats  #: ``(K,)`` chance of each to be the late one, in any unit
    positions: FloatArray | Floats  #: ``(T + 1, K, d)`` [m]
    until: IntArray  #: ``(K,)`` the last step of each at which it may come near to others
    nearness: float  #: Random distance by which a robot may be farther away and still be chosen [m]
    sizes: tuple[int, int]  #: The least and the greatest number of robots

    def draw(self, random: np.random.Generator) -> IntArray:
        """A robot that is late, and some that it comes near to, in random order."""
        robot = int(random.choice(len(self.delay), p=self.delay / self.delay.sum()))
        positions = self.positions[: self.until[robot] + 1]
        gaps = np.sqrt(((positions - positions[:, [robot]]) ** 2).sum(axis=2).min(axis=0))
        gaps += self.nearness * random.random(len(self.delay))
        gaps[robot] = -1.0
        return random.permutation(np.argsort(gaps, kind="stable")[: random.integers(*self.sizes, endpoint=True)])


class LowLevelPlanner(Protocol[S_co]):
    """A solution, and the search for other paths in it.

    Attributes:
        groups: Neighbourhoods that are replanned in a round.
        solution: The solution as it is now, which later rounds do not change.
        cost: What it costs; can be compared.
        odds: Chances of the robots.
        replan: Finds other paths for groups, and accepts what is better, or at this temperature a little worse.
    """

    groups: int

    @property
    def solution(self) -> S_co: ...
    @property
    def cost(self) -> Any: ...
    def odds(self, random: np.random.Generator) -> Odds: ...
    def replan(self, groups: list[IntArray], random: np.random.Generator, temperature: float) -> None: ...


def search_neighbourhoods(
    planner: LowLevelPlanner[S_co],
    random: np.random.Generator,
    rounds: int,
    should_stop: Callable[[], bool],
    temperature: float = 0.0,
) -> S_co:
    """Replan neighbourhoods, so many rounds, as long as there is time; return the best solution that there has been.

    What is worse is accepted as in simulated annealing, at a temperature that falls to zero with the rounds.
    """
    best, least = planner.solution, planner.cost
    for number in range(rounds):
        if should_stop():
            break
        odds = planner.odds(random)
        groups = [odds.draw(random) for _ in range(planner.groups)]
        planner.replan(groups, random, temperature * (1 - number / rounds))
        if planner.cost < least:
            best, least = planner.solution, planner.cost
    return best
