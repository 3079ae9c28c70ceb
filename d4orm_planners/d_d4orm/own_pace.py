"""Pools of nodes without common rounds: all in threads of this process, or one of them on a network."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence

from d4orm_planners.base.candidate import Candidate
from d4orm_planners.d_d4orm.inbox import Evaluator, Inbox
from d4orm_planners.d_d4orm.node import Node
from d4orm_planners.d_d4orm.node_pool import NodePool, SyncNodePool, ThreadJob
from d4orm_planners.d_d4orm.transport import Transport

logger = logging.getLogger(__name__)

GLANCE = 0.05
"""Seconds between looks at whether the nodes still live, while nothing arrives."""


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
        self._waited = sum(node.transport.waited for node in self._nodes)
        return best

    def _round(self, time_left: Callable[[], float | None], improve: bool) -> list[Candidate]:
        self._run(improve)
        heard: set[int] = set()
        first = None
        while True:
            ended = not any(job.running for job in self._jobs)
            heard |= {report.node for report in self._observer.receive(GLANCE)}
            self._lose_dead()
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
        running = [job for job in self._jobs if job.running]
        failed = [job for job in self._jobs if job.error is not None]
        self._seconds += sum(job.seconds for job in self._jobs if job not in running + failed)
        idle = [node for node in self.alive if node not in {job.node for job in running + failed}]
        if not running:
            self._evaluator.stop.clear()

        def run(node: Node) -> None:
            node.run(self._evaluator.stop, self.timeout, improve)

        begun = [ThreadJob(node, run) for node in idle]
        self._jobs = [*running, *failed, *begun]
        for job in begun:
            job.start()

    def _lose_dead(self) -> None:
        for job in self._jobs:
            if job.error is not None and job.node in self.alive:
                self._lose_failed(job)


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
        self._waited = self._node.transport.waited
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
