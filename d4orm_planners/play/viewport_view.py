"""The shapes of one team and its world on the page, and what dragging them does."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Literal, TypeAlias

import numpy as np
import trimesh
import viser
from numpy.typing import NDArray

from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.problem import Problem
from d4orm_env.render.panels import robot_colors, view_limits
from d4orm_planners.play import edits, meshes
from d4orm_planners.play.meshes import BodyGroup, PathLines, Points, in_space, linear
from d4orm_planners.play.session import Session
from d4orm_planners.play.viewport import Frame

Numbers: TypeAlias = NDArray[np.intp] | None  #: ``(N,)`` what shapes stand for, where it is not their own number
Move: TypeAlias = Callable[[Problem, int, FloatArray, FloatArray], Problem]
"""``(scene, number, position (d,), shift (d,))`` to the scene in which something was dragged there."""
Moved: TypeAlias = Callable[[int, Points, Points, bool], None]

CONTACT, OBSTACLE, BOUND, MARGIN = (208, 2, 27), (150, 156, 166), (90, 98, 110), (200, 60, 60)
INK, BODY = (20, 24, 30), (120, 124, 134)
TRAIL_STEPS = 30  #: Steps that a robot's trail goes back
TRAIL_SEGMENTS = 8  #: Lines that a trail consists of
PUSH_PER_METER = 1.0  #: Velocity that a robot gets for every metre of the arrow that pushes it [1/s]
WIDTHS = {"guidance": 1.5, "plans": 4.0, "trails": 2.0, "goal_poses": 2.0}  #: Widths of lines that fade, in pixels
LINES_EVERY = 0.1  #: Seconds between new trails and plans


class ViewportView:
    """View of one that drives."""

    def __init__(
        self,
        server: viser.ViserServer,
        session: Session,
        index: int,
        frame: Frame,
        position: Points,
        shown: Mapping[str, bool],
    ) -> None:
        self._scene, self._session, self._index, self._shown = server.scene, session, index, shown
        self._root = f"/viewport_{index}"
        self._seen, self._lines_at = (-1, False), 0.0
        self._held: dict[tuple[str, int], Points] = {}
        self._trail: list[FloatArray] = []
        self._paths = {name: PathLines(frame.problem) for name in ("plans", "guidance")}
        self._colors = self._own_colors = 255 * robot_colors(frame.problem.num_robots)
        self._groups = meshes.body_groups(frame.problem)
        self._removed, self._positions = False, dict[str, Points]()
        self._nodes: dict[str, Any] = {"": self._scene.add_frame(self._root, show_axes=False, position=position)}
        self._add_team(frame)
        self._add_world(frame.problem)
        self._add_bodies(frame)
        for name, wide in {"heading": 2.0, **WIDTHS}.items():
            color = INK if name == "heading" else meshes.NO_LINES[1]
            self._nodes[name] = self._scene.add_line_segments(
                f"{self._root}/{name}", meshes.NO_LINES[0], color, thickness=wide, thickness_units="screen",
            )  # fmt: skip

    def name(self, text: str, position: Points) -> None:
        """Write the policy's name at a position of this scene."""
        self._nodes["name"] = self._scene.add_label(
            f"{self._root}/name", text, position=position, anchor="bottom-center", font_screen_scale=1.3
        )

    def remove(self) -> None:
        """Take everything off the page; who holds a shape then lets go of it."""
        self._removed = True
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
        positions = self._with_held("robot", in_space(frame.positions(now)))
        goals = self._with_held("goal", in_space(frame.goals))
        self._positions = {"robot": positions, "goal": goals}
        self._move_team(frame, positions)
        nodes["heading"].points = meshes.heading_lines(frame.problem, frame.states, positions)
        nodes["goals"].batched_positions = goals
        if len(frame.bodies):
            nodes["bodies"].batched_positions = in_space(frame.body_positions(now))
        nodes["subgoals"].visible = self._shown["subgoals"] and frame.subgoals is not None
        if frame.subgoals is not None and nodes["subgoals"].visible:
            nodes["subgoals"].batched_positions = in_space(frame.subgoals)
        if now - self._lines_at > LINES_EVERY:
            self._lines_at = now
            self._draw_lines(frame)

    def _move_team(self, frame: Frame, positions: Points) -> None:
        """Move all bodies, their robots to ``positions`` ``(K, 3)``."""
        shown, turns = meshes.body_positions(frame.problem, frame.states, positions)
        for group in self._groups:
            margins = self._nodes[f"margins_{group.name}"]
            margins.visible = self._shown["margins"]
            for node in (self._nodes[group.name], *[margins] * self._shown["margins"]):
                node.batched_positions = shown[group.bodies]
                if turns is not None:
                    node.batched_wxyzs = turns[group.bodies]

    def _with_held(self, kind: str, positions: Points) -> Points:
        """Positions, with those that are dragged at the pointer."""
        for (what, index), position in list(self._held.items()):
            if what == kind and index < len(positions):
                positions[index] = position
        return positions

    def _add_team(self, frame: Frame) -> None:
        problem = frame.problem
        # Of the robots themselves: the discs round their trailers too would hide everything.
        radius = np.array([footprint.outer_radius for footprint in problem.team.footprint], np.float32)
        flat = problem.dimension == 2
        mark, dot = 1.5 * radius if flat else 1.4 * radius, 0.35 * radius
        positions, goals = in_space(frame.positions(time.perf_counter())), in_space(frame.goals)
        self._positions = {"robot": positions, "goal": goals}
        shown = meshes.body_positions(problem, frame.states, positions)[0]
        for group in self._groups:
            at, colors = shown[group.bodies], self._colors[group.robots]
            self._add_many(group.name, group.mesh, at, group.scales, colors, 1.0)
            self._add_many(f"margins_{group.name}", group.margin[0], at, group.margin[1], np.array(MARGIN), 0.25)
            self._drag(
                group.name, "robot", lambda scene, index, at, _: edits.move_robot(scene, index, at), group.robots
            )
            self._drag_pushes(group)
        diamond = meshes.puck(4, 0.2) if flat else meshes.ball(0)
        self._add_many("goals", diamond, goals, np.stack([mark] * 3, axis=1), self._colors, 0.6 if flat else 0.35)
        self._add_many("subgoals", meshes.ball(0), positions, np.stack([dot] * 3, axis=1), self._colors, 0.9)
        self._drag("goals", "goal", lambda scene, index, at, _: edits.move_goal(scene, index, at))

    def _add_bodies(self, frame: Frame) -> None:
        if len(frame.bodies):
            radius = frame.bodies[:, -1]
            mesh, high = (meshes.puck(24), 0.5 * radius) if frame.problem.dimension == 2 else (meshes.ball(2), radius)
            positions = in_space(frame.bodies[:, : frame.problem.dimension])
            self._add_many("bodies", mesh, positions, np.stack([radius, radius, high], axis=1), np.array(BODY), 1.0)

    def _add_many(
        self, name: str, mesh: trimesh.Trimesh, at: Points, scales: FloatArray, colors: FloatArray, opacity: float
    ) -> None:
        self._nodes[name] = self._scene.add_batched_meshes_simple(
            f"{self._root}/{name}", np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.uint32),
            np.tile(np.array([1, 0, 0, 0], np.float32), (len(at), 1)), at, batched_scales=scales,
            batched_colors=linear(colors), opacity=opacity, material="toon5", lod="off", cast_shadow=False,
            receive_shadow=False,
        )  # fmt: skip

    def _add_world(self, problem: Problem) -> None:
        low = view_limits(problem)
        floor, top = (low[0, 2], low[1, 2]) if problem.dimension == 3 else (0.0, 0.3)
        for kind in edits.KINDS:
            for index, shape in enumerate(getattr(problem.world, kind)):
                mesh, centre = meshes.solid(
                    kind, np.asarray(shape, np.float64), problem.dimension, float(floor), float(top)
                )
                name = f"{kind}_{index}"
                self._nodes[name] = self._scene.add_mesh_simple(
                    f"{self._root}/{name}", np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.uint32),
                    color=OBSTACLE, opacity=None if problem.dimension == 2 else 0.6, flat_shading=True,
                    position=centre, cast_shadow=False, receive_shadow=False, side="double",
                )  # fmt: skip
                self._drag(name, name, partial(_move_obstacle, kind, index))
        if problem.world.lower is not None:
            self._nodes["bounds"] = self._scene.add_line_segments(
                f"{self._root}/bounds", meshes.edges(in_space(problem.world.bounds)), BOUND,
                thickness=2.0, thickness_units="screen",
            )  # fmt: skip

    def _drag(self, name: str, kind: str, move: Move, numbers: Numbers = None) -> None:
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
            self._session.edit(lambda scene: move(scene, index, (at + shift)[:d], shift[:d]), self._index)

        self._follow_hand(node, kind, moved, numbers=numbers)

    def _drag_pushes(self, group: BodyGroup) -> None:
        """Let robots be pushed: the page draws an arrow, and where it is let go the robot gets its velocity."""

        def moved(index: int, at: Points, arrow: Points, ended: bool) -> None:
            if ended:
                self._session.push(index, PUSH_PER_METER * arrow[: self._frame.problem.dimension], self._index)

        self._follow_hand(self._nodes[group.name], "robot", moved, "shift", group.robots)

    def _follow_hand(
        self, node: Any, kind: str, moved: Moved, modifier: Literal["shift"] | None = None, numbers: Numbers = None
    ) -> None:
        """Call ``moved(number, position, shift so far, ended)`` while one of a node's shapes is dragged.

        The number is that of the shape, or what ``numbers`` has for it.
        """
        grips: dict[tuple[int, int], tuple[Points, Points]] = {}

        @node.on_drag("left", modifier=modifier)
        async def _(event: viser.SceneNodeDragEvent[viser.SceneNodeHandle]) -> None:  # one after the other
            if self._removed:
                return
            instance = event.instance_index or 0
            index, hand = instance if numbers is None else int(numbers[instance]), (event.client_id, instance)
            if event.phase == "start":
                # Where the page shows it; the session may be further on.
                at = np.array(self._positions[kind][index] if kind in self._positions else self._nodes[kind].position)
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
        for group in self._groups:
            self._nodes[group.name].batched_colors = linear(colors[group.robots])
        self._nodes["goals"].batched_colors = self._nodes["subgoals"].batched_colors = linear(self._colors)

    @property
    def _paper(self) -> int:
        """Brightness of what everything is drawn on."""
        return 20 if self._shown["dark"] else 255

    def _draw_lines(self, frame: Frame) -> None:
        lines = dict.fromkeys(WIDTHS, meshes.NO_LINES)
        if len(self._trail) > 1 and self._shown["trails"]:
            trail = np.stack(self._trail)
            taken = np.linspace(0, len(trail) - 1, TRAIL_SEGMENTS + 1).round().astype(np.intp)
            knots = [np.unique(taken)] * trail.shape[1]
            lines["trails"] = meshes.polylines(trail, self._colors, self._paper, (0.2, 1.0), knots)
        for name, path, shades in (("plans", frame.plan, (1.0, 0.4)), ("guidance", frame.guidance, (0.8, 0.25))):
            if path is not None and len(path) > 1 and self._shown[name]:
                lines[name] = self._paths[name].drawn(path, self._colors, self._paper, shades)
        poses, owners = meshes.goal_poses(frame.problem, self._positions["goal"])
        lines["goal_poses"] = poses, linear(np.repeat(self._colors[owners][:, None], 2, axis=1))
        for name, (points, colors) in lines.items():
            self._nodes[name].points, self._nodes[name].colors = points, colors


def _move_obstacle(kind: str, index: int, scene: Problem, _: int, at: FloatArray, shift: FloatArray) -> Problem:
    return edits.move_obstacle(scene, kind, index, shift)
