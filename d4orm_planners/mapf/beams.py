"""Paths of some robots around all others in space and time, by beam search on all cores."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from d4orm_env.core.arrays import BoolArray, FloatArray, IntArray
from d4orm_env.dynamics.robot_model import Model
from d4orm_env.engine.threads import Threads, available_cores
from d4orm_planners.base.working_plan import WorkingPlan
from d4orm_planners.engine.path_table import BLOCK
from d4orm_planners.mapf.beam import BeamRules, OtherAgents, Queries, make_beam_space
from d4orm_planners.mapf.beam_search import search_kernel
from d4orm_planners.mapf.block_drives import LANES
from d4orm_planners.mapf.motion_primitives import MotionPrimitives, Moves
from d4orm_planners.tracking.steering import Rollouts, by_model


def find_paths(
    team: WorkingPlan,
    robots: IntArray,
    blocks: ArrayLike,
    primitives: MotionPrimitives,
    rules: BeamRules,
    limits: ArrayLike = np.inf,
    others: OtherAgents | None = None,
) -> Rollouts:
    """The best paths that robots ``(R,)`` find; one that finds none does what it does, and does not arrive.

    So do those left over when the search should stop.

    Args:
        team: Plan of all.
        robots: Their numbers.
        blocks: ``(R,)`` the block of steps at whose beginning their new paths begin.
        primitives: Their motion primitives.
        rules: Rules by which paths are kept.
        limits: ``(R,)`` what a path must cost less than [s]: its time, and what it costs to meet others.
        others: Agents that they mind, or do not mind.

    Returns:
        A single path of each.
    """
    problem, horizon = team.problem, team.problem.horizon
    blocks, limits = np.broadcast_to(blocks, len(robots)), np.broadcast_to(np.asarray(limits, float), len(robots))
    if others is None:
        extra = np.zeros((len(robots), 0, horizon + 1, problem.dimension), np.float32)
        others = OtherAgents(robots[:, None], extra, np.zeros((len(robots), 0)))
    u, x = (np.ascontiguousarray(rows[:, robots].swapaxes(0, 1)) for rows in (team.controls, team.states))
    arrived = np.zeros(len(robots), bool)
    for model, members in by_model(problem):
        mine = np.flatnonzero(np.isin(robots, members))
        if len(mine):
            minded = OtherAgents(others.exclude[mine], others.extra[mine], others.radius[mine])
            queries = Queries(robots[mine], blocks[mine], x[mine, blocks[mine] * BLOCK], limits[mine], minded)
            moves = primitives.moves(problem.dimension, has_heading=model.heading_index is not None)
            u[mine], x[mine], arrived[mine] = _search(team, model, moves, rules, queries, u[mine], x[mine])
    u, x = (rows.swapaxes(0, 1)[:, :, None] for rows in (u, x))
    return Rollouts(u, x, arrived[:, None], problem.dimension)


def _search(
    team: WorkingPlan, model: Model, moves: Moves, rules: BeamRules, queries: Queries, u: FloatArray, x: FloatArray
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Controls ``(R, H, m)``, states ``(R, H+1, n)`` and arrivals of one model's robots; as given if none arrives."""
    found, search = np.zeros(len(u), bool), search_kernel(model.name)
    arrays, table = team.problem.arrays, team.index.table
    # Some searches take many times as long as others: who is done takes the next one.
    waiting = iter(range(len(u)))

    def look(_: IntArray) -> None:
        d, num_blocks = team.problem.dimension, len(table.first)
        space = make_beam_space(rules.width, len(moves.pace), num_blocks, BLOCK, x.shape[2], d, LANES)
        for number in waiting:
            if team.search.should_stop():
                break
            search(arrays, table, moves, rules, queries, np.array((number, number + 1)), space, u, x, found)

    Threads(available_cores()).over(len(u), look)
    return u, x, found


def prepare_beams(team: WorkingPlan) -> None:
    """Compile what the search of this team's paths needs, if it is not yet."""
    firsts: dict[str, int] = {model.name: robots[0] for model, robots in by_model(team.problem)}
    if not all(search_kernel(name).signatures for name in firsts):
        robots: Sequence[int] = list(firsts.values())
        team.faults(robots)
        find_paths(team, np.array(robots), 0, MotionPrimitives((90.0,), (1.0,)), BeamRules(2, 1.0, 1.0))
        team.index.move(robots, team.positions[:, robots])
