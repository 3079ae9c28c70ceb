"""Named scenarios and scenario files."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from d4orm_env.scenarios.maps import load_map
from d4orm_env.scenarios.problems import describe_scenario, list_scenarios, make_problem, register_scenario

if TYPE_CHECKING:
    from d4orm_env.scenarios.cl_mapf import load_cl_mapf
    from d4orm_env.scenarios.dynobench import load_dynobench
    from d4orm_env.scenarios.problem_files import load_problem, save_problem

__all__ = [
    "describe_scenario", "list_scenarios", "load_cl_mapf", "load_dynobench", "load_map", "load_problem",
    "make_problem", "register_scenario", "save_problem",
]  # fmt: skip


def __getattr__(name: str) -> object:
    """Import the file schema on first use only: building it takes as long as importing everything else."""
    if name in ("load_problem", "save_problem"):
        return getattr(import_module("d4orm_env.scenarios.problem_files"), name)
    if name in ("load_cl_mapf", "load_dynobench"):
        return getattr(import_module(f"d4orm_env.scenarios.{name.removeprefix('load_')}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
