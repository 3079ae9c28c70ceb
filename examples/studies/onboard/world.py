"""The simulated world, which moves all robots as they command, and the processes of the robots."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from examples.studies.onboard.mission import END, Command, Mission, Tick, decode, encode

from d4orm_env import navigation_v0
from d4orm_env.envs.joint_state import JointState, split_state
from d4orm_planners.d_d4orm.transport import Transport

AGAIN = 0.25
"""Seconds after which robots that have not answered are told again, as messages may get lost."""

ENDS, END_PERIOD = 3, 0.1
"""Number of times that the robots are told that it is over, and the seconds between."""

START = 300.0
"""Seconds within which every robot must have answered for the first time."""


@dataclass
class Record:
    """Record of a run, tick by tick."""

    joints: list[JointState] = field(default_factory=list)  #: The joint states, one more than steps
    reached: list[Any] = field(default_factory=list)  #: ``(K,)`` who reached a goal, per step
    collided: list[Any] = field(default_factory=list)  #: ``(K,)`` who touched something, per step
    executing: list[set[str]] = field(default_factory=list)  #: Plans that the robots said they execute, per step
    lost: list[list[int]] = field(default_factory=list)  #: Robots that had been given up, per step
    began: list[float] = field(default_factory=list)  #: Time at which each tick began, by :func:`time.perf_counter` [s]
    answered: list[float] = field(default_factory=list)  #: Seconds until all had answered, per step

    @property
    def steps(self) -> int:
        """Ticks that were simulated, to the end of each."""
        return max(len(self.joints) - 1, 0)

    @property
    def goals_reached(self) -> int:
        """Number of goals reached by all robots."""
        return int(np.sum(self.reached))

    @property
    def wall(self) -> float:
        """Seconds that it took."""
        return self.began[-1] + self.answered[-1] - self.began[0] if self.answered else 0.0


class World:
    """The environment, in lifelong mode, at the other end of the robots' network.

    A tick begins when all robots have answered the one before, but no sooner than real time allows, of which one second
    is ``speed`` simulated ones: a slow robot holds the world up, and one that does not answer within the mission's
    timeout is given up and stops.
    """

    def __init__(self, mission: Mission, robots: Transport, ticks: int, speed: float) -> None:
        self.problem = mission.problem()
        self.record = Record()
        self._mission, self._robots, self._speed = mission, robots, speed
        self._env = navigation_v0.parallel_env(problem=self.problem, lifelong=True, max_cycles=ticks)
        self._env.reset()
        # A step may compile, which must not happen while robots wait.
        self._env.step(dict.fromkeys(self.agents, np.zeros(self.problem.control_size, np.float32)))
        self._env.reset(seed=mission.seed)
        self._lost: set[int] = set()
        self._commands: dict[int, Command] = {}

    def await_robots(self, check: Callable[[], None]) -> None:
        """Wait for the first answer of every robot, and call meanwhile ``check``, which may raise.

        Raises:
            RuntimeError: If a robot does not answer.
        """
        deadline = time.perf_counter() + START
        while missing := self._ask(0, AGAIN):
            check()
            if time.perf_counter() > deadline:
                raise RuntimeError(f"robots {sorted(missing)} have not answered within {START:g} s")

    def run(self, each_tick: Callable[[int], None]) -> None:
        """Simulate to the end; ``each_tick`` is called with the number of every tick before it begins."""
        record, due = self.record, time.perf_counter()
        record.joints.append(split_state(self.problem, self._env.state()))
        while self._env.agents:
            tick = record.steps
            each_tick(tick)
            time.sleep(max(due - time.perf_counter(), 0))
            record.began.append(time.perf_counter())
            due = max(due, record.began[-1] - self.problem.dt / self._speed) + self.problem.dt / self._speed
            missing = self._ask(tick, self._mission.timeout)
            record.answered.append(time.perf_counter() - record.began[-1])
            self._lost |= missing
            self._step()

    def end(self) -> None:
        """Tell the robots that it is over."""
        for _ in range(ENDS):
            self._robots.publish(encode(END))
            time.sleep(END_PERIOD)
        self._env.close()

    def _ask(self, tick: int, seconds: float) -> set[int]:
        """Tell all robots the joint state, and collect their commands; the robots that have not answered in time."""
        state = [float(value) for value in self._env.state()]
        former = [self._commands.get(robot) for robot in range(len(self.agents))]
        ballots = ["" if command is None else command.ballot for command in former]
        rewards = [0.0 if command is None else command.reward for command in former]
        question = encode(Tick(tick, state, sorted(self._lost), ballots, rewards))
        deadline, again = time.perf_counter() + seconds, 0.0
        while missing := set(range(len(self.agents))) - self._lost - self._answered(tick):
            now = time.perf_counter()
            if now >= deadline:
                break
            if now >= again:
                self._robots.publish(question)
                again = now + AGAIN
            for data in self._robots.collect(min(again, deadline) - now):
                self._take(decode(data, Command), tick)
        return missing

    @property
    def agents(self) -> list[str]:
        """Names of the robots."""
        return list(self._env.possible_agents)

    def _answered(self, tick: int) -> set[int]:
        return {robot for robot, command in self._commands.items() if command.number == tick}

    def _take(self, command: Command | None, tick: int) -> None:
        if command is None or command.number != tick or not 0 <= command.robot < len(self.agents):
            return
        if command.robot not in self._lost and len(command.control) == self.problem.control_size:
            self._commands[command.robot] = command

    def _step(self) -> None:
        record, robots = self.record, range(len(self.agents))
        moving = [robot for robot in robots if robot not in self._lost]
        controls = np.zeros((len(self.agents), self.problem.control_size), np.float32)
        for robot in moving:
            controls[robot] = self._commands[robot].control
        _, _, _, _, infos = self._env.step(dict(zip(self.agents, controls, strict=True)))
        record.executing.append({self._commands[robot].executing for robot in moving})
        record.lost.append(sorted(self._lost))
        record.reached.append(np.array([infos[agent]["arrived"] for agent in self.agents]))
        record.collided.append(np.array([infos[agent]["collided"] for agent in self.agents]))
        record.joints.append(split_state(self.problem, self._env.state()))


GRACE = 15.0
"""Seconds that a robot has to end by itself."""


class RobotProcesses:
    """A process for every robot, with its log in ``folder``, which ends with the block at the latest."""

    def __init__(self, mission: Mission, folder: Path) -> None:
        self.logs = [folder / f"robot_{robot}.csv" for robot in range(mission.robots)]
        self.killed: set[int] = set()
        path = folder / "mission.json"
        path.write_text(json.dumps(asdict(mission)))
        root = str(Path(__file__).resolve().parents[3])
        paths = os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH")]))
        command = [sys.executable, "-m", "examples.studies.onboard.robot", str(path)]
        self._processes = [
            subprocess.Popen([*command, str(robot), str(log)], env={**os.environ, "PYTHONPATH": paths})
            for robot, log in enumerate(self.logs)
        ]

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
    """Endpoints on loopback that are free."""
    sockets = [socket.create_server(("127.0.0.1", 0)) for _ in range(number)]
    ports = [one.getsockname()[1] for one in sockets]
    for one in sockets:
        one.close()
    return [f"tcp/127.0.0.1:{port}" for port in ports]
