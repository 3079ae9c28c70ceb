"""Curves along which a robot and its trailers keep clear of obstacles and bounds, to goal hitch angles."""

from __future__ import annotations

import numpy as np

from d4orm_env.core.arrays import FloatArray, Floats, IntArray, Whole
from d4orm_env.core.bodies import FootprintArrays
from d4orm_env.core.goal_poses import MOST_TRAILERS
from d4orm_env.core.problem import Problem
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.engine.caching import cached_kernel
from d4orm_env.engine.compiling import OPTIONS, ZERO, compiled
from d4orm_env.engine.elementary import cosine, sine
from d4orm_env.engine.footprint_contacts import POSE, touches_static
from d4orm_env.engine.simd import TILE

SURE = 0.5  #: Share of the tolerance of hitch angles that they may be missed by where a curve ends
PARTS = 2  #: Poses that are looked at in what the fastest robot drives in a step, and in the length of a hitch


def free_curves(problem: Problem, robots: IntArray, poses: Floats, sides: Floats, lengths: Floats) -> IntArray:
    """``(R,)`` the first curve of each robot that keeps the margin from all obstacles and bounds, or else that touches
    none, trailers included, and ends with them as the goal asks, or else with any hitch angles; -1 where there is none.

    Args:
        problem: The problem.
        robots: ``(R,)`` whose they are.
        poses: ``(R, 3 + T)`` where they are, and the hitch angles of their trailers.
        sides: ``(W, R, S)`` of the curves' stretches, in the order in which they are preferred.
        lengths: ``(W, R, S)`` in turning radii; curves with infinite ones are none.
    """
    team, chosen = problem.team, np.full(len(robots), -1)
    # Of one type for all problems.
    arrays = problem.arrays._replace(turns_at_goals=None, goal_direction=None, squared_goal_chord=None, footprints=None)
    footprints = team.all_footprint_arrays
    buffer = np.zeros((2 + POSE * len(footprints.robot)) * TILE, np.float32)
    for row, robot in enumerate(robots.tolist()):
        radius, (largest, shortest) = float(team.turning_radius[robot]), _hitches(problem, robot)
        apart = min(problem.stride, shortest) / PARTS / radius
        side, length = (np.ascontiguousarray(part[:, row]) for part in (sides, lengths))
        asked, missed = problem.goal_hitches[robot], SURE * float(problem.goal_heading_tolerance[robot])
        for bends in (asked, np.full_like(asked, np.nan)):
            for extra in (np.float32(problem.margin), ZERO):
                if chosen[row] < 0:
                    chosen[row] = first_free(
                        footprints, arrays, robot, extra, radius, apart, poses[row], largest, side, length, bends,
                        missed, buffer,
                    )  # fmt: skip
    return chosen


def _hitches(problem: Problem, robot: int) -> tuple[Floats, float]:
    """``(T,)`` largest hitch angles of a robot [rad], and the length of its shortest hitch [m], infinite for none."""
    model, limits = problem.team.robot_models[robot], problem.team.limits[robot].astype(np.float64)
    columns = dict(model.state_limits)
    largest = [limits[columns[hitch]] if hitch in columns else np.pi for hitch, _ in model.trailers]
    lengths = [limits[column] for _, column in model.trailers]
    return np.array([*largest, *[0.0] * (MOST_TRAILERS - len(largest))]), float(min(lengths, default=np.inf))


@compiled
def _tow(f: FootprintArrays, k: Whole, way: float, turn: float, largest: Floats, bends: Floats) -> None:
    """Change hitch angles as robot ``k`` moves a way [m] and turns: by the midpoint, as models with trailers do."""
    i, n = np.int64(f.following[k]), 0
    while i >= 0:
        share = way / np.float64(f.hitch[i])
        middle = bends[n] + 0.5 * (turn - share * np.float64(sine(np.float32(bends[n]))))
        towed = share * np.float64(sine(np.float32(middle)))
        bends[n] = min(max(bends[n] + turn - towed, -largest[n]), largest[n])
        way, turn = way * np.float64(cosine(np.float32(middle))), towed
        i, n = np.int64(f.following[i]), n + 1


@compiled
def _is_clear(
    f: FootprintArrays, arrays: ProblemArrays, k: Whole, pose: Floats, extra: np.float32, buffer: FloatArray
) -> bool:
    poses, i, n, before, heading = buffer[2 * TILE :], np.int64(k), 2, np.int64(0), pose[2]
    while i >= 0:
        o = i * POSE * TILE
        poses[o], poses[o + TILE] = cosine(np.float32(heading)), sine(np.float32(heading))
        poses[o + 2 * TILE] = poses[o + 3 * TILE] = ZERO
        for row in range(2 if n > 2 else 0):
            poses[o + (2 + row) * TILE] = poses[before + (2 + row) * TILE] - f.hitch[i] * poses[o + row * TILE]
        before, i, n = o, np.int64(f.following[i]), n + 1
        heading -= pose[n] if i >= 0 else 0.0
    position = (np.float32(pose[0]), np.float32(pose[1]), ZERO)
    return not touches_static(f, arrays, k, position, poses, POSE * TILE, 0, extra, buffer)


@cached_kernel(**OPTIONS)
def first_free(
    f: FootprintArrays, arrays: ProblemArrays, k: int, extra: np.float32, radius: float, apart: float, begin: Floats,
    largest: Floats, sides: Floats, lengths: Floats, asked: FloatArray, missed: float, buffer: FloatArray,
) -> int:  # fmt: skip
    """Look for the first of the curves ``(W, S)`` from a pose that keeps clear, seen every ``apart``, and that misses
    the hitch angles ``asked``, NaN for any, by no more than that; -1 for none.
    """
    for w in range(lengths.shape[0]):
        pose, free = begin.copy(), bool(np.isfinite(lengths[w, 0]))
        for i in range(lengths.shape[1]):
            count = int(np.ceil(abs(lengths[w, i]) / apart)) if free else 0
            for _ in range(count):
                # The chord of an arc points half-way between the headings at its ends.
                gone = lengths[w, i] / count
                half = 0.5 * sides[w, i] * gone
                chord = 2 * np.float64(sine(np.float32(half))) * sides[w, i] if sides[w, i] != 0 else gone
                pose[0] += radius * chord * np.float64(cosine(np.float32(pose[2] + half)))
                pose[1] += radius * chord * np.float64(sine(np.float32(pose[2] + half)))
                pose[2] += 2 * half
                _tow(f, k, radius * gone, 2 * half, largest, pose[3:])
                if not _is_clear(f, arrays, k, pose, extra, buffer):
                    free = False
                    break
        for n in range(pose.shape[0] - 3):
            free &= not abs(pose[3 + n] - asked[n]) > missed
        if free:
            return w
    return -1
