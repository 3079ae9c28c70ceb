"""The messages of D-D4orm, candidates as bytes, and their transport: the threads of a process as the simplest one.

Layout, little-endian: magic, version, feasible, node, sequence, ``H``, ``K``, ``m``, reward (float64), the problem's
SHA-256; then ``(H, K, m)`` controls as float32; then the CRC-32 of all before. Whatever else arrives is told apart by
its fault, never unpickled.
"""

from __future__ import annotations

import struct
import threading
import zlib
from abc import ABC, abstractmethod
from collections import deque
from dataclasses import dataclass

import numpy as np

from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.problem import Problem
from d4orm_planners.base.candidate import MOST_OF_LIMIT

MAGIC = b"D4DC"
VERSION = 1
MAX_BYTES = 16 * 2**20  #: Longer messages are neither sent nor read

KINDS = (
    "garbage", "truncated", "too_large", "version", "checksum", "problem", "node", "shape", "not_finite", "limits",
    "stale",
)  # fmt: skip
"""Faults of messages that are dropped. ``"stale"`` is not the codec's to see, but the inbox's."""

_HEADER = struct.Struct("<4sHHIQIIId32s")
_CHECKSUM = struct.Struct("<I")


@dataclass(frozen=True, eq=False)
class Message:
    """A candidate as a node claims it to be."""

    node: int  #: Its sender, from 0
    sequence: int  #: Number of the candidate, from 1
    controls: FloatArray  #: ``(H, K, m)`` as planned, for the receiver to go on from as the sender would
    reward: float  #: Mean reward
    feasible: bool  #: Whether it is a solution


class MessageError(ValueError):
    """Bytes that are no usable message, with their kind of fault, one of :data:`KINDS`."""

    def __init__(self, kind: str, text: str) -> None:
        super().__init__(text)
        self.kind = kind


def encode(message: Message, problem: Problem) -> bytes:
    """A message as bytes. Raises MessageError if it would be longer than :data:`MAX_BYTES`."""
    digest = bytes.fromhex(problem.digest)
    content = np.ascontiguousarray(message.controls, "<f4")
    header = _HEADER.pack(
        MAGIC, VERSION, message.feasible, message.node, message.sequence, *content.shape, message.reward, digest
    )
    data = header + content.tobytes()
    data += _CHECKSUM.pack(zlib.crc32(data))
    if len(data) > MAX_BYTES:
        raise MessageError("too_large", f"a candidate takes {len(data)} bytes; at most {MAX_BYTES} are sent")
    return data


def decode(data: bytes, problem: Problem, num_nodes: int) -> Message:
    """Read a message, which may be anything, about this problem, from a node that is numbered below ``num_nodes``.

    A MessageError if it is anything but one of this version with finite controls, none beyond
    :data:`~d4orm_planners.base.candidate.MOST_OF_LIMIT` times its limit.
    """
    if len(data) > MAX_BYTES:
        raise MessageError("too_large", f"{len(data)} bytes; at most {MAX_BYTES} are read")
    if data[: len(MAGIC)] != MAGIC[: len(data)] or not data:
        raise MessageError("garbage", f"{len(data)} bytes that do not begin with {MAGIC!r}")
    if len(data) < _HEADER.size:
        raise MessageError("truncated", f"{len(data)} bytes; the header alone takes {_HEADER.size}")
    _, version, feasible, node, sequence, *shape, reward, digest = _HEADER.unpack_from(data)
    if version != VERSION:
        raise MessageError("version", f"version {version}; this is version {VERSION}")
    _check_length(data, shape)
    if _CHECKSUM.unpack_from(data, len(data) - _CHECKSUM.size)[0] != zlib.crc32(data[: -_CHECKSUM.size]):
        raise MessageError("checksum", "the checksum does not fit the content")
    if digest.hex() != problem.digest:
        raise MessageError("problem", f"about problem {digest.hex()[:8]}; this is {problem.digest[:8]}")
    if node >= num_nodes:
        raise MessageError("node", f"from node {node}; there are {num_nodes}, from 0")
    controls = np.frombuffer(data[_HEADER.size : -_CHECKSUM.size], "<f4").astype(np.float32)
    return Message(node, sequence, _checked(controls, tuple(shape), reward, problem), reward, bool(feasible))


def _check_length(data: bytes, shape: list[int]) -> None:
    steps, robots, size = shape
    length = _HEADER.size + 4 * steps * robots * size + _CHECKSUM.size
    if len(data) != length:
        kind = "truncated" if len(data) < length else "too_large"
        raise MessageError(kind, f"{len(data)} bytes; the header announces {length}")


def _checked(controls: FloatArray, shape: tuple[int, ...], reward: float, problem: Problem) -> FloatArray:
    expected = (problem.horizon, problem.num_robots, problem.control_size)
    if shape != expected:
        raise MessageError("shape", f"controls of shape {shape}; expected (H, K, m) = {expected}")
    if not (np.isfinite(controls).all() and np.isfinite(reward)):
        raise MessageError("not_finite", "a control or the reward is not finite")
    controls = controls.reshape(shape)
    if (np.abs(controls) > MOST_OF_LIMIT * problem.team.control_limits).any():
        raise MessageError("limits", f"a control is more than {MOST_OF_LIMIT:g} times its limit")
    return controls


TRANSPORTS = ("local", "ray", "zenoh")
WAITING = 64  #: Messages that wait for a slow node at most; then the oldest are lost, which newer ones replace anyhow


class Transport(ABC):
    """One node's access to the others. Messages are bytes; they may get lost, and come in any order.

    What arrives, whatever thread it comes from, is kept until it is collected.
    """

    def __init__(self) -> None:
        self._arrived: deque[bytes] = deque(maxlen=WAITING)
        self._changed = threading.Condition()
        self.closed = False

    @abstractmethod
    def publish(self, data: bytes) -> None:
        """Send to all other nodes, without waiting for them; nothing happens once closed."""

    def put(self, data: bytes) -> None:
        """Let a message arrive."""
        with self._changed:
            self._arrived.append(data)
            self._changed.notify_all()

    def collect(self, timeout: float = 0.0) -> list[bytes]:
        """Everything that has arrived since the last call; waits up to ``timeout`` [s] for something to arrive.

        Once closed there is nothing, at once.
        """
        with self._changed:
            self._changed.wait_for(lambda: self.closed or self._arrived, timeout)
            messages = [] if self.closed else list(self._arrived)
            self._arrived.clear()
        return messages

    def close(self) -> None:
        """Leave. A call that waits in :meth:`collect` is woken; closing again does no harm."""
        with self._changed:
            self.closed = True
            self._changed.notify_all()


class LocalTransport(Transport):
    """The ``"local"`` transport: one end of a :class:`LocalNetwork`."""

    def __init__(self, ends: list[LocalTransport]) -> None:
        super().__init__()
        self._ends = ends

    def publish(self, data: bytes) -> None:
        if self.closed:
            return
        for end in self._ends.copy():
            if end is not self:
                end.put(bytes(data))


class LocalNetwork:
    """A fully connected network inside one process."""

    def __init__(self) -> None:
        self._ends: list[LocalTransport] = []

    def join(self) -> LocalTransport:
        """A new end of the network; it receives what is sent from now on."""
        end = LocalTransport(self._ends)
        self._ends.append(end)
        return end
