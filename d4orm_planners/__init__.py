"""Planners and policies for teams of robots: D4orm, its rivals, and the loops that run them."""

from __future__ import annotations

from d4orm_planners.base import Planner, PlannerConfig
from d4orm_planners.episode import Episode, run_episode
from d4orm_planners.plan import IterationRecord, Plan
from d4orm_planners.policy import OpenLoop, Policy
from d4orm_planners.registry import list_planners, list_policies, make_planner, make_policy

__all__ = [
    "Episode",
    "IterationRecord",
    "OpenLoop",
    "Plan",
    "Planner",
    "PlannerConfig",
    "Policy",
    "list_planners",
    "list_policies",
    "make_planner",
    "make_policy",
    "run_episode",
]
