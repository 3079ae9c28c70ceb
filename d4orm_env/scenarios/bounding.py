"""Bounds for scenarios that are open."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import as_float32, frozen_array, shown
from d4orm_env.core.world import World
from d4orm_env.scenarios.placement import Area, Points
from d4orm_env.scenarios.settings import LARGEST, Settings, bounded


def with_bounds(settings: Settings, world: World, area: Area | None) -> World:
    """The world, with the bounds that were asked for if any were.

    Args:
        settings: With the ``bounds``.
        world: Of the scenario.
        area: Region that a margin is laid around: the same for every seed, so that worlds that differ in their seed
            alone have the same bounds.

    Raises:
        ValueError: If they are no bounds, or the scenario has some of its own.
    """
    if settings.bounds is None:
        return world
    if area is None or world.lower is not None:
        raise ValueError(
            f"scenario {settings.scenario!r} has bounds of its own and takes none, not {shown(settings.bounds)}; leave "
            "bounds out"
        )
    if isinstance(settings.bounds, list | tuple | np.ndarray):
        lower, upper = frozen_array(settings.bounds, "bounds", (2, world.dimension), largest=LARGEST)
    else:
        out = area.half_extent + bounded(settings.bounds, "bounds")
        lower, upper = as_float32(area.centre - out), as_float32(area.centre + out)
    return replace(world, lower=lower, upper=upper)


def require_inside(settings: Settings, world: World, starts: Points, goals: Points) -> None:
    """Check that the bounds that were asked for leave every start and goal its radius and the margin.

    Raises:
        ValueError: If not; the message says how much wider they must be.
    """
    if settings.bounds is None:
        return
    lower, upper = world.bounds.astype(np.float64)
    needed = np.asarray(settings.team.radius, np.float64) + settings.margin
    for what, places in (("start", starts), ("goal", goals)):
        gaps: NDArray[np.float64] = np.minimum(places - lower, upper - places).min(axis=1)
        robot = int(np.argmin(gaps - needed))
        if gaps[robot] <= needed[robot]:
            place = ", ".join(f"{coordinate:g}" for coordinate in places[robot])
            where = f"{gaps[robot]:.3g} m inside" if gaps[robot] >= 0 else f"{-gaps[robot]:.3g} m outside"
            raise ValueError(
                f"scenario {settings.scenario!r}: the {what} of robot_{robot} at ({place}) is {where} the bounds "
                f"{shown(settings.bounds)}, and its radius and the margin take {needed[robot]:.3g} m; use wider bounds"
            )
