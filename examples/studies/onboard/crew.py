"""Starting the robots' processes, and ending them whatever happens."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from pathlib import Path
from types import TracebackType
from typing import Self

from examples.studies.onboard.mission import Mission

GRACE = 15.0
"""Seconds that a robot has to end by itself."""


class RobotProcesses:
    """A process for every robot, which ends with the block at the latest.

    Args:
        mission: Their settings.
        folder: Folder of their logs.
    """

    def __init__(self, mission: Mission, folder: Path) -> None:
        self.logs = [folder / f"robot_{robot}.csv" for robot in range(mission.robots)]
        self.killed: set[int] = set()
        path = folder / "mission.json"
        path.write_text(mission.written())
        root = str(Path(__file__).resolve().parents[3])
        environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH")])),
        }
        command = [sys.executable, "-m", "examples.studies.onboard.robot", str(path)]
        self._processes: list[subprocess.Popen[bytes]] = []
        for robot, log in enumerate(self.logs):
            self._processes.append(subprocess.Popen([*command, str(robot), str(log)], env=environment))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        deadline = time.perf_counter() + (GRACE if kind is None else 0.0)
        for process in self._processes:
            try:
                process.wait(max(deadline - time.perf_counter(), 0))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def check(self) -> None:
        """Raise ``RuntimeError`` if a robot has ended before its time."""
        for robot, process in enumerate(self._processes):
            if process.poll() is not None:
                raise RuntimeError(f"the process of robot_{robot} has ended with status {process.returncode}")

    def kill(self, robot: int) -> None:
        """End one at once, as if its battery had run out."""
        self.killed.add(robot)
        self._processes[robot].kill()

    def statuses(self) -> list[int | None]:
        """Exit statuses, ``None`` for who still runs."""
        return [process.poll() for process in self._processes]


def free_endpoints(number: int) -> list[str]:
    """Endpoints on loopback that nobody listens at."""
    sockets = [socket.create_server(("127.0.0.1", 0)) for _ in range(number)]
    ports = [one.getsockname()[1] for one in sockets]
    for one in sockets:
        one.close()
    return [f"tcp/127.0.0.1:{port}" for port in ports]
