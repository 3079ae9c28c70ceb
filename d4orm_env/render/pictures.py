"""Pictures with matplotlib: still figures of a trajectory, frames for the environment, and a live window.

Everything is drawn to scale in data coordinates, as polygons and line segments, so that one code draws the plane, a
view of space, and space seen from above. Only figures are used, never pyplot's global state. Robots are told apart by
the Okabe-Ito palette, which colour-blind readers can tell apart too, and larger teams by a perceptually uniform map.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import product
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.registry import backend_registry
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection
from numpy.typing import NDArray

from d4orm_env.core.metrics import arrival_times
from d4orm_env.core.problem import Problem
from d4orm_env.core.trajectory import Trajectory

__all__ = ["FrameRenderer", "WindowRenderer", "plot_trajectory", "save_picture"]

PICTURE_SUFFIXES = (".png", ".svg", ".pdf")

OKABE_ITO = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#000000", "#F0E442")
OBSTACLE, OBSTACLE_EDGE, BOUND, SHADOW, INK = "#C9CDD2", "#6B7280", "#374151", "#D9DCE1", "#1F2937"
CONTACT, MARGIN, CLEAR = "#D0021B", "#F7B6BD", (1.0, 1.0, 1.0, 0.0)

_ANGLES = np.linspace(0, 2 * np.pi, 36, endpoint=False)
_CIRCLE = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=-1)
_DIAMOND = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
_STAR = np.stack([np.sin(np.pi * np.arange(16) / 8), np.cos(np.pi * np.arange(16) / 8)], axis=-1)
_STAR[1::2] *= 0.5
ARRIVED_SHADE = 0.45
_AZIMUTH, _SPATIAL_ELEVATION, _FLAT_ELEVATION = -60.0, 25.0, 45.0

Array = NDArray[Any]


def robot_colors(num_robots: int) -> Array:
    """``(K, 3)`` RGB colours: Okabe-Ito for up to eight robots, a perceptually uniform map for more."""
    if num_robots <= len(OKABE_ITO):
        return np.array([to_rgb(color) for color in OKABE_ITO[:num_robots]])
    return np.asarray(mpl.colormaps["viridis"](np.linspace(0, 0.92, num_robots)))[:, :3]


def picture_palette(num_robots: int, size: int) -> Array:
    """``(size, 3)`` uint8 colours that a picture of the team is made of: every solid one, then blends with white."""
    shades = np.array([1.0, 0.85, 0.65, ARRIVED_SHADE, 0.2])[:, None, None]
    flat = np.array([to_rgb(color) for color in (CONTACT, MARGIN, OBSTACLE, OBSTACLE_EDGE, BOUND, INK, SHADOW)])
    grays = np.repeat(np.linspace(0, 1, 12), 3).reshape(-1, 3)
    robots = robot_colors(num_robots)
    most = (size - len(flat) - len(grays)) // len(shades)
    robots = robots[np.unique(np.linspace(0, num_robots - 1, most).round().astype(int))]
    colors = np.concatenate([flat, grays, (shades * robots + 1 - shades).reshape(-1, 3)])
    return np.resize(np.round(255 * colors), (size, 3)).astype(np.uint8)


def view_limits(problem: Problem, points: Any = ()) -> Array:
    """``(2, d)`` lower and upper corner of what a picture shows [m].

    That is every start, goal, obstacle and further point with some room around them, and the bounds where they are
    near. Neither side of the plane is shown at less than 0.4 of the other.

    Args:
        problem: The problem.
        points: ``(..., d)`` further robot positions that must be in view.
    """
    d, world, reach = problem.dimension, problem.world, float(np.max(problem.team.radius))
    places = np.concatenate([problem.start[:, :d], problem.goal, np.reshape(points, (-1, d))]).astype(np.float64)
    lows, highs = [places.min(axis=0) - reach], [places.max(axis=0) + reach]
    for ball in world.balls:
        lows.append(ball[:d] - ball[d])
        highs.append(ball[:d] + ball[d])
    for cylinder in world.cylinders:
        lows.append(np.append(cylinder[:2] - cylinder[2], lows[0][2]))
        highs.append(np.append(cylinder[:2] + cylinder[2], highs[0][2]))
    for box in world.boxes:
        lows.append(box[:d])
        highs.append(box[d:])
    lower, upper = np.min(lows, axis=0), np.max(highs, axis=0)
    span = float(np.max(upper - lower))
    room = max(1.5 * reach, 0.05 * span)
    bounds = world.bounds.astype(np.float64)
    below = np.where(bounds[0] > lower - 0.3 * span, bounds[0] - 0.25 * room, lower - room)
    above = np.where(bounds[1] < upper + 0.3 * span, bounds[1] + 0.25 * room, upper + room)
    limits = np.stack([np.minimum(lows[0], below), np.maximum(highs[0], above)])
    sides = np.ptp(limits[:, :2], axis=0)
    limits[:, :2] += np.outer([-0.5, 0.5], np.maximum(0.4 * sides.max() - sides, 0))
    return limits


class Panel:
    """One view of the world on one axes: the plane, space, or space seen from above.

    Attributes:
        axes: Where it draws.
        spatial: Whether this is a view of space (mplot3d, orthographic, so that spheres are circles).
        right, up: ``(2,)`` or ``(3,)`` unit vectors that span the plane of the picture.
    """

    def __init__(self, figure: Figure, place: Any, problem: Problem, limits: Array, view: str) -> None:
        self.spatial = view == "space"
        self.limits = limits if self.spatial else limits[:, :2]
        self.axes: Any = figure.add_subplot(place, projection="3d" if self.spatial else None)
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

    def flatten(self, points: Any) -> Array:
        """Points ``(..., d)`` in the coordinates of this panel: ``z`` is dropped in a view from above."""
        return np.asarray(points, np.float64)[..., : len(self.right)]

    def outlines(self, centres: Any, radius: Any, shape: Array = _CIRCLE) -> Array:
        """``(N, vertices, .)`` copies of a shape of unit size, facing the reader."""
        offsets = shape[:, :1] * self.right + shape[:, 1:] * self.up
        corners: Array = self.flatten(centres)[:, None] + np.broadcast_to(radius, len(centres))[:, None, None] * offsets
        return corners

    def polygons(self, vertices: Any, **style: Any) -> Any:
        """Draw filled polygons and return the collection."""
        if self.spatial:
            return self.axes.add_collection3d(Poly3DCollection(vertices, **style), autolim=False)
        return self.axes.add_collection(PolyCollection(vertices, **style), autolim=False)

    def segments(self, paths: Any, **style: Any) -> Any:
        """Draw open paths and return the collection."""
        if self.spatial:
            return self.axes.add_collection3d(Line3DCollection(paths, **style), autolim=False)
        return self.axes.add_collection(LineCollection(paths, **style), autolim=False)


def draw_world(panel: Panel, problem: Problem) -> None:
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
        panel.polygons([box[np.array(corner)] for box in flat for corner in [corners]], **solid)
    if world.lower is not None:
        x, y = world.bounds[:, :2].T
        rectangle = np.array([(x[0], y[0]), (x[1], y[0]), (x[1], y[1]), (x[0], y[1]), (x[0], y[0])])
        if panel.spatial:
            rectangle = np.column_stack([rectangle, np.full(5, panel.limits[0, 2])])
        panel.segments([rectangle], colors=BOUND, linewidths=1.4, zorder=1)


def _draw_solids(panel: Panel, problem: Problem) -> None:
    """The obstacles of a view of space, translucent: nothing may hide behind them."""
    style = {"facecolors": (*to_rgb(OBSTACLE), 0.4), "edgecolors": (*to_rgb(OBSTACLE_EDGE), 0.6), "zorder": 1}
    for *centre, radius in problem.world.spheres:
        panel.polygons(panel.outlines([centre], radius), linewidths=0.8, **style)
        rings = np.stack([np.column_stack([_CIRCLE, 0 * _ANGLES]), np.column_stack([0 * _ANGLES, _CIRCLE])])
        panel.polygons(np.array(centre) + radius * rings, **(style | {"facecolors": "none", "linewidths": 0.4}))
    for x, y, radius in problem.world.cylinders:
        ring = np.array([x, y]) + radius * _CIRCLE
        low, high = (np.column_stack([ring, np.full(len(ring), z)]) for z in panel.limits[:, 2])
        sides = np.stack([low, np.roll(low, 1, axis=0), np.roll(high, 1, axis=0), high], axis=1)
        panel.polygons(sides, **(style | {"edgecolors": "none"}))
        panel.polygons([low, high], linewidths=0.8, **style)
    for box in problem.world.boxes:
        corners = np.array(list(product(*box.reshape(2, 3).T)))
        faces = [(0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5)]
        panel.polygons(corners[np.array(faces)], linewidths=0.8, **style)


class TeamLayer:
    """The robots of one panel: goals, trails, bodies, headings and contacts, drawn once and then moved.

    Attributes:
        artists: The matplotlib artists, in drawing order.
    """

    def __init__(self, panel: Panel, problem: Problem) -> None:
        self.panel, self.problem = panel, problem
        self.colors = robot_colors(problem.num_robots)
        self.radius = np.asarray(problem.team.radius, np.float64)
        self.drives = [k for k, model in enumerate(problem.team.robot_models) if model.heading_index is not None]
        span = float(np.max(panel.limits[1] - panel.limits[0]))
        self.mark_size = float(np.clip(self.radius.mean(), 0.015 * span, 0.03 * span))
        few = problem.num_robots <= 16
        lines, trail = (1.1 if few else 0.7), (1.6 if few else 0.8)
        self.dark = self.colors[self.drives] @ [0.299, 0.587, 0.114] < 0.6
        # One transparent face each: mplot3d sorts edge colours by depth together with the faces, or not at all.
        self.hollow = {"facecolors": [CLEAR] * problem.num_robots, "edgecolors": self.colors}
        empty = np.empty((0, 4, len(panel.right)))
        self.shadows = panel.segments(empty, colors=SHADOW, linewidths=trail, zorder=1.5)
        self.goals = panel.polygons(empty, **self.hollow, linewidths=lines, zorder=3)
        self.trails = panel.segments(empty, colors=self.colors, linewidths=trail, alpha=0.85, zorder=4)
        self.bodies = panel.polygons(empty, facecolors=self.colors, edgecolors=INK, linewidths=0.7, zorder=5)
        self.headings = panel.segments(empty, linewidths=1.6, capstyle="round", zorder=6)
        self.contacts = panel.polygons(empty, facecolors=CONTACT, edgecolors="white", linewidths=0.7, zorder=7)
        self.artists = [self.shadows, self.goals, self.trails, self.bodies, self.headings, self.contacts]

    def update(self, states: Array, arrived: Array, goals: Array, trail: Array, contacts: Array) -> None:
        """Move everything; the shapes are those of :meth:`FrameRenderer.draw`, with ``(N, d)`` contacts."""
        panel, d = self.panel, self.problem.dimension
        positions = states[:, :d]
        paths = panel.flatten(trail).swapaxes(0, 1)
        self.trails.set_segments(paths)
        if panel.spatial:
            floor = panel.limits[0, 2]
            self.shadows.set_segments(np.concatenate([paths[..., :2], np.full_like(paths[..., :1], floor)], axis=-1))
        self.goals.set_verts(panel.outlines(goals, 1.5 * self.radius, _DIAMOND))
        self.bodies.set_verts(panel.outlines(positions, self.radius))
        shade = np.where(arrived[:, None], ARRIVED_SHADE, 1.0)
        self.bodies.set_facecolor(shade * self.colors + 1 - shade)
        self.headings.set_segments(self.heading_lines(states))
        white = self.dark & ~arrived[self.drives]
        self.headings.set_color(["white" if on_dark else INK for on_dark in white])
        self.contacts.set_verts(panel.outlines(contacts, self.mark_size, _STAR))

    def heading_lines(self, states: Array) -> Array:
        """``(., 2, 2)`` lines from the centre to the front of every robot that has a heading."""
        models = self.problem.team.robot_models
        angle = np.array([states[k, models[k].heading_index] for k in self.drives], np.float64)
        front = self.radius[self.drives, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        centre = states[self.drives, :2].astype(np.float64)
        return np.stack([centre, centre + front], axis=1)


def _contact_starts(collided: Array) -> Array:
    """Where in ``(T, K)`` flags a contact begins."""
    starts: Array = collided & ~np.concatenate([np.zeros_like(collided[:1]), collided[:-1]])
    return starts


def contact_points(trajectory: Trajectory) -> list[Array]:
    """For every time, the ``(N, d)`` positions at which a robot has come into contact up to then."""
    starts = _contact_starts(np.asarray(trajectory.collided))
    return [np.asarray(trajectory.positions)[: t + 1][starts[: t + 1]] for t in range(len(starts))]


def checked_trajectory(problem: Problem, trajectory: Trajectory) -> None:
    """Check that a trajectory belongs to a problem of this size.

    Raises:
        ValueError: If the shapes disagree, or a state is not finite.
    """
    shape = np.shape(trajectory.states)
    if len(shape) != 3 or shape[0] < 1 or shape[1:] != (problem.num_robots, problem.state_size):
        raise ValueError(
            f"trajectory has states of shape {shape}; this problem needs (steps + 1, {problem.num_robots}, "
            f"{problem.state_size}): pass the problem that the trajectory solves"
        )
    if not np.isfinite(trajectory.states).all():
        t, robot = (int(i) for i in np.argwhere(~np.isfinite(trajectory.states))[0][:2])
        raise ValueError(f"state of robot_{robot} at step {t} is not finite; roll out finite controls to draw them")


def plot_trajectory(problem: Problem, trajectory: Trajectory, *, title: str | None = None) -> Figure:
    """Draw a whole trajectory, to scale: what the world is, where every robot went, and what went wrong.

    A circle in a robot's colour is its start, a diamond its goal, the filled disc where it ends (paler when it has
    arrived), the line in it the heading of a differential drive. A star marks where a contact begins, a red disc each
    further step of it, a pale red disc each step at which only the margin is violated. Spatial problems get a view of
    space and a view from above.

    Args:
        problem: The problem that the trajectory belongs to.
        trajectory: What to draw.
        title: Title of the figure; by default the problem's name and the outcome, ``""`` for none.

    Returns:
        A figure that belongs to no window; save it with ``figure.savefig`` or display it in a notebook.

    Raises:
        ValueError: If the trajectory does not fit the problem, or is not finite.
    """
    checked_trajectory(problem, trajectory)
    limits = view_limits(problem, trajectory.positions)
    size = limits[1] - limits[0]
    height = float(np.clip(5.4 * size[1] / size[0], 2.6, 7.5))
    spatial = problem.dimension == 3
    figure = Figure(figsize=(11.0 if spatial else 5.8, height + 0.9), layout="constrained")
    layer = None
    for place, view in ((121, "space"), (122, "above")) if spatial else ((111, "plane"),):
        panel = Panel(figure, place, problem, limits, view)
        layer = TeamLayer(panel, problem)
        _draw_history(layer, trajectory)
        if not panel.spatial:
            _number_robots(layer, trajectory, points_per_metre=72 * 4.6 / float(np.max(size[:2])))
    title = _outcome(problem, trajectory) if title is None else title
    if title:
        figure.suptitle(title, fontsize=11)
    spacing = {"columnspacing": 1.4, "handletextpad": 0.1, "fontsize": 8.5, "frameon": False}
    figure.legend(handles=_legend(problem, trajectory), loc="outside lower center", ncols=6, **spacing)
    return figure


def _draw_history(layer: TeamLayer, trajectory: Trajectory) -> None:
    panel, problem = layer.panel, layer.problem
    positions, collided = np.asarray(trajectory.positions), np.asarray(trajectory.collided)
    margin_only = positions[np.asarray(trajectory.margin_violated) & ~collided]
    further = positions[collided & ~_contact_starts(collided)]
    size = 0.5 * layer.mark_size
    panel.polygons(panel.outlines(margin_only, size), facecolors=MARGIN, edgecolors="none", zorder=2)
    panel.polygons(panel.outlines(further, size), facecolors=CONTACT, edgecolors="none", zorder=3.5)
    start = problem.start
    panel.polygons(
        panel.outlines(start[:, : problem.dimension], layer.radius),
        **layer.hollow,
        linewidths=layer.goals.get_linewidth(),
        zorder=2.5,
    )
    panel.segments(layer.heading_lines(start), colors=layer.colors[layer.drives], linewidths=1.2, zorder=2.5)
    contacts = contact_points(trajectory)[-1]
    layer.update(trajectory.states[-1], trajectory.arrived[-1], problem.goal, positions, contacts)


def _number_robots(layer: TeamLayer, trajectory: Trajectory, points_per_metre: float) -> None:
    """Write the robots' numbers into their discs where they fit; a heading line needs the room itself."""
    style: dict[str, Any] = {"color": INK, "ha": "center", "va": "center_baseline", "zorder": 6.5}
    for robot, (x, y) in enumerate(layer.panel.flatten(trajectory.positions[-1])):
        fontsize = min(9.0, points_per_metre * layer.radius[robot])
        if robot not in layer.drives and fontsize >= 4.5:
            layer.panel.axes.text(x, y, str(robot), fontsize=fontsize, **style)


def _outcome(problem: Problem, trajectory: Trajectory) -> str:
    robots, contacts = problem.num_robots, int(np.asarray(trajectory.collided).any(axis=0).sum())
    times = arrival_times(trajectory.arrived, problem.dt)
    arrived = int(np.isfinite(times).sum())
    noun = "robot" if robots == 1 else "robots"
    result = f"all arrived after {times.max():.1f} s" if arrived == robots else f"{arrived} of {robots} arrived"
    return f"{problem.name}, {robots} {noun}: {result}" + (f", {contacts} in contact" if contacts else "")


def _legend(problem: Problem, trajectory: Trajectory) -> list[Line2D]:
    collided = np.asarray(trajectory.collided)
    entries: list[tuple[bool, str, dict[str, Any]]] = [
        (True, "start", {"marker": "o", "mfc": "none", "mec": INK, "ms": 8}),
        (True, "goal", {"marker": "D", "mfc": "none", "mec": INK, "ms": 7}),
        (True, "end", {"marker": "o", "mfc": "#9CA3AF", "mec": INK, "ms": 8}),
        (problem.world.num_obstacles > 0, "obstacle", {"marker": "s", "mfc": OBSTACLE, "mec": OBSTACLE_EDGE, "ms": 8}),
        (bool(collided.any()), "contact", {"marker": (8, 1, 0), "mfc": CONTACT, "mec": CONTACT, "ms": 9}),
        (
            bool((np.asarray(trajectory.margin_violated) & ~collided).any()),
            "margin violated",
            {"marker": "o", "mfc": MARGIN, "mec": MARGIN, "ms": 6},
        ),
    ]
    return [Line2D([], [], linestyle="none", label=label, **style) for shown, label, style in entries if shown]


@contextmanager
def replaced_when_done(path: Path, suffixes: tuple[str, ...]) -> Iterator[Path]:
    """Give a temporary path in the same folder; rename it to ``path`` at the end, or remove it after an error.

    Raises:
        ValueError: If ``path`` does not end in one of the suffixes.
        OSError: If the folder does not exist or cannot be written to, or ``path`` is a folder.
    """
    if path.suffix.lower() not in suffixes:
        raise ValueError(f"{path} ends in {path.suffix!r}; choose one of {', '.join(suffixes)}")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"folder {path.parent} does not exist; create it, or write {path.name} elsewhere")
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder; give the name of a file")
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.{time.monotonic_ns()}{path.suffix}")
    try:
        try:
            temporary.touch(exist_ok=False)
        except OSError as error:
            raise type(error)(f"cannot write to folder {path.parent}: {error.strerror}") from error
        yield temporary
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def save_picture(problem: Problem, trajectory: Trajectory, path: str | Path, *, title: str | None = None) -> Path:
    """Write :func:`plot_trajectory` to a PNG, SVG or PDF file, by its suffix. The same input gives the same bytes.

    Returns:
        The path.

    Raises:
        ValueError: For another suffix, or as :func:`plot_trajectory`.
        OSError: If the folder does not exist or cannot be written to.
    """
    path = Path(path)
    kind = path.suffix.lower()[1:]
    undated: dict[str, dict[str, Any]] = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}
    with replaced_when_done(path, PICTURE_SUFFIXES) as temporary:
        figure = plot_trajectory(problem, trajectory, title=title)
        with mpl.rc_context({"svg.hashsalt": "d4orm", "pdf.fonttype": 42}):
            figure.savefig(temporary, format=kind, dpi=160, metadata=undated.get(kind))
    return path


class FrameRenderer:
    """Draws one moment after another into an image: the environment's ``rgb_array`` mode, and animations.

    The world is drawn once and kept; a frame redraws only what moves.

    Args:
        problem: Team, world, and the starts and goals that the view is fitted to.
        size: Width and height [pixels]. Spatial problems get a view of space, and a view from above beside it where
            the image is at least 1.6 times as wide as high.
        points: ``(..., d)`` further positions that must be in view; the view grows when a robot leaves it.

    Raises:
        ValueError: If the size is below 64 x 64.
    """

    def __init__(self, problem: Problem, size: tuple[int, int] = (480, 480), points: Any = ()) -> None:
        self.problem, self.size = problem, (int(size[0]), int(size[1]))
        if min(self.size) < 64:
            raise ValueError(f"size is {size}; a frame needs at least 64 x 64 pixels")
        self._closed = False
        self._build(view_limits(problem, points))

    def _build(self, limits: Array) -> None:
        width, height = self.size
        scale = float(np.clip(min(width, height) / 480, 0.5, 2.0))
        figure = Figure(figsize=(width / (100 * scale), height / (100 * scale)), dpi=100 * scale)
        self._canvas = FigureCanvasAgg(figure)
        panels = self._panels(figure, limits)
        self._layers = [TeamLayer(panel, self.problem) for panel in panels]
        self._caption = figure.text(0.5, 0.965, "", ha="center", va="center", fontsize=10, color=INK, animated=True)
        for layer in self._layers:
            for artist in layer.artists:
                artist.set_animated(True)
        self._limits = limits
        self._canvas.draw()
        self._background = self._canvas.copy_from_bbox(figure.bbox)

    def _panels(self, figure: Figure, limits: Array) -> list[Panel]:
        if self.problem.dimension == 2:
            places = [("plane", (0.12, 0.1, 0.85, 0.83))]
        elif self.size[0] >= 1.6 * self.size[1]:
            places = [("space", (0.015, 0.04, 0.44, 0.84)), ("above", (0.57, 0.1, 0.42, 0.83))]
        else:
            places = [("space", (0.01, 0.04, 0.86, 0.86))]
        panels = []
        for view, rectangle in places:
            panel = Panel(figure, 111, self.problem, limits, view)
            panel.axes.set_position(rectangle)
            panels.append(panel)
        return panels

    def draw(
        self,
        states: Any,
        arrived: Any,
        collided: Any,
        goals: Any = None,
        trail: Any = None,
        *,
        contacts: Any = (),
        caption: str | None = None,
    ) -> NDArray[np.uint8]:
        """Draw one moment.

        Args:
            states: ``(K, n)``.
            arrived: ``(K,)`` bool; these robots are drawn paler.
            collided: ``(K,)`` bool; these robots get a star.
            goals: ``(K, d)`` where they differ from the problem's.
            trail: ``(T, K, d)`` positions up to now, oldest first.
            contacts: ``(N, d)`` further points to mark with a star, such as earlier contacts.
            caption: Text above the picture; by default how many robots have arrived.

        Returns:
            ``(height, width, 3)`` image, the caller's own.

        Raises:
            ValueError: If the states have another shape or are not finite.
            RuntimeError: After :meth:`close`.
        """
        if self._closed:
            raise RuntimeError("this renderer is closed; make a new one to draw again")
        states, d = np.asarray(states), self.problem.dimension
        arrived, collided = np.asarray(arrived, bool), np.asarray(collided, bool)
        expected = (self.problem.num_robots, self.problem.state_size)
        if states.shape != expected or not np.isfinite(states).all():
            raise ValueError(f"states must be finite and of shape (K, n) = {expected}; these have {states.shape}")
        goals = self.problem.goal if goals is None else np.asarray(goals)
        trail = np.empty((0, len(states), d)) if trail is None else np.asarray(trail)
        contacts = np.concatenate([np.reshape(contacts, (-1, d)), states[collided, :d]])
        self._keep_in_view(np.concatenate([states[:, :d], goals]))
        for layer in self._layers:
            layer.update(states, arrived, goals, trail, contacts)
        self._caption.set_text(f"arrived {arrived.sum()} of {len(arrived)}" if caption is None else caption)
        return self._paint()

    def _keep_in_view(self, places: Array) -> None:
        reach = np.max(self.problem.team.radius)
        lower, upper = places.min(axis=0) - reach, places.max(axis=0) + reach
        if (lower < self._limits[0]).any() or (upper > self._limits[1]).any():
            room = 0.15 * (self._limits[1] - self._limits[0])
            self._build(
                np.stack(
                    [
                        np.where(lower < self._limits[0], lower - room, self._limits[0]),
                        np.where(upper > self._limits[1], upper + room, self._limits[1]),
                    ]
                )
            )

    def _paint(self) -> NDArray[np.uint8]:
        self._canvas.restore_region(self._background)
        for layer in self._layers:
            for artist in layer.artists:
                if layer.panel.spatial:
                    artist.do_3d_projection()
                layer.panel.axes.draw_artist(artist)
        self._canvas.figure.draw_artist(self._caption)
        return np.array(self._canvas.buffer_rgba())[..., :3].copy()

    def close(self) -> None:
        """Let go of the figure. Closing twice is fine."""
        if not self._closed:
            self._closed = True
            del self._canvas, self._layers, self._caption, self._background


class WindowRenderer:
    """Shows the frames of a :class:`FrameRenderer` in a window, at the pace of the problem's time step.

    The window is that of matplotlib's backend. Without a display that backend draws to memory only, and so does this:
    frames are made, and no window opens.

    Args:
        problem: As for :class:`FrameRenderer`.
        size: As for :class:`FrameRenderer`.
    """

    def __init__(self, problem: Problem, size: tuple[int, int] = (480, 480)) -> None:
        self._frames = FrameRenderer(problem, size)
        self._period = problem.dt
        self._manager: Any = None
        self._image: Any = None
        self._last = -np.inf
        self._open_window(problem, size)

    @property
    def has_window(self) -> bool:
        """Whether there is a window: not without a display, nor after the user closed it."""
        return self._manager is not None

    def _open_window(self, problem: Problem, size: tuple[int, int]) -> None:
        canvas_class = backend_registry.load_backend_module(mpl.get_backend()).FigureCanvas
        if not canvas_class.required_interactive_framework:
            return
        figure = Figure(figsize=(size[0] / 100, size[1] / 100), dpi=100)
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
        axes.set_axis_off()
        self._image = axes.imshow(np.full((size[1], size[0], 3), 255, np.uint8))
        self._manager = canvas_class.new_manager(figure, 1)
        self._manager.set_window_title(f"d4orm: {problem.name}")
        self._manager.canvas.mpl_connect("close_event", self._forget_window)
        self._manager.show()

    def _forget_window(self, event: Any) -> None:
        self._manager = None

    def draw(
        self, states: Any, arrived: Any, collided: Any, goals: Any = None, trail: Any = None, **marks: Any
    ) -> NDArray[np.uint8]:
        """Draw one moment as :meth:`FrameRenderer.draw` does, show it, and wait until it is time for the next."""
        frame = self._frames.draw(states, arrived, collided, goals, trail, **marks)
        if self._manager is not None:
            canvas = self._manager.canvas
            self._image.set_data(frame)
            canvas.draw()
            canvas.start_event_loop(max(1e-3, self._period - (time.monotonic() - self._last)))
            self._last = time.monotonic()
        return frame

    def close(self) -> None:
        """Close the window. Closing twice is fine."""
        self._frames.close()
        if self._manager is not None:
            manager, self._manager = self._manager, None
            manager.destroy()
