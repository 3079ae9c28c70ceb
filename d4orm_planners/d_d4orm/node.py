"""One node of D-D4orm: refine, broadcast, collect, choose (paper, Algorithm 5); and its work in a thread.

An observer may be told of all that it does, for timelines (section VIII-E).
"""

from __future__ import annotations

import atexit
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray
from d4orm_env.core.seeds import Stream, derived_seed
from d4orm_planners.base.candidate import Candidate
from d4orm_planners.base.planner import Planner
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.d_d4orm.inbox import Evaluator, Inbox, Stopped, choose
from d4orm_planners.d_d4orm.transport import Message, Transport, encode

KINDS = ("computed", "sent", "received", "selected")  #: A node made a candidate, sent it, got one, or chose it
ROUNDING = 1e-5  #: Difference of rewards of one candidate that is clipped and evaluated anew; two are hardly as near
RESEND = 0.2  #: Seconds after which a candidate is sent again, as messages may get lost
LAST_WAIT = 30.0  #: Seconds that the process's end waits for an abandoned thread: native code must not be interrupted


@dataclass(frozen=True, eq=False)
class Event:
    """Something that a node did."""

    node: int  #: The node that did it
    kind: str  #: One of :data:`KINDS`
    begin: float  #: Time at which it began to, by :func:`time.perf_counter` [s]
    end: float  #: Time at which it was done, likewise. Messages take no time here.
    of: int  #: The node that the candidate came from
    sequence: int  #: Number among that node's messages, from 1; 0 for one that was not sent yet
    candidate: Candidate  #: The candidate, as evaluated by ``node``
    size: int = 0  #: Bytes of the message that was sent, else 0


Observer = Callable[[Event], object]


def node_seed(seed: int, node: int) -> int:
    """The seed of a node; the first one's is the solve's own, so that a single node is the planner that it runs."""
    return seed if node == 0 else derived_seed(seed, Stream.NODE, node)


@dataclass(frozen=True, eq=False)
class PlanningTask:
    """Common task of the nodes of one solve."""

    num_nodes: int  #: Number of nodes
    seed: int  #: That of the whole solve
    controls: FloatArray | None  #: ``(H, K, m)`` to start from; ``None`` for zeros
    selection: str  #: Rule by which a node chooses a candidate; see :func:`~d4orm_planners.d_d4orm.inbox.choose`
    k: int  #: Number of candidates that it draws from
    links: BoolArray | None = None  #: ``(N, N)`` bool: which nodes each one hears; ``None`` for all

    def heard_by(self, node: int) -> set[int]:
        """Return the nodes that a node hears."""
        others = range(self.num_nodes) if self.links is None else np.flatnonzero(self.links[node]).tolist()
        return set(others) - {node}


class Node:
    """A planner that exchanges candidates with others.

    Args:
        number: Its number, from 0.
        planner: Planner that refines its candidate.
        evaluator: Evaluator, in common with other nodes of this process.
        sequence: The number before that of its first message; more than any that it sent before, if it did, and on a
            network the time at which it began, by which two nodes of one number know which was first.
        observer: Called with every :class:`~d4orm_planners.d_d4orm.node.Event`, in the node's own thread.
    """

    def __init__(
        self,
        number: int,
        task: PlanningTask,
        planner: Planner,
        transport: Transport,
        evaluator: Evaluator,
        sequence: int = 0,
        observer: Observer | None = None,
    ) -> None:
        self.number = number
        seed = node_seed(task.seed, number)
        #: Its own search
        self.search = SolveRun(planner, evaluator.problem, seed, task.controls, evaluator.engine, evaluator.own)
        self.search.cancelled = evaluator.stop
        self.candidate = self.search.current  #: The candidate that it made last
        self.messages = self.message_bytes = 0  #: Sent so far, each to all other nodes, and their length together
        self._transport = transport
        self._others = task.heard_by(number)
        self.inbox = Inbox(evaluator, transport, task.num_nodes, number, self._others)  #: Messages of the others
        self.excluded = 0  #: Samples left out so far because their reward was not finite
        self._task = task
        self._sequence = self._began = sequence
        self._observer = observer
        self._awaited = self._others

    def refine(self) -> None:
        """One iteration of the planner; its candidate is broadcast."""
        begin = time.perf_counter()
        self.excluded += self.search.advance().excluded
        self.candidate = self.search.current
        self._note("computed", self.number, 0, self.candidate, begin)
        self._publish(self.candidate)

    def exchange(self) -> None:
        """Take what has arrived and choose what to go on from."""
        self._gather()
        self._choose()

    def step(self, stop: threading.Event, timeout: float, improve: bool) -> bool:
        """Refine and exchange at its own pace, waiting for the others no longer than ``timeout`` [s].

        True to go on: not if asked to stop, nor with a solution unless it is to be improved.
        """
        self.refine()
        if stop.is_set() or self.search.time_left == 0 or (self.search.best.solved and not improve):
            return False
        self._await_others(stop, timeout)
        if self.search.best.solved and not improve:
            return False
        self._choose()
        return True

    def check_number(self) -> None:
        """ValueError if another node has this one's number, and had it first, or says so; not with a solution."""
        namesake = self.inbox.namesake
        if namesake is not None and namesake <= self._began and not self.search.best.solved:
            last = self._task.num_nodes - 1
            raise ValueError(
                f"node is {self.number}, and another process on the network is node {self.number} already; give each "
                f"a number of its own, from 0 to {last}"
            )

    def settle(self, seconds: float) -> bool:
        """Send the best candidate repeatedly, until all others have one as good or the time is over; return whether
        they have.

        Without a solution it only takes what has arrived.
        """
        self._gather()
        deadline = time.perf_counter() + seconds
        sent, again = None, 0.0
        while self.search.best.solved:
            now = time.perf_counter()
            if sent is not self.search.best or now >= again:
                sent, again = self.search.best, now + RESEND
                self._publish(sent)
            if self._all_have(sent):
                return True
            if now >= deadline:
                break
            self._gather(min(again, deadline) - now)
        return False

    def _publish(self, candidate: Candidate) -> None:
        self._sequence += 1
        message = Message(self.number, self._sequence, candidate.planned, candidate.reward, bool(candidate.solved))
        data = encode(message, self.search.problem)
        self._transport.publish(data)
        self.messages += 1
        self.message_bytes += len(data)
        self._note("sent", self.number, self._sequence, candidate, size=len(data))

    def _all_have(self, candidate: Candidate) -> bool:
        """Check whether each of the others has sent a solution as good as this one."""
        found = {node: report.candidate for node, report in self.inbox.newest.items()}
        return all(
            node in found and found[node].solved and found[node].reward >= candidate.reward - ROUNDING
            for node in self._others
        )

    def close(self) -> None:
        """Let go of what the planner left open."""
        self.search.close()

    def _await_others(self, stop: threading.Event, timeout: float) -> None:
        """Gather until all heard from the last time are heard from again, or the timeout passes."""
        deadline = time.perf_counter() + timeout
        heard = self._gather()
        while not (stop.is_set() or heard >= self._awaited):
            rest = deadline - time.perf_counter()
            if rest <= 0:
                break
            heard |= self._gather(rest)
        # A silent node is awaited again only once it was heard from.
        self._awaited = heard

    def _gather(self, timeout: float = 0.0) -> set[int]:
        """Return the nodes that sent something new."""
        reports = self.inbox.receive(timeout)
        for report in reports:
            self._note("received", report.node, report.sequence, report.candidate)
            if report.candidate.rank > self.search.best.rank:
                self.search.best = report.candidate
        return {report.node for report in reports}

    def _choose(self) -> None:
        reports = self.inbox.newest
        received = {node: (report.sequence, report.candidate) for node, report in reports.items()}
        received[self.number] = (self._sequence, self.candidate)
        nodes = sorted(received)
        candidates = [received[node][1] for node in nodes]
        chosen = choose(
            self._task.selection,
            [candidate.reward for candidate in candidates],
            np.stack([candidate.controls for candidate in candidates]),
            self._task.k,
            np.random.default_rng(self.search.iteration_seed(Stream.CHOICE)),
        )
        self.search.current = candidates[chosen]
        self._note("selected", nodes[chosen], *received[nodes[chosen]])

    def _note(
        self, kind: str, of: int, sequence: int, candidate: Candidate, begin: float | None = None, size: int = 0
    ) -> None:
        if self._observer is not None:
            now = time.perf_counter()
            start = now if begin is None else begin
            self._observer(Event(self.number, kind, start, now, of, sequence, candidate, size))


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
        """Begin. Ctrl-C may come while the thread starts, so the pool must know of this job before."""
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
