"""The motions of a team, with which the hybrid planner begins and which it improves in every iteration: planned one
robot after another among the others, and replanned for a few at a time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from itertools import count

import numpy as np

from d4orm_env.core.arrays import FloatArray, IntArray
from d4orm_env.core.problem import Problem
from d4orm_env.engine.threads import Threads, available_cores
from d4orm_planners.manoeuvres.closing import ends_of
from d4orm_planners.manoeuvres.detours import anywhere, on_fixed_path, starting_from, without_goal
from d4orm_planners.manoeuvres.lattice import buffer_size
from d4orm_planners.manoeuvres.nodes import Nodes
from d4orm_planners.manoeuvres.primitives import POSE_SIZE
from d4orm_planners.manoeuvres.robots import ManoeuvreScene, Robot, make_robot, scene_of
from d4orm_planners.manoeuvres.search import PAUSED, Motion, find_motion, motion_to
from d4orm_planners.manoeuvres.shortening import shortened
from d4orm_planners.manoeuvres.tight_places import motion_by_the_open
from d4orm_planners.manoeuvres.traffic import NEVER, Traffic, meets_nobody, traffic_of
from d4orm_planners.mapf.lns import Odds
from d4orm_planners.tracking.steering import advanced

MAX_NODES = 100_000  #: Nodes after which a search gives up, ...
FIRST_NODES = 400_000
"""... and among others at first a robot's share of so many, once more after every four searches of each: in a large
team it is quicker to change others' motions."""
DETOUR_NODES = MAX_NODES // 5  #: Nodes of which one is drawn for a robot to go to first
CELLS = (1.0, 0.8, 0.6)
"""Sizes of cells that are tried in turn for a robot alone, as shares of the usual one: whether poses that count as one
leave a way through a tight place is chance."""


class TeamMotions:
    """The motions of a team, as a low-level planner of :mod:`~d4orm_planners.mapf.lns`.

    Args:
        scene: What all robots share.
        robots: What the search knows of each.
        should_stop: Whether time is up.
        before: ``(T, K, m)`` controls that bring the team to where the motions begin, none by default.

    Attributes:
        robots: What the search knows of each.
        motions: Of each robot, ``None`` for those that have none yet.
        alone: Their motions if there were nobody else.
        late: Whether the first robot of a neighbourhood may set out late, so that others get out of its way.
        detours: Whether it goes somewhere else first, and lets them by.
    """

    groups = 1

    def __init__(
        self,
        scene: ManoeuvreScene,
        robots: list[Robot],
        should_stop: Callable[[], bool],
        before: FloatArray | None = None,
    ) -> None:
        self.problem, self.robots, self.should_stop, self._before = scene.problem, robots, should_stop, before
        self._area, self._interaction_range, problem = scene.area, scene.interaction_range, scene.problem
        size, horizon = problem.num_robots, problem.horizon
        self._poses = np.empty((size, horizon + 1, POSE_SIZE), np.float32)
        self._poses[:] = np.array([robot.start for robot in self.robots])[:, None]
        self.motions: list[Motion | None] = [None] * size
        self.alone: list[Motion | None] = [None] * size
        self.late = self.detours = False
        still = np.zeros((size, problem.control_size), np.float32)
        self._rests = (advanced(problem, problem.start, still) == problem.start).all(axis=1)
        nobody = self._traffic((), {})

        def find_alone(part: IntArray) -> None:
            nodes, searches = self._room_for_nodes(), count(1)
            for robot in range(part[0], part[1]):
                usual = self.robots[robot]
                for share in CELLS:
                    if share < 1.0:
                        self.robots[robot] = make_robot(scene.with_cells(share), robot) or usual
                    self.alone[robot] = self._search(robot, nobody, nodes, next(searches), MAX_NODES)
                    if self.alone[robot] is not None or should_stop():
                        break
                else:
                    self.robots[robot] = usual
                    self.alone[robot] = self._by_the_open(scene, robot, nobody, nodes, searches)
                if self.alone[robot] is None:
                    return  # nor will the team have any

        Threads(available_cores()).over(size, find_alone)
        self._nodes, self._searches = self._room_for_nodes(), size

    @classmethod
    def prepared(
        cls, problem: Problem, should_stop: Callable[[], bool], before: FloatArray | None = None
    ) -> TeamMotions | None:
        """A team without motions; ``None`` if time is up, or a robot has none even alone."""
        scene = scene_of(problem)
        robots: dict[int, Robot] = {}

        def prepare(part: IntArray) -> None:
            for number in range(part[0], part[1]):
                robot = None if should_stop() else make_robot(scene, number)
                if robot is not None:
                    robots[number] = robot

        Threads(available_cores()).over(problem.num_robots, prepare)
        if len(robots) < problem.num_robots:
            return None
        team = cls(scene, [robots[number] for number in range(problem.num_robots)], should_stop, before)
        return None if any(motion is None for motion in team.alone) else team

    @property
    def missing(self) -> int:
        """Number of robots without a motion."""
        return sum(motion is None for motion in self.motions)

    @property
    def cost(self) -> tuple[int, int]:
        """Number of robots without a motion, or, once all have one, the sum of their steps."""
        steps = [motion.steps for motion in self.motions if motion is not None]
        return (0, sum(steps)) if len(steps) == len(self.motions) else (self.missing, 0)

    def plan_all(self) -> None:
        """Plan one robot after the other, each among those before it, those first that take longest."""
        steps = [-1 if motion is None else motion.steps for motion in self.alone]
        self._plan_in_turn(np.argsort(-np.array(steps), kind="stable").tolist(), {})

    def leave_out(self, robots: Iterable[int]) -> None:
        """Forget the motions of some robots."""
        for robot in robots:
            self._take(robot, None)

    def odds(self, random: np.random.Generator) -> Odds:
        """See :meth:`LowLevelPlanner.odds`: robots without a motion are late, or else those that are slower."""
        missing = np.array([motion is None for motion in self.motions])
        if missing.any():
            delay = missing.astype(float)
        else:
            steps = np.array([[own.steps for own in some if own] for some in (self.motions, self.alone)], float)
            delay = np.maximum(steps[0] - steps[1], 1.0)
        positions = self._poses[:, :, :2].swapaxes(0, 1).copy()
        until = np.full(len(missing), self.problem.horizon)
        for robot in np.flatnonzero(missing):
            own = self.alone[robot]
            if own is not None:
                positions[: own.steps + 1, robot], positions[own.steps :, robot] = own.poses[:, :2], own.poses[-1, :2]
        return Odds(delay, positions, until, 4 * self._interaction_range, (2, 4))

    def replan(self, groups: list[IntArray], random: np.random.Generator, temperature: float) -> None:
        """See :meth:`LowLevelPlanner.replan`; those still to be planned wait at their starts for a while, or not."""
        for group in groups:
            before, cost, order = self.motions.copy(), self.cost, group.tolist()
            if random.random() < 0.5:
                order.sort(key=lambda robot: before[robot] is not None)
            longest = max((own.steps for own in self.alone if own is not None), default=0)
            held = {robot: int(longest * random.random() ** 2) * int(random.integers(2)) for robot in order}
            delay = int(longest * random.random()) if self.late and self._rests[order[0]] else 0
            for robot in order:
                self._take(robot, None)
            if self.detours and (detour := self._detour(order[0], random)) is not None:
                self._take(order.pop(0), detour)
            self._plan_in_turn(order, held, delay)
            if cost[0] == self.missing == 0:
                self.shorten(group.tolist(), random)
            if self.cost > cost:
                for robot, motion in enumerate(before):
                    self._take(robot, motion)

    def _plan_in_turn(self, order: list[int], held: dict[int, int], delay: int = 0) -> None:
        for position, robot in enumerate(order):
            if self.should_stop():
                return
            others = [other for other in range(len(self.motions)) if other != robot]
            later = {other: held.get(other, 0) for other in order[position + 1 :]}
            self._take(robot, self._find(robot, self._traffic(others, later), 0 if position else delay))

    def shorten(self, robots: Iterable[int], random: np.random.Generator) -> None:
        """Shorten the motions of some robots, one after the other, each among those of all others."""
        for robot in robots:
            own, motion, others = self.robots[robot], self.motions[robot], [*range(len(self.robots))]
            if motion is None or self.should_stop():
                continue
            others.remove(robot)
            start, ends = self.problem.start[robot], ends_of(self.problem, robot, own.task.goal, motion.poses[-1])
            traffic = self._traffic(others, {})
            self._take(robot, shortened(own, start, ends, motion, traffic, self._nodes, random))

    def _detour(self, number: int, random: np.random.Generator) -> Motion | None:
        """A robot's motion by way of somewhere else, drawn at random, where it stands for a while; if one is found."""
        robot, nodes, others = self.robots[number], self._nodes, [*range(number), *range(number + 1, len(self.robots))]
        self._searches += 2
        first, second = self._searches - 1, self._searches
        self._search(number, self._traffic(others, {}), nodes, first, DETOUR_NODES, without_goal(robot))
        found, alone = anywhere(robot, nodes, random), self.alone[number]
        if found is None or alone is None:
            return None
        node, there = found
        wait = int(2 * (there.steps + alone.steps) * random.random())
        since = there.steps + wait
        if since >= self.problem.horizon:
            return None
        robot = starting_from(robot, nodes, node, since)
        on = self._search(number, self._traffic(others, {}, since), nodes, second, MAX_NODES, robot)
        return None if on is None else there.followed_by(on, wait)

    def _take(self, robot: int, motion: Motion | None) -> None:
        self.motions[robot] = motion
        self._poses[robot] = self.robots[robot].start
        if motion is not None:
            self._poses[robot, : motion.steps + 1] = motion.poses
            self._poses[robot, motion.steps :] = motion.poses[-1]

    def _traffic(self, others: Iterable[int], held: dict[int, int], since: int = 0) -> Traffic:
        """The motions of others from a step on, and their starts if they are held there for some steps."""
        last, gone = np.full(len(self.robots), -1), np.full(len(self.robots), NEVER)
        for other in others:
            if (motion := self.motions[other]) is not None:
                last[other] = max(motion.steps - since, 0)
        for other, steps in held.items():
            if steps > 0:
                last[other], gone[other] = 0, steps
        poses = np.ascontiguousarray(self._poses[:, since:])
        return traffic_of(poses, last, gone, self._area.low, self._area.high, self._interaction_range)

    def _room_for_nodes(self) -> Nodes:
        return Nodes.of(MAX_NODES, buffer_size(self.problem.team.all_footprint_arrays))

    def _find(self, number: int, traffic: Traffic, delay: int) -> Motion | None:
        """A robot's motion among others: that which it would take alone, later by some steps, or else one that is
        looked for.
        """
        alone, team = self.alone[number], len(self.robots)
        if alone is not None and alone.steps + delay <= self.problem.horizon:
            alone = alone.later(delay)
        if alone is not None and meets_nobody(self.robots[number].task.body, traffic, alone.poses, self._nodes.buffer):
            return alone
        self._searches += 1
        most = FIRST_NODES // team * (1 + self._searches // (4 * team))
        motion = self._search(number, traffic, self._nodes, self._searches, most)
        # Nodes may run out long before a robot that need only wait for others has seen all places to do so.
        if motion is None and alone is not None and self._nodes.heap.filled[0] > 0:
            fixed = on_fixed_path(self.robots[number], alone)
            self._searches += 1
            motion = self._search(number, traffic, self._nodes, self._searches, most, fixed)
        return motion

    def _by_the_open(
        self, scene: ManoeuvreScene, number: int, nobody: Traffic, nodes: Nodes, searches: Iterator[int]
    ) -> Motion | None:
        """A robot's motion if there were nobody else, out of and into tight places."""

        def find(robot: Robot, most: int) -> Motion | None:
            return self._search(number, nobody, nodes, next(searches), most, robot)

        return motion_by_the_open(scene, self.robots[number], nobody, nodes, find)

    def _search(
        self, number: int, traffic: Traffic, nodes: Nodes, search: int, most: int, instead: Robot | None = None
    ) -> Motion | None:
        """Look for a robot's motion in about so many nodes, or for that of another one instead."""
        robot = instead or self.robots[number]
        task = robot.task._replace(number=search)
        nodes.filled[0] = 0
        goes_on, node = False, PAUSED
        while node == PAUSED and nodes.filled[0] < most and not self.should_stop():
            node = find_motion(task, traffic, nodes, robot.start, robot.mode, goes_on)
            goes_on = True
        return None if node < 0 else motion_to(robot, task, nodes, node)

    def controls(self) -> FloatArray:
        """``(H, K, m)`` of the whole team; a robot without a motion is at rest."""
        problem = self.problem
        controls = np.zeros((problem.horizon, problem.num_robots, problem.control_size), np.float32)
        for robot, motion in enumerate(self.motions):
            if motion is not None:
                controls[: motion.steps, robot, : motion.controls.shape[1]] = motion.controls
        return controls if self._before is None else np.concatenate([self._before, controls])
