"""Checked conversion of user input to read-only float32 arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float32]
BoolArray = NDArray[np.bool_]


def frozen_array(value: Any, name: str, shape: tuple[int | None, ...]) -> FloatArray:
    """``value`` as a read-only, finite float32 array.

    Args:
        value: Anything NumPy can read as numbers.
        name: What to call it in an error.
        shape: Expected shape; ``None`` matches any length.

    Raises:
        ValueError: If it cannot be read, has another shape, or holds a value that is not finite.
    """
    try:
        # A value too large for float32 becomes infinite, and is refused as such below.
        with np.errstate(over="ignore"):
            # Adding zero makes -0.0 a plain zero, so that equal problems have equal bits.
            array = np.array(value, dtype=np.float32) + np.float32(0)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} must be an array of numbers, not {value!r}") from error
    if (array.size == 0 and 0 in shape) or (array.size == 0 and None in shape):
        array = array.reshape([size or 0 for size in shape])
    if array.ndim != len(shape) or any(want is not None and want != have for want, have in zip(shape, array.shape)):
        wanted = ", ".join("any" if size is None else str(size) for size in shape)
        raise ValueError(f"{name} has shape {array.shape}; expected ({wanted})")
    if not np.isfinite(array).all():
        where = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise ValueError(f"{name}{list(where)} is {array[where]}; every value must be finite")
    array.setflags(write=False)
    return array


def frozen_per_robot(value: Any, name: str, num_robots: int) -> FloatArray:
    """``value`` as ``(num_robots,)`` positive numbers; a single number is given to every robot.

    Raises:
        ValueError: As :func:`frozen_array`, or if a value is not positive; the message names the robot.
    """
    if np.ndim(value) == 0:
        value = [value] * num_robots
    array = frozen_array(value, name, (num_robots,))
    if (array <= 0).any():
        robot = int(np.argmax(array <= 0))
        raise ValueError(f"{name} of robot_{robot} is {array[robot]:g}; it must be positive")
    return array


def restore_frozen(instance: Any, state: dict[str, Any]) -> None:
    """Set the attributes of a frozen dataclass from a pickle; NumPy brings its read-only arrays back writable."""
    for name, value in state.items():
        if isinstance(value, np.ndarray):
            value.setflags(write=False)
        object.__setattr__(instance, name, value)


LARGEST = 1e18
"""Numbers must stay below it: float32 still holds their squares."""

LARGEST_WHOLE = 2**63 - 1
"""Whole numbers must stay below it: every library holds them."""


def shown(value: Any) -> str:
    """``value`` as it stands in an error: on one line and not too long, whatever it is."""
    if isinstance(value, int) and abs(value) > LARGEST_WHOLE:
        return f"about {'-' if value < 0 else ''}1e{int(value.bit_length() * np.log10(2))}"
    try:
        text = " ".join(repr(value).split())
    except ValueError:  # a number of thousands of digits somewhere within
        text = f"a {type(value).__name__}"
    return text if len(text) <= 60 else text[:57] + "..."


def positive_number(value: Any, name: str, *, zero_allowed: bool = False) -> float:
    """``value`` as a finite positive float.

    Raises:
        ValueError: If it is not a number, not finite, negative, zero where zero is not allowed, or beyond
            :data:`LARGEST`.
    """
    try:
        if isinstance(value, bool | np.bool_):
            raise TypeError("truth is no number")
        number = float(value)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} must be a number, not {shown(value)}") from error
    except OverflowError:
        number = np.inf if value > 0 else -np.inf
    if not np.isfinite(number) or number < 0 or (number == 0 and not zero_allowed):
        raise ValueError(
            f"{name} is {number:g}; it must be {'zero or more' if zero_allowed else 'positive'} and finite"
        )
    if number > LARGEST:
        raise ValueError(f"{name} is {number:g}; it must be at most {LARGEST:g}")
    return number


def whole_number(value: Any, name: str, minimum: int) -> int:
    """``value`` as an int of at least ``minimum``.

    Raises:
        ValueError: If it is not a whole number or is too small.
    """
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, np.integer)):
        raise ValueError(f"{name} must be a whole number, not {shown(value)}")
    if value < minimum:
        raise ValueError(f"{name} is {shown(int(value))}; it must be at least {minimum}")
    return int(value)
