"""Denoising runs: both engines against a plain reference, against each other, and under strain."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from engine_support import ENGINE_NAMES, RecordedWeights, SameWeights, cpu_rewards, engine_noise, toward_goals
from env_support import mixed_problem

from d4orm_env.core.dynamics import MODELS
from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.core.world import World
from d4orm_env.engine.base import MovingObstacles, SamplingResult, SamplingRules, SamplingTask, get_engine
from d4orm_env.engine.cpu import CpuEngine
from d4orm_env.engine.jax import JaxEngine
from d4orm_env.engine.sampling import score_kernel
from d4orm_env.scenarios import list_scenarios, make_problem
from d4orm_planners.sampling.schedule import annealed
from d4orm_planners.sampling.weights import EliteWeights, SoftmaxWeights

CPU, JAX = CpuEngine(), JaxEngine()
SOFTMAX = SamplingRules(SoftmaxWeights(0.3))
NUM_SAMPLES = 200  # three tiles and a bit
CREDITS = ("team", "robot")
PLANNED = {"horizon": 25, "dt": 0.2}


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


def mixed_team() -> SamplingTask:
    problem = mixed_problem().replace(**PLANNED)
    return SamplingTask(problem, np.zeros((25, 3, 2), np.float32))


def through(problem: Problem) -> MovingObstacles:
    """A large body that crosses the middle, and a small one that stands there."""
    path = np.zeros((problem.horizon, 2, problem.dimension), np.float32)
    path[:, 0, 0] = np.linspace(-1, 1, problem.horizon)
    return MovingObstacles(path, np.array([0.3, 0.05], np.float32))


def with_moving(task: SamplingTask) -> SamplingTask:
    return replace(task, moving=through(task.problem))


def with_docked(task: SamplingTask, *robots: int) -> SamplingTask:
    arrived = np.zeros(task.problem.num_robots, bool)
    arrived[list(robots)] = True
    return replace(task, arrived=arrived)


def harder(task: SamplingTask) -> SamplingTask:
    """Violations cost more, and distances count relative to more than the robots' own."""
    return replace(task, penalty=3.0, reference_distance=5.0)


TASKS: dict[str, Callable[[], SamplingTask]] = {
    "holonomic2d": crowd,
    "velocity2d": lambda: crowd("velocity2d"),
    "differential_drive": lambda: crowd("differential_drive"),
    "holonomic3d": lambda: crowd("holonomic3d"),
    "alone": lambda: crowd(num_robots=1),
    "mixed": mixed_team,
    "obstacles": among_obstacles,
    "space": in_space,
    "no collisions": lambda: replace(crowd(), collisions=False),
    "moving": lambda: with_moving(crowd()),
    "moving, no collisions": lambda: replace(with_moving(crowd()), collisions=False),
    "moving in space": lambda: with_moving(in_space()),
    "harder": lambda: harder(with_moving(crowd())),
    "harder, obstacles": lambda: harder(among_obstacles()),
    "docked": lambda: with_docked(among_obstacles(), 1),
    "docked, moving": lambda: with_moving(with_docked(crowd(), 0, 3)),
    "all docked": lambda: with_docked(crowd(), 0, 1, 2, 3, 4),
    "all docked, moving": lambda: with_moving(with_docked(crowd(), 0, 1, 2, 3, 4)),
}


def plain_rewards(task: SamplingTask, controls: np.ndarray) -> np.ndarray:
    """``(K,)`` mean rewards of one sample ``(H, K, m)``, in float64 from every distance there is."""
    problem = task.problem
    d, radius = problem.dimension, np.asarray(problem.team.radius, np.float64)
    states = problem.start
    arrived = np.zeros(problem.num_robots, bool) if task.arrived is None else task.arrived
    reference = np.linalg.norm(problem.goal - problem.start[:, :d], axis=1).astype(np.float64)
    if task.reference_distance is not None:
        reference = np.maximum(reference, task.reference_distance)
    total = np.zeros(problem.num_robots)
    for t, control in enumerate(controls):
        states, _, arrived, *_ = CPU.step(problem.arrays, states, arrived, control)
        place = states[:, :d].astype(np.float64)
        near = np.zeros(problem.num_robots, bool)
        if task.collisions:
            gaps = np.linalg.norm(place[:, None] - place, axis=-1) - radius[:, None] - radius
            near |= (gaps + np.diag([np.inf] * len(gaps)) <= problem.margin).any(axis=1)
            if task.moving is not None:
                gaps = np.linalg.norm(place[:, None] - task.moving.positions[t], axis=-1) - radius[:, None]
                near |= (gaps - task.moving.radius <= problem.margin).any(axis=1)
        hit = problem.world.clearance(place) - radius <= problem.margin
        violations = near.astype(int) + hit
        total += 1 - np.linalg.norm(problem.goal - place, axis=1) / reference - task.penalty * violations
    return total / len(controls)


def sampled_controls(task: SamplingTask, mean: Any, sigma: Any, seed: int, step: int) -> np.ndarray:
    """``(M, H, K, m)`` what an engine rolls out in one step."""
    return (task.base + mean + sigma * engine_noise(task.problem, seed, step, NUM_SAMPLES)).astype(np.float32)


@pytest.mark.parametrize("name", TASKS)
def test_rewards_of_samples_are_those_of_plain_rollouts(name: str) -> None:
    task = TASKS[name]()
    rewards = cpu_rewards(CPU, replace(task, credit="robot"), 0.7, NUM_SAMPLES, seed=3)
    controls = sampled_controls(task, 0, np.float32(0.7), 3, 0)
    for sample in (0, 31, 32, 63, 64, 130, 199):
        np.testing.assert_allclose(rewards[:, sample], plain_rewards(task, controls[sample]), atol=1e-4)


def test_the_tasks_above_tell_contacts_apart() -> None:
    """Were no sample ever near anything, agreement on penalties would say nothing."""
    free = cpu_rewards(CPU, TASKS["no collisions"](), 0.7, NUM_SAMPLES, 3).mean()
    crowded = cpu_rewards(CPU, TASKS["holonomic2d"](), 0.7, NUM_SAMPLES, 3).mean()
    moving = cpu_rewards(CPU, TASKS["moving"](), 0.7, NUM_SAMPLES, 3).mean()
    assert moving + 0.02 < crowded
    assert crowded + 0.02 < free
    ignored = cpu_rewards(CPU, TASKS["moving, no collisions"](), 0.7, NUM_SAMPLES, 3).mean()
    assert ignored == free


@pytest.mark.parametrize("name", ["docked, moving", "space", "harder"])
def test_the_jax_engine_scores_those_samples_too(name: str) -> None:
    task = TASKS[name]()
    result = JAX.denoise(
        task, SamplingRules(SameWeights.picking((0,), 9)), 0 * task.base, np.float32([0.7]), num_samples=9, seed=3
    )
    controls = sampled_controls(task, 0, np.float32(0.7), 3, 0)[:9]
    expected = np.mean([plain_rewards(task, sample) for sample in controls])
    assert result.rewards.tolist() == [pytest.approx(expected, abs=1e-4)]


@pytest.mark.parametrize("credit", CREDITS)
@pytest.mark.parametrize("name", ["holonomic2d", "space", "mixed"])
def test_the_new_mean_is_the_weighted_mean_of_the_samples(name: str, credit: str) -> None:
    task = replace(TASKS[name](), credit=credit)
    recorded = RecordedWeights(SOFTMAX.weights)
    mean = 0.1 * engine_noise(task.problem, 99, 0, 1)[0]
    sigma = np.array([0.8, 0.4], np.float32)
    result = CPU.denoise(task, SamplingRules(recorded), mean, sigma, NUM_SAMPLES, seed=5)
    for step, rewards in enumerate(recorded.rewards):
        assert rewards.shape == (1 if credit == "team" else task.problem.num_robots, NUM_SAMPLES)
        assert result.rewards[step] == pytest.approx(rewards.mean(), abs=1e-6)
        weights = np.broadcast_to(SOFTMAX.weights(rewards, np), (task.problem.num_robots, NUM_SAMPLES))
        samples = sampled_controls(task, mean, sigma[step], 5, step) - task.base
        mean = np.einsum("ks,stkm->tkm", weights.astype(np.float64), samples.astype(np.float64))
    np.testing.assert_allclose(result.mean, mean, atol=1e-5)
    assert result.excluded == 0


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


@pytest.mark.parametrize("credit", CREDITS)
def test_adapted_noise_follows_the_spread_of_the_samples(credit: str) -> None:
    task = replace(TASKS["holonomic2d"](), credit=credit)
    rewards, deviations = RecordedWeights(EliteWeights(0.1)), []

    def adapt(deviation2: Any, xp: Any) -> Any:
        deviations.append(deviation2)
        return Spread(0.05)(deviation2, xp)

    sigma = np.array([0.8, 0.5, 0.5], np.float32)
    CPU.denoise(task, SamplingRules(rewards, adapt), 0 * task.base, sigma, NUM_SAMPLES, seed=5)
    mean, factor = np.zeros(task.base.shape), np.ones(task.base.shape)
    for step in range(3):
        weights = np.broadcast_to(EliteWeights(0.1)(rewards.rewards[step], np), (task.problem.num_robots, NUM_SAMPLES))
        samples = mean + factor * sigma[step] * engine_noise(task.problem, 5, step, NUM_SAMPLES)
        mean = np.einsum("ks,stkm->tkm", weights, samples)
        spread2 = np.einsum("ks,stkm->tkm", weights, (samples - mean) ** 2)
        np.testing.assert_allclose(deviations[step], spread2, rtol=1e-3, atol=1e-5)
        factor = Spread(0.05)(spread2, np)


@pytest.mark.parametrize("credit", CREDITS)
@pytest.mark.parametrize("name", ["holonomic2d", "holonomic3d"])
def test_importance_weighs_by_how_likely_a_sample_is_around_zero(name: str, credit: str) -> None:
    """The term is the logarithm of a ratio of densities, written out here from the samples themselves."""
    task = replace(TASKS[name](), credit=credit)
    mean = np.random.default_rng(0).normal(size=task.base.shape).astype(np.float32)
    ratios = []

    def weights(rewards: Any, xp: Any, log_ratio: Any) -> Any:
        ratios.append(log_ratio)
        return SOFTMAX.weights(rewards, xp, log_ratio)

    rules = SamplingRules(weights, importance=0.5)
    CPU.denoise(task, rules, mean, np.array([0.7], np.float32), NUM_SAMPLES, seed=5)
    centre, sigma = (task.base + mean).astype(np.float64), 0.7
    samples = centre + sigma * engine_noise(task.problem, 5, 0, NUM_SAMPLES)

    def log_density(around: Any) -> Any:
        return -0.5 * (((samples - around) / sigma) ** 2).sum(axis=(1, 3))

    expected = 0.5 * (log_density(0) - log_density(centre) + 0.5 * ((centre / sigma) ** 2).sum(axis=(0, 2))).T
    if credit == "team":
        expected = expected.sum(axis=0, keepdims=True)
    np.testing.assert_allclose(ratios[0], expected, rtol=1e-4, atol=1e-3)


def run(engine: Any, task: SamplingTask, steps: int, rules: SamplingRules = SOFTMAX, **options: Any) -> SamplingResult:
    arguments = {"num_samples": NUM_SAMPLES, "seed": 12} | options
    return engine.denoise(task, rules, np.zeros_like(task.base), annealed(steps, 1e-4, 2e-2), **arguments)


def assert_same_run(task: SamplingTask, steps: int, rules: SamplingRules = SOFTMAX, **options: Any) -> None:
    """Whole runs agree to 1e-4.

    Rounding differs between the engines, and now and then that turns a single sample's margin flag at a single step.
    Such a sample shifts the mean a little, so the mean is held to less than the rewards.
    """
    first, second = (run(engine, task, steps, rules, **options) for engine in (CPU, JAX))
    assert first.mean.shape == second.mean.shape == task.base.shape
    np.testing.assert_allclose(first.rewards, second.rewards, rtol=1e-4, atol=2e-5)
    np.testing.assert_allclose(first.mean, second.mean, atol=2e-3)
    assert first.excluded == second.excluded == 0
    plans = [CPU.rollout(task.problem, task.base + result.mean).rewards.mean() for result in (first, second)]
    assert plans[0] == pytest.approx(plans[1], rel=1e-4, abs=2e-5)


@pytest.mark.parametrize(
    ("name", "credit"),
    [
        *((name, credit) for name in ("holonomic2d", "differential_drive", "mixed") for credit in CREDITS),
        ("velocity2d", "robot"),
        ("holonomic3d", "team"),
        ("obstacles", "team"),
        ("space", "robot"),
        ("no collisions", "robot"),
        ("moving", "team"),
        ("moving in space", "robot"),
        ("harder", "team"),
        ("harder", "robot"),
        ("harder, obstacles", "team"),
        ("docked", "robot"),
        ("docked, moving", "team"),
        ("all docked, moving", "robot"),
    ],
)
def test_engines_denoise_alike(name: str, credit: str) -> None:
    assert_same_run(replace(TASKS[name](), credit=credit), steps=8)


@pytest.mark.parametrize("scenario", list_scenarios())
def test_engines_denoise_every_scenario_alike(scenario: str) -> None:
    size = {} if scenario.startswith("amswarm") else {"num_robots": 4}
    problem = make_problem(scenario, **size, horizon=20, dt=0.25)
    assert_same_run(SamplingTask(problem, 0.3 * toward_goals(problem), credit="robot"), steps=5)


@pytest.mark.parametrize("num_samples", [2, 65])
def test_engines_denoise_alike_with_any_number_of_samples(num_samples: int) -> None:
    assert_same_run(TASKS["obstacles"](), steps=3, num_samples=num_samples)


@pytest.mark.parametrize("credit", CREDITS)
def test_engines_weigh_by_importance_alike(credit: str) -> None:
    task = replace(TASKS["holonomic2d"](), credit=credit)
    assert_same_run(task, 10, SOFTMAX._replace(importance=0.05))


def test_engines_adapt_the_noise_alike() -> None:
    rules = SamplingRules(EliteWeights(0.1), Spread(0.1))
    assert_same_run(replace(TASKS["holonomic2d"](), credit="robot"), steps=5, rules=rules)


def test_a_long_run_improves_the_team() -> None:
    task = replace(TASKS["holonomic2d"](), credit="robot")
    assert_same_run(task, steps=20)
    result = run(CPU, task, 20)
    before = CPU.rollout(task.problem, task.base).rewards.mean()
    assert CPU.rollout(task.problem, task.base + result.mean).rewards.mean() > before + 0.05
    assert result.rewards[-1] > result.rewards[0] + 0.1


@pytest.mark.parametrize("name", ["holonomic2d", "mixed", "moving in space"])
@pytest.mark.parametrize("rules", [SOFTMAX, SamplingRules(EliteWeights(0.1), Spread(0.1))], ids=["softmax", "elite"])
def test_the_number_of_threads_changes_no_bit(name: str, rules: SamplingRules) -> None:
    task = replace(TASKS[name](), credit="robot")
    single, *others = (run(CpuEngine(num_threads=n), task, 4, rules, num_samples=333) for n in (1, 2, 3, 8))
    for other in others:
        assert other.mean.tobytes() == single.mean.tobytes()
        assert other.rewards.tobytes() == single.rewards.tobytes()


@pytest.mark.parametrize("engine", ENGINE_NAMES)
def test_the_same_seed_repeats_and_another_does_not(engine: str) -> None:
    task, physics = TASKS["mixed"](), get_engine(engine)
    physics.prepare(task, SOFTMAX, annealed(3, 1e-4, 2e-2), NUM_SAMPLES)
    first, again = (run(physics, task, 3, seed=2**33) for _ in range(2))
    assert first.mean.tobytes() == again.mean.tobytes()
    assert first.rewards.tobytes() == again.rewards.tobytes()
    assert np.abs(run(physics, task, 3, seed=2**33 + 1).mean - first.mean).max() > 0.01


@pytest.mark.parametrize("engine", ENGINE_NAMES)
def test_arguments_are_left_alone(engine: str) -> None:
    task, mean = TASKS["docked, moving"](), np.full((25, 5, 2), 0.1, np.float32)
    before = task.base.copy(), mean.copy(), np.copy(task.arrived), task.moving.positions.copy()
    get_engine(engine).denoise(task, SOFTMAX, mean, annealed(2, 1e-4, 2e-2), 64, 0)
    for old, new in zip(before, (task.base, mean, task.arrived, task.moving.positions), strict=True):
        np.testing.assert_array_equal(old, new)


def test_robots_docked_from_the_start_neither_move_nor_gain() -> None:
    task = replace(TASKS["all docked"](), credit="robot")
    np.testing.assert_allclose(cpu_rewards(CPU, task, 0.7, NUM_SAMPLES, 0), 0, atol=1e-6)


@dataclass(frozen=True)
class Burst:
    """Noise of one, but for one control of one robot, whose noise is so large that some samples overflow."""

    shape: tuple[int, ...]
    place: tuple[int, ...]
    size: float

    def __call__(self, deviation2: Any, xp: Any) -> Any:
        factor = np.ones(self.shape, np.float32)
        factor[self.place] = self.size
        return xp.asarray(factor)


def bursting_controls(task: SamplingTask, burst: Burst) -> Any:
    """The controls of the second step, whose noise is the burst."""
    rules, sigma = SamplingRules(RecordedWeights(SOFTMAX.weights)), np.ones(1, np.float32)
    mean = CPU.denoise(task, rules, 0 * task.base, sigma, NUM_SAMPLES, seed=4).mean
    return sampled_controls(task, mean, burst(0, np), 4, 1)


@pytest.mark.parametrize("credit", CREDITS)
def test_jax_excludes_and_counts_samples_with_infinite_controls(credit: str) -> None:
    task = replace(TASKS["obstacles"](), credit=credit)
    burst = Burst(task.base.shape, (6, 0, 1), 3e38)
    with np.errstate(over="ignore", invalid="ignore"):
        rules = SamplingRules(SOFTMAX.weights, burst)
        result = JAX.denoise(task, rules, 0 * task.base, np.ones(2, np.float32), NUM_SAMPLES, seed=4)
        blown = ~np.isfinite(bursting_controls(task, burst)).all(axis=(1, 2, 3))
    assert 20 < blown.sum() < 80
    assert result.excluded == blown.sum()
    assert np.isfinite(result.mean).all()


@pytest.mark.parametrize("credit", CREDITS)
def test_samples_that_blow_up_are_excluded_and_counted_and_change_no_other(credit: str) -> None:
    """A quarter of the samples in each tile gets a control whose square is infinite: its robot is nowhere."""
    task = replace(TASKS["obstacles"](), credit=credit)
    burst = Burst(task.base.shape, (6, 0, 1), 1.6e19)
    recorded = RecordedWeights(SOFTMAX.weights)
    sigma = np.ones(2, np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        result = CPU.denoise(task, SamplingRules(recorded, burst), 0 * task.base, sigma, NUM_SAMPLES, seed=4)
        controls = bursting_controls(task, burst)
        blown = ~np.isfinite(np.square(controls, dtype=np.float32)).all(axis=(1, 2, 3))
    assert 20 < blown.sum() < 80
    rewards = recorded.rewards[1]
    if credit == "team":
        np.testing.assert_array_equal(np.isneginf(rewards[0]), blown)
    else:
        np.testing.assert_array_equal(np.isneginf(rewards), [blown, 0 * blown, 0 * blown])
    assert result.excluded == blown.sum()
    for sample in np.flatnonzero(~blown):
        expected = plain_rewards(task, controls[sample])
        found = rewards[0, sample] if credit == "team" else rewards[:, sample]
        np.testing.assert_allclose(found, expected.mean() if credit == "team" else expected, atol=1e-4)
    assert np.isfinite(result.mean).all()


def test_samples_that_blow_up_do_not_hide_where_the_others_are() -> None:
    """Half the samples of every tile overflow early on, and the rest spread out for long after that."""
    task = replace(TASKS["obstacles"](), credit="robot")
    burst = Burst(task.base.shape, (3, 0, 0), 2.7e19)
    recorded = RecordedWeights(lambda rewards, xp: xp.zeros_like(rewards))
    with np.errstate(over="ignore", invalid="ignore"):
        CPU.denoise(task, SamplingRules(recorded, burst), 0 * task.base, np.ones(2, np.float32), NUM_SAMPLES, seed=0)
        controls = sampled_controls(task, 0, burst(0, np), 0, 1)
        usable = np.flatnonzero(np.isfinite(np.square(controls, dtype=np.float32)).all(axis=(1, 2, 3)))
    assert 80 < len(usable) < 120
    expected = np.transpose([plain_rewards(task, controls[sample]) for sample in usable])
    np.testing.assert_allclose(recorded.rewards[1][:, usable], expected, atol=1e-4)


@pytest.mark.parametrize("engine", ENGINE_NAMES)
def test_with_all_samples_excluded_the_mean_stays(engine: str) -> None:
    task = TASKS["holonomic2d"]()
    base, mean = task.base.copy(), np.full_like(task.base, 0.25)
    base[3, 2] = np.nan
    result = get_engine(engine).denoise(replace(task, base=base), SOFTMAX, mean, np.ones(3, np.float32), 100, 0)
    np.testing.assert_array_equal(result.mean, mean)
    assert result.excluded == 300
    assert result.rewards.tolist() == [0, 0, 0]


@pytest.mark.parametrize("engine", ENGINE_NAMES)
def test_a_robot_without_a_usable_sample_keeps_its_mean_and_the_others_go_on(engine: str) -> None:
    task = replace(TASKS["holonomic2d"](), credit="robot")
    base, mean = task.base.copy(), np.full_like(task.base, 0.25)
    base[0, 2] = np.nan
    result = get_engine(engine).denoise(replace(task, base=base), SOFTMAX, mean, np.ones(2, np.float32), 100, 0)
    np.testing.assert_array_equal(result.mean[:, 2], mean[:, 2])
    assert (np.abs(result.mean[:, [0, 1, 3, 4]] - 0.25).max(axis=(0, 2)) > 0.1).all()
    assert np.isfinite(result.mean).all()
    assert result.excluded == 200


def test_kernels_of_different_models_share_no_file() -> None:
    teams = [*((name,) for name in MODELS), ("holonomic2d", "differential_drive")]
    files = [score_kernel(models)._cache._impl.filename_base for models in teams]
    assert len(set(files)) == len(files)
    # All planar models are in the kernel of mixed teams, whoever they are.
    assert score_kernel(("velocity2d", "holonomic2d")) is score_kernel(teams[-1])
    assert score_kernel(("holonomic2d",) * 5) is score_kernel(("holonomic2d",))
