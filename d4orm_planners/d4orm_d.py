"""D4orm-D: failure-aware decoupling for big teams (paper, section V, Algorithm 3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray, positive_number, whole_number
from d4orm_env.core.problem import Problem
from d4orm_env.core.trajectory import Trajectory
from d4orm_env.engine.base import MovingObstacles, SamplingTask
from d4orm_planners.base import Iteration, Search
from d4orm_planners.d4orm import D4orm, D4ormConfig
from d4orm_planners.grouping import conflicts, failure_groups, independent_robots, reconnected
from d4orm_planners.steering import closing_stretches

DECOUPLINGS = ("independent", "groups")
WIDER = (1.0, 2.0)
"""Factors on the noise of successive repairs: what ordinary noise does not get around, wider noise may."""

MISSING_COST = 5
"""Conflicts that a robot may get into instead of never arriving."""

EARLIER = (0, 8, 16, 32, 64)
"""Steps before a robot's nearest approach at which it may turn straight to its goal."""


@dataclass(frozen=True, kw_only=True)
class D4ormDConfig(D4ormConfig):
    """Settings of D4orm-D.

    Attributes:
        decoupling: ``"groups"`` replans every group of robots that conflict, the team's reward within it (the paper).
            ``"independent"`` replans robots that have no conflict with each other at once, each by its own reward,
            around all others, and takes over only what is no worse.
        first_collisions: Whether the first iteration, over the whole team, minds collisions.
        repair_samples: ``M`` of an independent repair. A few are better than many: their error is a search of its own.
        penalty: What a violation costs per step in an independent repair. At the paper's one it can be cheaper to brush
            past a robot than to wait for it.
    """

    decoupling: str = "independent"
    first_collisions: bool = True
    repair_samples: int = 128
    penalty: float = 3.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.decoupling not in DECOUPLINGS:
            raise ValueError(f"decoupling {self.decoupling!r} is unknown; choose one of {', '.join(DECOUPLINGS)}")
        if not isinstance(self.first_collisions, bool):
            raise ValueError(f"first_collisions must be True or False, not {self.first_collisions!r}")
        whole_number(self.repair_samples, "repair_samples", 2)
        positive_number(self.penalty, "penalty")


class D4ormD(D4orm):
    """Failure-aware decoupling: replan only the robots that fail, around all others, until nobody fails."""

    name: ClassVar[str] = "d4orm-d"
    config_class = D4ormDConfig
    presets: ClassVar[dict[str, dict[str, Any]]] = {
        "paper": {**D4orm.presets["paper"], "decoupling": "groups", "first_collisions": False}
    }

    def iterate(self, search: Search) -> Iteration:
        """See :meth:`Planner.iterate`: the whole team first and once there is a solution, failed robots in between."""
        if search.iteration == 0 or search.best.solved or not search.current.failed.any():
            return super().iterate(search)
        repair = _Repair(self, search)
        if self.config.decoupling == "groups":
            repair.groups()
        else:
            repair.independent()
        return Iteration(repair.controls, repair.denoising_steps)

    def task(self, search: Search, base: FloatArray) -> SamplingTask:
        """See :meth:`SamplingPlanner.task`."""
        task = super().task(search, base)
        return replace(task, collisions=search.iteration > 0 or self.config.first_collisions)


class _Repair:
    """One iteration over failed robots: the team's controls and what they lead to, changed robot by robot."""

    def __init__(self, planner: D4ormD, search: Search) -> None:
        self.planner, self.config = planner, planner.config
        self.search, self.problem = search, search.problem
        candidate = search.current
        self.failed = candidate.failed
        self.controls = candidate.controls.copy()
        self.positions = candidate.trajectory.positions.copy()
        self.arrived = candidate.trajectory.arrived[-1].copy()
        self.graph = self.conflicts(self.positions)
        self.denoising_steps = 0
        self.stream = 0

    def conflicts(self, positions: FloatArray) -> BoolArray:
        """``(K, K)`` who comes within the margin of whom after the start."""
        return conflicts(positions[1:], self.problem.team.radius, self.problem.margin)

    def denoise(
        self, robots: Sequence[int], num_samples: int, noise_factor: float = 1.0, **scoring: Any
    ) -> tuple[Any, Problem]:
        """Deform these robots' controls around all others; returns the rollout and the problem of these robots."""
        planner, search, problem = self.planner, self.search, self.problem
        part = problem.select(robots)
        others = [robot for robot in range(problem.num_robots) if robot not in set(robots)]
        moving = None
        if others:
            moving = MovingObstacles(self.positions[1:, others], np.asarray(problem.team.radius)[others])
        base = np.ascontiguousarray(self.controls[:, robots, : part.control_size])
        task = SamplingTask(part, base, moving=moving, **scoring)
        rules, noise_scale = planner.rules(), planner.noise_scale() * np.float32(noise_factor)
        with search.watch.paused():
            search.engine.prepare(task, rules, noise_scale, num_samples)
        self.stream += 1
        seed = search.iteration_seed(self.stream)
        result = search.engine.denoise(task, rules, planner.start(search, base), noise_scale, num_samples, seed)
        self.denoising_steps += len(noise_scale)
        return search.engine.rollout(part, base + result.mean), part

    def groups(self) -> None:
        """Algorithm 3: every group in turn, the robots outside it as moving obstacles."""
        memory = self.search.memory
        joined = reconnected(self.graph, memory.get("graph"))
        memory["graph"] = self.graph
        for group in failure_groups(self.failed, joined):
            robots = list(group)
            trajectory, part = self.denoise(robots, self.config.num_samples, credit="team")
            self.controls[:, robots, : part.control_size] = trajectory.controls
            self.positions[:, robots] = trajectory.positions

    def independent(self) -> None:
        """Robots without conflicts among them at once, each by its own reward; whoever gets worse stays as it was."""
        memory, search = self.search.memory, self.search
        random = np.random.default_rng(search.iteration_seed(0))
        tired = memory.setdefault("tired", np.zeros(self.problem.num_robots))
        order = np.argsort(tired + random.random(len(tired)) - 0.2 * self.graph.sum(axis=1))
        robots = independent_robots([k for k in order if self.failed[k]], self.graph)
        distance = np.linalg.norm(self.problem.goal - self.problem.start[:, : self.problem.dimension], axis=1)
        trajectory, part = self.denoise(
            robots,
            self.config.repair_samples,
            WIDER[search.iteration % len(WIDER)],
            credit="robot",
            penalty=self.config.penalty,
            reference_distance=float(max(distance.mean(), self.problem.goal_radius)),
        )
        self.accept(robots, *self.with_closing_stretches(robots, part, trajectory))
        tired[list(robots)] += 0.3
        tired *= 0.7

    def with_closing_stretches(self, robots: Sequence[int], part: Problem, trajectory: Trajectory) -> Any:
        """The trajectory's ``(controls, positions, arrived)``; who does not arrive turns straight to its goal in time.

        A deformation ends metres from where it was aimed at after a long way: arriving is what sampling does worst, and
        steering does at once.
        """
        controls, positions = trajectory.controls.copy(), trajectory.positions.copy()
        arrived = trajectory.arrived[-1].copy()
        missing = [int(robot) for robot in np.flatnonzero(~arrived)]
        if not missing:
            return controls, positions, arrived
        late = part.select(missing)
        gap = np.linalg.norm(positions[:, missing] - late.goal, axis=2)
        switch = np.maximum(gap.argmin(axis=0)[:, None] - np.array(EARLIER), 0)
        switch = np.minimum(switch, part.horizon - 1)
        size = late.control_size
        stretches = closing_stretches(
            late, trajectory.states[:, missing, : late.state_size], controls[:, missing, :size], switch
        )
        for i, robot in enumerate(missing):
            options = np.flatnonzero(stretches.arrived[i])
            if len(options):
                costs = [self.conflicts_of(robots[robot], stretches.positions[:, i, v]).sum() for v in options]
                best = options[int(np.argmin(costs))]
                controls[:, robot, :size] = stretches.controls[:, i, best]
                positions[:, robot] = stretches.positions[:, i, best]
                arrived[robot] = True
        return controls, positions, arrived

    def conflicts_of(self, robot: int, path: FloatArray) -> BoolArray:
        """``(K,)`` who comes within the margin of a robot on this path ``(H+1, d)``."""
        radius = np.asarray(self.problem.team.radius)
        reach = radius + radius[robot] + self.problem.margin
        near = (((self.positions[1:] - path[1:, None]) ** 2).sum(axis=2) <= reach**2).any(axis=0)
        near[robot] = False
        return near

    def accept(self, robots: Sequence[int], controls: FloatArray, positions: FloatArray, arrived: BoolArray) -> None:
        """Take over the robots whose conflicts, arrival and contacts with obstacles are together no worse."""
        world, problem = self.problem.world, self.problem
        reach = np.asarray(problem.team.radius)[list(robots)] + problem.margin
        changed = self.positions.copy()
        changed[:, robots] = positions
        graph = self.conflicts(changed)

        def cost(paths: FloatArray, near: BoolArray, home: BoolArray) -> Any:
            clearance = world.clearance(paths[1:].reshape(-1, paths.shape[2])).reshape(-1, len(reach))
            return near.sum(axis=1) + MISSING_COST * (~home + (clearance <= reach).any(axis=0))

        before = cost(self.positions[:, robots], self.graph[list(robots)], self.arrived[list(robots)])
        after = cost(positions, graph[list(robots)], arrived)
        for i in np.flatnonzero(after <= before):
            robot = robots[int(i)]
            self.positions[:, robot] = positions[:, i]
            self.controls[:, robot, : controls.shape[2]] = controls[:, i]
