"""Results of single trials in a SQLite file: written row by row, by any number of processes, each trial once."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from dataclasses import astuple, dataclass, fields
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

from d4orm_env.core.arrays import LARGEST_WHOLE, short_repr
from d4orm_env.core.errors import MissingFileError
from d4orm_planners.evaluation.sqlite_file import SqliteFile

STORE = "trials.sqlite"  #: Name of the file in a folder of results


@dataclass(frozen=True)
class TrialKey:
    """Key of a trial."""

    policy: str  #: Registry name
    #: All settings of the policy, as JSON with sorted keys; under ``observation`` the arguments of the environment on
    #: what it observes, where there are any
    config: str
    problem: str  #: :attr:`d4orm_env.core.problem.Problem.digest`
    control_noise_std: float  #: Standard deviation of the execution noise, in the controls' units
    seed: int  #: Seed of the episode: of the policy and of the noise
    disturbances: str = "[]"  #: Further disturbances, as JSON: a list of ``[name, attributes]``
    physics: str = "model"  #: Physics of the robots, see :func:`~d4orm_planners.base.episode.find_physics`


class BestSoFar(NamedTuple):
    """The best plan of a solve from some moment on."""

    seconds: float  #: Since the solve began
    solved: int  #: Whether it is a solution, 1 or 0
    reward: float  #: Its mean reward
    steps: int | None = None  #: Denoising steps done; ``None`` where it is not known
    denoising: float | None = None  #: Share of the seconds that these took, likewise


@dataclass(frozen=True, kw_only=True)
class Trial(TrialKey):
    """One episode of one policy and how it ended: a row of the store, a column per field, its key first."""

    label: str  #: Name of the policy with these settings
    scenario: str  #: Name of the scenario, with the arguments that it was given
    num_robots: int  #: Team size
    model: str  #: Model names of the team, each once, joined by ``+``
    dt: float  #: Time step [s]
    versions: str = "{}"  #: Versions of the libraries, as JSON; ``{}`` where the process was lost
    machine: str = "{}"  #: Processor, cores and system, as JSON, likewise
    date: str = ""  #: Time at which the trial ended, UTC, ISO 8601
    success: bool = False  #: Everyone arrived in time, and none was ever in contact
    verified: bool | None = None  #: :func:`d4orm_env.verify` found no fault in the controls; ``None`` if not judged
    violation: str = ""  #: The first fault that it found
    collided: int = 0  #: Robots that were ever in contact
    arrived: int = 0  #: Robots that arrived
    travel_time: float | None = None  #: Mean arrival time [s], the whole episode's for a robot that did not arrive
    makespan: float | None = None  #: Latest arrival time [s], likewise
    #: Path travelled over the shortest path, see :func:`d4orm_env.core.trajectory.mean_stretch`; ``None`` if no robot
    #: arrived, and in rows that older versions wrote
    stretch: float | None = None
    reward: float | None = None  #: Mean over steps and robots
    mean_squared_jerk: float | None = None  #: See :func:`d4orm_env.core.trajectory.mean_squared_jerk` [m^2/s^6]
    steps: int = 0  #: Steps of the episode
    iterations: int | None = None  #: Iterations of the planner; ``None`` for a policy that executes no plan
    denoising_share: float | None = None  #: Share of them that denoised; 0 for search and path finding alone
    status: str = ""  #: End of its solve, see :class:`d4orm_planners.base.plan.Plan`
    wall_time: float | None = None  #: Seconds spent planning, or choosing actions
    #: Those of ``wall_time`` before the first action: the whole solve of a plan, the coarse plan of a controller;
    #: ``None`` in rows that older versions wrote
    preparation: float | None = None
    #: Seconds of training behind a learned policy, all before it included, where its file tells; else ``None``
    training_time: float | None = None
    elapsed: float | None = None  #: Seconds that the trial took, with the environment and the judge
    #: Times in the solve at which the best plan so far changed, as JSON: a list of :attr:`progress`, without its last
    #: two in rows that older versions wrote; empty for a policy that executes no plan.
    history: str = "[]"
    messages: int | None = None  #: Candidates that a distributed planner's nodes sent, each to all others
    message_bytes: int | None = None  #: Their length together
    waiting_share: float | None = None  #: Share of the nodes' time that they waited for each other
    error: str = ""  #: Why there is no outcome; empty for a trial that ran to its end

    @property
    def key(self) -> TrialKey:
        return TrialKey(*(getattr(self, name) for name in _KEYS))

    @cached_property
    def progress(self) -> list[BestSoFar]:
        """:attr:`history`, point by point."""
        return [BestSoFar(*point) for point in json.loads(self.history)]

    @property
    def decision_time(self) -> float | None:
        """Mean seconds of choosing the actions of one step, after the preparation; ``None`` where it is not known."""
        if self.wall_time is None or self.preparation is None or not self.steps:
            return None
        return (self.wall_time - self.preparation) / self.steps

    @property
    def denoising_steps(self) -> int | None:
        """Denoising steps until the last better plan; ``None`` where they are not known."""
        return self.progress[-1].steps if self.progress else None

    @property
    def denoising_time_share(self) -> float | None:
        """Share of the time until then that they took; ``None`` where it is not known."""
        return 0.0 if self.denoising_steps == 0 else self.progress[-1].denoising if self.progress else None


_NAMES = tuple(field.name for field in fields(Trial))
_KEYS = tuple(field.name for field in fields(TrialKey))
_KEY = ", ".join(_KEYS)
_TRUTHS = ("success", "verified")
_MACHINE = {"processor", "cores", "cores_used", "python"}  #: Least keys of a machine's description


def _are_lists(content: Any, *lengths: int) -> bool:
    return isinstance(content, list) and all(isinstance(entry, list) and len(entry) in lengths for entry in content)


_JSON: Mapping[str, Callable[[Any], bool]] = {
    "config": lambda content: isinstance(content, dict),
    "versions": lambda content: isinstance(content, dict),
    "machine": lambda content: content == {} or (isinstance(content, dict) and content.keys() >= _MACHINE),
    "history": lambda content: _are_lists(content, 3, 4, 5),
    "disturbances": lambda content: _are_lists(content, 2) and all(isinstance(levels, dict) for _, levels in content),
}
"""Checks of the columns that must be JSON."""
_SQL = {"str": "TEXT", "int": "INTEGER", "float": "REAL", "bool": "INTEGER"}
_PYTHON: Mapping[str, tuple[type, ...]] = {
    "str": (str,),
    "int": (int,),
    "float": (float, int),
    "bool": (int,),
    "None": (type(None),),
}
_TYPES = {field.name: str(field.type).split(" | ") for field in fields(Trial)}
_KINDS = {name: tuple(chain(*(_PYTHON[kind] for kind in kinds))) for name, kinds in _TYPES.items()}
"""Types of a row's values, by column."""
_COLUMNS = {name: f"{name} {_SQL[kinds[0]]}{'' if 'None' in kinds else ' NOT NULL'}" for name, kinds in _TYPES.items()}
_TABLE = f"({', '.join(_COLUMNS.values())}, PRIMARY KEY ({_KEY})) WITHOUT ROWID"
# What has run to its end stays as it is; only a trial that failed may be tried again.
_ADD = (
    f"INSERT INTO trials ({', '.join(_NAMES)}) VALUES ({', '.join('?' * len(_NAMES))}) ON CONFLICT ({_KEY}) "
    + "DO UPDATE SET "
    + ", ".join(f"{name} = excluded.{name}" for name in _NAMES if name not in _KEYS)
    + " WHERE trials.error != ''"
)


class TrialStore(SqliteFile):
    """A file of trials, made when there is none. Every method opens and closes it, so instances travel to processes.

    Args:
        path: The file.
        read_only: Leave it as it is, which must be there then; its folder need not be writable.
        alone: No other process opens it, so that no locks are taken, which some network file systems do not have.

    Raises:
        ValueError: If the file is something else, of another version, or cannot be opened or written to.
    """

    def __init__(self, path: str | os.PathLike[str], *, read_only: bool = False, alone: bool = False) -> None:
        super().__init__(path, _TABLE, read_only, alone)

    @classmethod
    def existing(cls, path: str | os.PathLike[str]) -> TrialStore:
        """The store in a file, or in a folder under its usual name, which must be there; to read only.

        Raises:
            MissingFileError: If there is none.
            ValueError: If the file is something else, or of another version.
        """
        file = Path(path) / STORE if Path(path).is_dir() else Path(path)
        if not file.is_file():
            raise MissingFileError(f"there is no store of trials at {path}; `d4orm evaluate` makes one")
        return cls(file, read_only=True)

    def add(self, *trials: Trial) -> int:
        """Store trials, durably and at once: all of them or, after an error, none.

        Returns:
            How many were new, or took the place of one that had failed; a finished trial is never overwritten.

        Raises:
            ValueError: If a number is too large for the store, or it cannot be written to.
        """
        with self._connection() as connection:
            connection.execute("BEGIN IMMEDIATE")
            try:
                added = connection.executemany(_ADD, [astuple(trial) for trial in trials]).rowcount
            except OverflowError as error:
                largest = max(trial.seed for trial in trials)
                raise ValueError(f"seed is {largest}; a store has room for seeds up to {LARGEST_WHOLE}") from error
            connection.execute("COMMIT")
        return int(added)

    def trials(self) -> list[Trial]:
        """All trials, in order of key."""
        with self._connection() as connection:
            rows = connection.execute(f"SELECT {', '.join(_NAMES)} FROM trials ORDER BY {_KEY}").fetchall()
        return [self._trial(number, dict(zip(_NAMES, row))) for number, row in enumerate(rows)]

    def _trial(self, number: int, values: dict[str, Any]) -> Trial:
        """A row as a trial. SQLite keeps whatever it is given in any column."""
        try:
            return checked_trial(values)
        except ValueError as error:
            raise self._damaged(f"trial {number} {error}") from None

    def finished(self) -> set[TrialKey]:
        """Keys of all trials that ran to their end."""
        with self._connection() as connection:
            rows = connection.execute(f"SELECT {_KEY} FROM trials WHERE error = ''")
            return {TrialKey(*row) for row in rows}


def checked_trial(values: Mapping[str, Any]) -> Trial:
    """A trial of what a file has for each of its attributes; truth values may be numbers.

    Another type is a ValueError, which goes on from the trial's name.
    """
    for name, kinds in _KINDS.items():
        if not isinstance(values[name], kinds) or (name in _JSON and not _is_json(values[name], _JSON[name])):
            raise ValueError(f"has {short_repr(values[name])} as {name}")
    truths = {name: None if values[name] is None else bool(values[name]) for name in _TRUTHS}
    return Trial(**{**values, **truths})


def _is_json(text: str, is_right: Callable[[Any], bool]) -> bool:
    try:
        return is_right(json.loads(text))
    except (ValueError, RecursionError):
        return False
