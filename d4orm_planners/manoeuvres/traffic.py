"""Motions of the other robots, and the steps in which a pose or a move is safe from them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from d4orm_env.core.arrays import FloatArray, Floats, IntArray, Whole
from d4orm_env.engine.caching import cached_kernel
from d4orm_env.engine.compiling import OPTIONS, ZERO, compiled
from d4orm_env.engine.convex_cores import cores_within, place_body
from d4orm_env.engine.simd import TILE
from d4orm_planners.manoeuvres.lattice import Pose, RobotBody, hitch_of, placed_first, placed_next, pose_between

NEVER = 1 << 40  #: Step that never comes


class Traffic(NamedTuple):
    """The motions of other robots, and a grid of who comes near to its cells when."""

    poses: FloatArray  #: ``(K, T + 1, 6)`` float32
    last: IntArray  #: ``(K,)`` number of the last step at which each moves; it stays there, ...
    gone: IntArray  #: ``(K,)`` ... but is there no more from this step on
    low: Floats  #: ``(2,)`` lowest corner of the grid [m]
    scale: float  #: One over the size of its cells [1/m], beyond which robots do not meet in a step
    size: tuple[int, int]  #: ``(2,)`` cells along x and y
    first: IntArray  #: ``(C + 1,)`` where the visits to each cell begin
    visits: IntArray  #: ``(V, 3)`` the robot that comes near, and the first and the last step


@compiled
def _cell(low: Floats, scale: float, size: tuple[int, int], x: float, y: float) -> tuple[int, int]:
    i, j = int((x - low[0]) * scale), int((y - low[1]) * scale)
    return max(0, min(size[0] - 1, i)), max(0, min(size[1] - 1, j))


@compiled
def _note(
    first: IntArray, visits: IntArray, size: tuple[int, int], at: tuple[int, int], robot: int, since: int, until: int
) -> None:
    """Note a visit in a cell and those round it; only count if there is no room yet."""
    for i in range(max(0, at[0] - 1), min(size[0], at[0] + 2)):
        for j in range(max(0, at[1] - 1), min(size[1], at[1] + 2)):
            cell = i * size[1] + j
            if visits.shape[0] > 0:
                row = first[cell]
                visits[row, 0], visits[row, 1], visits[row, 2] = robot, since, until
            first[cell] += 1


@cached_kernel(**OPTIONS)
def count_visits(
    poses: FloatArray, last: IntArray, gone: IntArray, low: Floats, scale: float, size: tuple[int, int],
    first: IntArray, visits: IntArray,
) -> None:  # fmt: skip
    """Count the visits to every cell in ``first``; or, if there are rows for them, write each where ``first`` says."""
    for robot in range(poses.shape[0]):
        if last[robot] < 0:
            continue
        since, at = 0, _cell(low, scale, size, poses[robot, 0, 0], poses[robot, 0, 1])
        for step in range(1, last[robot] + 1):
            after = _cell(low, scale, size, poses[robot, step, 0], poses[robot, step, 1])
            if after != at:
                _note(first, visits, size, at, robot, since, step - 1)
                since, at = step, after
        _note(first, visits, size, at, robot, since, gone[robot] - 1)


def traffic_of(poses: FloatArray, last: IntArray, gone: IntArray, low: Floats, high: Floats, cell: float) -> Traffic:
    """The motions of robots ``(K, T + 1, 6)``, in cells of this size [m]; one that has none moves last at step -1."""
    counted = np.maximum(np.ceil((high - low) / cell), 1)
    size = (int(counted[0]), int(counted[1]))
    cells = size[0] * size[1]
    counts = np.zeros(cells, np.int64)
    count_visits(poses, last, gone, low, 1 / cell, size, counts, np.empty((0, 3), np.int64))
    first = np.concatenate([[0], np.cumsum(counts)])
    visits = np.empty((max(int(first[-1]), 1), 3), np.int64)
    count_visits(poses, last, gone, low, 1 / cell, size, first[:-1].copy(), visits)
    return Traffic(poses, last, gone, low, 1 / cell, size, first, visits)


@compiled
def visits_of(traffic: Traffic, x: float, y: float) -> tuple[int, int]:
    """The rows of the visits to the cell of a position: the first, and the one after the last."""
    i, j = _cell(traffic.low, traffic.scale, traffic.size, x, y)
    cell = i * traffic.size[1] + j
    return traffic.first[cell], traffic.first[cell + 1]


@compiled
def _meets(
    body: RobotBody, traffic: Traffic, other: Whole, step: Whole, before: Floats, after: Floats, parts: int,
    buffer: FloatArray,
) -> bool:  # fmt: skip
    """Check whether another robot is too near to this one in a step that ends at ``step``, between two poses of it."""
    arrays, k, last = body.arrays, body.robot, traffic.last[other]
    end, begin = traffic.poses[other, min(step, last)], traffic.poses[other, min(max(step - 1, 0), last)]
    safety_distance = arrays.radius[k] + arrays.radius[other] + body.extra
    dx, dy = np.float32(end[0] - after[0]), np.float32(end[1] - after[1])
    far = safety_distance + np.float32(2 * body.stride)
    if dx * dx + dy * dy > far * far:
        return False
    for part in range(parts):
        pose, its_pose = pose_between(before, after, part / parts), pose_between(begin, end, part / parts)
        dx, dy = np.float32(its_pose[0]) - np.float32(pose[0]), np.float32(its_pose[1]) - np.float32(pose[1])
        near = dx * dx + dy * dy <= safety_distance * safety_distance
        if near and _touches(body, other, pose, its_pose, dx, dy, buffer):
            return True
    return False


@compiled
def _steps_away(body: RobotBody, traffic: Traffic, other: Whole, step: Whole, pose: Floats, moving: int) -> int:
    """Steps, from one on, in which another robot cannot be too near to a pose; ``moving`` is 1, or 2 if both move."""
    its_pose = traffic.poses[other, min(step, traffic.last[other])]
    dx, dy = its_pose[0] - pose[0], its_pose[1] - pose[1]
    far = body.arrays.radius[body.robot] + body.arrays.radius[other] + body.extra + 2 * body.stride
    return max(0, int((np.sqrt(dx * dx + dy * dy) - far) / (moving * body.stride)))


@compiled
def _touches(
    body: RobotBody, other: Whole, pose: Pose, its_pose: Pose, dx: np.float32, dy: np.float32, buffer: FloatArray
) -> bool:
    """Check whether another robot, offset by ``(dx, dy)`` from this one, is too near to it."""
    f, k = body.footprints, body.robot
    inner = f.inner[k] + f.inner[other] + body.extra
    if dx * dx + dy * dy <= inner * inner:
        return True
    own, core = buffer[:TILE], buffer[TILE : 2 * TILE]
    i, number, placed = np.int64(k), 0, placed_first(body, k, pose[2], ZERO, ZERO)
    while i >= 0:
        place_body(f, i, placed[0], placed[1], placed[2], placed[3], own)
        j, its_number, its = np.int64(other), 0, placed_first(body, other, its_pose[2], dx, dy)
        while j >= 0:
            place_body(f, j, its[0], its[1], its[2], its[3], core)
            if cores_within(own, core, body.extra):
                return True
            its = placed_next(body, j, its, hitch_of(its_pose, its_number))
            j, its_number = np.int64(f.following[j]), its_number + 1
        placed = placed_next(body, i, placed, hitch_of(pose, number))
        i, number = np.int64(f.following[i]), number + 1
    return False


@compiled
def meeting(
    body: RobotBody, traffic: Traffic, swept: Floats | FloatArray, first: int, last: int, depart: int,
    buffer: FloatArray,
) -> tuple[int, int]:  # fmt: skip
    """The first step, of those from ``first`` to ``last`` of a move that begins at step ``depart``, in which another
    robot is too near, and a step of the clock before which that one does not go away; zeros for none.
    """
    while first <= last:
        begin, end = visits_of(traffic, swept[first, 0], swept[first, 1])
        until = first + 1
        while until <= last and visits_of(traffic, swept[until, 0], swept[until, 1]) == (begin, end):
            until += 1
        met, whom = until, -1
        for row in range(begin, end):
            other, step = traffic.visits[row, 0], max(first, traffic.visits[row, 1] - depart)
            while step < met and step + depart <= traffic.visits[row, 2]:
                away = _steps_away(body, traffic, other, step + depart, swept[step], 2)
                before, after = swept[max(step - 1, 0)], swept[step]
                if away == 0 and _meets(body, traffic, other, step + depart, before, after, body.parts, buffer):
                    met, whom = step, other
                step += max(away, 1)
        if whom >= 0:
            at = met + depart
            return met, traffic.gone[whom] if at > traffic.last[whom] else at + 1
        first = until
    return 0, 0


@compiled
def safe_until(body: RobotBody, traffic: Traffic, step: Whole, pose: Floats, buffer: FloatArray) -> int:
    """The first step, from this one on, in which another robot is too near to a pose; :data:`NEVER` for none."""
    until = NEVER
    begin, end = visits_of(traffic, pose[0], pose[1])
    for row in range(begin, end):
        other = traffic.visits[row, 0]
        since = max(step, traffic.visits[row, 1])
        # A robot at rest does not come nearer.
        last, at = min(traffic.visits[row, 2], until - 1, max(traffic.last[other], since)), since
        while at <= last:
            away = _steps_away(body, traffic, other, at, pose, 1)
            if away == 0 and _meets(body, traffic, other, at, pose, pose, body.parts if at > step else 1, buffer):
                until = at
                break
            at += max(away, 1)
    return until


@compiled
def safe_since(body: RobotBody, traffic: Traffic, pose: Floats, buffer: FloatArray) -> int:
    """The first step from which on no other robot is too near to a pose; :data:`NEVER` for none."""
    since = 0
    begin, end = visits_of(traffic, pose[0], pose[1])
    for row in range(begin, end):
        other = traffic.visits[row, 0]
        # In the step after its last move it stands as it does from then on, until it is gone.
        last = min(traffic.visits[row, 2], traffic.last[other] + 1)
        for at in range(last, max(since, traffic.visits[row, 1]) - 1, -1):
            if _meets(body, traffic, other, at, pose, pose, body.parts, buffer):
                since = max(since, (traffic.visits[row, 2] if at == last else at) + 1)
                break
    return since


@cached_kernel(**OPTIONS)
def meets_nobody(body: RobotBody, traffic: Traffic, poses: FloatArray, buffer: FloatArray) -> bool:
    """Check whether no other robot comes too near to one that takes poses ``(T + 1, 6)``, and stays in the last."""
    last = poses.shape[0] - 1
    if meeting(body, traffic, poses, 0, last, 0, buffer)[1] > 0:
        return False
    return safe_until(body, traffic, last, poses[last], buffer) == NEVER
