"""Occupancy images as the map_server of ROS reads them: a YAML file, and a .png or .pgm image beside it."""

from __future__ import annotations

import io
import warnings
from functools import lru_cache
from pathlib import Path

import numpy as np

from d4orm_env.core.arrays import positive_number
from d4orm_env.core.yaml_text import read_yaml
from d4orm_env.scenarios.free_space import Mask
from d4orm_env.scenarios.grid_map import MAX_CELLS, GridMap


def read_occupancy_image(path: Path) -> GridMap:
    """The map of a map_server YAML file. Cells that are not known to be free are blocked.

    Raises:
        ValueError: If the file or its image is none; one line without the file's name.
        OSError: If the image cannot be read.
    """
    fields = read_yaml(path)
    if not isinstance(fields, dict):
        raise ValueError("is not a map_server file; expected fields such as 'image: map.pgm' and 'resolution: 0.05'")
    missing = [name for name in ("image", "resolution", "origin") if name not in fields]
    if missing:
        raise ValueError(f"has no field {missing[0]!r}; a map_server file needs image, resolution and origin")
    image, negate = fields["image"], fields.get("negate", 0)
    if not isinstance(image, str) or not image:
        raise ValueError(f"image is {image!r}; it must be the path of a .png or .pgm file")
    if not isinstance(negate, bool | int) or negate not in (0, 1):
        raise ValueError(f"negate is {negate!r}; it must be 0 or 1")
    if fields.get("mode", "trinary") not in ("trinary", "scale"):
        raise ValueError(f"mode is {fields['mode']!r}; only trinary and scale can be read")
    resolution = positive_number(fields["resolution"], "resolution")
    free = _share(fields.get("free_thresh", 0.196), "free_thresh")
    occupied = _share(fields.get("occupied_thresh", 0.65), "occupied_thresh")
    if free > occupied:
        raise ValueError(f"free_thresh is {free:g}; it must be at most occupied_thresh, which is {occupied:g}")
    low = _corner(fields["origin"])
    blocked = _blocked_cells((path.parent / image).read_bytes(), bool(negate), free)
    return _grid_map(blocked.tobytes(), blocked.shape, resolution, low)


@lru_cache(maxsize=4)
def _grid_map(blocked: bytes, shape: tuple[int, int], resolution: float, low: tuple[float, float]) -> GridMap:
    return GridMap(np.frombuffer(blocked, np.bool_).reshape(shape), resolution, low)


def _blocked_cells(content: bytes, negate: bool, free_thresh: float) -> Mask:
    from PIL import Image, UnidentifiedImageError

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(content)) as image:
                columns, rows = image.size
                if columns * rows > MAX_CELLS:
                    raise ValueError(f"its image has {rows} x {columns} cells; at most {MAX_CELLS} are read")
                deep = image.mode.startswith("I")
                shades = np.asarray(image if deep else image.convert("RGB"), np.float64)
    except (Image.DecompressionBombWarning, Image.DecompressionBombError):
        raise ValueError(f"its image is too large; at most {MAX_CELLS} cells are read") from None
    except UnidentifiedImageError:
        raise ValueError("its image is no image that can be read; save it as .png or .pgm") from None
    except (OSError, SyntaxError) as error:
        raise ValueError(f"its image is broken ({error}); save it again") from None
    share = shades / 65535 if deep else shades.mean(axis=-1) / 255
    occupancy = share if negate else 1 - share
    blocked: Mask = ~(occupancy < free_thresh)
    return blocked


def _share(value: object, name: str) -> float:
    return positive_number(value, name, zero_allowed=True, most=1.0)


def _corner(origin: object) -> tuple[float, float]:
    numbers = origin if isinstance(origin, list) and all(isinstance(value, int | float) for value in origin) else []
    if len(numbers) != 3 or not np.isfinite(numbers).all():
        raise ValueError(f"origin is {origin!r}; it must be three numbers, x, y and yaw")
    if numbers[2] != 0:
        raise ValueError(
            f"origin has a yaw of {numbers[2]:g} rad; only maps with a yaw of 0 can be read, so turn the image"
        )
    return float(numbers[0]), float(numbers[1])
