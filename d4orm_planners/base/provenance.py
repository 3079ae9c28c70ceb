"""Provenance of a plan, for later readers: settings, version and machine."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache

from d4orm_env import __version__
from d4orm_planners.base.machine import describe_machine


@dataclass(frozen=True, kw_only=True)
class Provenance:
    """Origin of a plan, beside its planner's name and the seed.

    Attributes:
        preset: Of :func:`~d4orm_planners.make_planner`; ``None`` for the defaults.
        settings: All settings of the planner, by name; what JSON has no word for as text.
        version: Of this package.
        machine: Processor, cores and system, as the benchmark describes them.
    """

    preset: str | None
    settings: Mapping[str, object]
    version: str
    machine: Mapping[str, object]

    def __post_init__(self) -> None:
        kinds = {"preset": (str, type(None)), "settings": Mapping, "version": str, "machine": Mapping}
        for name, kind in kinds.items():
            if not isinstance(getattr(self, name), kind):  # type: ignore[arg-type]
                raise ValueError(f"{name} of the provenance is {getattr(self, name)!r}")

    @classmethod
    def here(cls, preset: str | None, settings: Mapping[str, object]) -> Provenance:
        """Return that of a plan made by a planner with this preset and these settings here and now."""
        plain = json.loads(json.dumps(settings, default=str))
        return cls(preset=preset, settings=plain, version=__version__, machine=_machine())


@cache
def _machine() -> dict[str, object]:
    return describe_machine()
