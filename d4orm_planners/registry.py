"""Planners and policies by name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from types import MappingProxyType
from typing import Any

from d4orm_env.core.arrays import positive_number, shown
from d4orm_env.core.errors import UnknownKeywordError
from d4orm_planners.base import Planner
from d4orm_planners.cem import CEM
from d4orm_planners.d4orm import D4orm
from d4orm_planners.d4orm_c2f import D4ormC2F
from d4orm_planners.d4orm_d import D4ormD
from d4orm_planners.d_d4orm import DD4orm
from d4orm_planners.ipopt import Ipopt
from d4orm_planners.mbd import MBD, IterativeMBD
from d4orm_planners.mppi import MPPI
from d4orm_planners.orca import Orca
from d4orm_planners.policy import DriveToGoal, OpenLoop, Policy, RandomControls
from d4orm_planners.rl.learned import PPO, SAC

PLANNERS: Mapping[str, type[Planner]] = MappingProxyType(
    {planner.name: planner for planner in (D4orm, D4ormD, DD4orm, MPPI, CEM, MBD, IterativeMBD, Ipopt)}
)
"""Every planner class by its name."""

POLICIES: Mapping[str, type[Policy]] = MappingProxyType(
    {policy.name: policy for policy in (D4ormC2F, DriveToGoal, RandomControls, Orca, PPO, SAC)}
)
"""The policies that are no planners; every planner is an open-loop policy too."""


def list_planners() -> tuple[str, ...]:
    """Names that :func:`make_planner` accepts."""
    return tuple(PLANNERS)


def list_policies() -> tuple[str, ...]:
    """Names that :func:`make_policy` accepts."""
    return (*PLANNERS, *POLICIES)


def describe_planner(name: str) -> str:
    """The first sentence of a planner's documentation."""
    return _summary(_find(name, PLANNERS, "planner"))


def describe_policy(name: str) -> str:
    """The first sentence of a policy's documentation."""
    return _summary(_find(name, {**PLANNERS, **POLICIES}, "policy"))


def make_planner(name: str, *, preset: str | None = None, **config: Any) -> Planner:
    """A planner by name.

    Args:
        name: One of :func:`list_planners`.
        preset: ``"paper"`` for the paper's algorithm and parameters; ``None`` for this project's defaults.
        **config: Settings that differ from the preset; see the planner's configuration class.

    Raises:
        ValueError: For an unknown planner or preset, or a setting that makes no sense.
        TypeError: For an unknown setting.
    """
    kind = _find(name, PLANNERS, "planner")
    settings = {} if preset is None else _find(preset, kind.presets, "preset", f" of planner {name!r}")
    kind.config_class.check_names(config, f"planner {name!r}")
    return kind(kind.config_class(**{**settings, **config}))


def make_policy(name: str, **config: Any) -> Policy:
    """A policy by name: a planner's name for executing its plan open loop, or one of the policies.

    Args:
        name: One of :func:`list_policies`.
        **config: For a planner, its settings and ``preset``, and the budget of the solve (``time_limit``,
            ``max_iterations``); for a policy, its own settings.

    Raises:
        ValueError: For an unknown name, or a setting that makes no sense.
        TypeError: For an unknown setting.
    """
    if isinstance(name, str) and name in PLANNERS:
        time_limit = _time_limit(config)
        return OpenLoop(make_planner(name, **config), time_limit=time_limit)
    config_instance = _policy_config(name, config)
    kind: Any = POLICIES[name]
    return kind() if config_instance is None else kind(config_instance)


def policy_settings(name: str, **config: Any) -> dict[str, Any]:
    """All settings of ``make_policy(name, **config)``, defaults filled in; a preset has become its settings.

    Raises:
        ValueError, TypeError: As :func:`make_policy`.
    """
    if isinstance(name, str) and name in PLANNERS:
        time_limit = _time_limit(config)
        return {**asdict(make_planner(name, **config).config), "time_limit": time_limit}
    config_instance = _policy_config(name, config)
    return {} if config_instance is None else asdict(config_instance)


def _policy_config(name: str, config: Mapping[str, Any]) -> Any:
    """The configuration of a policy that is no planner; ``None`` for one without settings."""
    kind = _find(name, {**PLANNERS, **POLICIES}, "policy")
    if kind.config_class is not None:
        kind.config_class.check_names(config, f"policy {name!r}")
        return kind.config_class(**config)
    if config:
        raise UnknownKeywordError(f"policy {name!r} takes no settings, but was given {', '.join(map(shown, config))}")
    return None


def _time_limit(config: dict[str, Any]) -> float | None:
    """Take the budget of the solve out of a planner's settings."""
    limit = config.pop("time_limit", None)
    return None if limit is None else positive_number(limit, "time_limit")


def _find(name: Any, table: Mapping[str, Any], what: str, owner: str = "") -> Any:
    if not isinstance(name, str) or name not in table:
        raise ValueError(f"{what} {shown(name)}{owner} is unknown; choose one of {', '.join(table)}")
    return table[name]


def _summary(kind: type) -> str:
    return (kind.__doc__ or "").strip().splitlines()[0]
