"""D4orm-D: failure-aware decoupling for big teams (paper, section V, Algorithm 3).

Robots that fail are replanned as the paper or its authors' code does (:mod:`~d4orm_planners.d4orm_d.decoupling`); by
default they are repaired independently (:mod:`~d4orm_planners.d4orm_d.repairs`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.problem import Problem
from d4orm_planners.base.conflict_groups import conflicts
from d4orm_planners.base.planner import Iteration
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.d4orm_d.decoupling import GroupRuns, JointRun
from d4orm_planners.d4orm_d.repairs import DeformedPlan, Repairs
from d4orm_planners.d4orm_d.settings import D4ormDConfig
from d4orm_planners.engine.sampling_types import SamplingTask
from d4orm_planners.sampling.d4orm import AUTHORS_DEFORMATION, PAPER_DEFORMATION, DeformingPlanner
from d4orm_planners.tracking.steering import prepare_drives, straight_drives

State = GroupRuns | JointRun | Repairs
"""State between iterations, by the kind of decoupling."""


class D4ormD(DeformingPlanner):
    """Failure-aware decoupling: replan only the robots that fail, around all others, until none fails."""

    name: ClassVar[str] = "d4orm-d"
    config_class = D4ormDConfig
    drives_straight: ClassVar[bool] = True
    presets: ClassVar = {
        "paper": {
            **PAPER_DEFORMATION,
            # The authors' code clips the controls of robots that keep failing; the paper says nothing of it.
            "clip_between_iterations": True,
            "decoupling": "groups",
            "start": "team",
            "first_collisions": False,
            "big_team": None,
        },
        "authors": {
            **AUTHORS_DEFORMATION,
            "decoupling": "joint",
            "start": "team",
            "first_collisions": False,
            "big_team": None,
            "penalty_rise": 0.5,
            "reset_after_probe": True,
            "clip_after": 6,
        },
    }
    config: D4ormDConfig

    def init(self, search: SolveRun) -> State:
        with search.watch.paused():
            prepare_drives(search.problem)
        num_robots, config = search.problem.num_robots, self.config
        if config.decoupling == "joint":
            resets = config.reset_after_probe and not search.current.controls.any()
            return JointRun.of(num_robots, config.penalty, resets)
        return GroupRuns() if config.decoupling == "groups" else Repairs.of(num_robots)

    def iterate(self, search: SolveRun, state: State) -> tuple[State, Iteration]:
        """See :meth:`Planner.iterate`: the whole team at first and once none fails, the failed robots in between."""
        if search.iteration == 0 and not search.current.controls.any():
            drives = self.straight_start(search.problem)
            return self.whole_team(search, state) if drives is None else (state, Iteration(drives))
        if not isinstance(state, Repairs):
            return self.replan(search, state)
        if not search.current.unsolved.any():
            return self.whole_team(search, state)
        team = DeformedPlan(self, search, search.current.trajectory, search.current.report)
        return state.repair(team, self.config), team.iteration()

    def replan(self, search: SolveRun, state: GroupRuns | JointRun) -> tuple[State, Iteration]:
        """Replan the groups that fail, in turn or in one run, or once there was a solution the whole team."""
        if search.best.solved or not search.current.unsolved.any():
            return self.whole_team(search, state)
        if isinstance(state, JointRun):
            return state.replan(self, search)
        team = DeformedPlan(self, search, search.current.trajectory, search.current.report)
        state, iteration = state.replan(team), team.iteration()
        return state, replace(iteration, controls=self.braking(search, iteration.controls))

    def whole_team(self, search: SolveRun, state: State) -> tuple[State, Iteration]:
        """Deform all controls at once; unless in groups, then straight to the goals from wherever that is as good."""
        iteration = self.run(search)
        if not isinstance(state, Repairs):
            return state, iteration
        team = DeformedPlan(self, search, search.engine.rollout(search.problem, iteration.controls))
        return state.improve(team), replace(iteration, controls=team.controls)

    def is_big(self, problem: Problem) -> bool:
        """Check whether the team is a big one."""
        return self.config.big_team is not None and problem.num_robots > self.config.big_team

    def num_samples(self, search: SolveRun) -> int:
        return max(self.config.num_samples // 2, 2) if self.is_big(search.problem) else self.config.num_samples

    def task(self, search: SolveRun, base: FloatArray) -> SamplingTask:
        task = super().task(search, base)
        # Only a first plan may ignore collisions, to find out which robots meet; later ones keep robots apart.
        from_zero = search.iteration == 0 and not base.any()
        if self.config.first_collisions or not from_zero:
            return task
        # Robots that do not meet are groups of their own, which joint runs weight by.
        return replace(task, collisions=False, credit="robot" if self.config.decoupling == "joint" else task.credit)

    def straight_start(self, problem: Problem) -> FloatArray | None:
        """Controls ``(H, K, m)`` that send all straight to their goals, or ``None`` to start with the whole team."""
        if self.config.start == "auto":
            return straight_if_sparse(problem) if self.is_big(problem) else None
        return straight_drives(problem).controls[:, :, 0] if self.config.start == "straight" else None


def straight_if_sparse(problem: Problem) -> FloatArray | None:
    """Controls ``(H, K, m)`` straight to the goals; ``None`` where robots would meet half of the others on average."""
    drives = straight_drives(problem)
    graph = conflicts(drives.positions[:, :, 0], problem.team.radius, problem.margin)
    return None if 2 * sum(map(len, graph)) >= problem.num_robots**2 else drives.controls[:, :, 0]
