"""Algorithm 3: robots that conflict are replanned together, group by group (paper, section V)."""

from __future__ import annotations

from dataclasses import dataclass

from d4orm_env.core.arrays import BoolArray
from d4orm_planners.d4orm_d.team import TeamPaths
from d4orm_planners.grouping import failure_groups, reconnected


@dataclass(frozen=True, eq=False)
class Groups:
    """The state of the search by groups.

    Attributes:
        graph: ``(K, K)`` conflicts before the last iteration by groups, or ``None`` before the first.
    """

    graph: BoolArray | None = None

    def replan(self, team: TeamPaths) -> Groups:
        """Replan every group with a failed robot in turn, the robots outside it as moving obstacles."""
        planner, search = team.planner, team.search
        team.controls = planner.config.continued(search.current).copy()
        for group in failure_groups(search.current.failed, reconnected(team.graph, self.graph)):
            if search.should_stop():
                break
            robots = list(group)
            part, controls, trajectory = team.deformed(
                robots, team.problem.horizon, planner.config.num_samples, planner.noise_scale(), credit="team"
            )
            team.controls[:, robots, : part.control_size] = controls
            team.positions[:, robots] = trajectory.positions
        return Groups(team.graph)
