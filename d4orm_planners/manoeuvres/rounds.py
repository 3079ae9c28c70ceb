"""Rounds in which a team's motions are found and improved, a neighbourhood of robots at a time."""

from __future__ import annotations

import numpy as np

from d4orm_env.core.problem import Problem
from d4orm_env.core.seeds import Stream
from d4orm_env.core.team import Team
from d4orm_env.core.world import World
from d4orm_env.dynamics.models import MODELS
from d4orm_env.footprints import Box
from d4orm_planners.base.planner import Iteration
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.manoeuvres.closing import GapSpace, ends_of, gap_closer
from d4orm_planners.manoeuvres.coming_to_rest import come_to_rest
from d4orm_planners.manoeuvres.curves import NO_CURVES
from d4orm_planners.manoeuvres.nodes import AHEAD
from d4orm_planners.manoeuvres.primitives import POSE_SIZE
from d4orm_planners.manoeuvres.robots import make_goal
from d4orm_planners.manoeuvres.search import curve_from, find_motion
from d4orm_planners.manoeuvres.team import TeamMotions
from d4orm_planners.mapf.lns import search_neighbourhoods

ROUNDS, FIRST_ROUNDS, FIRST_PER_ROBOT = 400, 50, 4
"""Neighbourhoods that are replanned to find a motion for everybody; the most at first, and of a small team so many for
each robot. From then on every other one has late departures, and every other one detours, where robots have to let each
other by somewhere that is on nobody's way: which of them leads on is not known."""
BETTER_ROUNDS = 16  #: Neighbourhoods that are replanned in an iteration once everybody has one


def compile_manoeuvres(models: tuple[str, ...]) -> None:
    """Compile what such a team needs, if it is not yet: all but the gap closer is the same for all models."""
    if not find_motion.signatures:
        _compile_search()
    for model in (MODELS[name] for name in sorted({*models}) if not gap_closer(name).signatures):
        n, m = model.state_size, model.control_size
        problem = Problem(Team((model.name,)), np.zeros((1, n)), [[1.0, 0.0]])
        ends = ends_of(problem, 0, make_goal(problem, 0), np.zeros(POSE_SIZE))
        gap_closer(model.name)(ends, np.zeros((1, m)), 0, GapSpace.of(1, n, m))


def _compile_search() -> None:
    start = np.array([[0.0, 0.0, 1.0], [0.0, 2.0, 1.0]])
    team, world = Team(("unicycle",) * 2, footprint=Box(0.4, 0.2)), World(boxes=[[0.5, 0.8, 0.6, 1.2]])
    problem = Problem(team, start, [[1.0, 0.0], [1.0, 2.0]], world, goal_heading=0.0)
    motions = TeamMotions.prepared(problem, lambda: False)
    assert motions is not None
    motions.plan_all()
    motions.shorten([0], np.random.default_rng(0))
    curve_from(NO_CURVES, motions.robots[0].task.goal, 0.0, 0.0, 0.0, AHEAD)


def find_manoeuvres(search: SolveRun) -> TeamMotions | None:
    """Motions of the whole team, or of some robots if time is up; ``None`` if not all have one in the end."""
    with search.watch.paused():
        compile_manoeuvres(search.problem.team.models)
    at_rest = come_to_rest(search.problem, search.engine)
    motions = None if at_rest is None else TeamMotions.prepared(at_rest[1], search.should_stop, before=at_rest[0])
    if motions is None:
        return None
    motions.plan_all()
    if not _complete(search, motions):
        return motions if search.should_stop() else None
    # Once more, for those that were in others' way are so no longer.
    random, robots = np.random.default_rng(search.iteration_seed(Stream.SHORTENING)), range(len(motions.robots))
    motions.shorten([*robots, *robots], random)
    return motions


def _complete(search: SolveRun, motions: TeamMotions) -> bool:
    """Replan neighbourhoods of robots without a motion until there are none; return whether that is so."""
    random = np.random.default_rng(search.iteration_seed(Stream.NEIGHBOURHOODS))
    first = min(FIRST_ROUNDS, FIRST_PER_ROBOT * len(motions.robots))
    for number in range(ROUNDS):
        if not motions.missing or search.should_stop():
            break
        motions.late, motions.detours = number >= first and number % 2 == 0, number >= first and number % 2 == 1
        search_neighbourhoods(motions, random, 1, search.should_stop)
    motions.late = motions.detours = False
    return not motions.missing


def improve_manoeuvres(search: SolveRun, motions: TeamMotions) -> Iteration:
    """The team's controls, after robots whose motions fail have new ones, or else some have looked for faster ones."""
    motions.leave_out(np.flatnonzero(search.current.unsolved).tolist())
    if motions.missing:
        _complete(search, motions)
        return Iteration(motions.controls())
    random = np.random.default_rng(search.iteration_seed(Stream.NEIGHBOURHOODS))
    search_neighbourhoods(motions, random, BETTER_ROUNDS, search.should_stop)
    return Iteration(motions.controls())
