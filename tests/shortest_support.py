"""Shortest paths by another road: visibility graphs of inflated obstacles, by shapely and SciPy."""

from __future__ import annotations

import numpy as np
import shapely
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from d4orm_env import World


def visible_lengths(world: World, reach: float, source: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Lengths of the shortest paths of a disc of this reach from ``source`` to ``positions`` ``(Q, 2)``.

    Inflated corners are polygons inside of the true arcs, so that lengths are never too large, and hardly too small.
    """
    solid = [shapely.box(*box) for box in world.boxes.tolist()] + [shapely.Polygon(p) for p in world.polygons]
    parts = [shapely.Point(x, y).buffer(r + reach, quad_segs=24) for x, y, r in world.circles.tolist()]
    blocked = shapely.union_all([*parts, shapely.union_all(solid).buffer(reach, quad_segs=6)])
    corners = [source[None], positions]
    for part in shapely.get_parts(blocked):
        oriented = shapely.orient_polygons(part)  # counterclockwise outside, clockwise round holes
        for outline in (oriented.exterior, *oriented.interiors):
            points = np.asarray(outline.coords)[:-1]
            before, after = points - np.roll(points, 1, axis=0), np.roll(points, -1, axis=0) - points
            # Paths turn only where an obstacle bulges out.
            corners.append(points[before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0] > 0])
    nodes = np.concatenate(corners)
    low, high = world.bounds.astype(np.float64)
    inside = ((nodes >= low + reach - 1e-9) & (nodes <= high - reach + 1e-9)).all(axis=1)
    inside[: 1 + len(positions)] = True
    nodes = nodes[inside]
    solid_within = blocked.buffer(-1e-6)
    shapely.prepare(solid_within)
    one, other = np.triu_indices(len(nodes), 1)
    free = ~shapely.intersects(solid_within, shapely.linestrings(np.stack([nodes[one], nodes[other]], axis=1)))
    one, other = one[free], other[free]
    gaps = np.linalg.norm(nodes[one] - nodes[other], axis=1)
    graph = csr_array((gaps, (one, other)), shape=(len(nodes), len(nodes)))
    return dijkstra(graph, directed=False, indices=0)[1 : 1 + len(positions)]
