"""Problems, settings and reference formulas that the tests of the planners share."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from d4orm_env import verify
from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.core.world import World
from d4orm_planners.base.plan import IterationRecord, Plan
from d4orm_planners.base.planner import Planner
from d4orm_planners.base.planner_registry import PLANNERS, make_planner

CHEAP = {
    "engine": "cpu",
    "num_samples": 64,
    "num_steps": 5,
    "max_iterations": 2,
    "start": "team",
    "reroute": False,
    "repair_samples": 64,
    "repair_steps": 5,
    "refine": "sync",
    "rounds": 2,
    "solver_iterations": 20,
    "alternations": 10,
}
"""Settings that plan in no time, badly, and the same every time."""


def cheap_planner(name: str, **config: Any) -> Planner:
    """A planner with those of the cheap settings that it has."""
    known = PLANNERS[name].config_class.setting_names(config)
    return make_planner(name, **{key: value for key, value in CHEAP.items() if key in known} | config)


def hop_problem(num_robots: int = 3, **changes: Any) -> Problem:
    """Robots side by side with their goals half a metre ahead: near enough for a few samples to find."""
    team = Team(("holonomic2d",) * num_robots)
    start = np.zeros((num_robots, 4))
    start[:, 1] = np.arange(num_robots)
    return Problem(team, start, start[:, :2] + [0.5, 0], **({"horizon": 30, "goal_speed": np.inf} | changes))


def walled_in_problem() -> Problem:
    """One robot whose goal stands inside a ring of circles with gaps so little too narrow that no proof sees it."""
    return _ringed(6, 0.794)


def sealed_problem() -> Problem:
    """The same inside a ring of circles that overlap."""
    return _ringed(12, 0.8)


def _ringed(number: int, distance: float) -> Problem:
    angle = np.linspace(0, 2 * np.pi, number, endpoint=False)
    ring = np.column_stack([3 + distance * np.cos(angle), distance * np.sin(angle), np.full(number, 0.25)])
    return Problem(Team(("holonomic2d",)), [[0, 0, 0, 0]], [[3, 0]], World(circles=ring), horizon=60)


def assert_solves(planner: str, problem: Problem, seed: int = 0, **config: Any) -> Plan:
    """Whatever is claimed to be solved is checked here anew."""
    plan = make_planner(planner, engine="cpu", **config).solve(problem, seed=seed)
    assert plan.solved, (plan.status, [record.note for record in plan.history], plan.failures)
    report = verify(problem, plan.controls)
    assert report.ok, report.violations
    assert not plan.trajectory.margin_violated[1:].any()
    return plan


class Recorder:
    """A callback that keeps the records, and stops or raises after some of them."""

    def __init__(self, stop_after: int | None = None, error: BaseException | None = None) -> None:
        self.records: list[IterationRecord] = []
        self._stop_after = stop_after
        self._error = error

    def __call__(self, record: IterationRecord) -> bool:
        self.records.append(record)
        last = self._stop_after is not None and len(self.records) >= self._stop_after
        if last and self._error is not None:
            raise self._error
        return last


def softmax(rewards: np.ndarray, temperature: float) -> np.ndarray:
    """``exp(r / lambda)`` over its sum, for rewards brought to mean zero and deviation one."""
    score = (rewards - rewards.mean()) / rewards.std()
    likelihood = np.exp(score / temperature)
    return likelihood / likelihood.sum()


def algorithm_1(
    initial: np.ndarray,
    alpha_bar: list[float],
    draw: Callable[[int], np.ndarray],
    reward: Callable[[np.ndarray], np.ndarray],
    temperature: float,
) -> np.ndarray:
    """The paper's Algorithm 1, line by line, in float64.

    Args:
        initial: ``U_N``, ``(H, K, m)``.
        alpha_bar: ``alpha_bar_i`` for ``i`` from 1 to N.
        draw: ``(M, H, K, m)`` standard normals of the step with that number, 0 being the first (``i = N``).
        reward: ``(M,)`` or ``(M, K)`` rewards of the samples ``(M, H, K, m)``: the team's, or each robot's own.
        temperature: ``lambda``.
    """
    cumulative = np.concatenate([[1.0], alpha_bar])
    controls = initial.astype(np.float64)
    for step, i in enumerate(range(len(alpha_bar), 0, -1)):
        abar, alpha = cumulative[i], cumulative[i] / cumulative[i - 1]
        samples = controls / np.sqrt(abar) + np.sqrt(1 / abar - 1) * draw(step)  # line 3
        rewards = reward(samples)  # line 4
        if rewards.ndim == 1:
            mean = np.tensordot(softmax(rewards, temperature), samples, axes=1)  # line 5
        else:
            robots = range(rewards.shape[1])
            parts = [np.tensordot(softmax(rewards[:, k], temperature), samples[:, :, k], axes=1) for k in robots]
            mean = np.stack(parts, axis=1)
        score = -controls / (1 - abar) + np.sqrt(abar) / (1 - abar) * mean  # line 6
        controls = (controls + (1 - abar) * score) / np.sqrt(alpha)  # line 7
    return controls


def program(tmp_path: Path, body: str) -> subprocess.CompletedProcess[str]:
    """Run a program that starts processes of its own, as a user would write it."""
    (tmp_path / "program.py").write_text(body)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *filter(None, sys.path)])}
    return subprocess.run(
        [sys.executable, "program.py"], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
