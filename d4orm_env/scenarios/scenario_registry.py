"""The table of scenarios by name, which users and other packages extend."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from d4orm_env.core.arrays import shown
from d4orm_env.core.problem import Problem
from d4orm_env.core.registry import Registry
from d4orm_env.core.yaml_text import is_yaml_path
from d4orm_env.scenarios import corridors, forest, generators, maps, maze, mmd_maps, paper, rooms, warehouse
from d4orm_env.scenarios.scenario import BuiltIn, Scenario

SCENARIOS = Registry(
    "scenario", "d4orm.scenarios", lambda name, generator: Scenario(name.rpartition(":")[2], generator)
)
"""All scenarios by name; :func:`register_scenario` adds to them."""


def register_scenario(name: str, generator: Callable[..., Problem]) -> None:
    """Make a scenario known by name, wherever one is asked for.

    Args:
        name: Its name.
        generator: ``(seed, num_robots, **settings) -> Problem``, called with the first two by position. The same
            arguments must give the same problem. A problem called ``"custom"`` gets the scenario's name. The first line
            of the docstring describes the scenario.

    Raises:
        ValueError: If the name is taken or no name, or the generator cannot be called like that.
    """
    if isinstance(name, str) and is_yaml_path(name):
        raise ValueError(f"scenario name {shown(name)} is that of a file; give one that does not end in .yaml")
    SCENARIOS.add(name, generator)


_in_space = partial(BuiltIn, model="holonomic3d")
# Instances of others, who let robots stop dead at their goals.
_paper = partial(BuiltIn, horizon=100, goal_speed=np.inf)
_amswarm = partial(_in_space, num_robots=10, radius=0.29, margin=0.05, goal_speed=np.inf)
_mmd = partial(BuiltIn, draws=True, goal_speed=np.inf)

for _scenario in (
    BuiltIn(generators.circle),
    _in_space(generators.sphere),
    BuiltIn(generators.random, draws=True),
    BuiltIn(generators.four_obstacles),
    BuiltIn(generators.heterogeneous, model=None, max_acceleration=None),
    BuiltIn(generators.swap),
    _amswarm(generators.amswarm_1),
    _amswarm(generators.amswarm_2),
    _amswarm(generators.amswarm_3),
    _amswarm(generators.amswarm_4),
    _amswarm(generators.amswarm_5),
    _paper(paper.paper_circle),
    _paper(paper.paper_sphere, model="holonomic3d", radius=0.3),
    _paper(paper.paper_random, draws=True),
    _paper(paper.paper_heterogeneous, model=None, max_acceleration=None),
    _paper(paper.paper_obstacles, num_obstacles=4),
    BuiltIn(rooms.rooms, draws=True),
    BuiltIn(maze.maze, draws=True),
    BuiltIn(warehouse.warehouse, draws=True),
    BuiltIn(forest.forest, draws=True),
    BuiltIn(corridors.corridor, draws=True),
    BuiltIn(corridors.doorway, draws=True),
    _mmd(mmd_maps.mmd_conveyor),
    _mmd(mmd_maps.mmd_highways),
    _mmd(mmd_maps.mmd_drop_region),
    BuiltIn(maps.map),
):
    register_scenario(_scenario.__name__, _scenario)


def list_scenarios() -> tuple[str, ...]:
    """The names :func:`~d4orm_env.scenarios.make_problem` knows."""
    return tuple(SCENARIOS)


def describe_scenario(name: str) -> str:
    """One line on a scenario.

    Raises:
        ValueError: If there is no such scenario.
    """
    return SCENARIOS.look_up(name).description
