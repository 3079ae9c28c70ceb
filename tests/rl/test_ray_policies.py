"""Learned policies that read range sensors: their features, their training, and the sensors that they ask for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from d4orm_env import navigation_v0
from d4orm_env.core.observation_layout import ObservationSlices
from d4orm_env.envs.features import Features
from d4orm_planners import evaluate, make_policy, run_episode
from d4orm_planners.cli import app as cli
from d4orm_planners.rl.network import load_network

pytest.importorskip("stable_baselines3")
SLICES = ObservationSlices(2, 0, 0, num_rays=8)
OWN = [0, 0, 0, 0, 0, 3, 0.2, 0.25, 0, 0.15, 1, 2]
"""At rest, no heading, goal 3 m ahead along x and a little to the left."""


def test_rays_begin_at_the_one_nearest_to_the_goal() -> None:
    rays = np.linspace(0.5, 4, 8)
    features, frames = Features(SLICES, turned=True).encode(np.array([[*OWN, *rays]], np.float32))
    own = Features(SLICES, turned=True).own_size
    np.testing.assert_allclose(frames, [[1, 0]], atol=1e-6)
    np.testing.assert_allclose(features[0, own - 16 : own - 8], 1 / (1 + rays - 0.15), atol=1e-6)
    turned = np.array(OWN, float)
    turned[5:7] = -0.2, 3  # the same scene, turned by 90 degrees, which is two rays
    again, frames = Features(SLICES, turned=True).encode(np.array([[*turned, *np.roll(rays, 2)]], np.float32))
    np.testing.assert_allclose(frames, [[0, 1]], atol=1e-6)
    np.testing.assert_allclose(again, features, atol=1e-6)


def test_rays_of_a_robot_with_a_heading_are_as_they_are() -> None:
    own = [0, 0, 0.6, 0.8, *OWN[4:]]
    features, frames = Features(SLICES, False, "heading").encode(np.array([own + [1] * 4 + [2] * 4], np.float32))
    np.testing.assert_allclose(frames, [[0.6, 0.8]], atol=1e-6)
    np.testing.assert_allclose(features[0, -16:-8], [1 / 1.85] * 4 + [1 / 2.85] * 4, atol=1e-6)


@pytest.fixture(scope="module", params=["flat", "sets"])
def policy_file(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp(request.param)
    few = ["--num-robots", "2", "--steps", "256", "--num-envs", "8", "--stages", "1", "--validation-worlds", "2", "-q"]
    rays = ["--observed-rays", "6", "--ray-range", "3", "--network", request.param]
    with pytest.raises(SystemExit) as ended:
        cli.main(["train", "ppo", "--out", str(out), *few, *rays])
    assert not ended.value.code
    return out / "policy.safetensors"


def test_a_policy_is_trained_with_rays_and_asks_for_them(policy_file: Path) -> None:
    header = load_network(policy_file).header
    assert (header.num_rays, header.ray_range) == (6, 3)
    policy = make_policy("ppo", path=str(policy_file))
    env = navigation_v0.parallel_env("random", num_robots=2, observed_rays=6, ray_range=3.0, max_cycles=5)
    assert run_episode(env, policy).metrics["steps"] == 5
    # Six rays are as many numbers as a neighbour.
    for own in ({"observed_robots": 5}, {"observed_rays": 6}, {"observed_rays": 12, "ray_range": 3.0}):
        other = navigation_v0.parallel_env("random", num_robots=2, **own)
        other.reset(seed=0)
        with pytest.raises(ValueError, match=r"was trained with observed_rays=6, ray_range=3, and this environment"):
            policy.reset(other)


def test_commands_give_robots_rays(policy_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main(["run", "--policy", "ppo", "--num-robots", "2", "--observed-rays", "8"])
    assert ended.value.code == 2
    assert "was trained with observed_rays=0, and this environment has observed_rays=8" in capsys.readouterr().err
    settings = {"policy": "ppo", "path": str(policy_file)}
    study = {"num_robots": 2, "seeds": [0], "workers": 1, "out": tmp_path}
    rays = {"observed_rays": 6, "ray_range": 3.0}
    (row,) = evaluate({"mine": settings}, observation=rays, **study)
    assert row.errors == 0
    (row,) = evaluate({"mine": settings}, **study)  # the policy's own rays, unless others are asked for
    assert row.errors == 0
    (row,) = evaluate({"mine": settings}, observation={"observed_rays": 8}, **study)
    assert row.errors == 1
    with pytest.raises(ValueError, match="observation 'lifelong' is unknown"):
        evaluate({"mine": settings}, observation={"lifelong": True}, **study)


def test_a_training_goes_on_with_the_same_rays_only(policy_file: Path, tmp_path: Path) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main(["train", "ppo", "--out", str(tmp_path / "on"), "--start-from", str(policy_file)])
    assert ended.value.code == 2
    assert not list(tmp_path.iterdir())
