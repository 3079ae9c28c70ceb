"""Settings of every planner and policy: numbers of any type are the same settings; the rest is refused by name."""

from __future__ import annotations

import types
from collections.abc import Iterator
from dataclasses import fields, replace
from decimal import Decimal
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np
import pytest

from d4orm_env.core.arrays import positive_number, whole_number
from d4orm_env.core.errors import UnknownKeywordError
from d4orm_planners import list_policies, make_planner, make_policy
from d4orm_planners.base.planner_registry import PLANNERS, POLICIES, policy_settings, setting_names
from d4orm_planners.base.settings import CheckedSettings
from d4orm_planners.rl.learned import SHIPPED

KINDS: dict[str, type[CheckedSettings]] = {
    name: kind.config_class for name, kind in {**PLANNERS, **POLICIES}.items() if kind.config_class is not None
}

JOINT: dict[str, Any] = {"decoupling": "joint", "clip_between_iterations": False}
BESIDE: dict[str, dict[str, Any]] = {
    "node": {"transport": "zenoh", "mode": "async", "node": 0},
    "penalty_rise": JOINT,
    "penalty_limit": JOINT,
    "clip_after": JOINT,
    "communication_range": {"nodes": None},
}
"""What these numbers need beside them."""


def number_type(hint: Any) -> type | None:
    """``int`` or ``float`` for a field that holds one, or none at all."""
    if get_origin(hint) in (types.UnionType,) or type(None) in get_args(hint):
        hint = next(option for option in get_args(hint) if option is not type(None))
    return hint if hint in (int, float) else None


def numbers() -> Iterator[Any]:
    for name, kind in KINDS.items():
        for setting, hint in get_type_hints(kind).items():
            if (number := number_type(hint)) is not None:
                yield pytest.param(kind, setting, number, id=f"{name}-{setting}")


NUMBERS = pytest.mark.parametrize(("kind", "setting", "number"), tuple(numbers()))


def made(kind: type[CheckedSettings], setting: str, value: Any) -> CheckedSettings:
    return kind(**BESIDE.get(setting, {}) | {setting: value})


def test_the_numbers_of_all_kinds_are_looked_at() -> None:
    found = {(param.values[0].__name__, param.values[1]) for param in numbers()}
    assert {("D4ormConfig", "beta_start"), ("D4ormC2FConfig", "deadline"), ("OrcaConfig", "max_neighbors")} <= found
    assert {("IpoptConfig", "lookout"), ("DD4ormConfig", "timeout"), ("DD4ormConfig", "nodes")} <= found


@NUMBERS
def test_a_number_of_every_type_is_the_same_setting(kind: type[CheckedSettings], setting: str, number: type) -> None:
    default = getattr(kind(), setting)
    given = {"node": 0, "clip_after": 1, "check_every": 1}.get(setting, 0.01) if default is None else default
    value = number(given)
    expected = made(kind, setting, value)
    types = [np.array([value])[0]]
    if number is float:
        types += [Decimal(str(value)), *([int(value)] if value == int(value) else [])]
    for same in types:
        config = made(kind, setting, same)
        assert type(getattr(config, setting)) is number
        assert config == expected
        assert repr(config) == repr(expected)
        assert hash(config) == hash(expected)


NO_NUMBERS = (
    "", "1", "many", "nan", "1" * 5000, np.array("1"), True, np.True_, np.False_, -1, -1.5, float("nan"), float("inf"),
    10**400, -(10**400), 10**5000, 1e300, [1], [10**5000], {}, (), 1j, b"one", object(), np.arange(2), np.zeros((2, 2)),
)  # fmt: skip


@NUMBERS
def test_what_is_no_such_number_is_refused_by_name(kind: type[CheckedSettings], setting: str, number: type) -> None:
    for value in NO_NUMBERS:
        with pytest.raises(ValueError, match=rf"^{setting} (is|must be) ") as caught:
            made(kind, setting, value)
        assert "\n" not in str(caught.value)
        assert len(str(caught.value)) < 200


@NUMBERS
def test_none_is_no_number_unless_it_means_something(kind: type[CheckedSettings], setting: str, number: type) -> None:
    if type(None) in get_args(get_type_hints(kind)[setting]):
        assert getattr(kind(**{setting: None}), setting) is None
    else:
        with pytest.raises(ValueError, match=f"^{setting} must be a (whole )?number, not None"):
            kind(**{setting: None})


@pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)
def test_what_is_no_text_or_truth_is_refused_by_name(kind: type[CheckedSettings]) -> None:
    for setting, hint in get_type_hints(kind).items():
        wrong = {str: (3, ["auto"], "no such"), bool: (1, 0.0, "yes", None, np.True_)}.get(hint, ())
        for value in wrong:
            with pytest.raises(ValueError, match=f"^{setting} ") as caught:
                kind(**{setting: value})
            assert "\n" not in str(caught.value)


def test_settings_are_given_by_name_only() -> None:
    assert [(name, one.name) for name, kind in KINDS.items() for one in fields(kind) if not one.kw_only] == []


def test_which_settings_there_are_may_depend_on_others() -> None:
    assert "repair_steps" not in setting_names("d-d4orm")
    assert "repair_steps" in setting_names("d-d4orm", {"planner": "d4orm-d"})
    assert "repair_steps" in policy_settings("d-d4orm", planner="d4orm-d", preset="paper")
    assert "repair_steps" not in policy_settings("d-d4orm", preset="paper")


@pytest.mark.parametrize("name", list_policies())
def test_an_unknown_setting_is_an_unexpected_keyword(name: str) -> None:
    for make in (make_policy, policy_settings, *([make_planner] if name in PLANNERS else [])):
        with pytest.raises(TypeError, match=r"'?colour'?") as caught:
            make(name, colour=1)
        assert isinstance(caught.value, UnknownKeywordError)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", [["d4orm"], None, 3, {}])
def test_a_name_that_is_no_text_is_unknown(name: Any) -> None:
    for make in (make_planner, make_policy, policy_settings):
        with pytest.raises(ValueError, match="is unknown; choose one of d4orm"):
            make(name)
    with pytest.raises(ValueError, match=r"preset .* of planner 'd4orm' is unknown"):
        make_planner("d4orm", preset=name or [])


def test_the_time_limit_is_a_number_as_well() -> None:
    assert policy_settings("d4orm", time_limit=np.float32(1)) == policy_settings("d4orm", time_limit=1)
    with pytest.raises(ValueError, match="time_limit is inf"):
        make_policy("d4orm", time_limit=10**400)


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("d-d4orm", {"nodes": 100_000_000}, "nodes is 100000000; it must be at most 1024"),
        ("d-d4orm", {"num_samples": 10**21}, "num_samples is about 1e21; it must be at most 9.2"),
        ("d-d4orm", {"num_samples": 1e21}, "num_samples must be a whole number, not 1e\\+21"),
        ("d4orm", {"num_samples": "1e21"}, "num_samples must be a whole number, not '1e21'"),
        ("d4orm", {"num_samples": 10**7 + 1}, "num_samples is 10000001; it must be at most 1e\\+07"),
        ("d4orm", {"num_steps": 10**6 + 1}, "num_steps is 1000001; it must be at most 1e\\+06"),
        ("ppo", {"path": [1]}, r"path must be text, not \[1\]"),
        ("d4orm-c2f", {"beta_start": 0.5}, "beta_start 0.5 is above beta_end 0.02"),
    ],
)
def test_what_would_end_in_a_crash_is_refused(name: str, settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_policy(name, **settings)


def test_a_path_is_kept_as_text() -> None:
    kind = KINDS["ppo"]
    assert kind(path=Path("a.zip")) == kind(path="a.zip")


def test_settings_can_be_replaced_and_are_checked_again() -> None:
    config = make_planner("mppi").config
    assert replace(config, sigma=2).sigma == 2.0
    with pytest.raises(ValueError, match="sigma is 0; it must be positive"):
        replace(config, sigma=0)


@pytest.mark.parametrize("value", [10**400, -(10**400), True, np.True_, "1e999", [10**5000], None])
def test_numbers_are_refused_in_one_line(value: Any) -> None:
    with pytest.raises(ValueError, match=r"^x (is|must be) ") as caught:
        positive_number(value, "x")
    assert len(str(caught.value)) < 200


def test_whole_numbers_are_refused_in_one_line() -> None:
    with pytest.raises(ValueError, match="x is about -1e5000; it must be at least 0"):
        whole_number(-(10**5000), "x", 0)


def test_policies_are_told_by_the_file_that_they_act_by(tmp_path: Path) -> None:
    shipped = policy_settings("ppo")
    assert make_policy("ppo").identity() == shipped
    mine, other = tmp_path / "mine.safetensors", tmp_path / "other.safetensors"
    for copy in (mine, other):
        copy.write_bytes((SHIPPED / "ppo.safetensors").read_bytes())
    assert policy_settings("ppo", path=str(other)) == {**policy_settings("ppo", path=str(mine)), "path": str(other)}
    other.write_bytes((SHIPPED / "sac.safetensors").read_bytes())
    assert policy_settings("ppo", path=str(other))["file"] == policy_settings("sac")["file"] != shipped["file"]
    assert policy_settings("ppo", path=str(tmp_path / "none.safetensors"))["file"] is None


def test_noise_beyond_all_limits_is_refused() -> None:
    with pytest.raises(ValueError, match=r"beta_end is 0\.999999, with noise of .* times the limits; give less"):
        make_planner("d4orm", beta_end=0.999999)


def test_the_noise_that_is_refused_is_the_largest_of_all_steps() -> None:
    """A million times the limits in the first denoising step, three quarters of that in the next."""
    make_planner("d4orm", beta_end=0.455)
    with pytest.raises(ValueError, match=r"beta_end is 0\.46, with noise of 1e\+06 times the limits; give less"):
        make_planner("d4orm", beta_end=0.46)
