"""A session's frames as shapes of a viser page: what is there, where it is, and what is dragged."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import trimesh
import viser
from numpy.typing import NDArray

from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.problem import Problem
from d4orm_env.render.panels import robot_colors, view_limits
from d4orm_planners.play import edits
from d4orm_planners.play.frame import Frame
from d4orm_planners.play.session import Session

CONTACT, OBSTACLE, BOUND, MARGIN = (208, 2, 27), (150, 156, 166), (90, 98, 110), (200, 60, 60)
INK, NOTHING = (20, 24, 30), np.zeros((0, 2, 3), np.uint8)
TRAIL_STEPS = 30
"""Steps that a robot's trail goes back."""

LINES_EVERY = 0.1
"""Seconds between new trails and plans."""

Points = NDArray[np.float32]


class View:
    """Shapes on the page.

    Args:
        server: The page.
        session: What is shown, and changed by dragging.

    Attributes:
        shown: Which of ``"plans"``, ``"trails"``, ``"subgoals"`` and ``"margins"`` are shown.
    """

    def __init__(self, server: viser.ViserServer, session: Session) -> None:
        self._server, self._session = server, session
        self.shown = {"plans": True, "trails": True, "subgoals": False, "margins": False}
        self._generation, self._number, self._lines_at = -1, -1, 0.0
        self._nodes: dict[str, Any] = {}
        self._held: dict[tuple[str, int], Points] = {}
        self._trail: list[FloatArray] = []

    def update(self, frame: Frame) -> None:
        """Show a frame, where the robots are by now."""
        if frame.generation != self._generation:
            self._rebuild(frame)
        now = time.perf_counter()
        if frame.number != self._number:
            self._number = frame.number
            self._trail = [*self._trail[-TRAIL_STEPS:], frame.states[:, : frame.problem.dimension]]
            self._color(frame)
        places = self._with_held("robot", in_space(frame.positions(now)))
        with self._server.atomic():  # what has not changed is not sent
            self._nodes["robots"].batched_positions = places
            self._nodes["heading"].points = self._headings(frame, places)
            self._nodes["goals"].batched_positions = self._with_held("goal", in_space(frame.goals))
            self._nodes["margins"].visible = self.shown["margins"]
            self._nodes["subgoals"].visible = self.shown["subgoals"] and frame.subgoals is not None
            if frame.subgoals is not None:
                self._nodes["subgoals"].batched_positions = in_space(frame.subgoals)
            if self.shown["margins"]:
                self._nodes["margins"].batched_positions = places
            if now - self._lines_at > LINES_EVERY:
                self._lines_at = now
                self._draw_lines(frame)

    def _with_held(self, kind: str, places: Points) -> Points:
        """Places with those that somebody drags at the pointer."""
        for (what, index), place in list(self._held.items()):
            if what == kind and index < len(places):
                places[index] = place
        return places

    def _rebuild(self, frame: Frame) -> None:
        """Make all shapes anew."""
        problem, scene = frame.problem, self._server.scene
        with self._server.atomic():
            for node in self._nodes.values():
                node.remove()
            self._nodes, self._trail = {}, []
            self._held.clear()
            self._colors = 255 * robot_colors(problem.num_robots)
            self._add_team(problem, in_space(frame.states[:, : problem.dimension]), in_space(frame.goals))
            self._add_world(problem)
            for name, colors in (("heading", INK), ("plans", NOTHING), ("trails", NOTHING)):
                self._nodes[name] = scene.add_line_segments(
                    f"/{name}", np.zeros((0, 2, 3), np.float32), colors,
                    thickness=2.0, thickness_units="screen",
                )  # fmt: skip
        self._generation, self._number = frame.generation, -1

    def _add_team(self, problem: Problem, places: Points, goals: Points) -> None:
        scene, radius = self._server.scene, np.asarray(problem.team.radius, np.float32)
        flat = problem.dimension == 2
        body = trimesh.creation.cylinder(1.0, 1.0, sections=32) if flat else trimesh.creation.icosphere(subdivisions=2)
        diamond = (
            trimesh.creation.cylinder(1.5, 0.2, sections=4) if flat else trimesh.creation.icosphere(subdivisions=0)
        )
        height = np.where(flat, 0.5, 1.0) * radius
        upright = np.tile(np.array([1, 0, 0, 0], np.float32), (len(radius), 1))
        mark = radius if flat else np.float32(1.4) * radius
        shapes = {"robots": (body, radius, height, 1.0), "goals": (diamond, mark, mark, 0.6 if flat else 0.35)}
        shapes["margins"] = (body, radius + np.float32(problem.margin), 0.2 * height if flat else height, 0.25)
        dot = np.float32(0.35) * radius
        shapes["subgoals"] = (trimesh.creation.icosphere(subdivisions=1), dot, dot, 0.9)
        for name, (mesh, wide, high, opacity) in shapes.items():
            self._nodes[name] = scene.add_batched_meshes_simple(
                f"/{name}", np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.uint32), upright,
                goals if name == "goals" else places, batched_scales=np.stack([wide, wide, high], axis=1),
                batched_colors=_linear(np.array(MARGIN) if name == "margins" else self._colors),
                opacity=opacity, flat_shading=flat, lod="off", cast_shadow=False, receive_shadow=False,
            )  # fmt: skip
        self._drag("robots", "robot", lambda index, place, _: lambda problem: edits.move_robot(problem, index, place))
        self._drag("goals", "goal", lambda index, place, _: lambda problem: edits.move_goal(problem, index, place))

    def _add_world(self, problem: Problem) -> None:
        scene, low = self._server.scene, view_limits(problem)
        floor, top = (low[0, 2], low[1, 2]) if problem.dimension == 3 else (0.0, 0.3)
        for kind in ("circles", "spheres", "cylinders", "boxes", "polygons"):
            for index, shape in enumerate(getattr(problem.world, kind)):
                mesh, centre = _solid(kind, np.asarray(shape, np.float64), problem.dimension, float(floor), float(top))
                name = f"{kind}_{index}"
                self._nodes[name] = scene.add_mesh_simple(
                    f"/{name}", np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.uint32),
                    color=OBSTACLE, opacity=None if problem.dimension == 2 else 0.6, flat_shading=True,
                    position=centre, cast_shadow=False, receive_shadow=False, side="double",
                )  # fmt: skip
                self._drag(name, name, _mover(kind, index))
        if problem.world.lower is not None:
            self._nodes["bounds"] = scene.add_line_segments(
                "/bounds", _edges(in_space(problem.world.bounds)), BOUND, thickness=2.0, thickness_units="screen"
            )

    def _drag(self, name: str, kind: str, edit: Callable[[int, FloatArray, FloatArray], edits.Edit]) -> None:
        """Let a shape be dragged: it follows the pointer, and where it is let go the scene is changed."""
        node = self._nodes[name]
        grips: dict[int, tuple[Points, Points]] = {}

        @node.on_drag("left")
        def _(event: Any) -> None:
            index, frame = event.instance_index or 0, self._session.frame
            if event.phase == "start":
                at = self._place_of(kind, index, frame)
                grips[index] = (at, self._pointed(event, at))
            if index not in grips:
                return
            at, grip = grips[index]
            moved = at + self._pointed(event, at) - grip
            if event.phase != "end":
                self._held[kind, index] = moved
                if kind not in ("robot", "goal"):
                    node.position = moved
                return
            del grips[index]
            self._held.pop((kind, index), None)
            if kind not in ("robot", "goal"):
                node.position = at  # until the session has agreed
            d = frame.problem.dimension
            self._session.edit(edit(index, moved[:d], (moved - at)[:d]))

    def _place_of(self, kind: str, index: int, frame: Frame) -> Points:
        if kind == "robot":
            return in_space(frame.positions(time.perf_counter()))[index]
        if kind == "goal":
            return in_space(frame.goals)[index]
        return np.asarray(self._nodes[kind].position, np.float32)

    def _pointed(self, event: Any, at: Points) -> Points:
        """Where the pointer is: on the plane that planar robots drive on, or as far from the camera as the shape."""
        end = np.asarray(event.end_position, np.float64)
        if self._session.frame.problem.dimension == 3:
            return end.astype(np.float32)
        eye = np.asarray(event.client.camera.position, np.float64)
        ray = end - eye
        if abs(ray[2]) < 1e-9:
            return end.astype(np.float32)
        return (eye + (at[2] - eye[2]) / ray[2] * ray).astype(np.float32)

    def _color(self, frame: Frame) -> None:
        """Red in contact, paler when arrived."""
        colors = np.where(frame.arrived[:, None], 255 - 0.5 * (255 - self._colors), self._colors)
        colors = np.where(frame.collided[:, None], np.array(CONTACT), colors)
        self._nodes["robots"].batched_colors = _linear(colors)

    def _draw_lines(self, frame: Frame) -> None:
        nothing = np.zeros((0, 2, 3), np.float32), NOTHING
        trail = np.stack(self._trail) if len(self._trail) > 1 else None
        lines = {
            "trails": nothing if trail is None or not self.shown["trails"] else self._polylines(trail, fading=True),
            "plans": nothing,
        }
        if frame.guidance is not None and len(frame.guidance) > 1 and self.shown["plans"]:
            lines["plans"] = self._polylines(frame.guidance, fading=False)
        for name, (points, colors) in lines.items():
            self._nodes[name].points, self._nodes[name].colors = points, colors

    def _polylines(self, path: FloatArray, fading: bool) -> tuple[Points, NDArray[np.uint8]]:
        """``(N, 2, 3)`` segments along ``(T, K, d)`` and their colours: paler the older, or pale all along."""
        places = in_space(path)
        points = np.stack([places[:-1], places[1:]], axis=2)
        share = np.linspace(0.2, 1.0, len(points)) if fading else np.full(len(points), 0.6)
        colors = 255 - share[:, None, None] * (255 - self._colors)
        both = np.repeat(np.broadcast_to(colors, (*points.shape[:2], 3))[:, :, None], 2, axis=2)
        return points.reshape(-1, 2, 3), _linear(both.reshape(-1, 2, 3))

    def _headings(self, frame: Frame, places: Points) -> Points:
        """``(N, 2, 3)`` lines from the centre to the front of robots that have one."""
        models, radius = frame.problem.team.robot_models, np.asarray(frame.problem.team.radius)
        drives = [(robot, model.heading_index) for robot, model in enumerate(models) if model.heading_index is not None]
        points = np.zeros((len(drives), 2, 3), np.float32)
        for row, (robot, index) in enumerate(drives):
            angle = frame.states[robot, index]
            points[row] = places[robot] + np.array([0, 0, radius[robot]])
            points[row, 1, :2] += radius[robot] * np.array([np.cos(angle), np.sin(angle)])
        return points


def look_at(server: viser.ViserServer, problem: Problem) -> None:
    """Show all of a scene: from above in the plane, from the side in space."""
    limits = in_space(view_limits(problem))
    centre, size = limits.mean(axis=0), float(np.ptp(limits, axis=0).max())
    flat = problem.dimension == 2
    if flat:
        centre[0] += 0.15 * size  # the controls lie on the right
    eye = centre + size * (np.array([0, 0, 1.9]) if flat else np.array([1.0, -1.3, 0.9]))
    up = (0.0, 1.0, 0.0) if flat else (0.0, 0.0, 1.0)
    server.scene.set_up_direction(up)
    camera = server.initial_camera
    camera.position, camera.look_at, camera.up, camera.fov = eye, centre, up, np.deg2rad(35)
    for client in server.get_clients().values():
        client.camera.up_direction = up
        client.camera.position, client.camera.look_at = eye, centre


def in_space(points: Any) -> Points:
    """Points ``(..., d)`` as new ones ``(..., 3)``."""
    given = np.asarray(points, np.float32)
    places = np.zeros((*given.shape[:-1], 3), np.float32)
    places[..., : given.shape[-1]] = given
    return places


def _linear(colors: NDArray[Any]) -> NDArray[np.uint8]:
    """Colours as the page reads those of many things at once: proportional to the light."""
    return np.round(255 * (colors / 255) ** 2.2).astype(np.uint8)


def _mover(kind: str, index: int) -> Callable[[int, FloatArray, FloatArray], edits.Edit]:
    return lambda _, place, shift: lambda problem: edits.move_obstacle(problem, kind, index, shift)


def _solid(kind: str, shape: NDArray[np.float64], dimension: int, floor: float, top: float) -> tuple[Any, Points]:
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
    from d4orm_env.core.polygon import triangulate

    count, top = len(corners), np.array(triangulate(corners.astype(np.float32)))
    ring = np.arange(count)
    after = np.roll(ring, -1)
    walls = np.concatenate(
        [np.stack([ring, after, after + count], 1), np.stack([ring, after + count, ring + count], 1)]
    )
    vertices = np.concatenate([np.column_stack([corners, np.full(count, z)]) for z in (-tall / 2, tall / 2)])
    return trimesh.Trimesh(vertices, np.concatenate([top, top + count, walls]), process=False)


def _edges(bounds: Points) -> Points:
    """``(N, 2, 3)`` the edges of the box between two corners; of the rectangle where it is flat."""
    corners = np.array([[bounds[(i >> axis) & 1, axis] for axis in range(3)] for i in range(8)], np.float32)
    pairs = [(i, i | 1 << axis) for axis in range(3) for i in range(8) if not i & 1 << axis]
    segments = corners[np.array(pairs)]
    return segments[np.linalg.norm(segments[:, 0] - segments[:, 1], axis=1) > 0]
