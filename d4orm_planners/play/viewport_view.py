"""The shapes of one team and its world on the page, and what dragging them does."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any, Literal, TypeAlias

import numpy as np
import trimesh
import viser
from numpy.typing import NDArray

from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.problem import Problem
from d4orm_env.render.panels import robot_colors, view_limits
from d4orm_planners.play import edits
from d4orm_planners.play.meshes import (
    NO_LINES,
    Colors,
    Points,
    ball,
    bends,
    edges,
    in_space,
    linear,
    polylines,
    puck,
    solid,
)
from d4orm_planners.play.scene_frame import Frame
from d4orm_planners.play.session import Session

Moved: TypeAlias = Callable[[int, Points, Points, bool], None]

CONTACT, OBSTACLE, BOUND, MARGIN = (208, 2, 27), (150, 156, 166), (90, 98, 110), (200, 60, 60)
INK, BODY = (20, 24, 30), (120, 124, 134)
TRAIL_STEPS = 30
"""Steps that a robot's trail goes back."""

TRAIL_SEGMENTS = 8
"""Lines that a trail consists of."""

PLAN_TOLERANCE = 0.1
"""Error allowed in the line of a path ahead, in radii of a robot."""

PUSH_PER_METER = 1.0
"""Velocity that a robot gets for every metre of the arrow that pushes it [1/s]."""

WIDTHS = {"guidance": 1.5, "plans": 4.0, "trails": 2.0}
"""Widths of lines that fade, in pixels."""

LINES_EVERY = 0.1
"""Seconds between new trails and plans."""


class LaneView:
    """View of one that drives."""

    def __init__(
        self,
        server: viser.ViserServer,
        session: Session,
        index: int,
        frame: Frame,
        place: Points,
        shown: Mapping[str, bool],
    ) -> None:
        self._scene, self._session, self._index, self._shown = server.scene, session, index, shown
        self._root = f"/lane_{index}"
        self._seen, self._lines_at = (-1, False), 0.0
        self._held: dict[tuple[str, int], Points] = {}
        self._trail: list[FloatArray] = []
        self._knots: dict[str, tuple[FloatArray, list[NDArray[np.intp]]]] = {}
        self._colors = self._own_colors = 255 * robot_colors(frame.problem.num_robots)
        self._nodes: dict[str, Any] = {"": self._scene.add_frame(self._root, show_axes=False, position=place)}
        self._add_team(frame)
        self._add_world(frame.problem)
        self._add_bodies(frame)
        for name, wide in {"heading": 2.0, **WIDTHS}.items():
            color = INK if name == "heading" else NO_LINES[1]
            self._nodes[name] = self._scene.add_line_segments(
                f"{self._root}/{name}", NO_LINES[0], color, thickness=wide, thickness_units="screen",
            )  # fmt: skip

    def name(self, text: str, place: Points) -> None:
        """Write the policy's name at a position of this scene."""
        self._nodes["name"] = self._scene.add_label(
            f"{self._root}/name", text, position=place, anchor="bottom-center", font_screen_scale=1.3
        )

    def remove(self) -> None:
        """Take everything off the page."""
        self._nodes[""].remove()

    def update(self, frame: Frame, now: float) -> None:
        """Show a frame, where the robots are by a time of ``time.perf_counter()``."""
        nodes = self._nodes  # what has not changed is not sent
        seen = (frame.status.number, self._shown["dark"])
        if seen != self._seen:
            if seen[0] != self._seen[0]:
                self._trail = [*self._trail[-TRAIL_STEPS:], frame.states[:, : frame.problem.dimension]]
            self._seen = seen
            self._color(frame)
        places = self._with_held("robot", in_space(frame.positions(now)))
        nodes["robots"].batched_positions = places
        nodes["heading"].points = self._headings(frame, places)
        nodes["goals"].batched_positions = self._with_held("goal", in_space(frame.goals))
        if len(frame.bodies):
            nodes["bodies"].batched_positions = in_space(frame.body_positions(now))
        nodes["margins"].visible = self._shown["margins"]
        if self._shown["margins"]:
            nodes["margins"].batched_positions = places
        nodes["subgoals"].visible = self._shown["subgoals"] and frame.subgoals is not None
        if frame.subgoals is not None and nodes["subgoals"].visible:
            nodes["subgoals"].batched_positions = in_space(frame.subgoals)
        if now - self._lines_at > LINES_EVERY:
            self._lines_at = now
            self._draw_lines(frame)

    def _with_held(self, kind: str, places: Points) -> Points:
        """Positions, with those that are dragged at the pointer."""
        for (what, index), place in list(self._held.items()):
            if what == kind and index < len(places):
                places[index] = place
        return places

    def _add_team(self, frame: Frame) -> None:
        problem, radius = frame.problem, np.asarray(frame.problem.team.radius, np.float32)
        flat = problem.dimension == 2
        body, diamond = (puck(24), puck(4, 0.2)) if flat else (ball(2), ball(0))
        high = 0.5 * radius if flat else radius
        mark = 1.5 * radius if flat else 1.4 * radius
        margin, dot = radius + np.float32(problem.margin), 0.35 * radius
        shapes = {
            "robots": (body, radius, high, self._colors, 1.0),
            "goals": (diamond, mark, mark, self._colors, 0.6 if flat else 0.35),
            "margins": (body, margin, 0.2 * high if flat else margin, np.array(MARGIN), 0.25),
            "subgoals": (ball(0), dot, dot, self._colors, 0.9),
        }
        places, goals = in_space(frame.positions(time.perf_counter())), in_space(frame.goals)
        for name, (mesh, wide, tall, colors, opacity) in shapes.items():
            scales = np.stack([wide, wide, tall], axis=1)
            self._add_many(name, mesh, goals if name == "goals" else places, scales, colors, opacity)
        self._drag("robots", "robot", lambda index, place, _: lambda problem: edits.move_robot(problem, index, place))
        self._drag("goals", "goal", lambda index, place, _: lambda problem: edits.move_goal(problem, index, place))
        self._drag_pushes()

    def _add_bodies(self, frame: Frame) -> None:
        """Add the dynamic obstacles."""
        if len(frame.bodies):
            radius = frame.bodies[:, -1]
            mesh, high = (puck(24), 0.5 * radius) if frame.problem.dimension == 2 else (ball(2), radius)
            places = in_space(frame.bodies[:, : frame.problem.dimension])
            self._add_many("bodies", mesh, places, np.stack([radius, radius, high], axis=1), np.array(BODY), 1.0)

    def _add_many(
        self, name: str, mesh: trimesh.Trimesh, places: Points, scales: FloatArray, colors: FloatArray, opacity: float
    ) -> None:
        self._nodes[name] = self._scene.add_batched_meshes_simple(
            f"{self._root}/{name}", np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.uint32),
            np.tile(np.array([1, 0, 0, 0], np.float32), (len(places), 1)), places, batched_scales=scales,
            batched_colors=linear(colors), opacity=opacity, material="toon5", lod="off", cast_shadow=False,
            receive_shadow=False,
        )  # fmt: skip

    def _add_world(self, problem: Problem) -> None:
        low = view_limits(problem)
        floor, top = (low[0, 2], low[1, 2]) if problem.dimension == 3 else (0.0, 0.3)
        for kind in edits.KINDS:
            for index, shape in enumerate(getattr(problem.world, kind)):
                mesh, centre = solid(kind, np.asarray(shape, np.float64), problem.dimension, float(floor), float(top))
                name = f"{kind}_{index}"
                self._nodes[name] = self._scene.add_mesh_simple(
                    f"{self._root}/{name}", np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.uint32),
                    color=OBSTACLE, opacity=None if problem.dimension == 2 else 0.6, flat_shading=True,
                    position=centre, cast_shadow=False, receive_shadow=False, side="double",
                )  # fmt: skip
                self._drag(name, name, _mover(kind, index))
        if problem.world.lower is not None:
            self._nodes["bounds"] = self._scene.add_line_segments(
                f"{self._root}/bounds", edges(in_space(problem.world.bounds)), BOUND,
                thickness=2.0, thickness_units="screen",
            )  # fmt: skip

    def _drag(self, name: str, kind: str, edit: Callable[[int, FloatArray, FloatArray], edits.Edit]) -> None:
        """Let a shape be dragged: it follows the pointer, and where it is let go the scene is changed."""
        node = self._nodes[name]

        def moved(index: int, at: Points, shift: Points, ended: bool) -> None:
            if kind not in ("robot", "goal"):
                node.position = at if ended else at + shift  # until the session has agreed
            if not ended:
                self._held[kind, index] = at + shift
                return
            self._held.pop((kind, index), None)
            d = self._frame.problem.dimension
            self._session.edit(edit(index, (at + shift)[:d], shift[:d]), self._index)

        self._follow_hand(node, kind, moved)

    def _drag_pushes(self) -> None:
        """Let robots be pushed: the page draws an arrow, and where it is let go the robot gets its velocity."""

        def moved(index: int, at: Points, arrow: Points, ended: bool) -> None:
            if ended:
                self._session.push(index, PUSH_PER_METER * arrow[: self._frame.problem.dimension], self._index)

        self._follow_hand(self._nodes["robots"], "robot", moved, "shift")

    def _follow_hand(self, node: Any, kind: str, moved: Moved, modifier: Literal["shift"] | None = None) -> None:
        """Call ``moved(number, place, shift so far, ended)`` while one of a node's shapes is dragged."""
        grips: dict[tuple[int, int], tuple[Points, Points]] = {}

        @node.on_drag("left", modifier=modifier)
        async def _(event: viser.SceneNodeDragEvent[viser.SceneNodeHandle]) -> None:  # one after the other
            index, hand = event.instance_index or 0, (event.client_id, event.instance_index or 0)
            if event.phase == "start":
                at = self._place_of(kind, index)
                grips[hand] = (at, self._pointed(event, at))
            if hand in grips:
                (at, grip), ended = grips[hand], event.phase == "end"
                if ended:
                    del grips[hand]
                moved(index, at, self._pointed(event, at) - grip, ended)

    @property
    def _frame(self) -> Frame:
        frames = self._session.frames
        return frames[min(self._index, len(frames) - 1)]

    def _place_of(self, kind: str, index: int) -> Points:
        """``(3,)`` where the page shows it; the session may be further on."""
        many = {"robot": "robots", "goal": "goals"}.get(kind)
        return np.array(self._nodes[kind].position if many is None else self._nodes[many].batched_positions[index])

    def _pointed(self, event: viser.SceneNodeDragEvent[viser.SceneNodeHandle], at: Points) -> Points:
        """Return the pointer's position: on the plane that planar robots drive on, or as far off as the shape."""
        end = np.asarray(event.end_position, np.float64)
        if self._frame.problem.dimension == 3:
            return end.astype(np.float32)
        eye = np.asarray(event.client.camera.position, np.float64)
        ray = end - eye
        if abs(ray[2]) < 1e-9:
            return end.astype(np.float32)
        return (eye + (at[2] - eye[2]) / ray[2] * ray).astype(np.float32)

    def _color(self, frame: Frame) -> None:
        """Red in contact, paler when arrived, all lighter where it is dark."""
        self._colors = self._own_colors + (0.5 * (255 - self._own_colors) if self._shown["dark"] else 0)
        colors = np.where(frame.arrived[:, None], 0.5 * (self._paper + self._colors), self._colors)
        colors = np.where(frame.collided[:, None], np.array(CONTACT), colors)
        self._nodes["robots"].batched_colors = linear(colors)
        self._nodes["goals"].batched_colors = self._nodes["subgoals"].batched_colors = linear(self._colors)

    @property
    def _paper(self) -> int:
        """Brightness of what everything is drawn on."""
        return 20 if self._shown["dark"] else 255

    def _draw_lines(self, frame: Frame) -> None:
        lines = dict.fromkeys(WIDTHS, NO_LINES)
        if len(self._trail) > 1 and self._shown["trails"]:
            trail = np.stack(self._trail)
            taken = np.linspace(0, len(trail) - 1, TRAIL_SEGMENTS + 1).round().astype(np.intp)
            knots = [np.unique(taken)] * trail.shape[1]
            lines["trails"] = polylines(trail, self._colors, self._paper, (0.2, 1.0), knots)
        for name, path, shades in (("plans", frame.plan, (1.0, 0.4)), ("guidance", frame.guidance, (0.8, 0.25))):
            if path is not None and len(path) > 1 and self._shown[name]:
                lines[name] = self._path_lines(name, path, shades, frame.problem)
        for name, (points, colors) in lines.items():
            self._nodes[name].points, self._nodes[name].colors = points, colors

    def _path_lines(
        self, name: str, path: FloatArray, shades: tuple[float, float], problem: Problem
    ) -> tuple[Points, Colors]:
        """Lines of the paths ahead, looked for only when these are others."""
        if name not in self._knots or not np.array_equal(self._knots[name][0], path):
            tolerance = PLAN_TOLERANCE * np.asarray(problem.team.radius)
            knots = [bends(path[:, robot], float(tolerance[robot])) for robot in range(path.shape[1])]
            self._knots[name] = (path, knots)
        return polylines(path, self._colors, self._paper, shades, self._knots[name][1])

    def _headings(self, frame: Frame, places: Points) -> Points:
        """``(N, 2, 3)`` lines from the centre to the front of robots that have one."""
        models, radius = frame.problem.team.robot_models, np.asarray(frame.problem.team.radius)
        drives = [(robot, model.heading_index) for robot, model in enumerate(models) if model.heading_index is not None]
        points = np.zeros((len(drives), 2, 3), np.float32)
        for row, (robot, index) in enumerate(drives):
            angle = frame.states[robot, index]
            points[row] = places[robot] + np.array([0, 0, 0.3 * radius[robot]])
            points[row, 1, :2] += radius[robot] * np.array([np.cos(angle), np.sin(angle)])
        return points


def _mover(kind: str, index: int) -> Callable[[int, FloatArray, FloatArray], edits.Edit]:
    return lambda _, place, shift: lambda problem: edits.move_obstacle(problem, kind, index, shift)
