"""Files of setpoints, by format."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType

import numpy as np

from d4orm_env.core.arrays import Floats
from d4orm_env.core.errors import unknown
from d4orm_env.core.problem import Problem
from d4orm_planners.setpoints.polynomials import AXES, PIECE_BYTES, fit_polynomials
from d4orm_planners.setpoints.rosbag import write_bag
from d4orm_planners.setpoints.setpoints import Setpoints, sample_motion
from d4orm_planners.setpoints.smoothing import SmoothMotion

__all__ = ["FORMATS", "ExportReport", "export_motion"]


@dataclass(frozen=True)
class ExportReport:
    """Files that were written, and the figures of the motion in them.

    Attributes:
        files: Their paths.
        duration: Of the motion [s].
        stretch: Times the plan's duration that it takes.
        deviation: Largest distance from the plan at its steps [m].
        min_separation: Least gap between two robots [m].
        min_clearance: Least gap to an obstacle or bound [m].
        min_overhead: Least height of a robot above the centre of another, no farther beside it than both radii and the
            margin [m]; infinite where none flies over another, or the team moves in the plane.
        pieces: Polynomials a robot, or ``None``.
    """

    files: tuple[Path, ...]
    duration: float
    stretch: float
    deviation: float
    min_separation: float
    min_clearance: float
    min_overhead: float
    pieces: int | None = None

    @property
    def num_bytes(self) -> int | None:
        """Bytes of the polynomials on board of a robot, of the 4,096 that there are."""
        return None if self.pieces is None else self.pieces * PIECE_BYTES


def _csv(motion: SmoothMotion, setpoints: Setpoints, folder: Path, height: float) -> int | None:
    columns = setpoints.columns()
    if motion.problem.dimension == 2 and height:
        columns = columns | {"z": np.full_like(setpoints.heading, height)}
    for robot in range(motion.problem.num_robots):
        values = np.column_stack([setpoints.time, *(column[:, robot] for column in columns.values())])
        _write_table(folder / f"robot_{robot}.csv", ["time", *columns], values)
    return None


def _crazyswarm2(motion: SmoothMotion, setpoints: Setpoints, folder: Path, height: float) -> int | None:
    if motion.problem.dimension == 2 and height <= 0:
        raise ValueError(f"height is {height:g} m; a team that moves in the plane flies at a height above 0")
    polynomials = fit_polynomials(motion, height)
    header = ["Duration", *(f"{axis}^{power}" for axis in AXES for power in range(8))]
    for robot in range(motion.problem.num_robots):
        rows = polynomials.coefficients[:, robot].reshape(len(polynomials.durations), -1)
        _write_table(folder / f"robot_{robot}.csv", header, np.column_stack([polynomials.durations, rows]))
    return len(polynomials.durations)


def _bag(storage: str, motion: SmoothMotion, setpoints: Setpoints, folder: Path, height: float) -> int | None:
    write_bag(setpoints, folder / "motion", height, storage)
    return None


Writer = Callable[[SmoothMotion, Setpoints, Path, float], int | None]
"""It writes a motion into an empty folder, and returns how many polynomials a robot has."""

FORMATS: Mapping[str, Writer] = MappingProxyType(
    {"csv": _csv, "crazyswarm2": _crazyswarm2, "rosbag2": partial(_bag, "SQLITE3"), "mcap": partial(_bag, "MCAP")}
)
"""``csv``: a table for each robot. ``crazyswarm2``: polynomials of degree 7 for each robot, as its ``uav_trajectories``
reads them. ``rosbag2`` and ``mcap``: a bag of ROS 2 messages, stored as SQLite or MCAP."""


def export_motion(motion: SmoothMotion, form: str, folder: Path, rate: float, height: float) -> ExportReport:
    """Write a motion into a folder, which is made; files that are there stay, but for those of the same names.

    Raises:
        ValueError: If there is no such format, or the motion does not fit it.
        ModuleNotFoundError: If a library for it is missing; the message names it.
        OSError: If it cannot be written; nothing is left behind then.
    """
    if form not in FORMATS:
        raise unknown("format", form, FORMATS)
    if not np.isfinite(height):
        raise ValueError(f"height is {height!r}; it must be finite")
    if height and motion.problem.dimension == 3:
        raise ValueError(f"height is {height:g} m, and this team has heights of its own; leave it out")
    setpoints = sample_motion(motion, rate)
    folder.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(dir=folder.parent, prefix=".export") as name:
        pieces = FORMATS[form](motion, setpoints, Path(name), height)
        names = sorted(path.name for path in Path(name).iterdir())
        folder.mkdir(exist_ok=True)
        for entry in names:
            if (folder / entry).is_dir():
                shutil.rmtree(folder / entry)
            (Path(name) / entry).replace(folder / entry)
    return ExportReport(
        tuple(folder / entry for entry in names),
        motion.duration,
        motion.stretch,
        motion.deviation,
        motion.report.min_separation,
        motion.report.min_clearance,
        _least_overhead(motion.problem, setpoints.position),
        pieces,
    )


def _least_overhead(problem: Problem, places: Floats) -> float:
    """See :attr:`ExportReport.min_overhead`; ``places`` are ``(T, K, d)`` [m]."""
    least, reach = np.inf, problem.team.radius.astype(np.float64)
    if problem.dimension == 2:
        return least
    for robot in range(1, problem.num_robots):
        apart = np.abs(places[:, :robot] - places[:, robot, None])
        beside = np.hypot(apart[..., 0], apart[..., 1]) <= reach[:robot] + reach[robot] + problem.margin
        least = min(least, float(apart[..., 2][beside].min(initial=np.inf)))
    return least


def _write_table(path: Path, header: list[str], values: Floats) -> None:
    np.savetxt(path, values, fmt="%.9g", delimiter=",", header=",".join(header), comments="")
