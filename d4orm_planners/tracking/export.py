"""Setpoints of a smooth motion, sampled at a rate, and files for robots to execute, by format.

Crazyflies hold motions on board as polynomials of degree 7. A piece is a duration and eight coefficients for each of x,
y, z and yaw, 33 numbers of 4 bytes; 4,096 bytes are there for all (Crazyflie firmware,
``crtp_commander_high_level.c``). Pieces agree with the motion in position, velocity, acceleration and jerk where they
meet.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.interpolate import BPoly, BSpline, PPoly, make_interp_spline

from d4orm_env.core.arrays import LARGEST, Floats, positive_number, real_number
from d4orm_env.core.errors import unknown
from d4orm_env.core.files import make_folder, writing
from d4orm_env.core.lazy import LazyModule
from d4orm_env.verify import VerificationReport
from d4orm_planners.tracking.ros_messages import write_bag
from d4orm_planners.tracking.smoothing import SmoothMotion, drive_at_start, least_overhead

if TYPE_CHECKING:
    import pandas as pd
else:
    pd = LazyModule("pandas")

__all__ = ["FORMATS", "ExportReport", "Setpoints", "export_motion", "sample_motion"]

MAX_RATE, MAX_SAMPLES = 1e5, 10**8
MEMORY, PIECE_BYTES = 4096, 132
MOST_PIECES = MEMORY // PIECE_BYTES
CLOSE = 1 / 50  #: Largest distance from the motion that is aimed at, as a share of the smallest robot's radius
CHECKS = 32  #: Times a piece at which that distance is looked at
MEETING = 4  #: Derivatives, the values included, in which pieces agree where they meet
AXES = ("x", "y", "z", "yaw")


@dataclass(frozen=True, eq=False)
class Setpoints:
    """Setpoints for the controllers of ``K`` robots, at ``T`` times a constant period apart.

    Velocity, acceleration and jerk are the exact derivatives of one spline of class C4, which keeps the limits that it
    was made for and was verified to touch nothing, between the samples too.
    """

    time: Floats  #: ``(T,)`` from 0 until all robots are at rest [s]
    position: Floats  #: ``(T, K, d)`` [m]
    velocity: Floats  #: ``(T, K, d)`` [m/s]
    acceleration: Floats  #: ``(T, K, d)`` [m/s^2]
    jerk: Floats  #: ``(T, K, d)`` [m/s^3]
    heading: Floats  #: ``(T, K)`` [rad], not wrapped; zero for robots whose model has none
    stretch: float  #: Times the plan's duration that the motion takes, at least 1
    deviation: float  #: Largest distance from the plan at its steps [m]
    report: VerificationReport  #: What the verification found: least separation and clearance

    def to_dataframe(self) -> pd.DataFrame:
        """A row for each time and robot: ``time``, ``robot``, ``x`` to ``jz`` (``jy`` in the plane), ``heading``.

        Raises:
            ModuleNotFoundError: Without pandas.
        """
        times, robots = self.heading.shape
        index = {"time": np.repeat(self.time, robots), "robot": np.tile(np.arange(robots), times)}
        return pd.DataFrame(index | {name: values.ravel() for name, values in self.columns().items()})

    def columns(self) -> dict[str, Floats]:
        """``(T, K)`` each: ``x``, ``y``, in space ``z``, their derivatives ``v``, ``a`` and ``j``, and ``heading``."""
        kinds = {"": self.position, "v": self.velocity, "a": self.acceleration, "j": self.jerk}
        axes = "xyz"[: self.position.shape[2]]
        found = {f"{kind}{axis}": values[..., i] for kind, values in kinds.items() for i, axis in enumerate(axes)}
        return found | {"heading": self.heading}


def sample_motion(motion: SmoothMotion, rate: float) -> Setpoints:
    """The motion at a rate [Hz], its end included.

    Raises:
        ValueError: If the rate is not positive, or so high that there would be over 10^8 numbers of a kind.
    """
    rate = positive_number(rate, "rate", most=MAX_RATE)
    if rate * motion.duration < 1:
        least = f"{1.01 / motion.duration:.3g}"  # more than the least, however it is rounded
        raise ValueError(f"rate is {rate:g} Hz for a motion of {motion.duration:.3g} s; give at least {least}")
    count = int(np.ceil(motion.duration * rate)) + 1
    robots = motion.problem.num_robots
    if count * robots > MAX_SAMPLES:
        raise ValueError(
            f"rate is {rate:g} Hz for {motion.duration:.0f} s and {robots} robots; use at most "
            f"{0.99 * MAX_SAMPLES / robots / motion.duration:.3g}"
        )
    time = np.arange(count) / rate
    position, velocity, acceleration, jerk = (motion.position(time, order) for order in range(4))
    heading = motion.heading(time)
    return Setpoints(
        time, position, velocity, acceleration, jerk, heading, motion.stretch, motion.deviation, motion.report
    )


class Polynomials(NamedTuple):
    """Pieces of a motion for robots that hold them on board."""

    motion: SmoothMotion  #: What they describe
    durations: Floats  #: ``(P,)``, all equal [s]
    #: ``(P, K, 4, 8)`` of x, y, z [m] and yaw [rad], from the constant up, by the time in the piece
    coefficients: Floats


def fit_polynomials(motion: SmoothMotion, height: float) -> Polynomials:
    """The fewest pieces that stay close to a motion, or as many as there is memory for, as slow as its limits need.

    Args:
        motion: Of the team.
        height: z of a team that moves in the plane [m].

    Raises:
        ValueError: If the motion is too long for as many: robots would touch, or not end at their goals; or those that
            drive at the start would have to drive more slowly.
    """
    for count in range(1, MOST_PIECES + 1):
        curves, deviation = _pieces(motion, count)
        if deviation <= CLOSE * float(motion.problem.team.girth.min()):
            break
    spline = _as_spline(curves)
    ways, turns = (BSpline(spline.t, part, spline.k) for part in (spline.c[..., :-1], spline.c[..., -1]))
    same = replace(motion, curves=ways, headings=turns, deviation=motion.deviation + deviation)
    found, trouble = same.within(), ""
    if found.stretch > (1 + CLOSE) * motion.stretch and drive_at_start(motion.problem):
        trouble = "beyond the limits of robots, and these drive at the start, so they cannot take longer"
    if trouble := trouble or next(map(str, found.report.violations), ""):
        raise ValueError(
            f"{count} polynomials, which is all that {MEMORY} bytes on board hold, are up to {deviation:.3g} m off a "
            f"motion of {motion.duration:.0f} s: {trouble}; export shorter plans one after the other"
        )
    durations, coefficients = np.diff(curves.x) * found.stretch, _coefficients(motion, curves, height)
    return Polynomials(found, durations, coefficients / found.stretch ** np.arange(coefficients.shape[-1]))


def _pieces(motion: SmoothMotion, count: int) -> tuple[PPoly, float]:
    """Positions and headings ``(K, d+1)`` in so many pieces by the plan's time, and how far positions are off [m]."""
    usual = replace(motion, stretch=1.0)
    ends = np.linspace(0, usual.duration, count + 1)
    values = [
        np.concatenate([usual.position(ends, order), usual.heading(ends, order)[..., None]], axis=2)
        for order in range(MEETING)
    ]
    curves = PPoly.from_bernstein_basis(BPoly.from_derivatives(ends, np.stack(values, axis=1)))
    times = np.linspace(0, usual.duration, count * CHECKS + 1)
    offset = curves(times)[..., :-1] - usual.position(times)
    return curves, float(np.linalg.norm(offset, axis=2).max())


def _as_spline(curves: PPoly) -> BSpline:
    """The same as a spline, which motions are made of: through as many of its values as it has coefficients."""
    degree = len(curves.c) - 1
    knots = np.repeat(curves.x, [degree + 1, *[MEETING] * (len(curves.x) - 2), degree + 1])
    sites = np.convolve(knots[1:-1], np.full(degree, 1 / degree), "valid").clip(0, curves.x[-1])
    return make_interp_spline(sites, curves(sites), k=degree, t=knots)


def _coefficients(motion: SmoothMotion, curves: PPoly, height: float) -> Floats:
    ascending = np.moveaxis(curves.c[::-1], 0, -1)  # (P, K, d+1, 8)
    d = motion.problem.dimension
    coefficients = np.zeros((*ascending.shape[:2], len(AXES), ascending.shape[-1]))
    coefficients[:, :, :d], coefficients[:, :, 3] = ascending[:, :, :d], ascending[:, :, d]
    if d == 2:
        coefficients[:, :, 2, 0] = height
    return coefficients


@dataclass(frozen=True)
class ExportReport:
    """Files that were written, and the figures of the motion in them: of the polynomials where these are written."""

    files: tuple[Path, ...]  #: Their paths
    duration: float  #: Of the motion [s]
    stretch: float  #: Times the plan's duration that it takes
    deviation: float  #: Largest distance from the plan at its steps, of polynomials at most [m]
    min_separation: float  #: Least gap between two robots [m]
    min_clearance: float  #: Least gap to an obstacle or bound [m]
    min_overhead: float  #: Least height of a robot above another it flies over [m]; infinite without, or in the plane
    heights: tuple[float, float]  #: Lowest and highest z of any robot [m]
    pieces: int | None = None  #: Polynomials a robot, or ``None``

    @property
    def num_bytes(self) -> int | None:
        """Bytes of the polynomials on board of a robot, of the 4,096 that there are."""
        return None if self.pieces is None else self.pieces * PIECE_BYTES


def _csv(motion: SmoothMotion, setpoints: Setpoints, folder: Path, height: float) -> None:
    columns = setpoints.columns()
    if motion.problem.dimension == 2 and height:
        columns = columns | {"z": np.full_like(setpoints.heading, height)}
    for robot in range(motion.problem.num_robots):
        values = np.column_stack([setpoints.time, *(column[:, robot] for column in columns.values())])
        _write_table(folder / f"robot_{robot}.csv", ["time", *columns], values)


def _crazyswarm2(motion: SmoothMotion, setpoints: Setpoints, folder: Path, height: float) -> Polynomials:
    if motion.problem.dimension == 2 and height <= 0:
        raise ValueError(
            f"height is {height:g} m; a team that moves in the plane flies above 0: give height= (--height), as 1.0"
        )
    if motion.problem.dimension == 3 and (lowest := setpoints.position[..., 2].min(axis=0)).min() <= 0:
        robot = int(lowest.argmin())
        raise ValueError(
            f"robot_{robot} comes down to z = {lowest[robot]:.2f} m, and the floor is at 0; plan with bounds above the "
            "floor, or from a greater height"
        )
    polynomials = fit_polynomials(motion, height)
    header = ["Duration", *(f"{axis}^{power}" for axis in AXES for power in range(8))]
    for robot in range(motion.problem.num_robots):
        rows = polynomials.coefficients[:, robot].reshape(len(polynomials.durations), -1)
        _write_table(folder / f"robot_{robot}.csv", header, np.column_stack([polynomials.durations, rows]))
    return polynomials


def _bag(storage: str, motion: SmoothMotion, setpoints: Setpoints, folder: Path, height: float) -> None:
    write_bag(setpoints, folder / "motion", height, storage)


Writer = Callable[[SmoothMotion, Setpoints, Path, float], Polynomials | None]
"""It writes a motion into an empty folder, and returns the polynomials if that is what it writes."""

FORMATS: Mapping[str, Writer] = MappingProxyType(
    {"csv": _csv, "crazyswarm2": _crazyswarm2, "rosbag2": partial(_bag, "SQLITE3"), "mcap": partial(_bag, "MCAP")}
)
"""``csv``: a table for each robot. ``crazyswarm2``: polynomials of degree 7 for each robot, as its ``uav_trajectories``
reads them. ``rosbag2`` and ``mcap``: a bag of ROS 2 messages, stored as SQLite or MCAP."""


def export_motion(motion: SmoothMotion, form: str, folder: Path, rate: float, height: float) -> ExportReport:
    """Write a motion into a folder, which is made; files that are there stay, but for those of the same names.

    Raises:
        ValueError: If there is no such format, the motion does not fit it, the folder has files of more robots, or it
            cannot be written; nothing is left behind then.
        ModuleNotFoundError: If a library for it is missing; the message names it.
    """
    if not isinstance(form, str) or form not in FORMATS:
        raise unknown("format", form, FORMATS)
    if not abs(height := real_number(height, "height")) <= LARGEST:
        raise ValueError(f"height is {height:g}; it must be at most {LARGEST:g} m in magnitude")
    if height and motion.problem.dimension == 3:
        raise ValueError(f"height is {height:g} m, and this team has heights of its own; leave it out")
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder} is a file; give a folder")
    setpoints = sample_motion(motion, rate)
    make_folder(folder.parent)
    with writing(folder), TemporaryDirectory(dir=folder.parent, prefix=".export") as name:
        polynomials = FORMATS[form](motion, setpoints, Path(name), height)
        names = sorted(path.name for path in Path(name).iterdir())
        _refuse_others(folder, names)
        folder.mkdir(exist_ok=True)
        for entry in names:
            if (folder / entry).is_dir():
                shutil.rmtree(folder / entry)
            (Path(name) / entry).replace(folder / entry)
    if polynomials is not None:
        motion = polynomials.motion
        setpoints = sample_motion(motion, rate)
    heights = setpoints.position[..., 2] if motion.problem.dimension == 3 else np.array(height)
    return ExportReport(
        tuple(folder / entry for entry in names),
        motion.duration,
        motion.stretch,
        motion.deviation,
        motion.report.min_separation,
        motion.report.min_clearance,
        least_overhead(motion.problem, setpoints.position),
        (float(heights.min()), float(heights.max())),
        None if polynomials is None else len(polynomials.durations),
    )


def _refuse_others(folder: Path, names: list[str]) -> None:
    """Refuse a folder with robots' files that would not be replaced: drones would fly another plan beside this one."""
    others = sorted(path.name for path in folder.glob("robot_*.csv") if path.name not in names)
    if others and names[0].startswith("robot_"):
        raise ValueError(
            f"{folder} has {others[0]} of another team, and this one has {len(names)} robots; delete these, or name "
            "another folder"
        )


def _write_table(path: Path, header: list[str], values: Floats) -> None:
    np.savetxt(path, values, fmt="%.9g", delimiter=",", header=",".join(header), comments="")
