"""Disturbances by name, as on the command line: ``delay``, ``push.speed``, ``package.module:Wind.speed``."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Mapping
from dataclasses import MISSING, asdict, fields, is_dataclass
from typing import NamedTuple

import numpy as np

from d4orm_env.core.arrays import short_repr
from d4orm_env.core.files import parse_yaml
from d4orm_env.core.registry import Registry
from d4orm_env.disturbances.controls import Bias, ControlNoise, CorrelatedNoise, Delay, Dropout, Gain, Lag, Quantisation
from d4orm_env.disturbances.disturbance import AnyDisturbance, Disturbance
from d4orm_env.disturbances.moving_obstacle import Intruder
from d4orm_env.disturbances.perception import Occlusion, RayNoise, StateDelay, StateNoise
from d4orm_env.disturbances.robot_faults import Drag, LimitMismatch, Push, Stall

_BUILT_IN: tuple[type[AnyDisturbance], ...] = (
    ControlNoise, CorrelatedNoise, Bias, Delay, Dropout, Quantisation, Gain, StateNoise, StateDelay, Occlusion, Push,
    Stall, Intruder, Drag, LimitMismatch, Lag, RayNoise,
)  # fmt: skip


def _admit(name: str, thing: object) -> type[AnyDisturbance]:
    if not (isinstance(thing, type) and issubclass(thing, Disturbance)):
        raise ValueError(
            f"disturbance {name!r} is {short_repr(thing)}; give a subclass of d4orm_env.disturbances.Disturbance"
        )
    return thing


DISTURBANCES = Registry("disturbance", "d4orm.disturbances", _admit)
"""Every class of disturbances by its name."""

for _kind in _BUILT_IN:
    DISTURBANCES.add(re.sub(r"(?<=.)(?=[A-Z])", "_", _kind.__name__).lower(), _kind)


def register_disturbance(name: str, kind: type[AnyDisturbance] | str) -> None:
    """Let studies and the command line know disturbances of your own by a name.

    Args:
        name: Its name, such as ``"wind"``.
        kind: The subclass of :class:`Disturbance`, or the text ``"package.module:Name"`` of one.

    Raises:
        ValueError: If the name is none or taken, or the class is no subclass.
    """
    DISTURBANCES.add(name, kind)


class Level(NamedTuple):
    """Meaning of a name such as ``push(rate=0.5).speed``: kind, attribute that the level is of, values of others."""

    kind: type[AnyDisturbance]
    attribute: str
    fixed: dict[str, object]


def find_level(text: str) -> Level:
    """The kind and the attribute that a name such as ``push.speed`` stands for; without one, the kind's first.

    Other attributes may be given in brackets behind the kind, as YAML reads values: ``push(rate=0.5).speed``. What does
    not exist, or is given twice, is a ValueError.
    """
    path, opened, behind = text.partition("(")
    given, closed, rest = behind.partition(")")
    if opened and (not closed or (rest and not rest.startswith("."))):
        raise ValueError(f"disturbance {text!r} is not of the form push(rate=0.5).speed")
    module, colon, name = path.rpartition(":")
    name, _, attribute = name.partition(".")
    name, attribute = module + colon + name, attribute or rest[1:]
    kind = DISTURBANCES.find(name)
    known = [field.name for field in fields(kind)] if is_dataclass(kind) else []
    if not known:
        raise ValueError(f"disturbance {name!r} has no attribute that could have a level; make it a dataclass")
    fixed = _fixed(given, text) if opened else {}
    for one in filter(None, (attribute, *fixed)):
        if one not in known:
            raise ValueError(f"disturbance {name!r} has no {one!r}; it has {', '.join(known)}")
    level = Level(kind, attribute or known[0], fixed)
    if level.attribute in fixed:
        raise ValueError(f"disturbance {text!r} gives {level.attribute} twice; the levels are of it already")
    return level


def _fixed(given: str, text: str) -> dict[str, object]:
    """The attributes in ``rate=0.5, speed=0.3``."""
    try:
        values = parse_yaml("{" + given.replace("=", ": ") + "}")
    except ValueError as error:
        raise ValueError(f"disturbance {text!r}: what is in brackets {error}") from None
    if not isinstance(values, dict) or not all(isinstance(name, str) for name in values) or None in values.values():
        raise ValueError(f"disturbance {text!r}: write what is in brackets as name=value, as in push(rate=0.5).speed")
    return {name: math.inf if value == "inf" else value for name, value in values.items()}


def disturbance_at(text: str, level: object) -> AnyDisturbance:
    """The disturbance of a name, as for :func:`find_level`, at a level, all else as by default."""
    kind, attribute, fixed = find_level(text)
    return _make(kind, {**fixed, attribute: level}, text)


def disturbances_at(levels: Mapping[str, object]) -> tuple[AnyDisturbance, ...]:
    """Disturbances by name and level; what is said of several attributes of one kind is said of one disturbance."""
    kinds: dict[type[AnyDisturbance], dict[str, object]] = {}
    for text, level in levels.items():
        kind, attribute, fixed = find_level(text)
        values = kinds.setdefault(kind, {})
        for name, value in {**fixed, attribute: level}.items():
            if name in values:
                raise ValueError(f"disturbance {text!r} gives {name} once more; give it once")
            values[name] = value
    return tuple(_make(kind, values, kind.__name__) for kind, values in kinds.items())


def _make(kind: type[AnyDisturbance], values: Mapping[str, object], text: str) -> AnyDisturbance:
    needed = [field.name for field in fields(kind) if field.default is MISSING and field.default_factory is MISSING]
    missing = [name for name in needed if name not in values]
    if missing:
        raise ValueError(
            f"disturbance {text!r} needs {' and '.join(missing)} too; give it in brackets, as in "
            f"correlated_noise(std=0.2).time_constant"
        )
    return kind(**values)


def name_of(disturbance: AnyDisturbance | type[AnyDisturbance]) -> str:
    """Return the name of a kind, or of an instance's, here, or its import path."""
    kind = disturbance if isinstance(disturbance, type) else type(disturbance)
    for name in DISTURBANCES:
        if DISTURBANCES.origin(name) in (kind, f"{kind.__module__}:{kind.__qualname__}"):
            return name
    return f"{kind.__module__}:{kind.__qualname__}"


def attributes_of(disturbance: AnyDisturbance) -> dict[str, object]:
    """All attributes; what is infinite, which JSON does not have, as the text ``"inf"``, and arrays as digests."""
    return {name: _attribute(value) for name, value in asdict(disturbance).items()}


def _attribute(value: object) -> object:
    if isinstance(value, np.ndarray):
        return f"{value.shape} {hashlib.sha256(value.tobytes()).hexdigest()[:16]}"
    return "inf" if value == math.inf else value
