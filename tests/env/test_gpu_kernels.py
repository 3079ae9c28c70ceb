"""The kernels for GPUs, interpreted on the CPU, beside plain JAX; and that denoising lowers to few of them."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from env_support import mixed_problem, slow

from d4orm_env import make_problem
from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.dynamics.models import MODELS
from d4orm_env.jax import gpu_kernels, jax_engine, jax_motion
from d4orm_env.jax.jax_motion import Worlds
from d4orm_planners import make_planner
from d4orm_planners.engine import jax_sampling
from d4orm_planners.engine.jax_sampling import JaxSamplingEngine
from d4orm_planners.engine.sampling_types import SamplingTask
from d4orm_planners.sampling.d4orm import D4orm

HORIZON, SAMPLES = 12, gpu_kernels.LANES + 9
"""The last program has but a few samples."""


def facing_goals(**settings: Any) -> Problem:
    start = np.array([[0, 0, 0, 0], [0, 1, 1, 0.3], [1, 0, 2, 0]])
    return Problem(
        Team(("differential_drive",) * 3),
        start,
        start[:, :2] + 0.05,
        goal_heading=[0, 1, np.nan],
        goal_heading_tolerance=0.3,
        **settings,
    )


CASES = {
    "mixed": mixed_problem(),
    "facing goals": facing_goals(),
    "more than a program's robots": make_problem("circle", num_robots=gpu_kernels.ROWS + 3, diameter=2.0),
    "in space": make_problem("sphere", num_robots=3, diameter=2.0),
    "not docking": facing_goals(arrival="stay"),
}


@pytest.fixture
def interpreted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gpu_kernels.pl, "pallas_call", partial(gpu_kernels.pl.pallas_call, interpret=True))


def drawn_worlds(problem: Problem) -> tuple[Worlds, Any]:
    random = np.random.default_rng(3)
    num_robots, size = problem.num_robots, problem.control_size
    arrived = random.random((num_robots, SAMPLES)) < 0.2
    state = np.broadcast_to(problem.start[..., None], (*problem.start.shape, SAMPLES))
    controls = 2 * random.standard_normal((HORIZON, num_robots, size, SAMPLES))
    begin = Worlds(jnp.asarray(state), jnp.asarray(arrived), jnp.zeros((num_robots, size, SAMPLES), jnp.float32))
    return begin, jnp.asarray(controls, jnp.float32)


@pytest.mark.parametrize("name", CASES)
@pytest.mark.usefixtures("interpreted")
def test_the_kernel_rolls_out_as_the_steps_do(name: str) -> None:
    problem = CASES[name]
    begin, controls = drawn_worlds(problem)
    given = problem.team.models, problem.arrays, begin, controls
    by_kernel, in_steps = jax_motion._roll_out_by_kernel(*given), jax_motion._roll_out_in_steps(*given)
    for one, other in zip(by_kernel, in_steps, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-6)
    assert by_kernel.arrived.any()


@pytest.mark.parametrize("name", ["mixed", "more than a program's robots", "in space"])
@pytest.mark.usefixtures("interpreted")
def test_the_kernel_counts_those_who_are_near(name: str) -> None:
    problem, extra = CASES[name], np.float32(1)
    begin, controls = drawn_worlds(problem)
    state = jax_motion._roll_out_in_steps(problem.team.models, problem.arrays, begin, controls).state[-1]
    reach = problem.arrays.radius[:, None] + problem.arrays.radius + extra
    squared_reach = np.where(np.eye(problem.num_robots, dtype=bool), -1, reach * reach).astype(np.float32)
    counts = gpu_kernels.count_near(problem.dimension, state, jnp.asarray(squared_reach))
    np.testing.assert_array_equal(counts, jax_engine.robot_contacts(problem.arrays, state, extra))
    assert counts.any()


@pytest.mark.parametrize("model", [slow(m) if m.startswith(("car_with_1", "car_with_2")) else m for m in MODELS])
def test_a_denoising_run_is_one_loop_of_few_kernels_on_a_gpu(model: str, monkeypatch: pytest.MonkeyPatch) -> None:
    lowered: list[str] = []

    def lower(static: Any, treedef: Any, shapes: Any) -> None:
        arguments = jax.tree.unflatten(treedef, [jax.ShapeDtypeStruct(shape, dtype) for shape, dtype in shapes])
        run = jax.jit(partial(jax_sampling._denoise, static))
        lowered.append(run.trace(*arguments).lower(lowering_platforms=("cuda",)).as_text())

    monkeypatch.setattr(jax_sampling, "_compiled_denoise", lower)
    planner = make_planner("d4orm")
    assert isinstance(planner, D4orm)
    problem = make_problem("circle", num_robots=3, model=model, horizon=HORIZON)
    task = SamplingTask(problem, np.zeros((HORIZON, 3, problem.control_size), np.float32))
    JaxSamplingEngine().prepare(task, planner.rules(), planner.noise_scale(), SAMPLES)
    (program,) = lowered
    # Rollouts and, of teams of discs, pair checks.
    assert program.count("gpu.triton") == (1 if problem.team.shapes else 2)
    # Of footprints, which JAX itself compares, others are taken in turn.
    assert program.count("stablehlo.while") == (2 if problem.team.shapes else 1)
    assert "callback" not in program
