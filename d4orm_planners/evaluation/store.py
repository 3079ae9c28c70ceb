"""Results of single trials in a SQLite file: written row by row, by any number of processes, each trial once."""

from __future__ import annotations

import os
import sqlite3
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import NamedTuple

APPLICATION_ID = 0x64346F72
"""Marks the file as one of ours, in its header ("d4or")."""
VERSION = 4
STORE = "trials.sqlite"
"""Name of the file in a folder of results."""
PATIENCE = 60.0
"""Seconds to wait for another writer."""


class TrialKey(NamedTuple):
    """What tells one trial from another.

    Attributes:
        policy: Registry name.
        config: All settings of the policy, as JSON with sorted keys.
        problem: :attr:`d4orm_env.core.problem.Problem.digest`.
        noise: Standard deviation of the execution noise, in the controls' units.
        seed: Seed of the episode: of the policy and of the noise.
    """

    policy: str
    config: str
    problem: str
    noise: float
    seed: int


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One episode of one policy and how it ended. The first five fields are its :class:`TrialKey`.

    Attributes:
        policy: See :class:`TrialKey`.
        config: See :class:`TrialKey`.
        problem: See :class:`TrialKey`.
        noise: See :class:`TrialKey`.
        seed: See :class:`TrialKey`.
        label: What the policy with these settings was called.
        scenario: Name of the scenario.
        robots: Team size.
        model: Model names of the team, each once, joined by ``+``.
        dt: Time step [s].
        versions: Versions of the libraries, as JSON; ``{}`` where the process was lost.
        machine: Processor, cores and system, as JSON, likewise.
        date: When the trial ended, UTC, ISO 8601.
        success: Everyone arrived in time, and none was ever in contact.
        verified: Whether :func:`d4orm_env.verify` found no fault with the executed controls; ``None`` if not judged.
        violation: The first fault that it found.
        collided: Robots that were ever in contact.
        arrived: Robots that arrived.
        travel_time: Mean arrival time [s], with the time of the whole episode for a robot that did not arrive.
        makespan: Latest arrival time [s], likewise.
        reward: Mean over steps and robots.
        mean_squared_jerk: See :func:`d4orm_env.core.metrics.mean_squared_jerk` [m^2/s^6].
        steps: Steps of the episode.
        iterations: Iterations of the planner; ``None`` for a policy that executes no plan.
        status: How its solve ended, see :class:`d4orm_planners.plan.Plan`.
        wall_time: Seconds spent planning, or choosing actions.
        preparation: Those of ``wall_time`` before the first action: the whole solve of a plan, the coarse plan of a
            controller; ``None`` in rows that older versions wrote.
        elapsed: Seconds that the trial took, with the environment and the judge.
        history: Moments of the solve at which the best plan so far changed, as JSON: a list of
            ``[seconds, solved (0 or 1), mean reward]``; empty for a policy that executes no plan.
        messages: Candidates that the nodes of a distributed planner sent, each to all others; ``None`` for others.
        message_bytes: Their length together.
        waiting_share: Share of the nodes' time that they waited for each other.
        error: Why there is no outcome; empty for a trial that ran to its end.
    """

    policy: str
    config: str
    problem: str
    noise: float
    seed: int
    label: str
    scenario: str
    robots: int
    model: str
    dt: float
    versions: str = "{}"
    machine: str = "{}"
    date: str = ""
    success: bool = False
    verified: bool | None = None
    violation: str = ""
    collided: int = 0
    arrived: int = 0
    travel_time: float | None = None
    makespan: float | None = None
    reward: float | None = None
    mean_squared_jerk: float | None = None
    steps: int = 0
    iterations: int | None = None
    status: str = ""
    wall_time: float | None = None
    preparation: float | None = None
    elapsed: float | None = None
    history: str = "[]"
    messages: int | None = None
    message_bytes: int | None = None
    waiting_share: float | None = None
    error: str = ""

    @property
    def key(self) -> TrialKey:
        return TrialKey(self.policy, self.config, self.problem, self.noise, self.seed)


_NAMES = tuple(field.name for field in fields(Trial))
_KEY = ", ".join(TrialKey._fields)
_TRUTHS = ("success", "verified")
_CREATE = f"""
CREATE TABLE trials (
    policy TEXT NOT NULL, config TEXT NOT NULL, problem TEXT NOT NULL, noise REAL NOT NULL, seed INTEGER NOT NULL,
    label TEXT NOT NULL, scenario TEXT NOT NULL, robots INTEGER NOT NULL, model TEXT NOT NULL, dt REAL NOT NULL,
    versions TEXT NOT NULL, machine TEXT NOT NULL, date TEXT NOT NULL,
    success INTEGER NOT NULL, verified INTEGER, violation TEXT NOT NULL,
    collided INTEGER NOT NULL, arrived INTEGER NOT NULL,
    travel_time REAL, makespan REAL, reward REAL, mean_squared_jerk REAL,
    steps INTEGER NOT NULL, iterations INTEGER, status TEXT NOT NULL,
    wall_time REAL, preparation REAL, elapsed REAL, history TEXT NOT NULL,
    messages INTEGER, message_bytes INTEGER, waiting_share REAL, error TEXT NOT NULL,
    PRIMARY KEY ({_KEY})
) WITHOUT ROWID
"""
# What has run to its end stays as it is; only a trial that failed may be tried again.
_ADD = (
    f"INSERT INTO trials ({', '.join(_NAMES)}) VALUES ({', '.join('?' * len(_NAMES))}) ON CONFLICT ({_KEY}) "
    + "DO UPDATE SET "
    + ", ".join(f"{name} = excluded.{name}" for name in _NAMES if name not in TrialKey._fields)
    + " WHERE trials.error != ''"
)


class TrialStore:
    """A file of trials, made when there is none. Every method opens and closes it, so instances travel to processes.

    Args:
        path: The file.

    Raises:
        ValueError: If the file is something else, or of another version.
        OSError: If it cannot be opened or written to.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        with self._connection() as connection:
            self._check(connection)
            _use_wal(connection)

    @classmethod
    def existing(cls, path: str | os.PathLike[str]) -> TrialStore:
        """The store in a file, or in a folder under its usual name, which must be there.

        Raises:
            FileNotFoundError: If there is none.
            ValueError: If the file is something else, or of another version.
        """
        file = Path(path) / STORE if Path(path).is_dir() else Path(path)
        if not file.is_file():
            raise FileNotFoundError(f"there is no store of trials at {file}; `d4orm evaluate` makes one")
        return cls(file)

    def add(self, *trials: Trial) -> int:
        """Store trials, durably and at once: all of them or, after an error, none.

        Returns:
            How many were new, or took the place of one that had failed; a finished trial is never overwritten.
        """
        with self._connection() as connection:
            connection.execute("BEGIN IMMEDIATE")
            added = connection.executemany(_ADD, [astuple(trial) for trial in trials]).rowcount
            connection.execute("COMMIT")
        return int(added)

    def trials(self) -> list[Trial]:
        """All trials, in order of key."""
        with self._connection() as connection:
            rows = connection.execute(f"SELECT {', '.join(_NAMES)} FROM trials ORDER BY {_KEY}").fetchall()
        trials = []
        for row in rows:
            values = dict(zip(_NAMES, row))
            for name in _TRUTHS:  # SQLite keeps truth values as numbers
                values[name] = None if values[name] is None else bool(values[name])
            trials.append(Trial(**values))
        return trials

    def finished(self) -> set[TrialKey]:
        """Keys of all trials that ran to their end."""
        with self._connection() as connection:
            return {TrialKey(*row) for row in connection.execute(f"SELECT {_KEY} FROM trials WHERE error = ''")}

    @contextmanager
    def _connection(self) -> Iterator[sqlite3.Connection]:
        try:
            with closing(sqlite3.connect(self.path, timeout=PATIENCE, isolation_level=None)) as connection:
                yield connection
        except sqlite3.OperationalError as error:
            raise OSError(
                f"trial store {self.path} cannot be used: {error}; free some space or choose another folder"
            ) from error
        except sqlite3.DatabaseError as error:
            raise self._foreign(str(error)) from error

    def _check(self, connection: sqlite3.Connection) -> None:
        """Make the table in a new file; refuse a file of another kind or version, which stays untouched."""
        if _pragma(connection, "application_id") != APPLICATION_ID:
            # One transaction, so that of two processes that find no file one makes the table.
            connection.execute("BEGIN IMMEDIATE")
            if _pragma(connection, "application_id") == 0 and _pragma(connection, "schema_version") == 0:
                connection.execute(_CREATE)
                connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
                connection.execute(f"PRAGMA user_version = {VERSION}")
            connection.execute("COMMIT")
        if _pragma(connection, "application_id") != APPLICATION_ID:
            raise self._foreign("it is another program's database")
        if (version := _pragma(connection, "user_version")) != VERSION:
            raise self._foreign(f"it has version {version}, and this program reads version {VERSION}")

    def _foreign(self, reason: str) -> ValueError:
        return ValueError(f"{self.path} is no store of trials ({reason}); choose another folder or remove it")


def _use_wal(connection: sqlite3.Connection) -> None:
    """Let readers and a writer not wait for each other; the file remembers it."""
    deadline = time.monotonic() + PATIENCE
    while True:
        try:
            connection.execute("PRAGMA journal_mode = WAL")
            return
        except sqlite3.OperationalError as error:
            # SQLite's own patience does not cover this statement.
            if error.sqlite_errorcode & 0xFF != sqlite3.SQLITE_BUSY or time.monotonic() > deadline:
                raise
            time.sleep(0.01)


def _pragma(connection: sqlite3.Connection, name: str) -> int:
    return int(connection.execute(f"PRAGMA {name}").fetchone()[0])
