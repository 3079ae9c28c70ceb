"""What the tests of the core and the engines share: engines by name, plain NumPy operations, problems at hand."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from d4orm_env.core.observation_layout import ObservationLayout
from d4orm_env.core.problem import Problem
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.core.team import Team
from d4orm_env.core.world import World
from d4orm_env.dynamics.robot_model import Ops
from d4orm_env.engine import noise
from d4orm_env.engine.types import Engine, ObservationInputs, StepResult
from d4orm_planners.engine.sampling_types import SamplingRules, SamplingTask, get_sampling_engine

ENGINE_NAMES = ("cpu", "jax")
MODEL_NAMES = ("holonomic2d", "holonomic3d", "velocity2d", "differential_drive")
STANDING = {2: "velocity2d", 3: "holonomic3d"}
"""A model that stays where it is under zero control, by dimension."""

NUMPY_OPS = Ops(np.cos, np.sin, np.sqrt, np.minimum, np.maximum, np.arctan2, np.where)
PYTHON_OPS = Ops(math.cos, math.sin, math.sqrt, min, max, math.atan2, lambda condition, a, b: a if condition else b)
NUMPY_BITS = noise.BitOps(
    uint32=lambda x: np.asarray(x).astype(np.uint32),
    int32=lambda x: np.asarray(x).astype(np.int32),
    to_float=lambda x: np.asarray(x).astype(np.float32),
    float_bits=lambda x: np.asarray(x, np.float32).view(np.int32),
    bits_float=lambda x: np.asarray(x, np.int32).view(np.float32),
    sqrt=np.sqrt,
)


def observe_team(
    arrays: ProblemArrays, layout: ObservationLayout, states: Any, controls: Any, arrived: Any, time_left: float
) -> np.ndarray:
    """``(K, D)`` what the robots of one team see."""
    out = np.empty((1, len(states), layout.size), np.float32)
    parts = [np.array(part)[None] for part in (arrays.goal, states, controls, arrived)]
    nothing = np.empty((1, 0, 2 * arrays.goal.shape[1] + 1), np.float32)
    sight = ObservationInputs(*parts, nothing, np.array([time_left], np.float32))
    get_sampling_engine("cpu").observe_worlds(arrays, layout, sight, out)
    return out[0]


def words(*values: int) -> list[np.ndarray]:
    """Each value as an array of one uint32: unlike scalars, arrays wrap without a warning."""
    return [np.array([value], np.uint32) for value in values]


def stream(seed: int = 0, step: int = 0, robot: int = 0, time: int = 0, pair: int = 0) -> Any:
    """The keys of one stream of noise."""
    low, high = noise.seed_words(seed)
    return noise.stream_key(*words(int(low), int(high), step, robot, time, pair), NUMPY_BITS)


def engine_noise(problem: Problem, seed: int, step: int, num_samples: int) -> np.ndarray:
    """``(M, H, K, m)`` float32: the standard normals that an engine adds in one denoising step."""
    counters, cosine, sine = noise.turned(np.arange(num_samples, dtype=np.uint32), NUMPY_BITS)
    size = problem.control_size
    draws = np.empty((num_samples, problem.horizon, problem.num_robots, size), np.float32)
    for time in range(problem.horizon):
        for robot in range(problem.num_robots):
            for pair in range((size + 1) // 2):
                x, y = noise.normal_pair(counters, stream(seed, step, robot, time, pair), NUMPY_BITS)
                both = cosine * x - sine * y, sine * x + cosine * y
                for component, draw in zip(range(2 * pair, size), both):
                    draws[:, time, robot, component] = draw
    return draws


def open_problem(
    num_robots: int, dimension: int = 2, world: World | None = None, radius: Any = 0.25, **changes: Any
) -> Problem:
    """Robots far from each other, from their goals and from everything near the origin."""
    team = Team((STANDING[dimension],) * num_robots, radius=radius)
    position = np.zeros((num_robots, dimension))
    position[:, 0] = 100 + 10 * np.arange(num_robots)
    start = np.zeros((num_robots, team.state_size))
    start[:, :dimension] = position
    return Problem(team, start, position + 3, world, **changes)


def stand(engine: Engine, problem: Problem, positions: Any) -> StepResult:
    """What an engine says of the team standing still at ``positions`` ``(K, d)``, which no problem need allow."""
    states = np.zeros((problem.num_robots, problem.state_size), np.float32)
    states[:, : problem.dimension] = positions
    controls = np.zeros((problem.num_robots, problem.control_size), np.float32)
    result = engine.step(problem.arrays, states, np.zeros(problem.num_robots, bool), controls)
    np.testing.assert_array_equal(result.states, states)
    return result


def random_controls(problem: Problem, seed: int, scale: float = 1.5) -> np.ndarray:
    """``(H, K, m)`` smooth controls, some of them beyond the limits."""
    generator = np.random.default_rng(seed)
    steady = generator.standard_normal((1, problem.num_robots, problem.control_size))
    wobble = generator.standard_normal((problem.horizon, problem.num_robots, problem.control_size))
    controls = (scale * steady + 0.5 * wobble) * problem.team.control_limits
    return controls.astype(np.float32)


def toward_goals(problem: Problem) -> np.ndarray:
    """``(H, K, m)`` controls that push every robot toward its goal, so that the team meets in the middle."""
    controls = np.zeros((problem.horizon, problem.num_robots, problem.control_size), np.float32)
    ahead = problem.goal - problem.start[:, : problem.dimension]
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    for robot, model in enumerate(problem.team.robot_models):
        if model.heading_index is None:
            controls[:, robot, : problem.dimension] = ahead[robot]
        else:
            controls[:, robot, 1] = 1
    return controls


@dataclass(frozen=True)
class SameWeights:
    """Rules that ignore the rewards: rows of weights fixed beforehand, one for the team or one per robot.

    Attributes:
        rows: Nested tuples ``(1 or K, M)``, so that the rules can be hashed.
    """

    rows: tuple[tuple[float, ...], ...]

    @classmethod
    def picking(cls, samples: Any, num_samples: int) -> SameWeights:
        """All weight on one sample, for the team or for each robot."""
        return cls(tuple(tuple(float(i == sample) for i in range(num_samples)) for sample in samples))

    def __call__(self, rewards: Any, xp: Any) -> Any:
        del rewards
        return xp.asarray(self.rows, dtype=np.float32)


class RecordedRules:
    """A method's rules that keep what an engine calls them with and what they answer, step by step.

    Attributes:
        rules: To hand to the engine.
        rewards: ``(1, M)`` or ``(K, M)`` of each step.
        weights: Of the same shapes.
        log_ratios: Likewise, where the rules ask for them.
        deviations: ``(H, K, m)`` of each step, where the rules adapt the noise.
    """

    def __init__(self, rules: SamplingRules) -> None:
        self.rewards: list[np.ndarray] = []
        self.weights: list[np.ndarray] = []
        self.log_ratios: list[np.ndarray] = []
        self.deviations: list[np.ndarray] = []
        self._inner = rules
        self.rules = rules._replace(weights=self._weights, adapt=None if rules.adapt is None else self._adapt)

    def _weights(self, rewards: Any, xp: Any, *log_ratio: Any) -> Any:
        weights = self._inner.weights(rewards, xp, *log_ratio)
        for kept, value in zip((self.rewards, self.weights, self.log_ratios), (rewards, weights, *log_ratio)):
            _keep(kept, value, xp)
        return weights

    def _adapt(self, deviation2: Any, xp: Any) -> Any:
        assert self._inner.adapt is not None
        _keep(self.deviations, deviation2, xp)
        return self._inner.adapt(deviation2, xp)


def _keep(kept: list[np.ndarray], value: Any, xp: Any) -> None:
    """Append a copy; out of a compiled run it comes by a callback."""
    if xp is np:
        kept.append(np.array(value))
    else:
        jax.debug.callback(lambda array: kept.append(np.array(array)), value, ordered=True)


def cpu_rewards(engine: Engine, task: SamplingTask, sigma: float, num_samples: int, seed: int) -> np.ndarray:
    """``(1, M)`` or ``(K, M)`` rewards of the samples of one step around zero."""
    recorded = RecordedRules(SamplingRules(lambda rewards, xp: xp.full_like(rewards, 1 / rewards.shape[-1])))
    mean = np.zeros_like(task.base)
    engine.denoise(task, recorded.rules, mean, np.array([sigma], np.float32), num_samples, seed)
    return recorded.rewards[0]


def rk4(derivative: Callable[..., Any], x: Any, u: Any, dt: Any, ops: Ops) -> tuple[Any, ...]:
    """Classical fourth-order Runge-Kutta as textbooks have it, over one step with the control held constant."""

    def moved(share: Any, k: Any) -> tuple[Any, ...]:
        return tuple(component + share * slope for component, slope in zip(x, k, strict=True))

    k1 = derivative(x, u, ops)
    k2 = derivative(moved(dt / 2, k1), u, ops)
    k3 = derivative(moved(dt / 2, k2), u, ops)
    k4 = derivative(moved(dt, k3), u, ops)
    return moved(dt / 6, tuple(a + 2 * b + 2 * c + d for a, b, c, d in zip(k1, k2, k3, k4, strict=True)))
