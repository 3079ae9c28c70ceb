"""Nodes in threads of one process, in synchronous rounds."""

from __future__ import annotations

import atexit
import logging
import threading
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Sequence

from d4orm_env.core.errors import describe
from d4orm_planners.base.candidate import Candidate
from d4orm_planners.base.plan import IterationRecord
from d4orm_planners.base.planner import Iteration
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.d_d4orm.inbox import Evaluator, Stopped
from d4orm_planners.d_d4orm.node import Node
from d4orm_planners.d_d4orm.transport import Transport

logger = logging.getLogger(__name__)

MODES = ("sync", "async")

LAST_WAIT = 30.0
"""Seconds that the end of the process waits for an abandoned thread: native code must not be interrupted."""


class ThreadJob:
    """Work of a node, to be done in a thread of its own; an exception is kept instead of lost."""

    def __init__(self, node: Node, work: Callable[[Node], object]) -> None:
        self.node = node
        self.error: Exception | None = None
        self._work = work
        self._begin: float | None = None
        self._end: float | None = None
        self._over = threading.Event()
        # A node that hangs must not keep the process from ending for ever.
        self._thread = threading.Thread(target=self._run, daemon=True, name=f"d-d4orm-{node.number}")

    def start(self) -> None:
        """Begin.

        Ctrl-C may come while the thread starts, so the pool must know of this job before.
        """
        self._begin = time.perf_counter()
        self._thread.start()

    def _run(self) -> None:
        try:
            self._work(self.node)
        except Stopped:
            pass
        except Exception as error:  # whatever it is, it concerns this node only
            self.error = error
        finally:
            self._end = time.perf_counter()
            self._over.set()

    @property
    def running(self) -> bool:
        """True if it has begun and is not over."""
        return self._begin is not None and not self._over.is_set()

    @property
    def seconds(self) -> float:
        """Time that it has taken."""
        if self._begin is None:
            return 0.0
        return (self._end or time.perf_counter()) - self._begin

    def wait(self, timeout: float | None) -> None:
        """Wait while it runs, no longer than ``timeout`` [s]."""
        # A thread whose start was interrupted cannot be joined before it has run.
        if self._begin is not None and self._over.wait(timeout):
            self._thread.join()

    def leave(self) -> None:
        """Wait for it no longer, except at the end of the process."""
        if self.running:
            atexit.register(self.wait, LAST_WAIT)


class NodePool(ABC):
    """The nodes of one solve.

    Args:
        nodes: The nodes.
        transports: All ends to close in the end.
        timeout: Seconds that are waited for stragglers: beyond the time limit, and when asynchronous in every round.
        evaluator: Evaluator of all nodes.

    Attributes:
        alive: Nodes that have not failed.
    """

    def __init__(
        self, nodes: Sequence[Node], transports: Sequence[Transport], timeout: float, evaluator: Evaluator
    ) -> None:
        self.alive = list(nodes)
        self.timeout = timeout
        self._evaluator = evaluator
        self._nodes = tuple(nodes)
        self._transports = tuple(transports)
        self._jobs: list[ThreadJob] = []
        self._notes: list[str] = []
        self._losses: list[str] = []
        self._error: Exception | None = None
        self._reported: Counter[str] = Counter()
        self._spent = self._excluded = 0
        self._read = dict.fromkeys(nodes, 0)
        self._seconds = self._waited = 0.0

    def iterate(self, search: SolveRun) -> Iteration:
        """The best new candidate, after a round of all nodes that live.

        Raises:
            RuntimeError: If every node has failed, from the error of the last one.
        """
        self._check_alive()
        compiled_before = {node: node.search.watch.paused_seconds for node in self.alive}

        def compiling() -> float:
            paused = (node.search.watch.paused_seconds - before for node, before in compiled_before.items())
            return min(paused, default=0.0)

        def time_left() -> float | None:
            if search.time_limit is None:
                return None
            return search.time_limit - search.watch.elapsed + compiling()

        left = time_left()
        for node in self.alive:
            node.search.time_limit = None if left is None else node.search.watch.elapsed + left
        candidates = self._round(time_left, search.planner.config.improve)
        search.watch.leave_out(compiling())
        if not candidates and not self.alive:
            self._check_alive()
        best = max(candidates, key=lambda candidate: candidate.rank, default=search.current)
        return self._iteration(best)

    def close(self) -> Candidate:
        """Stop the nodes, and return the best candidate that they have seen.

        Threads are waited for no longer than the timeout.
        """
        self._evaluator.stop.set()
        for node in self._nodes:
            node.close()
        for transport in self._transports:
            transport.close()
        deadline = time.perf_counter() + self.timeout
        for job in self._jobs:
            if job.node in self.alive:
                job.wait(max(deadline - time.perf_counter(), 0))
            job.leave()
        return max((node.search.best for node in self._nodes), key=lambda candidate: candidate.rank)

    def metrics(self) -> dict[str, float]:
        """Messages sent by all nodes, and the share of their time that they waited for each other; once closed."""
        return {
            "messages": sum(node.transport.messages for node in self._nodes),
            "message_bytes": sum(node.transport.message_bytes for node in self._nodes),
            "waiting_share": self._waited / self._seconds if self._seconds else 0.0,
        }

    @abstractmethod
    def _round(self, time_left: Callable[[], float | None], improve: bool) -> list[Candidate]:
        """New candidates of the nodes.

        Args:
            time_left: Returns the seconds left, below zero when overdue.
            improve: Whether nodes go on once there is a solution.
        """

    def _lose(self, job: ThreadJob, reason: str) -> None:
        self.alive.remove(job.node)
        loss = f"node {job.node.number} {reason}"
        logger.warning("%s", loss, exc_info=job.error)
        self._notes.append(loss)
        self._losses.append(loss)

    def _lose_failed(self, job: ThreadJob) -> None:
        assert job.error is not None
        self._error = job.error
        self._lose(job, f"failed ({describe(job.error)})")

    def _check_alive(self) -> None:
        if not self.alive and self._error is not None:
            raise RuntimeError(
                f"all {len(self._nodes)} nodes of d-d4orm are lost: {'; '.join(self._losses)}"
            ) from self._error

    def _iteration(self, best: Candidate) -> Iteration:
        steps = max(node.search.denoising_steps for node in self._nodes)
        excluded = sum(node.excluded for node in self._nodes)
        faults: Counter[str] = Counter()
        for node in self._nodes:
            faults += node.inbox.dropped
            faults["false claim"] += node.inbox.false_claims
        new = faults - self._reported
        records = self._new_records()
        notes = self._notes + [record.note for record in records if record.note]
        notes += [f"received {count} x {kind}" for kind, count in sorted(new.items())]
        unreachable = tuple(sorted({robot for record in records for robot in record.unreachable}))
        iteration = Iteration(
            best.controls, steps - self._spent, excluded - self._excluded, "; ".join(notes), best, unreachable
        )
        self._spent, self._excluded, self._reported, self._notes = steps, excluded, faults, []
        return iteration

    def _new_records(self) -> list[IterationRecord]:
        """Return records of the nodes' iterations since the last call."""
        new = []
        for node in self._nodes:
            records = node.search.history[self._read[node] :]  # which may grow meanwhile
            self._read[node] += len(records)
            new += records
        return new


class SyncNodePool(NodePool):
    """Rounds: all nodes refine, then all of them exchange. The same seed gives the same rounds."""

    def _round(self, time_left: Callable[[], float | None], improve: bool) -> list[Candidate]:
        self._all(Node.refine, time_left)
        candidates = [node.candidate for node in self.alive]
        # Evaluating the candidates of others takes time, and after the last round no node goes on from them.
        left = time_left()
        in_time = left is None or left > 0
        if in_time and (improve or not any(candidate.solved for candidate in candidates)):
            self._all(Node.exchange, time_left)
        return candidates

    def _all(self, work: Callable[[Node], object], time_left: Callable[[], float | None]) -> None:
        begin = time.perf_counter()
        self._jobs = [ThreadJob(node, work) for node in self.alive]
        for job in self._jobs:
            job.start()
        for job in self._jobs:
            while job.running:
                left = time_left()
                if left is not None and left + self.timeout <= 0:
                    break
                job.wait(None if left is None else left + self.timeout)
            if job.running:
                job.leave()
                self._lose(job, "did not finish in time")
            elif job.error is not None:
                self._lose_failed(job)
        seconds = time.perf_counter() - begin
        self._seconds += seconds * len(self._jobs)
        self._waited += sum(seconds - job.seconds for job in self._jobs)
