"""Algorithm 3: robots that conflict are replanned together, group by group (paper, section V)."""

from __future__ import annotations

from dataclasses import dataclass

from d4orm_planners.base.conflict_groups import Grouping, conflicts, failure_groups, regrouped
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.d4orm_d.deformed_plan import DeformedPlan


@dataclass(frozen=True, eq=False)
class Groups:
    """The state of the search by groups.

    Attributes:
        grouping: Groups of the last iteration by groups, or ``None`` before the first.
    """

    grouping: Grouping | None = None

    def replan(self, team: DeformedPlan) -> Groups:
        """Replan every group with a failed robot in turn, the robots outside it as moving obstacles."""
        planner, search, problem = team.planner, team.search, team.problem
        grouping = grouping_of(search, self.grouping)
        team.controls = planner.config.continued(search.current).copy()
        for group in failure_groups(search.current.unsolved, grouping.groups):
            if search.should_stop():
                break
            robots = list(group)
            _, controls, trajectory = team.deformed(
                robots, problem.horizon, planner.config.num_samples, planner.noise_scale(), credit="team"
            )
            team.move(robots, controls, trajectory.states, trajectory.arrived[-1])
        return Groups(grouping)


def grouping_of(search: SolveRun, previous: Grouping | None) -> Grouping:
    """Return the groups of the present candidate, at the steps that are checked."""
    problem, positions = search.problem, search.current.trajectory.positions
    graph = conflicts(positions[:: search.check_interval], problem.team.radius, problem.margin)
    return regrouped(graph, previous)
