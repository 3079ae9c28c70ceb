"""Robot types of dynobench, db-CBS and db-LaCAM, and what they are here."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from d4orm_env.core.arrays import number_list, positive_number, short_repr, whole_number
from d4orm_env.core.errors import did_you_mean
from d4orm_env.core.goal_poses import MOST_TRAILERS
from d4orm_env.footprints import Box, Disc, Footprint, Train

_UNICYCLE1: dict[str, Any] = {
    "dynamics": "unicycle1", "min_vel": -0.5, "max_vel": 0.5, "min_angular_vel": -0.5, "max_angular_vel": 0.5,
    "shape": "box", "size": (0.5, 0.25), "radius": 0.4,
}  # fmt: skip
_INTEGRATOR1: dict[str, Any] = {"dynamics": "integrator1_2d", "max_vel": 0.5, "shape": "sphere", "radius": 0.1}
_INTEGRATOR2: dict[str, Any] = {
    "dynamics": "integrator2_2d", "max_vel": 0.5, "max_acc": 2.0, "shape": "sphere", "radius": 0.1,
}  # fmt: skip
_UNICYCLE2: dict[str, Any] = _UNICYCLE1 | {"dynamics": "unicycle2", "max_acc_abs": 0.25, "max_angular_acc": 0.25}
_CAR1: dict[str, Any] = {
    "dynamics": "car_with_trailers", "num_trailers": 1, "min_vel": -0.1, "max_vel": 0.5, "max_steering_abs": 1.047198,
    "l": 0.25, "hitch_lengths": (0.5,), "shape": "box", "size": (0.5, 0.25), "size_trailer": (0.3, 0.25),
}  # fmt: skip
_SPHERE = _UNICYCLE1 | {"shape": "sphere", "min_angular_vel": -2.0, "max_angular_vel": 2.0}

MODELS: dict[str, dict[str, Any]] = {
    "unicycle1_v0": _UNICYCLE1,
    "unicycle1_sphere_v0": _UNICYCLE1 | {"shape": "sphere"},
    "unicycle_first_order": _UNICYCLE1,
    "unicycle_first_order_0": _UNICYCLE1,
    "unicycle_first_order_0_sphere": _SPHERE,
    "unicycle2_v0": _UNICYCLE2,
    "unicycle_second_order_0": _UNICYCLE2,
    "car1_v0": _CAR1,
    "car_first_order_with_1_trailers_0": _CAR1,
    "integrator1_2d_v0": _INTEGRATOR1,
    "single_integrator": _INTEGRATOR1,
    "single_integrator_0": _INTEGRATOR1,
    "integrator2_2d_v0": _INTEGRATOR2,
    "double_integrator_0": _INTEGRATOR2,
    "integrator2_3d_v0": _INTEGRATOR2 | {"dynamics": "integrator2_3d"},
}
"""Robot types and their parameters, as in dynobench's ``models`` and db-CBS's ``robots.cpp``."""

DYNAMICS = {
    "unicycle1": "unicycle1", "unicycle2": "unicycle2", "integrator1_2d": "velocity2d", "integrator2_2d": "holonomic2d",
    "integrator2_3d": "holonomic3d", "car_with_trailers": "car_with_1_trailer",
}  # fmt: skip
"""Their dynamics and our models."""
NEEDED = {
    "unicycle1": ("max_vel", "max_angular_vel"),
    "unicycle2": ("max_vel", "max_angular_vel", "max_acc_abs", "max_angular_acc"),
    "integrator1_2d": ("max_vel",),
    "integrator2_2d": ("max_vel", "max_acc"),
    "integrator2_3d": ("max_vel", "max_acc"),
    "car_with_trailers": ("max_vel", "max_steering_abs", "l", "num_trailers", "hitch_lengths", "size_trailer"),
}
"""Parameters that a type of each dynamics has, besides its shape."""
SHAPES = {"sphere": "radius", "box": "size"}
"""Shapes, and the parameter with the size of each."""
PARAMETERS = {*NEEDED["unicycle2"], *NEEDED["integrator2_2d"], "max_steering_abs", "l", "diff_max_abs", "radius"}
"""Parameters that are positive numbers."""
LOWER = ("min_vel", "min_angular_vel")
"""Parameters that are negative numbers: robots rest."""
SIZES = {"size": 2, "size_trailer": 2, "hitch_lengths": 1}
"""Parameters that are lists of numbers, and how many of them there are at least."""


def checked_types(models: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Robot types by name, each with all parameters that its dynamics and its shape need; others are left alone.

    One that is missing, misspelt or no such number is a ValueError that names it and the type.
    """
    if not isinstance(models, Mapping):
        raise ValueError(f"models is {short_repr(models)}; give parameters by type, as {{'mine': {{'dynamics': ...}}}}")
    for name, own in models.items():
        where = f"robot type {name}"
        if not isinstance(own, Mapping):
            raise ValueError(f"{where} is {short_repr(own)}; give its parameters, as {{'dynamics': 'unicycle1', ...}}")
        if own.get("dynamics") not in list(DYNAMICS):
            given = short_repr(own.get("dynamics"))
            raise ValueError(f"{where}: dynamics {given} has no model here; there are {', '.join(DYNAMICS)}")
        if own.get("shape") not in list(SHAPES):
            raise ValueError(f"{where}: shape is {short_repr(own.get('shape'))}; it must be one of {', '.join(SHAPES)}")
        _check_parameters(own, where)
    return {name: dict(own) for name, own in models.items()}


def _check_parameters(own: Mapping[str, Any], where: str) -> None:
    known = {"dynamics", "shape", "num_trailers", *PARAMETERS, *LOWER, *SIZES}
    for name in own:
        if name not in known and (meant := did_you_mean(str(name), sorted(known - own.keys()))):
            raise ValueError(f"{where} has the parameter {short_repr(name)}{meant}")
    for name in (*NEEDED[own["dynamics"]], SHAPES[own["shape"]]):
        if name not in own:
            raise ValueError(f"{where}: {name} is missing, which {own['dynamics']} in the shape {own['shape']} needs")
    for name in PARAMETERS & own.keys():
        positive_number(own[name], f"{where}: {name}")
    for name in own.keys() & set(LOWER):
        if not (isinstance(own[name], float | int) and own[name] < 0):
            raise ValueError(f"{where}: {name} is {short_repr(own[name])}; it must be negative, for robots rest")
    for name in own.keys() & SIZES.keys():
        if not isinstance(own[name], Sequence):
            raise ValueError(f"{where}: {name} is {short_repr(own[name])}; it must be a list of numbers")
        number_list(own[name], f"{where}: {name}", SIZES[name])
    if own["dynamics"] == "car_with_trailers":
        count = whole_number(own["num_trailers"], f"{where}: num_trailers", 1, MOST_TRAILERS)
        if len(own["hitch_lengths"]) != count:
            raise ValueError(f"{where}: hitch_lengths has {len(own['hitch_lengths'])} entries for {count} trailers")


def symmetric(own: Mapping[str, Any]) -> dict[str, float]:
    """The lower limits of a type whose parameters give none."""
    return {f"min_{name}": -own[f"max_{name}"] for name in ("vel", "angular_vel") if f"max_{name}" in own}


def model_name(own: Mapping[str, Any]) -> str:
    """The name of our model; the unicycle has limits for both directions only where they are not symmetric."""
    name = DYNAMICS[own["dynamics"]]
    if name == "car_with_1_trailer" and own["num_trailers"] > 1:
        return f"car_with_{own['num_trailers']}_trailers"
    return "unicycle" if name == "unicycle1" and own.items() >= symmetric(own).items() else name


def limits_of(own: Mapping[str, Any]) -> dict[str, float]:
    """Limits that only one of our models has, from a type's parameters."""
    names = {"max_angular_acc": "max_turn_acceleration", "max_steering_abs": "max_steering", "l": "wheelbase"}
    limits = {ours: float(own[theirs]) for theirs, ours in names.items() if theirs in own}
    lower = {"min_vel": "max_reverse_speed", "min_angular_vel": "max_right_turn_rate"}
    limits |= {ours: -float(own[theirs]) for theirs, ours in lower.items() if theirs in own}
    for number, length in enumerate(own.get("hitch_lengths", ()), 1):
        limits[f"hitch_length_{number}"] = float(length)
        limits[f"max_hitch_angle_{number}"] = float(own.get("diff_max_abs", math.pi / 4))
    return limits


def footprint_of(own: Mapping[str, Any]) -> Footprint:
    """The shape of a type."""
    footprint: Disc | Box = Disc(own["radius"]) if own["shape"] == "sphere" else Box(*own["size"][:2])
    if own["dynamics"] != "car_with_trailers":
        return footprint
    return Train(footprint, [Box(*own["size_trailer"][:2])] * own["num_trailers"])
