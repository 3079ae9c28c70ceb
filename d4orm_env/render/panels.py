"""Drawing primitives: a panel in data coordinates, the world, and the team on it.

Everything is drawn to scale, as polygons and line segments, so that one code draws the plane, a view of space, and
space seen from above. Robots are told apart by a list of colours that begins with Okabe and Ito's, which colour-blind
readers can tell apart too, and goes on with what differs most in OKLab from all before it, from white and from the red
of contacts. Only matplotlib figures are used, never pyplot's global state.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import hsv_to_rgb, to_rgb
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection
from numpy.typing import ArrayLike

from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team

ROBOTS = (
    "#0072B2", "#D98E00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#000000", "#8F8A00",
    "#9600FF", "#00C300", "#690000", "#FF00E1", "#004B00", "#2D78FF", "#784B00", "#2D0087",
    "#FF6978", "#96B487", "#780078", "#F078FF", "#003C78", "#A5785A", "#0000FF", "#963C5A",
    "#2D7800", "#9678F0", "#FF0F87", "#694B96", "#B4A5E1", "#B43CC3", "#5A3CD2", "#D200FF",
)  # fmt: skip
OBSTACLE, OBSTACLE_EDGE, BOUND, SHADOW, INK = "#C9CDD2", "#6B7280", "#374151", "#D9DCE1", "#1F2937"
PUSH, BODY = "#7C3AED", "#4B5563"
CONTACT, MARGIN, CLEAR = "#D0021B", "#F7B6BD", (1.0, 1.0, 1.0, 0.0)

_ANGLES = np.linspace(0, 2 * np.pi, 36, endpoint=False)
_CIRCLE = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=-1)
_DIAMOND = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
_STAR = np.stack([np.sin(np.pi * np.arange(16) / 8), np.cos(np.pi * np.arange(16) / 8)], axis=-1)
_STAR[1::2] *= 0.5
ARRIVED_SHADE = 0.45
_AZIMUTH, _SPATIAL_ELEVATION, _FLAT_ELEVATION = -60.0, 25.0, 45.0

Array = np.ndarray


def robot_colors(num_robots: int) -> Array:
    """``(K, 3)`` RGB colours, all at least 2.2 : 1 in contrast with white up to 32 robots; turns of the hue beyond."""
    further = np.arange(max(num_robots - len(ROBOTS), 0))
    # The golden section of a turn, and three lightnesses: neighbours differ in both.
    hues = np.stack([0.618034 * further % 1, np.ones(len(further)), 0.45 + 0.2 * (further % 3)], axis=1)
    return np.concatenate([[to_rgb(color) for color in ROBOTS[:num_robots]], hsv_to_rgb(hues)])


def picture_palette(num_robots: int, size: int) -> Array:
    """``(size, 3)`` uint8 colours that a picture of the team is made of: every solid one, then blends with white."""
    shades = np.array([1.0, 0.85, 0.65, ARRIVED_SHADE, 0.2])[:, None, None]
    flat = np.array(
        [to_rgb(color) for color in (CONTACT, MARGIN, OBSTACLE, OBSTACLE_EDGE, BOUND, INK, SHADOW, PUSH, BODY)]
    )
    grays = np.repeat(np.linspace(0, 1, 12), 3).reshape(-1, 3)
    robots = robot_colors(num_robots)
    most = (size - len(flat) - len(grays)) // len(shades)
    robots = robots[np.unique(np.linspace(0, num_robots - 1, most).round().astype(int))]
    colors = np.concatenate([flat, grays, (shades * robots + 1 - shades).reshape(-1, 3)])
    return np.resize(np.round(255 * colors), (size, 3)).astype(np.uint8)


def view_limits(problem: Problem, points: ArrayLike = ()) -> Array:
    """``(2, d)`` lower and upper corner of what a picture shows [m].

    That is every start, goal, obstacle and further robot position ``(..., d)`` with some room around them, and the
    bounds where they are near. Neither side of the plane is shown at less than 0.4 of the other.
    """
    d, world, radius = problem.dimension, problem.world, float(np.max(problem.team.radius))
    positions = np.concatenate([problem.start[:, :d], problem.goal, np.reshape(points, (-1, d))]).astype(np.float64)
    nearest, farthest = positions.min(axis=0) - radius, positions.max(axis=0) + radius
    corners = np.where(np.isfinite(every := np.stack(world.shapes.corners())), every, nearest)
    lower, upper = corners[0].min(axis=0, initial=np.inf), corners[1].max(axis=0, initial=-np.inf)
    lower, upper = np.minimum(lower, nearest), np.maximum(upper, farthest)
    span = float(np.max(upper - lower))
    room = max(1.5 * radius, 0.05 * span)
    bounds = world.bounds.astype(np.float64)
    below = np.where(bounds[0] > lower - 0.3 * span, bounds[0] - 0.25 * room, lower - room)
    above = np.where(bounds[1] < upper + 0.3 * span, bounds[1] + 0.25 * room, upper + room)
    limits = np.stack([np.minimum(nearest, below), np.maximum(farthest, above)])
    sides = np.ptp(limits[:, :2], axis=0)
    limits[:, :2] += np.outer([-0.5, 0.5], np.maximum(0.4 * sides.max() - sides, 0))
    return limits


def make_axes(figure: Figure, position: int, view: str) -> Axes:
    """Axes of a figure for a view: ``"space"``, or flat for ``"plane"`` and ``"above"``."""
    return figure.add_subplot(position, projection="3d" if view == "space" else None)


class Axes2D:
    """One view of the world on one axes: the plane, space, or space seen from above.

    Args:
        axes: Axes to draw on: flat, or ``projection="3d"`` for a view of space.
        problem: Problem of the world.
        limits: ``(2, d)`` corners of what is shown, see :func:`view_limits`.

    Attributes:
        axes: Axes to draw on.
        spatial: Whether this is a view of space (mplot3d, orthographic, so that spheres are circles).
        right: ``(2,)`` or ``(3,)`` unit vector in the plane of the picture.
        up: The other one.
    """

    def __init__(self, axes: Any, problem: Problem, limits: Array) -> None:
        self.axes, self.spatial = axes, axes.name == "3d"
        self.limits = limits if self.spatial else limits[:, :2]
        if self.spatial:
            self._look_at_space()
        else:
            self.right, self.up = np.eye(2)
            self.axes.set(xlim=self.limits[:, 0], ylim=self.limits[:, 1], aspect="equal")
        self.axes.set(xlabel="x [m]", ylabel="y [m]")
        self.axes.tick_params(labelsize=8, color=BOUND)
        draw_world(self, problem)

    def _look_at_space(self) -> None:
        axes, size = self.axes, self.limits[1] - self.limits[0]
        degrees = _SPATIAL_ELEVATION if size[2] > 0.5 * size[:2].max() else _FLAT_ELEVATION
        elevation, azimuth = np.deg2rad([degrees, _AZIMUTH])
        self.right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        self.up = np.array(
            [-np.sin(elevation) * np.cos(azimuth), -np.sin(elevation) * np.sin(azimuth), np.cos(elevation)]
        )
        axes.set_proj_type("ortho")
        axes.view_init(elev=degrees, azim=_AZIMUTH)
        axes.set(xlim=self.limits[:, 0], ylim=self.limits[:, 1], zlim=self.limits[:, 2])
        flat = degrees == _FLAT_ELEVATION
        axes.set_box_aspect(size, zoom=1.0 if flat else 0.9)
        axes.locator_params(axis="z", nbins=max(2, round(6 * size[2] / size[:2].max())))
        if flat:  # a label would lie on the ticks of so short an axis
            axes.zaxis.set_major_formatter("{x:g} m")
        else:
            axes.set_zlabel("z [m]")
        axes.computed_zorder = False
        for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
            axis.set_pane_color((0.97, 0.97, 0.98, 1.0))
            axis._axinfo["grid"].update(color="#E5E7EB", linewidth=0.6)

    def flatten(self, points: Array) -> Array:
        """Points ``(..., d)`` in the coordinates of this panel: ``z`` is dropped in a view from above."""
        return np.asarray(points, np.float64)[..., : len(self.right)]

    def outlines(self, centres: Array, radius: Array | float, shape: Array = _CIRCLE) -> Array:
        """``(N, vertices, .)`` copies of a shape of unit size, facing the reader."""
        offsets = shape[:, :1] * self.right + shape[:, 1:] * self.up
        return self.flatten(centres)[:, None] + np.broadcast_to(radius, len(centres))[:, None, None] * offsets

    def polygons(self, vertices: Sequence[Array] | Array, **style: Any) -> Any:
        """Draw filled polygons and return the collection."""
        if self.spatial:
            return self.axes.add_collection3d(Poly3DCollection(vertices, **style), autolim=False)
        return self.axes.add_collection(PolyCollection(list(vertices), **style), autolim=False)

    def segments(self, paths: Sequence[Array] | Array, **style: Any) -> Any:
        """Draw open paths and return the collection."""
        if self.spatial:
            return self.axes.add_collection3d(Line3DCollection(paths, **style), autolim=False)
        return self.axes.add_collection(LineCollection(list(paths), **style), autolim=False)


def draw_world(panel: Axes2D, problem: Problem) -> None:
    """Obstacles and bounds."""
    world = problem.world
    solid = {"facecolors": OBSTACLE, "edgecolors": OBSTACLE_EDGE, "linewidths": 0.8, "zorder": 1}
    if panel.spatial:
        _draw_solids(panel, problem)
    else:
        for discs in (world.balls, world.cylinders):
            panel.polygons(panel.outlines(discs[:, :2], discs[:, -1]), **solid)
        corners = [(0, 1), (2, 1), (2, 3), (0, 3)]
        flat = world.boxes[:, [0, 1, problem.dimension, problem.dimension + 1]]
        panel.polygons([*(box[np.array(corners)] for box in flat), *world.polygons], **solid)
    if world.lower is not None:
        x, y = world.bounds[:, :2].T
        rectangle = np.array([(x[0], y[0]), (x[1], y[0]), (x[1], y[1]), (x[0], y[1]), (x[0], y[0])])
        if panel.spatial:
            rectangle = np.column_stack([rectangle, np.full(5, panel.limits[0, 2])])
        panel.segments([rectangle], colors=BOUND, linewidths=1.4, zorder=1)


def _draw_solids(panel: Axes2D, problem: Problem) -> None:
    """The obstacles of a view of space, translucent: nothing may hide behind them."""
    style = {"facecolors": (*to_rgb(OBSTACLE), 0.4), "edgecolors": (*to_rgb(OBSTACLE_EDGE), 0.6), "zorder": 1}
    faces: list[Array] = []
    rings: list[Array] = []
    sides: list[Array] = []
    planes = np.stack([np.column_stack([_CIRCLE, 0 * _ANGLES]), np.column_stack([0 * _ANGLES, _CIRCLE])])
    for *centre, radius in problem.world.spheres:
        faces.extend(panel.outlines(np.array([centre]), radius))
        rings.extend(np.array(centre) + radius * planes)
    for x, y, radius in problem.world.cylinders:
        ring = np.array([x, y]) + radius * _CIRCLE
        low, high = (np.column_stack([ring, np.full(len(ring), z)]) for z in panel.limits[:, 2])
        sides.extend(np.stack([low, np.roll(low, 1, axis=0), np.roll(high, 1, axis=0), high], axis=1))
        faces += [low, high]
    corners = [(0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5)]
    for box in problem.world.boxes:
        faces.extend(np.array(list(product(*box.reshape(2, 3).T)))[np.array(corners)])
    panel.polygons(sides, **(style | {"edgecolors": "none"}))
    panel.polygons(faces, linewidths=0.8, **style)
    panel.polygons(rings, **(style | {"facecolors": "none", "linewidths": 0.4}))


def _front_radius(team: Team) -> Array:
    """``(K,)`` radii of the discs round the robots, without trailers [m]."""
    if not team.shapes or team.dimension == 3:
        return np.asarray(team.radius, np.float64)
    fronts = team.bodies[: team.num_robots]
    return np.array([np.linalg.norm(body.footprint.outline(), axis=1).max() for body in fronts])


def _rays(begin: Array, angle: Array, length: Array) -> Array:
    """``(N, 2, 2)`` lines in the plane from points ``(N, .)``, in directions ``(N,)`` [rad]."""
    begin = begin[:, :2].astype(np.float64)
    return np.stack([begin, begin + length[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)], axis=1)


class TeamLayer:
    """The robots of one panel: goals, trails, bodies, headings of both, contacts, drawn once and then moved.

    Attributes:
        artists: The matplotlib artists, in drawing order.
    """

    def __init__(self, panel: Axes2D, problem: Problem) -> None:
        self.panel, self.problem = panel, problem
        self.colors = robot_colors(problem.num_robots)
        self.radius = _front_radius(problem.team)
        self.drives = [k for k, model in enumerate(problem.team.robot_models) if model.heading_index is not None]
        span = float(np.max(panel.limits[1] - panel.limits[0]))
        self.mark_size = float(np.clip(self.radius.mean(), 0.015 * span, 0.03 * span))
        few = problem.num_robots <= 32
        lines, trail = (1.1 if few else 0.7), (1.6 if few else 0.8)
        self.dark = self.colors[self.drives] @ [0.299, 0.587, 0.114] < 0.6
        # One transparent face each: mplot3d sorts edge colours by depth together with the faces, or not at all.
        self.hollow = {"facecolors": [CLEAR] * problem.num_robots, "edgecolors": self.colors}
        self.robots = [body.robot for body in problem.team.bodies]
        empty = np.empty((0, 4, len(panel.right)))
        self.shadows = panel.segments(empty, colors=SHADOW, linewidths=trail, zorder=1.5)
        self.goals = panel.polygons(empty, **self.hollow, linewidths=lines, zorder=3)
        self.headed = np.flatnonzero(~np.isnan(problem.goal_heading))
        self.goal_headings = panel.segments(empty, colors=self.colors[self.headed], linewidths=1.5 * lines, zorder=3)
        self.trails = panel.segments(empty, colors=self.colors, linewidths=trail, alpha=0.85, zorder=4)
        self.bodies = panel.polygons(empty, facecolors=self.colors, edgecolors=INK, linewidths=0.7, zorder=5)
        self.headings = panel.segments(empty, linewidths=1.6, capstyle="round", zorder=6)
        self.contacts = panel.polygons(empty, facecolors=CONTACT, edgecolors="white", linewidths=0.7, zorder=7)
        self.artists = [
            self.shadows, self.goals, self.goal_headings, self.trails, self.bodies, self.headings, self.contacts
        ]  # fmt: skip

    def update(self, states: Array, arrived: Array, goals: Array, trail: Array, contacts: Array) -> None:
        """Move everything; the shapes are those of :meth:`FrameRenderer.draw`, with ``(N, d)`` contacts."""
        panel = self.panel
        paths = panel.flatten(trail).swapaxes(0, 1)
        self.trails.set_segments(paths)
        if panel.spatial:
            floor = panel.limits[0, 2]
            self.shadows.set_segments(np.concatenate([paths[..., :2], np.full_like(paths[..., :1], floor)], axis=-1))
        self.goals.set_verts(panel.outlines(goals, 1.5 * self.radius, _DIAMOND))
        angle = self.problem.goal_heading[self.headed].astype(np.float64)
        self.goal_headings.set_segments(_rays(goals[self.headed], angle, 2 * self.radius[self.headed]))
        self.bodies.set_verts(self.body_outlines(states))
        shade = np.where(arrived[:, None], ARRIVED_SHADE, 1.0)
        self.bodies.set_facecolor((shade * self.colors + 1 - shade)[self.robots])
        self.headings.set_segments(self.heading_lines(states))
        white = self.dark & ~arrived[self.drives]
        self.headings.set_color(["white" if on_dark else INK for on_dark in white])
        self.contacts.set_verts(panel.outlines(contacts, self.mark_size, _STAR))

    def body_outlines(self, states: Array) -> Array:
        """``(F, vertices, .)`` outlines of the bodies in states ``(K, n)``; in space ellipsoids face the reader."""
        team, panel = self.problem.team, self.panel
        positions = states[:, : team.dimension]
        if not team.shapes:
            return panel.outlines(positions, self.radius)
        if team.dimension == 3:
            balls = panel.outlines(np.zeros_like(positions), 1.0)
            sizes = panel.flatten(team.all_footprint_arrays.semi_axes)
            return panel.flatten(positions)[:, None] + balls * sizes[:, None]
        poses = team.body_poses(states)
        x, y = np.moveaxis(np.stack([body.footprint.outline() for body in team.bodies]), 2, 0)
        cosine, sine = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
        return panel.flatten(poses[:, :2])[:, None] + np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)

    def heading_lines(self, states: Array) -> Array:
        """``(., 2, 2)`` lines from the centre to the front of every robot that has a heading."""
        models = self.problem.team.robot_models
        angle = np.array([states[k, models[k].heading_index] for k in self.drives], np.float64)
        return _rays(states[self.drives, :2], angle, self.radius[self.drives])
