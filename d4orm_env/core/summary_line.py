"""Summary of a problem or a motion in a line: for tables and for printing."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable

KeyFigure = tuple[str, str]
"""A key figure: what it is, and its value."""


def count(number: int, noun: str) -> str:
    """A number of things, ``"1 robot"`` or ``"2 robots"``."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def team_text(models: Iterable[str]) -> str:
    """Return the number of robots of each model, the most common first."""
    return ", ".join(f"{number} {name}" for name, number in Counter(models).most_common())


def outcome_rows(metrics: dict[str, float], num_robots: int) -> list[KeyFigure]:
    """The key figures of a plan or an episode: what arrived, what went wrong, and how long it took.

    Metrics that it lacks are left out.
    """
    texts = {
        "arrived": ("arrived", f"{{:.0f}} of {num_robots}"),
        "collided": ("in contact", "{:.0f}"),
        "margin_violated": ("within the margin", "{:.0f}"),
        "travel_time": ("travel time", "{:.2f} s"),
        "makespan": ("makespan", "{:.2f} s"),
        "goals_reached": ("goals reached", "{:.0f}"),
    }
    if "arrived" in metrics:
        del texts["goals_reached"]
    return [(text, form.format(metrics[name])) for name, (text, form) in texts.items() if name in metrics]


def joined(rows: Iterable[KeyFigure]) -> str:
    """Key figures in a line."""
    return ", ".join(f"{name} {value}" for name, value in rows)
