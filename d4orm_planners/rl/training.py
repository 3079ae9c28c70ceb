"""Training with Stable-Baselines3: stages with a checkpoint after each, from which a killed training goes on.

A stage begins with fresh worlds and a fresh random state, both set by the seed and the stage's number, and otherwise
depends on the checkpoint before it only. A training that was killed and goes on therefore ends as if nothing had
happened.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.utils import FloatSchedule, set_random_seed
from stable_baselines3.common.vec_env import VecNormalize

from d4orm_env.core.files import checked_path
from d4orm_env.core.seeds import Stream, derived_seed
from d4orm_planners.evaluation.pool import only_writer
from d4orm_planners.rl.algorithms import ALGORITHMS, Algorithm, network_of, set_network
from d4orm_planners.rl.checkpoints import Checkpoints, Evaluation, evaluate_network
from d4orm_planners.rl.network import CLIP, EPSILON, Network, load_network, range_sensors
from d4orm_planners.rl.train_config import MIXTURE, VALIDATION_SEED, Drawn, Stage, TrainingSettings, make_stages

__all__ = ["TrainingResult", "TrainingSettings", "train"]

Progress = Callable[[str, int, int], object]


@dataclass(frozen=True)
class TrainingResult:
    """Result of a training."""

    network: Network  #: The policy with the best validation
    curve: tuple[Evaluation, ...]  #: One evaluation per stage
    policy_path: Path  #: Path of the policy


def train(
    settings: TrainingSettings, out: str | os.PathLike[str], progress: Progress | None = None, command: str = ""
) -> TrainingResult:
    """Train, or go on with a training that was broken off.

    ``out`` then holds ``policy.safetensors``, the policy that did best in validation; ``curve.csv`` and ``curve.png``,
    the evaluations; ``checkpoints/``, the last two, each with ``model.zip``, as Stable-Baselines3 saves it; and
    ``tensorboard/``, logs.

    Args:
        settings: Settings of the training.
        out: Folder to write to, and to go on from.
        progress: Called as ``progress(what, steps done, steps in all)``.
        command: Command of the training, for the policy file.

    Raises:
        ValueError: For settings that make no sense, or other settings than those of the training in ``out``.
        OSError: If the folder cannot be used, or another process trains into it.
    """
    folder = checked_path(out, "the folder of a training")
    run = _TrainingRun(settings, folder, progress or (lambda what, done, total: None), command)
    with only_writer(folder):
        for index in range(len(run.evaluations), len(run.stages)):
            run.learn(index)
    return TrainingResult(run.checkpoints.policy(), tuple(run.evaluations), run.checkpoints.policy_path)


class _TrainingRun:
    def __init__(self, settings: TrainingSettings, out: Path, progress: Progress, command: str) -> None:
        self.settings, self._out, self._progress, self._command = settings, out, progress, command
        self._algorithm: Algorithm = ALGORITHMS[settings.algorithm]
        unit = settings.batch * self._algorithm.steps_per_update
        self.stages = make_stages(
            settings.num_robots, settings.scenario, settings.steps, unit, settings.stages, settings.curriculum
        )
        if settings.mixture:
            largest = max(task.num_robots for task in settings.tasks)
            self.stages = tuple(Stage(largest, MIXTURE, stage.steps) for stage in self.stages)
        self._total = sum(stage.steps for stage in self.stages)
        self._model: BaseAlgorithm | None = None
        self._drawn: Drawn = {}
        # First of all, because it refuses what cannot be learned, and nothing is to be written then.
        self._validation = settings.validation()
        self._start = None if settings.start_from is None else self._first_network(settings.start_from)
        self.checkpoints = Checkpoints(out, asdict(settings))
        self._checkpoint = self.checkpoints.latest()
        self.evaluations: list[Evaluation] = [] if self._checkpoint is None else self._checkpoint.evaluations

    def _first_network(self, path: str) -> Network:
        network, wanted = load_network(path), self._validation.features.frame
        if network.features.frame != wanted:
            raise ValueError(
                f"start_from is {path}, which sees the world from another frame ({network.features.frame}) than is "
                f"trained for ({wanted}); give a policy that was trained for robots of this model"
            )
        mine = range_sensors(self.settings.observed_rays, self.settings.ray_range)
        if network.header.range_sensors != mine:
            raise ValueError(
                f"start_from is {path}, a policy for {network.header.range_sensors}, and {mine} is asked for; give the "
                "same, or another policy"
            )
        if network.header.shortest_paths and not self.settings.shortest_paths:
            raise ValueError(
                f"start_from is {path}, whose robots look along their shortest paths; give --shortest-paths"
            )
        if (theirs := network.features.slices.goal_headings) != self.settings.goal_headings:
            does = ("reads no goal headings", "reads goal headings", "reads goal hitch angles")[min(theirs, 2)]
            raise ValueError(f"start_from is {path}, which {does}; give a policy trained with such goals")
        robots = self.settings.worlds(self.stages[0], 0, 0, {})
        try:  # whether it fits
            normalized = VecNormalize(robots)
            set_network(self._fresh_model(normalized), normalized, network)
        finally:
            robots.close()
        return network

    def learn(self, index: int) -> None:
        begin, stage, settings = time.perf_counter(), self.stages[index], self.settings
        done = sum(earlier.steps for earlier in self.stages[:index])
        self._progress(_describe(stage, self.evaluations), done, self._total)
        robots = settings.worlds(stage, index, done, self._drawn)
        making = time.perf_counter() - begin
        normalized = VecNormalize(robots, clip_obs=CLIP, gamma=self._algorithm.gamma, epsilon=EPSILON)
        if settings.network == "sets":
            _leave_as_they_are(normalized)
        model = self._model = self._restored(normalized)
        self._algorithm.prepare(model, robots, self._training_seed(index + 1))
        first_rate = settings.learning_rate or self._algorithm.learning_rate
        model.lr_schedule = FloatSchedule(first_rate * (0.1 + 0.9 * (1 - done / self._total)))
        watch = _Watch(lambda steps: self._progress(_describe(stage, self.evaluations), done + steps, self._total))
        model.learn(stage.steps, callback=watch, reset_num_timesteps=False)
        seconds = time.perf_counter() - begin
        before = 0.0 if self._start is None else self._start.training_time or 0.0
        header = self.settings.header(
            self.settings.algorithm, self._validation, command=self._command, stage=index + 1,
            training_time=round(before + seconds + sum(earlier.seconds for earlier in self.evaluations), 1),
        )  # fmt: skip
        network = network_of(header, model, normalized)
        success, travel_time, parts = evaluate_network(network, self._validation, VALIDATION_SEED)
        evaluation = Evaluation(
            done + stage.steps, stage.num_robots, stage.scenario, success, travel_time,
            seconds, (making + robots.seconds) / seconds, parts=parts if settings.mixture else None,
        )  # fmt: skip
        self.evaluations = [*self.evaluations, evaluation]
        self._checkpoint = self.checkpoints.conclude(index, model, normalized, network, self.evaluations)
        robots.close()

    def _restored(self, env: VecNormalize) -> BaseAlgorithm:
        """The model with the state of the last checkpoint, in a new environment."""
        model, fresh = self._model, self._model is None
        if model is None:
            model = self._fresh_model(env)
            model.set_logger(configure(str(self._out / "tensorboard"), ["tensorboard"]))
        else:
            model.set_env(env, force_reset=True)
        if self._checkpoint is not None:
            self._checkpoint.restore(env, model, fresh)
        elif self._start is not None:
            set_network(model, env, self._start)
        return model

    def _fresh_model(self, env: VecNormalize) -> BaseAlgorithm:
        set_random_seed(self._training_seed(0))
        features = self._validation.features if self.settings.network == "sets" else None
        return self._algorithm.make(env, features, self.settings.learner_settings)

    def _training_seed(self, number: int) -> int:
        """A seed for the libraries' own random states, which take 32 bits."""
        return derived_seed(self.settings.seed, Stream.TRAINING, number) % 2**32


class _Watch(BaseCallback):
    """Reports progress, and notes how the worlds end."""

    def __init__(self, report: Callable[[int], object]) -> None:
        super().__init__()
        self._report = report

    def _on_training_start(self) -> None:
        self._first = self.num_timesteps

    def _on_step(self) -> bool:
        for _, success, travel_time in self.training_env.get_attr("finished", 0)[0]:
            self.logger.record_mean("worlds/success_rate", float(success))
            self.logger.record_mean("worlds/travel_time", travel_time)
        return True

    def _on_rollout_end(self) -> None:
        self._report(self.num_timesteps - self._first)


def _describe(stage: Stage, evaluations: list[Evaluation]) -> str:
    last = f"; success {evaluations[-1].success_rate:.0%}" if evaluations else ""
    return f"{stage.scenario}, {stage.num_robots} robots{last}"


def _leave_as_they_are(env: VecNormalize) -> None:
    """Have features not normalised: every row of a set must be in the same units, and features are of order one."""
    fixed: Any = _Fixed(shape=env.observation_space.shape or ())
    fixed.var[:] = 1 - EPSILON
    env.obs_rms = fixed


class _Fixed(RunningMeanStd):
    def update(self, arr: Any) -> None:
        """Nothing is learned from what is seen."""
