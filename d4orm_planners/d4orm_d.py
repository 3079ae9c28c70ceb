"""D4orm-D: failure-aware decoupling for big teams (paper, section V, Algorithm 3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar

import numpy as np

from d4orm_env.core import portable
from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.problem import Problem
from d4orm_env.core.seeds import Stream
from d4orm_env.core.trajectory import Trajectory
from d4orm_env.engine.base import MovingObstacles, SamplingTask
from d4orm_planners.base import Iteration, Search
from d4orm_planners.d4orm import D4orm, D4ormConfig
from d4orm_planners.grouping import components, conflicts, failure_groups, independent_robots, reconnected
from d4orm_planners.sampling.schedule import annealed
from d4orm_planners.settings import Count, Positive, Samples, Steps, one_of
from d4orm_planners.steering import Drives, closing_stretches, detours, prepare_drives, straight_drives

Decoupling = Annotated[str, one_of(("independent", "groups"))]
Start = Annotated[str, one_of(("auto", "team", "straight"))]

WIDER = (1.0, 2.0)
"""Factors on the noise of successive repairs: what ordinary noise does not get around, wider noise may."""

VAIN = 2
"""Repairs in vain after which a robot may take a detour."""

DETOURS = 32
"""Random detours that it chooses from."""

JOINTLY, STUCK, STUCK_SIZE = 3, 2, 3
"""Every so many repairs, robots in conflict that were all repaired in vain so often are repaired jointly, if so few."""

SLACK = 40
"""Steps beyond the latest arrival of the robots repaired that their repair looks at."""

SHORTENINGS = 2
"""How many times in turn robots look for shorter ways home."""

EARLIER = (0, 8, 16, 32, 64)
"""Steps before a robot's arrival, or its nearest approach, at which it may turn straight to its goal."""

MISSING_COST = 5.0
"""Conflicts that a robot may get into instead of never arriving, or of touching an obstacle."""

TIME_COST = 0.1
"""Conflicts that a robot may get into instead of using the whole horizon: of two ways as good, the sooner one."""


@dataclass(frozen=True, kw_only=True)
class D4ormDConfig(D4ormConfig):
    """Settings of D4orm-D. The defaults find a first solution soonest; the preset ``"paper"`` is Algorithm 3.

    Attributes:
        num_samples: ``M`` of an iteration over the whole team or a group.
        num_steps: ``N`` of such an iteration.
        big_team: Teams of more robots than this are sampled half as often in iterations over all of them, whose time
            grows with the team while repairs make up for their errors; ``None`` for no such team.
        decoupling: ``"groups"`` replans every group of robots that conflict, the team's reward within it (the paper).
            ``"independent"`` replans robots that have no conflict with each other at once, each by its own reward,
            around all others, and takes over only what is no worse.
        start: What the first iteration does without initial controls. ``"team"`` deforms the whole team at once;
            ``"straight"`` sends everybody straight to its goal and leaves the rest to repairs; ``"auto"`` does the
            second where robots so meet less than half of the others on average.
        first_collisions: Whether the first iteration over the whole team minds collisions.
        repair_samples: ``M`` of an independent repair. A few are better than many: their error is a search of its own.
        repair_steps: ``N`` of an independent repair.
        penalty: What a violation costs per step in an independent repair. At the paper's one it can be cheaper to brush
            past a robot than to wait for it.
    """

    big_team: Count | None = 32
    decoupling: Decoupling = "independent"
    start: Start = "auto"
    first_collisions: bool = True
    repair_samples: Samples = 128
    repair_steps: Steps = 50
    penalty: Positive = 3.0


class D4ormD(D4orm):
    """Failure-aware decoupling: replan only the robots that fail, around all others, until nobody fails."""

    name: ClassVar[str] = "d4orm-d"
    config_class = D4ormDConfig
    presets: ClassVar[dict[str, dict[str, Any]]] = {
        "paper": {
            **D4orm.presets["paper"],
            # The authors' code clips the controls of robots that keep failing; the paper says nothing of it.
            "clip_between_iterations": True,
            "decoupling": "groups",
            "start": "team",
            "first_collisions": False,
            "big_team": None,
        }
    }

    def iterate(self, search: Search) -> Iteration:
        """See :meth:`Planner.iterate`: the whole team at first and once nobody fails, the failed robots in between."""
        with search.watch.paused():
            prepare_drives(search.problem)
        if search.iteration == 0 and not search.current.controls.any():
            drives = self.straight_start(search.problem)
            return self.whole_team(search) if drives is None else Iteration(drives, 0)
        in_groups = self.config.decoupling == "groups"
        if not search.current.failed.any() or (in_groups and search.best.solved):
            return self.whole_team(search)
        repair = _Repair(self, search, search.current.trajectory)
        if in_groups:
            repair.groups()
        else:
            repair.independent()
        return Iteration(repair.controls, repair.denoising_steps, repair.excluded)

    def whole_team(self, search: Search) -> Iteration:
        """Deform everybody's controls at once; unless in groups, then straight home from wherever that is as good."""
        iteration = super().iterate(search)
        if self.config.decoupling == "groups":
            return iteration
        repair = _Repair(self, search, search.engine.rollout(search.problem, iteration.controls))
        repair.shorten()
        return Iteration(repair.controls, iteration.denoising_steps, iteration.excluded)

    def num_samples(self, search: Search) -> int:
        """See :meth:`SamplingPlanner.num_samples`."""
        big = self.config.big_team is not None and search.problem.num_robots > self.config.big_team
        return max(self.config.num_samples // 2, 2) if big else self.config.num_samples

    def task(self, search: Search, base: Any) -> SamplingTask:
        """See :meth:`SamplingPlanner.task`."""
        task = super().task(search, base)
        return replace(task, collisions=search.iteration > 0 or self.config.first_collisions)

    def straight_start(self, problem: Problem) -> Any:
        """Controls ``(H, K, m)`` that send everybody straight to its goal, or ``None`` to start with the whole team."""
        if self.config.start == "team":
            return None
        drives = straight_drives(problem)
        if self.config.start == "auto":
            met = conflicts(drives.positions[1:, :, 0], problem.team.radius, problem.margin).sum(axis=1).mean()
            if met >= problem.num_robots / 2:
                return None
        return drives.controls[:, :, 0]


class _Repair:
    """One iteration over failed robots: the team's controls and what they lead to, changed robot by robot."""

    def __init__(self, planner: D4ormD, search: Search, trajectory: Trajectory) -> None:
        self.planner, self.config = planner, planner.config
        self.search, self.problem = search, search.problem
        self.failed = search.current.failed
        self.controls = trajectory.controls.copy()
        search.memory.setdefault("vain", np.zeros(self.problem.num_robots, int))
        self.positions = trajectory.positions.copy()
        self.arrived = trajectory.arrived[-1].copy()
        self.arrival = np.where(self.arrived, trajectory.arrived.argmax(axis=0), self.problem.horizon)
        self.graph = self.conflicts(self.positions)
        self.denoising_steps = 0
        self.excluded = 0
        self.runs = self.detours = 0

    def conflicts(self, positions: Any) -> Any:
        """``(K, K)`` who comes within the margin of whom after the start."""
        return conflicts(positions[1:], self.problem.team.radius, self.problem.margin)

    def denoise(
        self, robots: Sequence[int], horizon: int, num_samples: int, noise_scale: Any, **scoring: Any
    ) -> tuple[Problem, FloatArray, Trajectory]:
        """Deform these robots' first ``horizon`` controls around all others.

        Returns:
            The problem of these robots alone, their new controls as planned, and the rollout of those in it.
        """
        planner, search, problem = self.planner, self.search, self.problem
        part = problem.select(robots)
        others = [robot for robot in range(problem.num_robots) if robot not in set(robots)]
        moving = None
        if others:
            radius = np.asarray(problem.team.radius)[others]
            moving = MovingObstacles(self.positions[1 : horizon + 1, others], radius)
        base = np.ascontiguousarray(self.controls[:horizon, robots, : part.control_size])
        task = SamplingTask(part.moment(part.start, part.goal, horizon=horizon), base, moving=moving, **scoring)
        rules = planner.rules()
        self.runs += 1
        start, seed = planner.start(search, base, self.runs), search.iteration_seed(Stream.REPAIR, self.runs)
        result = search.denoise(task, rules, start, noise_scale, num_samples, seed)
        self.denoising_steps += len(result.rewards)
        self.excluded += result.excluded
        controls = np.zeros((problem.horizon, len(robots), part.control_size), np.float32)
        controls[:horizon] = base + result.mean
        return part, controls, search.engine.rollout(part, controls)

    def groups(self) -> None:
        """Algorithm 3: every group in turn, the robots outside it as moving obstacles."""
        memory = self.search.memory
        self.controls = self.planner.base(self.search).copy()
        joined = reconnected(self.graph, memory.get("graph"))
        memory["graph"] = self.graph
        for group in failure_groups(self.failed, joined):
            if self.search.should_stop():
                break
            robots, scale = list(group), self.planner.noise_scale()
            part, controls, trajectory = self.denoise(
                robots, self.problem.horizon, self.config.num_samples, scale, credit="team"
            )
            self.controls[:, robots, : part.control_size] = controls
            self.positions[:, robots] = trajectory.positions

    def independent(self) -> None:
        """Robots without conflicts among them at once, each by its own reward; whoever gets worse stays as it was."""
        config, problem = self.config, self.problem
        robots, credit = self.next_robots()
        # Far beyond everyone's arrival there is nothing to search, and what happens there would dilute the rewards.
        horizon = min(int(self.arrival[list(robots)].max()) + SLACK, problem.horizon)
        scale = annealed(config.repair_steps, config.beta_start, config.beta_end)
        distance = np.linalg.norm(problem.goal - problem.start[:, : problem.dimension], axis=1)
        part, _, trajectory = self.denoise(
            robots,
            horizon,
            config.repair_samples,
            scale * np.float32(WIDER[self.search.iteration % len(WIDER)]),
            credit=credit,
            penalty=config.penalty,
            # A robot that starts next to its goal has little to lose by making way, but would lose it many times over.
            reference_distance=float(max(distance.mean(), problem.goal_radius)),
        )
        self.take_over(robots, part, trajectory)
        if not self.graph.any() and self.arrived.all():
            # The detours that got robots out of each other's way are longer than they need be.
            self.shorten()

    def shorten(self) -> None:
        """Let everybody turn home as soon as that is no worse."""
        for _ in range(SHORTENINGS):
            if self.search.should_stop():
                break
            trajectory = self.search.engine.rollout(self.problem, self.controls)
            self.take_over(range(self.problem.num_robots), self.problem, trajectory)

    def next_robots(self) -> tuple[tuple[int, ...], str]:
        """Whom to repair, and by whose reward.

        Failed robots without conflicts among them, those that were not repaired lately first, each by its own reward.
        Now and then a few robots that only together can get out of each other's way, by their team's.
        """
        search = self.search
        vain = search.memory["vain"]
        tired = search.memory.setdefault("tired", np.zeros(self.problem.num_robots))
        random = np.random.default_rng(search.iteration_seed(Stream.REPAIR_ORDER)).random(len(tired))
        order = np.argsort(tired + random - 0.2 * self.graph.sum(axis=1), kind="stable")
        if search.iteration % JOINTLY == 0:
            stuck = [
                group
                for group in components(self.graph)
                if 1 < len(group) <= STUCK_SIZE and vain[list(group)].min() >= STUCK
            ]
            if stuck:
                return stuck[search.iteration // JOINTLY % len(stuck)], "team"
        robots = independent_robots([k for k in order if self.failed[k]], self.graph)
        tired[list(robots)] += 0.3
        tired *= 0.7
        return robots, "robot"

    def take_over(self, robots: Sequence[int], part: Problem, trajectory: Trajectory) -> None:
        """Let robots do as in the trajectory, or turn to their goals in time; whoever gets worse stays as it was."""
        controls, positions, arrived = self.with_closing_stretches(robots, part, trajectory)
        changed = self.positions.copy()
        changed[:, robots] = positions
        graph = self.conflicts(changed)
        index = list(robots)
        before = self.cost(index, self.positions[:, index], self.graph[index], self.arrived[index])
        after = self.cost(index, positions, graph[index], arrived)
        for i in np.flatnonzero(after <= before):
            robot = index[int(i)]
            self.controls[:, robot, : controls.shape[2]] = controls[:, i]
            self.positions[:, robot] = positions[:, i]
            self.arrived[robot] = arrived[i]
        self.graph = self.conflicts(self.positions)
        still = self.cost(index, self.positions[:, index], self.graph[index], self.arrived[index]) > 0
        vain = self.search.memory["vain"]
        vain[index] = np.where(still, vain[index] + 1, 0)

    def cost(self, robots: list[int], paths: Any, near: Any, arrived: Any) -> Any:
        """``(R,)`` conflicts, with those added that a missed goal and contact with an obstacle amount to."""
        return near.sum(axis=1) + MISSING_COST * (~arrived | self.touches_obstacle(robots, paths))

    def touches_obstacle(self, robots: list[int], paths: Any) -> Any:
        """``(R, ...)`` which robots come within the margin of an obstacle on paths ``(H+1, R, ..., d)``."""
        world = self.problem.world
        reach = np.asarray(self.problem.team.radius)[robots] + self.problem.margin
        clearance = world.clearance(paths[1:].reshape(-1, paths.shape[-1])).reshape(len(paths) - 1, len(robots), -1)
        return (clearance <= reach[:, None]).any(axis=0).reshape(paths.shape[1:-1])

    def with_closing_stretches(self, robots: Sequence[int], part: Problem, trajectory: Trajectory) -> Any:
        """The trajectory's ``(controls, positions, arrived)``, with robots turning straight to their goals if better.

        A deformation ends metres from where it was aimed at after a long way: arriving is what sampling does worst, and
        steering does at once. A robot that was repaired in vain some times may take a random detour instead.
        """
        arrived = trajectory.arrived[-1].copy()
        gap = np.linalg.norm(trajectory.positions - part.goal, axis=2)
        nearest = np.where(trajectory.arrived.any(axis=0), trajectory.arrived.argmax(axis=0), gap.argmin(axis=0))
        switch = np.maximum(nearest[:, None] - np.array(EARLIER), 0)
        as_it_is = Drives(trajectory.controls[:, :, None], trajectory.positions[:, :, None], arrived[:, None])
        turning = closing_stretches(part, trajectory.states, trajectory.controls, switch)
        ways = as_it_is.joined(turning)
        vain = self.search.memory["vain"]
        paths = self.positions.copy()
        paths[:, robots] = trajectory.positions
        controls, positions = trajectory.controls.copy(), trajectory.positions.copy()
        for i in np.argsort(-nearest, kind="stable"):
            if self.search.should_stop():
                break
            robot = robots[int(i)]
            own = ways.of(int(i))
            cost = self.costs(robot, own, paths)
            if vain[robot] >= VAIN and cost.min() >= 1:
                own = self.with_detours(part.select([int(i)]), own)
                cost = self.costs(robot, own, paths)
            best = int(np.argmin(cost))
            controls[:, i] = own.controls[:, best]
            positions[:, i] = paths[:, robot] = own.positions[:, best]
            arrived[i] = own.arrived[best]
        return controls, positions, arrived

    def with_detours(self, alone: Problem, ways: Drives) -> Drives:
        """One robot's ways and some more, each by a random point."""
        start, goal = alone.start[0, : alone.dimension], alone.goal[0]
        random = np.random.default_rng(self.search.iteration_seed(Stream.DETOURS, self.detours))
        self.detours += 1
        spread = 0.5 * np.linalg.norm((goal - start)[None], axis=1) + 1
        vias = (
            start
            + random.random((DETOURS, 1)) * (goal - start)
            + spread * portable.standard_normal(random, (DETOURS, alone.dimension))
        )
        return ways.joined(detours(alone, vias[None].astype(np.float32)).of(0))

    def costs(self, robot: int, ways: Drives, paths: Any) -> Any:
        """``(V,)`` costs of ways ``(H+1, V, d)`` of a robot among others on ``paths`` ``(H+1, K, d)``."""
        horizon = self.problem.horizon
        moves = (ways.positions[1:] != ways.positions[:-1]).any(axis=2)
        last_move = horizon - moves[::-1].argmax(axis=0)
        blocked = self.touches_obstacle([robot], ways.positions[:, None])[0]
        met = self.met(robot, ways.positions, paths)
        return met + MISSING_COST * (~ways.arrived | blocked) + TIME_COST * last_move / horizon

    def met(self, robot: int, ways: Any, paths: Any) -> Any:
        """``(V,)`` robots on ``paths`` ``(H+1, K, d)`` that a robot meets on each of its ``ways`` ``(H+1, V, d)``."""
        radius = np.asarray(self.problem.team.radius, np.float32)
        reach2 = (radius + radius[robot] + np.float32(self.problem.margin)) ** 2
        gap2 = sum((paths[1:, :, None, axis] - ways[1:, None, :, axis]) ** 2 for axis in range(paths.shape[2]))
        near = (gap2 <= reach2[:, None]).any(axis=0)
        near[robot] = False
        return near.sum(axis=0)
