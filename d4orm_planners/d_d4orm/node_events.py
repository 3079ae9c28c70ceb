"""Reports of a node of D-D4orm to an observer of its work, for timelines (paper, section VIII-D)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from d4orm_planners.base.candidate import Candidate

KINDS = ("computed", "sent", "received", "selected")
"""A node has made a candidate, sent it, got one, or chosen it to go on from."""


@dataclass(frozen=True, eq=False)
class Event:
    """Something that a node did.

    Attributes:
        node: The node that did it.
        kind: One of :data:`KINDS`.
        begin: Time at which it began to, by :func:`time.perf_counter` [s].
        end: Time at which it was done, likewise. Messages take no time here.
        of: The node that the candidate came from.
        sequence: Number among that node's messages, from 1; 0 for one that was not sent yet.
        candidate: The candidate, as evaluated by ``node``.
        size: Bytes of the message that was sent, else 0.
    """

    node: int
    kind: str
    begin: float
    end: float
    of: int
    sequence: int
    candidate: Candidate
    size: int = 0


Observer = Callable[[Event], object]
