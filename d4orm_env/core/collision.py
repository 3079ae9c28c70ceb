"""Contact tests in scalar style, on squared lengths: no square root is needed to compare two distances.

Two bodies touch when the distance between their surfaces is zero or less, so every test is "less or equal"
(paper, Eq. 1 and the safety reward, with the margin added to the reach).
"""

from __future__ import annotations

from typing import Any

from d4orm_env.core.robot_model import Ops


def axis_gap(x: Any, lower: Any, upper: Any, zero: Any, ops: Ops) -> Any:
    """How far ``x`` lies outside the interval from ``lower`` to ``upper``; zero inside it."""
    return ops.maximum(ops.maximum(lower - x, x - upper), zero)


def leaves(x: Any, reach: Any, lower: Any, upper: Any) -> Any:
    """Whether a body of that reach at ``x`` touches or leaves the interval from ``lower`` to ``upper``."""
    return (x - reach <= lower) | (x + reach >= upper)
