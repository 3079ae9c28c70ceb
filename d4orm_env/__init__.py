"""Multi-robot navigation with real dynamics: problems, environments, physics engines and an independent judge."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from d4orm_env.core.problem import Problem
from d4orm_env.core.robot_types import make_team
from d4orm_env.core.team import Team
from d4orm_env.core.trajectory import Trajectory
from d4orm_env.core.world import World
from d4orm_env.dynamics.models import register_model
from d4orm_env.engine.choice import rollout
from d4orm_env.envs import register_environments
from d4orm_env.scenarios import list_scenarios, load_map, make_problem, register_scenario
from d4orm_env.verify import VerificationReport, verify

if TYPE_CHECKING:
    from d4orm_env import navigation_v0
    from d4orm_env.jax import functional
    from d4orm_env.scenarios import load_dynobench, load_problem, save_problem

__version__ = "1.0.0rc1"

__all__ = [
    "Problem", "Team", "Trajectory", "VerificationReport", "World", "functional", "list_scenarios", "load_dynobench",
    "load_map", "load_problem", "make_problem", "make_team", "navigation_v0", "register_model", "register_scenario",
    "rollout", "save_problem", "verify",
]  # fmt: skip

register_environments()


def __getattr__(name: str) -> object:
    """Load what brings PettingZoo, JAX or pydantic with it on first use only."""
    if name in ("load_dynobench", "load_problem", "save_problem"):
        return getattr(import_module("d4orm_env.scenarios"), name)
    if name in ("functional", "navigation_v0"):
        return import_module("d4orm_env.jax.functional" if name == "functional" else "d4orm_env.navigation_v0")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
