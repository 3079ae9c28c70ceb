"""Beam search of robots' paths in space and time among the known paths of all others, compiled with numba.

A path is made of pieces of a block of steps each, in which the robot heads for its goal, faster or slower, stops, or
turns off by some angle. After every block the most promising of the paths so far are kept.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from d4orm_env.core.arrays import BoolArray, FloatArray, IntArray, Whole
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.dynamics.models import MODELS
from d4orm_env.dynamics.robot_model import Model, TimeStep
from d4orm_env.engine.borrowing import borrow
from d4orm_env.engine.caching import Kernel, cached_kernel
from d4orm_env.engine.compiling import WITHOUT_ARRAYS, inlined, to_fixed_tuple
from d4orm_env.engine.elementary import OPS
from d4orm_env.engine.simd import TILE
from d4orm_env.engine.stepping import Row, models_key
from d4orm_env.engine.threads import Threads, available_cores
from d4orm_planners.base.working_plan import WorkingPlan
from d4orm_planners.engine.path_table import BLOCK, PathTable, find_nearby, steps_of
from d4orm_planners.mapf.beam import (
    BeamRules,
    BeamSpace,
    Branches,
    OtherAgents,
    Queries,
    count_met,
    count_passing,
    is_like_another,
    keep,
    make_beam_space,
    sink,
    trace_back,
)
from d4orm_planners.mapf.block_drives import (
    LANES,
    block_driver,
    count_faults,
    enclose_lanes,
    end_of,
    has_arrived,
    read_positions,
    read_state,
)
from d4orm_planners.mapf.motion_primitives import MotionPrimitives, Moves, aiming, frame_at
from d4orm_planners.tracking.steering import Rollouts, by_model
from d4orm_planners.tracking.tracker import tracker

Ending: TypeAlias = tuple[float, Whole, Whole]
"""Cost of the best path that arrives [s], the path that it goes on from, and its last move; -1 if there is none."""


@inlined
def _count_next(
    arrays: ProblemArrays, table: PathTable, queries: Queries, r: int, new: Branches, node: Whole, block: Whole
) -> float:
    """Faults of a path by itself in the block and, unless there are some, or it was counted, robots that it meets."""
    robot, (begin, end), faults = queries.robots[r], steps_of(table, block), 0.0
    read_positions(node % TILE, end - begin, new.lanes[node // TILE], new.path)
    if not new.counted[node, 0]:
        faults, new.counted[node, 0] = count_faults(arrays, robot, end - begin, end, new.path), True
    if faults == 0.0:
        faults = float(count_met(table, queries, r, new.nearby, new.path, block))
        new.counted[node, 1] = True
    return faults


@inlined
def _count_to_end(
    arrays: ProblemArrays, table: PathTable, rules: BeamRules, queries: Queries, r: int, new: Branches, node: Whole,
    block: Whole, faults: float, best: float,
) -> float:  # fmt: skip
    """The faults of a path that arrives in the block, so many before; fewer where it costs more than the best."""
    robot, (begin, end), cost = queries.robots[r], steps_of(table, block), new.costs[node]
    lane, lanes = node % TILE, new.lanes[node // TILE]
    read_positions(lane, end - begin, lanes, new.path)
    faults += count_faults(arrays, robot, end - begin, end_of(lane, lanes), new.path)
    if rules.contact * faults + cost >= best:
        return faults
    # It stays there: whoever comes by later counts too.
    faults += count_met(table, queries, r, new.nearby, new.path, block)
    left = best - (rules.contact * faults + cost)
    return faults + count_passing(table, queries, r, new.path, block, rules.contact, left)


@inlined
def _keep_best(
    arrays: ProblemArrays, table: PathTable, moves: Moves, rules: BeamRules, queries: Queries, r: int,
    space: BeamSpace, count: Whole, block: Whole, best: float,
) -> Whole:  # fmt: skip
    """Keep the most promising of ``count`` paths, of those that are alike the better one; return how many.

    Most are worse than those kept whatever they touch or meet. So that is counted of one only when its turn comes,
    which then comes again.
    """
    beam, new, heap = space.beam, space.new, space.new.heap
    num_moves, dedup2 = moves.pace.shape[0], rules.dedup_distance * rules.dedup_distance
    root = size = np.int64(0)  # literals would compile what they are passed to once more
    for number in range(space.before.shape[0]):
        space.before[number] = beam.numbers[number]
    for position in range(count // 2 - 1, -1, -1):
        sink(new.bounds, heap, position, count)
    while size < space.before.shape[0] and count > 0 and new.bounds[heap[0]] < best:
        node = heap[0]
        lane, lanes = node % TILE, new.lanes[node // TILE]
        read_state(lane, lanes, beam.states[size], beam.motions[size])
        alike, faults = is_like_another(beam, new.apart[node], size, dedup2), 0.0
        new.apart[node] = size
        if not alike and not new.counted[node, 1]:
            faults = _count_next(arrays, table, queries, r, new, node, block)
        if faults == 0.0:
            count -= 1
            heap[0] = heap[count]
            if not alike:
                keep(beam, size, new.faults[node], space.before[node // num_moves], node % num_moves, space.ever)
                size += 1
        else:
            new.faults[node] += faults
            new.bounds[node] = rules.contact * new.faults[node] + new.costs[node]
        sink(new.bounds, heap, root, count)
    return size


def _move_follower(model: Model) -> Callable[..., int]:
    """Function that drives a robot along the moves of a path."""
    approach, (aim_of, slowed) = inlined(model.functions.approach), aiming(model)

    @inlined
    def by_moves(
        reference: tuple[Moves, IntArray, int, FloatArray, np.float32, FloatArray],
        aim: Row, step: int, state: Row, at: Row, limits: Row, h: TimeStep,
    ) -> tuple[Row, Row, bool]:  # fmt: skip
        moves, did, begin, goal, goal_radius, states = reference
        block = step // BLOCK - begin
        number = did[did.shape[0] - 1 - block] if block < did.shape[0] else 0
        if step % BLOCK == 0:
            aim = aim_of(frame_at(states[step], goal), state, limits, goal, goal_radius, moves, number)
        return slowed(approach(state, aim, limits, h, OPS), moves.pace[number]), aim, True

    return tracker(model, by_moves)


def _path_grower(model: Model) -> Callable[..., tuple[Whole, Ending]]:
    """Function that continues every path by every move for a block: how many are new, and the best that arrives."""
    drive_block, d = block_driver(model), model.dimension

    @inlined
    def grow_paths(
        arrays: ProblemArrays, table: PathTable, moves: Moves, rules: BeamRules, queries: Queries, r: int,
        space: BeamSpace, size: Whole, block: Whole, ending: Ending,
    ) -> tuple[Whole, Ending]:  # fmt: skip
        beam, new, num_moves = space.beam, space.new, moves.pace.shape[0]
        robot, (begin, end), total = queries.robots[r], steps_of(table, block), size * num_moves
        for first in range(0, total, TILE):
            together, lanes, costs = min(TILE, total - first), new.lanes[first // TILE], new.costs[first : first + TILE]
            drive_block(arrays, robot, moves, beam, first, together, begin, end - begin, lanes, costs)
        box = enclose_lanes(d, total, new.lanes)
        find_nearby(table, robot, queries.others.exclude[r], box, block, new.nearby)
        count, (best, best_number, best_move) = np.int64(0), ending
        for node in range(total):
            faults, cost = beam.faults[node // num_moves], new.costs[node]
            if rules.contact * faults + cost >= best:
                continue
            if has_arrived(node % TILE, new.lanes[node // TILE]):
                faults = _count_to_end(arrays, table, rules, queries, r, new, node, block, faults, best)
                if rules.contact * faults + cost < best:
                    best, best_number = rules.contact * faults + cost, beam.numbers[node // num_moves]
                    best_move = node % num_moves
                continue
            new.heap[count], new.counted[node, 0], new.counted[node, 1], new.apart[node] = node, False, False, 0
            new.faults[node], new.bounds[node] = faults, rules.contact * faults + cost
            count += 1
        return count, (best, best_number, best_move)

    return grow_paths


Search: TypeAlias = Kernel[
    [ProblemArrays, PathTable, Moves, BeamRules, Queries, int, BeamSpace, FloatArray, FloatArray, BoolArray], None
]
"""A kernel of :func:`search_kernel`."""


@cache
def search_kernel(name: str) -> Search:
    """The compiled search for robots of the model with this name.

    For query ``r`` it fills controls ``u`` ``(R, H, m)`` and states ``x`` ``(R, H+1, n)`` from where its path begins,
    and says in ``found`` ``(R,)`` whether a path arrives; if none does, the rest is left alone.
    """
    model = MODELS[name]
    grow_paths, follow = _path_grower(model), _move_follower(model)
    n, d = model.state_size, model.dimension

    @cached_kernel(variant=name, key=models_key((name,)), **WITHOUT_ARRAYS)
    def search(
        arrays: ProblemArrays, table: PathTable, moves: Moves, rules: BeamRules, queries: Queries, r: int,
        space: BeamSpace, u: FloatArray, x: FloatArray, found: BoolArray,
    ) -> None:  # fmt: skip
        arrays, table, moves = borrow(arrays), borrow(table), borrow(moves)
        queries, space = borrow(queries), borrow(space)
        zero: Whole = np.int64(0)  # a literal would compile what it is passed to once more
        for i in range(n):
            space.beam.states[0, i] = queries.states[r, i]
        space.beam.faults[0], space.beam.numbers[0], size, space.ever.used[0] = 0.0, -1, zero + 1, 0
        ending = (queries.limits[r], zero - 1, zero - 1)
        for block in range(queries.blocks[r], table.first.shape[0]):
            count, ending = grow_paths(arrays, table, moves, rules, queries, r, space, size, block, ending)
            size = _keep_best(arrays, table, moves, rules, queries, r, space, count, block, ending[0])
            if size == 0:
                break
        _, number, move = ending
        found[r] = move >= 0
        if found[r]:
            length = trace_back(space.ever, number, move, space.did)
            robot, begin, start = queries.robots[r], queries.blocks[r], queries.blocks[r] * BLOCK
            state, goal = to_fixed_tuple(queries.states[r], n), arrays.goal[robot]
            for i in range(n):
                x[r, start, i] = state[i]
            goal_radius = np.sqrt(arrays.squared_goal_radius)
            reference = (moves, space.did[:length], begin, goal, goal_radius, x[r])
            follow(arrays, robot, reference, to_fixed_tuple(goal, d), start, state, False, u[r], x[r])

    return search


def find_paths(
    team: WorkingPlan,
    robots: IntArray,
    blocks: ArrayLike,
    primitives: MotionPrimitives,
    rules: BeamRules,
    limits: ArrayLike = np.inf,
    others: OtherAgents | None = None,
) -> Rollouts:
    """The single best path that each of robots ``(R,)`` finds, or what it does, without arriving, for one that finds
    none.

    So do those left over when the search should stop. Paths are new from the beginning of ``blocks`` ``(R,)`` of steps
    on, and must cost less than ``limits`` ``(R,)`` [s]: their time, and what it costs to meet ``others``.
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
        space = make_beam_space(rules.width, len(moves.pace), num_blocks, x.shape[2], d, LANES, team.problem.num_robots)
        for number in waiting:
            if team.search.should_stop():
                break
            search(arrays, table, moves, rules, queries, number, space, u, x, found)

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
