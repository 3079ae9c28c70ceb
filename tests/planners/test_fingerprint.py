"""What tells policies of a user from each other in a store of trials."""

from __future__ import annotations

import functools
import json
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from env_support import line_problem
from test_own import program

from d4orm_planners import Policy, evaluate, make_policy
from d4orm_planners.base.planner_registry import policy_settings
from d4orm_planners.base.provenance import attributes


@dataclass(frozen=True)
class Gains:
    """Gains of a controller."""

    position: float
    rates: tuple[float, ...] = (1.8,)


class Held(Policy):
    """Pushes everyone by what it holds."""

    def __init__(self, held: Any) -> None:
        self.held = held

    def act(self, observations: dict[str, Any], state: Any) -> dict[str, Any]:
        return {agent: np.asarray(self.held, float) for agent in observations}

    def pushed(self, observation: Any) -> Any:
        return self.held


class Slotted:
    """Acts, and has no dictionary."""

    __slots__ = ("held",)

    def __init__(self, held: Any) -> None:
        self.held = held

    def reset(self, env: Any, seed: int = 0) -> None: ...

    def act(self, observations: dict[str, Any], state: Any) -> dict[str, Any]:
        return dict.fromkeys(observations, self.held)


def closed_over(held: Any) -> Callable[[Any], Any]:
    return lambda observation: held


def by_default(held: Any) -> Callable[[Any], Any]:
    def act(observation: Any, *, pushed: Any = held) -> Any:
        return pushed

    return act


def within_itself(held: Any) -> list[Any]:
    items = [held]
    items.append(items)
    return items


def cached(held: Any) -> Any:
    return functools.cache(closed_over(held))


HOLDERS: tuple[Callable[[Any], Any], ...] = (
    Held,
    Slotted,
    closed_over,
    by_default,
    lambda held: lambda: Held(held),
    lambda held: functools.partial(Held, held),
    lambda held: functools.partial(Held, held=held),
    lambda held: Held(held).pushed,
)
PAIRS: tuple[tuple[Any, Any], ...] = (
    (1, 2),
    ([1.0, 1.8], [0.0, 0.0]),
    ((1, 2), [1, 2]),
    (np.array([1.0, 2.0]), np.array([1.0, 3.0])),
    (np.zeros(4), np.zeros((2, 2))),
    (np.zeros(2), np.zeros(2, np.float32)),
    (np.float32(1), np.float32(2)),
    ({"a": [1]}, {"a": [2]}),
    ({"a", "b"}, {"a", "c"}),
    (Gains(1.0), Gains(1.0, (1.9,))),
    ([Gains(1.0)], [Gains(2.0)]),
    (deque([1]), deque([2])),
    (Path("a"), Path("b")),
    (b"a", b"b"),
    (np.random.default_rng(1), np.random.default_rng(2)),
    (lambda x: 2 * x, lambda x: 3 * x),
    (closed_over([1]), closed_over([2])),
    (cached([1]), cached([2])),
    (within_itself(1), within_itself(2)),
    (line_problem([1.0]), line_problem([2.0])),
    (Held([1]), Held([2])),
    (make_policy("d4orm"), make_policy("d4orm", num_samples=8)),
    (dict, list),
)


ALL = "[np.arange(3), {'a': {'x', 'y', 'z'}}, Gains(1.0), Path('a'), closed_over, Held]"


@pytest.mark.parametrize("pair", PAIRS)
def test_attributes_of_all_kinds_tell_policies_apart(pair: tuple[Any, Any]) -> None:
    for make in HOLDERS:
        first, second = (policy_settings(make(held)) for held in pair)
        assert first != second
        assert first == policy_settings(make(pair[0]))
        assert json.loads(json.dumps(first)) == first


def test_what_stays_itself() -> None:
    assert attributes(Held(1.5)) == {"held": 1.5}
    assert attributes(Slotted("a")) == {"held": "a"}
    assert attributes(functools.partial(closed_over, 2)) == {"0": 2}
    assert attributes(Held) == attributes(closed_over) == {}


def test_what_cannot_be_told_apart_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"'held' of Held cannot be told .* give a class whose method identity\(\)"):
        evaluate({"mine": Held(threading.Lock())}, [line_problem([1.0])], out=tmp_path / "out", workers=1)
    assert not (tmp_path / "out").exists()


def test_another_gain_runs_anew(tmp_path: Path) -> None:
    def rate(gain: Any) -> float:
        rows = evaluate({"mine": Held(np.array(gain))}, [problem], seeds=[1], out=tmp_path, workers=1)
        return rows[0].rate

    problem = line_problem([1.0])
    assert [rate(gain) for gain in ([1.0, 0.0], [0.0, 0.0], [1.0, 0.0])] == [1.0, 0.0, 1.0]


def test_digests_are_those_of_other_processes(tmp_path: Path) -> None:
    code = f"from test_fingerprint import *\nprint(attributes(Held({ALL}))['held'])\n"
    assert program(tmp_path, code).strip() == attributes(Held(eval(ALL)))["held"]
