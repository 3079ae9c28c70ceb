"""A team that drives on a roadmap: on paths planned one after another, and on better ones for some robots at a time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product
from typing import TypeAlias

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray, Floats, IntArray
from d4orm_env.core.problem import Problem
from d4orm_env.core.trajectory import Trajectory, arrival_steps
from d4orm_env.dynamics.robot_model import ACCELERATION, SPEED
from d4orm_env.engine.threads import Threads, available_cores
from d4orm_env.paths.spaces import make_space
from d4orm_planners.mapf.lacam import TeamOnRoadmap
from d4orm_planners.mapf.near_neighbours import sort_into_cells
from d4orm_planners.mapf.occupancy import Occupancy, Others, find_meetings
from d4orm_planners.mapf.precedence import join_routes, make_routes, stops_of
from d4orm_planners.mapf.replanning import find_path
from d4orm_planners.mapf.reservations import Reservations, Trip, make_reservations, straighten, turn_on_the_spot
from d4orm_planners.mapf.roadmap import WALL_SLACK, Roadmap
from d4orm_planners.tracking.path_drives import Corners, drive_routes
from d4orm_planners.tracking.timed_path import drive_by_clock

FIRST_CUT = 0.2  #: Most by which corners are cut on first routes, in radii of the largest robot, as all lengths below
SPEED_PROFILES = ((1.0, 5 / 3, False), (0.9, 2 / 3, True), (0.75, 0.2, True), (0.6, 1 / 15, True))
"""Shares of its speed that a robot is taken to drive at when its path is planned, by how much it cuts corners, and
whether the steps that it turns on the spot count; the next where it is late so, or comes too near to something."""
LEISURE = 0.1  #: Share of that by which it is slower, at most: drawn per path, so that no two searches are alike
LAUNCH = 0.4  #: Share of the time to full speed that setting out costs
OVERTIME = 3  #: Horizons within which first routes must be driven; they become shorter afterwards
BOUND_FACTOR, BOUND_EXTRA = 1.5, 60  #: Bounds of the first search for a path: times as long as alone, and steps more
FAR = 1e9  #: Position of robots that are not there yet [m]
LATER = 30  #: Steps by which a robot may come later for the sake of others
KEEP, TOUCH, ROUNDING = 0.4, 1 / 30, 2.0**-17
"""Distances beyond radii and margin that a path is planned to keep, where starts and goals allow it, and keeps; and
what starts and goals themselves must be apart less, for rounding."""
Drive: TypeAlias = tuple[FloatArray, Floats, int]  #: Controls ``(T, m)``, positions ``(T + 1, 3)``, step of arrival


@dataclass(frozen=True, eq=False)
class TeamRollout:
    """Rollout of a team."""

    controls: FloatArray  #: ``(T, K, m)`` float32
    positions: Floats  #: ``(T + 1, K, 3)`` float64 [m]
    arrivals: IntArray  #: ``(K,)`` int64 step of arrival; ``T + 1`` or more for one that has not arrived

    @classmethod
    def of(cls, trajectory: Trajectory) -> TeamRollout:
        """Return the rollout of a team that docks."""
        positions = np.zeros((*trajectory.positions.shape[:2], 3))
        positions[..., : trajectory.positions.shape[2]] = trajectory.positions
        return cls(trajectory.controls, positions, arrival_steps(trajectory.arrived))

    def cost(self, horizon: int) -> tuple[int, int]:
        """Less is better: robots that come too late, and the sum of all arrival steps."""
        return int((self.arrivals > horizon).sum()), int(self.arrivals.sum())

    def until(self, horizon: int) -> FloatArray:
        """Controls ``(H, K, m)``, at rest after the last arrival and cut off at the horizon."""
        controls = np.zeros((horizon, *self.controls.shape[1:]), np.float32)
        controls[: len(self.controls)] = self.controls[:horizon]
        return controls


def drive_moves(problem: Problem, roadmap: Roadmap, moves: IntArray) -> TeamRollout:
    """Drive a team along the moves of a search."""
    stops = stops_of(roadmap, moves, problem.num_robots)
    routes = join_routes(
        problem, make_routes(problem, stops, range(problem.num_robots), FIRST_CUT * problem.team.largest_radius)
    )
    return TeamRollout(*drive_routes(problem, routes, OVERTIME * problem.horizon))


class Replanning:
    """Better paths for some robots of a team at a time, planned one after another around all others as they drive.

    After ``dwell`` steps an arrived robot is no obstacle any more, for it goes on to another goal; ``None``: it stays.
    """

    def __init__(self, problem: Problem, roadmap: Roadmap, dwell: int | None = None) -> None:
        self.problem, self.roadmap, self.dwell = problem, roadmap, dwell
        self.cells = sort_into_cells(roadmap.flat, float(2 * np.asarray(problem.team.girth).max() + problem.margin))
        self.space = make_space(problem) if problem.world.num_obstacles else None
        self.bodies, self.size = TeamOnRoadmap(problem, roadmap).bodies, problem.team.largest_radius
        speed, acceleration = np.asarray(problem.team.limits, np.float64)[:, [SPEED, ACCELERATION]].T
        self.strides = problem.dt * speed
        self.launch = np.round(LAUNCH * speed / acceleration / problem.dt).astype(np.int64)
        positions, flat = (
            [nodes[ends] for ends in (roadmap.starts, roadmap.goals)] for nodes in (roadmap.nodes, roadmap.flat)
        )
        gaps = [np.sqrt(((ends[:, None] - ends) ** 2).sum(axis=2)) for ends in flat]
        self.ends_apart = np.minimum(gaps[0], gaps[1] - self.bodies.goal_radius) - ROUNDING * self.size
        # Who turns in place need not back up.
        self.backing = [(False,) if model.turns_in_place else (False, True) for model in problem.team.robot_models]
        self.turns = [turn_on_the_spot(problem, robot) for robot in range(problem.num_robots)]
        rooms = [problem.world.clearance(ends[:, : problem.dimension]) for ends in positions]
        self.own_room = np.minimum(*rooms) - TOUCH * self.size
        self.threads = Threads(min(2, available_cores()))
        #: ``(K,)`` about how many steps each robot takes by itself
        self.alone = self.bodies.costs[np.arange(problem.num_robots), roadmap.starts] / self.strides

    def replan(
        self, driven: TeamRollout, robots: IntArray, random: np.random.Generator, should_stop: Callable[[], bool]
    ) -> TeamRollout | None:
        """The team with new paths for some robots, planned in their order; ``None`` if one finds none, or in time."""
        last = int(driven.arrivals.max())
        changed = TeamRollout(
            driven.controls[:last].copy(), driven.positions[: last + 1].copy(), driven.arrivals.copy()
        )
        occupancy = Occupancy(self.cells, changed.positions, self.flatten)
        occupancy.put(robots, FAR)
        latest = np.minimum(driven.arrivals + LATER, last)
        for robot in robots.tolist():
            if should_stop() or not self.replan_one(changed, occupancy, robot, int(latest[robot]), random):
                return None
        return changed

    def flatten(self, positions: Floats) -> Floats:
        """Positions ``(..., 3)`` as others see them; see :meth:`Team.flattened`."""
        return self.problem.team.flattened(positions, self.problem.margin)

    def leaves(self, arrival: int) -> int | None:
        """The step from which on a robot that arrives at a step is no obstacle any more, if any."""
        return None if self.dwell is None else arrival + self.dwell + 1

    def separation(self, robot: int, beyond: float) -> Floats:
        """``(K,)`` how far a robot keeps from each other beyond radii and margin, where ends are so far apart [m]."""
        safety_distance = self.bodies.radius[robot] + self.bodies.radius + self.bodies.margin + beyond * self.size
        need: Floats = np.minimum(safety_distance, self.ends_apart[robot])
        need[robot] = 0.0
        return need

    def replan_one(
        self,
        driven: TeamRollout,
        occupancy: Occupancy,
        robot: int,
        latest: int,
        random: np.random.Generator,
        minded: BoolArray | None = None,
        release: int = 0,
    ) -> bool:
        """Plan a robot's path around those that it minds in ``driven``, which is changed; return whether it has one.

        It does not set out before step ``release``.
        """
        haste, others = 1 - random.random() * LEISURE, occupancy.around(self.separation(robot, KEEP))
        if minded is not None:
            others = others._replace(need=np.where(minded, others.need, 0.0))
        reservations = make_reservations(self.roadmap, self.bodies, others, robot, latest, self.dwell is None)
        close, usual = None, min(TOUCH * self.size, float(self.own_room[robot] - self.bodies.safety_distance[robot]))
        for path, cut in self.paths(reservations, robot, latest, haste, release):
            if not len(path):  # and hardly one for a slower robot
                break
            for drive in self.drives(robot, path, cut, others.positions.shape[1] - 1):
                room = self.room_at_walls(others, robot, drive, latest)
                if room > usual:
                    self.take(driven, occupancy, robot, drive)
                    return True
                if close is None and room > self.problem.rounding:
                    close = drive
        if close is not None:
            self.take(driven, occupancy, robot, close)
        return close is not None

    def take(self, driven: TeamRollout, occupancy: Occupancy, robot: int, drive: Drive) -> None:
        """Let a robot drive so in ``driven``."""
        driven.controls[:, robot], positions, driven.arrivals[robot] = drive
        if self.dwell is not None:
            positions[self.leaves(drive[2]) :] = FAR
        occupancy.put(robot, positions)

    def paths(
        self, reservations: Reservations, robot: int, latest: int, haste: float, release: int = 0
    ) -> Iterator[tuple[IntArray, float]]:
        """A robot's path in each of the :data:`SPEED_PROFILES`, and by how much it cuts corners."""
        # Two are looked for side by side, because the second one is often needed.
        found: dict[int, IntArray] = {}
        dwell, (turn, facing) = -1 if self.dwell is None else self.dwell, self.turns[robot]

        def look(part: IntArray) -> None:
            for each in range(number + part[0], number + part[1]):
                share, _, counts_turns = SPEED_PROFILES[each]
                stride, turns = share * haste * self.strides[robot], turn * counts_turns
                trip = Trip(stride, self.launch[robot], latest, dwell, turns, facing, release)
                found[each] = self.path(reservations, robot, trip)

        for number, (_, cut, _) in enumerate(SPEED_PROFILES):
            if number not in found:
                self.threads.over(self.threads.num_threads, look)
            yield found[number], cut

    def path(self, reservations: Reservations, robot: int, trip: Trip) -> IntArray:
        """``(n, 3)`` int64 nodes of a robot's path, and when it sets out for and reaches each; empty without one."""
        roadmap, bodies = self.roadmap, self.bodies
        # Looked for among the sooner ones at first, because that is where it mostly is.
        soon = int(BOUND_FACTOR * self.alone[robot]) + BOUND_EXTRA + trip.release
        for latest in sorted({min(soon, trip.latest), trip.latest}):
            trip = trip._replace(latest=int(latest))
            path = find_path(roadmap, bodies, reservations, robot, trip)
            if len(path):
                safety_distance = bodies.safety_distance[robot] * (1 + WALL_SLACK * 2 / 3)
                left = straighten(roadmap, bodies, self.space, reservations.others, robot, safety_distance, trip, path)
                return path[:left]
        return path

    def drives(self, robot: int, path: IntArray, cut: float, steps: int) -> Iterator[Drive]:
        """Rollouts of a robot along a path, in so many steps."""
        nodes, departs, arrives = path.T
        ends = np.array([0, len(path)])
        stops = Corners(self.roadmap.nodes[nodes], ends, departs.astype(float), arrives.astype(float))
        route = make_routes(self.problem, stops, [robot], cut * self.size)[0]
        # As soon as it can, or else by the clock of its path.
        for backs_up, hurrying in product(self.backing[robot], (True, False)):
            yield drive_by_clock(self.problem, robot, route, stops, steps, hurrying=hurrying, backs_up=backs_up)

    def room_at_walls(self, others: Others, robot: int, drive: Drive, latest: int) -> float:
        """Room that a robot's rollout leaves at obstacles beyond its margin [m]; -inf if late or too near to others."""
        _, positions, arrival = drive
        if arrival > latest:
            return -np.inf
        touch, met = np.minimum(self.separation(robot, TOUCH), others.need), np.empty(len(others.need), bool)
        find_meetings(others._replace(need=touch), self.flatten(positions[: self.leaves(arrival)]), met)
        if met.any():
            return -np.inf
        if self.space is None:
            return np.inf
        room = self.problem.world.clearance(positions[1 : arrival + 1, : self.problem.dimension])
        return float(room.min() - self.bodies.safety_distance[robot])
