from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from env_support import act, line_problem, mixed_problem, straight_drive
from gymnasium.utils.env_checker import data_equivalence

from d4orm_env import navigation_v0
from d4orm_env.envs.joint_state import split_state
from d4orm_env.envs.wrappers import GaussianControlNoise


def executed(env: Any, steps: int, control: Any, seed: int | None = 0) -> np.ndarray:
    """``(steps, K, m)`` controls executed when all robots are given ``control``."""
    env.reset(seed=seed)
    problem, log = env.unwrapped.problem, []
    for _ in range(steps):
        env.step(act(env, np.tile(np.float32(control), (problem.num_robots, 1))))
        log.append(split_state(problem, env.state()).controls)
    return np.array(log)


def far_team(count: int = 40) -> Any:
    return line_problem([50.0] * count, "differential_drive")


def test_noise_has_its_standard_deviation_per_component() -> None:
    env = GaussianControlNoise(navigation_v0.parallel_env(problem=far_team()), (0.2, 0.0))
    log = executed(env, 50, [0.1, 0.5])
    # 2000 draws: within four standard errors of the mean, 0.2 / sqrt(2000) each, and 7 % of the deviation.
    assert log[..., 0].mean() == pytest.approx(0.1, abs=0.018)
    assert log[..., 0].std() == pytest.approx(0.2, rel=0.07)
    assert (log[..., 1] == 0.5).all()
    draws = log[..., 0] - 0.1
    assert abs(np.corrcoef(draws[:, :-1].ravel(), draws[:, 1:].ravel())[0, 1]) < 0.09
    assert abs(np.corrcoef(draws[:-1].ravel(), draws[1:].ravel())[0, 1]) < 0.09


def test_noise_is_clipped_after_it_is_added() -> None:
    problem = line_problem([9.0] * 4, "holonomic2d")
    log = executed(GaussianControlNoise(navigation_v0.parallel_env(problem=problem), 2.0), 20, [0.0, 0.0])
    norms = np.linalg.norm(log, axis=-1)
    assert norms.max() <= 1 + 1e-6
    # Clipped by norm, not by component: saturated controls point everywhere, not along the corners of a box.
    saturated = log[norms > 0.999]
    assert len(saturated) > 40
    assert (np.abs(saturated) > 0.99).any(axis=1).mean() < 0.5


def test_seeds() -> None:
    def log(seed: int | None, env: Any) -> np.ndarray:
        return executed(env, 5, [0.0, 0.0], seed)

    def make() -> Any:
        return GaussianControlNoise(navigation_v0.parallel_env(problem=far_team(3)), 0.1)

    env = make()
    first = log(0, env)
    second = log(None, env)
    np.testing.assert_array_equal(first, log(0, make()))
    assert (first != second).any()
    assert (first != log(1, env)).any()
    log(0, env)
    np.testing.assert_array_equal(second, log(None, env))


def test_it_is_independent_of_the_noise_inside() -> None:
    inside = executed(navigation_v0.parallel_env(problem=far_team(), control_noise_std=0.2), 20, [0.0, 0.0])
    outside = executed(GaussianControlNoise(navigation_v0.parallel_env(problem=far_team()), 0.2), 20, [0.0, 0.0])
    assert abs(np.corrcoef(inside.ravel(), outside.ravel())[0, 1]) < 0.11


def test_no_noise_changes_nothing() -> None:
    plain, wrapped = (navigation_v0.parallel_env("circle", 3) for _ in range(2))
    wrapped = GaussianControlNoise(wrapped, 0)
    controls = straight_drive(plain.problem)
    assert data_equivalence(plain.reset(seed=0), wrapped.reset(seed=0), exact=True)
    for control in controls[:30]:
        assert data_equivalence(plain.step(act(plain, control)), wrapped.step(act(wrapped, control)), exact=True)


def test_the_callers_actions_are_left_alone() -> None:
    env = GaussianControlNoise(navigation_v0.parallel_env("circle", 2), 0.5)
    env.reset(seed=0)
    actions = {agent: np.zeros(2, np.float32) for agent in env.agents}
    env.step(actions)
    assert all((action == 0).all() for action in actions.values())


def test_one_robots_noise_does_not_depend_on_who_is_left() -> None:
    # In one team robot_0 arrives at the second step, in the other it never does.
    logs = []
    for distance in (0.2, 40.0):
        env = GaussianControlNoise(navigation_v0.parallel_env(problem=line_problem([distance, 40.0])), 0.02)
        logs.append(executed(env, 12, [0.9, 0.0])[:, 1])
        assert (env.agents == ["robot_1"]) == (distance < 1)
    np.testing.assert_array_equal(*logs)


def test_bad_actions_still_name_the_agent() -> None:
    env = GaussianControlNoise(navigation_v0.parallel_env("circle", 2), 0.1)
    env.reset(seed=0)
    with pytest.raises(ValueError, match="actions lack robot_1"):
        env.step({"robot_0": [0, 0]})
    with pytest.raises(ValueError, match="action of robot_1 is None"):
        env.step({"robot_0": [0, 0], "robot_1": None})
    with pytest.raises(ValueError, match="action of robot_0"):
        env.step({"robot_0": [0, np.nan], "robot_1": [0, 0]})
    with pytest.raises(ValueError, match="actions must be a dictionary"):
        env.step(None)


@pytest.mark.parametrize("std", [-0.1, float("nan"), float("inf"), [0.1, 0.1, 0.1]])
def test_bad_standard_deviations_are_refused(std: Any) -> None:
    with pytest.raises(ValueError, match="control_noise_std"):
        GaussianControlNoise(navigation_v0.parallel_env(problem=mixed_problem()), std)
