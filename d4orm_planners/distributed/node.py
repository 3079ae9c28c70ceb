"""One node of D-D4orm: refine, broadcast, collect, choose (paper, Algorithm 5)."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.problem import Problem
from d4orm_env.engine.base import Engine
from d4orm_planners.base import Planner, Search
from d4orm_planners.distributed.inbox import Inbox
from d4orm_planners.distributed.judge import Judge, JudgedPlanner, StoppableEngine
from d4orm_planners.distributed.messages import Message, encode
from d4orm_planners.distributed.meter import Meter
from d4orm_planners.distributed.selection import choose
from d4orm_planners.distributed.transport import Transport

CHOICE = 10**6
"""The stream of random numbers that a node chooses with; planners use lower ones."""


@dataclass(frozen=True)
class Selection:
    """How a node chooses what to go on from; see :func:`~d4orm_planners.distributed.selection.choose`."""

    rule: str
    k: int


def node_seed(seed: int, node: int) -> int:
    """The seed of a node; the first one's is the solve's own, so that a single node is the planner that it runs."""
    if node == 0:
        return seed
    return int(np.random.SeedSequence([seed, node]).generate_state(1, np.uint64)[0])


class Node:
    """A planner that exchanges candidates with others.

    Attributes:
        number: From 0.
        search: Its own search.
        candidate: The candidate that it made last.
        transport: What it sends and receives by, with a count.
        inbox: What the others sent.
        excluded: Samples left out so far because their reward was not finite.
    """

    def __init__(
        self,
        number: int,
        num_nodes: int,
        planner: Planner,
        problem: Problem,
        seed: int,
        controls: FloatArray,
        engine: Engine,
        transport: Transport,
        selection: Selection,
        judge: Judge | None = None,
    ) -> None:
        self.number = number
        judge = judge or Judge(engine, problem)
        stoppable: Any = StoppableEngine(engine, judge.stop)
        self.search = Search(JudgedPlanner(planner, judge), problem, node_seed(seed, number), controls, stoppable)
        self.candidate = self.search.current
        self.transport = Meter(transport)
        self.inbox = Inbox(problem, engine, self.transport, num_nodes, number, judge)
        self.excluded = 0
        self._selection = selection
        self._awaited = set(range(num_nodes)) - {number}

    def refine(self) -> None:
        """One iteration of the planner; its candidate is broadcast."""
        self.excluded += self.search.advance().excluded
        self.candidate = self.search.current
        reward = float(self.candidate.trajectory.rewards.mean())
        message = Message(
            self.number, self.search.iteration, self.candidate.controls, reward, bool(self.candidate.solved)
        )
        self.transport.publish(encode(message, self.search.problem))

    def exchange(self) -> None:
        """Take what has arrived and choose what to go on from."""
        self._gather()
        self._choose()

    def run(self, stop: threading.Event, patience: float, improve: bool) -> None:
        """Refine and exchange until told to stop, or until there is a solution unless it is to be improved.

        It waits for the others no longer than ``patience`` [s].
        """
        while True:
            self.refine()
            if stop.is_set() or (self.search.best.solved and not improve):
                break
            self._await_others(stop, patience)
            if self.search.best.solved and not improve:
                break
            self._choose()

    def close(self) -> None:
        """Let go of what the planner left open."""
        self.search.planner.finish(self.search)

    def _await_others(self, stop: threading.Event, patience: float) -> None:
        """Gather until everybody heard from the last time is heard from again, or patience ends."""
        deadline = time.perf_counter() + patience
        heard = self._gather()
        while not (stop.is_set() or heard >= self._awaited):
            rest = deadline - time.perf_counter()
            if rest <= 0:
                break
            heard |= self._gather(rest)
        # Who is silent, maybe for ever, is awaited again only when heard from.
        self._awaited = heard

    def _gather(self, timeout: float = 0.0) -> set[int]:
        """Who sent something new."""
        reports = self.inbox.receive(timeout)
        for report in reports:
            if report.candidate.rank > self.search.best.rank:
                self.search.best = report.candidate
        return {report.node for report in reports}

    def _choose(self) -> None:
        received = {node: report.candidate for node, report in self.inbox.newest.items()} | {
            self.number: self.candidate
        }
        candidates = [received[node] for node in sorted(received)]
        self.search.current = candidates[
            choose(
                self._selection.rule,
                [candidate.trajectory.rewards.mean() for candidate in candidates],
                np.stack([candidate.controls for candidate in candidates]),
                self._selection.k,
                np.random.default_rng(self.search.iteration_seed(CHOICE)),
            )
        ]
