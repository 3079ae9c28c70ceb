"""Settings of the hybrid planner, and the numbers of its search for paths around others."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from d4orm_planners.base.settings import Positive, one_of
from d4orm_planners.d4orm_d.settings import D4ormDConfig
from d4orm_planners.sampling.settings import Credit

Start = Annotated[str, one_of(("auto", "team", "straight", "mapf"))]
Improver = Annotated[str, one_of(("lns", "denoising"))]


@dataclass(frozen=True, kw_only=True)
class HybridConfig(D4ormDConfig):
    """Settings of the hybrid planner: those of D4orm-D, whose repairs it makes, and of what it does besides.

    Attributes:
        start: First iteration without initial controls: as in D4orm-D, or ``"mapf"``, path finding on a
            roadmap, whose solution becomes better from iteration to iteration (:mod:`d4orm_planners.mapf`). ``"auto"``
            finds paths where obstacles lead somebody far round, or repairs have not helped for some time.
        reroute: Whether robots that fail search for paths among all others' before they are deformed.
        improver: Improver of a solution: ``"lns"``, large-neighbourhood search of groups of robots for faster
            paths around all others, or ``"denoising"``, the whole team deformed again.
    """

    credit: Credit = "alternate"
    penalty: Positive = 1.0
    start: Start = "auto"
    reroute: bool = True
    improver: Improver = "lns"


@dataclass(frozen=True)
class RerouteRules:
    """The numbers of the search for paths around others.

    Attributes:
        sweeps: Number of times in turn that robots which fail look for a path in an iteration.
        batch: Robots that look for paths at the same time, not minding each other's: so that all cores have work.
        width: Paths that a search keeps after each block of steps.
        contact: Cost of being near another robot for a block of steps in the first sweep [s]: waiting that long is
            cheaper.
        contact_growth: Times as much it costs in the next sweep: what cannot be had for little may be had for more.
        dedup_distance: Least distance between paths that are kept, in radii of the largest robot, or else twice as much
            in speed [1/s].
        earlier: Blocks before a robot's first fault at which its new path begins: from one number to the other, which
            doubles with each sweep.
        angles: By which a robot turns off from the path to its goal [degrees]; in space up and down as well.
        swing: From one sweep to the next all of them change by up to so much either way [degrees].
        paces: Shares of its speed with which a robot heads for its goal: waiting has no direction.
        standing: Blocks for which, of two robots that meet only each other, the second is taken to stay where it starts
            while the first looks for a path.
        detours: Random points by which it tries to drive if it has found no path.
    """

    sweeps: int = 6
    batch: int = 16
    width: int = 32
    contact: float = 1.25
    contact_growth: float = 2.0
    dedup_distance: float = 1.0
    earlier: tuple[int, int] = (2, 5)
    angles: tuple[float, ...] = (30.0, 60.0, 90.0, 135.0, 180.0)
    swing: float = 14.0
    paces: tuple[float, ...] = (1.0, 0.5, 0.0)
    standing: int = 4
    detours: int = 32


REROUTE_RULES = RerouteRules()
