"""Algorithm 3: robots that conflict are replanned together, group by group (paper, section V)."""

from __future__ import annotations

from dataclasses import dataclass

from d4orm_planners.base.conflict_groups import Graph, conflicts, failure_groups, reconnected
from d4orm_planners.d4orm_d.deformed_plan import DeformedPlan


@dataclass(frozen=True, eq=False)
class Groups:
    """The state of the search by groups.

    Attributes:
        graph: Conflicts before the last iteration by groups, or ``None`` before the first.
    """

    graph: Graph | None = None

    def replan(self, team: DeformedPlan) -> Groups:
        """Replan every group with a failed robot in turn, the robots outside it as moving obstacles."""
        planner, search, problem = team.planner, team.search, team.problem
        checked = search.current.trajectory.positions[:: search.check_interval]
        graph = conflicts(checked, problem.team.radius, problem.margin)
        team.controls = planner.config.continued(search.current).copy()
        for group in failure_groups(search.current.unsolved, reconnected(graph, self.graph)):
            if search.should_stop():
                break
            robots = list(group)
            _, controls, trajectory = team.deformed(
                robots, problem.horizon, planner.config.num_samples, planner.noise_scale(), credit="team"
            )
            team.move(robots, controls, trajectory.states, trajectory.arrived[-1])
        return Groups(graph)
