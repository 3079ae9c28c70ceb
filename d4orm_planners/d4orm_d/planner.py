"""D4orm-D: failure-aware decoupling for big teams (paper, section V, Algorithm 3)."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import numpy as np

from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.problem import Problem
from d4orm_planners.base.conflict_groups import conflicts
from d4orm_planners.base.planner import Iteration
from d4orm_planners.base.solve import Search
from d4orm_planners.d4orm_d.deformed_plan import DeformedTeam
from d4orm_planners.d4orm_d.groups import Groups
from d4orm_planners.d4orm_d.repairs import Repairs
from d4orm_planners.d4orm_d.settings import D4ormDConfig
from d4orm_planners.engine.sampling_types import SamplingTask
from d4orm_planners.mapf.improvement import FIRST_ROUNDS, GUIDED_ROUNDS, refined_iteration, shorten_first_ways
from d4orm_planners.mapf.planner import (
    Guide,
    GuidedConfig,
    better_ways,
    first_ways,
    going_on_from_best,
    guided_iteration,
)
from d4orm_planners.mapf.working_plan import TeamPaths
from d4orm_planners.sampling.d4orm import D4orm
from d4orm_planners.tracking.steering import prepare_drives, straight_drives

State = Groups | Repairs | Guide
"""What is kept between iterations, by the way of decoupling, or once ways have been found on a roadmap."""

GUIDED = GuidedConfig()
GUIDED_AFTER = 6
"""Iterations without a solution after which ways are looked for on a roadmap."""
GUIDED_TURNS = 5
"""Of so many iterations after guided ways one refines the motions, the others replan on the roadmap."""


class D4ormD(D4orm):
    """Failure-aware decoupling: replan only the robots that fail, around all others, until nobody fails."""

    name: ClassVar[str] = "d4orm-d"
    config_class = D4ormDConfig
    drives_straight: ClassVar[bool] = True
    presets: ClassVar = {
        "paper": {
            **D4orm.presets["paper"],
            # The authors' code clips the controls of robots that keep failing; the paper says nothing of it.
            "clip_between_iterations": True,
            "decoupling": "groups",
            "start": "team",
            "first_collisions": False,
            "big_team": None,
            "penalty": D4ormDConfig.penalty,  # of independent repairs, which it has not
        }
    }
    config: D4ormDConfig

    def init(self, search: Search) -> State:
        """See :meth:`Planner.init`."""
        # Here, because importing numba takes long.
        from d4orm_planners.mapf.beams import prepare_beams

        with search.watch.paused():
            prepare_drives(search.problem)
            if self.config.decoupling == "groups":
                return Groups()
            if self.config.reroute or self.config.shorten:
                prepare_beams(TeamPaths(search, search.current.trajectory))
        return Repairs.of(search.problem.num_robots)

    def iterate(self, search: Search, state: State) -> tuple[State, Iteration]:
        """See :meth:`Planner.iterate`: the whole team at first and once nobody fails, the failed robots in between."""
        if isinstance(state, Guide):
            return self.go_on_guided(search, state)
        if self.is_guided(search):
            guide = first_ways(search)
            if isinstance(guide, Guide):
                return guide, self.guided(search, guide)
        if search.iteration == 0 and not search.current.controls.any():
            drives = self.straight_start(search.problem)
            return self.whole_team(search, state) if drives is None else (state, Iteration(drives))
        if self.config.shorten and search.best.solved:
            return state, refined_iteration(search)
        if not search.current.failed.any() or (isinstance(state, Groups) and search.best.solved):
            return self.whole_team(search, state)
        team = DeformedTeam(self, search, search.current.trajectory)
        if isinstance(state, Groups):
            return state.replan(team), team.iteration()
        state = state.repair(team, self.config)
        self.shorten_first(team)
        return state, team.iteration()

    def guided(self, search: Search, guide: Guide) -> Iteration:
        """What a team does that has ways; they become a little shorter if that is all that is left to do."""
        iteration = guided_iteration(search, guide)
        if not self.config.shorten:
            return iteration
        team = DeformedTeam(self, search, search.engine.rollout(search.problem, iteration.controls))
        self.shorten_first(team, GUIDED_ROUNDS)
        return replace(iteration, controls=team.controls)

    def go_on_guided(self, search: Search, guide: Guide) -> tuple[Guide, Iteration]:
        """Better ways for a team that has some: mostly on the roadmap, and by turns by search among its motions.

        The first finds other ways round, the second cuts corners and leaves out stops.
        """
        if search.best.solved and self.config.shorten:
            if search.iteration % GUIDED_TURNS == 1:
                return guide, refined_iteration(search)
            guide = going_on_from_best(search, guide)
        guide = better_ways(search, guide, GUIDED.neighbours, GUIDED.replannings)
        return guide, guided_iteration(search, guide)

    def is_guided(self, search: Search) -> bool:
        """Whether this iteration is to find ways on a roadmap: the first, or one after some without a solution."""
        if search.iteration == 0:
            return super().is_guided(search)
        stuck = search.iteration == GUIDED_AFTER and not search.best.solved and search.problem.world.num_obstacles > 0
        return stuck and self.config.start == "auto"

    def whole_team(self, search: Search, state: State) -> tuple[State, Iteration]:
        """Deform everybody's controls at once; unless in groups, then straight home from wherever that is as good."""
        iteration = self.run(search)
        if not isinstance(state, Repairs):
            return state, iteration
        team = DeformedTeam(self, search, search.engine.rollout(search.problem, iteration.controls))
        state = state.shorten(team)
        self.shorten_first(team)
        return state, replace(iteration, controls=team.controls)

    def shorten_first(self, team: DeformedTeam, rounds: int = FIRST_ROUNDS) -> None:
        """Let the ways of a team in which nobody fails any more become shorter."""
        if self.config.shorten and not team.faults(np.arange(team.problem.num_robots))[0].any():
            shorten_first_ways(team, rounds)

    def is_patient(self, search: Search) -> bool:
        """See :meth:`D4orm.is_patient`: repairs are what helps here."""
        return False

    def num_samples(self, search: Search) -> int:
        """See :meth:`SamplingPlanner.num_samples`."""
        big = self.config.big_team is not None and search.problem.num_robots > self.config.big_team
        return max(self.config.num_samples // 2, 2) if big else self.config.num_samples

    def task(self, search: Search, base: FloatArray) -> SamplingTask:
        """See :meth:`SamplingPlanner.task`."""
        task = super().task(search, base)
        return replace(task, penalty=1.0, collisions=search.iteration > 0 or self.config.first_collisions)

    def straight_start(self, problem: Problem) -> FloatArray | None:
        """Controls ``(H, K, m)`` that send everybody straight to its goal, or ``None`` to start with the whole team."""
        if self.config.start == "team":
            return None
        drives = straight_drives(problem)
        if self.config.start == "auto":
            graph = conflicts(drives.positions[:, :, 0], problem.team.radius, problem.margin)
            # As many as when everybody meets half of the team.
            if 2 * sum(map(len, graph)) >= problem.num_robots**2:
                return None
        return drives.controls[:, :, 0]
