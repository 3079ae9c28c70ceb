"""Meshes, lines and colours of what a page shows.

Few triangles and cheap materials: where a browser has no graphics processor, the processor that plans draws too.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from d4orm_env.geometry.polygon import triangulate

Points = NDArray[np.float32]
Colors = NDArray[np.uint8]
Numbers = NDArray[np.number]

NO_LINES: tuple[Points, Colors] = np.zeros((0, 2, 3), np.float32), np.zeros((0, 2, 3), np.uint8)


def in_space(points: ArrayLike) -> Points:
    """Points ``(..., d)`` as new ones ``(..., 3)``."""
    given = np.asarray(points, np.float32)
    places = np.zeros((*given.shape[:-1], 3), np.float32)
    places[..., : given.shape[-1]] = given
    return places


def linear(colors: Numbers) -> Colors:
    """Colours as the page reads those of many things at once: proportional to the light."""
    return np.round(255 * (colors / 255) ** 2.2).astype(np.uint8)


def puck(sections: int, height: float = 1.0) -> trimesh.Trimesh:
    """Return the shape of things in the plane: a flat prism of radius 1 about the origin, open below."""
    mesh = trimesh.creation.cylinder(1.0, height, sections=sections)
    mesh.update_faces(mesh.face_normals[:, 2] > -0.5)
    mesh.unmerge_vertices()  # so that edges are sharp
    return mesh


def slab(outline: NDArray[np.float64]) -> trimesh.Trimesh:
    """Return the shape of a convex outline ``(n, 2)`` in the plane: a prism of height 1 about it."""
    corners = outline[np.linalg.norm(outline - np.roll(outline, 1, axis=0), axis=1) > 1e-9]
    mesh = _prism(corners, 1.0)
    mesh.unmerge_vertices()  # so that edges are sharp
    return mesh


def ball(subdivisions: int) -> trimesh.Trimesh:
    """Return the shape of things in space: a sphere of radius 1 about the origin."""
    return trimesh.creation.icosphere(subdivisions=subdivisions)


def solid(
    kind: str, shape: NDArray[np.float64], dimension: int, floor: float, top: float
) -> tuple[trimesh.Trimesh, Points]:
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


def _prism(corners: NDArray[np.float64], tall: float) -> trimesh.Trimesh:
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
    path: Numbers, colors: Numbers, paper: int, shares: tuple[float, float], knots: Sequence[NDArray[np.intp]]
) -> tuple[Points, Colors]:
    """Segments along the paths of a team.

    Args:
        path: ``(T, K, d)`` positions.
        colors: ``(K, 3)`` up to 255.
        paper: Brightness of what they are drawn on, up to 255.
        shares: Share of its colour that a path has at its beginning and its end; the rest is paper.
        knots: Points of its path that each robot's line goes through.

    Returns:
        ``(N, 2, 3)`` ends and their colours.
    """
    places, share = in_space(path), np.linspace(shares[0], shares[1], len(path))[:, None]
    points, tones = [NO_LINES[0]], [NO_LINES[1].astype(np.float64)]
    for robot, taken in enumerate(knots):
        path, tone = places[taken, robot], paper + share[taken] * (colors[robot] - paper)
        points.append(np.stack([path[:-1], path[1:]], axis=1))
        tones.append(np.stack([tone[:-1], tone[1:]], axis=1))
    return np.concatenate(points), linear(np.concatenate(tones))


def bends(path: Numbers, tolerance: float) -> NDArray[np.intp]:
    """Indices of a few points that tell a path ``(T, d)`` to within a tolerance [m] (Ramer, Douglas and Peucker)."""
    kept, open_parts = {0, len(path) - 1}, [(0, len(path) - 1)]
    while open_parts:
        first, last = open_parts.pop()
        if last - first < 2:
            continue
        along, off = path[last] - path[first], path[first + 1 : last] - path[first]
        share = np.clip(off @ along / max(float(along @ along), 1e-12), 0.0, 1.0)
        distance = np.linalg.norm(off - share[:, None] * along, axis=1)
        farthest = int(distance.argmax())
        if distance[farthest] > tolerance:
            middle = first + 1 + farthest
            kept.add(middle)
            open_parts += [(first, middle), (middle, last)]
    return np.array(sorted(kept), np.intp)
