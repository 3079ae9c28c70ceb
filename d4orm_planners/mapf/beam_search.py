"""Beam search of one robot's path among all others' known ways, in space and time, compiled with numba.

A path is made of pieces of a block of steps each, in which the robot heads for its goal, faster or slower, stops, or
turns off by some angle. After every block the most promising of the paths so far are kept.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import BoolArray, FloatArray, IntArray, Whole
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.dynamics import transition
from d4orm_env.dynamics.models import MODELS
from d4orm_env.dynamics.robot_model import SPEED, Model, TimeStep
from d4orm_env.engine.borrowing import borrow
from d4orm_env.engine.caching import Kernel, cached_kernel
from d4orm_env.engine.compiling import WITHOUT_ARRAYS, ZERO, compiled, inlined, to_fixed_tuple
from d4orm_env.engine.elementary import OPS
from d4orm_env.engine.obstacles import is_closed, touches_static
from d4orm_env.engine.stepping import Docking, docking_of, models_key
from d4orm_env.engine.tile_layout import Row
from d4orm_planners.engine.path_index import is_unsure
from d4orm_planners.engine.path_table import BLOCK, PathTable, count_near, steps_of
from d4orm_planners.mapf.beam import BeamSpace, is_like_another, keep, sink, trace_back
from d4orm_planners.mapf.motion_primitives import Moves, aiming
from d4orm_planners.tracking.tracker import tracker, velocity_step

_AHEAD = np.float32(0.5)
"""Distance ahead of a robot from which the rest of its path is measured [s]."""

_TOUCH = 100.0
"""Robots that are met rather than an obstacle touched for a step."""


class BeamRules(NamedTuple):
    """Rules by which the beam keeps paths.

    Attributes:
        width: Number of paths.
        contact: Cost of being near another robot in a block [s].
        dedup_distance: Least distance between two, or else twice as much in speed [m, m/s].
    """

    width: int
    contact: float
    dedup_distance: float


class OtherAgents(NamedTuple):
    """Agents that robots which look for a path avoid, other than the team as it drives at present.

    Attributes:
        without: ``(R, N)`` numbers of robots that each does not mind, its own among them.
        beside: ``(R, M, H+1, d)`` paths that it minds as well [m].
        radius: ``(R, M)`` radii of the agents on them [m].
    """

    without: NDArray[np.int64]
    beside: FloatArray
    radius: NDArray[np.float64]


class Queries(NamedTuple):
    """Robots that look for paths.

    Attributes:
        robots: ``(R,)`` their numbers in the team.
        blocks: ``(R,)`` the block at whose beginning their new paths begin,
        states: ``(R, n)`` and in which state.
        limits: ``(R,)`` what their paths must cost less than [s]: the step at which one ends, and what contacts cost.
        others: Agents that they mind, or do not mind.
    """

    robots: NDArray[np.int64]
    blocks: NDArray[np.int64]
    states: FloatArray
    limits: NDArray[np.float64]
    others: OtherAgents


@compiled
def _count_beside(
    table: PathTable, robot: Whole, others: OtherAgents, r: int, path: FloatArray, first: Whole, last: Whole
) -> int:
    """Count the further paths that a path meets from one step to another; at its end it is at rest."""
    count, end = 0, path.shape[0] - 1
    for other in range(others.beside.shape[1]):
        reach = table.radius[robot] + others.radius[r, other] + table.margin
        for t in range(first, last):
            gap2 = 0.0
            for axis in range(path.shape[1]):
                place = np.float64(path[min(t - first, end), axis])
                gap = place - np.float64(others.beside[r, other, t, axis])
                gap2 += gap * gap
            if gap2 <= reach * reach:
                count += 1
                break
    return count


@compiled
def _count_met(table: PathTable, queries: Queries, r: int, path: FloatArray, block: Whole) -> int:
    """Count those whom a path through a block meets there."""
    robot, (first, last) = queries.robots[r], steps_of(table, block)
    count = count_near(table, robot, queries.others.without[r], path, first, block)
    return count + _count_beside(table, robot, queries.others, r, path, first, last)


@inlined
def _keep_best(
    space: BeamSpace,
    count: Whole,
    best: float,
    rules: BeamRules,
    table: PathTable,
    queries: Queries,
    r: int,
    block: Whole,
) -> Whole:
    """Keep the most promising of ``count`` paths, of those that are alike the better one; return how many.

    Most are worse than those kept whomever they meet. So that is counted of one only when its turn comes, which then
    comes again.
    """
    new, heap, counted, numbers = space.new, space.heap, space.counted, space.numbers
    dedup2 = rules.dedup_distance * rules.dedup_distance
    root = size = np.int64(0)  # literals would compile what they are passed to once more
    for node in range(count):
        heap[node], counted[node] = node, False
    for place in range(count // 2 - 1, -1, -1):
        sink(new.bounds, heap, place, count)
    while size < numbers.shape[0] and count > 0 and new.bounds[heap[0]] < best:
        node = heap[0]
        alike = is_like_another(new, node, space.beam, size, dedup2)
        if alike or counted[node]:
            count -= 1
            heap[0] = heap[count]
            if not alike:
                keep(new, node, space.beam, size, numbers, space.ever)
                size += 1
        else:
            new.faults[node] += _count_met(table, queries, r, new.paths[node], block)
            new.bounds[node], counted[node] = rules.contact * new.faults[node] + new.costs[node], True
        sink(new.bounds, heap, root, count)
    return size


@compiled
def _count_passing(
    table: PathTable, robot: Whole, others: OtherAgents, r: int, path: FloatArray, block: Whole, last_busy: Whole
) -> int:
    """Count those who come by after a block that ended at the goal, where the robot stays; ``path`` is changed."""
    first, last = steps_of(table, block)
    for row in range(path.shape[0]):
        for axis in range(path.shape[1]):
            path[row, axis] = path[last - first - 1, axis]
    count = 0
    for later in range(block + 1, last_busy + 1):
        count += count_near(table, robot, others.without[r], path, steps_of(table, later)[0], later)
    return count + _count_beside(table, robot, others, r, path, last, len(table.places))


def _block_driver(model: Model) -> Callable[..., tuple[Row, Row, bool, float, float]]:
    """Function that drives a robot by a move for a block: state, velocity, arrival, cost [s] and robots met."""
    approach, velocity_of = inlined(model.functions.approach), inlined(model.functions.velocity)
    step_towards, (aim_of, slowed) = velocity_step(model), aiming(model)
    n, d, no_control = model.state_size, model.dimension, (ZERO,) * model.control_size

    @inlined
    def drive_block(
        arrays: ProblemArrays, moves: Moves, number: int, states: FloatArray, faults: float, goal: FloatArray, at: Row,
        limits: Row, docking: Docking, reach: np.float32, steps: tuple[Whole, Whole],
        path: FloatArray,
    ) -> tuple[Row, Row, bool, float, float]:  # fmt: skip
        dt, closed, goal_radius = arrays.time_step, is_closed(arrays), np.sqrt(arrays.squared_goal_radius)
        h, (first, last) = transition.TimeStep(dt[0], dt[1], dt[2], dt[3]), steps
        state, control, at_goal = to_fixed_tuple(states, n), no_control, False
        aim, end = aim_of(states, state, limits, goal, goal_radius, moves, number), first
        for t in range(first, last):
            if not transition.stands(at_goal, arrays.docks):
                velocity = slowed(approach(state, aim, limits, h, OPS), moves.pace[number])
                control, state, at_goal = step_towards(state, velocity, limits, at, docking, h)
                end = t
            for axis in range(d):
                path[t - first, axis] = state[axis]
            if end == t and is_unsure(arrays, path[t - first], goal):
                faults += 1.0
            if closed and touches_static(arrays, reach, path[t - first]):
                faults += _TOUCH
        velocity, cost = velocity_of(state, control, limits, OPS), end * dt[0]
        if not at_goal:
            rest2 = 0.0
            for axis in range(d):
                gap = goal[axis] - (state[axis] + _AHEAD * velocity[axis])
                rest2 += gap * gap
            cost = end * dt[0] + max(np.sqrt(rest2) - goal_radius, ZERO) / limits[SPEED]
        return state, velocity, at_goal, cost, faults

    return drive_block


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
            aim = aim_of(states[step], state, limits, goal, goal_radius, moves, number)
        return slowed(approach(state, aim, limits, h, OPS), moves.pace[number]), aim, True

    return tracker(model, by_moves)


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
    drive_block, follow = _block_driver(model), _move_follower(model)
    n, d, num_limits = model.state_size, model.dimension, len(model.limit_names)

    @cached_kernel(variant=name, key=models_key((name,)), **WITHOUT_ARRAYS)
    def search(
        arrays: ProblemArrays, table: PathTable, moves: Moves, rules: BeamRules, queries: Queries, part: IntArray,
        space: BeamSpace, u: FloatArray, x: FloatArray, found: BoolArray,
    ) -> None:  # fmt: skip
        arrays, table, moves = borrow(arrays), borrow(table), borrow(moves)
        queries, space = borrow(queries), borrow(space)
        num_blocks, num_moves = table.first.shape[0], moves.pace.shape[0]
        zero: Whole = np.int64(0)  # a literal would compile what it is passed to once more
        last_busy = min(num_blocks - 1, table.moving[0] + 1)
        beam, new, ever, numbers, did = space.beam, space.new, space.ever, space.numbers, space.did
        for r in range(part[0], part[1]):
            robot, begin = queries.robots[r], queries.blocks[r]
            goal, limits = arrays.goal[robot], to_fixed_tuple(arrays.limits[robot], num_limits)
            docking = docking_of(arrays, robot)
            at, reach = to_fixed_tuple(goal, d), arrays.radius[robot] + arrays.margin
            for i in range(n):
                beam.states[0, i] = queries.states[r, i]
            beam.faults[0], numbers[0], size, ever.used[0] = 0.0, -1, zero + 1, 0
            best, best_number, best_move = queries.limits[r], zero - 1, zero - 1
            for block in range(begin, num_blocks):
                steps, count = steps_of(table, block), zero
                for node in range(size):
                    for number in range(num_moves):
                        path = new.paths[count]
                        state, velocity, at_goal, cost, faults = drive_block(
                            arrays, moves, number, beam.states[node], beam.faults[node], goal, at, limits, docking,
                            reach, steps, path,
                        )  # fmt: skip
                        if rules.contact * faults + cost >= best:
                            continue
                        if at_goal:
                            # It stays there: whoever comes by later counts too.
                            faults += _count_met(table, queries, r, path, block)
                            faults += _count_passing(table, robot, queries.others, r, path, block, last_busy)
                            if rules.contact * faults + cost < best:
                                best, best_number, best_move = rules.contact * faults + cost, numbers[node], number
                            continue
                        for axis in range(d):
                            new.velocities[count, axis] = velocity[axis]
                        for i in range(n):
                            new.states[count, i] = state[i]
                        new.costs[count], new.bounds[count] = cost, rules.contact * faults + cost
                        new.faults[count], new.before[count], new.moves[count] = faults, numbers[node], number
                        count += 1
                size = _keep_best(space, count, best, rules, table, queries, r, block)
                if size == 0:
                    break
            found[r] = best_move >= 0
            if found[r]:
                length = trace_back(ever, best_number, best_move, did)
                state, start = to_fixed_tuple(queries.states[r], n), begin * BLOCK
                for i in range(n):
                    x[r, start, i] = state[i]
                goal_radius = np.sqrt(arrays.squared_goal_radius)
                reference = (moves, did[:length], begin, goal, goal_radius, x[r])
                follow(arrays, robot, reference, at, start, state, False, u[r], x[r])

    return search
