"""Problems of cars (CL-MAPF) as CL-CBS and CSDO publish theirs, in YAML.

Source of the format and of the vehicle: https://github.com/APRIL-ZJU/CL-CBS and
https://github.com/YangSVM/CSDOTrajectoryPlanning. A car takes any speed, and any turn that its wheels allow, at once,
as in their searches. CSDO's optimiser bounds how fast wheels turn as well. CL-CBS keeps rear axles within the bounds,
CSDO two discs round a car, and we its body.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from d4orm_env.core.arrays import number_list, positive_number, truth
from d4orm_env.core.errors import did_you_mean, first_line, unknown
from d4orm_env.core.files import checked_path, naming, read_yaml
from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.core.world import World
from d4orm_env.footprints import Box

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
"""Turning radius, width, rear axle to front and to back, radius of an obstacle without one [m], by ``config.yaml``."""
MAP_KEYS = ("dimensions", "obstacles")


def load_cl_mapf(
    path: str | os.PathLike[str], vehicle: Mapping[str, float] | None = None, *, clockwise: bool = False
) -> Problem:
    """Read a problem of cars from CSDO's or CL-CBS's benchmark.

    Args:
        path: Its YAML file, with ``agents`` and ``map``.
        vehicle: What replaces entries of :data:`VEHICLE`, such as ``{"obsRadius": 1.0}`` [m].
        clockwise: Whether headings turn clockwise: true for CL-CBS's files, which do not say so themselves.

    Returns:
        The problem of ``car_first_order`` at 1 m/s, as rectangles with goal headings, in steps of 0.25 s and without a
        margin; cars may leave their goals for others (``arrival="stay"``).

    Raises:
        ValueError: If the file cannot be read or is no such problem, ``clockwise`` is no truth value, or an entry of
            the vehicle is unknown or not positive; the message names the file, or the entry.
    """
    given = {} if vehicle is None else vehicle
    if not isinstance(given, Mapping):
        raise ValueError(f"vehicle must be a mapping such as {{'r': 3.0}}, not {given!r}")
    for name in given:
        if name not in VEHICLE:
            raise unknown("vehicle's entry", name, VEHICLE)
    clockwise = truth(clockwise, "clockwise")
    own = VEHICLE | {name: positive_number(value, f"{name} of vehicle") for name, value in given.items()}
    path = checked_path(path, "a problem of CL-CBS or CSDO")
    with naming(path):
        try:
            return _problem(read_yaml(path), own, -1 if clockwise else 1, path.stem)
        except (KeyError, TypeError, IndexError) as error:
            reason = f"it lacks {error}" if isinstance(error, KeyError) else first_line(error)
            raise ValueError(
                f"is no problem of CL-CBS or CSDO ({reason}); it has agents: start, goal; map: dimensions, obstacles"
            ) from error


def _problem(content: Any, vehicle: Mapping[str, float], way: int, name: str) -> Problem:
    agents, world = content["agents"], _world(content["map"], vehicle["obsRadius"])
    starts, goals = (
        np.array([number_list(agent[what], f"{what} of robot_{robot}", 3) for robot, agent in enumerate(agents)])
        * (1, 1, way)
        for what in ("start", "goal")
    )
    length = vehicle["LF"] + vehicle["LB"]
    team = Team(
        ("car_first_order",) * len(agents),
        max_speed=1.0,
        # In the tightest turn wheels are turned by half a right angle.
        own_limits={"max_steering": math.pi / 4, "wheelbase": vehicle["r"], "max_reverse_speed": 1.0},
        footprint=Box(length, vehicle["carWidth"], offset=vehicle["LF"] - length / 2),
    )
    farthest = float(np.linalg.norm(goals[:, :2] - starts[:, :2], axis=1).max())
    return Problem(
        team, starts, goals[:, :2], world, DT, max(LEAST_STEPS, math.ceil(SLOWEST * farthest / DT)), margin=0.0,
        goal_radius=GOAL_TOLERANCE, name=name, arrival="stay", goal_heading=goals[:, 2],
        goal_heading_tolerance=GOAL_TOLERANCE,
    )  # fmt: skip


def _world(given: Any, radius: float) -> World:
    for name in given:
        if name not in MAP_KEYS and (meant := did_you_mean(name, MAP_KEYS)):
            raise ValueError(f"map has the key {name!r}{meant}")
    size, circles = number_list(given["dimensions"], "dimensions of map", 2), []
    for number, obstacle in enumerate(given.get("obstacles") or ()):
        row = number_list(obstacle, f"obstacle {number}").tolist()
        if len(row) not in (2, 3):
            raise ValueError(f"obstacle {number} is {row}; it must have numbers, 2 or 3 of them")
        circles.append([*row, radius][:3])
    return World(2, circles=circles, lower=(-ROUNDING, -ROUNDING), upper=size + ROUNDING)
