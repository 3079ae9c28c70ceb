"""Motions as polynomials of degree 7, as Crazyflies hold them on board.

A piece is a duration and eight coefficients for each of x, y, z and yaw, 33 numbers of 4 bytes; 4,096 bytes are there
for all (Crazyflie firmware, ``crtp_commander_high_level.c``). Pieces agree with the motion in position, velocity,
acceleration and jerk where they meet.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BPoly, PPoly

from d4orm_env.core.arrays import Floats
from d4orm_env.verify import VerificationReport
from d4orm_env.verify.discs import verify_curves
from d4orm_planners.setpoints.smoothing import SmoothMotion

MEMORY, PIECE_BYTES = 4096, 132
MOST_PIECES = MEMORY // PIECE_BYTES
CLOSE = 1 / 50
"""Largest distance from the motion that is aimed at, as a share of the smallest robot's radius."""
CHECKS = 32
"""Times a piece at which that distance is looked at."""
AXES = ("x", "y", "z", "yaw")


@dataclass(frozen=True, eq=False)
class Polynomials:
    """Pieces of equal duration.

    Attributes:
        durations: ``(P,)`` [s].
        coefficients: ``(P, K, 4, 8)`` of x, y, z [m] and yaw [rad], from the constant up, by the time in the piece.
        deviation: Largest distance from the motion [m].
        report: What the verification of the polynomials found.
    """

    durations: Floats
    coefficients: Floats
    deviation: float
    report: VerificationReport

    @property
    def num_bytes(self) -> int:
        """On board of one robot."""
        return PIECE_BYTES * len(self.durations)


def fit_polynomials(motion: SmoothMotion, height: float) -> Polynomials:
    """The fewest pieces that stay close to a motion, or as many as there is memory for.

    Args:
        motion: Of the team.
        height: z of a team that moves in the plane [m].

    Raises:
        ValueError: If the motion is too long for as many: robots would touch, or not end at their goals.
    """
    wanted = CLOSE * float(motion.problem.team.radius.min())
    for count in range(1, MOST_PIECES + 1):
        curves, deviation = _pieces(motion, count)
        if deviation <= wanted:
            break
    report = _verified(motion, curves)
    if not report.ok:
        raise ValueError(
            f"{count} polynomials, which is all that {MEMORY} bytes on board hold, are up to {deviation:.3g} m off a "
            f"motion of {motion.duration:.0f} s: {report.violations[0]}; export shorter plans one after the other"
        )
    return Polynomials(np.diff(curves.x), _coefficients(motion, curves, height), deviation, report)


def _pieces(motion: SmoothMotion, count: int) -> tuple[PPoly, float]:
    """Positions and headings ``(K, d+1)`` in so many pieces, and how far the positions are off [m]."""
    ends = np.linspace(0, motion.duration, count + 1)
    values = [
        np.concatenate([motion.position(ends, order), motion.heading(ends, order)[..., None]], axis=2)
        for order in range(4)
    ]
    curves = PPoly.from_bernstein_basis(BPoly.from_derivatives(ends, np.stack(values, axis=1)))
    times = np.linspace(0, motion.duration, count * CHECKS + 1)
    offset = curves(times)[..., :-1] - motion.position(times)
    return curves, float(np.linalg.norm(offset, axis=2).max())


def _verified(motion: SmoothMotion, curves: PPoly) -> VerificationReport:
    times = np.linspace(0, motion.duration, (len(curves.x) - 1) * CHECKS + 1)
    bend = np.linalg.norm(curves(times, nu=2)[..., :-1], axis=2).max(axis=0)
    return verify_curves(motion.problem, lambda times: curves(times)[..., :-1], motion.duration, bend)


def _coefficients(motion: SmoothMotion, curves: PPoly, height: float) -> Floats:
    ascending = np.moveaxis(curves.c[::-1], 0, -1)  # (P, K, d+1, 8)
    d = motion.problem.dimension
    coefficients = np.zeros((*ascending.shape[:2], len(AXES), ascending.shape[-1]))
    coefficients[:, :, :d], coefficients[:, :, 3] = ascending[:, :, :d], ascending[:, :, d]
    if d == 2:
        coefficients[:, :, 2, 0] = height
    return coefficients
