"""Robots that hear nothing more: they run on as they were told last, until their watchdogs stop them."""

from __future__ import annotations

import math

import numpy as np

from d4orm_env.core.arrays import FloatArray, Floats
from d4orm_env.core.problem import Problem
from d4orm_env.engine.cpu import CpuEngine
from d4orm_planners.base.disturbance_observer import summed_controls
from d4orm_planners.tracking.tracker import follow_reference

NEAR = 0.5  #: Share of the margin that robots keep when they run on
CREEPING = 0.125  #: Least pace of robots that are slowed down


class RunningOn:
    """Foresight of where a team runs on to, at the speeds and turn rates that it was told, for so many ``seconds``."""

    def __init__(self, problem: Problem, seconds: float) -> None:
        self._problem, self._engine = problem, CpuEngine()
        self._steps = math.ceil(seconds / problem.dt)
        self._keeps_speed = ~summed_controls(problem).any(axis=1)
        self._braking = math.ceil(float((problem.team.max_speed / problem.team.max_acceleration).max()) / problem.dt)

    def meets_something(self, states: FloatArray, controls: FloatArray) -> bool:
        """Check whether robots in ``states`` ``(K, n)`` that are told ``controls`` ``(K, m)``, and then nothing, come
        nearer than :data:`NEAR`, or touch if they are nearer now, before they have come to rest.
        """
        problem, held = self._problem, np.repeat(controls[None], self._steps, axis=0)
        held[1:] *= self._keeps_speed
        end = self._engine.move(problem.arrays, states, np.zeros(len(states), bool), held)[-1]
        at_rest = np.zeros((self._braking, *problem.goal.shape), np.float32)
        told = np.concatenate([held, follow_reference(problem, end, at_rest, at_rest, 0.0)])
        nearer = {"margin": NEAR * problem.margin, "goal_radius": problem.rounding}
        seen = self._engine.rollout(problem.with_state(states, problem.goal, horizon=len(told), **nearer), told)
        near = seen.margin_violated[1:] & ~seen.margin_violated[0]
        return bool((near | (seen.collided[1:] & ~seen.collided[0])).any())


def slowed(twists: Floats, before: Floats, share: float) -> Floats:
    """``(K, 1)`` paces at which speeds of ``twists`` ``(K, 4)`` are lower by a share than those ``before``.

    Some pace is left, so that robots get away from where they stand.
    """
    now, then = (np.linalg.norm(rows[:, :3], axis=1) for rows in (twists, before))
    return np.clip((1 - share) * then / np.maximum(now, np.finfo(float).tiny), CREEPING, 1.0)[:, None]
