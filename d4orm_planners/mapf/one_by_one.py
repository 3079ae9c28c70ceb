"""Paths of a team, planned one robot after another; who finds none displaces others, if these find others.

After J. Li, Z. Chen, D. Harabor, P. Stuckey and S. Koenig, *MAPF-LNS2: fast repairing for multi-agent path finding via
large neighborhood search* (AAAI 2022): a change of some paths is kept if no more robots than before are without one.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from d4orm_env.core.arrays import BoolArray, IntArray
from d4orm_planners.mapf.occupancy import Occupancy, find_meetings
from d4orm_planners.mapf.roadmap_team import FAR, KEEP, TOUCH, Replanning, TeamRollout

MINDED = (1.0, 0.9, 0.75, 0.5, 0.25, 0.0)
"""Shares of the others that a robot without a path minds in turn, at random: the fewer it displaces, the better."""
RELEASED = 0.5  #: Odds that a robot for which nothing gets better sets out late, to let others into a bay before it
HOPELESS = 10  #: Paths that robots do not find even alone after which patience is over


def plan_one_by_one(
    replanning: Replanning, random: np.random.Generator, should_stop: Callable[[], bool], patience: int
) -> TeamRollout | None:
    """All robots' paths within the horizon, planned one by one; ``None`` if they were not found.

    ``random`` draws the order, the robots that may be displaced, and how long others are left to set out.
    ``should_stop`` is asked before every path, and after ``patience`` paths it gives up, if no fewer robots wait for
    theirs than ever before.
    """
    problem, steps, num_robots = replanning.problem, replanning.problem.horizon, replanning.problem.num_robots
    positions = np.full((steps + 1, num_robots, 3), FAR)
    controls = np.zeros((steps, num_robots, problem.control_size), np.float32)
    driven = TeamRollout(controls, positions, np.full(num_robots, steps + 1))
    waiting = np.argsort(replanning.alone + random.random(num_robots))
    return settle(replanning, driven, waiting, random, should_stop, patience)


def settle(
    replanning: Replanning,
    driven: TeamRollout,
    robots: IntArray,
    random: np.random.Generator,
    should_stop: Callable[[], bool],
    patience: int,
) -> TeamRollout | None:
    """The same for those ``robots``, the last of them first, among all others in ``driven``, which is changed."""
    team, waiting = _Settled(replanning, driven, random, should_stop), robots.tolist()
    team.settled[robots] = False
    fewest, idle = len(waiting), 0
    while waiting and idle < patience and not should_stop():
        fewest, idle = min(fewest, len(waiting)), 0 if len(waiting) < fewest else idle + 1
        robot, team.leisure = int(waiting.pop()), int(replanning.alone.max() * idle / patience)
        displaced = team.displace(robot)
        if displaced is None:
            # Not even alone: it drove too near to a wall, and might not at another pace.
            waiting.insert(0, robot)
            idle += patience // HOPELESS
        elif len(displaced):
            # The longer it gets no better, the more it may get worse for once.
            most = 1 + int(random.random() * (1 + idle / len(team.settled)))
            waiting[:0] = team.find_others(robot, displaced, most)
    return None if waiting else driven


class _Settled:
    """A team of which some robots have paths."""

    def __init__(
        self, replanning: Replanning, driven: TeamRollout, random: np.random.Generator, should_stop: Callable[[], bool]
    ) -> None:
        self.replanning, self.driven, self.random, self.should_stop = replanning, driven, random, should_stop
        self.occupancy, self.steps = (
            Occupancy(replanning.cells, driven.positions, replanning.flatten),
            len(driven.controls),
        )
        self.settled = np.ones(replanning.problem.num_robots, bool)
        self.leisure = 0  #: steps that robots leave others to set out, at most

    def replan(self, robot: int, minded: BoolArray | None = None, release: int = 0) -> bool:
        return self.replanning.replan_one(self.driven, self.occupancy, robot, self.steps, self.random, minded, release)

    def displace(self, robot: int) -> IntArray | None:
        """Plan a robot's path around as many as it can; those in whose way it is, ``None`` if it has no path at all."""
        replanning, settled, release = self.replanning, self.settled, 0
        if self.leisure and self.random.random() < RELEASED:
            release = int(self.random.random() * self.leisure)
        for hard in MINDED:
            minded = self.random.random(len(settled)) < hard
            if self.replan(robot, minded, release):
                break
        else:
            return None
        others = self.occupancy.around(replanning.separation(robot, KEEP))
        others, met = others._replace(need=replanning.separation(robot, TOUCH)), np.ones(len(settled), bool)
        last = replanning.leaves(int(self.driven.arrivals[robot]))
        find_meetings(others, np.ascontiguousarray(replanning.flatten(self.driven.positions[:last, robot])), met)
        displaced = np.flatnonzero(settled & met)
        settled[robot] = True
        return displaced

    def find_others(self, robot: int, displaced: IntArray, most: int) -> list[int]:
        """Plan other paths for those that a robot displaces, numbers ``(D,)``, which it leaves time to set out if it
        can.

        Robots that have no path now are returned: those that find none, or that robot where they are more than
        ``most``; then all others have the paths that they had.
        """
        driven, lost, roadmap = self.driven, list[int](), self.replanning.roadmap
        controls, arrivals = driven.controls[:, displaced], driven.arrivals[displaced]
        positions = driven.positions[:, displaced]
        # Nowhere yet, or for some steps at their starts.
        standing, places = int(self.random.random() * self.leisure), np.full_like(positions, FAR)
        places[:standing] = roadmap.nodes[roadmap.starts[displaced]]
        self.occupancy.put(displaced, places)
        if standing:
            self.replan(robot)
        for other in self.random.permutation(displaced).tolist():
            if self.should_stop() or not self.replan(other):
                lost.append(other)
            if len(lost) > most:
                driven.controls[:, displaced], driven.arrivals[displaced] = controls, arrivals
                self.occupancy.put(displaced, positions)
                self.occupancy.put(robot, FAR)
                lost = [robot]
                break
        self.settled[lost] = False
        return lost
