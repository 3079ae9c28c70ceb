"""Time to a robot's goal from all poses."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from d4orm_env.core.arrays import FloatArray, Floats
from d4orm_env.dynamics.robot_model import SPEED
from d4orm_planners.manoeuvres.heaps import Heap
from d4orm_planners.manoeuvres.kinds import SECTOR, SECTORS, Kind
from d4orm_planners.manoeuvres.lattice import PoseLattice, RobotBody, buffer_size, fill_costs
from d4orm_planners.manoeuvres.primitives import Primitives, primitives_of
from d4orm_planners.manoeuvres.snapping import Goal

TEAM_CELLS, LEAST_CELLS, MOST_CELLS = 4_000_000, 150_000, 400_000
"""Cells of the costs of all robots together, and the least and the most of one: a larger world has larger cells."""


class Area(NamedTuple):
    """The part of the plane that robots may use, and the size of the cells of the search's lattices [m]."""

    low: Floats
    high: Floats
    cell: float

    def lattice(self, cell: float, heading: float, sectors: int, modes: int) -> PoseLattice:
        """Cells of this size over all of it."""
        size = np.ceil((self.high - self.low) / cell).astype(int).tolist()
        return PoseLattice(self.low, 1 / cell, (size[0], size[1]), heading, sectors, modes)


class Costs(NamedTuple):
    """Steps to a goal.

    Attributes:
        lattice: Cells.
        steps: ``(cells,)``, infinite where they are not known: there they are at least
        far: this, ...
        pace: ... less so many for each metre from the start, ...
        start: ... which is at ``(x, y)``.
    """

    lattice: PoseLattice
    steps: FloatArray
    far: float
    pace: float
    start: tuple[float, float]


def costs_of(kind: Kind, area: Area, body: RobotBody, start: Floats, goal: Goal, team_size: int, bent: bool) -> Costs:
    """Steps to a goal for a robot that starts at a pose ``(6,)``, in a team of so many; ``bent`` if its trailers end in
    a bend.
    """
    layers = SECTORS if kind.model.heading_index is not None else 1
    modes, cells = primitives_of(kind)[2], np.clip(TEAM_CELLS / team_size, LEAST_CELLS, MOST_CELLS)
    size = np.prod(area.high - area.low) * len(modes) * layers
    cell = max(area.cell, float(np.sqrt(size / cells)))
    lattice = area.lattice(cell, 0.0 if np.isnan(goal.heading) else goal.heading, layers, len(modes))
    back, pace = primitives_of(replace(kind, cell=cell))[1], 1 / (kind.limits[SPEED] * kind.dt)
    goals = _goals(goal, lattice, len(modes) if bent else 1)
    steps, far = _spread(body, back, lattice, goals, start, modes.index(kind.start), pace)
    if far == np.inf:
        # Cells are coarse: even where no chain of them leads from the start to the goal, a path may do so.
        far, pace = float(steps[steps < np.inf].max(initial=0)), 0.0
    return Costs(lattice, steps, far, pace, (float(start[0]), float(start[1])))


def _goals(goal: Goal, lattice: PoseLattice, modes: int) -> Floats:
    """``(., 4)`` poses and modes at which a robot is at its goal."""
    headings = [goal.heading] if not np.isnan(goal.heading) else (np.arange(lattice.sectors) * SECTOR).tolist()
    return np.array([[goal.x, goal.y, heading, mode] for mode in range(modes) for heading in headings])


def _spread(
    body: RobotBody, back: Primitives, lattice: PoseLattice, goals: Floats, start: Floats, mode: int, pace: float
) -> tuple[FloatArray, float]:
    cells = lattice.modes * lattice.sectors * lattice.size[0] * lattice.size[1]
    steps = np.full(cells, np.inf, np.float32)
    far = fill_costs(
        body, back, lattice, goals, start, pace, steps, np.empty((cells, 3)), Heap.of(2 * cells + 512), mode,
        np.zeros(buffer_size(body.footprints), np.float32),
    )  # fmt: skip
    return steps, far
