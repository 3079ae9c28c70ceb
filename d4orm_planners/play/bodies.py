"""The bodies of a team on the page: robots and trailers of one shape are instances of one mesh."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray

from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.problem import Problem
from d4orm_env.footprints import DIRECTIONS, Footprint
from d4orm_planners.play.meshes import Colors, Points, ball, bends, in_space, polylines, puck, slab

PLAN_TOLERANCE = 0.1
"""Error allowed in the line of a path ahead, in radii of a robot."""
HEIGHT, MARGIN_HEIGHT = 0.5, 0.1
"""Of what drives in the plane, in radii of its robot."""


class BodyGroup(NamedTuple):
    """Bodies of one shape.

    Attributes:
        name: Of the instances.
        bodies: ``(N,)`` numbers among the team's bodies.
        robots: ``(N,)`` whose they are.
        mesh: Their shape.
        scales: ``(N, 3)``.
        margin: Their shape with the margin, and the scales of that.
    """

    name: str
    bodies: NDArray[np.intp]
    robots: NDArray[np.intp]
    mesh: trimesh.Trimesh
    scales: FloatArray
    margin: tuple[trimesh.Trimesh, FloatArray]


def body_groups(problem: Problem) -> list[BodyGroup]:
    """A team's bodies by shape; discs and ellipsoids of any size are one."""
    kinds: dict[Footprint | None, list[int]] = {}
    planar = problem.team.shapes and problem.dimension == 2
    for number, body in enumerate(problem.team.bodies):
        kinds.setdefault(body.footprint if planar else None, []).append(number)
    return [_group(problem, f"robots_{place}", *kind) for place, kind in enumerate(kinds.items())]


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


def body_places(problem: Problem, states: FloatArray, places: Points) -> tuple[Points, FloatArray | None]:
    """``(F, 3)`` positions and ``(F, 4)`` quaternions of all bodies, their robots drawn at ``places`` ``(K, 3)``.

    A body lies from its robot as it does in ``states`` ``(K, n)``. What is round has no turn: ``None``.
    """
    if not problem.team.shapes or problem.dimension == 3:
        return places, None
    d, poses = problem.dimension, problem.team.body_poses(states)
    robots = [body.robot for body in problem.team.bodies]
    shown = places[robots] + in_space(poses[:, :d] - states[robots, :d])
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


def heading_lines(problem: Problem, states: FloatArray, places: Points) -> Points:
    """``(N, 2, 3)`` lines from the centre to the front of robots that have one."""
    models, fronts = problem.team.robot_models, [shape.outline()[:, 0].max() for shape in problem.team.footprint]
    drives = [(robot, model.heading_index) for robot, model in enumerate(models) if model.heading_index is not None]
    points = np.zeros((len(drives), 2, 3), np.float32)
    for row, (robot, index) in enumerate(drives):
        angle = states[robot, index]
        points[row] = places[robot] + np.array([0, 0, 0.3 * problem.team.radius[robot]])
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
