"""A node's inbox, with the newest candidate of every other node, and rules of selection (Algorithm 5, lines 4-6).

The nodes of one process share an evaluator, which evaluates every candidate once and tells them to stop.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Set
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from d4orm_env.core.arrays import FloatArray, Floats, IntArray
from d4orm_env.core.errors import unknown
from d4orm_env.core.problem import Problem
from d4orm_planners.base.candidate import Candidate, evaluate_controls
from d4orm_planners.d_d4orm.transport import KINDS, Message, MessageError, Transport, decode
from d4orm_planners.engine.sampling_types import SamplingEngine

logger = logging.getLogger(__name__)
TOLERANCE = 1e-3  #: Rewards that differ by more than this are not the same; engines round differently


class Stopped(Exception):
    """An iteration was left because its result is no longer wanted."""


class Evaluator:
    """Evaluates candidates, and remembers so many of this process's own nodes."""

    def __init__(self, engine: SamplingEngine, problem: Problem, remembered: int = 0) -> None:
        self.stop = threading.Event()  #: Once set, nodes leave their iterations between denoising steps
        self.solution_ends = False  #: Whether the first solution sets :attr:`stop`
        self.engine, self.problem, self._remembered = engine, problem, remembered
        self._known: dict[bytes, Candidate] = {}
        self._lock = threading.Lock()

    def own(self, controls: FloatArray) -> Candidate:
        """Evaluate the controls of a node of this process. Raises Stopped if it is no longer wanted."""
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
        """Evaluate received controls; those that a node of this process has made are known already."""
        return self._known.get(controls.tobytes()) or evaluate_controls(self.engine, self.problem, controls)


@dataclass(frozen=True, eq=False)
class Report:
    """A candidate of another node as it was found to be here."""

    node: int
    sequence: int
    candidate: Candidate


class Inbox:
    """Takes messages from a transport; nothing that arrives makes it raise.

    It is that of the node ``own``, or an observer's, and takes messages of the nodes ``heard``, by default of all.
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
        self.newest: dict[int, Report] = {}  #: The newest report of every node heard from, by node
        # All kinds from the beginning: other threads look at it, which a growing dictionary does not bear.
        #: Numbers of messages that were dropped, by :data:`~d4orm_planners.d_d4orm.transport.KINDS`
        self.dropped: Counter[str] = Counter(dict.fromkeys(KINDS, 0))
        self.false_claims = 0  #: Candidates that were not what their sender claimed. They count for what they are
        self.namesake: int | None = None  #: Last number that another node sent under this one's, or ``None``
        self.waited = 0.0  #: Seconds spent so far waiting for messages

    def receive(self, timeout: float = 0.0) -> list[Report]:
        """The new reports among what has arrived, by node; waits up to ``timeout`` [s] if nothing has."""
        messages, begin = [], time.perf_counter()
        arrived = self._transport.collect(timeout)
        self.waited += time.perf_counter() - begin
        for data in arrived:
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


Item: TypeAlias = Report | Message  #: Candidate of a node, evaluated or as it was sent
SELECTIONS = ("top-k", "max", "k-means")
ROUNDS = 50  #: Rounds after which k-means stops, converged or not


def shares(total: int, parts: int) -> tuple[int, ...]:
    """``total`` split as evenly as whole numbers can be; the first parts get what is left over."""
    return tuple(total // parts + (part < total % parts) for part in range(parts))


def merge(newest: Mapping[int, Item], arrivals: Iterable[Message]) -> tuple[dict[int, Item], tuple[Message, ...]]:
    """The newest item of every node, and the stale arrivals: those that are no newer than what was held before."""
    merged, stale = dict(newest), list[Message]()
    for item in arrivals:
        if item.node in newest and item.sequence <= newest[item.node].sequence:
            stale.append(item)
        elif item.node not in merged or item.sequence > merged[item.node].sequence:
            merged[item.node] = item
    return merged, tuple(stale)


def top_k(rewards: ArrayLike, k: int) -> tuple[int, ...]:
    """Indices of the ``k`` largest of ``(n,)`` rewards, best first; of equal ones the first."""
    return tuple(int(i) for i in np.argsort(-np.asarray(rewards), kind="stable")[:k])


def k_means(points: ArrayLike, k: int, generator: np.random.Generator) -> IntArray:
    """``(n,)`` the cluster, numbered from 0, of each of points ``(n, D)``, by Lloyd's rounds from a k-means++ start.

    There are fewer than ``k`` where there are fewer different points.
    """
    positions = np.asarray(points, np.float64)
    centres = positions[[generator.integers(len(positions))]]
    while len(centres) < k:
        gap2 = _square_distances(positions, centres).min(axis=1)
        if gap2.sum() == 0:
            break
        centres = np.vstack([centres, positions[generator.choice(len(positions), p=gap2 / gap2.sum())]])
    labels = _square_distances(positions, centres).argmin(axis=1)
    for _ in range(ROUNDS):
        former = labels
        # A cluster that has lost all its points stays where it was.
        full = np.unique(labels)
        centres[full] = [positions[labels == cluster].mean(axis=0) for cluster in full]
        labels = _square_distances(positions, centres).argmin(axis=1)
        if (labels == former).all():
            break
    return labels


def diverse(rewards: ArrayLike, points: ArrayLike, k: int, generator: np.random.Generator) -> tuple[int, ...]:
    """Indices of the best of each of at most ``k`` clusters of candidates, best first.

    Of candidates ``points`` ``(n, ...)`` with ``rewards`` ``(n,)``; their distance is the l2 norm of the difference.
    """
    count = np.size(rewards)
    labels = k_means(np.reshape(points, (count, -1)), k, generator)
    first: dict[int, int] = {}
    for i in top_k(rewards, count):
        first.setdefault(int(labels[i]), i)
    return tuple(first.values())


def choose(selection: str, rewards: ArrayLike, points: ArrayLike, k: int, generator: np.random.Generator) -> int:
    """Index of the candidate to go on from, by the rewards ``(n,)`` and controls, ``points`` ``(n, ...)``, of all.

    ``"top-k"`` draws one of the ``k`` best (Algorithm 5); ``"max"`` takes the best; ``"k-means"`` draws one of the best
    of ``k`` clusters (section VIII-D).
    """
    if selection == "max":
        return top_k(rewards, 1)[0]
    if selection == "top-k":
        among = top_k(rewards, k)
    elif selection == "k-means":
        among = diverse(rewards, points, k, generator)
    else:
        raise unknown("selection", selection, SELECTIONS)
    return among[int(generator.integers(len(among)))]


def _square_distances(points: Floats, centres: Floats) -> Floats:
    """``(n, c)``."""
    return ((points[:, None] - centres[None]) ** 2).sum(axis=2)
