"""The components of one robot's observation: where each part lies, what it is called and how large it gets."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import accumulate, pairwise
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from d4orm_env.core import portable
from d4orm_env.core.arrays import LARGEST, FloatArray, positive_number, read_only, whole_number
from d4orm_env.core.goal_poses import goal_headings
from d4orm_env.core.problem import Problem

__all__ = ["BoundsSlack", "ObservationLayout"]

WINDING = 10
"""Longest path in an observation, over the farthest that anything may be from a robot."""
_NEVER_NEGATIVE = ("time_left", "arrived", "present", "length")


class BoundsSlack(NamedTuple):
    """Room beyond what robots and their observations keep to by themselves."""

    distance: float = 0.0  #: Between where a robot is and where it is seen [m]
    speed: float = 0.0  #: Beyond the speed limit, in what is seen [m/s]
    heading: float = 0.0  #: Between true and seen [rad]
    drift: float = 0.0  #: Speed at which a robot may be moved in addition to its own motion [m/s]
    radius: float = 0.0  #: Of what is seen and is no robot [m]

    def joined(self, other: BoundsSlack) -> BoundsSlack:
        """Room for both."""
        sums = BoundsSlack(*(a + b for a, b in zip(self, other)))
        return sums._replace(radius=max(self.radius, other.radius))


class OwnParts(NamedTuple):
    """Slices of the robot's own part; ``d`` position dimensions, lengths in m and speeds in m/s."""

    velocity: slice  #: d
    heading: slice  #: cosine and sine, both zero for a model without a heading
    speed: slice
    goal: slice  #: d, vector to the goal
    time_left: slice  #: share of the time that is left, 1 to 0
    arrived: slice
    radius: slice
    max_speed: slice
    max_acceleration: slice
    #: cosine and sine of the goal heading less its own, both zero for a robot without one; empty where no robot has one
    goal_heading: slice
    #: likewise of the hitch angle of each trailer, up to the last that any robot has a goal for
    goal_hitches: slice


class NeighborParts(NamedTuple):
    """Slices of a neighbour's part; all zeros for an absent one."""

    present: slice
    position: slice  #: d, relative to its own
    velocity: slice  #: d, relative to its own
    radius: slice


class ObstacleParts(NamedTuple):
    """Slices of the part of an obstacle or a wall of the bounds, likewise."""

    present: slice
    position: slice  #: d, vector to the nearest point of the surface
    gap: slice  #: between the two surfaces


class PathParts(NamedTuple):
    """Slices of the part on its shortest path, from the first component of that on."""

    direction: slice  #: d, unit vector along it; zero at the goal
    length: slice


Parts: TypeAlias = OwnParts | NeighborParts | ObstacleParts | PathParts


@dataclass(frozen=True)
class ObservationSlices:
    """Slices of an observation: the robot's own part, each neighbour's, each obstacle's, the rays, and the path."""

    dimension: int  #: ``d``
    num_neighbors: int  #: Neighbours listed, nearest first
    num_obstacles: int  #: Obstacles listed, nearest first; walls of the bounds are among them
    #: Rays of its range sensor, counter-clockwise, the first along its heading, or along the x axis for a model without
    #: one: how far each reaches [m]
    num_rays: int = field(default=0, kw_only=True)
    observed_path: bool = field(default=False, kw_only=True)  #: Whether the path is there
    #: Bodies whose goal headings are: robots where any has one, and trailers, by their hitch angles
    goal_headings: int = field(default=0, kw_only=True)

    def __post_init__(self) -> None:
        for name in ("num_neighbors", "num_obstacles", "num_rays"):
            whole_number(getattr(self, name), name, 0)

    @cached_property
    def own(self) -> OwnParts:
        """Slices of the observation."""
        d = self.dimension
        turns = 2 * min(self.goal_headings, 1), 2 * max(self.goal_headings - 1, 0)
        return OwnParts(*_slices(d, 2, 1, d, 1, 1, 1, 1, 1, *turns))

    @cached_property
    def neighbor(self) -> NeighborParts:
        """Slices of a row of :meth:`neighbors`."""
        return NeighborParts(*_slices(1, self.dimension, self.dimension, 1))

    @cached_property
    def obstacle(self) -> ObstacleParts:
        """Slices of a row of :meth:`obstacles`."""
        return ObstacleParts(*_slices(1, self.dimension, 1))

    @cached_property
    def path(self) -> PathParts:
        """Slices of :meth:`paths`."""
        return PathParts(*_slices(self.dimension, 1))

    @cached_property
    def ray_directions(self) -> FloatArray:
        """``(num_rays, 2)`` unit vectors of the rays in the robot's frame, read-only."""
        angles = 2 * np.pi * np.arange(self.num_rays) / max(self.num_rays, 1)
        sine, cosine = portable.sin_cos(angles)
        return read_only(np.stack([cosine, sine], axis=1).astype(np.float32))

    @cached_property
    def size(self) -> int:
        """Number of components ``D``."""
        return self.rays.stop + self.observed_path * self.path[-1].stop

    @property
    def rays(self) -> slice:
        """Slice of the rays."""
        return slice(self._obstacles_end, self._obstacles_end + self.num_rays)

    @property
    def _neighbors_end(self) -> int:
        return self.own[-1].stop + self.num_neighbors * self.neighbor[-1].stop

    @property
    def _obstacles_end(self) -> int:
        return self._neighbors_end + self.num_obstacles * self.obstacle[-1].stop

    def neighbors(self, observations: FloatArray) -> FloatArray:
        """``(..., num_neighbors, .)`` the rows of neighbours of observations ``(..., D)``."""
        rows = observations[..., self.own[-1].stop : self._neighbors_end]
        return rows.reshape(*rows.shape[:-1], self.num_neighbors, self.neighbor[-1].stop)

    def obstacles(self, observations: FloatArray) -> FloatArray:
        """``(..., num_obstacles, .)`` the rows of obstacles of observations ``(..., D)``."""
        rows = observations[..., self._neighbors_end : self._obstacles_end]
        return rows.reshape(*rows.shape[:-1], self.num_obstacles, self.obstacle[-1].stop)

    def paths(self, observations: FloatArray) -> FloatArray:
        """``(..., .)`` what observations ``(..., D)`` say of the path; empty where they do not."""
        return observations[..., self.rays.stop :]

    def with_goal_headings(self, observations: FloatArray, wanted: int) -> FloatArray:
        """Observations ``(..., D)`` with goal headings of so many bodies, zeros where there were none."""
        kept, end = self.own.goal_heading.start + 2 * wanted, self.own[-1].stop
        if kept > end:
            return np.insert(observations, [end] * (kept - end), 0, axis=-1)
        return observations if kept == end else np.delete(observations, slice(kept, end), axis=-1)

    @property
    def names(self) -> tuple[str, ...]:
        """One name per component, as ``neighbor_0.velocity_y``."""
        blocks: list[tuple[str, Parts]] = [("", self.own)]
        blocks += [(f"neighbor_{row}.", self.neighbor) for row in range(self.num_neighbors)]
        blocks += [(f"obstacle_{row}.", self.obstacle) for row in range(self.num_obstacles)]
        listed = [prefix + name for prefix, parts in blocks for name in _component_names(parts)]
        listed += [f"ray_{ray}" for ray in range(self.num_rays)]
        return (*listed, *(f"path.{name}" for name in _component_names(self.path) if self.observed_path))


@dataclass(frozen=True, eq=False)
class ObservationLayout(ObservationSlices):
    """The same with the finite bounds that observations stay in."""

    low: FloatArray  #: ``(D,)`` float32 lower bounds
    high: FloatArray  #: ``(D,)`` float32 upper bounds
    #: Distance of centres beyond which neighbours are not observed [m]
    communication_range: float = field(default=np.inf, kw_only=True)
    #: Whether neighbours behind obstacles are not observed either
    line_of_sight: bool = field(default=False, kw_only=True)

    @classmethod
    def for_problem(
        cls,
        problem: Problem,
        num_neighbors: int = 4,
        num_obstacles: int = 4,
        observed_path: bool = False,
        slack: BoundsSlack = BoundsSlack(),  # noqa: B008 - it is immutable
        num_rays: int = 0,
        ray_range: float = 5.0,
        communication_range: float | None = None,
        line_of_sight: bool = False,
    ) -> ObservationLayout:
        """The layout for a problem, with bounds that no motion of its robots can leave.

        Arguments are as the attributes. There is ``slack`` beyond the bounds for what disturbs the motion or what is
        seen of it, and a ray that meets nothing reads ``ray_range`` [m].

        Raises:
            ValueError: If a number makes no sense, or the robots cannot have rays or a line of sight.
        """
        sizes, turns = (problem.dimension, num_neighbors, num_obstacles), goal_headings(problem)
        parts: dict[str, Any] = {"num_rays": num_rays, "observed_path": observed_path, "goal_headings": turns}
        if line_of_sight and problem.dimension != 2:
            raise ValueError("line_of_sight is for the plane, and this problem is in space; leave it out")
        if num_rays and problem.dimension != 2:
            raise ValueError("rays lie in the plane, and this problem is in space; leave observed_rays out")
        number = partial(positive_number, most=LARGEST)
        low, high = _bounds(problem, ObservationSlices(*sizes, **parts), slack, number(ray_range, "ray_range"))
        limit = np.inf if communication_range is None else number(communication_range, "communication_range")
        return cls(*sizes, low, high, communication_range=limit, line_of_sight=line_of_sight, **parts)

    @property
    def ray_range(self) -> float:
        """The range of the rays [m]; there must be some."""
        return float(self.high[self.rays.start])

    @cached_property
    def bounds(self) -> FloatArray:
        """``(2, D)`` lower and upper bounds in one array, read-only."""
        return read_only(np.stack([self.low, self.high]))


def _bounds(problem: Problem, slices: ObservationSlices, slack: BoundsSlack, ray_range: float) -> FloatArray:
    """``(2, D)`` lower and upper bounds that no motion of the robots can leave, read-only."""
    team, d = problem.team, problem.dimension
    radius, speed, acceleration = (float(x.max()) for x in (team.radius, team.max_speed, team.max_acceleration))
    # No robot gets further than the widest distance between positions, plus a full-speed drive from either end. The
    # speed limit is applied at the end of a step, within which a robot may exceed it.
    drive = (speed + acceleration * problem.dt / 2 + slack.drift) * problem.duration + slack.distance
    widest = np.ptp(np.concatenate([problem.start[:, :d], problem.goal, *problem.world.extremes()]), axis=0)
    # Farthest that anything may be from a robot.
    farthest = float(np.sqrt(np.square(widest).sum())) + 2 * drive + 2 * radius
    top = speed + slack.speed
    own = _ends(
        slices.own, velocity=top, heading=1, speed=top, goal=farthest, time_left=1, arrived=1, radius=radius,
        max_speed=speed, max_acceleration=acceleration, goal_heading=1, goal_hitches=1,
    )  # fmt: skip
    neighbor = _ends(
        slices.neighbor, present=1, position=farthest, velocity=2 * top, radius=max(radius, slack.radius)
    )  # fmt: skip
    obstacle = _ends(slices.obstacle, present=1, position=farthest, gap=farthest)
    rays = np.tile(np.array([[0], [ray_range]], np.float32), slices.num_rays)
    path = _ends(slices.path, direction=1, length=WINDING * farthest)
    parts = [own, *[neighbor] * slices.num_neighbors, *[obstacle] * slices.num_obstacles, rays]
    return read_only(np.concatenate([*parts, *[path] * slices.observed_path], axis=1))


def _ends(parts: Parts, **largest: float) -> FloatArray:
    """``(2, .)`` bounds of parts by their largest values: as far below zero, where they are ever negative."""
    ends: FloatArray = np.empty((2, parts[-1].stop), np.float32)
    for name, high in largest.items():
        part = getattr(parts, name)
        ends[1, part], ends[0, part] = high, 0 if name in _NEVER_NEGATIVE else -high
    return ends


def _slices(*widths: int) -> Iterator[slice]:
    """Yield the slices of parts of these widths, one after the other."""
    return (slice(begin, end) for begin, end in pairwise(accumulate(widths, initial=0)))


def _component_names(parts: Parts) -> Iterator[str]:
    for name, part in zip(parts._fields, parts, strict=True):
        width = part.stop - part.start
        if name == "goal_hitches":
            yield from (f"goal_hitch_{1 + i // 2}_{('cos', 'sin')[i % 2]}" for i in range(width))
            continue
        several = ("_cos", "_sin") if name.endswith("heading") else ("_x", "_y", "_z")
        yield from (name + suffix for suffix in (("",) if width == 1 else several[:width]))
