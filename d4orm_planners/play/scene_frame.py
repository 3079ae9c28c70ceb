"""Frame of a session's scene: read by the page while the session goes on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray
from d4orm_env.core.problem import Problem


@dataclass(frozen=True)
class Status:
    """Common status of all that drive side by side.

    Attributes:
        generation: Counts changes of team, world and policies.
        number: Counts moments.
        time: Simulated seconds since the scene was made.
        since: ``time.perf_counter()`` when this moment began.
        pace: Seconds from one step to the next at this speed.
        state: ``"running"``, ``"paused"``, ``"planning"`` or ``"arrived"``.
        message: Last error, for people.
        refused: Counts what was asked for and could not be.
    """

    generation: int
    number: int
    time: float
    since: float
    pace: float
    state: str
    message: str
    refused: int


@dataclass(frozen=True, eq=False)
class Frame:
    """A moment of a team that a policy drives.

    Attributes:
        status: Common status.
        policy: Name of what drives.
        problem: Team and world; its start and goals are those of the last change.
        states: ``(K, n)`` now.
        before: ``(K, d)`` positions a step ago [m].
        goals: ``(K, d)`` [m].
        arrived: ``(K,)``.
        collided: ``(K,)``.
        finished: Whether all have arrived.
        loop: Seconds that the policy took for this step.
        replanned: Seconds that it took to plan after the last change.
        closest: Least distance between surfaces [m], negative in contact.
        plan: ``(P, K, d)`` where the policy has just planned to lead the team, if it says so.
        guidance: ``(P, K, d)`` the coarse plan that it follows, likewise.
        subgoals: ``(K, d)`` what it heads for next, likewise.
        bodies: ``(N, 2 d + 1)`` position [m], velocity [m/s] and radius [m] of what moves about and is no robot.
    """

    status: Status
    policy: str
    problem: Problem
    states: FloatArray
    before: FloatArray
    goals: FloatArray
    arrived: BoolArray
    collided: BoolArray
    finished: bool
    loop: float
    replanned: float
    closest: float
    plan: FloatArray | None
    guidance: FloatArray | None
    subgoals: FloatArray | None
    bodies: FloatArray

    def positions(self, now: float) -> FloatArray:
        """``(K, d)`` where to draw the robots at a time of ``time.perf_counter()``: on their way here."""
        return self.before + self._share(now) * (self.states[:, : self.problem.dimension] - self.before)

    def body_positions(self, now: float) -> FloatArray:
        """``(N, d)`` likewise for what is no robot."""
        d = self.problem.dimension
        return self.bodies[:, :d] - (1 - self._share(now)) * np.float32(self.problem.dt) * self.bodies[:, d : 2 * d]

    def _share(self, now: float) -> np.float32:
        """Return the share of the step before this moment that has been shown."""
        status = self.status
        return np.float32(min(max((now - status.since) / max(status.pace, 1e-3), 0.0), 1.0))


def closest_approach(problem: Problem, states: FloatArray) -> float:
    """Least distance between the surfaces of two robots, or of one and an obstacle or the bounds [m]."""
    positions = states[:, : problem.dimension].astype(np.float64)
    radius = np.asarray(problem.team.radius, np.float64)
    least = float((problem.world.clearance(positions) - radius).min())
    gaps = np.linalg.norm(positions[:, None] - positions, axis=2) - radius[:, None] - radius
    gaps[np.diag_indices(len(positions))] = np.inf
    return min(least, float(gaps.min()))


def plan(policy: object, steps: int) -> FloatArray | None:
    """``(P, K, d)`` where a policy that predicts, or executes a plan, leads the team after so many steps."""
    predicted, whole = getattr(policy, "predicted", None), getattr(policy, "plan", None)
    if predicted is not None:
        return np.asarray(predicted, np.float32)
    return None if whole is None else np.asarray(whole.trajectory.positions[steps:], np.float32)


def guidance(policy: object) -> FloatArray | None:
    """``(P, K, d)`` of a policy that follows a coarse plan."""
    coarse = getattr(policy, "guidance", None)
    return None if coarse is None else np.asarray(coarse.path, np.float32)
