"""A SQLite file of trials: opened and closed by every access, and what is said of one that cannot be used."""

from __future__ import annotations

import os
import sqlite3
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from d4orm_env.core.errors import FileAccessError

APPLICATION_ID = 0x64346F72  #: Marks the file as one of ours, in its header ("d4or")
VERSION = 10
TIMEOUT = 60.0  #: Seconds to wait for another writer


class SqliteFile:
    """A file with a table ``trials`` of these columns, see :class:`~d4orm_planners.evaluation.store.TrialStore`."""

    def __init__(self, path: str | os.PathLike[str], columns: str, read_only: bool, alone: bool) -> None:
        self.path = Path(path)
        self._read_only, self._alone = read_only, alone
        with self._connection() as connection:
            if not read_only:
                self._make(connection, columns)
            self._check(connection)
            if not (read_only or alone):
                use_wal(connection)

    @contextmanager
    def _connection(self) -> Iterator[sqlite3.Connection]:
        try:
            with closing(self._opened()) as connection:
                yield connection
        except sqlite3.OperationalError as error:
            # A statement does not fit the tables, or without a code of SQLite's, a text is no UTF-8.
            if getattr(error, "sqlite_errorcode", sqlite3.SQLITE_ERROR) & 0xFF == sqlite3.SQLITE_ERROR:
                raise self._damaged(str(error)) from error
            action, remedy = (
                ("read", "copy it with all files beside it to a folder that can be written to")
                if self._read_only
                else ("used", "free some space or choose another folder")
            )
            raise FileAccessError(f"trial store {self.path} cannot be {action}: {error}; {remedy}") from error
        except sqlite3.DatabaseError as error:
            if error.sqlite_errorcode == sqlite3.SQLITE_NOTADB:
                raise self._foreign(str(error)) from error
            raise self._damaged(str(error)) from error
        except UnicodeDecodeError as error:
            raise self._damaged(str(error)) from error

    def _opened(self) -> sqlite3.Connection:
        name = self.path.absolute().as_uri()
        log = self.path.with_name(f"{self.path.name}-wal")
        if self._read_only and not os.access(self.path.parent, os.W_OK) and not (log.exists() and log.stat().st_size):
            # SQLite cannot make the files that it keeps beside the store, and no writer has left anything in them.
            name += "?mode=ro&immutable=1"
        elif self._alone:
            name += "?nolock=1"
        return sqlite3.connect(name, uri=True, timeout=TIMEOUT, isolation_level=None)

    def _make(self, connection: sqlite3.Connection, columns: str) -> None:
        if _pragma(connection, "application_id") != APPLICATION_ID:
            # One transaction, so that of two processes that find no file one makes the table.
            connection.execute("BEGIN IMMEDIATE")
            if _pragma(connection, "application_id") == 0 and _pragma(connection, "schema_version") == 0:
                connection.execute(f"CREATE TABLE trials {columns}")
                connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
                connection.execute(f"PRAGMA user_version = {VERSION}")
            connection.execute("COMMIT")

    def _check(self, connection: sqlite3.Connection) -> None:
        """Refuse a file of another kind or version, which stays untouched."""
        if _pragma(connection, "application_id") != APPLICATION_ID:
            raise self._foreign("it is another program's database")
        if (version := _pragma(connection, "user_version")) != VERSION:
            raise self._foreign(f"it has version {version}, and this program reads version {VERSION}")

    def _foreign(self, reason: str) -> ValueError:
        return ValueError(f"{self.path} is no store of trials ({reason}); choose another folder or remove it")

    def _damaged(self, reason: str) -> ValueError:
        return ValueError(
            f"trial store {self.path} is damaged ({reason}); put a copy in its place, or move it away to begin anew"
        )


def use_wal(connection: sqlite3.Connection) -> None:
    """Let readers and a writer not wait for each other; the file remembers it."""
    deadline = time.monotonic() + TIMEOUT
    while True:
        try:
            connection.execute("PRAGMA journal_mode = WAL")
            return
        except sqlite3.OperationalError as error:
            # SQLite's own timeout does not cover this statement.
            if error.sqlite_errorcode & 0xFF != sqlite3.SQLITE_BUSY or time.monotonic() > deadline:
                raise
            time.sleep(0.01)


def _pragma(connection: sqlite3.Connection, name: str) -> int:
    return int(connection.execute(f"PRAGMA {name}").fetchone()[0])
