"""Planners and policies for teams of robots: D4orm, its rivals, and the loops that run them."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from d4orm_planners.base.controller import Controller
    from d4orm_planners.base.episode import Episode, run_episode
    from d4orm_planners.base.names import register_planner, register_policy
    from d4orm_planners.base.plan import IterationRecord, Plan, load_plan
    from d4orm_planners.base.planner import Iteration, Planner, PlannerConfig
    from d4orm_planners.base.planner_registry import list_planners, list_policies, make_planner, make_policy
    from d4orm_planners.base.policy import OpenLoop, Policy
    from d4orm_planners.base.shared_policy import MixedPolicy
    from d4orm_planners.base.solve import SolveRun
    from d4orm_planners.evaluation.evaluate import evaluate

__all__ = [
    "Controller", "Episode", "Iteration", "IterationRecord", "MixedPolicy", "OpenLoop", "Plan", "Planner",
    "PlannerConfig", "Policy", "SolveRun", "evaluate", "list_planners", "list_policies", "load_plan",
    "make_planner", "make_policy", "register_planner", "register_policy", "run_episode",
]  # fmt: skip

_HOMES = {
    "base.controller": ("Controller",),
    "base.episode": ("Episode", "run_episode"),
    "evaluation.evaluate": ("evaluate",),
    "base.shared_policy": ("MixedPolicy",),
    "base.names": ("register_planner", "register_policy"),
    "base.plan": ("IterationRecord", "Plan", "load_plan"),
    "base.planner": ("Iteration", "Planner", "PlannerConfig"),
    "base.policy": ("OpenLoop", "Policy"),
    "base.planner_registry": ("list_planners", "list_policies", "make_planner", "make_policy"),
    "base.solve": ("SolveRun",),
}


def __getattr__(name: str) -> object:
    """Import on first use, so that ``d4orm --help`` need not wait for the engines."""
    for home, names in _HOMES.items():
        if name in names:
            return getattr(import_module(f"d4orm_planners.{home}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
