"""What the fuzz tests share: how many examples, values of every kind, and what it means to refuse one.

The property is the same everywhere: an input that is accepted works and leads to finite numbers; anything else is
refused by a ``ValueError`` or ``TypeError`` of one line (on the command line: exit status 2 and one line on stderr) and
changes nothing. Values are of every kind, but none that would take more than some 100 MB or a second if it were
accepted: numbers are small enough to run, or so large that nothing could ever hold as many.
"""

from __future__ import annotations

import datetime
import os
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

Result = TypeVar("Result")


def few(examples: int) -> settings:
    """So many examples, the same in every run; with ``pytest --fuzz-examples N`` it is N, drawn anew."""
    asked = os.environ.get("FUZZ_EXAMPLES")
    return settings(
        max_examples=int(asked) if asked else examples,
        derandomize=not asked,
        database=None,
        deadline=None,
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
    )


WHOLE = st.one_of(st.integers(-3, 12), st.sampled_from([2**63, -(2**63), 2**64, 10**30, 10**400]))
DECIMAL = st.one_of(
    st.floats(-10, 10),
    st.sampled_from([0.0, -0.0, 1e-300, 1e-50, 1e-4, 0.5, 1.0, 1e19, 1e30, 1e308, float("inf"), float("nan")]),
)
NUMBER_LIKE = st.sampled_from(
    [
        "1", "0", "-1", "1e-4", "1E5", "0.5", "+.5", "1_0", "0x10", "010", "1:30", ".nan", "nan", "inf", "-.inf",
        "1e400", "9" * 30, "9" * 5000, "٣", " 1", "1 ", "1,5",
    ]
)  # fmt: skip
WORD = st.one_of(
    st.sampled_from(["", "None", "null", "~", "true", "no", "auto", "cpu", "robot", "team", "a=b", "=", "--", "../x"]),
    st.text(max_size=6),
)
SCALAR = st.one_of(st.none(), st.booleans(), WHOLE, DECIMAL, NUMBER_LIKE, WORD)
OBJECT = st.sampled_from(
    [
        b"1", 1j, [], {}, (), [1], [[1, 2]], {"a": 1}, {1}, object, print, datetime.date(2000, 1, 1),
        np.float32(0.5), np.float32(np.nan), np.int64(3), np.uint8(200), np.bool_(True), np.array(1), np.array([1.0]),
        np.array([]), np.array(["a"]), np.array([None]), np.datetime64("2000-01-01"), np.ma.masked,
    ]
)  # fmt: skip
ANYTHING = st.one_of(SCALAR, OBJECT)
PLAIN = st.recursive(
    SCALAR, lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(WORD, inner, max_size=3)), max_leaves=6
)
"""What a YAML or JSON file can hold."""


def refused(call: Callable[[], Result], *names: str) -> tuple[Result | None, bool]:
    """What a call returns, and whether it refused its input; then the error must be one line with one of the names."""
    try:
        return call(), False
    except (ValueError, TypeError) as error:
        text = str(error)
    assert text, "an error without a word"
    assert "\n" not in text, f"more than one line: {text!r}"
    # Names of any kind are given as Python writes them.
    assert not names or any(name in text or repr(name)[1:-1] in text for name in names), f"{text!r} is not on {names}"
    return None, True


def all_finite(*values: Any) -> bool:
    """Whether every number in these arrays, numbers, dictionaries and lists of such is finite."""
    return all(
        all_finite(*value.values())
        if isinstance(value, dict)
        else all_finite(*value)
        if isinstance(value, list | tuple)
        else value is None or bool(np.isfinite(np.asarray(value, np.float64)).all())
        for value in values
    )


@st.composite
def spoiled(draw: st.DrawFn, document: Any) -> Any:
    """A document of mappings, lists and scalars with a part or two replaced, removed, doubled or added to."""
    for _ in range(draw(st.integers(1, 2))):
        document = _spoil(draw, document)
    return document


def _spoil(draw: st.DrawFn, node: Any) -> Any:
    if isinstance(node, dict) and node and draw(st.integers(0, 4)):
        key = draw(st.sampled_from(sorted(node)))
        change = draw(st.integers(0, 7))
        if change == 0:
            return {name: value for name, value in node.items() if name != key}
        if change == 1:
            return {**node, draw(WORD): draw(PLAIN)}
        return {**node, key: _spoil(draw, node[key])}
    if isinstance(node, list) and node and draw(st.integers(0, 4)):
        index = draw(st.integers(0, len(node) - 1))
        change = draw(st.integers(0, 7))
        if change == 0:
            return node[:index] + node[index + 1 :]
        if change == 1:
            return [*node, node[index]]
        return [*node[:index], _spoil(draw, node[index]), *node[index + 1 :]]
    return draw(PLAIN)


@st.composite
def damaged(draw: st.DrawFn, content: bytes) -> bytes:
    """Bytes with some overwritten, cut off at the end or doubled."""
    data = bytearray(content)
    for _ in range(draw(st.integers(1, 3))):
        position = draw(st.integers(0, max(len(data) - 1, 0)))
        kind = draw(st.integers(0, 5))
        if kind == 0:
            del data[position:]
        elif kind == 1:
            data[position:position] = data[position : position + draw(st.integers(1, 40))]
        else:
            data[position : position + 1] = draw(st.binary(min_size=1, max_size=4))
    return bytes(data)
