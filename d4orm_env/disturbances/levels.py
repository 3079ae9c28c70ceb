"""Levels of disturbances, checked."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import MISSING, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from d4orm_env.core.arrays import LARGEST, FloatArray, as_float32, positive_number, shown

MAX_DELAY = 1000
"""Most steps of a delay: every world remembers so many."""


Check = Callable[[Any, str], object]
"""``(value, name) -> value`` as it is kept, or a ``ValueError`` that has the name."""

standard_deviation: Callable[[object, str], float] = partial(positive_number, zero_allowed=True, most=LARGEST)
"""A number of zero or more."""
share: Callable[[object, str], float] = partial(positive_number, zero_allowed=True, most=1.0)
"""A probability."""


def level(check: Check, default: object = MISSING, **neutral: object) -> Any:
    """An attribute of a disturbance that is checked; where it is ``off=``, if that is given, nothing is disturbed."""
    return field(default=default, metadata={"check": check, **neutral})


def unless(special: object, check: Check) -> Check:
    """The check of all values but a special one."""
    return lambda value, name: value if value is special or value == special else check(value, name)


def truth(value: object, name: str) -> bool:
    """True or False."""
    if not isinstance(value, bool):
        raise ValueError(f"{name} is {shown(value)}; it must be True or False")
    return value


def per_component(value: ArrayLike, name: str) -> float | tuple[float, ...]:
    """One number, or one per control component, of zero or more."""
    try:
        array = as_float32(value)
    except ValueError:
        raise ValueError(f"{name} must be a number or one per control component, not {shown(value)}") from None
    if array.ndim > 1:
        raise ValueError(f"{name} has shape {array.shape}; give one number, or one per control component")
    if not np.isfinite(array).all() or (array < 0).any():
        raise ValueError(f"{name} is {shown(value)}; it must be zero or more and finite")
    if (array > LARGEST).any():
        raise ValueError(f"{name} is {shown(value)}; it must be at most {LARGEST:g}")
    return tuple(array.tolist()) if array.ndim else float(np.asarray(value, np.float64))


def check_components(value: float | tuple[float, ...], name: str, control_size: int) -> None:
    """Refuse levels that are neither one nor one per control component."""
    if isinstance(value, tuple) and len(value) != control_size:
        raise ValueError(
            f"{name} has shape ({len(value)},); give one number, or {control_size}, one per control component"
        )


def scaled(value: float | tuple[float, ...], numbers: FloatArray) -> FloatArray:
    """``numbers`` ``(..., m)`` times levels."""
    level = np.array(value, np.float32) if isinstance(value, tuple) else np.float32(value)
    return level * numbers
