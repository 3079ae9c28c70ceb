"""What goes wrong in a trial: noise on the controls, and disturbances by name and level."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import TypeAlias

from d4orm_env.core.arrays import positive_number, shown
from d4orm_env.disturbances import Disturbance
from d4orm_env.disturbances.disturbance import AnyDisturbance
from d4orm_env.disturbances.registry import attributes_of, disturbance_at, name_of
from d4orm_env.disturbances.selection import checked_disturbances
from d4orm_planners.references import source_digest

Levels: TypeAlias = Iterable[object]
DisturbanceLevels: TypeAlias = Mapping[str, Levels]
"""Levels by name, as ``{"delay": [0, 1, 2], "push.speed": [0.2, 0.5]}``, or disturbances by any label, as
``{"wind": [Wind(0.1), Wind(0.2)], "both": [[], [Delay(2), Wind(0.1)]]}``."""


@dataclass(frozen=True)
class Condition:
    """What goes wrong in a trial.

    Attributes:
        control_noise_std: Standard deviation of the execution noise, in the controls' units.
        disturbances: What else goes wrong.
        name: What is varied, such as ``"push.speed"``; empty for nothing.
        level: How much of it; of disturbances that differ in more than a number, their place among the levels.
        physics: What moves the robots, one of :data:`d4orm_planners.episode.PHYSICS`.
    """

    control_noise_std: float = 0.0
    disturbances: tuple[AnyDisturbance, ...] = ()
    name: str = ""
    level: float | None = None
    physics: str = "model"

    @property
    def text(self) -> str:
        """The disturbances that change anything, as JSON: a list of ``[name, attributes]``.

        Raises:
            ValueError: If an attribute of a user's has no form in JSON, or its source cannot be read.
        """
        listed = [[name_of(one), _attributes(one)] for one in self.disturbances if not one.negligible]
        try:
            return json.dumps(listed, sort_keys=True)
        except TypeError as error:
            raise ValueError(
                f"disturbance {self.name!r} has an attribute that cannot be stored ({error}); give numbers, text, "
                "truth values, lists and mappings of them"
            ) from None

    @property
    def replayable(self) -> bool:
        """Whether the executed controls alone tell how the robots have moved."""
        return self.physics == "model" and all(one.negligible or one.replayable for one in self.disturbances)


def conditions(
    control_noise_std: float | Iterable[float], disturbances: DisturbanceLevels | None
) -> tuple[Condition, ...]:
    """Every level of noise with every level of every disturbance, one disturbance at a time.

    Raises:
        ValueError: For an unknown name, a level that makes no sense, or nothing to do.
    """
    given = control_noise_std if isinstance(control_noise_std, Iterable) else (control_noise_std,)
    noise = tuple(dict.fromkeys(positive_number(std, "control_noise_std", zero_allowed=True) for std in given))
    if not noise:
        raise ValueError("control_noise_std is empty; give at least one level")
    if disturbances is None:
        return tuple(Condition(std) for std in noise)
    if not isinstance(disturbances, Mapping):
        raise ValueError(f"disturbances is {shown(disturbances)}; give levels by name, as {{'delay': [0, 1, 2]}}")
    varied = [one for name, levels in disturbances.items() for one in _varied(name, levels)]
    if not varied:
        raise ValueError("disturbances is empty; give levels by name, as {'delay': [0, 1, 2]}, or leave it out")
    return tuple(
        Condition(std, chosen, name, level) for std, (name, chosen, level) in product(noise, dict.fromkeys(varied))
    )


Varied: TypeAlias = tuple[str, tuple[AnyDisturbance, ...], float]


def _varied(name: str, levels: Levels) -> list[Varied]:
    """A name, disturbances and a level for each of the levels of one thing."""
    if isinstance(levels, str | Disturbance) or not isinstance(levels, Iterable):
        levels = (levels,)
    listed = list(levels)
    if not listed:
        raise ValueError(f"disturbances[{name!r}] is empty; give at least one level")
    if all(isinstance(one, Disturbance | Sequence) and not isinstance(one, str) and _holds(one) for one in listed):
        chosen = [checked_disturbances(one) for one in listed]
        return [(name, one, level) for one, level in zip(chosen, _told(chosen))]
    made = [(level, disturbance_at(name, level)) for level in listed]
    return [(name, (one,), _number(level, place)) for place, (level, one) in enumerate(made)]


def _holds(given: object) -> bool:
    """Whether something is a disturbance, or a list of disturbances only."""
    return isinstance(given, Disturbance) or all(isinstance(one, Disturbance) for one in given)  # type: ignore[attr-defined] # a sequence


def _told(chosen: Sequence[tuple[AnyDisturbance, ...]]) -> list[float]:
    """The levels of disturbances that were given themselves: the number in which they differ, or their places."""
    if all(len(one) == 1 and type(one[0]) is type(chosen[0][0]) for one in chosen):
        values = [attributes_of(one[0]) for one in chosen]
        differing = [name for name in values[0] if len({repr(each[name]) for each in values}) > 1]
        if len(differing) == 1 and all(isinstance(each[differing[0]], int | float) for each in values):
            return [float(each[differing[0]]) for each in values]  # type: ignore[arg-type] # a number, as was asked
    return [float(place) for place in range(len(chosen))]


def _number(level: object, place: int) -> float:
    return float(level) if isinstance(level, int | float) else float(place)


def _attributes(one: AnyDisturbance) -> dict[str, object]:
    attributes = attributes_of(one)
    foreign = type(one).__module__.partition(".")[0] != "d4orm_env"
    return {**attributes, "source": source_digest(type(one))} if foreign else attributes
