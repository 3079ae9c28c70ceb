"""Which of the curves to a goal pose a robot's own footprint may drive among obstacles and bounds."""

from __future__ import annotations

import numpy as np

from d4orm_env.core.arrays import FloatArray, Floats, IntArray, Whole
from d4orm_env.core.bodies import FootprintArrays
from d4orm_env.core.problem import Problem
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.engine.caching import cached_kernel
from d4orm_env.engine.compiling import OPTIONS, ZERO, compiled
from d4orm_env.engine.elementary import cosine, sine
from d4orm_env.engine.footprint_contacts import POSE, touches_static
from d4orm_env.engine.simd import TILE

PARTS = 2
"""Poses that are looked at in what the fastest robot drives in a step."""


def free_curves(problem: Problem, robots: IntArray, poses: Floats, sides: Floats, lengths: Floats) -> IntArray:
    """``(R,)`` the first curve of each robot that keeps the margin from all obstacles and bounds, or else that touches
    none; -1 where there is none either, and for robots with trailers, which do not look.

    Args:
        problem: The problem.
        robots: ``(R,)`` whose they are.
        poses: ``(R, 3)`` where they are.
        sides: ``(W, R, S)`` of the curves' stretches, in the order in which they are preferred.
        lengths: ``(W, R, S)`` in turning radii; curves with infinite ones are none.
    """
    team, chosen = problem.team, np.full(len(robots), -1)
    # Of one type for all problems.
    arrays = problem.arrays._replace(turns_at_goals=None, goal_direction=None, squared_goal_chord=None, footprints=None)
    footprints = team.all_footprint_arrays
    buffer = np.zeros((2 + POSE * len(footprints.robot)) * TILE, np.float32)
    for row, robot in enumerate(robots.tolist()):
        if team.robot_models[robot].trailers:
            continue
        radius = float(team.turning_radius[robot])
        side, length = (np.ascontiguousarray(part[:, row]) for part in (sides, lengths))
        for extra in (np.float32(problem.margin), ZERO):
            if chosen[row] < 0:
                chosen[row] = first_free(
                    footprints, arrays, robot, extra, radius, problem.stride / PARTS / radius, poses[row], side, length,
                    buffer,
                )  # fmt: skip
    return chosen


@compiled
def _is_clear(
    f: FootprintArrays, arrays: ProblemArrays, k: Whole, x: float, y: float, heading: float, extra: np.float32,
    buffer: FloatArray,
) -> bool:  # fmt: skip
    """Check whether a robot keeps so far from obstacles and bounds in a pose."""
    poses, o = buffer[2 * TILE :], np.int64(k) * POSE * TILE
    poses[o], poses[o + TILE] = cosine(np.float32(heading)), sine(np.float32(heading))
    poses[o + 2 * TILE] = poses[o + 3 * TILE] = ZERO
    position = (np.float32(x), np.float32(y), ZERO)
    return not touches_static(f, arrays, k, position, poses, POSE * TILE, 0, extra, buffer)


@cached_kernel(**OPTIONS)
def first_free(
    f: FootprintArrays, arrays: ProblemArrays, k: int, extra: np.float32, radius: float, apart: float, pose: Floats,
    sides: Floats, lengths: Floats, buffer: FloatArray,
) -> int:  # fmt: skip
    """Look for the first of the curves ``(W, S)`` from a pose that keeps clear, seen every ``apart``; -1 for none."""
    for w in range(lengths.shape[0]):
        x, y, heading, free = pose[0], pose[1], pose[2], bool(np.isfinite(lengths[w, 0]))
        for i in range(lengths.shape[1]):
            count = int(np.ceil(abs(lengths[w, i]) / apart)) if free else 0
            for _ in range(count):
                # The chord of an arc points half-way between the headings at its ends.
                gone = lengths[w, i] / count
                half = 0.5 * sides[w, i] * gone
                chord = 2 * np.float64(sine(np.float32(half))) * sides[w, i] if sides[w, i] != 0 else gone
                x += radius * chord * np.float64(cosine(np.float32(heading + half)))
                y += radius * chord * np.float64(sine(np.float32(heading + half)))
                heading += 2 * half
                if not _is_clear(f, arrays, k, x, y, heading, extra, buffer):
                    free = False
                    break
        if free:
            return w
    return -1
