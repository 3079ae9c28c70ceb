"""Effects of disturbances as events for pictures."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from d4orm_env.core.disturbance_events import DisturbanceEvents
from d4orm_env.core.problem import Problem
from d4orm_env.disturbances.disturbance import DisturbanceEffect


def marks_of(effects: Sequence[DisturbanceEffect], problem: Problem) -> DisturbanceEvents:
    """Marks of one world from its effects at the beginning and after every step, each of one world."""
    still = np.zeros((1, problem.num_robots, problem.dimension), np.float32)
    obeying = np.zeros((1, problem.num_robots), np.bool_)
    nothing = np.zeros((1, 0, 2 * problem.dimension + 1), np.float32)
    return DisturbanceEvents(
        pushed=np.concatenate([still if effect.pushed is None else effect.pushed for effect in effects]),
        stalled=np.concatenate([obeying if effect.stalled is None else effect.stalled for effect in effects]),
        bodies=np.concatenate([nothing if effect.bodies is None else effect.bodies for effect in effects]),
    )
