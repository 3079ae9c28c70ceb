"""Moving obstacles on given trajectories, such as recorded pedestrians."""

from __future__ import annotations

import csv
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from d4orm_env.core.arrays import LARGEST, FloatArray, Floats, IntArray, frozen_array, positive_number
from d4orm_env.core.observation_layout import BoundsSlack
from d4orm_env.core.problem import Problem
from d4orm_env.disturbances.disturbance import Disturbance, DisturbanceEffect, Scene
from d4orm_env.disturbances.draws import Draws
from d4orm_env.disturbances.intruder import MAX_INTRUDERS

_COLUMNS = ("id", "time", "x", "y")
_ROUNDING = 1e-6
"""Rounding of the time after so many steps [s]."""


class BodiesNow(NamedTuple):
    """Bodies ``(B, N, 2 d + 1)``, as in :class:`~d4orm_env.disturbances.Observed`; all zeros for one that is absent."""

    bodies: FloatArray


@dataclass(frozen=True, eq=False)
class MovingObstacle(Disturbance[BodiesNow]):
    """A body, disc or ball, or several, on a given trajectory: it meets robots as an :class:`Intruder` does.

    Between the times it moves on straight lines. It is absent before the first time and after the last, and where its
    position or the next one is NaN.

    Attributes:
        times: ``(T,)`` increasing, two or more, from the beginning of the episode [s].
        positions: ``(T, d)``, or ``(T, N, d)`` of at most 100 bodies [m].
        radius: [m].

    Raises:
        ValueError: If times do not increase, positions do not fit them, or the radius is not positive.
    """

    times: ArrayLike
    positions: ArrayLike
    radius: float = 0.15

    def __post_init__(self) -> None:
        times = frozen_array(self.times, "MovingObstacle times", (None,), largest=LARGEST).astype(np.float64)
        places = np.array(self.positions, np.float64)
        if len(times) < 2 or (np.diff(times) <= 0).any():
            raise ValueError("MovingObstacle times must be two or more, and increase")
        if places.ndim == 2:
            places = places[:, None]
        if places.ndim != 3 or len(places) != len(times) or not 1 <= places.shape[1] <= MAX_INTRUDERS:
            raise ValueError(
                f"MovingObstacle positions have shape {np.shape(self.positions)}; they must be (T, d), or (T, N, d) of "
                f"at most {MAX_INTRUDERS} bodies, for {len(times)} times"
            )
        if (np.abs(places) > LARGEST).any():
            raise ValueError(f"MovingObstacle positions must be at most {LARGEST:g} m in magnitude, or NaN")
        radius = positive_number(self.radius, "MovingObstacle radius", least=1e-3, most=LARGEST)
        for name, value in {"times": times, "positions": places, "radius": radius}.items():
            object.__setattr__(self, name, value)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, MovingObstacle) and self._content == other._content

    def __hash__(self) -> int:
        return hash(self._content)

    @property
    def _content(self) -> tuple[object, ...]:
        times, places = self._track
        return times.tobytes(), places.shape, places.tobytes(), self.radius

    @property
    def replayable(self) -> bool:
        return True  # it changes neither states nor controls

    @property
    def _track(self) -> tuple[Floats, Floats]:
        """``(T,)`` times and ``(T, N, d)`` positions."""
        return np.asarray(self.times), np.asarray(self.positions)

    def check(self, problem: Problem) -> None:
        d = self._track[1].shape[-1]
        if d != problem.dimension:
            raise ValueError(
                f"MovingObstacle positions have {d} components, and the robots move in {problem.dimension} dimensions; "
                "give as many"
            )

    def slack(self, problem: Problem) -> BoundsSlack:
        times, places = self._track
        stands = np.concatenate([problem.start[:, : problem.dimension], problem.goal])
        beyond = np.maximum(places - stands.max(axis=0), stands.min(axis=0) - places)
        speed = np.linalg.norm(np.diff(places, axis=0), axis=-1) / np.diff(times)[:, None]
        return BoundsSlack(
            distance=float(np.linalg.norm(np.maximum(np.nan_to_num(beyond), 0), axis=-1).max()),
            speed=max(0.0, float(np.nan_to_num(speed).max()) - float(problem.team.max_speed.max())),
            radius=self.radius,
        )

    def begin(self, scene: Scene, draws: Draws) -> BodiesNow:
        return BodiesNow(self._at(scene.steps, scene.problem.dt))

    def move(
        self, states: FloatArray, controls: FloatArray, memory: BodiesNow, scene: Scene, draws: Draws
    ) -> tuple[FloatArray, FloatArray]:
        memory.bodies[:] = self._at(scene.steps + 1, scene.problem.dt)
        return states, controls

    def effect(self, memory: BodiesNow, scene: Scene) -> DisturbanceEffect:
        return DisturbanceEffect(bodies=memory.bodies)

    def _at(self, steps: IntArray, dt: float) -> FloatArray:
        """``(B, N, 2 d + 1)`` bodies after ``(B,)`` steps."""
        times, places = self._track
        now = steps.astype(np.float64) * dt
        index = np.clip(np.searchsorted(times, now + _ROUNDING, side="right") - 1, 0, len(times) - 2)
        begin, duration = places[index], (times[index + 1] - times[index])[:, None, None]
        velocity = (places[index + 1] - begin) / duration
        place = begin + (now - times[index])[:, None, None] * velocity
        radius = np.full((*place.shape[:-1], 1), self.radius)
        inside = (now >= times[0] - _ROUNDING) & (now <= times[-1] + _ROUNDING)
        there = inside[:, None, None] & np.isfinite(place).all(axis=-1, keepdims=True)
        return np.where(there, np.concatenate([place, velocity, radius], axis=-1), 0).astype(np.float32)


def load_pedestrians(path: str | Path, radius: float = 0.25) -> MovingObstacle:
    """Read recorded pedestrians from a CSV file with the columns ``id``, ``time`` [s], ``x`` and ``y`` [m].

    Other columns do not matter, and rows may have any order. Everyone is there from the first to the last row with his
    id, on straight lines between them, and time counts from the earliest row.

    Args:
        path: The file.
        radius: Of everyone [m].

    Raises:
        ValueError: If a column is missing, a value is no number, or somebody is at two places at one time.
        OSError: If the file cannot be read.
    """
    with open(path, newline="", encoding="utf-8") as file:
        reader = csv.DictReader(file)
        missing = [name for name in _COLUMNS if name not in (reader.fieldnames or ())]
        if missing:
            raise ValueError(f"{path} has no column {', '.join(missing)}; it needs a header with id, time, x and y")
        people: dict[str, dict[float, tuple[float, float]]] = defaultdict(dict)
        for row in reader:
            try:
                time, x, y = (float(row[name]) for name in _COLUMNS[1:])
            except (TypeError, ValueError):
                raise ValueError(f"{path}, line {reader.line_num}: time, x and y must be numbers") from None
            if people[row["id"]].setdefault(time, (x, y)) != (x, y):
                raise ValueError(f"{path}, line {reader.line_num}: {row['id']} is at two places at {time:g} s")
    times = np.unique([time for track in people.values() for time in track])
    places = np.full((len(times), len(people), 2), np.nan)
    for number, track in enumerate(people.values()):
        own = np.array(sorted(track))
        here = (times >= own[0]) & (times <= own[-1])
        for axis in range(2):
            places[here, number, axis] = np.interp(times[here], own, [track[time][axis] for time in own])
    return MovingObstacle(times - times[:1], places, radius)
