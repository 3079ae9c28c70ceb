"""The CPU engine's sampling: denoising runs compiled with numba for all cores of one processor."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.bodies import Body, FootprintArrays, as_arrays
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.engine import noise
from d4orm_env.engine.cpu import CpuEngine, typed
from d4orm_env.engine.noise import DRAWS, TURNS
from d4orm_env.engine.sample_noise import Drawing
from d4orm_env.engine.simd import BLOCK, TILE
from d4orm_env.engine.threads import Threads
from d4orm_env.footprints import Disc
from d4orm_planners.engine import score, weighting
from d4orm_planners.engine.proximity import Bodies
from d4orm_planners.engine.sampling_types import (
    WATCHED_SAMPLES,
    DenoisingStep,
    MovingObstacles,
    SamplingResult,
    SamplingRules,
    SamplingTask,
    StepWatcher,
)

WORTH_A_THREAD = 2**16  #: Samples' steps of a robot; fewer are scored before another thread has woken up


class CpuSamplingEngine(CpuEngine):
    """The CPU engine that samples as well. Stateless: all instances are alike."""

    def prepare(self, task: SamplingTask, rules: SamplingRules, noise_scale: FloatArray, num_samples: int) -> None:
        """See :meth:`SamplingEngine.prepare`; one compilation serves all teams of the same models."""
        del noise_scale, num_samples
        if not (score.score_kernel(task.problem.team.models).signatures and weighting.average_noise.signatures):
            self.denoise(task, rules, task.base, np.ones(1, np.float32), TILE, 0)

    def denoise(
        self,
        task: SamplingTask,
        rules: SamplingRules,
        mean: FloatArray,
        noise_scale: FloatArray,
        num_samples: int,
        seed: int,
        should_stop: Callable[[], bool] | None = None,
        watcher: StepWatcher | None = None,
    ) -> SamplingResult:
        run = Sampling(task, num_samples, seed, self._threads)
        factor, units = task.first_factor, task.problem.team.control_units
        mean_rewards = np.empty(len(noise_scale), np.float32)
        done = excluded = 0
        for step, sigma in enumerate(noise_scale):
            if should_stop is not None and should_stop():
                break
            done = step + 1
            scale = factor * sigma * units
            rewards = run.score(step, mean, scale)
            mean_rewards[step] = rewards.mean()
            if not np.isfinite(mean_rewards[step]):
                usable = np.isfinite(rewards)
                excluded += int(usable.size - usable.sum())
                mean_rewards[step] = np.where(usable, rewards, 0).sum() / max(usable.sum(), 1)
                rewards = np.where(usable, rewards, np.float32(-np.inf))
            extra = (rules.importance * run.log_ratio(mean, scale),) if rules.importance else ()
            weights = rules.weights(rewards, np, *extra)
            first, second = run.moments(weights, rules.adapt is not None)
            samples = None if watcher is None else mean + scale * run.first_noise(WATCHED_SAMPLES)
            mean = mean + scale * first
            if watcher is not None and samples is not None:
                kept = np.squeeze(np.array(weights[:, : len(samples)], np.float32), 0 if len(weights) == 1 else ())
                watcher(DenoisingStep(task, float(sigma), mean, samples, kept))
            if rules.adapt is not None:
                # The square deviation of the samples from their new mean.
                factor = rules.adapt((factor * sigma) ** 2 * (second - first**2), np).astype(np.float32)
        return SamplingResult(mean, mean_rewards[:done], excluded, factor)


def _discs(radius: FloatArray) -> FootprintArrays:
    return as_arrays([Body(number, Disc(size), None, 0.0) for number, size in enumerate(radius.tolist())])


def bound_boxes(arrays: ProblemArrays) -> FloatArray:
    """``(S, d, 2)`` ends of the boxes round what lies beyond each of the bounds, widened by half of the margin."""
    dimension = arrays.goal.shape[1]
    low, high = np.full((2, 0, dimension), np.float32(0))
    for side, axis in np.argwhere(np.isfinite(arrays.bounds)):
        beyond = np.full((2, 1, dimension), np.float32(np.inf))
        beyond[0] = -np.float32(np.inf)
        beyond[1 - side, 0, axis] = arrays.bounds[side, axis]
        low, high = np.concatenate([low, beyond[0]]), np.concatenate([high, beyond[1]])
    return _widened(low, high, arrays.margin)


def make_bodies(moving: MovingObstacles, margin: np.float32) -> Bodies:
    # Copies, for which one compilation serves: read-only arrays are of another type.
    positions, radius = (np.array(values, np.float32, order="C") for values in (moving.positions, moving.radius))
    num_steps, num_blocks = len(positions), -(-len(positions) // BLOCK)
    # A last block that is short goes on with its last position.
    blocks = positions[np.minimum(np.arange(num_blocks * BLOCK), num_steps - 1)]
    blocks = blocks.reshape(num_blocks, BLOCK, *positions.shape[1:])
    boxes = _widened(blocks.min(axis=1) - radius[:, None], blocks.max(axis=1) + radius[:, None], margin)
    headings = np.zeros((num_steps, 0)) if moving.headings is None else moving.headings
    return Bodies(positions, radius, boxes, moving.footprints, np.array(headings, np.float32, order="C"))


def _widened(low: FloatArray, high: FloatArray, margin: np.float32) -> FloatArray:
    widening = np.float32(0.5) * margin
    return np.ascontiguousarray(np.stack([low - widening, high + widening], axis=-1), np.float32)


class Sampling:
    """One denoising run: its arrays and the threads that share its tiles."""

    def __init__(self, task: SamplingTask, num_samples: int, seed: int, threads: Threads) -> None:
        problem = task.problem
        worth = task.base.shape[0] * problem.num_robots * num_samples // WORTH_A_THREAD
        self.task, self.threads = task, Threads(min(threads.num_threads, max(worth, 1)))
        nobody = np.zeros((task.base.shape[0], 0, problem.dimension), np.float32), np.zeros(0, np.float32)
        self.arrays, moving = typed(task.arrays), task.moving or MovingObstacles(*nobody)
        self.kernel = score.score_kernel(problem.team.models)
        self.spaces: dict[int, score.Workspace] = {}
        self.base = np.ascontiguousarray(task.base, np.float32)
        arrived = np.zeros(problem.num_robots, bool) if task.arrived is None else task.arrived
        if self.arrays.footprints is not None or moving.footprints is not None:
            # A disc among others that are none has a footprint too.
            self.arrays = self.arrays._replace(footprints=problem.team.all_footprint_arrays)
            moving = moving._replace(footprints=moving.footprints or _discs(moving.radius))
        self.scoring = score.Scoring(
            arrived=np.ascontiguousarray(arrived, bool),
            collisions=task.collisions,
            bodies=make_bodies(moving, self.arrays.margin),
            bounds=bound_boxes(self.arrays),
            penalties=task.penalties,
            per_pair=task.penalty_per_pair,
        )
        footprints = self.arrays.footprints
        self.num_bodies = 0 if footprints is None else len(footprints.heading)
        self.seed = np.array(noise.seed_words(seed), np.uint32)
        self.rewards = np.empty((problem.num_robots, num_samples), np.float32)
        num_tiles, pairs = -(-num_samples // TILE), (problem.control_size + 1) // 2
        self.kept = np.empty((num_tiles, problem.num_robots, len(self.base), pairs, 2, DRAWS), np.float32)

    def space(self, first: int) -> score.Workspace:
        """The workspace of the thread whose tiles begin with this number."""
        if first not in self.spaces:
            self.spaces[first] = score.make_workspace(self.base.shape, self.arrays.goal.shape[1], self.num_bodies)
        return self.spaces[first]

    def score(self, step: int, mean: FloatArray, scale: FloatArray) -> FloatArray:
        """Rewards of this step's samples, ``(M,)`` for team credit and ``(K, M)`` for robot credit."""
        num_tiles = -(-self.rewards.shape[1] // TILE)
        scale = np.ascontiguousarray(scale, np.float32)
        drawing = Drawing(self.base + mean, scale, self.seed, step)
        self.threads.over(
            num_tiles,
            lambda part: self.kernel(
                self.arrays, self.scoring, drawing, part, self.space(part[0]), self.kept, self.rewards
            ),
        )
        return self.rewards.mean(axis=0, keepdims=True) if self.task.credit == "team" else self.rewards

    def log_ratio(self, mean: FloatArray, scale: FloatArray) -> FloatArray:
        """The last samples' :attr:`SamplingRules.importance` terms, ``(1, M)`` or ``(K, M)`` like their rewards."""
        num_steps, num_robots, pairs = (*self.base.shape[:2], self.kept.shape[3])
        centre: FloatArray = np.zeros((num_steps, num_robots, 2 * pairs), np.float32)
        centre[:, :, : mean.shape[2]] = (self.base + mean) / scale
        centre = centre.reshape(num_steps, num_robots, pairs, 2)
        along, across = np.empty((2, num_robots, len(self.kept), DRAWS), np.float32)
        weighting.project_noise(self.kept, centre, along, across)
        turns = np.stack([along, -along, across, -across], axis=2)
        samples = turns.reshape(num_robots, -1)[:, : self.rewards.shape[1]]
        return -(samples.sum(axis=0, keepdims=True) if self.task.credit == "team" else samples)

    def first_noise(self, count: int) -> FloatArray:
        """``(S, H, K, m)`` noise of the first samples of the last step, ``count`` at most: those not turned."""
        count = min(count, self.rewards.shape[1], DRAWS)
        draws = np.moveaxis(self.kept[0, ..., :count], -1, 0)
        pairs = draws.reshape(count, *draws.shape[1:3], -1)[..., : self.base.shape[2]]
        return np.ascontiguousarray(pairs.swapaxes(1, 2))

    def moments(self, weights: FloatArray, with_second: bool) -> tuple[FloatArray, FloatArray]:
        """``(H, K, m)`` weighted mean of the noise and, if asked for, of its square."""
        num_steps = len(self.base)
        odd, even = _by_counter(np.asarray(weights, np.float32))
        first = np.empty_like(self.base)
        second = np.empty_like(self.base) if with_second else np.empty((0, 0, 0), np.float32)
        self.threads.over(num_steps, lambda part: weighting.average_noise(self.kept, odd, even, part, first, second))
        return first, second


def _by_counter(weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Weights ``(K, M)`` or ``(1, M)`` of samples gathered by the counter of their noise (see :func:`noise.turned`).

    ``(2, K, .)`` in an odd moment, summed over a counter's samples with the cosine and the sine of their turn, and
    ``(2, K, .)`` in an even one, with their squares.
    """
    num_rows, num_samples = weights.shape
    if num_samples % TILE:
        weights = np.pad(weights, ((0, 0), (0, -num_samples % TILE)))
    # One row for each turn: by 0, 180, 90 and 270 degrees.
    turns = np.ascontiguousarray(weights.reshape(num_rows, -1, TURNS, DRAWS).transpose(2, 0, 1, 3))
    turns = turns.reshape(TURNS, num_rows, -1)
    return turns[0::2] - turns[1::2], turns[0::2] + turns[1::2]
