"""The shortest ways to the goals through the space that obstacles leave free."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from d4orm_env.core.arrays import FloatArray, Floats
from d4orm_env.core.observation_layout import ObservationLayout
from d4orm_env.core.problem import Problem

if TYPE_CHECKING:
    from d4orm_env.engine.wavefront import Front, Lattice, Space


MAX_NODES, MAX_NODES_IN_ALL = 2**21, 2**24
"""Most nodes of a grid, and of the grids of all robots together; coarser ones where there would be more."""

STEP = 0.5
"""Distance of neighbouring nodes, as a share of the robot's radius and margin."""
REFINEMENTS = 2
"""How often a robot that seems to have no way is tried again on a grid that is twice as fine."""


class _Field(NamedTuple):
    """Where one robot can go, and by which way."""

    space: Space
    lattice: Lattice
    reach: float
    front: Front

    def look(self, places: Floats) -> tuple[Floats, Floats, NDArray[np.int32]]:
        """``(Q, d)`` where to go first from places ``(Q, d)``, ``(Q,)`` the length of the way, ``(Q,)`` its anchor."""
        from d4orm_env.engine.wavefront import look

        spatial = in_space(places)
        target, length, anchor = spatial.copy(), np.empty(len(spatial)), np.empty(len(spatial), np.int32)
        look(self.space, self.lattice, self.reach, self.front, spatial, target, length, anchor)
        return target[:, : places.shape[1]], length, anchor


@dataclass(frozen=True, eq=False)
class Ways:
    """The shortest free way of every robot of a problem to its goal, other robots not counted.

    A free way keeps the radius of the robot and the margin to obstacles and bounds. A place that is nearer to something
    already (a goal may be, and a robot may have got there) is left and reached on lines that come no nearer than it is.
    Lengths are at most 2% above the least. Gaps that are wider than radius and margin need by less than a sixteenth
    of that may be missed.

    Attributes:
        problem: The problem.
        length: ``(K,)`` float64 from start to goal [m]; infinite where there is no way.
    """

    problem: Problem
    length: Floats
    _fields: tuple[_Field, ...]

    def distance(self, points: ArrayLike) -> Floats:
        """``(..., K)`` float64 length of the ways from points ``(..., K, d)`` to the goals [m]."""
        return self._look(points)[1]

    def distance_from(self, robot: int, places: Floats) -> Floats:
        """``(Q,)`` float64 length of the ways of one robot from places ``(Q, d)`` to its goal [m]."""
        if not self._fields:
            return np.linalg.norm(places - self.problem.goal[robot], axis=1)
        return self._fields[robot].look(places)[1]

    def direction(self, points: ArrayLike) -> Floats:
        """``(..., K, d)`` float64 unit vectors along the ways; zero at a goal and where there is no way."""
        return self.ahead(points)[0]

    def ahead(self, points: ArrayLike) -> tuple[Floats, Floats]:
        """:meth:`direction` and :meth:`distance` at once."""
        places = np.asarray(points, np.float64)
        target, length = self._look(places)
        offset = target - places
        norm = np.sqrt((offset * offset).sum(axis=-1, keepdims=True))
        direction: Floats = offset / np.where(norm > 0, norm, 1.0)
        return direction, length

    def path(self, robot: int) -> Floats:
        """``(w, d)`` float64 corners of the way of a robot, its start first and its goal last; empty if there is none.

        Args:
            robot: Its number.
        """
        d = self.problem.dimension
        start, goal = self.problem.start[robot, :d].astype(np.float64), self.problem.goal[robot].astype(np.float64)
        if not np.isfinite(self.length[robot]):
            return np.empty((0, d))
        if not self._fields:
            return np.stack([start, goal])
        field = self._fields[robot]
        target, _, anchors = field.look(start[None])
        corners, anchor = [start, target[0]], int(anchors[0])
        while anchor >= 0:
            corners.append(field.front.points[anchor, :d])
            anchor = int(field.front.parents[anchor])
        way = np.stack(corners)
        return way[np.append(True, (np.diff(way, axis=0) != 0).any(axis=1))]

    def _look(self, points: ArrayLike) -> tuple[Floats, Floats]:
        """Where to go first, and how far it is in all."""
        places: Floats = np.asarray(points, np.float64)
        goal = self.problem.goal.astype(np.float64)
        if not self._fields:
            offset = goal - places
            straight: Floats = np.sqrt((offset * offset).sum(axis=-1))
            return np.broadcast_to(goal, places.shape), straight
        target, length = np.empty(places.shape), np.empty(places.shape[:-1])
        for robot, field in enumerate(self._fields):
            own = places[..., robot, :]
            first, far, _ = field.look(own.reshape(-1, own.shape[-1]))
            target[..., robot, :], length[..., robot] = first.reshape(own.shape), far.reshape(own.shape[:-1])
        return target, length


def shortest_ways(problem: Problem) -> Ways:
    """The shortest free ways of a team.

    In a world without obstacles they are straight, and there is nothing to compute. Otherwise a wavefront spreads from
    every goal over a grid; see :mod:`d4orm_env.engine.wavefront`.

    Args:
        problem: The team, its starts and goals, and the world.
    """
    start = problem.start[:, : problem.dimension].astype(np.float64)
    if not problem.world.num_obstacles:
        return Ways(problem, np.linalg.norm(problem.goal - start, axis=1), ())
    # Here, because importing the compiler takes longer than importing all the rest of the package.
    from d4orm_env.engine.wavefront import make_space, spread

    space = make_space(problem)
    length, fields = np.full(problem.num_robots, np.inf), []
    lattices: dict[tuple[float, int], Lattice] = {}
    for robot, goal in enumerate(in_space(problem.goal.astype(np.float64))):
        reach = float(np.asarray(problem.team.radius)[robot]) + problem.margin
        for refinement in range(1 + REFINEMENTS):
            if (reach, refinement) not in lattices:
                step, most = STEP * reach / 2**refinement, min(MAX_NODES, MAX_NODES_IN_ALL // problem.num_robots)
                lattices[reach, refinement] = lay_lattice(problem, space, reach, step, most)
            lattice = lattices[reach, refinement]
            field = _Field(space, lattice, reach, spread(space, lattice, reach, goal))
            length[robot] = field.look(start[robot : robot + 1])[1][0]
            if np.isfinite(length[robot]):
                break
        fields.append(field)
    length.setflags(write=False)
    return Ways(problem, length, tuple(fields))


def observe_ways(observations: FloatArray, layout: ObservationLayout, ways: Ways, places: FloatArray) -> None:
    """Fill in what robots see of their ways.

    Args:
        observations: ``(..., K, D)``.
        layout: What is in them.
        ways: The ways.
        places: ``(..., K, d)`` where the robots are [m].
    """
    seen, parts = layout.ways(observations), layout.way
    seen[..., parts.direction], length = ways.ahead(places)
    seen[..., parts.length] = np.minimum(length, layout.high[-1])[..., None]


def lay_lattice(
    problem: Problem, space: Space | None, reach: float, step: float, most: int, pad: float = 0.0
) -> Lattice:
    """Nodes so far apart wherever ways may lead; farther apart where there would be too many.

    Args:
        problem: The starts, goals and bounds.
        space: Its obstacles; ``None`` where there are none.
        reach: What must fit at a node [m].
        step: Distance of neighbouring nodes [m].
        most: Most nodes.
        pad: How far beyond starts, goals and obstacles ways may lead, at least twice the reach [m].
    """
    from d4orm_env.engine.wavefront import Lattice, settle_nodes

    d, bounds, pad = problem.dimension, problem.world.bounds.astype(np.float64), max(pad, 2 * reach)
    places = np.concatenate([problem.start[:, :d], problem.goal]).astype(np.float64)
    if space is not None:
        obstacles = space.extent[:, :d]
        places = np.concatenate([places, np.where(np.isinf(obstacles), problem.goal[0], obstacles)])
    low = np.maximum(places.min(axis=0) - pad, bounds[0])
    high = np.minimum(places.max(axis=0) + pad, bounds[1])
    while np.floor((high - low) / step + 1).prod() > most:
        step *= 1.05
    size = np.floor((high - low) / step).astype(np.int64) + 1
    flat = [0] * (3 - d)
    lattice = Lattice(
        low=np.append((low + high - (size - 1) * step) / 2, flat).astype(np.float64),
        step=step,
        size=np.append(size, [1] * (3 - d)).astype(np.int64),
        moves=np.array([(*move, *flat) for move in product((-1, 0, 1), repeat=d) if any(move)]),
        places=np.empty((size.prod(), 3)),
        free=np.empty(size.prod(), np.bool_),
    )
    if space is None:
        lattice.places[:] = lattice.low + np.indices(tuple(lattice.size)).reshape(3, -1).T * step
        inside = (lattice.places[:, :d] >= bounds[0] + reach) & (lattice.places[:, :d] <= bounds[1] - reach)
        lattice.free[:] = inside.all(axis=1)
    else:
        settle_nodes(space, lattice, reach)
    return lattice


def in_space(places: Floats) -> Floats:
    """Places ``(Q, d)`` in three dimensions."""
    return np.hstack([places, np.zeros((len(places), 3 - places.shape[1]))])
