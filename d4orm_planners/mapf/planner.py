"""Path finding on a roadmap, driven under the robots' dynamics and improved step by step: no sampling at all."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from d4orm_env.core.arrays import LARGEST, BoolArray, FloatArray, IntArray
from d4orm_env.core.problem import Problem
from d4orm_env.core.problem_checks import MAX_HORIZON
from d4orm_env.core.seeds import Stream
from d4orm_env.core.world import World
from d4orm_planners.base.planner import Iteration, Planner, PlannerConfig
from d4orm_planners.base.settings import Count
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.mapf.lacam import TeamOnRoadmap, find_moves
from d4orm_planners.mapf.lns import Odds, search_neighbourhoods
from d4orm_planners.mapf.one_by_one import plan_one_by_one, settle
from d4orm_planners.mapf.replanning import is_compiled
from d4orm_planners.mapf.roadmap import fill_costs, lay_roadmap
from d4orm_planners.mapf.roadmap_team import FAR, Replanning, TeamRollout, drive_moves

NEARNESS = 10 / 3  #: Random distance by which a robot may be farther and still replanned too, in largest radii
ONE_BY_ONE = (1.6, 3.0, 1.6, 3.0, 4.0)  #: Fineness of the roadmaps of searches one by one; these differ by chance too
ALL_AT_ONCE = (1.6, 1.25, 1.0, 2.2, 3.0)
"""Fineness of those on which paths are then looked for all at once; see
:func:`~d4orm_planners.mapf.roadmap.lay_roadmap`."""
PATIENCE = (50, 1.5)  #: Paths, and paths per robot, after which the next roadmap is tried if no fewer robots wait
MAX_ROBOT_STEPS = 4_000_000  #: Most steps of all robots together, whose drives are kept several times over
DETOUR_RATIO = 1.25  #: Ratio of path to straight line from which it is a detour; on a lattice any may be 1.1
LEISURELY = 10  #: Horizon of the small problems that kernels are compiled with, in straight drives at full speed
NOT_IN_TIME = "no paths found on the roadmaps in time"
STEPS = 3000  #: Steps of path finding for all at once after which the next roadmap is tried
RELAY_FINENESS = 1.6  #: Fineness of the roadmap of a team with ever new goals
DWELL = 1.0  #: Time for which others keep off the goal of an arrived robot, which then drives on to another [s]


@dataclass
class RoadmapPaths:
    """Low-level planner of :func:`~d4orm_planners.mapf.lns.search_neighbourhoods`: paths in space and time."""

    replanning: Replanning  #: Search for paths
    solution: TeamRollout  #: Rollout of the team
    most: int  #: Robots that are replanned together, at most
    should_stop: Callable[[], bool]  #: Asked before every path
    groups: int = 1

    @property
    def cost(self) -> tuple[int, int]:
        return self.solution.cost(self.replanning.problem.horizon)

    def odds(self, random: np.random.Generator) -> Odds:
        """See :meth:`LowLevelPlanner.odds`: often one of those that come too late."""
        driven, replanning = self.solution, self.replanning
        delay = np.maximum(driven.arrivals - replanning.alone, 1.0)
        late = driven.arrivals > replanning.problem.horizon
        if late.any() and random.random() < 0.5:
            delay[~late] = 0.0
        sizes = (1, min(len(delay), self.most))
        return Odds(delay, driven.positions, driven.arrivals, NEARNESS * replanning.size, sizes)

    def replan(self, groups: list[IntArray], random: np.random.Generator, temperature: float) -> None:
        """See :meth:`LowLevelPlanner.replan`; what is worse is never accepted."""
        for robots in groups:
            changed = self.replanning.replan(self.solution, robots, random, self.should_stop)
            if changed is not None and changed.cost(self.replanning.problem.horizon) < self.cost:
                self.solution = changed


@dataclass(frozen=True, kw_only=True)
class MAPFConfig(PlannerConfig):
    """Settings of path finding."""

    max_iterations: Count = 1000
    neighbours: Count = 8  #: Robots that are replanned together, at most
    replannings: Count = 8  #: Groups of robots that are replanned in an iteration


@dataclass(frozen=True, eq=False)
class RoadmapSolution:
    """The state of the search."""

    replanning: Replanning  #: Search for better paths
    driven: TeamRollout  #: Rollout of the team on those that there are

    def iteration(self, search: SolveRun) -> Iteration:
        """The team's controls within the horizon."""
        return Iteration(self.driven.until(search.problem.horizon))

    def going_on_from_best(self, search: SolveRun) -> RoadmapSolution:
        """The solution of a team that drives as in the best plan so far."""
        return replace(self, driven=TeamRollout.of(search.best.trajectory))

    def improved(self, search: SolveRun, config: MAPFConfig) -> RoadmapSolution:
        """Replan some groups of robots; what is no better for all together is left."""
        paths = RoadmapPaths(self.replanning, self.driven, config.neighbours, search.should_stop)
        random = np.random.default_rng(search.iteration_seed(Stream.GUIDANCE))
        search_neighbourhoods(paths, random, config.replannings, search.should_stop)
        return replace(self, driven=paths.solution)


@dataclass(frozen=True)
class NoPaths:
    """The state of the search when no paths were found."""

    why: str  #: For the record of the iterations
    unreachable: tuple[int, ...] = ()  #: Robots that have no path to their goals, if that is why

    @classmethod
    def unless_reachable(cls, search: SolveRun) -> NoPaths | None:
        """Return why there are no paths, if the :attr:`Problem.shortest_paths` tell."""
        problem = search.problem
        with search.watch.paused():  # it may compile
            _small_problem(problem, 0).shortest_paths.check_reachable()
        try:
            problem.shortest_paths.check_reachable()
        except ValueError as error:
            return cls(str(error), tuple(np.flatnonzero(np.isinf(problem.shortest_paths.length)).tolist()))
        return None

    def explained(self, iteration: Iteration) -> Iteration:
        """The iteration, in whose record it says why."""
        return replace(iteration, note=self.why, unreachable=self.unreachable)


class MAPF(Planner):
    """Path finding on a roadmap, one robot after another or for all at once, driven under the robots' own dynamics."""

    name: ClassVar[str] = "mapf"
    config_class = MAPFConfig
    # The paper names path finding as what is missing, and so has no parameters for it.
    presets: ClassVar = {"paper": {}}
    config: MAPFConfig

    def iterate(
        self, search: SolveRun, state: RoadmapSolution | NoPaths | None
    ) -> tuple[RoadmapSolution | NoPaths, Iteration]:
        """See :meth:`Planner.iterate`: first paths for the whole team, then better ones for some robots at a time."""
        if isinstance(state, RoadmapSolution):
            state = state.improved(search, self.config)
        elif state is None:
            state = find_roadmap_solution(search)
        if isinstance(state, NoPaths):
            return state, state.explained(Iteration(search.current.controls))
        return state, state.iteration(search)


def find_roadmap_solution(search: SolveRun) -> RoadmapSolution | NoPaths:
    """Paths for the whole team, or as many robots as possible; the reason if none are found in time."""
    return find_one_by_one(search) or find_all_at_once(search)


def find_one_by_one(search: SolveRun) -> RoadmapSolution | NoPaths | None:
    """Paths for the whole team, planned one robot after another; the reason if there can be none or time is up."""
    problem = search.problem
    if problem.num_robots * problem.horizon > MAX_ROBOT_STEPS:
        return NoPaths(f"more than {MAX_ROBOT_STEPS} steps of all robots together are too many to look for paths")
    with search.watch.paused():
        compile_path_finding(problem)
    random = np.random.default_rng(search.iteration_seed(Stream.GUIDANCE))
    patience, connected = PATIENCE[0] + int(PATIENCE[1] * problem.num_robots), False
    for number, fineness in enumerate((*ONE_BY_ONE, ONE_BY_ONE[0])):
        # The last one only where no lattice leads to all goals.
        narrow = number == len(ONE_BY_ONE)
        if search.should_stop() or (narrow and connected):
            break
        replanning = Replanning(problem, lay_roadmap(problem, fineness, narrow=narrow))
        if np.isfinite(replanning.alone).all():
            connected = True
            driven = plan_one_by_one(replanning, random, search.should_stop, patience)
            if driven is not None:
                return RoadmapSolution(replanning, driven)
        elif number == 0 and (reason := NoPaths.unless_reachable(search)) is not None:
            return reason
    return NoPaths(NOT_IN_TIME) if search.should_stop() else None


def find_all_at_once(search: SolveRun) -> RoadmapSolution | NoPaths:
    """Paths for as many robots as possible, found for all of them at once."""
    problem, best = search.problem, None
    for number, fineness in enumerate(ALL_AT_ONCE):
        roadmap = lay_roadmap(problem, fineness)
        replanning = Replanning(problem, roadmap)
        if not np.isfinite(replanning.alone).all():
            continue
        seed = search.iteration_seed(Stream.GUIDANCE, number + 1)
        found = find_moves(problem, roadmap, seed, search.should_stop, STEPS)
        if found is not None and (best is None or found.arrived.sum() > best[1].arrived.sum()):
            best = RoadmapSolution(replanning, drive_moves(problem, roadmap, found.moves)), found
        if search.should_stop() or (found is not None and found.arrived.all()):
            break
    return best[0] if best else NoPaths(NOT_IN_TIME)


def relay_paths(problem: Problem, paths: FloatArray, changed: BoolArray, seed: int) -> FloatArray | None:
    """``(H + 1, K, d)`` future positions of a team with ever new goals [m], of which the ``changed`` ``(K,)`` are
    planned.

    They go around all others on their ``paths`` ``(T + 1, K, d)`` from now on [m], who yield only where there is no
    other path; ``None`` if none were found. The seed is of those that may have to yield, and of how leisurely they
    drive.
    """
    compile_path_finding(problem)
    num_robots, d = problem.num_robots, problem.dimension
    dwell = int(np.ceil(DWELL / problem.dt))
    replanning = Replanning(problem, lay_roadmap(problem, RELAY_FINENESS), dwell)
    if not np.isfinite(replanning.alone).all():
        return None
    result = paths[np.minimum(np.arange(problem.horizon + 1), len(paths) - 1)]
    present = _driven(problem, result, dwell)
    present.positions[:, changed] = FAR
    before, random, robots = present.positions.copy(), np.random.default_rng(seed), np.flatnonzero(changed)
    order = robots[np.argsort(replanning.alone[robots] + random.random(len(robots)))]
    driven = settle(replanning, present, order, random, lambda: False, num_robots)
    if driven is None:
        return None
    for robot in np.flatnonzero((driven.positions != before).any(axis=(0, 2))):
        end = int(driven.arrivals[robot]) + 1
        result[:end, robot], result[end:, robot] = driven.positions[:end, robot, :d], problem.goal[robot]
    return result


def _driven(problem: Problem, paths: FloatArray, dwell: int) -> TeamRollout:
    """A team on its paths ``(H + 1, K, d)``, whose robots leave their goals again; its controls are not known."""
    steps, num_robots, d = problem.horizon, problem.num_robots, problem.dimension
    at_goal = np.linalg.norm(paths - problem.goal, axis=2) <= problem.goal_radius
    arrivals = np.where(at_goal.any(axis=0), at_goal.argmax(axis=0), steps)
    positions = np.zeros((steps + 1, num_robots, 3))
    positions[:, :, :d] = paths
    positions[np.arange(steps + 1)[:, None] > arrivals + dwell] = FAR
    return TeamRollout(np.zeros((steps, num_robots, problem.control_size), np.float32), positions, arrivals)


def compile_roadmap(problem: Problem) -> None:
    """Compile what :func:`needs_detour` needs, if it is not yet."""
    if problem.world.num_obstacles and not fill_costs.signatures:
        needs_detour(_small_problem(problem, 0))


def needs_detour(problem: Problem) -> bool:
    """Check whether obstacles make some robot's shortest path a long detour, so that straight lines are no start."""
    if not problem.world.num_obstacles:
        return False
    roadmap = lay_roadmap(problem)
    straight = np.linalg.norm(problem.goal - problem.start[:, : problem.dimension], axis=1)
    paths = TeamOnRoadmap(problem, roadmap).bodies.costs[np.arange(problem.num_robots), roadmap.starts]
    return bool((paths > DETOUR_RATIO * straight + problem.goal_radius).any())


def compile_path_finding(problem: Problem) -> None:
    """Compile what path finding for such a team in such a world needs, if it is not yet."""
    if is_compiled(problem):
        return
    for robot in {model: number for number, model in enumerate(problem.team.models)}.values():
        alone = _small_problem(problem, robot)
        roadmap = lay_roadmap(alone)
        found = find_moves(alone, roadmap, 0, lambda: False, STEPS)
        if found is not None:
            drive_moves(alone, roadmap, found.moves)
            plan_one_by_one(Replanning(alone, roadmap), np.random.default_rng(0), lambda: False, 1)


def _small_problem(problem: Problem, robot: int) -> Problem:
    """A short path of one robot, in a world with an obstacle if the problem's has any: quickly planned anywhere."""
    alone, d = problem.select([robot]), problem.dimension
    far = min(8 * (float(alone.team.radius[0]) + alone.margin), LARGEST / 2)
    start, aside = alone.start.copy(), np.eye(d)[1] * far
    start[:, :d] = 0
    boxes = [[*aside, *(2 * aside + far)]] if problem.world.num_obstacles else ()
    steps = min(LEISURELY * far / (alone.dt * float(alone.team.max_speed[0])), MAX_HORIZON - 100)
    return alone.replace(start=start, goal=[np.eye(d)[0] * far], world=World(d, boxes=boxes), horizon=100 + int(steps))
