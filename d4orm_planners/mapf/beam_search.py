"""Beam search of one robot's path in space and time among the known paths of all others, compiled with numba.

A path is made of pieces of a block of steps each, in which the robot heads for its goal, faster or slower, stops, or
turns off by some angle. After every block the most promising of the paths so far are kept.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import TypeAlias

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray, IntArray, Whole
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.dynamics.models import MODELS
from d4orm_env.dynamics.robot_model import Model, TimeStep
from d4orm_env.engine.borrowing import borrow
from d4orm_env.engine.caching import Kernel, cached_kernel
from d4orm_env.engine.compiling import WITHOUT_ARRAYS, compiled, inlined, to_fixed_tuple
from d4orm_env.engine.elementary import OPS
from d4orm_env.engine.simd import TILE
from d4orm_env.engine.stepping import Row, models_key
from d4orm_planners.engine.path_table import BLOCK, PathTable, count_near, steps_of
from d4orm_planners.mapf.beam import (
    Beam,
    BeamRules,
    BeamSpace,
    OtherAgents,
    Queries,
    is_like_another,
    keep,
    sink,
    trace_back,
)
from d4orm_planners.mapf.block_drives import block_driver, count_faults, end_of, path_reader, read_positions
from d4orm_planners.mapf.motion_primitives import Moves, aiming, frame_at
from d4orm_planners.tracking.tracker import tracker

Ending: TypeAlias = tuple[float, Whole, Whole]
"""Cost of the best path that arrives [s], the path that it goes on from, and its last move; -1 if there is none."""


@compiled
def _count_extra(
    table: PathTable, robot: Whole, others: OtherAgents, r: int, path: FloatArray, first: Whole, last: Whole
) -> int:
    """Count the extra paths that a path meets from one step to another; at its end it is at rest."""
    count, end = 0, path.shape[0] - 1
    for other in range(others.extra.shape[1]):
        safety_distance = table.radius[robot] + others.radius[r, other] + table.margin
        for t in range(first, last):
            gap2 = 0.0
            for axis in range(path.shape[1]):
                position = np.float64(path[min(t - first, end), axis])
                gap = position - np.float64(others.extra[r, other, t, axis])
                gap2 += gap * gap
            if gap2 <= safety_distance * safety_distance:
                count += 1
                break
    return count


@compiled
def _count_met(table: PathTable, queries: Queries, r: int, path: FloatArray, block: Whole) -> int:
    """Count the robots that a path meets in a block."""
    robot, (first, last) = queries.robots[r], steps_of(table, block)
    count = count_near(table, robot, queries.others.exclude[r], path, first, block)
    return count + _count_extra(table, robot, queries.others, r, path, first, last)


@inlined
def _keep_best(
    space: BeamSpace,
    count: Whole,
    best: float,
    rules: BeamRules,
    arrays: ProblemArrays,
    table: PathTable,
    queries: Queries,
    r: int,
    block: Whole,
) -> Whole:
    """Keep the most promising of ``count`` paths, of those that are alike the better one; return how many.

    Most are worse than those kept whatever they touch or meet. So that is counted of one only when its turn comes,
    which then comes again.
    """
    new, heap, counted, numbers = space.new, space.heap, space.counted, space.numbers
    robot, (begin, end) = queries.robots[r], steps_of(table, block)
    dedup2 = rules.dedup_distance * rules.dedup_distance
    root = size = np.int64(0)  # literals would compile what they are passed to once more
    for node in range(count):
        heap[node], counted[node, 0], counted[node, 1] = node, False, False
    for position in range(count // 2 - 1, -1, -1):
        sink(new.bounds, heap, position, count)
    while size < numbers.shape[0] and count > 0 and new.bounds[heap[0]] < best:
        node = heap[0]
        alike = is_like_another(new, node, space.beam, size, dedup2)
        if alike or counted[node, 1]:
            count -= 1
            heap[0] = heap[count]
            if not alike:
                keep(new, node, space.beam, size, numbers, space.ever)
                size += 1
        else:
            faults = 0.0
            if not counted[node, 0]:
                faults, counted[node, 0] = count_faults(arrays, robot, end - begin, end, new.paths[node]), True
            if faults == 0.0:
                faults, counted[node, 1] = float(_count_met(table, queries, r, new.paths[node], block)), True
            new.faults[node] += faults
            new.bounds[node] = rules.contact * new.faults[node] + new.costs[node]
        sink(new.bounds, heap, root, count)
    return size


@compiled
def _count_passing(
    table: PathTable, robot: Whole, others: OtherAgents, r: int, path: FloatArray, block: Whole, last_busy: Whole
) -> int:
    """Count the robots that come by after a block that ended at the goal, where this one stays; ``path`` is changed."""
    first, last = steps_of(table, block)
    for row in range(path.shape[0]):
        for axis in range(path.shape[1]):
            path[row, axis] = path[last - first - 1, axis]
    count = 0
    for later in range(block + 1, last_busy + 1):
        count += count_near(table, robot, others.exclude[r], path, steps_of(table, later)[0], later)
    return count + _count_extra(table, robot, others, r, path, last, len(table.positions))


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


@inlined
def _add_path(new: Beam, at: Whole, state: Row, velocity: Row, cost: float, bound: float, faults: float) -> None:
    for axis in range(len(velocity)):
        new.velocities[at, axis] = velocity[axis]
    for i in range(len(state)):  # a mixed team's rows may be longer
        new.states[at, i] = state[i]
    new.costs[at], new.bounds[at], new.faults[at] = cost, bound, faults


def _path_grower(model: Model) -> Callable[..., tuple[Whole, Ending]]:
    """Function that goes on from every path in the beam by every move for a block: how many paths are new, and the best
    one that arrives.
    """
    drive_block, read_path = block_driver(model), path_reader(model)

    @inlined
    def grow_paths(
        arrays: ProblemArrays, table: PathTable, moves: Moves, rules: BeamRules, queries: Queries, r: int,
        space: BeamSpace, size: Whole, block: Whole, ending: Ending,
    ) -> tuple[Whole, Ending]:  # fmt: skip
        beam, new, numbers, lanes = space.beam, space.new, space.numbers, space.lanes
        robot, (begin, end), last_busy = queries.robots[r], steps_of(table, block), _last_busy(table)
        count, num_moves = np.int64(0), moves.pace.shape[0]
        best, best_number, best_move = ending
        for first in range(0, size * num_moves, TILE):
            together = min(TILE, size * num_moves - first)
            drive_block(arrays, robot, moves, beam, first, together, end - begin, lanes)
            for lane in range(together):
                node, number = (first + lane) // num_moves, (first + lane) % num_moves
                state, velocity, at_goal, cost = read_path(arrays, robot, lane, begin, lanes)
                if rules.contact * beam.faults[node] + cost >= best:
                    continue
                path, faults = new.paths[count], beam.faults[node]
                read_positions(lane, end - begin, lanes, path)
                if at_goal:
                    faults += count_faults(arrays, robot, end - begin, end_of(lane, lanes), path)
                    if rules.contact * faults + cost >= best:
                        continue
                    # It stays there: whoever comes by later counts too.
                    faults += _count_met(table, queries, r, path, block)
                    faults += _count_passing(table, robot, queries.others, r, path, block, last_busy)
                    if rules.contact * faults + cost < best:
                        best, best_number, best_move = rules.contact * faults + cost, numbers[node], number
                    continue
                _add_path(new, count, state, velocity, cost, rules.contact * faults + cost, faults)
                new.before[count], new.moves[count] = numbers[node], number
                count += 1
        return count, (best, best_number, best_move)

    return grow_paths


@inlined
def _last_busy(table: PathTable) -> Whole:
    """Number of the last block in which anybody moves, or the one after it."""
    return min(table.first.shape[0] - 1, table.moving[0] + 1)


Search: TypeAlias = Kernel[
    [ProblemArrays, PathTable, Moves, BeamRules, Queries, IntArray, BeamSpace, FloatArray, FloatArray, BoolArray], None
]
"""A kernel of :func:`search_kernel`."""


@cache
def search_kernel(name: str) -> Search:
    """The compiled search for robots of the model with this name.

    For a range of the queries it fills controls ``u`` ``(R, H, m)`` and states ``x`` ``(R, H+1, n)`` from where their
    paths begin, and says in ``found`` ``(R,)`` whether a path arrives; if none does, the rest is left alone.
    """
    model = MODELS[name]
    grow_paths, follow = _path_grower(model), _move_follower(model)
    n, d = model.state_size, model.dimension

    @cached_kernel(variant=name, key=models_key((name,)), **WITHOUT_ARRAYS)
    def search(
        arrays: ProblemArrays, table: PathTable, moves: Moves, rules: BeamRules, queries: Queries, part: IntArray,
        space: BeamSpace, u: FloatArray, x: FloatArray, found: BoolArray,
    ) -> None:  # fmt: skip
        arrays, table, moves = borrow(arrays), borrow(table), borrow(moves)
        queries, space = borrow(queries), borrow(space)
        zero: Whole = np.int64(0)  # a literal would compile what it is passed to once more
        for r in range(part[0], part[1]):
            for i in range(n):
                space.beam.states[0, i] = queries.states[r, i]
            space.beam.faults[0], space.numbers[0], size, space.ever.used[0] = 0.0, -1, zero + 1, 0
            ending = (queries.limits[r], zero - 1, zero - 1)
            for block in range(queries.blocks[r], table.first.shape[0]):
                count, ending = grow_paths(arrays, table, moves, rules, queries, r, space, size, block, ending)
                size = _keep_best(space, count, ending[0], rules, arrays, table, queries, r, block)
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
