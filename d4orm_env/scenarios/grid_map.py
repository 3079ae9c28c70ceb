"""Maps of square cells, free or blocked, as worlds of few boxes.

Among them are occupancy images as the map_server of ROS reads them: a YAML file, and a .png or .pgm image beside it.
"""

from __future__ import annotations

import io
import math
import warnings
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, TypeAlias, get_args

import numpy as np

from d4orm_env.core.arrays import LARGEST, SMALLEST, BoolArray, Floats, positive_number, short_repr
from d4orm_env.core.files import read_limited, read_yaml
from d4orm_env.core.lazy import LazyModule
from d4orm_env.core.problem_checks import RESOLUTION
from d4orm_env.core.world import World

Image: Any = LazyModule("PIL.Image")

MAX_CELLS = 2**24
"""Cells of a map at most."""
MAX_BYTES = 8 * MAX_CELLS
"""Of the file of a map: 16-bit colours with alpha have as many."""

ROUNDING = 1e-3
"""More than float32 rounds away over a map, as a share."""

MOST_PARTS = 8
"""Lattice points per half of a cell at most; a team that needs more does not fit."""


@dataclass(frozen=True, eq=False)
class GridMap:
    """Square cells, free or blocked."""

    blocked: BoolArray  #: ``(rows, columns)``, the first row at the top
    cell: float  #: Side of a cell [m]
    low: tuple[float, float] = (0.0, 0.0)  #: x and y of the lower left corner [m]
    origin: tuple[float, float] = (0.0, 0.0)  #: Of the world, where the map was elsewhere before [m]
    world: World = field(init=False)  #: The blocked cells as boxes, and bounds around the map; y goes up

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

    def centres(self, cells: Floats) -> Floats:
        """``(., 2)`` centres of the cells of these columns and rows ``(., 2)`` [m]."""
        column, row = cells.T
        return np.array(self.low) + self.cell * np.column_stack([column + 0.5, len(self.blocked) - row - 0.5])

    def lattice_step(self, safety_distance: float) -> float:
        """Step of a lattice that finds every path one cell wide which robots with that safety distance have [m]."""
        half = self.cell / 2
        if half <= safety_distance:
            return half * max(1, int(safety_distance / 2 / half))
        # Between two lattice points this far from a wall a robot is still clear of it; see free_space.
        room = 2 * math.sqrt(half * half - safety_distance * safety_distance) * (1 - ROUNDING)
        parts = int(half / room) + 1
        return half / min(parts, MOST_PARTS)


def float32_resolves(coordinate: float, cell: float) -> bool:
    """Check whether float32 holds so large a coordinate to a hundredth of a cell [m], as starts to the goal radius."""
    return coordinate <= LARGEST and bool(RESOLUTION * np.spacing(np.float32(coordinate)) <= cell)


def merge_cells(blocked: BoolArray) -> np.ndarray:
    """``(B, 4)`` disjoint rectangles, top, left, bottom and right, the last two exclusive, that cover the blocked
    cells.

    Cells side by side make a run, and equal runs one below the other a rectangle; columns are tried in place of rows.
    """
    upright = _merge_rows(blocked.T)[:, [1, 0, 3, 2]]
    flat = _merge_rows(blocked)
    return flat if len(flat) <= len(upright) else upright


def _merge_rows(blocked: BoolArray) -> np.ndarray:
    edges = np.diff(np.pad(blocked, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    row, left = np.nonzero(edges == 1)
    right = np.nonzero(edges == -1)[1]
    order = np.lexsort((row, right, left))
    row, left, right = row[order], left[order], right[order]
    goes_on = (np.diff(row) == 1) & (np.diff(left) == 0) & (np.diff(right) == 0)
    first, last = np.r_[True, ~goes_on][: len(row)], np.r_[~goes_on, True][: len(row)]
    return np.column_stack([row[first], left[first], row[last] + 1, right[first]])


Mode: TypeAlias = Literal["trinary", "scale", "raw"]

LEAST_TURN = 0.01
"""Share of a cell by which a yaw may move a corner of a map and still count as none."""


def read_occupancy_image(path: Path) -> GridMap:
    """The map of a map_server YAML file. Cells that are not known to be free are blocked."""
    fields = read_yaml(path)
    if not isinstance(fields, dict):
        raise ValueError("is not a map_server file; expected fields such as 'image: map.pgm' and 'resolution: 0.05'")
    return grid_of_fields(fields, path.parent)


def grid_of_fields(fields: dict[str, Any], folder: Path) -> GridMap:
    """The map that the fields of a map_server file mean, its image in this folder; see :func:`read_occupancy_image`."""
    missing = [name for name in ("image", "resolution", "origin") if name not in fields]
    if missing:
        raise ValueError(f"has no field {missing[0]!r}; a map_server file needs image, resolution and origin")
    image, negate = fields["image"], fields.get("negate", 0)
    if not isinstance(image, str) or not image:
        raise ValueError(f"image is {short_repr(image)}; it must be the path of a .png or .pgm file")
    if not isinstance(negate, bool | int) or negate not in (0, 1):
        raise ValueError(f"negate is {short_repr(negate)}; it must be 0 or 1")
    mode = _mode(fields.get("mode", "trinary"))
    if mode == "raw" and negate:
        raise ValueError("negate is 1 and mode is raw, which map_server and nav2 read differently; save it with 0")
    resolution = positive_number(fields["resolution"], "resolution", least=SMALLEST, most=LARGEST)
    free = _share(fields.get("free_thresh", 0.196), "free_thresh")
    occupied = _share(fields.get("occupied_thresh", 0.65), "occupied_thresh")
    if free > occupied:
        raise ValueError(f"free_thresh is {free:g}; it must be at most occupied_thresh, which is {occupied:g}")
    x, y, yaw = _checked_origin(fields["origin"])
    blocked = ~(_occupancy(read_limited(folder / image, "an image", MAX_BYTES), mode, bool(negate)) < free)
    if abs(math.remainder(yaw, math.tau)) * math.hypot(*blocked.shape) > LEAST_TURN:
        raise ValueError(f"origin has a yaw of {yaw:g} rad; only maps with a yaw of 0 can be read, so turn the image")
    return _grid_map(blocked.tobytes(), blocked.shape, resolution, (x, y))


@lru_cache(maxsize=4)
def _grid_map(blocked: bytes, shape: tuple[int, int], resolution: float, low: tuple[float, float]) -> GridMap:
    cells: BoolArray = np.frombuffer(blocked, np.bool_).reshape(shape)
    far = max(max(abs(low[axis]), abs(low[axis] + resolution * shape[1 - axis])) for axis in (0, 1))
    if float32_resolves(far, resolution):
        return GridMap(cells, resolution, low)
    return GridMap(cells, resolution, origin=low)


def _occupancy(content: bytes, mode: Mode, negate: bool) -> Floats:
    """Return the occupancy of each cell, from 0 to 1, and infinite where that is unknown, ``(rows, columns)``.

    Colours and ``negate`` count as in map_server and nav2 (loadMapFromFile), and alpha so that it never makes a cell
    free. Trinary: averaged in with the colours, as they do, but for an opaque pixel, which is as in an image without
    alpha, and one of no opacity, which is unknown even if negated. Scale: what is not opaque is unknown, as in nav2;
    and so in raw, where neither looks. Raw: the brightness from 0 to 100 is the occupancy in per cent, and unknown
    above.
    """
    shade, alpha = _pixels(content)
    if mode == "raw":
        value = np.round(shade * 255)
        return np.where((alpha == 1) & (value <= 100), value / 100, np.inf)
    occupancy = shade if negate else 1 - shade
    if mode == "scale":
        return np.where(alpha == 1, occupancy, np.inf)
    return np.where(alpha > 0, np.maximum(occupancy, (3 * occupancy + 1 - alpha) / 4), np.inf)


def _pixels(content: bytes) -> tuple[Floats, Floats]:
    """Brightness and opacity of each pixel, from 0 to 1, ``(rows, columns)`` each."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(content)) as image:
                columns, rows = image.size
                if columns * rows > MAX_CELLS:
                    raise ValueError(f"its image has {rows} x {columns} cells; at most {MAX_CELLS} are read")
                key = image.info.get("transparency")
                if image.mode.startswith("I"):  # 16 bits deep, where at most one shade is transparent
                    deep = np.asarray(image)
                    return deep / 65535, np.where(deep == key, 0.0, 1.0)
                if key is None and not image.mode.upper().endswith("A"):
                    return _brightness(np.asarray(image.convert("RGB"))), np.ones((rows, columns))
                pixels = np.asarray(image.convert("RGBA"))
    except (Image.DecompressionBombWarning, Image.DecompressionBombError):
        raise ValueError(f"its image is too large; at most {MAX_CELLS} cells are read") from None
    except Image.UnidentifiedImageError:
        raise ValueError("its image is no image that can be read; save it as .png or .pgm") from None
    except (OSError, SyntaxError) as error:
        raise ValueError(f"its image is broken ({error}); save it again") from None
    return _brightness(pixels[..., :3]), pixels[..., 3] / 255


def _brightness(colours: np.ndarray) -> Floats:
    return colours.sum(axis=-1, dtype=np.uint16) / 3 / 255


def _mode(value: object) -> Mode:
    """Check a mode as nav2 does: in letters of either case."""
    for mode in get_args(Mode):
        if isinstance(value, str) and value.lower() == mode:
            return mode
    raise ValueError(f"mode is {short_repr(value)}; it must be one of {', '.join(get_args(Mode))}")


def _share(value: object, name: str) -> float:
    return positive_number(value, name, zero_allowed=True, most=1.0)


def _checked_origin(origin: object) -> list[float]:
    """X and y [m], and yaw [rad].

    Some saved maps have ``-nan`` as their yaw, where a mapper sent no valid orientation. Nothing in ROS's navigation
    uses a yaw, and its maintainers advise to write zero there (ros-planning/navigation, issue 993): it is read as zero.
    """
    numbers: list[Any] = origin if isinstance(origin, list) and len(origin) == 3 else [None]
    if str(numbers[-1]).lower().lstrip("+-.") == "nan":
        numbers = [*numbers[:2], 0.0]
    if not all(isinstance(value, int | float) and math.isfinite(value) for value in numbers):
        raise ValueError(f"origin is {short_repr(origin)}; it must be three numbers, x, y and yaw")
    return [float(value) for value in numbers]
