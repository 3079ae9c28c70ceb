"""Rerouting: robots that fail look for ways around all others in space and time, one after the other."""

from __future__ import annotations

import numpy as np

from d4orm_env.core import portable
from d4orm_env.core.arrays import IntArray
from d4orm_env.core.seeds import Stream
from d4orm_env.engine.beam_search import BeamRules
from d4orm_env.engine.path_index import BLOCK
from d4orm_planners.d4orm_d.settings import REROUTE_RULES
from d4orm_planners.refinement.beams import Manner, find_ways
from d4orm_planners.refinement.team import TeamPaths
from d4orm_planners.steering import drives, standing


def reroute(team: TeamPaths) -> None:
    """Let the robots that fail look for other ways, some times in turn, those that meet most others first.

    As prioritised planning does, but robots that have no way yet are in the way of others all the same, at a cost: who
    cannot get past all of them gets past most (MAPF-LNS2, Li et al., AAAI 2022).
    """
    everybody = np.arange(team.problem.num_robots)
    for sweep in range(REROUTE_RULES.sweeps):
        random = np.random.default_rng(team.search.iteration_seed(Stream.DETOURS, sweep))
        faults, _ = team.faults(everybody)
        failed = np.lexsort((random.random(len(everybody)), -faults))[: np.count_nonzero(faults)]
        swing = (2 * random.random() - 1) * REROUTE_RULES.swing
        manner = Manner(tuple(np.array(REROUTE_RULES.angles) + swing), REROUTE_RULES.paces)
        contact = REROUTE_RULES.contact * REROUTE_RULES.contact_growth**sweep
        rules = BeamRules(REROUTE_RULES.width, contact, REROUTE_RULES.apart)
        for first in range(0, len(failed), REROUTE_RULES.batch):
            if team.search.should_stop():
                return
            robots = failed[first : first + REROUTE_RULES.batch]
            # Some may have been helped by others before them.
            faults, begin = team.faults(robots)
            least, most = REROUTE_RULES.earlier
            earlier = random.integers(least, most << sweep, len(robots), endpoint=True)
            blocks = np.maximum((begin - 1) // BLOCK - earlier, 0)
            robots, blocks = robots[faults > 0], blocks[faults > 0]
            if len(robots):
                ways = find_ways(team, robots, blocks, manner, rules)
                team.take_best(robots, ways)
                lost = robots[~ways.arrived[:, 0]]
                if len(lost):
                    _try_detours(team, lost, random)


def _try_detours(team: TeamPaths, robots: IntArray, random: np.random.Generator) -> None:
    """Let robots ``(R,)`` drive by random points around their straight ways, if that is better."""
    part = team.problem.select(robots.tolist())
    start, goal = (places[:, None] for places in (part.start[:, : part.dimension], part.goal))
    size = (len(robots), REROUTE_RULES.detours)
    spread = 0.5 * np.linalg.norm(goal - start, axis=2, keepdims=True) + 1
    vias = start + random.random((*size, 1)) * (goal - start)
    vias = vias + spread * portable.standard_normal(random, (*size, part.dimension))
    team.take_best(robots, drives(part, *standing(part), np.zeros(size, int), vias[:, :, None]))
