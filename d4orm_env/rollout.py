"""Rolling controls out, with any engine."""

from __future__ import annotations

from numpy.typing import ArrayLike

from d4orm_env.core.problem import Problem
from d4orm_env.core.trajectory import Trajectory
from d4orm_env.engine.choice import get_engine


def rollout(problem: Problem, controls: ArrayLike, engine: str = "auto") -> Trajectory:
    """The motion of the team under ``controls``, clipped to the robots' limits.

    Args:
        problem: Starts, goals, limits and world.
        controls: ``(H, K, m)``.
        engine: ``"auto"``, ``"cpu"`` or ``"jax"``.

    Returns:
        States, executed controls, rewards and flags over time.

    Raises:
        ValueError: If the controls have another shape or are not finite, or the engine is unknown.
    """
    return get_engine(engine).rollout(problem, controls)
