"""Messages that a node has received: the newest candidate of every other node, evaluated, and a count of the rest.

The nodes of one process share an evaluator: candidates are evaluated once, and it has the word to stop.
"""

from __future__ import annotations

import logging
import threading
from collections import Counter
from collections.abc import Set
from dataclasses import dataclass

import numpy as np

from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.problem import Problem
from d4orm_planners.base.candidate import Candidate, evaluate_controls
from d4orm_planners.d_d4orm.messages import KINDS, Message, MessageError, decode
from d4orm_planners.d_d4orm.selection import merge
from d4orm_planners.d_d4orm.transport import Transport
from d4orm_planners.engine.sampling_types import SamplingEngine

logger = logging.getLogger(__name__)
TOLERANCE = 1e-3
"""Rewards that differ by more than this are not the same; engines round differently."""


class Stopped(Exception):
    """An iteration was left because its result is no longer wanted."""


class Evaluator:
    """Judges candidates, and remembers some.

    Args:
        engine: Engine for rollouts.
        problem: The problem.
        remembered: Candidates of this process's own nodes that are remembered.

    Attributes:
        engine: Engine for rollouts.
        problem: The problem.
        stop: Once set, nodes leave their iterations between denoising steps.
        solution_ends: Whether to set it at the first solution.
    """

    def __init__(self, engine: SamplingEngine, problem: Problem, remembered: int = 0) -> None:
        self.stop = threading.Event()
        self.solution_ends = False
        self.engine, self.problem, self._remembered = engine, problem, remembered
        self._known: dict[bytes, Candidate] = {}
        self._lock = threading.Lock()

    def own(self, controls: FloatArray) -> Candidate:
        """Judge what a node of this process has made.

        Raises:
            Stopped: If it is no longer wanted.
        """
        # Evaluation holds the interpreter's lock: two at once would both be half as fast.
        with self._lock:
            if self.stop.is_set():
                raise Stopped
            candidate = evaluate_controls(self.engine, self.problem, controls)
            self._known[candidate.planned.tobytes()] = candidate
            while len(self._known) > self._remembered:
                del self._known[next(iter(self._known))]
            if candidate.solved and self.solution_ends:
                self.stop.set()
        return candidate

    def received(self, controls: FloatArray) -> Candidate:
        """Judge what has arrived; the very controls that a node of this process has made are known already."""
        return self._known.get(controls.tobytes()) or evaluate_controls(self.engine, self.problem, controls)


@dataclass(frozen=True, eq=False)
class Report:
    """A candidate of another node as it was found to be here."""

    node: int
    sequence: int
    candidate: Candidate


class Inbox:
    """Takes messages from a transport; nothing that arrives makes it raise.

    Args:
        evaluator: Evaluator of the candidates.
        transport: Transport of the messages.
        num_nodes: Number of nodes.
        own: The node that it belongs to, or ``None`` for an observer's.
        heard: Nodes whose messages reach it; ``None`` for all.

    Attributes:
        newest: The newest report of every node heard from, by node.
        dropped: Numbers of messages that were dropped, by :data:`~d4orm_planners.d_d4orm.messages.KINDS`.
        false_claims: Candidates that were not what their sender claimed. They count for what they are.
        namesake: The number of the last candidate that another node sent under this one's own number, or ``None``.
    """

    def __init__(
        self,
        evaluator: Evaluator,
        transport: Transport,
        num_nodes: int,
        own: int | None = None,
        heard: Set[int] | None = None,
    ) -> None:
        self._evaluator, self._transport = evaluator, transport
        self._num_nodes, self._own, self._heard = num_nodes, own, heard
        self._owner = "the observer" if own is None else f"node {own}"
        self._logged: set[str] = set()
        self.newest: dict[int, Report] = {}
        # All kinds from the beginning: other threads look at it, which a growing dictionary does not bear.
        self.dropped: Counter[str] = Counter(dict.fromkeys(KINDS, 0))
        self.false_claims = 0
        self.namesake: int | None = None

    def receive(self, timeout: float = 0.0) -> list[Report]:
        """The new reports among what has arrived, by node; waits up to ``timeout`` [s] if nothing has."""
        messages = []
        for data in self._transport.collect(timeout):
            try:
                message = self._decoded(data)
            except MessageError as error:
                self._drop(error.kind, str(error))
                continue
            if self._heard is None or message.node in self._heard:
                messages.append(message)
        newest, stale = merge(self.newest, messages)
        for message in stale:
            self._drop("stale", f"number {message.sequence} of node {message.node}, which has sent a newer one")
        fresh = [newest[node] for node in sorted(newest)]
        reports = [self._evaluated(item) for item in fresh if isinstance(item, Message)]
        self.newest |= {report.node: report for report in reports}
        return reports

    def _decoded(self, data: bytes) -> Message:
        message = decode(data, self._evaluator.problem, self._num_nodes)
        if message.node == self._own:
            self.namesake = message.sequence
            raise MessageError("node", f"claims to be from node {message.node}, which has received it")
        return message

    def _evaluated(self, message: Message) -> Report:
        # What is sent again, by the same node or another, need not be verified again, which takes its time.
        known = (report.candidate for report in self.newest.values())
        same = (candidate for candidate in known if np.array_equal(candidate.planned, message.controls))
        candidate = next(same, None) or self._evaluator.received(message.controls)
        reward = candidate.reward
        if candidate.solved != message.feasible or abs(reward - message.reward) > TOLERANCE:
            self.false_claims += 1
            claimed, found = (f"reward {r:g}, feasible {f}" for r, f in
                              ((message.reward, message.feasible), (reward, candidate.solved)))  # fmt: skip
            self._log("false claim", f"node {message.node} claims {claimed}; found {found}")
        return Report(message.node, message.sequence, candidate)

    def _drop(self, kind: str, text: str) -> None:
        self.dropped[kind] += 1
        self._log(kind, text)

    def _log(self, kind: str, text: str) -> None:
        """Warn of the first of its kind; a flood of them would drown everything else."""
        if kind not in self._logged:
            self._logged.add(kind)
            logger.warning("%s received a message with a fault (%s): %s", self._owner, kind, text)
