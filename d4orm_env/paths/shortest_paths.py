"""The shortest paths to the goals through the space that obstacles leave free."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from d4orm_env.core.arrays import BoolArray, FloatArray, Floats, read_only
from d4orm_env.core.lazy import LazyModule
from d4orm_env.core.observation_layout import ObservationLayout
from d4orm_env.core.problem import Problem

if TYPE_CHECKING:
    from d4orm_env.paths import lattice as grids
    from d4orm_env.paths import looking, spaces, wavefront
    from d4orm_env.paths.lattice import Lattice
    from d4orm_env.paths.looking import Fields
    from d4orm_env.paths.spaces import Space
    from d4orm_env.paths.wavefront import Front
else:
    grids = LazyModule("d4orm_env.paths.lattice")
    looking = LazyModule("d4orm_env.paths.looking")
    spaces = LazyModule("d4orm_env.paths.spaces")
    wavefront = LazyModule("d4orm_env.paths.wavefront")


MAX_NODES, MAX_NODES_IN_ALL = 2**21, 2**24
"""Most nodes of a grid, and of the grids of all robots together; coarser ones where there would be more."""
STEP = 0.5
"""Distance of neighbouring nodes, as a share of the robot's radius and margin."""
REFINEMENTS = 2
"""Number of times that a robot without a path is tried again, each time on a grid that is twice as fine."""


@dataclass(frozen=True, eq=False)
class ShortestPaths:
    """The shortest path of every robot of a problem to its goal, other robots not counted.

    A free path keeps the radius of the robot and the margin to obstacles and bounds. A position that is nearer to
    something, as a goal may be, is left and reached on lines that come no nearer than it is. Lengths are at most 2%
    above the least. Gaps that are wider than radius and margin need by less than a sixteenth of that may be missed.
    """

    problem: Problem  #: The problem
    length: Floats  #: ``(K,)`` float64 from start to goal [m]; infinite where there is no path
    _world: tuple[Space, Fields] | None

    def distance(self, points: ArrayLike) -> Floats:
        """``(..., K)`` float64 length of the paths from points ``(..., K, d)`` to the goals [m]."""
        return self._look(points)[1]

    def distance_from(self, robot: int, positions: Floats) -> Floats:
        """``(Q,)`` float64 length of the paths of one robot from positions ``(Q, d)`` to its goal [m]."""
        if self._world is None:
            return np.linalg.norm(positions - self.problem.goal[robot], axis=1)
        return _find(self._world, robot, in_space(positions)[None])[1][0]

    def direction(self, points: ArrayLike) -> Floats:
        """``(..., K, d)`` float64 unit vectors along the paths; zero at a goal and where there is no path."""
        return self.ahead(points)[0]

    def ahead(self, points: ArrayLike) -> tuple[Floats, Floats]:
        """:meth:`direction` and :meth:`distance` at once."""
        positions = np.asarray(points, np.float64)
        target, length = self._look(positions)
        return _towards(positions, target), length

    def path(self, robot: int) -> Floats:
        """``(w, d)`` float64 corners of the path of a robot, from its start to its goal; empty if there is none."""
        d = self.problem.dimension
        start, goal = self.problem.start[robot, :d].astype(np.float64), self.problem.goal[robot].astype(np.float64)
        if not np.isfinite(self.length[robot]):
            return np.empty((0, d))
        if self._world is None:
            return np.stack([start, goal])
        target, _, anchors = _find(self._world, robot, in_space(start[None])[None])
        corners, anchor, fields = [start, target[0, 0, :d]], int(anchors[0, 0]), self._world[1]
        first = fields.first_point[robot]
        while anchor >= 0:
            corners.append(fields.points[first + anchor, :d])
            anchor = int(fields.parents[first + anchor])
        points = np.stack(corners)
        return points[np.append(True, (np.diff(points, axis=0) != 0).any(axis=1))]

    def check_reachable(self) -> None:
        """Raise ``ValueError``, which names them, if robots have no path."""
        robots = np.flatnonzero(np.isinf(self.length))
        if len(robots):
            names = ", ".join(f"robot_{robot}" for robot in robots)
            distances = sorted(
                {f"{radius + self.problem.margin:.4g}" for radius in self.problem.team.wall_radius[robots]}
            )
            shaped = bool(self.problem.team.shapes)
            raise ValueError(
                f"{names} {'has' if len(robots) == 1 else 'have'} no path from start to goal that is "
                f"{' or '.join(distances)} m clear of obstacles{', for the disc round its footprint' * shaped}; move "
                f"the start or the goal, open the world there, or use a smaller {'footprint' if shaped else 'radius'} "
                "or margin"
            )

    def _look(self, points: ArrayLike) -> tuple[Floats, Floats]:
        """Return the next position to head for, and the whole distance."""
        positions: Floats = np.asarray(points, np.float64)
        goal = self.problem.goal.astype(np.float64)
        if self._world is None:
            offset = goal - positions
            straight: Floats = np.sqrt((offset * offset).sum(axis=-1))
            return np.broadcast_to(goal, positions.shape), straight
        num_robots, d = positions.shape[-2:]
        spatial = in_space(positions.reshape(-1, d)).reshape(-1, num_robots, 3).swapaxes(0, 1)
        target, length, _ = _find(self._world, 0, np.ascontiguousarray(spatial))
        return target.swapaxes(0, 1)[..., :d].reshape(positions.shape), length.T.reshape(positions.shape[:-1])


def _find(world: tuple[Space, Fields], robot: int, positions: Floats) -> tuple[Floats, Floats, NDArray[np.int32]]:
    """Return next positions for robots from this number on at ``(R, Q, 3)``, the whole distances, and their anchors."""
    shape = positions.shape[:2]
    target, length, anchor = np.empty(positions.shape), np.empty(shape), np.empty(shape, np.int32)
    looking.look(*world, robot, positions, target, length, anchor)
    return target, length, anchor


def shortest_paths(problem: Problem) -> ShortestPaths:
    """The shortest paths of a team.

    In a world without obstacles they are straight, and there is nothing to compute. Otherwise a wavefront spreads from
    every goal over a grid; see :mod:`d4orm_env.paths.wavefront`.
    """
    start = problem.start[:, : problem.dimension].astype(np.float64)
    if not problem.world.num_obstacles:
        return ShortestPaths(problem, np.linalg.norm(problem.goal - start, axis=1), None)
    space, starts = spaces.make_space(problem), in_space(start)[:, None]
    safety_distances = np.asarray(problem.team.wall_radius, np.float64) + problem.margin
    lattices: dict[tuple[float, int], Lattice] = {}
    chosen: list[tuple[float, int]] = []
    fronts: list[Front] = []
    for safety_distance, goal, position in zip(
        safety_distances.tolist(), in_space(problem.goal.astype(np.float64)), starts
    ):
        for refinement in range(1 + REFINEMENTS):
            if (safety_distance, refinement) not in lattices:
                lattices[safety_distance, refinement] = _first_or_finer(
                    problem, space, safety_distance, lattices.get((safety_distance, refinement - 1))
                )
            lattice = lattices[safety_distance, refinement]
            front = wavefront.spread(space, lattice, safety_distance, goal)
            own = looking.gather(np.array([safety_distance]), [lattice], np.array([0]), [front])
            if np.isfinite(_find((space, own), 0, position[None])[1]).all():
                break
        chosen.append((safety_distance, refinement))
        fronts.append(front)
    number = {key: n for n, key in enumerate(lattices)}
    world = (
        space,
        looking.gather(safety_distances, list(lattices.values()), np.array([number[key] for key in chosen]), fronts),
    )
    return ShortestPaths(problem, read_only(_find(world, 0, starts)[1][:, 0]), world)


def _towards(positions: Floats, targets: Floats) -> Floats:
    """Unit vectors ``(..., d)`` from positions to targets; zero where these are the same."""
    offset = targets - positions
    norm = np.sqrt((offset * offset).sum(axis=-1, keepdims=True))
    return offset / np.where(norm > 0, norm, 1.0)


def ahead_in_each(paths: Sequence[ShortestPaths], positions: FloatArray) -> tuple[Floats, Floats]:
    """:meth:`ShortestPaths.ahead` in ``B`` worlds, each with paths of its own, from positions ``(B, K, d)``."""
    given = positions.astype(np.float64)
    target, length = np.empty(given.shape), np.empty(given.shape[:-1])
    # Each robot is one row of one position.
    spatial = in_space(given.reshape(-1, given.shape[-1])).reshape(*given.shape[:-1], 1, 3)
    found, lengths, anchors = np.empty(spatial.shape), length[:, :, None], np.empty(spatial.shape[:3], np.int32)
    for world, own in enumerate(paths):
        if own._world is None:
            target[world], length[world] = own._look(given[world])
        else:
            looking.look(*own._world, 0, spatial[world], found[world], lengths[world], anchors[world])
            target[world] = found[world, :, 0, : given.shape[-1]]
    return _towards(given, target), length


def observe_paths(observations: FloatArray, layout: ObservationLayout, direction: Floats, length: Floats) -> None:
    """Fill in what robots see of their paths: ``(..., K, d)`` unit vectors, and ``(..., K)`` lengths [m]."""
    seen, parts = layout.paths(observations), layout.path
    seen[..., parts.direction] = direction
    seen[..., parts.length] = np.minimum(length, layout.high[-1])[..., None]


def along_paths(direction: ArrayLike, length: ArrayLike) -> tuple[Floats, BoolArray]:
    """``(N, d)`` vectors along paths, as long as they are, and ``(N,)`` robots with one: neither at the goal nor lost.

    Of unit vectors ``direction`` ``(N, d)``, zero at a goal, and ``length`` ``(N,)`` [m], infinite without a path.
    """
    direction, length = np.asarray(direction, np.float64), np.asarray(length, np.float64)
    known = (direction != 0).any(axis=1) & np.isfinite(length)
    return direction * np.where(known, length, 0.0)[:, None], known


def _first_or_finer(problem: Problem, space: Space, safety_distance: float, before: Lattice | None) -> Lattice:
    """The lattice that paths are looked for on at first, or one that is twice as fine as the one before."""
    most = min(MAX_NODES, MAX_NODES_IN_ALL // problem.num_robots)
    if before is None:
        return grids.lay_lattice(problem, space, safety_distance, STEP * safety_distance, most, MAX_NODES)
    return grids.lay_lattice(problem, space, safety_distance, before.step / 2, most)


def in_space(positions: Floats) -> Floats:
    """Positions ``(Q, d)`` in three dimensions."""
    return np.hstack([positions, np.zeros((len(positions), 3 - positions.shape[1]))])
