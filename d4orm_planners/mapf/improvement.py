"""An iteration that makes the best plan so far better."""

from __future__ import annotations

from d4orm_env.core.seeds import Stream
from d4orm_env.core.trajectory import Trajectory
from d4orm_planners.base.candidate import evaluate_controls
from d4orm_planners.base.planner import Iteration
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.base.working_plan import WorkingPlan
from d4orm_planners.mapf.beams import prepare_beams
from d4orm_planners.mapf.lns import improve_paths
from d4orm_planners.mapf.roundabout import drive_roundabout

ROUNDS = 96
"""Rounds of the search in an iteration: one annealing."""
FIRST_ROUNDS = 4
"""Rounds for a plan that has just been found."""
GUIDED_ROUNDS = 8
"""The same for one that was found on a roadmap, with all its corners and stops."""
FIRST_ROBOT_STEPS = 2**19
"""Steps of all robots in these rounds together: in a large world there are fewer, for the first plan not to wait."""


def improve_by_lns(search: SolveRun) -> Iteration:
    """The best plan so far, or a roundabout if that is better, whose robots have looked for faster paths."""
    team = WorkingPlan(search, _better_roundabout(search) or search.best.trajectory)
    with search.watch.paused():
        prepare_beams(team)
    return Iteration(improve_paths(team, search.iteration_seed(Stream.NEIGHBOURHOODS), ROUNDS))


def _better_roundabout(search: SolveRun) -> Trajectory | None:
    """A roundabout in which none fails, with more reward than the best plan so far."""
    best = search.best
    for side in (1, -1):
        controls = drive_roundabout(search.problem, search.engine, side)
        if controls is None:
            continue
        candidate = evaluate_controls(search.engine, search.problem, controls)
        if candidate.rank > best.rank:
            best = candidate
    return None if best is search.best else best.trajectory


def improve_first_paths(team: WorkingPlan, rounds: int = FIRST_ROUNDS) -> None:
    """Take what faster paths there are at once for a team in which none fails, in so many rounds."""
    rounds = min(rounds, FIRST_ROBOT_STEPS // (team.problem.num_robots * team.problem.horizon))
    improve_paths(team, team.search.iteration_seed(Stream.NEIGHBOURHOODS), rounds, temperature=0.0)
