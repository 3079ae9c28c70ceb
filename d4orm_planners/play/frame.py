"""What a session shows of a moment: read by the page while the session goes on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray
from d4orm_env.core.problem import Problem


@dataclass(frozen=True, eq=False)
class Frame:
    """A moment of a session.

    Attributes:
        problem: Team and world; its start and goals are those of the last change.
        generation: Counts changes of team and world.
        number: Counts frames.
        states: ``(K, n)`` now.
        before: ``(K, d)`` positions a step ago [m].
        goals: ``(K, d)`` [m].
        arrived: ``(K,)``.
        collided: ``(K,)``.
        time: Simulated seconds since the scene was made.
        since: ``time.perf_counter()`` when this moment began.
        pace: Seconds from one step to the next at this speed.
        loop: Seconds that the policy took for this step.
        replanned: Seconds that it took to plan after the last change.
        closest: Least distance between surfaces [m], negative in contact.
        guidance: ``(P, K, d)`` where the policy leads the team from here, if it says so.
        subgoals: ``(K, d)`` what it heads for next, likewise.
        state: ``"running"``, ``"paused"``, ``"planning"`` or ``"arrived"``.
        message: What went wrong last, for people.
    """

    problem: Problem
    generation: int
    number: int
    states: FloatArray
    before: FloatArray
    goals: FloatArray
    arrived: BoolArray
    collided: BoolArray
    time: float
    since: float
    pace: float
    loop: float
    replanned: float
    closest: float
    guidance: FloatArray | None
    subgoals: FloatArray | None
    state: str
    message: str

    def positions(self, now: float) -> FloatArray:
        """``(K, d)`` where to draw the robots at a time of ``time.perf_counter()``: on their way here."""
        share = np.float32(min(max((now - self.since) / max(self.pace, 1e-3), 0.0), 1.0))
        return self.before + share * (self.states[:, : self.problem.dimension] - self.before)


def closest_approach(problem: Problem, states: FloatArray) -> float:
    """Least distance between the surfaces of two robots, or of one and an obstacle or the bounds [m]."""
    places = states[:, : problem.dimension].astype(np.float64)
    radius = np.asarray(problem.team.radius, np.float64)
    least = float((problem.world.clearance(places) - radius).min())
    gaps = np.linalg.norm(places[:, None] - places, axis=2) - radius[:, None] - radius
    gaps[np.diag_indices(len(places))] = np.inf
    return min(least, float(gaps.min()))


def guidance(policy: object, steps: int) -> FloatArray | None:
    """``(P, K, d)`` where a policy that follows a coarse plan, or executes one, leads the team after so many steps."""
    coarse, plan = getattr(policy, "guidance", None), getattr(policy, "plan", None)
    if coarse is not None:
        return np.asarray(coarse.path, np.float32)
    return None if plan is None else np.asarray(plan.trajectory.positions[steps:], np.float32)
