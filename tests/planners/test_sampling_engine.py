"""Denoising runs: both engines against a reference in float64, step by step, and under strain."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from engine_support import ENGINE_NAMES, RecordedRules, cpu_rewards, engine_noise, toward_goals
from env_support import mixed_problem, needed, slow
from reference import ROUNDOFF, evaluate, position_error

from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.core.world import World
from d4orm_env.dynamics.models import MODELS
from d4orm_env.footprints import Box
from d4orm_env.scenarios import list_scenarios, make_problem
from d4orm_planners.engine.cpu_sampling import CpuSamplingEngine
from d4orm_planners.engine.jax_sampling import JaxSamplingEngine
from d4orm_planners.engine.sampling_types import (
    MovingObstacles,
    SamplingResult,
    SamplingRules,
    SamplingTask,
    get_sampling_engine,
)
from d4orm_planners.engine.score import score_kernel
from d4orm_planners.sampling.settings import annealed
from d4orm_planners.sampling.weights import EliteWeights, SoftmaxWeights

CPU, JAX = CpuSamplingEngine(), JaxSamplingEngine()
SOFTMAX = SamplingRules(SoftmaxWeights(0.3))
NUM_SAMPLES = 200  # three tiles and a bit
CREDITS = ("team", "robot")
PLANNED: dict[str, Any] = {"horizon": 25, "dt": 0.2, "goal_speed": np.inf}


def crowd(model: str = "holonomic2d", num_robots: int = 5) -> SamplingTask:
    """A small circle that everybody crosses at once."""
    problem = make_problem("circle", num_robots=num_robots, model=model, diameter=2.0, **PLANNED)
    return SamplingTask(problem, 0.5 * toward_goals(problem))


def among_obstacles() -> SamplingTask:
    world = World(
        2,
        circles=[[0, 0, 0.4], [0, 1.2, 0.1]],
        boxes=[[-0.6, -1.5, 0.6, -0.9]],
        lower=[-3, -2],
        upper=[3, 2],
    )
    start = [[-2, -0.4, 0, 0], [-2, 0.4, 0.5, 0], [-2, -1.4, 0, 0]]
    problem = Problem(Team(("holonomic2d",) * 3), start, [[2, 0.4], [2, -0.4], [2, -1.4]], world, **PLANNED)
    return SamplingTask(problem, 0.5 * toward_goals(problem))


def in_space() -> SamplingTask:
    world = World(
        3,
        spheres=[[0, 0, 0, 0.4]],
        cylinders=[[1.0, 0.5, 0.2]],
        boxes=[[-1, -1.5, -1, -0.5, -0.5, 1]],
        lower=[-3, -3, -0.6],
        upper=[3, 3, 0.6],
    )
    start = [[-2, 0, 0, 0, 0, 0], [2, 0.1, 0, 0, 0, 0], [0, -2, 0, 0, 0, 0], [0.1, 2, 0, 0, 0, 0]]
    goal = [[2, 0, 0], [-2, 0.1, 0], [0, 2, 0], [0.1, -2, 0]]
    problem = Problem(Team(("holonomic3d",) * 4, radius=[0.1, 0.2, 0.3, 0.15]), start, goal, world, **PLANNED)
    return SamplingTask(problem, 0.5 * toward_goals(problem))


def arriving() -> SamplingTask:
    """With little noise everybody docks early, and stands from then on: robot 0 within the margin of a circle."""
    world = World(2, circles=[[0.35, -0.33, 0.15]])
    start, goal = [[0, 0, 0, 0], [0, 1, 0, 0]], [[0.5, 0], [0.5, 1]]
    problem = Problem(Team(("holonomic2d",) * 2), start, goal, world, goal_radius=0.2, **PLANNED)
    return SamplingTask(problem, 0.5 * toward_goals(problem))


def mixed_team() -> SamplingTask:
    problem = mixed_problem().replace(**PLANNED)
    return SamplingTask(problem, np.zeros((25, 3, 2), np.float32))


def through(problem: Problem) -> MovingObstacles:
    """A large body that crosses the middle, and a small one that stands there."""
    path = np.zeros((problem.horizon, 2, problem.dimension), np.float32)
    # It stops short of where it would stand at exactly the margin of a docked robot.
    path[:, 0, 0] = np.linspace(-1, 0.95, problem.horizon)
    return MovingObstacles(path, np.array([0.3, 0.05], np.float32))


def with_moving(task: SamplingTask) -> SamplingTask:
    return replace(task, moving=through(task.problem))


def with_arrived(task: SamplingTask, *robots: int) -> SamplingTask:
    arrived = np.zeros(task.problem.num_robots, bool)
    arrived[list(robots)] = True
    return replace(task, arrived=arrived)


def with_slow_docking(task: SamplingTask) -> SamplingTask:
    """Goals that many samples reach, some of them too fast to dock."""
    return replace(task, problem=task.problem.replace(goal_radius=0.4, goal_speed=0.5))


def harder(task: SamplingTask) -> SamplingTask:
    """Violations cost more, and distances count relative to more than the robots' own."""
    problem = task.problem.replace(collision_penalty=1.5)
    return replace(task, problem=problem, penalty=2.0, reference_distance=5.0)


TASKS: dict[str, Callable[[], SamplingTask]] = {
    "holonomic2d": crowd,
    "velocity2d": lambda: crowd("velocity2d"),
    "differential_drive": lambda: crowd("differential_drive"),
    "holonomic3d": lambda: crowd("holonomic3d"),
    "alone": lambda: crowd(num_robots=1),
    "mixed": mixed_team,
    "obstacles": among_obstacles,
    "space": in_space,
    "docking": lambda: with_slow_docking(crowd()),
    "docking in space": lambda: with_slow_docking(in_space()),
    "docking drives": lambda: with_slow_docking(crowd("differential_drive")),
    "no collisions": lambda: replace(crowd(), collisions=False),
    "moving": lambda: with_moving(crowd()),
    "moving, no collisions": lambda: replace(with_moving(crowd()), collisions=False),
    "moving in space": lambda: with_moving(in_space()),
    "harder": lambda: harder(with_moving(crowd())),
    "harder, obstacles": lambda: harder(among_obstacles()),
    "arrived": lambda: with_arrived(among_obstacles(), 1),
    "docked, moving": lambda: with_moving(with_arrived(crowd(), 0, 3)),
    "all docked": lambda: with_arrived(crowd(), 0, 1, 2, 3, 4),
    "all docked, moving": lambda: with_moving(with_arrived(crowd(), 0, 1, 2, 3, 4)),
}


def sampled_controls(task: SamplingTask, mean: Any, sigma: Any, seed: int, step: int) -> np.ndarray:
    """``(M, H, K, m)`` what an engine rolls out in one step."""
    return (task.base + mean + sigma * engine_noise(task.problem, seed, step, NUM_SAMPLES)).astype(np.float32)


def step_by_step(
    engine: Any,
    task: SamplingTask,
    rules: SamplingRules = SOFTMAX,
    sigma: Any = (0.8, 0.5, 0.3),
    num_samples: int = NUM_SAMPLES,
) -> None:
    """Hold a denoising run to the reference: the rewards of every sample, their weights, the means under those.

    Every step is judged for itself: the reference takes the rewards that the engine found, weighs them, and goes on
    from there. Whole runs are no measure: once rounding has turned a single comparison of a single sample, which it
    does on one processor or another, they part for good. Samples in which it may do so are left out, and the rest must
    agree to as much as rounding alone explains.
    """
    recorded = RecordedRules(rules)
    mean = 0.1 * engine_noise(task.problem, 99, 0, 1)[0]
    result = engine.denoise(task, recorded.rules, mean, np.array(sigma, np.float32), num_samples, 11)
    mean, factor, drift = mean.astype(np.float64), 1.0, 0.0
    rows = 1 if task.credit == "team" else task.problem.num_robots
    units = task.problem.team.control_units.astype(np.float64)
    assert [rewards.shape for rewards in recorded.rewards] == [(rows, num_samples)] * len(sigma)
    for step, (rewards, weights) in enumerate(zip(recorded.rewards, recorded.weights, strict=True)):
        scale = factor * np.float64(np.float32(sigma[step])) * units
        samples = mean + scale * engine_noise(task.problem, 11, step, num_samples)
        assert_rewards(task, task.base + samples, rewards, drift)
        assert result.rewards[step] == pytest.approx(rewards.mean(), abs=1e-6)

        log_ratio = [recorded.log_ratios[step].astype(np.float64)] if rules.importance else []
        expected = rules.weights(rewards.astype(np.float64), np, *log_ratio)
        # The logarithm of a weight that counts is below 50, and a handful of roundings of that change the weight so.
        np.testing.assert_allclose(weights, expected, rtol=1e-4, atol=1e-8)

        shares = np.broadcast_to(weights, (task.problem.num_robots, num_samples)).astype(np.float64)
        mean = np.einsum("ks,stkm->tkm", shares, samples)
        # A sum of as many shares of the largest sample, rounded either way after every term.
        drift += 3 * np.sqrt(num_samples) * ROUNDOFF * float(np.abs(samples).max())
        if rules.adapt is not None:
            spread2 = np.einsum("ks,stkm->tkm", shares, (samples - mean) ** 2)
            np.testing.assert_allclose(recorded.deviations[step], spread2 / units**2, atol=10 * drift)
            factor = rules.adapt(recorded.deviations[step].astype(np.float64), np)
    np.testing.assert_allclose(result.mean, mean, atol=drift)
    assert result.excluded == 0


def assert_rewards(task: SamplingTask, controls: np.ndarray, rewards: np.ndarray, drift: float = 0.0) -> None:
    """Hold ``rewards`` ``(1 or K, M)`` to those of the reference, in all samples that leave no doubt."""
    expected, error = evaluate(task, controls), position_error(task, controls, drift)
    clear = expected.doubt > error
    # Else the comparison would say little. Two samples in three is what the fullest of worlds here leaves.
    assert clear.mean() > 0.6
    gap, tolerance = rewards - expected.rewards, error * expected.inverse_distance
    if task.credit == "team":
        gap, tolerance = rewards - expected.rewards.mean(axis=0), tolerance.mean(keepdims=True)
    penalty = task.penalty * task.problem.collision_penalty
    assert (np.abs(gap[:, clear]) <= (tolerance + 16 * ROUNDOFF * penalty)[:, None]).all()


ENGINES = {"cpu": CPU, "jax": JAX}


STEPPED = [
    ("mixed", "robot"), ("harder", "team"), ("harder, obstacles", "team"), ("docking in space", "team"),
    ("arrived", "robot"), ("mixed", "team"), ("harder", "robot"), ("alone", "team"), ("docking drives", "robot"),
    ("moving in space", "robot"), ("moving, no collisions", "team"), ("all docked, moving", "robot"),
    ("velocity2d", "robot"), ("holonomic3d", "team"), ("obstacles", "team"), ("space", "robot"), ("docking", "robot"),
    *((name, credit) for name in ("holonomic2d", "differential_drive") for credit in CREDITS), ("moving", "team"),
    ("no collisions", "robot"), ("all docked", "team"), ("docked, moving", "team"),
]  # fmt: skip


# JAX compiles for seconds for every one of them, so it meets those that hold what the others are about.
@pytest.mark.parametrize(
    ("name", "credit", "engine"),
    [
        *((*case, "cpu") for case in STEPPED),
        *((*case, "jax") for case in STEPPED[:5]),
        *(slow(*case, "jax") for case in STEPPED[5:12]),
    ],
)
def test_every_step_is_that_of_the_reference(name: str, credit: str, engine: str) -> None:
    step_by_step(ENGINES[engine], replace(TASKS[name](), credit=credit))


@pytest.mark.parametrize("engine", ENGINE_NAMES)
def test_so_it_is_for_robots_that_stand_in_all_samples(engine: str) -> None:
    task = replace(arriving(), credit="robot")
    assert CPU.rollout(task.problem, task.base).arrived[10].all()
    step_by_step(ENGINES[engine], task, sigma=(0.1, 0.05))


WORLDS = ("sphere", "rooms", "map")
"""Fuller worlds than those above; JAX compiles for minutes for all scenarios, and rolls out in all elsewhere."""


@pytest.mark.parametrize(
    ("scenario", "engine"), [*((name, "cpu") for name in list_scenarios()), *((name, "jax") for name in WORLDS)]
)
@pytest.mark.slow
def test_so_it_is_in_every_scenario(scenario: str, engine: str) -> None:
    size = {} if scenario.startswith("amswarm") else {"num_robots": 4}
    problem = make_problem(scenario, **size, **needed(scenario), horizon=20, dt=0.25)
    task = SamplingTask(problem, 0.3 * toward_goals(problem), credit="robot")
    step_by_step(ENGINES[engine], task, sigma=(0.6, 0.2))


@pytest.mark.parametrize("engine", ENGINE_NAMES)
@pytest.mark.parametrize("num_samples", [slow(2), 65])
def test_so_it_is_with_any_number_of_samples(num_samples: int, engine: str) -> None:
    step_by_step(ENGINES[engine], TASKS["alone"](), num_samples=num_samples)


@pytest.mark.parametrize("engine", ENGINE_NAMES)
@pytest.mark.parametrize("credit", ["team", slow("robot")])
def test_so_it_is_with_importance(credit: str, engine: str) -> None:
    step_by_step(ENGINES[engine], replace(TASKS["holonomic2d"](), credit=credit), SOFTMAX._replace(importance=0.05))


@pytest.mark.parametrize("engine", ENGINE_NAMES)
@pytest.mark.parametrize("credit", ["team", slow("robot")])
def test_so_it_is_where_the_noise_follows_the_spread_of_the_samples(credit: str, engine: str) -> None:
    rules = SamplingRules(EliteWeights(0.1), Spread(0.05))
    step_by_step(ENGINES[engine], replace(TASKS["holonomic2d"](), credit=credit), rules)


def test_the_reference_tells_contacts_and_docking_apart() -> None:
    """Were no sample ever near anything, agreement on it would say nothing."""

    def mean_reward(task: SamplingTask) -> float:
        return float(evaluate(task, sampled_controls(task, 0, np.float32(0.7), 3, 0)).rewards.mean())

    free, crowded, moving = (mean_reward(TASKS[name]()) for name in ("no collisions", "holonomic2d", "moving"))
    assert moving + 0.02 < crowded
    assert crowded + 0.02 < free
    assert mean_reward(TASKS["moving, no collisions"]()) == free
    anyhow = replace(TASKS["docking"](), problem=TASKS["docking"]().problem.replace(goal_speed=np.inf))
    assert (
        len({round(reward, 2) for reward in map(mean_reward, (TASKS["docking"](), anyhow, TASKS["holonomic2d"]()))})
        == 3
    )


def passing_by(**scoring: Any) -> SamplingTask:
    """Ten steps of 0.1 m: robot 0 goes 4 m to a goal and is met on steps 3, 4 and 5; robot 1 has 2 m to go, and waits.

    The circle comes within robot 0's margin on the last four steps.
    """
    problem = Problem(
        Team(("velocity2d",) * 2, radius=0.25),
        [[0, 0], [0, 5]],
        [[4, 0], [2, 5]],
        World(2, circles=[[1.0, 0.45, 0.25]]),
        horizon=10,
        dt=0.1,
        margin=0.05,
    )
    base = np.zeros((10, 2, 2), np.float32)
    base[:, 0, 0] = 1
    met = np.full((10, 1, 2), 50, np.float32)
    met[2:5] = [[[0.3, -0.3]], [[0.4, -0.3]], [[0.5, -0.3]]]
    return SamplingTask(problem, base, credit="robot", moving=MovingObstacles(met, np.float32([0.1])), **scoring)


@pytest.mark.parametrize(
    ("scoring", "expected"),
    [
        # Robot 0 is at 0.1, ..., 1.0 m, on average 3.45 m from its goal, and in violation 3 + 4 times.
        ({}, [1 - 3.45 / 4 - 0.7, 0]),
        ({"penalty": 3.0}, [1 - 3.45 / 4 - 2.1, 0]),
        ({"penalty": 3.0, "collisions": False}, [1 - 3.45 / 4 - 1.2, 0]),
        # Robot 1 never moves: 2 m of a reference of 5 m. What is below both initial distances changes nothing.
        ({"reference_distance": 5.0}, [1 - 3.45 / 5 - 0.7, 0.6]),
        ({"reference_distance": 3.0}, [1 - 3.45 / 4 - 0.7, 1 / 3]),
        ({"reference_distance": 1.5}, [1 - 3.45 / 4 - 0.7, 0]),
        ({"penalty": 3.0, "reference_distance": 5.0}, [1 - 3.45 / 5 - 2.1, 0.6]),
    ],
)
def test_penalty_and_reference_distance_of_a_task_change_the_rewards(
    scoring: dict[str, Any], expected: list[float]
) -> None:
    task = passing_by(**scoring)
    np.testing.assert_allclose(cpu_rewards(CPU, task, 0.0, 2, 0).T, [expected] * 2, atol=1e-5)
    for engine in (CPU, JAX):
        result = engine.denoise(task, SOFTMAX, 0 * task.base, np.zeros(1, np.float32), 2, 0)
        assert result.rewards.tolist() == [pytest.approx(np.mean(expected), abs=1e-5)]


@pytest.mark.parametrize(("per_pair", "expected"), [(False, [2.0, 2.0, 3.0]), (True, [6.0, 6.0, 9.0])])
def test_a_penalty_may_be_each_robots_own_and_be_paid_for_every_pair(per_pair: bool, expected: list[float]) -> None:
    """Three robots near each other, and a body between them, all the time."""
    start = np.float32([[0, 0], [0.32, 0], [0.16, 0.277]])
    problem = Problem(Team(("velocity2d",) * 3), start, start + np.float32([4, 0]), horizon=10)
    moving = MovingObstacles(np.full((10, 1, 2), [0.16, 0.09], np.float32), np.float32([0.1]))
    base = np.zeros((10, 3, 2), np.float32)
    penalty = np.float32([2, 2, 3])
    task = SamplingTask(problem, base, credit="robot", moving=moving, penalty=penalty, penalty_per_pair=per_pair)
    np.testing.assert_allclose(cpu_rewards(CPU, task, 0.0, 2, 0).T, [np.negative(expected)] * 2, atol=1e-5)
    result = JAX.denoise(task, SOFTMAX, 0 * base, np.zeros(1, np.float32), 2, 0)
    assert result.rewards.tolist() == [pytest.approx(-np.mean(expected), abs=1e-5)]


@pytest.mark.parametrize("engine", [CPU, JAX], ids=["cpu", "jax"])
def test_robots_without_noise_keep_their_controls(engine: Any) -> None:
    task = TASKS["holonomic2d"]()
    factor = np.ones_like(task.base)
    factor[:, 1] = 0
    task = replace(task, credit="robot", noise_factor=factor)
    result = engine.denoise(task, SOFTMAX, 0 * task.base, np.full(3, 0.5, np.float32), NUM_SAMPLES, 0)
    assert not result.mean[:, 1].any()
    assert result.mean[:, 0].any()


def test_team_credit_is_the_mean_of_the_robots_rewards() -> None:
    task = TASKS["obstacles"]()
    team = cpu_rewards(CPU, task, 0.7, NUM_SAMPLES, 1)
    robots = cpu_rewards(CPU, replace(task, credit="robot"), 0.7, NUM_SAMPLES, 1)
    np.testing.assert_allclose(team[0], robots.mean(axis=0), atol=1e-6)


@dataclass(frozen=True)
class Spread:
    """The next step's noise has the spread of the samples that counted, and a floor."""

    floor: float

    def __call__(self, deviation2: Any, xp: Any) -> Any:
        return xp.sqrt(xp.maximum(deviation2, 0)) + self.floor


@pytest.mark.parametrize("engine", ENGINE_NAMES)
@pytest.mark.parametrize(("name", "credit"), [slow("holonomic2d", "team"), ("holonomic3d", "robot")])
def test_importance_weighs_by_how_likely_a_sample_is_around_zero(name: str, credit: str, engine: str) -> None:
    """The term is the logarithm of a ratio of densities, written out here from the samples themselves."""
    task = replace(TASKS[name](), credit=credit)
    mean = np.random.default_rng(0).normal(size=task.base.shape).astype(np.float32)
    recorded = RecordedRules(SOFTMAX._replace(importance=0.5))
    ENGINES[engine].denoise(task, recorded.rules, mean, np.array([0.7], np.float32), NUM_SAMPLES, seed=5)
    centre, sigma = (task.base + mean).astype(np.float64), 0.7
    samples = centre + sigma * engine_noise(task.problem, 5, 0, NUM_SAMPLES)

    def log_density(around: Any) -> Any:
        return -0.5 * (((samples - around) / sigma) ** 2).sum(axis=(1, 3))

    expected = 0.5 * (log_density(0) - log_density(centre) + 0.5 * ((centre / sigma) ** 2).sum(axis=(0, 2))).T
    if credit == "team":
        expected = expected.sum(axis=0, keepdims=True)
    np.testing.assert_allclose(recorded.log_ratios[0], expected, rtol=1e-4, atol=1e-3)


def run(engine: Any, task: SamplingTask, steps: int, rules: SamplingRules = SOFTMAX, **options: Any) -> SamplingResult:
    arguments = {"num_samples": NUM_SAMPLES, "seed": 12} | options
    return engine.denoise(task, rules, np.zeros_like(task.base), annealed(steps, 1e-4, 2e-2), **arguments)


@pytest.mark.parametrize("engine", ENGINE_NAMES)
def test_a_long_run_improves_the_team(engine: str) -> None:
    task = replace(TASKS["holonomic2d"](), credit="robot")
    result = run(ENGINES[engine], task, 20)
    before = CPU.rollout(task.problem, task.base).rewards.mean()
    assert CPU.rollout(task.problem, task.base + result.mean).rewards.mean() > before + 0.05
    assert result.rewards[-1] > result.rewards[0] + 0.1


@pytest.mark.parametrize("name", ["holonomic2d", "mixed", "moving in space"])
@pytest.mark.parametrize("rules", [SOFTMAX, SamplingRules(EliteWeights(0.1), Spread(0.1))], ids=["softmax", "elite"])
def test_the_number_of_threads_changes_no_bit(name: str, rules: SamplingRules) -> None:
    task = replace(TASKS[name](), credit="robot")
    single, *others = (run(CpuSamplingEngine(num_threads=n), task, 4, rules, num_samples=333) for n in (1, 2, 3, 8))
    for other in others:
        assert other.mean.tobytes() == single.mean.tobytes()
        assert other.rewards.tobytes() == single.rewards.tobytes()


@pytest.mark.parametrize("engine", ENGINE_NAMES)
def test_the_same_seed_repeats_and_another_does_not(engine: str) -> None:
    task, physics = TASKS["mixed"](), get_sampling_engine(engine)
    physics.prepare(task, SOFTMAX, annealed(3, 1e-4, 2e-2), NUM_SAMPLES)
    first, again = (run(physics, task, 3, seed=2**33) for _ in range(2))
    assert first.mean.tobytes() == again.mean.tobytes()
    assert first.rewards.tobytes() == again.rewards.tobytes()
    assert np.abs(run(physics, task, 3, seed=2**33 + 1).mean - first.mean).max() > 0.01


@pytest.mark.parametrize("engine", ENGINE_NAMES)
def test_arguments_are_left_alone(engine: str) -> None:
    task, mean = TASKS["docked, moving"](), np.full((25, 5, 2), 0.1, np.float32)
    before = task.base.copy(), mean.copy(), np.copy(task.arrived), task.moving.positions.copy()
    get_sampling_engine(engine).denoise(task, SOFTMAX, mean, annealed(2, 1e-4, 2e-2), 64, 0)
    for old, new in zip(before, (task.base, mean, task.arrived, task.moving.positions), strict=True):
        np.testing.assert_array_equal(old, new)


def test_robots_docked_from_the_start_neither_move_nor_gain() -> None:
    task = replace(TASKS["all docked"](), credit="robot")
    np.testing.assert_allclose(cpu_rewards(CPU, task, 0.7, NUM_SAMPLES, 0), 0, atol=1e-6)


@dataclass(frozen=True)
class Burst:
    """Noise of one, but for one control of one robot, whose noise is so large that some samples overflow."""

    shape: tuple[int, ...]
    position: tuple[int, ...]
    size: float

    def __call__(self, deviation2: Any, xp: Any) -> Any:
        factor = np.ones(self.shape, np.float32)
        factor[self.position] = self.size
        return xp.asarray(factor)


def bursting_controls(task: SamplingTask, burst: Burst) -> Any:
    """The controls of the second step, whose noise is the burst."""
    mean = CPU.denoise(task, SOFTMAX, 0 * task.base, np.ones(1, np.float32), NUM_SAMPLES, seed=4).mean
    return sampled_controls(task, mean, burst(0, np), 4, 1)


@pytest.mark.parametrize("engine", ENGINE_NAMES)
@pytest.mark.parametrize("credit", ["robot", slow("team")])
def test_samples_that_blow_up_are_excluded_and_counted_and_change_no_other(credit: str, engine: str) -> None:
    """A quarter of the samples in each tile gets a control whose square is infinite: its robot is nowhere."""
    task = replace(TASKS["obstacles"](), credit=credit)
    burst = Burst(task.base.shape, (6, 0, 1), 1.6e19)
    recorded = RecordedRules(SamplingRules(SOFTMAX.weights, burst))
    sigma = np.ones(2, np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        result = get_sampling_engine(engine).denoise(task, recorded.rules, 0 * task.base, sigma, NUM_SAMPLES, seed=4)
        controls = bursting_controls(task, burst)
        blown = ~np.isfinite(np.square(controls, dtype=np.float32)).all(axis=(1, 2, 3))
    assert 20 < blown.sum() < 80
    rewards = recorded.rewards[1]
    if credit == "team":
        np.testing.assert_array_equal(np.isneginf(rewards[0]), blown)
    else:
        np.testing.assert_array_equal(np.isneginf(rewards), [blown, 0 * blown, 0 * blown])
    assert result.excluded == blown.sum()
    assert_rewards(task, controls[~blown], rewards[:, ~blown])
    assert np.isfinite(result.mean).all()


def test_samples_that_blow_up_do_not_hide_where_the_others_are() -> None:
    """Half the samples of every tile overflow early on, and the rest spread out for long after that."""
    task = replace(TASKS["obstacles"](), credit="robot")
    burst = Burst(task.base.shape, (3, 0, 0), 2.7e19)
    recorded = RecordedRules(SamplingRules(lambda rewards, xp: xp.zeros_like(rewards), burst))
    with np.errstate(over="ignore", invalid="ignore"):
        CPU.denoise(task, recorded.rules, 0 * task.base, np.ones(2, np.float32), NUM_SAMPLES, seed=0)
        controls = sampled_controls(task, 0, burst(0, np), 0, 1)
        usable = np.flatnonzero(np.isfinite(np.square(controls, dtype=np.float32)).all(axis=(1, 2, 3)))
    assert 80 < len(usable) < 120
    assert_rewards(task, controls[usable], recorded.rewards[1][:, usable])


@pytest.mark.parametrize("engine", ENGINE_NAMES)
def test_with_all_samples_excluded_the_mean_stays(engine: str) -> None:
    task = TASKS["holonomic2d"]()
    base, mean = task.base.copy(), np.full_like(task.base, 0.25)
    base[3, 2] = np.nan
    result = get_sampling_engine(engine).denoise(
        replace(task, base=base), SOFTMAX, mean, np.ones(3, np.float32), 100, 0
    )
    np.testing.assert_array_equal(result.mean, mean)
    assert result.excluded == 300
    assert result.rewards.tolist() == [0, 0, 0]


@pytest.mark.parametrize("engine", ENGINE_NAMES)
def test_a_robot_without_a_usable_sample_keeps_its_mean_and_the_others_go_on(engine: str) -> None:
    task = replace(TASKS["holonomic2d"](), credit="robot")
    base, mean = task.base.copy(), np.full_like(task.base, 0.25)
    base[0, 2] = np.nan
    result = get_sampling_engine(engine).denoise(
        replace(task, base=base), SOFTMAX, mean, np.ones(2, np.float32), 100, 0
    )
    np.testing.assert_array_equal(result.mean[:, 2], mean[:, 2])
    assert (np.abs(result.mean[:, [0, 1, 3, 4]] - 0.25).max(axis=(0, 2)) > 0.1).all()
    assert np.isfinite(result.mean).all()
    assert result.excluded == 200


def test_kernels_of_different_models_share_no_file() -> None:
    teams = [*((name,) for name in MODELS), ("holonomic2d", "differential_drive")]
    files = [score_kernel(models)._cache._impl.filename_base for models in teams]
    assert len(set(files)) == len(files)
    # All common planar models are in the kernel of mixed teams, whoever they are.
    assert score_kernel(("velocity2d", "holonomic2d")) is score_kernel(teams[-1])
    assert score_kernel(("holonomic2d",) * 5) is score_kernel(("holonomic2d",))
    # Teams with another model compile no more than the models that they have.
    assert score_kernel(("car", "holonomic2d")).py_func.__qualname__.endswith("_holonomic2d_car")


@slow
@pytest.mark.parametrize("robots", [{}, {"model": "differential_drive", "footprint": Box(0.36, 0.24)}])
def test_denoising_of_64_robots_in_jax_needs_less_than_2_gb(robots: dict[str, Any]) -> None:
    problem = make_problem("circle", num_robots=64, diameter=16.0, horizon=100, **robots)
    none = np.zeros((problem.horizon, problem.num_robots, problem.control_size), np.float32)
    compiled, _ = JAX._lower(
        SamplingTask(problem, none), SOFTMAX, none, np.linspace(1, 0.1, 3, dtype=np.float32), 1024, 0
    )
    memory = compiled.memory_analysis()
    assert memory.argument_size_in_bytes + memory.output_size_in_bytes + memory.temp_size_in_bytes < 2e9
