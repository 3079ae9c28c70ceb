"""Guidance of motions out of obstacles, constraints and other robots' paths while they are denoised.

Every step of guidance goes once along the motion. Where a point violates something, the motion's modes are changed by
as little as it takes, measured by their deviation among the examples: a gradient step on one point's hinge loss in the
prior's metric (Kaczmarz's method), so that what is pushed stays like what was learned.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable

from d4orm_env.core.arrays import FloatArray, Floats, IntArray, Whole
from d4orm_env.engine.caching import cached_kernel
from d4orm_env.engine.compiling import OPTIONS, compiled
from d4orm_env.paths.spaces import Space, clearance_at
from d4orm_planners.baselines.mmd.path_frame import PathFrame, locate, trace
from d4orm_planners.baselines.mmd.tracking import fill_clock

_PROBE, _WITHIN = 1 / 150, 2.0**-27
"""Distance over which the slope of the clearance is measured, in radii of the largest robot, and share of a sphere's
radius within which no direction leads out of it."""
_BACKING = 0.02
"""Added to a point's variance, as a share of the largest, so that points near the ends, which cannot move, do not move
the rest."""


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
