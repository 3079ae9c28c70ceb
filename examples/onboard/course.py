"""The plan that the team executes, and what follows from it: pure functions, with the same result on every robot."""

from __future__ import annotations

import hashlib
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import numpy as np

from d4orm_env import Problem
from d4orm_env.engine.base import Engine
from d4orm_env.joint_state import JointState
from d4orm_planners.base import Candidate
from d4orm_planners.steering import straight_drives

LEAST_MARGIN = 0.01
"""Margin below which plans never go, however near to each other robots have come to stand [m]."""

ROUNDING = 1e-3
"""Slack between the margin that bodies keep now and the one that is asked of a plan [m]."""

DRIFT = 0.01
"""How far a robot may be from where the course has it [m]."""


@dataclass(frozen=True, eq=False)
class Course:
    """A plan under way; where it ends, the robots stand.

    Attributes:
        begin: Tick at which it begins.
        controls: ``(T, K, m)``.
        states: ``(T+1, K, n)``.
        goals: ``(K, d)`` that it was made for.
        digest: What names it.
        reward: What the planner makes of it.
    """

    begin: int
    controls: Any
    states: Any
    goals: Any
    digest: str
    reward: float = 0.0

    @classmethod
    def standing(cls, problem: Problem, tick: int, states: Any) -> Course:
        """Everyone stays; made for no goals."""
        goals = np.full(problem.goal.shape, np.nan, np.float32)
        controls = np.zeros((1, problem.num_robots, problem.control_size), np.float32)
        return cls(tick, controls, np.stack([states, states]), goals, f"standing-{tick}")

    @classmethod
    def of(cls, begin: int, problem: Problem, candidate: Candidate) -> Course:
        """A candidate that solves the problem which begins at a tick."""
        trajectory = candidate.trajectory
        return cls(begin, candidate.controls, trajectory.states, problem.goal, digest(candidate), reward(candidate))

    def controls_at(self, tick: int) -> Any:
        """``(K, m)``."""
        step = tick - self.begin
        return self.controls[step] if step < len(self.controls) else np.zeros_like(self.controls[0])

    def states_at(self, tick: int) -> Any:
        """``(K, n)``."""
        return self.states[min(tick - self.begin, len(self.controls))]

    def rest(self, tick: int, horizon: int) -> Any:
        """``(horizon, K, m)`` controls from a tick on."""
        left = self.controls[tick - self.begin :][:horizon]
        rest = np.zeros((horizon, *self.controls.shape[1:]), np.float32)
        rest[: len(left)] = left
        return rest

    def is_left(self, tick: int, states: Any, dimension: int) -> bool:
        """Whether a robot is elsewhere than it should be at a tick."""
        return bool(np.abs(self.states_at(tick) - states)[:, :dimension].max() > DRIFT)

    def with_stops(self, problem: Problem, engine: Engine, joint: JointState, lost: Collection[int]) -> Course:
        """The rest of the course when these robots stand: whoever would come too near to another one stops too.

        In the last resort everybody stands, which is safe for robots that can stop at once.
        """
        controls = self.rest(joint.steps, problem.horizon)
        here = present_problem(problem, joint.states, joint.goals)
        standing = np.isin(np.arange(problem.num_robots), list(lost))
        while True:
            controls[:, standing] = 0
            trajectory = engine.rollout(here, controls)
            too_near = trajectory.margin_violated[1:].any(axis=0) & ~standing
            if not too_near.any():
                break
            standing |= too_near
        name = f"{self.digest.partition('+')[0]}+stops-{joint.steps}"
        return Course(joint.steps, trajectory.controls, trajectory.states, self.goals, name)


def digest(candidate: Candidate) -> str:
    """A short name of a candidate, by its controls."""
    return hashlib.sha256(np.ascontiguousarray(candidate.controls, "<f4").tobytes()).hexdigest()[:12]


def reward(candidate: Candidate) -> float:
    """Mean reward of a candidate."""
    return float(candidate.trajectory.rewards.mean())


def goals_to_plan_for(problem: Problem, joint: JointState, lost: Collection[int]) -> Any:
    """``(K, d)`` the goals, but robots that are lost stay, and so do those whose goal a body that stays has taken."""
    positions = joint.states[:, : problem.dimension]
    radius = np.asarray(problem.team.radius)
    stays = np.isin(np.arange(problem.num_robots), list(lost))
    while True:
        goals = np.where(stays[:, None], positions, joint.goals)
        gaps = np.linalg.norm(goals[:, None] - goals[None], axis=2) - radius[:, None] - radius
        np.fill_diagonal(gaps, np.inf)
        taken = ~stays & (gaps[:, stays] < problem.margin).any(axis=1)
        if not taken.any():
            return goals
        stays |= taken


def present_problem(problem: Problem, states: Any, goals: Any) -> Problem:
    """The problem that begins here. Robots that are nearer than the margin, after one stopped, may stay as near."""
    positions, radius = states[:, : problem.dimension], np.asarray(problem.team.radius)
    gaps = np.linalg.norm(positions[:, None] - positions[None], axis=2) - radius[:, None] - radius
    np.fill_diagonal(gaps, np.inf)
    walls = problem.world.clearance(positions) - radius
    least = min(gaps.min(), walls.min()) - ROUNDING
    margin = problem.margin if least >= problem.margin - 2 * ROUNDING else max(float(least), LEAST_MARGIN)
    return problem.moment(states, goals, margin=margin)


def first_guess(course: Course, problem: Problem, tick: int) -> Any:
    """``(H, K, m)`` controls to start planning from: the course's, or straight to the goal where that is new."""
    controls = course.rest(tick, problem.horizon)
    new = (course.goals != problem.goal).any(axis=1)
    controls[:, new] = straight_drives(problem).controls[:, new, 0]
    return controls
