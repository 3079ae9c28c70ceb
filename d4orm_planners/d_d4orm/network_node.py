"""One node of this process among others on a network."""

from __future__ import annotations

import logging
from collections.abc import Callable

from d4orm_planners.base.candidate import Candidate
from d4orm_planners.d_d4orm.evaluator import Evaluator
from d4orm_planners.d_d4orm.node import Node
from d4orm_planners.d_d4orm.node_pool import SyncNodePool
from d4orm_planners.d_d4orm.transport import Transport

logger = logging.getLogger(__name__)


class NetworkNodePool(SyncNodePool):
    """A single node here; a round is over when the others were heard from, or the timeout has passed.

    Args:
        node: The node.
        transport: Its access to the others.
        timeout: See :class:`~d4orm_planners.d_d4orm.node_pool.NodePool`.
        evaluator: See :class:`~d4orm_planners.d_d4orm.node_pool.NodePool`.
        grace_period: Seconds that a solution is sent to the others in the end, see :meth:`Node.settle`.
    """

    def __init__(
        self, node: Node, transport: Transport, timeout: float, evaluator: Evaluator, grace_period: float
    ) -> None:
        super().__init__([node], [transport], timeout, evaluator)
        self._node, self._grace_period = node, grace_period
        self._seen: set[int] = set()

    def close(self) -> Candidate:
        """See :meth:`Crew.close`; before it, a solution is sent to the others."""
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
        """See :meth:`Crew._round`."""
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
