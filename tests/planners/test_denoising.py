"""Watching a plan come about: what watchers see is what happened, and watching changes nothing."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from engine_support import engine_noise

from d4orm_env import make_problem
from d4orm_env.render.replay import Denoising, save_denoising
from d4orm_planners import make_planner
from d4orm_planners.base.plan import IterationRecord, Plan
from d4orm_planners.engine.sampling_types import WATCHED_SAMPLES, DenoisingStep, SamplingTask, get_sampling_engine
from d4orm_planners.sampling.denoising import DenoisingFilm

QUICK = {"num_samples": 64, "num_steps": 8, "engine": "cpu"}


@pytest.fixture(scope="module")
def problem():
    return make_problem("circle", num_robots=3, seed=0)


@pytest.mark.parametrize("credit", ["team", "robot"])
@pytest.mark.parametrize("num_samples", [5, 100])
def test_a_step_tells_of_its_first_samples(problem, credit: str, num_samples: int) -> None:
    shape = (problem.horizon, problem.num_robots, problem.control_size)
    task = SamplingTask(problem, np.zeros(shape, np.float32), credit=credit)
    steps: list[DenoisingStep] = []
    sigmas = np.array([1.0, 0.5], np.float32)
    rules = make_planner("d4orm").rules()
    result = get_sampling_engine("cpu").denoise(task, rules, task.base, sigmas, num_samples, 7, None, steps.append)
    kept = min(num_samples, WATCHED_SAMPLES)
    mean = task.base
    for number, step in enumerate(steps):
        noise = engine_noise(problem, 7, number, kept)
        assert step.noise_scale == pytest.approx(sigmas[number])
        np.testing.assert_allclose(step.samples, mean + sigmas[number] * noise, atol=1e-5)
        assert step.weights.shape == ((kept,) if credit == "team" else (problem.num_robots, kept))
        if num_samples == kept:
            np.testing.assert_allclose(step.weights.sum(axis=-1), 1, atol=1e-5)
            weights = np.broadcast_to(np.atleast_2d(step.weights), (problem.num_robots, kept))
            np.testing.assert_allclose(np.einsum("ks,shkm->hkm", weights, step.samples), step.mean, atol=1e-4)
        mean = step.mean
    np.testing.assert_array_equal(mean, result.mean)


def test_watching_changes_no_bit_of_a_plan(problem) -> None:
    planner = make_planner("d4orm", **QUICK)
    film = DenoisingFilm(problem)
    plain = planner.solve(problem, seed=3, max_iterations=2)
    watched = planner.solve(problem, seed=3, max_iterations=2, watcher=film)
    np.testing.assert_array_equal(plain.controls, watched.controls)
    assert len(film) == watched.denoising_steps > 0


def test_the_jax_engine_says_that_it_cannot_be_watched(problem) -> None:
    planner = make_planner("d4orm", **{**QUICK, "engine": "jax"})
    with pytest.raises(ValueError, match="to watch them, use engine='cpu'"):
        planner.solve(problem, max_iterations=1, watcher=lambda step: None)


def test_a_record_has_the_candidate_for_callbacks_only(problem, tmp_path: Path) -> None:
    records: list[IterationRecord] = []
    plan = make_planner("d4orm", **QUICK, improve=True).solve(problem, max_iterations=2, callback=records.append)
    assert tuple(records) == plan.history
    for record in records:
        assert record.controls is not None
        assert record.trajectory is not None
        assert record.controls.shape == plan.controls.shape
        assert record.reward == pytest.approx(record.trajectory.rewards.mean())
    assert all(record.controls is None and record.trajectory is None for record in plan.history)
    plan.save(tmp_path / "plan.npz")
    assert Plan.load(tmp_path / "plan.npz").history == plan.history


def test_a_film_ends_where_the_plan_begins(problem) -> None:
    film = DenoisingFilm(problem, num_samples=2)
    plan = make_planner("d4orm", **QUICK, final_approach=False).solve(problem, max_iterations=1, watcher=film)
    seen = film.developed(most=5)
    assert seen.labels[-1].startswith("denoising step 8 of 8, sigma 0.")
    assert seen.paths.shape == (5, 26, 3, 2)
    assert seen.samples.shape == (5, 2, 26, 3, 2)
    assert ((seen.alpha > 0) & (seen.alpha <= 1)).all()
    steps = np.linspace(0, problem.horizon, 26).round().astype(int)
    np.testing.assert_allclose(seen.paths[-1], plan.trajectory.positions[steps], atol=1e-5)


@pytest.mark.parametrize(
    ("weights", "alpha"), [([0.5, 0.25, 0.0], [0.42, 0.27, 0.12]), ([[0.5, 0.1], [0.25, 0.3]], [0.345, 0.24])]
)
def test_samples_are_the_more_opaque_the_more_they_count(problem, weights: list[Any], alpha: list[float]) -> None:
    """With robot credit on average over the robots, and relative to what counts most for any."""
    base = np.zeros((problem.horizon, problem.num_robots, problem.control_size), np.float32)
    film = DenoisingFilm(problem)
    film(DenoisingStep(SamplingTask(problem, base), 1.0, base, np.stack([base] * len(alpha)), np.array(weights)))
    np.testing.assert_allclose(film.developed().alpha, [alpha], rtol=1e-6)


def test_a_film_without_a_step_says_so(problem) -> None:
    with pytest.raises(ValueError, match="no denoising of the whole team was seen"):
        DenoisingFilm(problem).developed()


def test_shapes_that_do_not_go_together_are_refused() -> None:
    paths = np.zeros((2, 4, 3, 2), np.float32)
    with pytest.raises(ValueError, match="labels, paths, samples and alpha"):
        Denoising(("a",), paths, np.zeros((2, 1, 4, 3, 2), np.float32), np.zeros((2, 1), np.float32))


@pytest.mark.parametrize("scenario", ["circle", "sphere"])
def test_the_denoising_is_drawn_and_replayed(scenario: str, tmp_path: Path) -> None:
    problem = make_problem(scenario, num_robots=3)
    film = DenoisingFilm(problem)
    plan = make_planner("d4orm", **QUICK).solve(problem, max_iterations=1, watcher=film)
    seen = film.developed(most=4)
    assert save_denoising(problem, seen, tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    scene = plan.motion(denoising=seen).content
    assert scene["denoising"]["labels"] == list(seen.labels)
    assert scene["denoising"]["points"] == seen.paths.shape[1]
    assert seen.samples.shape[:2] == (4, 4)


SHARED = """
import sys
import jax, numpy as np
from d4orm_env import make_problem
from d4orm_planners import make_planner
problem = make_problem("circle", num_robots=3, goal_speed=np.inf)
for name, preset in (("d4orm", None), ("d4orm", "paper"), ("cem", None)):
    planner = make_planner(name, preset=preset, engine="jax", num_samples=128, num_steps=6)
    sys.stdout.buffer.write(planner.solve(problem, seed=1, max_iterations=1).controls.tobytes())
sys.stderr.write(str(jax.local_device_count()))
"""


@pytest.mark.slow
def test_several_devices_share_the_samples_of_one_plan() -> None:
    plans = []
    for devices in (1, 4):
        flags = {"XLA_FLAGS": f"--xla_force_host_platform_device_count={devices}", "JAX_PLATFORMS": "cpu"}
        ran = subprocess.run([sys.executable, "-c", SHARED], env=os.environ | flags, capture_output=True, check=True)
        assert ran.stderr.decode().endswith(str(devices))
        plans.append(np.frombuffer(ran.stdout, np.float32))
    np.testing.assert_allclose(*plans, atol=1e-3)
    assert np.abs(plans[0]).max() > 0.5
