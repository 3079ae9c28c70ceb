"""Meshes, lines and colours of what a page shows; robots and trailers of one shape are instances of one mesh.

Few triangles and cheap materials: where a browser has no graphics processor, the processor that plans draws too.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.problem import Problem
from d4orm_env.footprints import DIRECTIONS, Footprint
from d4orm_env.geometry.polygon import triangulate

Points = NDArray[np.float32]
Colors = NDArray[np.uint8]
Numbers = NDArray[np.number]

NO_LINES: tuple[Points, Colors] = np.zeros((0, 2, 3), np.float32), np.zeros((0, 2, 3), np.uint8)


def in_space(points: ArrayLike) -> Points:
    """Points ``(..., d)`` as new ones ``(..., 3)``."""
    given = np.asarray(points, np.float32)
    positions = np.zeros((*given.shape[:-1], 3), np.float32)
    positions[..., : given.shape[-1]] = given
    return positions


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
    middle, faces = np.eye(4), triangulate(corners.astype(np.float32))
    middle[2, 3] = -tall / 2
    return trimesh.creation.extrude_triangulation(corners, faces, tall, middle)


def edges(bounds: Points) -> Points:
    """``(N, 2, 3)`` the edges of the box between two corners; of the rectangle where it is flat."""
    corners = np.array([[bounds[(i >> axis) & 1, axis] for axis in range(3)] for i in range(8)], np.float32)
    pairs = [(i, i | 1 << axis) for axis in range(3) for i in range(8) if not i & 1 << axis]
    segments = corners[np.array(pairs)]
    return segments[np.linalg.norm(segments[:, 0] - segments[:, 1], axis=1) > 0]


def polylines(
    path: Numbers, colors: Numbers, paper: int, shares: tuple[float, float], knots: Sequence[NDArray[np.intp]]
) -> tuple[Points, Colors]:
    """``(N, 2, 3)`` segments along the paths ``(T, K, d)`` of a team, and their colours, of ``colors`` ``(K, 3)`` up to
    255.

    ``shares`` of these a path has at its beginning and its end; the rest is the brightness of the ``paper``. ``knots``
    are points of its path that each robot's line goes through.
    """
    positions, share = in_space(path), np.linspace(shares[0], shares[1], len(path))[:, None]
    points, tones = [NO_LINES[0]], [NO_LINES[1].astype(np.float64)]
    for robot, taken in enumerate(knots):
        path, tone = positions[taken, robot], paper + share[taken] * (colors[robot] - paper)
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


PLAN_TOLERANCE = 0.1  #: Error allowed in the line of a path ahead, in radii of a robot
HEIGHT, MARGIN_HEIGHT = 0.5, 0.1  #: Of what drives in the plane, in radii of its robot


class BodyGroup(NamedTuple):
    """Bodies of one shape."""

    name: str  #: Of the instances
    bodies: NDArray[np.intp]  #: ``(N,)`` numbers among the team's bodies
    robots: NDArray[np.intp]  #: ``(N,)`` whose they are
    mesh: trimesh.Trimesh  #: Their shape
    scales: FloatArray  #: ``(N, 3)``
    margin: tuple[trimesh.Trimesh, FloatArray]  #: Their shape with the margin, and the scales of that


def body_groups(problem: Problem) -> list[BodyGroup]:
    """A team's bodies by shape; discs and ellipsoids of any size are one."""
    kinds: dict[Footprint | None, list[int]] = {}
    planar = problem.team.shapes and problem.dimension == 2
    for number, body in enumerate(problem.team.bodies):
        kinds.setdefault(body.footprint if planar else None, []).append(number)
    return [_group(problem, f"robots_{index}", *kind) for index, kind in enumerate(kinds.items())]


def _group(problem: Problem, name: str, footprint: Footprint | None, numbers: list[int]) -> BodyGroup:
    team, margin = problem.team, np.float32(problem.margin)
    robots = np.array([team.bodies[number].robot for number in numbers])
    radius = np.asarray(team.radius, np.float32)[robots]
    ones = np.ones_like(radius)
    bodies = np.array(numbers)
    if footprint is not None:
        outline, high = footprint.outline(), HEIGHT * radius
        wider = slab(outline + margin * DIRECTIONS), np.stack([ones, ones, MARGIN_HEIGHT * radius], axis=1)
        return BodyGroup(name, bodies, robots, slab(outline), np.stack([ones, ones, high], axis=1), wider)
    if problem.dimension == 2:
        wide, mesh = radius + margin, puck(24)
        scales = np.stack([radius, radius, HEIGHT * radius], axis=1)
        return BodyGroup(
            name, bodies, robots, mesh, scales, (mesh, np.stack([wide, wide, MARGIN_HEIGHT * radius], axis=1))
        )
    sizes, mesh = team.all_footprint_arrays.semi_axes[numbers], ball(2)
    return BodyGroup(name, bodies, robots, mesh, sizes, (mesh, sizes + margin))


def body_positions(problem: Problem, states: FloatArray, positions: Points) -> tuple[Points, FloatArray | None]:
    """``(F, 3)`` positions and ``(F, 4)`` quaternions of all bodies, their robots drawn at ``positions`` ``(K, 3)``.

    A body lies from its robot as it does in ``states`` ``(K, n)``. What is round has no turn: ``None``.
    """
    if not problem.team.shapes or problem.dimension == 3:
        return positions, None
    d, poses = problem.dimension, problem.team.body_poses(states)
    robots = [body.robot for body in problem.team.bodies]
    shown = positions[robots] + in_space(poses[:, :d] - states[robots, :d])
    half = 0.5 * poses[:, d]
    turns = np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], axis=1)
    return shown, turns.astype(np.float32)


def goal_poses(problem: Problem, goals: Points) -> tuple[Points, NDArray[np.intp]]:
    """``(N, 2, 3)`` outlines and headings at ``goals`` ``(K, 3)`` that ask for one, and ``(N,)`` whose each line is."""
    lines, owners = [np.zeros((0, 2, 3), np.float32)], [np.zeros(0, np.intp)]
    for robot in np.flatnonzero(~np.isnan(problem.goal_heading)):
        corners = problem.team.footprint[robot].outline()
        front = np.array([[0.0, 0.0], [corners[:, 0].max(), 0.0]])
        cosine, sine = np.cos(problem.goal_heading[robot]), np.sin(problem.goal_heading[robot])
        drawn = np.concatenate([np.stack([corners, np.roll(corners, -1, axis=0)], axis=1), front[None]])
        lines.append(goals[robot] + in_space(drawn @ np.array([[cosine, sine], [-sine, cosine]])))
        owners.append(np.full(len(drawn), robot))
    return np.concatenate(lines), np.concatenate(owners)


def heading_lines(problem: Problem, states: FloatArray, positions: Points) -> Points:
    """``(N, 2, 3)`` lines from the centre to the front of robots that have one."""
    models, fronts = problem.team.robot_models, [shape.outline()[:, 0].max() for shape in problem.team.footprint]
    drives = [(robot, model.heading_index) for robot, model in enumerate(models) if model.heading_index is not None]
    points = np.zeros((len(drives), 2, 3), np.float32)
    for row, (robot, index) in enumerate(drives):
        angle = states[robot, index]
        points[row] = positions[robot] + np.array([0, 0, 0.3 * problem.team.radius[robot]])
        points[row, 1, :2] += fronts[robot] * np.array([np.cos(angle), np.sin(angle)])
    return points


class PathLines:
    """Lines of the paths ahead, whose bends are looked for only when these are others."""

    def __init__(self, problem: Problem) -> None:
        self._tolerance = PLAN_TOLERANCE * np.asarray(problem.team.radius)
        self._path, self._knots = np.zeros((0, 0, 0), np.float32), list[NDArray[np.intp]]()

    def drawn(
        self, path: FloatArray, colors: FloatArray, paper: int, shades: tuple[float, float]
    ) -> tuple[Points, Colors]:
        """Lines along ``path`` ``(P, K, d)``; the other arguments are those of :func:`polylines`."""
        if not np.array_equal(self._path, path):
            self._path = path
            self._knots = [bends(path[:, robot], float(self._tolerance[robot])) for robot in range(path.shape[1])]
        return polylines(path, colors, paper, shades, self._knots)
