"""The plan that the team executes, and what follows from it: pure functions, with the same result on every robot."""

from __future__ import annotations

import hashlib
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import numpy as np

from d4orm_env import Problem, Team
from d4orm_env.engine.types import Engine
from d4orm_env.envs.joint_state import JointState
from d4orm_planners.base.candidate import Candidate, evaluate_controls
from d4orm_planners.tracking.steering import straight_drives

LEAST_MARGIN = 0.01
"""Margin below which plans never go, however near to each other robots have come to stand [m]."""

ROUNDING = 1e-3
"""Slack between the margin that bodies keep now and the one that is asked of a plan [m]."""

STANDSTILL = float(np.float32(1e-6))
"""Speed limit of robots that are lost, which must be above zero [m/s]."""

SETTLING = 8
"""Times that controls are executed at most until they stay the same; two do."""

DRIFT = 0.01
"""Most deviation of a robot from its course [m]."""


@dataclass(frozen=True, eq=False)
class Course:
    """A plan under way; where it ends, the robots stand."""

    begin: int  #: Tick at which it begins
    controls: Any  #: ``(T, K, m)``
    states: Any  #: ``(T+1, K, n)``
    goals: Any  #: ``(K, d)`` that it was made for
    digest: str  #: Its digest
    reward: float = 0.0  #: Its reward by the planner

    @classmethod
    def standing(cls, problem: Problem, tick: int, states: Any) -> Course:
        """Everyone stays; made for no goals."""
        goals = np.full(problem.goal.shape, np.nan, np.float32)
        controls = np.zeros((1, problem.num_robots, problem.control_size), np.float32)
        return cls(tick, controls, np.stack([states, states]), goals, f"standing-{tick}")

    @classmethod
    def of(cls, begin: int, problem: Problem, engine: Engine, candidate: Candidate) -> Course | None:
        """The plan that a candidate is, for the problem that begins at a tick; ``None`` if it is no solution."""
        controls = settled_controls(engine, problem, candidate.controls)
        # To judge it again takes its time.
        is_settled = np.array_equal(controls, candidate.controls)
        same = candidate if is_settled else evaluate_controls(engine, problem, controls)
        name, worth = digest(engine, problem, candidate), reward(candidate)
        return cls(begin, same.controls, same.trajectory.states, problem.goal, name, worth) if same.solved else None

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
        """Check whether a robot is elsewhere than it should be at a tick."""
        return bool(np.abs(self.states_at(tick) - states)[:, :dimension].max() > DRIFT)

    def with_stops(self, problem: Problem, engine: Engine, joint: JointState, lost: Collection[int]) -> Course:
        """The rest of the course when these robots stop: a robot that would come too near to another one stops too.

        In the last resort all robots stop, which is safe for robots that can stop at once.
        """
        controls = self.rest(joint.steps, problem.horizon)
        here = present_problem(problem, joint.states, joint.goals, lost)
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


def settled_controls(engine: Engine, problem: Problem, controls: Any) -> Any:
    """Controls that stay as they are, to the bit, when they are executed, told and executed again; zero for the lost.

    Limiting them to the robots' speed may change the last bit, and again wherever a candidate is passed on.
    """
    controls = np.where(np.asarray(problem.team.max_speed)[:, None] > STANDSTILL, controls, 0).astype(np.float32)
    for _ in range(SETTLING):
        executed = engine.rollout(problem, controls).controls
        if np.array_equal(executed, controls):
            break
        controls = executed
    return controls


def digest(engine: Engine, problem: Problem, candidate: Candidate) -> str:
    """A short name of a candidate by its controls, the same wherever it has been passed on."""
    controls = settled_controls(engine, problem, candidate.controls)
    return hashlib.sha256(np.ascontiguousarray(controls, "<f4").tobytes()).hexdigest()[:12]


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


def present_problem(problem: Problem, states: Any, goals: Any, lost: Collection[int]) -> Problem:
    """The problem that begins here, in which robots that are lost cannot move.

    Robots that are nearer to each other than the margin, after one of them stopped, may stay as near.
    """
    positions, radius = states[:, : problem.dimension], np.asarray(problem.team.radius)
    gaps = np.linalg.norm(positions[:, None] - positions[None], axis=2) - radius[:, None] - radius
    np.fill_diagonal(gaps, np.inf)
    walls = problem.world.clearance(positions) - radius
    least = min(gaps.min(), walls.min()) - ROUNDING
    margin = problem.margin if least >= problem.margin - 2 * ROUNDING else max(float(least), LEAST_MARGIN)
    speed = np.array(problem.team.max_speed)
    speed[list(lost)] = STANDSTILL
    team = Team(problem.team.models, problem.team.radius, speed)
    return problem.with_state(states, goals, margin=margin, team=team)


def warm_start(course: Course, problem: Problem, tick: int) -> Any:
    """``(H, K, m)`` controls to start planning from: the course's, or straight to the goal where that is new."""
    controls = course.rest(tick, problem.horizon)
    new = (course.goals != problem.goal).any(axis=1)
    controls[:, new] = straight_drives(problem).controls[:, new, 0]
    return controls
