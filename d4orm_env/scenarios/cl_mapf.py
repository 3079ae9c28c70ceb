"""Problems of cars (CL-MAPF) as CL-CBS and CSDO publish theirs, in YAML.

Source of the format and of the vehicle: https://github.com/APRIL-ZJU/CL-CBS and
https://github.com/YangSVM/CSDOTrajectoryPlanning. A car is as their searches take it: up to full speed and to the
tightest turn at once. CSDO's optimiser bounds how fast wheels turn as well.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from d4orm_env.core.arrays import positive_number
from d4orm_env.core.errors import first_line, unknown
from d4orm_env.core.files import naming, read_yaml
from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.core.world import World
from d4orm_env.footprints import Box
from d4orm_env.scenarios.dynobench import numbers

DT = 0.25
"""Time step [s]; at 1 m/s a twelfth of a car's length."""
GOAL_TOLERANCE = 0.05
"""By how much a car may miss its goal [m, rad]: half of what CSDO lets bodies overlap."""
ROUNDING = 0.01
"""By how much bodies may leave the bounds [m]: files round headings, so that cars along a wall stand in it."""
SLOWEST = 5
"""A problem's duration, in times that its cars would need straight to their goals."""
LEAST_STEPS = 400
VEHICLE = {"r": 3.0, "carWidth": 2.0, "LF": 2.0, "LB": 1.0, "obsRadius": 0.8}
"""Turning radius, width, rear axle to front and to back, radius of an obstacle without one [m]: ``config.yaml``."""


def load_cl_mapf(path: str | os.PathLike[str], vehicle: Mapping[str, float] | None = None) -> Problem:
    """Read a problem of cars from CL-CBS's or CSDO's benchmark.

    Args:
        path: Its YAML file, with ``agents`` and ``map``.
        vehicle: What replaces entries of :data:`VEHICLE`, such as ``{"obsRadius": 1.0}`` [m].

    Returns:
        The problem of ``car_first_order`` at 1 m/s, as rectangles with goal headings, in steps of 0.25 s and without a
        margin; cars may leave their goals for others (``arrival="stay"``).

    Raises:
        ValueError: If the file cannot be read or is no such problem, or an entry of the vehicle is unknown or not
            positive; the message names the file, or the entry.
    """
    own = VEHICLE | dict(vehicle or {})
    for name, value in own.items():
        if name not in VEHICLE:
            raise unknown("vehicle's entry", name, VEHICLE)
        positive_number(value, f"{name} of vehicle")
    with naming(path):
        try:
            return _problem(read_yaml(path), own, Path(path).stem)
        except (KeyError, TypeError, IndexError) as error:
            reason = f"it lacks {error}" if isinstance(error, KeyError) else first_line(error)
            raise ValueError(
                f"is no problem of CL-CBS or CSDO ({reason}); it has agents: start, goal; map: dimensions, obstacles"
            ) from error


def _problem(content: Any, vehicle: Mapping[str, float], name: str) -> Problem:
    agents, size = content["agents"], numbers(content["map"]["dimensions"], "dimensions of map", 2)
    starts, goals = (
        np.array([numbers(agent[what], f"{what} of robot_{robot}", 3) for robot, agent in enumerate(agents)])
        for what in ("start", "goal")
    )
    obstacles = [
        [*numbers(given, f"obstacle {number}", 2), *numbers(given, f"obstacle {number}")[2:3], vehicle["obsRadius"]][:3]
        for number, given in enumerate(content["map"].get("obstacles") or ())
    ]
    length = vehicle["LF"] + vehicle["LB"]
    team = Team(
        ("car_first_order",) * len(agents),
        max_speed=1.0,
        own_limits={"max_steering": math.atan(1 / vehicle["r"]), "wheelbase": 1.0, "max_reverse_speed": 1.0},
        footprint=Box(length, vehicle["carWidth"], offset=vehicle["LF"] - length / 2),
    )
    world = World(2, circles=obstacles, lower=(-ROUNDING, -ROUNDING), upper=size + ROUNDING)
    farthest = float(np.linalg.norm(goals[:, :2] - starts[:, :2], axis=1).max())
    return Problem(
        team, starts, goals[:, :2], world, DT, max(LEAST_STEPS, math.ceil(SLOWEST * farthest / DT)), margin=0.0,
        goal_radius=GOAL_TOLERANCE, name=name, arrival="stay", goal_heading=goals[:, 2],
        goal_heading_tolerance=GOAL_TOLERANCE,
    )  # fmt: skip
