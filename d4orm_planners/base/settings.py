"""Settings as data: converted and checked once, when they are made, by the types of their fields.

A field's type says what it may hold, as ``Annotated[Whole, Field(ge=1)]``; pydantic does the rest. Numbers may be of
any type, but no text; they are converted, so that equal settings are equal and look alike wherever they are kept.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields
from functools import cache
from types import MappingProxyType
from typing import Annotated, Any, Self, get_type_hints

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, create_model

from d4orm_env.core.arrays import LARGEST, LARGEST_NUMBER, LARGEST_WHOLE, real_number, short_repr
from d4orm_env.core.errors import UnknownKeywordError, no_setting, unknown
from d4orm_env.engine.choice import ENGINES


def _truth(value: object) -> object:
    """NumPy's truth and text, which pydantic would take for numbers, as Python's."""
    return value.tolist() if isinstance(value, np.bool_ | np.ndarray) else value


def _whole(value: object) -> object:
    """NumPy's integers as an ``int``; anything else as it is, for pydantic to judge."""
    return int(value) if isinstance(value, np.integer) else _truth(value)


def _number(value: object) -> object:
    """Whatever means a number as a ``float``; anything else as it is, for pydantic to judge."""
    try:
        return real_number(value, "")
    except ValueError:
        return _truth(value)


def _path(value: object) -> object:
    return os.fspath(value) if isinstance(value, os.PathLike) else value


def _variance(value: float) -> float:
    if not 0 < value < 1:
        raise ValueError(f"is {value:g}; it must lie between 0 and 1")
    return value


def one_of(choices: Iterable[str]) -> AfterValidator:
    """Return a check that a text is one of these."""
    known = tuple(choices)

    def check(value: str) -> str:
        if value not in known:
            raise unknown("", value, known)
        return value

    return AfterValidator(check)


Whole = Annotated[int, BeforeValidator(_whole), Field(le=LARGEST_WHOLE)]
Count = Annotated[Whole, Field(ge=1)]
Samples = Annotated[Whole, Field(ge=2, le=10**7)]
Steps = Annotated[Whole, Field(ge=1, le=10**6)]  #: A number of samples or steps, no more than memory and time allow
Number = Annotated[float, BeforeValidator(_number), Field(le=LARGEST_NUMBER)]
Positive = Annotated[Number, Field(gt=0)]
Seconds = Annotated[Number, Field(ge=0, le=LARGEST)]  #: No clock waits longer
NotNegative = Annotated[Number, Field(ge=0)]
Share = Annotated[Number, Field(gt=0, le=1)]
ShareOrNone = Annotated[Number, Field(ge=0, le=1)]
Variance = Annotated[Number, AfterValidator(_variance)]
PathText = Annotated[str, BeforeValidator(_path)]
EngineName = Annotated[str, one_of(ENGINES)]


NOTHING: Mapping[str, object] = MappingProxyType({})


@dataclass(frozen=True, kw_only=True)
class CheckedSettings:
    """Base of settings; a subclass is a frozen dataclass with fields of the types above.

    Raises:
        ValueError: If a value makes no sense; one line that names the setting, the value and what was expected.
    """

    def __post_init__(self) -> None:
        kind: Any = type(self)
        try:
            converted = _schema(kind)(**vars(self))
        except ValidationError as error:
            raise ValueError(_explain(error, vars(self))) from None
        for field in fields(self):
            object.__setattr__(self, field.name, getattr(converted, field.name))

    @classmethod
    def setting_names(cls, given: Mapping[str, object] = NOTHING) -> tuple[str, ...]:
        """Names of all settings that there are where these are given, in order."""
        del given
        return tuple(field.name for field in fields(cls))

    @classmethod
    def from_keywords(cls, given: Mapping[str, object], owner: str) -> Self:
        """Settings as users give them; an UnknownKeywordError names what is none, whose, and those there are."""
        known = cls.setting_names(given)
        for name in given:
            if name not in known:
                if name == "time_limit" and "max_iterations" in known:
                    raise UnknownKeywordError(
                        f"'time_limit' is no setting of {owner}; give it to solve(), or as --time-limit"
                    )
                raise no_setting(name, owner, known)
        return cls._made_of(given)

    @classmethod
    def _made_of(cls, given: Mapping[str, object]) -> Self:
        return cls(**given)

    def keywords(self) -> dict[str, object]:
        """All settings as :meth:`from_keywords` takes them."""
        return asdict(self)


@cache
def _schema(kind: type[CheckedSettings]) -> type[BaseModel]:
    """The types of all settings, as pydantic checks them."""
    types = get_type_hints(kind, include_extras=True)
    wanted: dict[str, Any] = {field.name: (types[field.name], ...) for field in fields(kind)}
    config = ConfigDict(strict=True, allow_inf_nan=False, arbitrary_types_allowed=True)
    return create_model(kind.__name__, __config__=config, **wanted)


_EXPECTED = {
    "greater_than": "above {gt:g}",
    "greater_than_equal": "at least {ge:g}",
    "less_than": "below {lt:g}",
    "less_than_equal": "at most {le:g}",
    "finite_number": "finite",
    "int_type": "a whole number",
    "float_type": "a number",
    "dict_type": "a mapping",
    "bool_type": "True or False",
    "string_type": "text",
}
"""Expectations by pydantic's kinds of errors; others keep its own words."""

_PLAIN = {"above 0": "positive", "at least 0": "zero or more"}


def _explain(error: ValidationError, given: Mapping[str, object]) -> str:
    """The first error as one line."""
    first = error.errors(include_url=False)[0]
    name, kind, value = str(first["loc"][0]), first["type"], first["input"]
    if isinstance(group := given[name], Mapping) and first["loc"][1:] and first["loc"][1] in group:
        name = f"{first['loc'][1]} of {name}"
    if kind == "value_error":
        return f"{name} {first['ctx']['error']}"
    if kind not in _EXPECTED:
        return f"{name}: {first['msg']}, not {short_repr(value)}"
    expected = _EXPECTED[kind].format(**first.get("ctx", {}))
    if kind.endswith("_type"):
        return f"{name} must be {expected}, not {short_repr(value)}"
    found = f"{value:g}" if isinstance(value, float) else short_repr(value)
    return f"{name} is {found}; it must be {_PLAIN.get(expected, expected)}"
