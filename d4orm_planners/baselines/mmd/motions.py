"""Motions by the clock, compiled with numba: kept clear while they are denoised, and driven in the end.

Every step of guidance goes once along the motion. Where a point violates something, the motion's modes are changed by
as little as it takes, measured by their deviation among the examples: a gradient step on one point's hinge loss in the
prior's metric (Kaczmarz's method), so that what is pushed stays like what was learned.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable

from d4orm_env.core.arrays import FloatArray, Floats, IntArray, Whole
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.dynamics.models import MODELS
from d4orm_env.dynamics.robot_model import Model, TimeStep
from d4orm_env.engine.caching import Kernel, cached_kernel
from d4orm_env.engine.compiling import OPTIONS, compiled, inlined, to_fixed_tuple
from d4orm_env.engine.elementary import OPS
from d4orm_env.engine.stepping import Row, models_key
from d4orm_env.paths.spaces import Space, clearance_at
from d4orm_planners.baselines.mmd.path_frame import PathFrame, locate, segment_length, trace
from d4orm_planners.tracking.tracker import tracker

SHARE = 0.7  #: Share of its acceleration that a robot counts on, so that it can make up for what it is off
GAIN = np.float32(1.5)  #: Share of its distance from the motion that a robot makes up for in a second [1/s]
_PROBE, _WITHIN = 1 / 150, 2.0**-27
"""Distance over which the slope of the clearance is measured, in radii of the largest robot, and share of a sphere's
radius within which no direction leads out of it."""
_BACKING = 0.02
"""Added to a point's variance, as a share of the largest, so that points near the ends, which cannot move, do not move
the rest."""


@compiled
def fill_clock(
    points: Floats, duration: float, speed: float, acceleration: float, paces: Floats, times: Floats
) -> None:
    """Fill ``times`` ``(N + 1,)`` with when a robot that starts from rest is at each point [s].

    Points follow each other at equal times, but for bends that are driven slower than that, and braking before them.

    Args:
        points: ``(N + 1, 3)`` [m].
        duration: Of the motion [s]; it takes no less.
        speed: Limit [m/s].
        acceleration: Limit [m/s^2].
        paces: ``(N + 1,)`` scratch [m/s].
        times: Output.
    """
    last, usable = points.shape[0] - 1, SHARE * acceleration
    paces[0], paces[last] = 0.0, speed
    for i in range(1, last):
        before, after = segment_length(points, i), segment_length(points, i + 1)
        square = 0.0
        for axis in range(3):
            turn = (points[i + 1, axis] - points[i, axis]) / after - (points[i, axis] - points[i - 1, axis]) / before
            square += turn * turn
        # A point that is waited at has no direction.
        bends = before > 0.0 and after > 0.0 and square > 0.0
        paces[i] = min(speed, np.sqrt(usable * (before + after) / (2 * np.sqrt(square)))) if bends else speed
    for i in range(last - 1, 0, -1):
        paces[i] = min(paces[i], np.sqrt(paces[i + 1] * paces[i + 1] + 2 * usable * segment_length(points, i + 1)))
    times[0] = 0.0
    for i in range(last):
        length = segment_length(points, i + 1)
        paces[i + 1] = min(paces[i + 1], np.sqrt(paces[i] * paces[i] + 2 * usable * length))
        pace = (paces[i] + paces[i + 1]) / 2
        times[i + 1] = times[i] + max(duration / last, length / pace if pace > 0.0 else 0.0)


class PathSurroundings(NamedTuple):
    """Constraints on a robot's motion."""

    space: Space  #: The world
    clearance: float  #: Distance from obstacles to keep with the robot's centre [m]
    size: float  #: Radius of the largest robot [m]
    dt: float  #: Of the steps [s]
    spheres: Floats  #: ``(C, 4)`` centre and radius of hard constraints [m]
    spans: IntArray  #: ``(C, 2)`` int64 first and last step of each
    others: Floats  #: ``(S, T, 3)`` where other robots are at every step [m]
    radii: Floats  #: ``(S,)`` distance to keep from each [m]
    pull: float  #: Share of a soft violation that a step takes away; of hard ones it takes away all


@register_jitable(nogil=True, **OPTIONS)
def _point_variance(sines: Floats, deviation: Floats) -> Floats:
    """``(N + 1, 2)`` variances of each point among the examples, ahead and aside."""
    points, modes = sines.shape
    variance = np.zeros((points, 2))
    for i in range(points):
        for mode in range(modes):
            for side in range(2):
                part = deviation[side * modes + mode] * sines[i, mode]
                variance[i, side] += part * part
    return variance


@cached_kernel(variant="guide", **OPTIONS)
def guide(
    frame: PathFrame,
    sines: Floats,
    deviation: Floats,
    surroundings: PathSurroundings,
    durations: Floats,
    steps: int,
    motions: FloatArray,
) -> None:
    """Change motions so that they violate less.

    Args:
        frame: The robot's :class:`~d4orm_planners.baselines.mmd.path_frame.PathFrame`.
        sines: ``(N + 1, M)`` of :func:`~d4orm_planners.baselines.mmd.path_frame.sine_table`.
        deviation: ``(2 M,)`` of the modes.
        surroundings: Constraints on the motion.
        durations: ``(B,)`` of the motions [s].
        steps: Number of times to go along each motion.
        motions: ``(B, 2 M)`` float32 whitened modes, changed in place.
    """
    last, modes = sines.shape[0] - 1, sines.shape[1]
    variance = _point_variance(sines, deviation)
    backing = _BACKING * variance.max()
    points, paces, times = np.empty((last + 1, 3)), np.empty(last + 1), np.empty(last + 1)
    spot, push = np.empty((4, 3)), np.empty(3)
    for b in range(motions.shape[0]):
        axis = frame.axes[b % frame.axes.shape[0]]
        for _ in range(steps):
            quiet = True
            trace(frame, axis, sines, deviation, motions[b], spot, points)
            fill_clock(points, durations[b], frame.speed, frame.acceleration, paces, times)
            for i in range(1, last):
                # It may have moved with the points before it.
                locate(frame, axis, sines[i], deviation, motions[b], i, spot)
                step = np.int64(times[i] / surroundings.dt + 0.5)
                if not _violation(surroundings, step, spot, push):
                    continue
                quiet = False
                ahead = push[0] * spot[1, 0] + push[1] * spot[1, 1] + push[2] * spot[1, 2]
                aside = push[0] * spot[2, 0] + push[1] * spot[2, 1] + push[2] * spot[2, 2]
                ahead /= frame.length * (variance[i, 0] + backing)
                aside /= frame.length * (variance[i, 1] + backing)
                for mode in range(modes):
                    motions[b, mode] += np.float32(ahead * deviation[mode] * sines[i, mode])
                    motions[b, modes + mode] += np.float32(aside * deviation[modes + mode] * sines[i, mode])
            if quiet:
                break


@compiled
def _violation(surroundings: PathSurroundings, step: Whole, spot: Floats, push: Floats) -> bool:
    """Fill ``push`` ``(3,)`` with what would end a position's violations at a step [m]; whether there are any."""
    push[:] = 0.0
    position, aside = spot[0], spot[2]
    violated = False
    for c in range(surroundings.spheres.shape[0]):
        if surroundings.spans[c, 0] <= step <= surroundings.spans[c, 1]:
            sphere = surroundings.spheres[c]
            violated |= _push_out(sphere, sphere[3], 1.0, aside, position, push)
    at = min(step, surroundings.others.shape[1] - 1)
    for other in range(surroundings.others.shape[0]):
        centre = surroundings.others[other, at]
        violated |= _push_out(centre, surroundings.radii[other], surroundings.pull, aside, position, push)
    return _push_clear(surroundings.space, surroundings.clearance, _PROBE * surroundings.size, spot, push) or violated


@compiled
def _push_clear(space: Space, clearance: float, probe: float, spot: Floats, push: Floats) -> bool:
    """Add to ``push`` what brings a position out of obstacles on the side of the path; whether it is too near."""
    x, y, z = spot[0, 0], spot[0, 1], spot[0, 2]
    missing = clearance - clearance_at(space, x, y, z)
    if not missing > 0.0:
        return False
    gx = clearance_at(space, x + probe, y, z) - clearance_at(space, x - probe, y, z)
    gy = clearance_at(space, x, y + probe, z) - clearance_at(space, x, y - probe, z)
    gz = clearance_at(space, x, y, z + probe) - clearance_at(space, x, y, z - probe)
    norm = np.sqrt(gx * gx + gy * gy + gz * gz)
    hx, hy, hz = spot[3, 0] - x, spot[3, 1] - y, spot[3, 2] - z
    if gx * hx + gy * hy + gz * hz < 0.0:
        # Beyond the middle of a wall the nearest way out leads to its other side.
        push[0] += hx
        push[1] += hy
        push[2] += hz
    elif norm > 0.0:
        push[0] += missing * gx / norm
        push[1] += missing * gy / norm
        push[2] += missing * gz / norm
    return True


@compiled
def _push_out(centre: Floats, radius: float, share: float, aside: Floats, position: Floats, push: Floats) -> bool:
    """Add to ``push`` that share of what brings a position out of a sphere; whether it is in it."""
    dx, dy, dz = position[0] - centre[0], position[1] - centre[1], position[2] - centre[2]
    square = dx * dx + dy * dy + dz * dz
    if not square < radius * radius or share == 0.0:
        return False
    distance = np.sqrt(square)
    if distance < _WITHIN * radius:
        dx, dy, dz, distance = aside[0], aside[1], aside[2], 1.0
        missing = share * radius
    else:
        missing = share * (radius - distance)
    push[0] += missing * dx / distance
    push[1] += missing * dy / distance
    push[2] += missing * dz / distance
    return True


class TrackedMotions(NamedTuple):
    """Rollouts along ``B`` motions."""

    controls: FloatArray  #: ``(B, H, m)`` float32, zero after arrival
    states: FloatArray  #: ``(B, H+1, n)`` float32, from the first step on
    positions: Floats  #: ``(B, H+1, 3)`` [m]
    arrivals: IntArray  #: ``(B,)`` int64 the step of arrival; ``H + 1`` for none
    clearances: Floats  #: ``(B,)`` least distance of the centre from obstacles and bounds [m]


def _motion_follower(model: Model) -> Callable[..., int]:
    """Function that drives a robot along a motion by its clock."""
    approach, d = inlined(model.functions.approach), model.dimension

    @inlined
    def by_motion(
        reference: tuple[Floats, Floats, np.float32, FloatArray],
        i: int,
        step: int,
        x: Row,
        goal: Row,
        limits: Row,
        h: TimeStep,
    ) -> tuple[Row, int, bool]:
        points, times, dt, wanted = reference
        time, last = (step + 1) * dt, times.shape[0] - 1
        while i < last and times[i + 1] <= time:
            i += 1
        if i == last:
            return approach(x, goal, limits, h, OPS), i, True
        for axis in range(d):
            pace = (points[i + 1, axis] - points[i, axis]) / (times[i + 1] - times[i])
            error = points[i, axis] + (time - times[i]) * pace - x[axis]
            # By the next step the motion has gone on as well.
            wanted[axis] = pace + GAIN * (error - pace * dt)
        return to_fixed_tuple(wanted, d), i, True

    return tracker(model, by_motion)


@cache
def motion_kernel(
    name: str,
) -> Kernel[[ProblemArrays, int, PathFrame, Floats, Floats, Space, Floats, FloatArray, TrackedMotions], None]:
    """The compiled drives of a robot of the model with this name, which fill :class:`TrackedMotions`."""
    model = MODELS[name]
    follow, n, d = _motion_follower(model), model.state_size, model.dimension

    @cached_kernel(variant=name, key=models_key((name,)), **OPTIONS)
    def drive_motion(
        arrays: ProblemArrays, robot: int, frame: PathFrame, sines: Floats, deviation: Floats, space: Space,
        durations: Floats, motions: FloatArray, driven: TrackedMotions,
    ) -> None:  # fmt: skip
        num_points, start = sines.shape[0], to_fixed_tuple(arrays.start[robot], n)
        points, wanted, states = np.empty((num_points, 3)), np.zeros(d, np.float32), driven.states
        paces, times, spot = np.empty(num_points), np.empty(num_points), np.empty((4, 3))
        for b in range(motions.shape[0]):
            trace(frame, frame.axes[b % frame.axes.shape[0]], sines, deviation, motions[b], spot, points)
            fill_clock(points, durations[b], frame.speed, frame.acceleration, paces, times)
            reference = (points, times, arrays.time_step[0], wanted)
            driven.arrivals[b] = follow(arrays, robot, reference, 0, 0, start, False, driven.controls[b], states[b])
            positions, least = driven.positions[b], np.inf
            positions[:] = 0.0
            positions[0, :d] = arrays.start[robot, :d]
            for step in range(1, positions.shape[0]):
                positions[step, :d] = states[b, step, :d]
                least = min(least, clearance_at(space, positions[step, 0], positions[step, 1], positions[step, 2]))
            driven.clearances[b] = least

    return drive_motion
