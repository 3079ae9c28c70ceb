"""Dynamic obstacles: bodies that drive through the team without regard for it, and those on given trajectories."""

from __future__ import annotations

import csv
from collections import defaultdict
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from d4orm_env.core.arrays import (
    LARGEST,
    FloatArray,
    Floats,
    Frozen,
    IntArray,
    frozen_array,
    positive_number,
    short_repr,
    whole_number,
)
from d4orm_env.core.files import checked_path
from d4orm_env.core.observation_layout import BoundsSlack
from d4orm_env.core.problem import Problem
from d4orm_env.disturbances.disturbance import Disturbance, DisturbanceEffect, Kept, M, Scene, level, standard_deviation
from d4orm_env.disturbances.draws import Draws

MAX_INTRUDERS = 100
_radius = partial(positive_number, least=1e-3, most=LARGEST)
_TRIES = 16


class Courses(NamedTuple):
    """Bodies ``(B, N, 2 d + 1)``, as in :class:`~d4orm_env.disturbances.Observed`, and how long ``(B, N)`` each still
    takes to leave the area [s].
    """

    bodies: FloatArray
    time: FloatArray


@dataclass(frozen=True)
class _Bodies(Disturbance[M]):
    """Bodies that are no robots, the first of what is remembered; they change neither states nor controls."""

    @property
    def replayable(self) -> bool:
        return True

    def effect(self, memory: M, scene: Scene) -> DisturbanceEffect:
        return DisturbanceEffect(bodies=memory[0])  # type: ignore[arg-type] # they are float32


@dataclass(frozen=True)
class Intruder(_Bodies[Courses]):
    """Bodies, discs or balls, that cross the team's area on straight lines at constant speed, one after another.

    Robots see them as they see robots, and ``env.state()`` ends with them, see :mod:`d4orm_env.envs.joint_state`.
    Touching one is a collision, and the paper's reward of a robot within the margin of one is 1 less.

    The area is the ball round all starts and goals, and there are always ``count`` of them in it: one that has left
    enters anew somewhere else, and at first they are anywhere on their lines. Obstacles and walls do not stop them. A
    line passes through a random point between starts and goals in a random direction, but not where it would meet
    robots at rest at their starts or goals, for these cannot yield; if sixteen tries find no such line, it is the one
    that stays farthest from them.
    """

    #: Number of them, at most 100
    count: int = level(partial(whole_number, minimum=0, maximum=MAX_INTRUDERS), 1, off=0)
    speed: float = level(standard_deviation, 0.5)  #: [m/s]
    radius: float = level(_radius, 0.15)  #: [m]

    def slack(self, problem: Problem) -> BoundsSlack:
        faster = max(0.0, self.speed - float(problem.team.max_speed.max()))
        return BoundsSlack(distance=2 * self._room(problem) + self.speed * problem.dt, speed=faster, radius=self.radius)

    def _room(self, problem: Problem) -> float:
        """Return the distance that keeps an intruder clear of any robot [m]."""
        return self.radius + float(problem.team.radius.max()) + 2 * problem.margin

    def begin(self, scene: Scene, draws: Draws) -> Courses:
        bodies, time = self._courses(scene, draws)
        gone, d = time * draws.uniform(self.count), scene.problem.dimension
        bodies[..., :d] += gone[..., None] * bodies[..., d : 2 * d]
        return Courses(bodies, time - gone)

    def move(
        self, states: FloatArray, controls: FloatArray, memory: Courses, scene: Scene, draws: Draws
    ) -> tuple[FloatArray, FloatArray]:
        d, dt = scene.problem.dimension, np.float32(scene.problem.dt)
        memory.bodies[..., :d] += dt * memory.bodies[..., d : 2 * d]
        memory.time[:] -= dt
        out = memory.time < 0
        if out.any():
            worlds = np.flatnonzero(out.any(axis=1))
            left = out[worlds]
            for past, fresh in zip(memory, self._courses(scene.of(worlds), draws.of(worlds))):
                past[out] = fresh[left]
        return states, controls

    def _courses(self, scene: Scene, draws: Draws) -> Courses:
        """New lines for all worlds, their bodies at the beginning."""
        d, room = scene.problem.dimension, np.float32(self._room(scene.problem))
        endpoints = np.concatenate([scene.start[..., :d], scene.goal], axis=1)
        low, high = endpoints.min(axis=1), endpoints.max(axis=1)
        centre, half = (low + high) / 2, (high - low) / 2
        reach = np.sqrt((half * half).sum(axis=-1)) + room
        heading = draws.direction(self.count, _TRIES, d)
        through = low[:, None, None] + (high - low)[:, None, None] * draws.uniform(self.count, _TRIES, d)
        gaps = _distances(endpoints[:, None, None], through[..., None, :], heading[..., None, :]).min(axis=-1)
        best = np.minimum(gaps, room).argmax(axis=-1)
        chosen = (np.arange(len(best))[:, None], np.arange(self.count), best)
        heading, through = heading[chosen], through[chosen]
        # From where the line enters the ball to where it leaves it.
        offset = centre[:, None] - through
        middle = (offset * heading).sum(axis=-1)
        half_chord = np.sqrt(np.maximum(reach[:, None] ** 2 - (offset * offset).sum(axis=-1) + middle * middle, 0))
        positions = through + (middle - half_chord)[..., None] * heading
        speed, radius = np.float32(self.speed), np.full((*positions.shape[:-1], 1), self.radius, np.float32)
        time = 2 * half_chord / np.maximum(speed, np.float32(1e-6))
        return Courses(np.concatenate([positions, speed * heading, radius], axis=-1), time)


def _distances(points: FloatArray, through: FloatArray, heading: FloatArray) -> FloatArray:
    """``(...)`` distances of points from lines [m]; all arguments ``(..., d)``."""
    offset = points - through
    along = (offset * heading).sum(axis=-1)
    return np.sqrt(np.maximum((offset * offset).sum(axis=-1) - along * along, 0))


_COLUMNS = ("id", "time", "x", "y")
_ROUNDING = 1e-6
"""Rounding of the time after so many steps [s]."""


@dataclass(frozen=True, eq=False)
class MovingObstacle(Frozen, _Bodies[Kept]):
    """A body, disc or ball, or several, on a given trajectory: it meets robots as an :class:`Intruder` does.

    Between the times it moves on straight lines. It is absent before the first time and after the last, and where its
    position or the next one is NaN.

    Raises:
        ValueError: If times do not increase, positions do not fit them or are half NaN, or the radius is not positive.
    """

    times: ArrayLike  #: ``(T,)`` increasing, two or more, from the beginning of the episode [s]
    positions: ArrayLike  #: ``(T, d)``, or ``(T, N, d)`` of at most 100 bodies [m]
    radius: float = level(_radius, 0.15)  #: [m]

    def __post_init__(self) -> None:
        super().__post_init__()
        times = frozen_array(self.times, "MovingObstacle times", (None,), largest=LARGEST).astype(np.float64)
        try:
            positions = np.array(self.positions, np.float64)
        except (TypeError, ValueError):
            positions = np.empty(0)
        if len(times) < 2 or (np.diff(times) <= 0).any():
            raise ValueError(f"MovingObstacle times are {short_repr(times.tolist())}; give two or more that increase")
        if positions.ndim == 2:
            positions = positions[:, None]
        if positions.ndim != 3 or len(positions) != len(times) or not 1 <= positions.shape[1] <= MAX_INTRUDERS:
            raise ValueError(
                f"MovingObstacle positions are {short_repr(self.positions)}; they must be numbers (T, d), or (T, N, d) "
                f"of at most {MAX_INTRUDERS} bodies, for {len(times)} times"
            )
        if (np.abs(positions) > LARGEST).any():
            raise ValueError(f"MovingObstacle positions must be at most {LARGEST:g} m in magnitude, or NaN")
        for row in positions[np.isnan(positions).any(axis=2) & ~np.isnan(positions).all(axis=2)][:1]:
            raise ValueError(f"MovingObstacle position {row.tolist()} is half NaN; give all of it, or NaN for absent")
        self._set(times=times, positions=positions)

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
        times, positions = self._track
        endpoints = np.concatenate([problem.start[:, : problem.dimension], problem.goal])
        beyond = np.maximum(positions - endpoints.max(axis=0), endpoints.min(axis=0) - positions)
        speed = np.linalg.norm(np.diff(positions, axis=0), axis=-1) / np.diff(times)[:, None]
        return BoundsSlack(
            distance=float(np.linalg.norm(np.maximum(np.nan_to_num(beyond), 0), axis=-1).max()),
            speed=max(0.0, float(np.nan_to_num(speed).max()) - float(problem.team.max_speed.max())),
            radius=self.radius,
        )

    def begin(self, scene: Scene, draws: Draws) -> Kept:
        return Kept(self._at(scene.steps, scene.problem.dt))

    def move(
        self, states: FloatArray, controls: FloatArray, memory: Kept, scene: Scene, draws: Draws
    ) -> tuple[FloatArray, FloatArray]:
        memory.values[:] = self._at(scene.steps + 1, scene.problem.dt)
        return states, controls

    def _at(self, steps: IntArray, dt: float) -> FloatArray:
        """``(B, N, 2 d + 1)`` bodies after ``(B,)`` steps; all zeros for one that is absent."""
        times, positions = self._track
        now = steps.astype(np.float64) * dt
        index = np.clip(np.searchsorted(times, now + _ROUNDING, side="right") - 1, 0, len(times) - 2)
        begin, duration = positions[index], (times[index + 1] - times[index])[:, None, None]
        velocity = (positions[index + 1] - begin) / duration
        position = begin + (now - times[index])[:, None, None] * velocity
        radius = np.full((*position.shape[:-1], 1), self.radius)
        inside = (now >= times[0] - _ROUNDING) & (now <= times[-1] + _ROUNDING)
        present = inside[:, None, None] & np.isfinite(position).all(axis=-1, keepdims=True)
        return np.where(present, np.concatenate([position, velocity, radius], axis=-1), 0).astype(np.float32)


def load_pedestrians(path: str | Path, radius: float = 0.25) -> MovingObstacle:
    """Read recorded pedestrians from a CSV file with the columns ``id``, ``time`` [s], ``x`` and ``y`` [m].

    Other columns do not matter, and rows may have any order. Everyone is there from the first to the last row with his
    id, on straight lines between them, and time counts from the earliest row.

    Args:
        path: The file.
        radius: Of everyone [m].

    Raises:
        ValueError: If the file cannot be read, a column is missing, a value is no finite number, there are fewer than
            two times, or somebody is at two places at one time.
    """
    try:
        with checked_path(path, "a file of pedestrians").open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file, skipinitialspace=True)
            names = reader.fieldnames or ()
            rows = [(reader.line_num, row) for row in reader]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = getattr(error, "strerror", None) or error
        raise ValueError(f"{path}: cannot be read ({reason}); give a CSV file of pedestrians, in UTF-8") from None
    missing = [name for name in _COLUMNS if name not in names]
    if missing:
        raise ValueError(f"{path} has no column {', '.join(missing)}; it needs a header with id, time, x and y")
    people: dict[str, dict[float, tuple[float, float]]] = defaultdict(dict)
    for line, row in rows:
        try:
            time, x, y = (float(row[name]) for name in _COLUMNS[1:])
            if not np.isfinite((time, x, y)).all():
                raise ValueError("not finite")
        except (TypeError, ValueError):
            given = ", ".join(short_repr(row[name]) for name in _COLUMNS[1:])
            raise ValueError(f"{path}, line {line}: time, x and y are {given}; give numbers") from None
        if people[row["id"]].setdefault(time, (x, y)) != (x, y):
            raise ValueError(f"{path}, line {line}: {row['id']} is at two places at {time:g} s; give one")
    times = np.unique([time for track in people.values() for time in track])
    if len(times) < 2:
        raise ValueError(f"{path} has rows at {len(times)} different times; give two at least")
    positions = np.full((len(times), len(people), 2), np.nan)
    for number, track in enumerate(people.values()):
        own = np.array(sorted(track))
        here = (times >= own[0]) & (times <= own[-1])
        for axis in range(2):
            positions[here, number, axis] = np.interp(times[here], own, [track[time][axis] for time in own])
    return MovingObstacle(times - times[:1], positions, radius)
