"""Checked conversion of user input to read-only float32 arrays."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, fields
from typing import Any, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float32]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]
Floats = NDArray[np.float64]
"""Arrays where float32 is not enough."""
Ints = NDArray[np.int32]
"""Arrays that must not take more room."""
Whole = int | np.int64
"""A whole number in compiled code, where int and int64 are one."""


A = TypeVar("A", bound=np.ndarray | tuple[Any, ...])

SMALLEST, LARGEST = 1e-7, 1e6
"""Limits, radii, coordinates and times lie between these in SI units: float32 then holds all that is computed of them,
over a whole horizon."""


def read_only(arrays: A) -> A:
    """An array, or the arrays in a tuple, made read-only."""
    for array in arrays if isinstance(arrays, tuple) else (arrays,):
        if isinstance(array, np.ndarray):
            array.setflags(write=False)
    return arrays


def as_float32(value: ArrayLike) -> FloatArray:
    """A new float32 array of ``value``, PyTorch's tensors included; what is too large for float32 becomes infinite.

    What cannot be read as numbers, or is a whole number that no float holds, is a ValueError.
    """
    array: FloatArray = _as_floats(value, np.float32)
    return array


def _as_floats(value: ArrayLike, dtype: type) -> Any:
    try:
        with np.errstate(over="ignore"):
            return np.array(_detached(value), dtype)
    except OverflowError:
        raise ValueError("it holds a whole number too large for a float") from None
    except (RuntimeError, TypeError, ValueError):
        raise ValueError("it does not hold numbers only, in rows of one length; text and True are none") from None


def _detached(value: Any) -> Any:
    """``value`` with PyTorch's tensors, in a list too, as arrays, whatever their device and gradients."""
    # What most calls are for, in every step of an environment.
    if isinstance(value, float) or (isinstance(value, np.ndarray) and value.dtype.kind == "f"):
        return value
    if isinstance(value, list | tuple):
        return [_detached(part) for part in value]
    dtype = getattr(value, "dtype", None)
    kind = getattr(dtype, "kind", str(dtype))
    if kind == "O":
        return _detached(value.tolist())
    # NumPy would drop imaginary parts, and read text, times and truth values as numbers.
    if isinstance(value, str | bytes | bool) or kind in ("b", "c", "S", "U", "m", "M", "torch.bool"):
        raise TypeError("these are no real numbers")
    # In double precision NumPy has all of PyTorch's types.
    return value.detach().cpu().double().numpy() if hasattr(value, "detach") else value


def numbers_of(value: ArrayLike, what: str, dtype: type = np.float32) -> Any:
    """A new array of what a user gave, as :func:`as_float32`; errors say ``what`` it is: ``"goal must be numbers"``."""
    try:
        if value is None:
            raise ValueError("nothing was given")
        return _as_floats(value, dtype)
    except ValueError as error:
        raise ValueError(f"{what}, not {short_repr(value)}; {error}") from error


def frozen_array(
    value: ArrayLike,
    name: str,
    shape: tuple[int | None, ...],
    *,
    largest: float = float("inf"),
    columns: Collection[str] = (),
) -> FloatArray:
    """``value`` as a read-only, finite float32 array of a shape, in which ``None`` matches any length.

    ``columns`` are what its columns mean, for the message.

    Raises:
        ValueError: If it cannot be read, has another shape, or holds a value that is not finite or beyond ``largest``.
    """
    # Adding zero makes -0.0 a plain zero, so that equal problems have equal bits.
    array = numbers_of(value, f"{name} must be an array of numbers") + np.float32(0)
    if array.size == 0 and (0 in shape or None in shape):
        array = array.reshape([size or 0 for size in shape])
    if array.ndim != len(shape) or any(want is not None and want != have for want, have in zip(shape, array.shape)):
        wanted = ", ".join("any" if size is None else str(size) for size in shape) + "," * (len(shape) == 1)
        meaning = ": " * bool(columns) + ", ".join(columns)
        raise ValueError(f"{name} has shape {array.shape}; expected ({wanted}){meaning}")
    too_large = np.abs(array) > largest, f"magnitudes must be at most {largest:g}"
    for wrong, remedy in ((~np.isfinite(array), "every value must be finite"), too_large):
        if wrong.any():
            where = np.argwhere(wrong)[0].tolist()
            raise ValueError(f"{name}{where} is {array[tuple(where)]:g}; {remedy}")
    return read_only(array)


def frozen_per_robot(value: ArrayLike, name: str, num_robots: int, *, zero_allowed: bool = False) -> FloatArray:
    """``value`` as ``(num_robots,)`` numbers from :data:`SMALLEST`, or zero, to :data:`LARGEST`; a single one is given
    to every robot.

    Others are a ValueError that names the robot.
    """
    array = frozen_array(one_or_each(value, name, num_robots), name, (num_robots,))
    least = 0.0 if zero_allowed else SMALLEST
    if not zero_allowed:
        refuse_robots(array <= 0, name, array, "positive")
    refuse_robots((array < np.float32(least)) | (array > LARGEST), name, array, f"from {least:g} to {LARGEST:g}")
    return array


def one_or_each(value: ArrayLike, name: str, num_robots: int, note: str = "") -> FloatArray:
    """``(num_robots,)`` numbers, given as one for all robots or one each."""
    numbers = numbers_of(value, f"{name} must be a number or one per robot")
    numbers = np.repeat(numbers, num_robots) if numbers.ndim == 0 else numbers
    if numbers.shape != (num_robots,):
        raise ValueError(f"{name} has shape {numbers.shape}; expected one number, or ({num_robots},){note}")
    return numbers


def refuse_robots(wrong: BoolArray, name: str, values: FloatArray, wanted: str, unit: str = "") -> None:
    """Refuse ``values`` ``(K,)``, a number of a unit for each robot, where they are ``wrong`` ``(K,)``."""
    for robot in np.flatnonzero(wrong)[:1]:
        raise ValueError(f"{name} of robot_{robot} is {values[robot]:g}{unit}; it must be {wanted}")


@dataclass(frozen=True, eq=False, init=False)
class Frozen:
    """Data that are set once, and equal where their values are.

    Copies, unpickled ones too, have read-only arrays and no cached values.
    """

    def _set(self, **values: object) -> None:
        for name, value in values.items():
            parts = tuple(value.values()) if isinstance(value, Mapping) else value
            read_only(parts if isinstance(parts, tuple) else (parts,))
            object.__setattr__(self, name, value)

    def replace(self, **changes: object) -> Self:
        """A copy with some attributes changed, checked again."""
        return type(self)(**self.__getstate__() | changes)

    def __getstate__(self) -> dict[str, object]:
        return {attribute.name: getattr(self, attribute.name) for attribute in fields(self)}

    def __setstate__(self, state: dict[str, object]) -> None:
        self._set(**state)

    def __eq__(self, other: object) -> bool:
        return type(other) is type(self) and _content(self.__getstate__()) == _content(other.__getstate__())

    def __hash__(self) -> int:
        return hash(_content(self.__getstate__()))


def _content(value: object) -> object:
    """``value`` as something hashable that is equal where shapes and bits of its arrays are."""
    if isinstance(value, Mapping):
        return frozenset((name, _content(part)) for name, part in value.items())
    if isinstance(value, tuple):
        return tuple(map(_content, value))
    return (value.shape, value.tobytes()) if isinstance(value, np.ndarray) else value


LARGEST_NUMBER = 1e18
"""Numbers must stay below it: float32 still holds their squares."""

LARGEST_WHOLE = 2**63 - 1
"""Whole numbers must stay below it: every library holds them."""


def short_repr(value: object) -> str:
    """``value`` as errors show it: on one line, and not too long."""
    if isinstance(value, int) and abs(value) > LARGEST_WHOLE:
        return f"about {'-' if value < 0 else ''}1e{int(value.bit_length() * np.log10(2))}"
    try:
        text = " ".join(repr(value).split())
    except ValueError:  # a number of thousands of digits somewhere within
        text = f"a {type(value).__name__}"
    return text if len(text) <= 60 else text[:57] + "..."


def is_one_of(value: object, names: Iterable[str]) -> bool:
    """Check that ``value`` is text and one of the names; an array, compared to them, has many answers."""
    return isinstance(value, str) and value in list(names)


def check_choice(value: object, name: str, names: Collection[str]) -> None:
    """Refuse what is none of the names."""
    if not is_one_of(value, names):
        raise ValueError(f"{name} is {short_repr(value)}; choose one of {', '.join(names)}")


def number_list(given: object, name: str, count: int | None = None) -> Floats:
    """A list of finite numbers in a file, or one number; the first ``count`` of them, where so many are wanted."""
    try:
        numbers = np.atleast_1d(numbers_of(given, name, np.float64))  # type: ignore[arg-type] # what is none raises
    except ValueError:
        numbers = np.zeros((0, 0))
    if numbers.ndim != 1 or len(numbers) < (count or 0):
        wanted = "be a list of numbers, as [1.0, 2.5]" if count is None else f"have numbers, {count} of them"
        raise ValueError(f"{name} is {short_repr(given)}; it must {wanted}")
    if not (abs(numbers) <= LARGEST).all():
        raise ValueError(f"{name} is {short_repr(given)}; all must be numbers of at most {LARGEST:g}")
    return numbers[:count]


def real_number(value: object, name: str) -> float:
    """``value`` as a float; a ValueError if it is no number, as text and truth values are none."""
    try:
        return float(_detached(value))
    except (RuntimeError, TypeError, ValueError) as error:
        raise ValueError(f"{name} must be a number, not {short_repr(value)}") from error
    except OverflowError:
        return np.inf if value > 0 else -np.inf  # type: ignore[operator] # a whole number


def positive_number(
    value: object, name: str, *, zero_allowed: bool = False, least: float = 0.0, most: float = LARGEST_NUMBER
) -> float:
    """``value`` as a finite positive float, or zero if that is allowed; by default float32 still holds its square.

    Raises:
        ValueError: If it is not a number, not finite, negative, zero where zero is not allowed, below ``least`` or
            above ``most``.
    """
    number = real_number(value, name)
    if not np.isfinite(number) or number < 0 or (number == 0 and not zero_allowed):
        raise ValueError(
            f"{name} is {number:g}; it must be {'zero or more' if zero_allowed else 'positive'} and finite"
        )
    if number > most:
        raise ValueError(f"{name} is {number:g}; it must be at most {most:g}")
    if 0 < number < least:
        raise ValueError(f"{name} is {number:g}; it must be at least {least:g}")
    return number


def duration(value: object, name: str) -> float:
    """``value`` as a positive number of seconds that every clock can wait: at most :data:`LARGEST`, eleven days."""
    return positive_number(value, name, most=LARGEST)


def whole_number(value: object, name: str, minimum: int, maximum: int | None = None) -> int:
    """``value`` as an int of at least ``minimum``, and at most ``maximum`` where there is one."""
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, np.integer)):
        raise ValueError(f"{name} must be a whole number, not {short_repr(value)}")
    if value < minimum:
        raise ValueError(f"{name} is {short_repr(int(value))}; it must be at least {minimum}")
    if maximum is not None and value > maximum:
        raise ValueError(f"{name} is {short_repr(int(value))}; it must be at most {maximum}")
    return int(value)


def truth(value: object, name: str) -> bool:
    """True or False."""
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"{name} is {short_repr(value)}; it must be True or False")
    return bool(value)


def plain_number(value: object) -> object:
    """A number or truth value of NumPy's as Python's, else a TypeError: ``default=`` of ``json.dumps``."""
    for theirs, ours in ((np.bool_, bool), (np.integer, int), (np.floating, float)):
        if isinstance(value, theirs):
            return ours(value)
    raise TypeError(f"{type(value).__name__} has no form in JSON")


MAX_ACTION = 1e15
"""Largest magnitude of an action. float32 still holds the square of more, but no control of a robot is near it: an
action so far outside its space is refused like one that is not finite, and less is clipped to the robot's limits."""


def usable(actions: FloatArray) -> BoolArray:
    """Return where actions are finite, and at most :data:`MAX_ACTION` in magnitude."""
    return np.abs(actions) <= MAX_ACTION
