"""What the docs say of the trials in ``data/``, computed from them: prose is held to the data as the tables are."""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import cache
from pathlib import Path

import pytest

from d4orm_planners.evaluation.store import Trial
from d4orm_planners.evaluation.tables import read_parquet

pytest.importorskip("pyarrow", reason="needs pip install d4orm-env[evaluate]")

ROOT = Path(__file__).resolve().parents[1]
WORDS = ("none", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten")


@cache
def trials(name: str) -> tuple[Trial, ...]:
    """The trials of ``data/name.parquet``."""
    return tuple(read_parquet(ROOT / "data" / f"{name}.parquet"))


@cache
def text(page: str) -> str:
    """A page of the repository, with single spaces for all whitespace."""
    return " ".join((ROOT / page).read_text().split())


def says(page: str, *statements: str) -> None:
    """Assert that a page has these words, whatever its line breaks, and no longer numbers at their ends."""
    for statement in statements:
        words = re.escape(" ".join(statement.split()))
        assert re.search(rf"(?<![\d.,]){words}(?!\d|[.,]\d)", text(page)), f"{page} does not say: {statement}"


def listed(values: Iterable[object]) -> str:
    """Values as a sentence has them, such as "1, 2 and 3"."""
    *others, last = map(str, values)
    return f"{', '.join(others)} and {last}"


def span(values: Iterable[float], form: str = "g", join: str = " to ") -> str:
    """From the least to the greatest."""
    found = sorted(values)
    return f"{found[0]:{form}}{join}{found[-1]:{form}}"
