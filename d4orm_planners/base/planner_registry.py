"""Planners and policies by name, import path or object."""

from __future__ import annotations

import copy
import inspect
from collections.abc import Callable, Mapping
from typing import Any, TypeAlias, TypeVar

from d4orm_env.core.arrays import duration, short_repr
from d4orm_env.core.errors import UnknownKeywordError, describe, did_you_mean, no_setting, unknown
from d4orm_env.core.registry import check_call, load_reference, source_digest, source_object
from d4orm_planners.base.names import PLANNERS, POLICIES, is_planner_class
from d4orm_planners.base.planner import Planner
from d4orm_planners.base.policy import OpenLoop, Policy, acts, as_policy, makes_policy
from d4orm_planners.base.provenance import attributes
from d4orm_planners.base.settings import NOTHING, CheckedSettings

_NO_TEXT = ("bool", "float", "int")  #: Annotations of keywords for which text, as a command line has it, is refused
RECOMMENDED = "hybrid"  #: The planner that solves most problems, and soonest
Presets: TypeAlias = Mapping[str, Mapping[str, object]]  #: Settings by preset
Config = TypeVar("Config", bound=CheckedSettings)

PolicyLike: TypeAlias = str | Policy | Planner | type[object] | Callable[..., object]
"""A policy as :func:`make_policy` takes it; other objects with ``reset`` and ``act`` as well."""


def list_planners() -> tuple[str, ...]:
    """Names that :func:`make_planner` accepts."""
    return tuple(PLANNERS)


def list_policies() -> tuple[str, ...]:
    """Names that :func:`make_policy` accepts."""
    return (*PLANNERS, *POLICIES)


def preset_names(name: str) -> tuple[str, ...]:
    """The presets of a planner or policy."""
    return tuple(_presets(find_policy(name)))


def describe_policy(name: str) -> str:
    """The first line of a planner's or policy's documentation."""
    return (find_policy(name).__doc__ or "").strip().partition("\n")[0]


def make_planner(name: str | type[Planner] = RECOMMENDED, *, preset: str | None = None, **config: object) -> Planner:
    """A planner by name; without one, that which solves most, soonest.

    Args:
        name: One of :func:`list_planners`, ``"package.module:Name"`` (or ``"folder/file.py:Name"``) of a planner class,
            or the class.
        preset: ``"paper"`` for the paper's algorithm and parameters; ``"authors"``, of D4orm, D4orm-D and CEM, for what
            its authors published as code; ``"tuned"``, of D4orm and its rivals, for the paper's with parameters that
            were tuned; ``None`` for this project's defaults. :func:`preset_names` lists a planner's.
        **config: Settings that differ from the preset; see the planner's configuration class.

    Raises:
        ValueError: For an unknown planner or preset, or a setting that makes no sense.
        TypeError: For an unknown setting.
    """
    kind, owner = _planner_class(name), f"planner {called(name)!r}"
    planner = kind(_configured(kind.config_class, kind.presets, preset, config, owner))
    planner.preset = preset
    return planner


def make_policy(name: PolicyLike, **config: Any) -> Policy:
    """A policy: by name, a planner's for executing its plan open loop; or from what a user brings.

    Args:
        name: One of :func:`list_policies`; ``"package.module:Name"`` or ``"folder/file.py:Name"`` of any of the
            following; a :class:`Policy` or another object with ``reset`` and ``act``; a planner, executed open loop; a
            class of these; a function ``(observations, state) -> actions`` of the team, ``observation -> action`` of
            every robot by itself, or without required positional parameters, which makes a policy.
        **config: For a planner, its settings and ``preset``, and the budget of the solve (``time_limit``,
            ``max_iterations``); for a policy class, its own settings, and ``preset`` if it has presets; for a function
            that makes one, its keywords.

    Raises:
        ValueError: For an unknown name or preset, an import path that leads nowhere, something that does not act, or a
            setting that makes no sense.
        TypeError: For an unknown setting.
    """
    kind, owner = find_policy(name), f"policy {called(name)!r}"
    if is_planner_class(kind):
        time_limit = _time_limit(config)
        return OpenLoop(make_planner(name if isinstance(name, str) else kind, **config), time_limit=time_limit)
    if not makes_policy(kind):
        _refuse_settings(config, owner)
        return as_policy(kind, owner)
    if (config_class := getattr(kind, "config_class", None)) is not None:
        return as_policy(kind(_policy_config(kind, config_class, config, owner)), owner)
    _check_keywords(kind, config, owner)
    return as_policy(kind(**config), owner)


def find_policy(policy: object) -> object:
    """The thing that a name or import path stands for, else a ValueError; all but text is returned as it is."""
    if is_brought(policy):
        return policy
    if isinstance(policy, str):
        if policy in PLANNERS and policy in POLICIES:
            raise ValueError(f"{policy!r} names a planner and a policy of two packages; uninstall one of them")
        for table in (PLANNERS, POLICIES):
            if policy in table:
                return table[policy]
        if ":" in policy:
            return load_reference(policy)
    for present, missing in (("act", "reset"), ("reset", "act")):
        if hasattr(policy, present):
            raise ValueError(
                f"policy {short_repr(policy)} has {present} and lacks {missing}; define it, or subclass "
                "d4orm_planners.Policy"
            )
    if hasattr(policy, "predict"):
        raise ValueError(
            f"policy {short_repr(policy)} is a model; give from_sb3(model), from d4orm_planners.base.adapters"
        )
    raise unknown("policy", policy, list_policies(), "give a Policy, a function, or package.module:Name of one")


def is_brought(policy: object) -> bool:
    """Check whether a policy is given itself, rather than by name or import path."""
    return callable(policy) or isinstance(policy, Planner) or acts(policy)


def origin(policy: object) -> object:
    """The import path or object of a policy, which :func:`make_policy` takes in any process without registration."""
    for table in (PLANNERS, POLICIES):
        if isinstance(policy, str) and policy in table:
            return table.origin(policy)
    return policy


def is_planned(policy: object) -> bool:
    """Check whether a policy is a planner, whose plan is executed open loop."""
    kind = find_policy(policy)
    return is_planner_class(kind) or isinstance(kind, Planner)


def setting_names(policy: object, given: Mapping[str, object] = NOTHING) -> tuple[str, ...]:
    """Settings that :func:`make_policy` takes for a policy, where these are given."""
    kind = find_policy(policy)
    if is_planner_class(kind):
        return (*kind.config_class.setting_names(given), "preset", "time_limit")
    if not makes_policy(kind):
        return ()
    if (config_class := getattr(kind, "config_class", None)) is not None:
        return (*config_class.setting_names(given), *(("preset",) if _presets(kind) else ()))
    return tuple(inspect.signature(kind).parameters)


def default_settings(policy: str) -> dict[str, object]:
    """Settings of a planner or policy with their defaults; ``"required"`` where there is none."""
    kind = find_policy(policy)
    if (config_class := getattr(kind, "config_class", None)) is not None:
        return dict(config_class().keywords())
    parameters = inspect.signature(kind).parameters if makes_policy(kind) else {}
    return {name: "required" if own.default is own.empty else own.default for name, own in parameters.items()}


def policy_settings(name: object, **config: Any) -> dict[str, object]:
    """All that distinguishes ``make_policy(name, **config)`` from other policies of that name; refused where that is.

    These are its settings, with the defaults of a configuration class, and with those of a preset in its place. A
    policy from outside this package has the digest of its source as well.
    """
    kind, owner = find_policy(name), f"policy {called(name)!r}"
    settings: dict[str, object]
    if is_planner_class(kind):
        time_limit = _time_limit(config)
        planner = make_planner(name if isinstance(name, str) else kind, **config)
        settings = {**planner.config.keywords(), "time_limit": time_limit}
    elif not makes_policy(kind):
        _refuse_settings(config, owner)
        policy = as_policy(kind, owner)
        settings = policy.identity() if isinstance(kind, Policy | Planner) else attributes(kind)
    elif (config_class := getattr(kind, "config_class", None)) is not None:
        checked = _policy_config(kind, config_class, config, owner)
        if isinstance(kind, type) and issubclass(kind, Policy):
            settings = kind.identity_with(checked)
        else:
            settings = checked.keywords()
    else:
        _check_keywords(kind, config, owner)
        settings = {**attributes(kind), **config}
    code = source_object(kind.planner if isinstance(kind, OpenLoop) and kind.planner is not None else kind)
    foreign = code.__module__.partition(".")[0] != __name__.partition(".")[0]
    return {**settings, "source": source_digest(code)} if foreign else settings


def _presets(kind: object) -> Presets:
    presets: Presets = getattr(kind, "presets", {})
    return presets


def _policy_config(kind: object, config_class: type[Config], given: Mapping[str, object], owner: str) -> Config:
    config, presets = dict(given), _presets(kind)
    preset = config.pop("preset", None) if presets else None
    return _configured(config_class, presets, preset, config, owner)


def _configured(
    config_class: type[Config], presets: Presets, preset: object, config: Mapping[str, object], owner: str
) -> Config:
    """The settings on top of those of a preset; ValueError or, for an unknown one, TypeError."""
    if preset is not None and not (isinstance(preset, str) and preset in presets):
        remedy = f"choose one of {', '.join(presets)}" if presets else "it has none, so leave it out"
        raise ValueError(f"preset {short_repr(preset)} of {owner} is unknown; {remedy}{did_you_mean(preset, presets)}")
    settings = NOTHING if preset is None else presets[preset]
    known = config_class.setting_names({**settings, **config})
    applying = {name: value for name, value in settings.items() if name in known}
    return config_class.from_keywords({**applying, **config}, owner)


def _planner_class(name: object) -> type[Planner]:
    if isinstance(name, str) and name in POLICIES and name not in PLANNERS:
        remedy = f"use make_policy({name!r}), or d4orm run --policy {name}"
        raise ValueError(f"{name!r} is no planner but a policy, which acts step by step; {remedy}")
    kind = name if is_planner_class(name) else PLANNERS.find(name)
    if inspect.isabstract(kind):
        raise ValueError(f"planner {called(name)!r} lacks iterate; define it in the class")
    check_call(kind.iterate, f"planner {called(name)!r}: iterate", "self", "search", "state")
    return kind


def _check_keywords(kind: Callable[..., object], config: Mapping[str, object], owner: str) -> None:
    """Refuse what a function or class that makes a policy does not take, and what it lacks."""
    if inspect.isabstract(kind):
        missing = ", ".join(sorted(vars(kind)["__abstractmethods__"]))
        raise ValueError(f"{owner} lacks {missing}; define it in the class")
    try:
        signature = inspect.signature(kind)
    except (TypeError, ValueError):
        raise ValueError(
            f"{owner} is {short_repr(kind)}, which does not say what it takes; give a Policy of yours"
        ) from None
    parameters = signature.parameters
    if not parameters:
        _refuse_settings(config, owner)
    for name, value in config.items():
        if name not in parameters and not any(known.kind is known.VAR_KEYWORD for known in parameters.values()):
            raise no_setting(name, owner, parameters)
        hint = getattr(parameters.get(name), "annotation", None)
        hint = getattr(hint, "__name__", hint)  # annotations may be text
        if isinstance(value, str) and hint in _NO_TEXT:
            raise ValueError(f"{name} of {owner} is {short_repr(value)}; it must be a {hint}")
    try:
        signature.bind(**config)
    except TypeError as error:
        raise ValueError(f"{owner} cannot be made: {error}; give it as a setting") from None


def _refuse_settings(config: Mapping[str, object], owner: str) -> None:
    if config:
        raise UnknownKeywordError(f"{owner} takes no settings, but was given {', '.join(map(short_repr, config))}")


def _time_limit(config: dict[str, object]) -> float | None:
    """Take the budget of the solve out of a planner's settings."""
    limit = config.pop("time_limit", None)
    return None if limit is None else duration(limit, "time_limit")


def called(thing: object) -> str:
    """Return the name of a policy for messages."""
    return thing if isinstance(thing, str) else getattr(thing, "__name__", type(thing).__name__)


def fresh_policy(name: PolicyLike, **config: Any) -> Policy:
    """:func:`make_policy`, where that returns a given instance, a copy of it: its episodes do not change it."""
    policy = make_policy(name, **config)
    return copy_policy(policy) if policy is find_policy(name) else policy


def copy_policy(policy: Policy) -> Policy:
    """A policy like this one, whose episodes do not change it. Raises ValueError if it cannot be copied."""
    # Those of this package begin anew at every reset.
    if type(policy).__module__.startswith("d4orm_planners."):
        return copy.copy(policy)
    try:
        return copy.deepcopy(policy)
    except Exception as error:  # objects reduce themselves by methods of their own
        policy.identity()  # what cannot be told from others is to be told first
        raise ValueError(
            f"policy {called(policy)!r} cannot be copied for an episode of its own ({describe(error)}); give its "
            "class, or a function that makes it, in place of the instance"
        ) from error
