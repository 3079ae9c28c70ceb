"""A round of planning: a node of D-D4orm in a thread of its own, while the robot drives on."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Any

from d4orm_env import Problem
from d4orm_env.core.seeds import Stream, derived_seed
from d4orm_env.engine.base import Engine
from d4orm_planners.base import Candidate
from d4orm_planners.d4orm import D4orm, D4ormConfig
from d4orm_planners.distributed.events import Event
from d4orm_planners.distributed.node import Node, Selection
from d4orm_planners.distributed.transport import Transport
from onboard.course import Course, digest
from onboard.mission import Mission

PATIENCE = 0.25
"""Seconds that a node waits for the others after each of its iterations."""

RETELL = 0.2
"""Seconds between two looks at whether everybody has the best candidate, once all had it."""

LOOK = 0.02
"""Seconds between two looks at what has arrived, before that."""

TOLD = 10_000
"""More messages than a node sends in a round; a later round's are numbered on from there."""


class Round:
    """Planning from where the team will be when the plan takes over.

    Args:
        mission: The settings.
        members: The robots that are alive, whose nodes are numbered in this order.
        robot: Whose node it is.
        takeover: Tick at which the plan begins.
        number: Of the round; later ones have larger numbers.
        problem: The problem that begins then.
        guess: ``(H, K, m)`` controls to start from.
        engine: What rolls out and samples.
        team: Where candidates are exchanged.
        observer: Is told what the node does, and the digest of the plan that it is about.
    """

    def __init__(
        self,
        mission: Mission,
        members: Sequence[int],
        robot: int,
        takeover: int,
        number: int,
        problem: Problem,
        guess: Any,
        engine: Engine,
        team: Transport,
        observer: Callable[[Event, str], None],
    ) -> None:
        self.members, self.takeover, self.number, self.problem = tuple(members), takeover, number, problem
        self._mission, self._engine = mission, engine
        self._iterated, self._enough, self._settled, self._over = (threading.Event() for _ in range(4))
        self._node: Node | None = None
        self._error: Exception | None = None
        nodes, own = len(members), self.members.index(robot)
        self._known: dict[str, Candidate] = {}
        self._learned = threading.Condition()
        planning = mission.planning()
        planner = D4orm(D4ormConfig(**planning.node_settings(nodes)[own]))
        choice = Selection(planning.selection, planning.k)
        seed = derived_seed(mission.seed, Stream.TAKEOVER, takeover)

        def observe(event: Event) -> None:
            plan = digest(engine, problem, event.candidate)
            with self._learned:
                self._known[plan] = event.candidate
                self._learned.notify_all()
            observer(event, plan)

        def work() -> None:
            try:
                self._node = Node(
                    own, nodes, planner, problem, seed, guess, engine, team, choice,
                    told=TOLD * number, observer=observe,
                )  # fmt: skip
                self._think(self._node)
            except Exception as error:
                self._error = error
            finally:
                self._iterated.set()
                self._settled.set()

        # A node that is at its last iteration must not keep the robot from ending.
        self._thread = threading.Thread(target=work, daemon=True, name=f"round-{number}")
        self._thread.start()

    def _think(self, node: Node) -> None:
        iterations = 0
        while not self._enough.is_set():
            node.step(self._enough, PATIENCE, improve=True)
            iterations += 1
            if iterations == self._mission.iterations:
                self._iterated.set()
        while not self._over.is_set():
            if all_have := node.settle(RETELL):
                self._settled.set()
            self._over.wait(RETELL if all_have else LOOK)

    def enough(self, timeout: float) -> None:
        """Begin no further iteration, if the least number is done or the seconds are over: tell the best candidate."""
        self._iterated.wait(timeout)
        self._enough.set()

    def settle(self, timeout: float) -> None:
        """Wait until every robot has told a candidate as good as the best one here, or the seconds are over."""
        self._settled.wait(timeout)

    def best(self) -> Course | None:
        """The best solution that this robot has by now, its own or another's, if there is any.

        Raises:
            RuntimeError: If the node has failed.
        """
        if self._error is not None:
            raise RuntimeError(f"round {self.number} has failed: {self._error}") from self._error
        return None if self._node is None else self._course(self._node.search.best)

    def progress_on(self, problem: Problem) -> Any:
        """``(H, K, m)`` controls that this round ended with, if it was about the same problem; else ``None``."""
        return self._node.search.best.controls if self._node is not None and problem == self.problem else None

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
        return Course.of(self.takeover, self.problem, self._engine, candidate)
