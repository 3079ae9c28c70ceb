"""Log of a robot, written as things happen, so that it is there even if the robot is killed."""

from __future__ import annotations

import csv
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self

from examples.studies.onboard.course import reward

from d4orm_planners.d_d4orm.node import Event

COLUMNS = (
    "time", "until", "tick", "round", "robot", "event", "of", "message", "bytes", "plan", "reward", "solved"
)  # fmt: skip


class Log:
    """A CSV file with a row per event; times are :func:`time.perf_counter`, the same clock for all processes.

    Args:
        path: The file.
        robot: Its owner.

    Attributes:
        tick: The present tick.
        round: The present round.
        members: Robots that take part in it, by the numbers of their nodes.
    """

    def __init__(self, path: Path, robot: int) -> None:
        self._file = path.open("w", newline="")
        self._writer = csv.DictWriter(self._file, COLUMNS, restval="")
        self._writer.writeheader()
        self._robot = robot
        self._lock = threading.Lock()
        self.tick = self.round = 0
        self.members: Sequence[int] = ()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        with self._lock:
            self._file.close()

    def note(self, event: str, **fields: Any) -> None:
        """Write a row; what happens after the end is not written."""
        now = time.perf_counter()
        row = {"time": now, "until": now, "tick": self.tick, "round": self.round, "robot": self._robot, "event": event}
        with self._lock:
            if not self._file.closed:
                self._writer.writerow(row | fields)
                self._file.flush()

    def observe(self, event: Event, plan: str) -> None:
        """Write what the robot's node did, and with which plan."""
        self.note(
            event.kind,
            time=event.begin,
            until=event.end,
            of=self.members[event.of],
            message=event.sequence,
            bytes=event.size,
            plan=plan,
            reward=f"{reward(event.candidate):.6f}",
            solved=int(event.candidate.solved),
        )
