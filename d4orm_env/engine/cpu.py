"""The CPU engine: the physics compiled with numba for all cores of one processor."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba.extending import register_jitable

from d4orm_env.core import collision, dynamics, observation, reward, transition
from d4orm_env.core.arrays import BoolArray, FloatArray
from d4orm_env.core.observation import ObservationLayout
from d4orm_env.core.problem import Problem, ProblemArrays
from d4orm_env.core.trajectory import Trajectory
from d4orm_env.engine import noise, sampling, tiles
from d4orm_env.engine.base import SamplingResult, SamplingRules, SamplingTask, StepResult, checked_controls
from d4orm_env.engine.caching import cached_kernel, fingerprint
from d4orm_env.engine.noise import MIRROR
from d4orm_env.engine.sampling import LANES
from d4orm_env.engine.threads import Threads, available_cores
from d4orm_env.engine.tiles import (
    CONTROL,
    DISTANCE2,
    DOCKED,
    GOAL,
    NEAR_OBSTACLE,
    NEAR_ROBOT,
    ONE,
    OPTIONS,
    STATE,
    STRIDE,
    TILE,
    ZERO,
    compiled,
)

SOURCES = fingerprint((dynamics, transition, collision, reward, observation, tiles))

for _function in (
    observation.observe_robot,
    observation.insert_nearest,
    observation._find_nearest_robots,
    observation._find_nearest_obstacles,
    observation._insert_round,
):
    register_jitable(**OPTIONS)(_function)


@compiled
def _load(goal: Any, state: Any, control: Any, docked: Any, first: Any, w: Any) -> None:
    """Put worlds from number ``first`` on into the lanes of a tile."""
    for s in range(min(TILE, state.shape[0] - first)):
        for k in range(state.shape[1]):
            o = k * STRIDE + s
            for i in range(state.shape[2]):
                w[o + (STATE + i) * TILE] = state[first + s, k, i]
            for i in range(control.shape[2]):
                w[o + (CONTROL + i) * TILE] = control[first + s, k, i]
            for axis in range(goal.shape[2]):
                w[o + (GOAL + axis) * TILE] = goal[first + s, k, axis]
            w[o + DOCKED * TILE] = ONE if docked[first + s, k] else ZERO


@compiled
def _store(state: Any, control: Any, docked: Any, first: Any, w: Any) -> None:
    """The reverse of :func:`_load`, for what a step changes."""
    for s in range(min(TILE, state.shape[0] - first)):
        for k in range(state.shape[1]):
            o = k * STRIDE + s
            for i in range(state.shape[2]):
                state[first + s, k, i] = w[o + (STATE + i) * TILE]
            for i in range(control.shape[2]):
                control[first + s, k, i] = w[o + (CONTROL + i) * TILE]
            docked[first + s, k] = w[o + DOCKED * TILE] > ZERO


@compiled
def _judge(arrays: Any, inverse: Any, first: Any, w: Any, collided: Any, violated: Any, rewards: Any) -> None:
    """Flag contacts and margin violations and compute rewards; all outputs ``(B, K)``."""
    num_robots = arrays.radius.shape[0]
    tiles.clear_row(NEAR_ROBOT, num_robots, w)
    tiles.clear_row(NEAR_OBSTACLE, num_robots, w)
    # Whatever is in contact is within the margin too, so the second level adds to the flags of the first.
    for level in range(2):
        extra = ZERO if level == 0 else arrays.margin
        flags = collided if level == 0 else violated
        tiles.mark_pairs(arrays, extra, w)
        for k in range(num_robots):
            tiles.mark_obstacles(arrays, k, extra, w)
        for s in range(min(TILE, collided.shape[0] - first)):
            for k in range(num_robots):
                o = k * STRIDE + s
                flags[first + s, k] = w[o + NEAR_ROBOT * TILE] + w[o + NEAR_OBSTACLE * TILE] > ZERO
    for s in range(min(TILE, collided.shape[0] - first)):
        for k in range(num_robots):
            o = k * STRIDE + s
            distance, near_robot = np.sqrt(w[o + DISTANCE2 * TILE]), w[o + NEAR_ROBOT * TILE]
            near_obstacle = w[o + NEAR_OBSTACLE * TILE]
            rewards[first + s, k] = reward.step_reward(
                distance, inverse[first + s, k], near_robot, near_obstacle, ONE
            )  # fmt: skip


@compiled
def _step_worlds(
    arrays: Any, goal: Any, inverse: Any, state: Any, control: Any, docked: Any, collided: Any, violated: Any,
    rewards: Any, tile_range: Any, w: Any,
) -> None:  # fmt: skip
    num_robots, dimension = arrays.goal.shape
    for index in range(tile_range[0], tile_range[1]):
        first = index * TILE
        _load(goal, state, control, docked, first, w)
        tiles.measure_goal_distance(num_robots, dimension, w)
        for k in range(num_robots):
            tiles.move_robot(arrays, k, w)
        _judge(arrays, inverse, first, w, collided, violated, rewards)
        _store(state, control, docked, first, w)


@cached_kernel(SOURCES, **OPTIONS)
def step_worlds(
    arrays: Any, goal: Any, inverse: Any, state: Any, control: Any, docked: Any, collided: Any, violated: Any,
    rewards: Any, tile_range: Any,
) -> None:  # fmt: skip
    """Step ``B`` worlds of one problem in place; each has its own goals and start distances.

    Args:
        arrays: The problem.
        goal: ``(B, K, d)``.
        inverse: ``(B, K)`` one over the start distances.
        state: ``(B, K, n)``.
        control: ``(B, K, m)``; holds the executed controls afterwards.
        docked: ``(B, K)`` bool.
        collided: ``(B, K)`` bool, output.
        violated: ``(B, K)`` bool, output.
        rewards: ``(B, K)``, output.
        tile_range: First tile of worlds and the one after the last.
    """
    w = np.zeros(arrays.radius.shape[0] * STRIDE, np.float32)
    _step_worlds(arrays, goal, inverse, state, control, docked, collided, violated, rewards, tile_range, w)


@cached_kernel(SOURCES, **OPTIONS)
def roll_out(
    arrays: Any, goal: Any, inverse: Any, controls: Any, states: Any, docked: Any, collided: Any, violated: Any,
    rewards: Any,
) -> None:  # fmt: skip
    """Step a single world through ``controls`` ``(H, 1, K, m)``, keeping every step; time comes first everywhere."""
    w = np.zeros(arrays.radius.shape[0] * STRIDE, np.float32)
    only = np.array([0, 1])
    _load(goal, states[0], controls[0], docked[0], 0, w)
    tiles.measure_goal_distance(arrays.goal.shape[0], arrays.goal.shape[1], w)
    _judge(arrays, inverse, 0, w, collided[0], violated[0], rewards[0])
    for t in range(controls.shape[0]):
        states[t + 1] = states[t]
        docked[t + 1] = docked[t]
        _step_worlds(
            arrays, goal, inverse, states[t + 1], controls[t], docked[t + 1], collided[t + 1], violated[t + 1],
            rewards[t], only, w,
        )  # fmt: skip


@cached_kernel(SOURCES, **OPTIONS)
def judge_worlds(
    arrays: Any, goal: Any, inverse: Any, state: Any, control: Any, docked: Any, collided: Any, violated: Any
) -> None:
    """Contacts and margin violations of ``B`` worlds as they stand; arguments as in :func:`step_worlds`."""
    w = np.zeros(arrays.radius.shape[0] * STRIDE, np.float32)
    rewards = np.empty(collided.shape, np.float32)
    for first in range(0, state.shape[0], TILE):
        _load(goal, state, control, docked, first, w)
        tiles.measure_goal_distance(arrays.goal.shape[0], arrays.goal.shape[1], w)
        _judge(arrays, inverse, first, w, collided, violated, rewards)


@cached_kernel(SOURCES, **OPTIONS)
def observe_worlds(
    arrays: Any, goal: Any, state: Any, control: Any, docked: Any, time_left: Any, low: Any, high: Any,
    num_neighbors: Any, num_obstacles: Any, world_range: Any, out: Any,
) -> None:  # fmt: skip
    """Fill ``out`` ``(B, K, D)`` with what every robot of a range of worlds sees; ``time_left`` is ``(B,)``."""
    num_robots, d = arrays.goal.shape
    position, velocity = np.empty((num_robots, d), np.float32), np.empty((num_robots, d), np.float32)
    heading, arrived = np.empty((num_robots, 2), np.float32), np.empty(num_robots, np.float32)
    nearest_robots = np.empty((num_neighbors, 2), np.float32)
    nearest_obstacles = np.empty((num_obstacles, 1 + d), np.float32)
    w = np.zeros(num_robots * STRIDE, np.float32)
    for b in range(world_range[0], world_range[1]):
        _load(goal[b : b + 1], state[b : b + 1], control[b : b + 1], docked[b : b + 1], 0, w)
        for k in range(num_robots):
            position[k] = state[b, k, :d]
            tiles.read_motion(arrays, k, 0, w, velocity[k], heading[k])
            arrived[k] = ONE if docked[b, k] else ZERO
            if docked[b, k]:
                velocity[k] = ZERO
        for k in range(num_robots):
            observation.observe_robot(
                k, arrays, goal[b], position, velocity, heading, arrived, time_left[b], nearest_robots,
                nearest_obstacles, out[b, k],
            )  # fmt: skip
            for i in range(out.shape[2]):
                out[b, k, i] = min(max(out[b, k, i], low[i]), high[i])


class CpuEngine:
    """The physics on the CPU, compiled with numba. Stateless: all instances are alike."""

    name = "cpu"

    def __init__(self, num_threads: int | None = None) -> None:
        self._threads = Threads(num_threads or available_cores())

    def step(self, arrays: ProblemArrays, states: FloatArray, arrived: BoolArray, controls: FloatArray) -> StepResult:
        """See :meth:`d4orm_env.engine.base.Engine.step`."""
        state, control = np.array(states, np.float32)[None], np.array(controls, np.float32)[None]
        docked = np.array(arrived, bool)[None]
        collided, violated, rewards = np.empty_like(docked), np.empty_like(docked), np.empty(docked.shape, np.float32)
        goal, inverse = _single(arrays)
        step_worlds(
            _typed(arrays), goal, inverse, state, control, docked, collided, violated, rewards, _ONE_WORLD
        )  # fmt: skip
        return StepResult(state[0], control[0], docked[0], collided[0], violated[0], rewards[0])

    def contacts(self, arrays: ProblemArrays, states: FloatArray) -> tuple[BoolArray, BoolArray]:
        """``(collided (K,), margin_violated (K,))`` of a team standing at ``states`` ``(K, n)``."""
        state = np.array(states, np.float32)[None]
        control = np.zeros((1, len(states), 1), np.float32)
        docked = np.zeros((1, len(states)), bool)
        collided, violated = np.empty_like(docked), np.empty_like(docked)
        judge_worlds(_typed(arrays), *_single(arrays), state, control, docked, collided, violated)
        return collided[0], violated[0]

    def observe(
        self,
        arrays: ProblemArrays,
        layout: ObservationLayout,
        states: FloatArray,
        controls: FloatArray,
        arrived: BoolArray,
        time_left: float,
    ) -> FloatArray:
        """What every robot sees.

        Args:
            arrays: The problem.
            layout: Which components there are, and their bounds.
            states: ``(K, n)``.
            controls: ``(K, m)`` executed last.
            arrived: ``(K,)`` bool.
            time_left: Share of the time left, 1 to 0.

        Returns:
            ``(K, D)`` observations inside the layout's bounds.
        """
        out = np.empty((1, len(states), layout.size), np.float32)
        observe_worlds(
            _typed(arrays),
            _single(arrays)[0],
            np.array(states, np.float32)[None],
            np.array(controls, np.float32)[None],
            np.array(arrived, bool)[None],
            np.array([time_left], np.float32),
            layout.low,
            layout.high,
            layout.num_neighbors,
            layout.num_obstacles,
            _ONE_WORLD,
            out,
        )
        return out[0]

    def rollout(self, problem: Problem, controls: FloatArray) -> Trajectory:
        """See :meth:`d4orm_env.engine.base.Engine.rollout`.

        Raises:
            ValueError: If the controls have another shape than ``(H, K, m)`` or are not finite.
        """
        executed = checked_controls(problem, controls).copy()[:, None]
        steps, num_robots = len(executed), problem.num_robots
        states = np.empty((steps + 1, 1, num_robots, problem.state_size), np.float32)
        states[0] = problem.start
        docked = np.zeros((steps + 1, 1, num_robots), bool)
        collided, violated = np.empty_like(docked), np.empty_like(docked)
        rewards = np.empty((steps, 1, num_robots), np.float32)
        arrays = problem.arrays
        roll_out(
            _typed(arrays), *_single(arrays), executed, states, docked, collided, violated, rewards
        )  # fmt: skip
        return Trajectory(
            states=states[:, 0],
            positions=np.ascontiguousarray(states[:, 0, :, : problem.dimension]),
            controls=executed[:, 0],
            rewards=rewards[:, 0],
            arrived=docked[:, 0],
            collided=collided[:, 0],
            margin_violated=violated[:, 0],
        )

    def prepare(self, task: SamplingTask, rules: SamplingRules, noise_scale: FloatArray, num_samples: int) -> None:
        """See :meth:`d4orm_env.engine.base.Engine.prepare`; one compilation serves every problem."""
        del noise_scale, num_samples
        if not sampling.average_noise.signatures:
            self.denoise(task, rules, task.base, np.zeros(1, np.float32), LANES, 0)

    def denoise(
        self,
        task: SamplingTask,
        rules: SamplingRules,
        mean: FloatArray,
        noise_scale: FloatArray,
        num_samples: int,
        seed: int,
    ) -> SamplingResult:
        """See :meth:`d4orm_env.engine.base.Engine.denoise`."""
        run = _Sampling(task, rules, num_samples, seed, self._threads)
        factor = np.ones_like(task.base)
        mean_rewards = np.empty(len(noise_scale), np.float32)
        excluded = 0
        for step, sigma in enumerate(noise_scale):
            rewards = run.score(step, mean, factor * sigma)
            usable = np.isfinite(rewards)
            excluded += int(usable.size - usable.sum())
            mean_rewards[step] = np.where(usable, rewards, 0).sum() / max(usable.sum(), 1)
            weights = rules.weights(np.where(usable, rewards, -np.inf).astype(np.float32), np)
            first, second = run.moments(step, weights, rules.adapt is not None)
            new_mean = mean + factor * sigma * first
            if rules.adapt is not None:
                # The square deviation of the samples from their new mean.
                factor = rules.adapt((factor * sigma) ** 2 * (second - first**2), np).astype(np.float32)
            mean = new_mean
        return SamplingResult(mean, mean_rewards, excluded)


class _Sampling:
    """One denoising run: its arrays and the threads that share its tiles."""

    def __init__(self, task: SamplingTask, rules: SamplingRules, num_samples: int, seed: int, threads: Any) -> None:
        problem = task.problem
        self.task, self.threads = task, threads
        self.arrays = _typed(problem.arrays)
        self.base = np.ascontiguousarray(task.base, np.float32)
        docked = np.zeros(problem.num_robots, bool) if task.arrived is None else task.arrived
        self.docked = np.ascontiguousarray(docked, bool)
        if task.moving is None:
            self.moving = np.zeros((len(self.base), 0, problem.dimension), np.float32)
            self.moving_radius = np.zeros(0, np.float32)
        else:
            self.moving = np.ascontiguousarray(task.moving.positions, np.float32)
            self.moving_radius = np.ascontiguousarray(task.moving.radius, np.float32)
        self.seed = np.array(noise.seed_words(seed), np.uint32)
        self.rewards = np.empty((problem.num_robots, num_samples), np.float32)

    def score(self, step: int, mean: FloatArray, scale: FloatArray) -> FloatArray:
        """Rewards of this step's samples, ``(M,)`` for team credit and ``(K, M)`` for robot credit."""
        num_tiles = -(-self.rewards.shape[1] // TILE)
        offset, scale = self.base + mean, np.ascontiguousarray(scale, np.float32)
        self.threads.over(
            num_tiles,
            lambda part: sampling.score_tiles(
                self.arrays, offset, scale, self.docked, self.task.collisions, self.moving, self.moving_radius,
                self.seed, step, part, self.rewards,
            ),
        )  # fmt: skip
        return self.rewards.mean(axis=0, keepdims=True) if self.task.credit == "team" else self.rewards

    def moments(self, step: int, weights: Any, with_second: bool) -> tuple[FloatArray, FloatArray]:
        """``(H, K, m)`` weighted mean of the noise and, if asked for, of its square."""
        num_steps, num_robots, _ = self.base.shape
        rows = np.asarray(weights, np.float32)
        counters, odd, even, counts = _by_counter(np.repeat(rows, num_robots, axis=0) if len(rows) == 1 else rows)
        first = np.zeros_like(self.base)
        second = np.zeros_like(self.base) if with_second else np.zeros((0, 0, 0), np.float32)
        self.threads.over(
            num_steps,
            lambda part: sampling.average_noise(self.seed, step, counters, odd, even, counts, part, first, second),
        )
        return first, second


def _by_counter(weights: FloatArray) -> tuple[Any, FloatArray, FloatArray, Any]:
    """Weights ``(K, M)`` of samples gathered by the counter of their noise, which a sample shares with its mirror.

    Returns:
        ``(K, .)`` counters, their weights in an odd moment (sample minus mirror) and in an even one (sample plus
        mirror), and ``(K,)`` how many there are. Counters without weight are left out, and the lists are padded to
        whole blocks of lanes.
    """
    num_rows, num_samples = weights.shape
    padded = np.zeros((num_rows, -(-num_samples // TILE) * TILE), np.float32)
    padded[:, :num_samples] = weights
    halves = padded.reshape(num_rows, -1, 2, MIRROR)
    odd = (halves[:, :, 0] - halves[:, :, 1]).reshape(num_rows, -1)
    even = (halves[:, :, 0] + halves[:, :, 1]).reshape(num_rows, -1)
    rows, columns = np.nonzero(even)
    counts = np.bincount(rows, minlength=num_rows)
    width = -(-int(counts.max()) // LANES) * LANES
    place = np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts)
    counters = np.zeros((num_rows, width), np.uint32)
    counters[rows, place] = columns
    compact = np.zeros((2, num_rows, width), np.float32)
    compact[:, rows, place] = odd[rows, columns], even[rows, columns]
    return counters, compact[0], compact[1], counts


_ONE_WORLD = np.array([0, 1])


def _single(arrays: ProblemArrays) -> tuple[FloatArray, FloatArray]:
    """Goals and inverse start distances as of one world."""
    goal, inverse = arrays.goal[None], arrays.inverse_initial_distance[None]
    goal.flags.writeable = inverse.flags.writeable = False
    return goal, inverse


def _typed(arrays: ProblemArrays) -> ProblemArrays:
    """The arrays with replaced goals made read-only like the rest, so that one compilation serves all."""
    goal, inverse = arrays.goal.view(), arrays.inverse_initial_distance.view()
    goal.flags.writeable = inverse.flags.writeable = False
    return arrays._replace(goal=goal, inverse_initial_distance=inverse)
