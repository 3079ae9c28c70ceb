"""Pools of nodes: in threads of this process, in rounds or each at its own pace, or one of them on a network."""

from __future__ import annotations

import logging
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Sequence

from d4orm_env.core.errors import describe
from d4orm_planners.base.candidate import Candidate
from d4orm_planners.base.plan import IterationRecord
from d4orm_planners.base.planner import Iteration
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.d_d4orm.inbox import Evaluator, Inbox
from d4orm_planners.d_d4orm.node import Node, ThreadJob
from d4orm_planners.d_d4orm.transport import Transport

logger = logging.getLogger(__name__)

MODES = ("sync", "async")
GLANCE = 0.05  #: Seconds between looks at whether the nodes still live, while nothing arrives


class NodePool(ABC):
    """The nodes of one solve, with all ends of transports to close.

    Stragglers have ``timeout`` seconds: beyond the time limit, and when asynchronous in every round.
    """

    def __init__(
        self, nodes: Sequence[Node], transports: Sequence[Transport], timeout: float, evaluator: Evaluator
    ) -> None:
        self.alive = list(nodes)  #: Nodes that have not failed
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
        """The best new candidate, after a round of all nodes that live; a RuntimeError if every node has failed."""
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
        search.denoising_time = max(node.search.denoising_time for node in self._nodes)  # side by side
        if not candidates and not self.alive:
            self._check_alive()
        best = max(candidates, key=lambda candidate: candidate.rank, default=search.current)
        return self._iteration(best)

    def close(self) -> Candidate:
        """Stop the nodes, and return the best candidate seen; threads are waited for no longer than the timeout."""
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
            "messages": sum(node.messages for node in self._nodes),
            "message_bytes": sum(node.message_bytes for node in self._nodes),
            "waiting_share": self._waited / self._seconds if self._seconds else 0.0,
        }

    @abstractmethod
    def _round(self, time_left: Callable[[], float | None], improve: bool) -> list[Candidate]:
        """New candidates of the nodes, which go on to ``improve`` a solution; time left is below 0 when overdue."""

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
        faults = sum((node.inbox.dropped for node in self._nodes), Counter[str]())
        faults["false claim"] = sum(node.inbox.false_claims for node in self._nodes)
        records = self._new_records()
        notes = self._notes + [record.note for record in records if record.note]
        notes += [f"received {count} x {kind}" for kind, count in sorted((faults - self._reported).items())]
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


class AsyncNodePool(NodePool):
    """Nodes run by themselves; a round is over when each was heard from, or the timeout has passed after the first."""

    def __init__(
        self,
        nodes: Sequence[Node],
        transports: Sequence[Transport],
        timeout: float,
        evaluator: Evaluator,
        observer: Inbox,
    ) -> None:
        super().__init__(nodes, transports, timeout, evaluator)
        self._observer = observer

    def close(self) -> Candidate:
        best = super().close()
        self._seconds += sum(job.seconds for job in self._jobs)
        self._waited = sum(node.inbox.waited for node in self._nodes)
        return best

    def _round(self, time_left: Callable[[], float | None], improve: bool) -> list[Candidate]:
        self._run(improve)
        heard: set[int] = set()
        first = None
        while True:
            ended = not any(job.running for job in self._jobs)
            heard |= {report.node for report in self._observer.receive(GLANCE)}
            for job in self._jobs:
                if job.error is not None and job.node in self.alive:
                    self._lose_failed(job)
            now = time.perf_counter()
            first = now if heard and first is None else first
            left = time_left()
            candidates = [self._observer.newest[number].candidate for number in sorted(heard)]
            if (
                heard >= {node.number for node in self.alive}
                or (first is not None and now - first >= self.timeout)
                or (left is not None and left <= 0)
                or ended
                or (not improve and any(candidate.solved for candidate in candidates))
            ):
                return candidates

    def _run(self, improve: bool) -> None:
        """Start idle nodes: at first all, later those that stopped at what proved to be no solution here."""
        self._evaluator.solution_ends = not improve
        kept = [job for job in self._jobs if job.running or job.error is not None]
        self._seconds += sum(job.seconds for job in self._jobs if job not in kept)
        idle = [node for node in self.alive if node not in {job.node for job in kept}]
        if not any(job.running for job in kept):
            self._evaluator.stop.clear()

        def run(node: Node) -> None:
            while node.step(self._evaluator.stop, self.timeout, improve):
                pass

        begun = [ThreadJob(node, run) for node in idle]
        self._jobs = [*kept, *begun]
        for job in begun:
            job.start()


class NetworkNodePool(SyncNodePool):
    """A single node here; a round is over when the others were heard from, or the timeout has passed."""

    def __init__(
        self, node: Node, transport: Transport, timeout: float, evaluator: Evaluator, grace_period: float
    ) -> None:
        super().__init__([node], [transport], timeout, evaluator)
        self._node, self._grace_period = node, grace_period
        self._seen: set[int] = set()

    def close(self) -> Candidate:
        """See :meth:`NodePool.close`; before it, a solution is sent to the others."""
        self._evaluator.stop.set()
        try:
            for job in self._jobs:
                job.wait(self.timeout)
            self._node.settle(self._grace_period)
            self._report_new_nodes()
        except KeyboardInterrupt:
            logger.info("interrupted while telling the others")
        finally:
            best = super().close()
        # Waiting is part of a node's own round here.
        self._waited = self._node.inbox.waited
        return best

    def _round(self, time_left: Callable[[], float | None], improve: bool) -> list[Candidate]:
        left = time_left()
        timeout = self.timeout if left is None else min(self.timeout, max(left, 0.0))
        self._all(lambda node: node.step(self._evaluator.stop, timeout, improve), time_left)
        self._node.check_number()
        if not self.alive:
            # What others have sent is not lost with the planner here.
            self._node.settle(0.0)
            best = self._node.search.best
            return [best] if best.solved and not improve else []
        self._report_new_nodes()
        return [self._node.candidate, *(report.candidate for report in self._node.inbox.newest.values())]

    def _report_new_nodes(self) -> None:
        for number in sorted(set(self._node.inbox.newest) - self._seen):
            logger.info("heard from node %d", number)
            self._seen.add(number)
