"""A map of square cells, free or blocked, as a world of few boxes."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from d4orm_env.core.arrays import LARGEST, SMALLEST
from d4orm_env.core.problem_checks import RESOLUTION
from d4orm_env.core.world import World
from d4orm_env.scenarios.free_space import Mask
from d4orm_env.scenarios.placement import Points

MAX_CELLS = 2**24
MAX_BYTES = 8 * MAX_CELLS
"""Of the file of a map: 16-bit colours with alpha have as many."""
"""Cells of a map at most."""

ROUNDING = 1e-3
"""More than float32 rounds away over a map, as a share."""

MOST_PARTS = 8
"""Lattice points per half of a cell at most; a team that needs more does not fit."""


@dataclass(frozen=True, eq=False)
class GridMap:
    """Square cells, free or blocked.

    Attributes:
        blocked: ``(rows, columns)``, the first row at the top.
        cell: Side of a cell [m].
        low: x and y of the lower left corner [m].
        origin: Of the world, where the map was elsewhere before [m].
        world: The blocked cells as boxes, and bounds around the map; y goes up.

    Raises:
        ValueError: If no cell is free, or float32 does not resolve the cells.
    """

    blocked: Mask
    cell: float
    low: tuple[float, float] = (0.0, 0.0)
    origin: tuple[float, float] = (0.0, 0.0)
    world: World = field(init=False)

    def __post_init__(self) -> None:
        if self.blocked.all():
            raise ValueError("has no free cell; open some")
        rows, columns = self.blocked.shape
        side = self.cell * max(rows, columns)
        if not SMALLEST <= self.cell <= side <= LARGEST or not float32_resolves(side, self.cell):
            raise ValueError(
                f"has {rows} x {columns} cells of {self.cell:g} m (resolution or cell); they must have {SMALLEST:g} m "
                f"or more, the sides of the map at most {LARGEST:g} m, and float32 must hold a cell to 1/{RESOLUTION}"
            )
        object.__setattr__(self, "world", self._world())

    def _world(self) -> World:
        rows, columns = self.blocked.shape
        top, left, bottom, right = merge_cells(self.blocked).T
        cells = np.column_stack([left, rows - bottom, right, rows - top])
        corner = np.array(self.low)
        boxes = cells * self.cell + np.tile(corner, 2)
        upper = corner + self.cell * np.array([columns, rows])
        return World(2, boxes=boxes, lower=corner, upper=upper, origin=self.origin)

    def centres(self, cells: Points) -> Points:
        """``(., 2)`` centres of the cells of these columns and rows ``(., 2)`` [m]."""
        column, row = cells.T
        return np.array(self.low) + self.cell * np.column_stack([column + 0.5, len(self.blocked) - row - 0.5])

    def lattice_step(self, reach: float) -> float:
        """Step of a lattice that finds every path one cell wide which robots of that reach have [m]."""
        half = self.cell / 2
        if half <= reach:
            return half * max(1, int(reach / 2 / half))
        # Between two lattice points this far from a wall a robot is still clear of it; see free_space.
        room = 2 * math.sqrt(half * half - reach * reach) * (1 - ROUNDING)
        parts = int(half / room) + 1
        return half / min(parts, MOST_PARTS)


def float32_resolves(coordinate: float, cell: float) -> bool:
    """Check whether float32 holds so large a coordinate to a hundredth of a cell [m], as starts to the goal radius."""
    return coordinate <= LARGEST and bool(RESOLUTION * np.spacing(np.float32(coordinate)) <= cell)


def merge_cells(blocked: Mask) -> np.ndarray:
    """Disjoint rectangles that cover the blocked cells and nothing else.

    Cells side by side make a run, and equal runs one below the other a rectangle; columns are tried in place of rows.

    Returns:
        ``(B, 4)`` top, left, bottom and right, the last two exclusive.
    """
    upright = _merge_rows(blocked.T)[:, [1, 0, 3, 2]]
    flat = _merge_rows(blocked)
    return flat if len(flat) <= len(upright) else upright


def _merge_rows(blocked: Mask) -> np.ndarray:
    edges = np.diff(np.pad(blocked, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    row, left = np.nonzero(edges == 1)
    right = np.nonzero(edges == -1)[1]
    order = np.lexsort((row, right, left))
    row, left, right = row[order], left[order], right[order]
    goes_on = (np.diff(row) == 1) & (np.diff(left) == 0) & (np.diff(right) == 0)
    first, last = np.r_[True, ~goes_on][: len(row)], np.r_[~goes_on, True][: len(row)]
    return np.column_stack([row[first], left[first], row[last] + 1, right[first]])
