"""Rerouting: robots that fail look for paths around all others in space and time, one after the other."""

from __future__ import annotations

import numpy as np

from d4orm_env.core import portable
from d4orm_env.core.arrays import IntArray
from d4orm_env.core.seeds import Stream
from d4orm_env.core.trajectory import resting_steps
from d4orm_planners.base.candidate import components
from d4orm_planners.base.working_plan import WorkingPlan
from d4orm_planners.engine.path_table import BLOCK
from d4orm_planners.mapf.beam import BeamRules, OtherAgents
from d4orm_planners.mapf.beam_search import find_paths
from d4orm_planners.mapf.motion_primitives import MotionPrimitives
from d4orm_planners.tracking.steering import at_rest, drives

SWEEPS, BATCH = 6, 16
"""Sweeps over the robots that fail in an iteration, and robots that search at the same time without regard to each
other, so that all cores have work."""
WIDTH = 32
"""Paths that a search keeps after each block of steps."""
CONTACT, CONTACT_GROWTH = 1.25, 2.0
"""Cost of being near another robot for a block of steps in the first sweep [s], and its growth from sweep to sweep."""
DEDUP_DISTANCE = 1.0
"""Least distance between paths that are kept, in radii of the largest robot; or in speed, twice as much [1/s]."""
EARLIER = (2, 5)
"""Least and largest number of blocks before a robot's first fault, or its docking, at which its new path begins; the
largest doubles with each sweep."""
ANGLES, SWING = np.array([30.0, 60.0, 90.0, 135.0, 180.0]), 14.0
"""Angles between a robot's heading and the direction of its goal, in space up and down as well, and their largest
common change from sweep to sweep [degrees]."""
PACES = (1.0, 0.5, 0.0)
"""Speeds with which a robot heads for its goal, as shares of its limit."""
STARTING = 4
"""Blocks for which the second of two robots that meet only each other stays at its start while the first searches."""
DETOURS = 32
"""Random points by which a robot tries to drive if it has found no path."""
AWAY = np.float32(1e6)
"""Coordinate of a robot that is out of the way of all others [m]."""
SPREAD = 20 / 3
"""Deviation of detours' points from straight paths, beyond half of their lengths, in radii of the largest robot."""


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
