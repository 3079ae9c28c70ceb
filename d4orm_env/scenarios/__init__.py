"""Named scenarios and scenario files."""

from d4orm_env.scenarios.files import load_problem, save_problem
from d4orm_env.scenarios.registry import describe_scenario, list_scenarios, make_problem

__all__ = ["describe_scenario", "list_scenarios", "load_problem", "make_problem", "save_problem"]
