"""Coordination on a fixed path: a robot keeps to a motion, and may only choose how long it stands at each stop."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from d4orm_planners.manoeuvres.costs import unknown_costs
from d4orm_planners.manoeuvres.primitives import seen_from_first, table
from d4orm_planners.manoeuvres.robots import Robot
from d4orm_planners.manoeuvres.search import Motion


def on_fixed_path(robot: Robot, motion: Motion) -> Robot:
    """A robot whose moves are those of a motion of it from stop to stop, one after the other."""
    stops = motion.stops.tolist()
    # Modes count down: in mode 0, and in no other, a car with trailers may be at its goal.
    modes, rows = len(stops), []
    for number, (first, end) in enumerate(pairwise(stops)):
        poses, controls = seen_from_first(motion.poses[first : end + 1].astype(float)), motion.controls[first:end]
        # Alone it was not at its goal any sooner than at the end of its motion.
        speed = np.append(np.full(end - first - 1, np.inf), 0.0)
        rows.append((modes - 1 - number, modes - 2 - number, poses, speed, controls))
    primitives, lattice = table(rows, np.ones(modes, bool)), robot.task.lattice._replace(modes=modes)
    # There are too few moves for the order to matter.
    task = robot.task._replace(primitives=primitives, lattice=lattice, costs=unknown_costs(lattice))
    return replace(robot, task=task, mode=modes - 1)
