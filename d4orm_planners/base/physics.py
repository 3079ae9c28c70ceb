"""Physics that moves the robots of an episode, by name and settings."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from d4orm_env import navigation_v0
from d4orm_env.core.arrays import short_repr
from d4orm_env.core.errors import no_setting
from d4orm_env.core.files import parse_yaml
from d4orm_env.core.problem import Problem

PHYSICS = {"model": "", "mujoco": "Physics", "crazyflow": "DronePhysics"}
"""The equations that planners know, rigid bodies in MuJoCo, or drones in crazyflow; and the class of settings."""


def find_physics(physics: str, problem: Problem | None = None) -> tuple[Any, dict[str, Any]]:
    """The module with the environment of a physics, and further arguments for this environment.

    Args:
        physics: One of :data:`PHYSICS`; behind a colon settings of :class:`d4orm_env.mujoco.Physics` or
            :class:`d4orm_env.crazyflow.DronePhysics`, as ``"crazyflow:gust=0.02,mass_factor=1.05"``.
        problem: A problem whose robots it is to move.

    Raises:
        ValueError: For an unknown physics or setting, a setting out of range, or robots that have no bodies in it.
        ImportError: If it needs a library that is not installed.
    """
    name, colon, listed = physics.partition(":") if isinstance(physics, str) else ("", "", "")
    if name not in PHYSICS:
        raise ValueError(f"physics is {short_repr(physics)}; choose one of {', '.join(PHYSICS)}")
    if name == "model":
        if colon:
            raise ValueError(f"physics is {short_repr(physics)}, and the model has no settings; give disturbances")
        return navigation_v0, {}
    module = import_module(f"d4orm_env.{name}")
    if problem is not None:
        module.check_problem(problem)
    if not colon:
        return module, {}
    kind, settings = getattr(module, PHYSICS[name]), {}
    for part in listed.split(","):
        setting, equals, text = part.partition("=")
        if not equals or setting in settings:
            raise ValueError(f"physics is {short_repr(physics)}; give settings once each, as {name}:name=value,...")
        if setting not in kind.__dataclass_fields__:
            raise no_setting(setting, f"physics {name!r}", kind.__dataclass_fields__)
        settings[setting] = parse_yaml(text)
    return module, {"physics": kind(**settings)}
