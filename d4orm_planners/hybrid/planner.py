"""The hybrid planner: an initialiser, a repairer and an improver; and rerouting, by which it repairs first.

Robots that fail then look for paths around all others in space and time, one after the other.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import numpy as np

from d4orm_env.core import portable
from d4orm_env.core.arrays import FloatArray, IntArray
from d4orm_env.core.problem import Problem
from d4orm_env.core.seeds import Stream
from d4orm_env.core.trajectory import resting_steps
from d4orm_planners.base.candidate import components
from d4orm_planners.base.planner import Iteration, Planner
from d4orm_planners.base.settings import Positive, one_of
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.base.working_plan import WorkingPlan
from d4orm_planners.d4orm_d.decoupling import DeformedPlan, Repairs
from d4orm_planners.d4orm_d.planner import D4ormD, D4ormDConfig, straight_if_sparse
from d4orm_planners.d4orm_d.planner import State as DecouplingState
from d4orm_planners.engine.path_table import BLOCK
from d4orm_planners.manoeuvres.robots import can_plan
from d4orm_planners.manoeuvres.rounds import find_manoeuvres, improve_manoeuvres
from d4orm_planners.manoeuvres.team import TeamMotions
from d4orm_planners.mapf.beam import BeamRules, OtherAgents
from d4orm_planners.mapf.beam_search import find_paths, prepare_beams
from d4orm_planners.mapf.lns import FIRST_ROUNDS, GUIDED_ROUNDS, improve_by_lns, improve_first_paths
from d4orm_planners.mapf.motion_primitives import MotionPrimitives
from d4orm_planners.mapf.planner import (
    MAPFConfig,
    RoadmapSolution,
    compile_roadmap,
    find_all_at_once,
    find_one_by_one,
    find_roadmap_solution,
    needs_detour,
)
from d4orm_planners.sampling.settings import Credit
from d4orm_planners.tracking.steering import at_rest, drives

SWEEPS, BATCH = 6, 16
"""Sweeps over the robots that fail in an iteration, and robots that search at the same time without regard to each
other, so that all cores have work."""
WIDTH = 32  #: Paths that a search keeps after each block of steps
CONTACT, CONTACT_GROWTH = 1.25, 2.0
"""Cost of being near another robot for a block of steps in the first sweep [s], and its growth from sweep to sweep."""
DEDUP_DISTANCE = 1.0  #: Least distance between paths kept, in the largest radii; or in speed, twice that [1/s]
EARLIER = (2, 5)
"""Least and largest number of blocks before a robot's first fault, or its docking, at which its new path begins; the
largest doubles with each sweep."""
ANGLES, SWING = np.array([30.0, 60.0, 90.0, 135.0, 180.0]), 14.0
"""Angles between a robot's heading and the direction of its goal, in space up and down as well, and their largest
common change from sweep to sweep [degrees]."""
PACES = (1.0, 0.5, 0.0)  #: Speeds with which a robot heads for its goal, as shares of its limit
STARTING = 4  #: Blocks for which the second of two robots that meet only each other waits while the first searches
DETOURS = 32  #: Random points by which a robot tries to drive if it has found no path
AWAY = np.float32(1e6)  #: Coordinate of a robot that is out of the way of all others [m]
SPREAD = 20 / 3  #: Deviation of detours' points from straight paths, beyond half their lengths, in the largest radii


def reroute(team: WorkingPlan) -> None:
    """Replan the paths of robots that fail, in several sweeps, those that meet most others first.

    This is prioritised planning in which contact has a cost: a robot that cannot get past all others gets past most
    (MAPF-LNS2, Li et al., AAAI 2022).
    """
    everybody = np.arange(team.problem.num_robots)
    for sweep in range(SWEEPS):
        random = np.random.default_rng(team.search.iteration_seed(Stream.DETOURS, sweep))
        faults, _ = team.faults(everybody)
        failed = np.lexsort((random.random(len(everybody)), -faults))[: np.count_nonzero(faults)]
        swing = (2 * random.random() - 1) * SWING
        primitives = MotionPrimitives(tuple(ANGLES + swing), PACES)
        contact = CONTACT * CONTACT_GROWTH**sweep
        rules = BeamRules(WIDTH, contact, DEDUP_DISTANCE * team.problem.team.largest_radius)
        for first in range(0, len(failed), BATCH):
            if team.search.should_stop():
                return
            robots = failed[first : first + BATCH]
            # Others' new paths may have helped some of them.
            faults, begin = team.faults(robots)
            least, most = EARLIER
            earlier = random.integers(least, most << sweep, len(robots), endpoint=True)
            blocks = np.maximum((np.minimum(begin, _docking_steps(team, robots)) - 1) // BLOCK - earlier, 0)
            robots, blocks = robots[faults > 0], blocks[faults > 0]
            if len(robots):
                paths = find_paths(team, robots, blocks, primitives, rules)
                team.take_best(robots, paths)
                if team.search.should_stop():
                    return
                lost = robots[~paths.arrived[:, 0]]
                if len(lost):
                    _try_detours(team, lost, random)
    for pair in components(team.conflicts()):
        if len(pair) == 2 and not team.search.should_stop():
            _reroute_pair(team, np.array(pair), primitives, rules)


def _docking_steps(team: WorkingPlan, robots: IntArray) -> IntArray:
    """``(R,)`` steps from which on robots are held at their goals; beyond the last for those that may set out again."""
    held = team.arrived[robots] & team.problem.docks
    return np.where(held, resting_steps(team.positions[:, robots]), team.problem.horizon + 1)


def _reroute_pair(team: WorkingPlan, pair: IntArray, primitives: MotionPrimitives, rules: BeamRules) -> None:
    """Replan two robots that meet only each other from the start, one after the other, if that is better.

    Where they face each other at the start, replanning one of them does not help while the other comes on.
    """
    problem = team.problem
    faults, radius = team.faults(pair)[0].sum(), np.asarray(problem.team.girth, np.float64)
    present = team.controls[:, pair], team.states[:, pair], team.arrived[pair]
    for first, second in (pair, pair[::-1]):
        # The second one stays where it is as long as the first may need to get away.
        extra = np.full((1, 1, problem.horizon + 1, problem.dimension), AWAY, np.float32)
        extra[:, :, : STARTING * BLOCK + 1] = problem.start[second, : problem.dimension]
        paths = []
        for robot, other in ((first, second), (second, first)):
            others = OtherAgents(pair[None], extra, radius[[[other]]])
            paths.append(find_paths(team, np.array([robot]), 0, primitives, rules, others=others))
            extra = np.ascontiguousarray(np.moveaxis(paths[-1].positions, 0, 2))
        controls = np.concatenate([path.controls[:, :, 0] for path in paths], axis=1)
        states = np.concatenate([path.states[:, :, 0] for path in paths], axis=1)
        team.move([first, second], controls, states, [path.arrived[0, 0] for path in paths])
        if team.faults(pair)[0].sum() < faults:
            return
        team.move(pair, *present)


def _try_detours(team: WorkingPlan, robots: IntArray, random: np.random.Generator) -> None:
    """Let robots ``(R,)`` drive by random points around their straight paths, if that is better."""
    part = team.problem.select(robots.tolist())
    start, goal = (positions[:, None] for positions in (part.start[:, : part.dimension], part.goal))
    size = (len(robots), DETOURS)
    spread = 0.5 * np.linalg.norm(goal - start, axis=2, keepdims=True) + SPREAD * part.team.largest_radius
    vias = start + random.random((*size, 1)) * (goal - start)
    vias = vias + spread * portable.standard_normal(random, (*size, part.dimension))
    team.take_best(robots, drives(part, *at_rest(part), np.zeros(size, int), vias[:, :, None]))


Start = Annotated[str, one_of(("auto", "team", "straight", "mapf"))]
Improver = Annotated[str, one_of(("lns", "denoising"))]


@dataclass(frozen=True, kw_only=True)
class HybridConfig(D4ormDConfig):
    """Settings of the hybrid planner: those of D4orm-D, whose repairs it makes, and of what it does besides."""

    credit: Credit = "alternate"
    penalty: Positive = 1.0
    #: First iteration without initial controls: as in D4orm-D, or ``"mapf"``, path finding on a roadmap, whose solution
    #: becomes better from iteration to iteration (:mod:`d4orm_planners.mapf`). ``"auto"`` finds paths where obstacles
    #: lead somebody far round, or repairs have not helped for some time.
    start: Start = "auto"
    reroute: bool = True  #: Whether robots that fail search for paths among all others' before they are deformed
    #: Improver of a solution: ``"lns"``, large-neighbourhood search of groups of robots for faster paths around all
    #: others, or ``"denoising"``, the whole team deformed again.
    improver: Improver = "lns"


State = DecouplingState | RoadmapSolution | TeamMotions
"""State between iterations: the repairer's, or the roadmap solution or the team's manoeuvres once there are any."""

MAPF_AFTER = 6  #: Iterations without a solution after which paths are looked for on a roadmap
LNS_PERIOD = 5  #: Iterations on a roadmap solution of which one improves the motions; the others replan on the roadmap


def covered_by_discs(problem: Problem) -> bool:
    """Check whether discs stand for the robots in all that is asked of them: without trailers and goal headings."""
    return not any(model.trailers for model in problem.team.robot_models) and bool(np.isnan(problem.goal_heading).all())


class Hybrid(Planner):
    """Path finding where it helps, D4orm-D where robots conflict, and anytime improvement of what was found."""

    name: ClassVar[str] = "hybrid"
    config_class = HybridConfig
    drives_straight: ClassVar[bool] = True
    config: HybridConfig

    def __init__(self, config: HybridConfig) -> None:
        super().__init__(config)
        self.denoiser = D4ormD(config)

    def init(self, search: SolveRun) -> State:
        state = self.denoiser.init(search)
        if isinstance(state, Repairs) and (self.config.reroute or self.improves_by_lns):
            with search.watch.paused():
                prepare_beams(WorkingPlan(search, search.current.trajectory))
        return state

    @property
    def improves_by_lns(self) -> bool:
        return self.config.improver == "lns"

    def iterate(self, search: SolveRun, state: State) -> tuple[State, Iteration]:
        """See :meth:`Planner.iterate`: initialise, then repair robots that fail, then improve."""
        if isinstance(state, RoadmapSolution):
            return self.improve_roadmap_solution(search, state)
        if isinstance(state, TeamMotions):
            return state, improve_manoeuvres(search, state)
        needs_manoeuvres = self.finds_manoeuvres(search)
        as_discs = not needs_manoeuvres or covered_by_discs(search.problem)
        needs_paths = as_discs and self.finds_paths(search)
        solution = find_one_by_one(search) if needs_paths else None
        if needs_manoeuvres and not isinstance(solution, RoadmapSolution):
            motions = find_manoeuvres(search)
            if motions is not None:
                return motions, Iteration(motions.controls())
        if needs_paths or (not as_discs and self.finds_paths(search)):
            solution = solution or (find_all_at_once if as_discs else find_roadmap_solution)(search)
            if isinstance(solution, RoadmapSolution):
                return solution, self.follow(search, solution)
            state, iteration = self.without_paths(search, state)
            return state, solution.explained(iteration)
        return self.without_paths(search, state)

    def without_paths(self, search: SolveRun, state: DecouplingState) -> tuple[State, Iteration]:
        """Start straight or with the whole team, then improve, or repair robots that fail.

        These search for paths around others, and those that fail nevertheless are deformed.
        """
        if search.iteration == 0 and not search.current.controls.any():
            drives = self.straight_start(search.problem)
            return self.whole_team(search, state) if drives is None else (state, Iteration(drives))
        if self.improves_by_lns and search.best.solved:
            return state, improve_by_lns(search)
        if not isinstance(state, Repairs):
            return self.denoiser.replan(search, state)
        if not search.current.unsolved.any():
            return self.whole_team(search, state)
        team = DeformedPlan(self.denoiser, search)
        if self.config.reroute:
            reroute(team)
        state = state.repair(team)
        self.improve_first(team)
        return state, team.iteration()

    def straight_start(self, problem: Problem) -> FloatArray | None:
        """Controls ``(H, K, m)`` that send all straight to their goals, or ``None`` to start with the whole team."""
        return straight_if_sparse(problem) if self.config.start == "auto" else self.denoiser.straight_start(problem)

    def whole_team(self, search: SolveRun, state: DecouplingState) -> tuple[State, Iteration]:
        """Deform all controls at once, as D4orm-D does, and improve them if none fails."""
        state, iteration = self.denoiser.whole_team(search, state)
        return state, (self.improved_at_once(search, iteration) if isinstance(state, Repairs) else iteration)

    def improved_at_once(self, search: SolveRun, iteration: Iteration, rounds: int = FIRST_ROUNDS) -> Iteration:
        """The iteration, its controls improved for some rounds if no robot fails with them."""
        team = WorkingPlan(search, search.engine.rollout(search.problem, iteration.controls))
        self.improve_first(team, rounds)
        return replace(iteration, controls=team.controls)

    def follow(self, search: SolveRun, solution: RoadmapSolution) -> Iteration:
        """The team's controls on a roadmap solution, improved a little if it is a solution of the problem."""
        iteration = solution.iteration(search)
        return self.improved_at_once(search, iteration, GUIDED_ROUNDS) if self.improves_by_lns else iteration

    def improve_roadmap_solution(
        self, search: SolveRun, solution: RoadmapSolution
    ) -> tuple[RoadmapSolution, Iteration]:
        """Replan robots on the roadmap, for other paths round, and by turns search the motions, which cuts corners."""
        if search.best.solved and self.improves_by_lns:
            if search.iteration % LNS_PERIOD == 1:
                return solution, improve_by_lns(search)
            solution = solution.going_on_from_best(search)
        solution = solution.improved(search, MAPFConfig())
        return solution, solution.iteration(search)

    def finds_manoeuvres(self, search: SolveRun) -> bool:
        """Check whether this iteration is to find manoeuvres: the first one, for a team that needs them."""
        from_nothing = search.iteration == 0 and not search.current.controls.any()
        return from_nothing and self.config.start == "auto" and can_plan(search.problem)

    def finds_paths(self, search: SolveRun) -> bool:
        """Check whether this iteration is to find paths: the first, or one after some without a solution."""
        start = self.config.start
        if search.iteration == 0:
            if search.current.controls.any() or start not in ("auto", "mapf"):
                return False
            if start == "mapf":
                return True
            with search.watch.paused():
                compile_roadmap(search.problem)
            return needs_detour(search.problem)
        stuck = search.iteration == MAPF_AFTER and not search.best.solved and search.problem.world.num_obstacles > 0
        return stuck and start == "auto"

    def improve_first(self, team: WorkingPlan, rounds: int = FIRST_ROUNDS) -> None:
        """Improve a team in which none fails any more, for some rounds."""
        if self.improves_by_lns and not team.faults(np.arange(team.problem.num_robots))[0].any():
            improve_first_paths(team, rounds)
