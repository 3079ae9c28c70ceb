"""Path finding on a roadmap, driven by precedence and made better robot by robot: no sampling at all."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from d4orm_env.core.problem import Problem
from d4orm_env.core.seeds import Stream
from d4orm_planners.planner import Iteration, Planner, PlannerConfig
from d4orm_planners.search import Search
from d4orm_planners.settings import Count

if TYPE_CHECKING:
    from d4orm_planners.guidance.roadmap import Roadmap
    from d4orm_planners.guidance.team import Driven, Replanning

FINENESS = (1.6, 1.25, 1.0, 2.2, 3.0)
"""How fine the roadmaps are that are tried; see :func:`~d4orm_planners.guidance.roadmap.lay_roadmap`."""
TURNS = 30
"""Ways that are planned per robot before path finding for all at once is tried."""
STEPS = 3000
"""Steps of path finding for all at once after which the next roadmap is tried."""


@dataclass(frozen=True, kw_only=True)
class GuidedConfig(PlannerConfig):
    """Settings of path finding.

    Attributes:
        neighbours: Robots that are replanned together, at most.
        replannings: Groups of robots that are replanned in an iteration.
    """

    max_iterations: Count = 1000
    neighbours: Count = 8
    replannings: Count = 8


@dataclass(frozen=True, eq=False)
class Guide:
    """The state of the search.

    Attributes:
        roadmap: What ways are found on.
        replanning: What makes them better.
        driven: How the team drives on them.
    """

    roadmap: Roadmap
    replanning: Replanning
    driven: Driven


class Guided(Planner):
    """Path finding for the team on a roadmap (LaCAM, PIBT), driven under the robots' dynamics by precedence."""

    name: ClassVar[str] = "guided"
    config_class = GuidedConfig
    config: GuidedConfig

    def init(self, search: Search) -> Guide | None:
        """See :meth:`Planner.init`."""
        with search.watch.paused():
            compile_guidance(search.problem)
        return None

    def iterate(self, search: Search, state: Guide | None) -> tuple[Guide | None, Iteration]:
        """See :meth:`Planner.iterate`: first ways for the whole team, then better ones for some robots at a time."""
        if state is None:
            state = first_ways(search)
            if state is None:
                return None, Iteration(search.current.controls, note="no way found on the roadmap")
        else:
            state = self.better_ways(search, state)
        return state, Iteration(state.driven.until(search.problem.horizon))

    def better_ways(self, search: Search, state: Guide) -> Guide:
        """Replan some groups of robots; what is no better for all together is left."""
        random = np.random.default_rng(search.iteration_seed(Stream.GUIDANCE))
        replanning, driven = state.replanning, state.driven
        for _ in range(self.config.replannings):
            if search.should_stop():
                break
            robots = replanning.neighbours(driven, random, self.config.neighbours)
            driven = replanning.better(driven, robots) or driven
        return replace(state, driven=driven)


def first_ways(search: Search) -> Guide | None:
    """Ways for the whole team, or as many robots as possible; ``None`` if nothing is found before time is up.

    Raises:
        ValueError: If a robot has no way even by itself; the message names it.
    """
    from d4orm_planners.guidance.lacam import find_moves
    from d4orm_planners.guidance.roadmap import lay_roadmap
    from d4orm_planners.guidance.team import Replanning, drive_moves

    problem, best = search.problem, None
    random = np.random.default_rng(search.iteration_seed(Stream.GUIDANCE))
    for number, fineness in enumerate(FINENESS):
        roadmap = lay_roadmap(problem, fineness)
        replanning = Replanning(problem, roadmap)
        if not np.isfinite(replanning.alone).all():
            if number == 0:
                problem.check_reachable()
            continue
        driven = replanning.one_by_one(random, search.should_stop, TURNS * problem.num_robots)
        if driven is not None:
            return Guide(roadmap, replanning, driven)
        seed = search.iteration_seed(Stream.GUIDANCE, number + 1)
        found = find_moves(problem, roadmap, seed, search.should_stop, STEPS)
        if found is not None and (best is None or found.arrived.sum() > best[1].arrived.sum()):
            best = Guide(roadmap, replanning, drive_moves(problem, roadmap, found.moves)), found
        if search.should_stop() or (found is not None and found.arrived.all()):
            break
    return best and best[0]


def compile_guidance(problem: Problem) -> None:
    """Compile what path finding for such a team in such a world needs, if it is not yet."""
    from d4orm_planners.guidance.roadmap import lay_roadmap
    from d4orm_planners.guidance.lacam import find_moves
    from d4orm_planners.guidance.team import Replanning, drive_moves, is_compiled

    if is_compiled(problem):
        return
    for robot in {model: number for number, model in enumerate(problem.team.models)}.values():
        alone = problem.select([robot])
        roadmap = lay_roadmap(alone)
        found = find_moves(alone, roadmap, 0, lambda: False, STEPS)
        if found is not None:
            driven = drive_moves(alone, roadmap, found.moves)
            Replanning(alone, roadmap).better(driven, np.zeros(1, np.int64))
