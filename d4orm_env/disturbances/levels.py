"""Levels of disturbances, checked."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from d4orm_env.core.arrays import LARGEST, FloatArray, as_float32, positive_number, shown

MAX_DELAY = 1000
"""Most steps of a delay: every world remembers so many."""


def standard_deviation(value: object, name: str, most: float = LARGEST) -> float:
    """``value`` as a number of zero or more.

    Raises:
        ValueError: If it is none.
    """
    return positive_number(value, name, zero_allowed=True, most=most)


def share(value: object, name: str) -> float:
    """``value`` as a probability.

    Raises:
        ValueError: If it is not a number from 0 to 1.
    """
    return positive_number(value, name, zero_allowed=True, most=1.0)


def per_component(value: ArrayLike, name: str) -> float | tuple[float, ...]:
    """One number, or one per control component, of zero or more.

    Raises:
        ValueError: If it is something else.
    """
    try:
        array = as_float32(value)
    except ValueError:
        raise ValueError(f"{name} must be a number or one per control component, not {shown(value)}") from None
    if array.ndim > 1:
        raise ValueError(f"{name} has shape {array.shape}; give one number, or one per control component")
    if not np.isfinite(array).all() or (array < 0).any():
        raise ValueError(f"{name} is {array.tolist()}; it must be zero or more and finite")
    if (array > LARGEST).any():
        raise ValueError(f"{name} is {array.tolist()}; it must be at most {LARGEST:g}")
    return tuple(array.tolist()) if array.ndim else float(np.asarray(value, np.float64))


def check_components(value: float | tuple[float, ...], name: str, control_size: int) -> None:
    """Refuse levels that are neither one nor one per control component.

    Raises:
        ValueError: If they are as many as something else.
    """
    if isinstance(value, tuple) and len(value) != control_size:
        raise ValueError(
            f"{name} has shape ({len(value)},); give one number, or {control_size}, one per control component"
        )


def scaled(value: float | tuple[float, ...], numbers: FloatArray) -> FloatArray:
    """``numbers`` ``(..., m)`` times levels."""
    level = np.array(value, np.float32) if isinstance(value, tuple) else np.float32(value)
    product: FloatArray = level * numbers
    return product
