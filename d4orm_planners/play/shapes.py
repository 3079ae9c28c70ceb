"""Meshes, lines and colours of what a page shows.

Few triangles and cheap materials: where a browser has no graphics processor, the processor that plans draws too.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from d4orm_env.core.polygon import triangulate

Points = NDArray[np.float32]
Colors = NDArray[np.uint8]

NO_LINES: tuple[Points, Colors] = np.zeros((0, 2, 3), np.float32), np.zeros((0, 2, 3), np.uint8)


def in_space(points: Any) -> Points:
    """Points ``(..., d)`` as new ones ``(..., 3)``."""
    given = np.asarray(points, np.float32)
    places = np.zeros((*given.shape[:-1], 3), np.float32)
    places[..., : given.shape[-1]] = given
    return places


def linear(colors: NDArray[Any]) -> Colors:
    """Colours as the page reads those of many things at once: proportional to the light."""
    return np.round(255 * (colors / 255) ** 2.2).astype(np.uint8)


def puck(sections: int, height: float = 1.0) -> Any:
    """What stands for something in the plane: a flat prism of radius 1 about the origin, open below."""
    mesh = trimesh.creation.cylinder(1.0, height, sections=sections)
    mesh.update_faces(mesh.face_normals[:, 2] > -0.5)
    mesh.unmerge_vertices()  # so that edges are sharp
    return mesh


def ball(subdivisions: int) -> Any:
    """What stands for something in space: a sphere of radius 1 about the origin."""
    return trimesh.creation.icosphere(subdivisions=subdivisions)


def solid(kind: str, shape: NDArray[np.float64], dimension: int, floor: float, top: float) -> tuple[Any, Points]:
    """An obstacle's mesh about its centre, and the centre."""
    tall, middle = top - floor, (top + floor) / 2
    if kind == "spheres":
        return trimesh.creation.icosphere(radius=shape[3], subdivisions=3), in_space(shape[:3])
    if kind in ("circles", "cylinders"):
        mesh = trimesh.creation.cylinder(shape[2], tall, sections=48)
        return mesh, np.array([shape[0], shape[1], middle], np.float32)
    if kind == "boxes":
        low, high = in_space(shape[:dimension]), in_space(shape[dimension:])
        if dimension == 2:
            low[2], high[2] = floor, top
        return trimesh.creation.box(extents=high - low), in_space((low + high) / 2)
    centre = shape.mean(axis=0)
    return _prism(shape - centre, tall), np.array([*centre, middle], np.float32)


def _prism(corners: NDArray[np.float64], tall: float) -> Any:
    """A polygon as a solid of some height."""
    count, top = len(corners), np.array(triangulate(corners.astype(np.float32)))
    ring = np.arange(count)
    after = np.roll(ring, -1)
    walls = np.concatenate(
        [np.stack([ring, after, after + count], 1), np.stack([ring, after + count, ring + count], 1)]
    )
    vertices = np.concatenate([np.column_stack([corners, np.full(count, z)]) for z in (-tall / 2, tall / 2)])
    return trimesh.Trimesh(vertices, np.concatenate([top, top + count, walls]), process=False)


def edges(bounds: Points) -> Points:
    """``(N, 2, 3)`` the edges of the box between two corners; of the rectangle where it is flat."""
    corners = np.array([[bounds[(i >> axis) & 1, axis] for axis in range(3)] for i in range(8)], np.float32)
    pairs = [(i, i | 1 << axis) for axis in range(3) for i in range(8) if not i & 1 << axis]
    segments = corners[np.array(pairs)]
    return segments[np.linalg.norm(segments[:, 0] - segments[:, 1], axis=1) > 0]


def polylines(
    path: NDArray[Any], colors: NDArray[Any], shares: tuple[float, float], most: int
) -> tuple[Points, Colors]:
    """Segments along the ways of a team.

    Args:
        path: ``(T, K, d)`` positions, at least two.
        colors: ``(K, 3)`` up to 255.
        shares: How much of its colour a way has at its beginning and its end; the rest is white.
        most: Segments of a way.

    Returns:
        ``(N, 2, 3)`` ends and their colours.
    """
    taken = np.unique(np.linspace(0, len(path) - 1, most + 1).round().astype(np.intp))
    places = in_space(path[taken])
    points = np.stack([places[:-1], places[1:]], axis=2)
    share = np.linspace(shares[0], shares[1], len(points))
    faded = 255 - share[:, None, None] * (255 - colors)
    both = np.repeat(np.broadcast_to(faded, (*points.shape[:2], 3))[:, :, None], 2, axis=2)
    return points.reshape(-1, 2, 3), linear(both.reshape(-1, 2, 3))
