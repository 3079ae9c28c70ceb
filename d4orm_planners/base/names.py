"""Registries of planners and policies, which users and other packages extend."""

from __future__ import annotations

from typing import TypeGuard

from d4orm_env.core.arrays import is_one_of, short_repr
from d4orm_env.core.registry import Registry
from d4orm_planners.base.planner import Planner


def is_planner_class(thing: object) -> TypeGuard[type[Planner]]:
    return isinstance(thing, type) and issubclass(thing, Planner)


def _admit_planner(name: str, thing: object) -> type[Planner]:
    if not is_planner_class(thing):
        raise ValueError(f"planner {name!r} is {short_repr(thing)}; give a subclass of d4orm_planners.Planner")
    return thing


def _admit_policy(name: str, thing: object) -> object:
    if not (callable(thing) or hasattr(thing, "act")):
        raise ValueError(f"policy {name!r} is {short_repr(thing)}; give a Policy, or a function that is or makes one")
    return thing


PLANNERS = Registry("planner", "d4orm.planners", _admit_planner)  #: Every planner class by its name
POLICIES = Registry("policy", "d4orm.policies", _admit_policy)
"""The policies that are no planners; every planner is an open-loop policy too."""


def register_planner(name: str, planner_class: type[Planner] | str) -> None:
    """Let :func:`~d4orm_planners.make_planner` and whatever takes a policy's name know a planner of your own.

    Args:
        name: Its name.
        planner_class: A subclass of :class:`~d4orm_planners.Planner`, or the text ``"package.module:Name"`` of one.

    Raises:
        ValueError: If the name is taken or no name, or the class is no planner.
    """
    _refuse_name_of(POLICIES, name)
    PLANNERS.add(name, planner_class)


def register_policy(name: str, factory: object) -> None:
    """Let :func:`~d4orm_planners.make_policy` and whatever takes a policy's name know a policy of your own.

    Args:
        name: Its name.
        factory: A subclass of :class:`~d4orm_planners.Policy`, a function that makes a policy from its settings,
            anything else that :func:`~d4orm_planners.make_policy` takes, or the text ``"package.module:Name"`` of one.

    Raises:
        ValueError: If the name is taken or no name, or nothing that acts was given.
    """
    _refuse_name_of(PLANNERS, name)
    POLICIES.add(name, factory)


def _refuse_name_of(other: Registry[object], name: object) -> None:
    if is_one_of(name, other.own()):
        raise ValueError(f"{other.what} {name!r} has that name already; register yours under another")


for _name, _path in {
    "d4orm": "sampling.d4orm:D4orm",
    "d4orm-d": "d4orm_d.planner:D4ormD",
    "hybrid": "hybrid.planner:Hybrid",
    "d-d4orm": "d_d4orm.planner:DD4orm",
    "mppi": "sampling.mppi:MPPI",
    "cem": "sampling.cem:CEM",
    "mbd": "sampling.mbd:MBD",
    "i-mbd": "sampling.mbd:IterativeMBD",
    "ipopt": "baselines.ipopt:Ipopt",
    "mapf": "mapf.planner:MAPF",
    "amswarm": "baselines.amswarm:AMSwarm",
    "mmd": "baselines.mmd.planner:MMD",
}.items():
    register_planner(_name, f"d4orm_planners.{_path}")

for _name, _path in {
    "d4orm-c2f": "d4orm_c2f.receding_horizon:D4ormC2F",
    "go-to-goal": "base.policy:GoToGoal",
    "random": "base.policy:RandomControls",
    "orca": "baselines.orca:Orca",
    "ppo": "rl.learned:PPO",
    "sac": "rl.learned:SAC",
}.items():
    register_policy(_name, f"d4orm_planners.{_path}")
