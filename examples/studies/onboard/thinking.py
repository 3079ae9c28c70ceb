"""A round of planning: a node of D-D4orm in a thread of its own, while the robot drives on; and the log of both."""

from __future__ import annotations

import csv
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from examples.studies.onboard.course import Course, digest, reward
from examples.studies.onboard.mission import Mission

from d4orm_env import Problem
from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.seeds import Stream, derived_seed
from d4orm_env.engine.types import Engine
from d4orm_planners.base.candidate import Candidate
from d4orm_planners.d_d4orm.inbox import Evaluator
from d4orm_planners.d_d4orm.node import Event, Node, PlanningTask
from d4orm_planners.d_d4orm.transport import Transport

COLUMNS = (
    "time", "until", "tick", "round", "robot", "event", "of", "message", "bytes", "plan", "reward", "solved"
)  # fmt: skip


class Log:
    """A CSV file of a robot's events; times are :func:`time.perf_counter`, the same clock for all processes.

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


TIMEOUT = 0.25
"""Seconds that a node waits for the others after each of its iterations."""

RESEND = 0.2
"""Seconds between two looks at whether all nodes have the best candidate, once all had it."""

LOOK = 0.02
"""Seconds between two looks at what has arrived, before that."""

SEQUENCE = 10_000
"""More messages than a node sends in a round; a later round's are numbered on from there."""


@dataclass(frozen=True)
class Agenda:
    """Task of a round of planning."""

    number: int  #: Of the round; later ones have larger numbers
    members: tuple[int, ...]  #: The robots that are alive, whose nodes are numbered in this order
    takeover: int  #: Tick at which the plan begins
    problem: Problem  #: The problem that begins then
    guess: FloatArray  #: ``(H, K, m)`` controls to start from


class Round:
    """Planning from where the team will be when the plan takes over.

    ``observer`` is called with what the node does, and the digest of the plan that it is about.
    """

    def __init__(
        self,
        agenda: Agenda,
        mission: Mission,
        robot: int,
        engine: Engine,
        team: Transport,
        observer: Callable[[Event, str], None],
    ) -> None:
        self.agenda = agenda
        self._mission, self._engine, self._team, self._observer = mission, engine, team, observer
        self._iterated, self._enough, self._settled, self._over = (threading.Event() for _ in range(4))
        self._node: Node | None = None
        self._error: Exception | None = None
        self._known: dict[str, Candidate] = {}
        self._learned = threading.Condition()
        # A node that is at its last iteration must not keep the robot from ending.
        self._thread = threading.Thread(target=self._work, args=(robot,), daemon=True, name=f"round-{agenda.number}")
        self._thread.start()

    def _work(self, robot: int) -> None:
        try:
            self._node = self._make_node(robot)
            self._think(self._node)
        except Exception as error:
            self._error = error
        finally:
            self._iterated.set()
            self._settled.set()

    def _make_node(self, robot: int) -> Node:
        agenda, planning = self.agenda, self._mission.planning()
        nodes, own = len(agenda.members), agenda.members.index(robot)
        seed = derived_seed(self._mission.seed, Stream.TAKEOVER, agenda.takeover)
        task = PlanningTask(nodes, seed, agenda.guess, planning.selection, planning.k)
        planner, evaluator = planning.node_planners(nodes)[own], Evaluator(self._engine, agenda.problem)
        sequence = SEQUENCE * agenda.number
        return Node(own, task, planner, self._team, evaluator, sequence=sequence, observer=self._observe)

    def _observe(self, event: Event) -> None:
        plan = digest(self._engine, self.agenda.problem, event.candidate)
        with self._learned:
            self._known[plan] = event.candidate
            self._learned.notify_all()
        self._observer(event, plan)

    def _think(self, node: Node) -> None:
        iterations = 0
        while not self._enough.is_set():
            node.step(self._enough, TIMEOUT, improve=True)
            iterations += 1
            if iterations == self._mission.iterations:
                self._iterated.set()
        while not self._over.is_set():
            if all_have := node.settle(RESEND):
                self._settled.set()
            self._over.wait(RESEND if all_have else LOOK)

    def enough(self, timeout: float) -> None:
        """Begin no further iteration, if the least number is done or the seconds are over: tell the best candidate."""
        self._iterated.wait(timeout)
        self._enough.set()

    def settle(self, timeout: float) -> None:
        """Wait until every robot has sent a solution as good as the best one here, or the seconds are over.

        Without one there is nothing to wait for: what others announce is asked for by its name.
        """
        if self._node is not None and self._node.search.best.solved:
            self._settled.wait(timeout)

    def best(self) -> Course | None:
        """The best solution that this robot has by now, its own or another's, if there is any.

        Raises:
            RuntimeError: If the node has failed.
        """
        if self._error is not None:
            raise RuntimeError(f"round {self.agenda.number} has failed: {self._error}") from self._error
        return None if self._node is None else self._course(self._node.search.best)

    def progress_on(self, problem: Problem) -> FloatArray | None:
        """``(H, K, m)`` controls that this round ended with, if it was about the same problem; else ``None``."""
        return self._node.search.best.controls if self._node is not None and problem == self.agenda.problem else None

    def named(self, plan: str, timeout: float) -> Course | None:
        """The solution of that digest, if this robot has it or gets it within the seconds, and it is one."""
        with self._learned:
            self._learned.wait_for(lambda: plan in self._known, timeout)
            candidate = self._known.get(plan)
        return None if candidate is None else self._course(candidate)

    def end(self, timeout: float) -> None:
        """Let go of it; an iteration under way is waited for, so that no two rounds take turns on a core."""
        self._enough.set()
        self._over.set()
        self._thread.join(timeout)

    def _course(self, candidate: Candidate) -> Course | None:
        return Course.of(self.agenda.takeover, self.agenda.problem, self._engine, candidate)
