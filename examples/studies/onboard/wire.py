"""Messages between the world and the robots in every tick, as JSON: nothing is unpickled, bad messages are None."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass
from typing import Any, TypeVar

MAX_BYTES = 2**20


@dataclass(frozen=True)
class Tick:
    """Message of the world to all robots.

    Attributes:
        number: Ticks since the start; -1 for the last message, which ends the run.
        state: The joint state, see :mod:`d4orm_env.envs.joint_state`.
        lost: Robots that have been given up; they stand where they stopped.
        ballots: Plan that each robot announced last as its choice, ``""`` for none.
        rewards: Rewards of those.
    """

    number: int
    state: list[float]
    lost: list[int]
    ballots: list[str]
    rewards: list[float]


@dataclass(frozen=True)
class Command:
    """Message of a robot in a tick.

    Attributes:
        number: The tick.
        robot: Its number.
        control: ``(m,)``.
        ballot: Digest of the plan that it would take over next, ``""`` for none.
        reward: Its reward.
        executing: Digest of the plan that it executes.
    """

    number: int
    robot: int
    control: list[float]
    ballot: str
    reward: float
    executing: str


END = Tick(-1, [], [], [], [])

Word = TypeVar("Word", Tick, Command)


def encode(word: Tick | Command) -> bytes:
    """A message as bytes."""
    return json.dumps({"kind": type(word).__name__, **asdict(word)}).encode()


def decode(data: bytes, kind: type[Word]) -> Word | None:
    """A message of that kind; ``None`` for one of another kind, or anything else."""
    if len(data) > MAX_BYTES:
        return None
    try:
        fields = json.loads(data)
        if fields.pop("kind") != kind.__name__:
            return None
        word = kind(**fields)
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return None
    return word if _is_sound(word) else None


def _is_sound(word: Tick | Command) -> bool:
    if isinstance(word, Tick):
        lists = [(word.state, float), (word.lost, int), (word.ballots, str), (word.rewards, float)]
        return type(word.number) is int and all(_all_of(values, kind) for values, kind in lists)
    texts = isinstance(word.ballot, str) and isinstance(word.executing, str)
    numbers = type(word.number) is int and type(word.robot) is int and isinstance(word.control, list)
    return texts and numbers and _all_of([*word.control, word.reward], float)


def _all_of(values: Any, kind: type) -> bool:
    return isinstance(values, list) and all(
        type(value) is kind and (kind is not float or math.isfinite(value)) for value in values
    )
