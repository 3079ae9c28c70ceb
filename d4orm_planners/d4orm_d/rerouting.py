"""Rerouting: robots that fail look for ways around all others in space and time, one after the other."""

from __future__ import annotations

import numpy as np

from d4orm_env.core import portable
from d4orm_env.core.arrays import IntArray
from d4orm_env.core.seeds import Stream
from d4orm_env.engine.beam_search import BeamRules, Moves, Seekers, search_kernel
from d4orm_env.engine.path_index import BLOCK
from d4orm_env.engine.threads import Threads, available_cores
from d4orm_planners.d4orm_d.settings import REROUTE_RULES
from d4orm_planners.d4orm_d.team import TeamPaths
from d4orm_planners.steering import Drives, by_model, drives, standing


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
        contact = REROUTE_RULES.contact * REROUTE_RULES.contact_growth**sweep
        for first in range(0, len(failed), REROUTE_RULES.batch):
            if team.search.should_stop():
                return
            robots = failed[first : first + REROUTE_RULES.batch]
            # Some may have been helped by others before them.
            faults, begin = team.faults(robots)
            least, most = REROUTE_RULES.earlier
            earlier = random.integers(least, most << sweep, len(robots), endpoint=True)
            blocks = np.maximum((begin - 1) // BLOCK - earlier, 0)
            lost = _search(team, robots[faults > 0], blocks[faults > 0], swing, contact)
            if len(lost):
                _try_detours(team, lost, random)


def prepare_rerouting(team: TeamPaths) -> None:
    """Compile what rerouting of this team needs, if it is not yet."""
    firsts = {model.name: robots[0] for model, robots in by_model(team.problem)}
    if not all(search_kernel(name).signatures for name in firsts):
        robots = np.array(list(firsts.values()))
        team.faults(robots)
        _search(team, robots, np.zeros(len(robots), int), 0.0, REROUTE_RULES.contact)
        team.index.move(robots, team.positions[:, robots])


def _search(team: TeamPaths, robots: IntArray, blocks: IntArray, swing: float, contact: float) -> IntArray:
    """Let robots ``(R,)`` take the best ways that they find from these blocks ``(R,)`` on.

    Returns:
        Those who found none.
    """
    problem, table, arrived = team.problem, team.index.table, np.zeros(team.problem.num_robots, bool)
    rules = BeamRules(REROUTE_RULES.width, contact, REROUTE_RULES.apart)
    for model, members in by_model(problem):
        mine = np.isin(robots, members)
        own = robots[mine]
        if len(own):
            seekers = Seekers(own, blocks[mine], team.states[blocks[mine] * BLOCK, own])
            u, x = (np.ascontiguousarray(rows[:, own].swapaxes(0, 1)) for rows in (team.controls, team.states))
            moves = _moves(problem.dimension, swing, has_heading=model.heading_index is not None)
            found, search = np.zeros(len(own), bool), search_kernel(model.name)
            Threads(available_cores()).over(
                len(own),
                lambda part: search(problem.arrays, table, moves, rules, seekers, part, u, x, found),  # noqa: B023
            )
            u, x = (rows.swapaxes(0, 1)[:, :, None] for rows in (u, x))
            team.take_best(own, Drives(u, x, found[:, None], problem.dimension))
            arrived[own] = found
    return robots[~arrived[robots]]


def _try_detours(team: TeamPaths, robots: IntArray, random: np.random.Generator) -> None:
    """Let robots ``(R,)`` drive by random points around their straight ways, if that is better."""
    part = team.problem.select(robots.tolist())
    start, goal = (places[:, None] for places in (part.start[:, : part.dimension], part.goal))
    size = (len(robots), REROUTE_RULES.detours)
    spread = 0.5 * np.linalg.norm(goal - start, axis=2, keepdims=True) + 1
    vias = start + random.random((*size, 1)) * (goal - start)
    vias = vias + spread * portable.standard_normal(random, (*size, part.dimension))
    team.take_best(robots, drives(part, *standing(part), np.zeros(size, int), vias[:, :, None]))


def _moves(dimension: int, swing: float, *, has_heading: bool) -> Moves:
    """What a robot may do, all angles changed by ``swing`` [degrees]."""
    angle = np.radians(np.array(REROUTE_RULES.angles) + swing)
    # To the left and to the right; in space upwards and downwards too.
    across = np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])[: 2 * (dimension - 1)]
    sides = portable.sin(angle)[:, None, None] * across
    ahead = np.broadcast_to(portable.cos(angle)[:, None, None], (*sides.shape[:2], 1))
    turned = np.concatenate([ahead, sides], axis=2).reshape(-1, 3)
    home = np.zeros((1, 3))
    beside = np.column_stack([np.zeros(len(across)), REROUTE_RULES.beside * across])
    parts = [(home, True, pace) for pace in REROUTE_RULES.paces] + [(beside, True, 1.0), (turned, False, 1.0)]
    if has_heading:
        parts += [(home, True, REROUTE_RULES.on_the_spot), (turned, False, REROUTE_RULES.on_the_spot)]
    sizes = [len(turns) for turns, _, _ in parts]
    return Moves(
        np.concatenate([turns for turns, _, _ in parts]).astype(np.float32),
        np.repeat([homewards for _, homewards, _ in parts], sizes),
        np.repeat([pace for _, _, pace in parts], sizes).astype(np.float32),
    )
