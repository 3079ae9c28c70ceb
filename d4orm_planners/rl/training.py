"""Training with Stable-Baselines3: stages with a checkpoint after each, from which a killed training goes on.

A stage begins with fresh worlds and a fresh random state, both set by the seed and the stage's number, and otherwise
depends on the checkpoint before it only. A training that was killed and goes on therefore ends as if nothing had
happened.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, Field
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecNormalize

from d4orm_env.core.problem import Problem
from d4orm_env.core.seeds import Stream, derived_seed
from d4orm_env.envs.rewards import TrainingReward
from d4orm_planners.base.settings import Count, Number, PathText, Positive, Whole, one_of
from d4orm_planners.rl.algorithms import ALGORITHMS, Algorithm
from d4orm_planners.rl.checkpoints import Checkpoints
from d4orm_planners.rl.curriculum import Stage, common_batch, make_stages, team_sizes
from d4orm_planners.rl.curve import Evaluation, evaluate_network, write_curve
from d4orm_planners.rl.network import CLIP, EPSILON, Network, load_network
from d4orm_planners.rl.robot_vec_env import RobotVecEnv
from d4orm_planners.rl.sb3_network import network_of, set_network
from d4orm_planners.rl.sb3_sets import leave_as_they_are
from d4orm_planners.rl.task_mixture import Instances, MixedVecEnv, TrainTask, gather_parts, parse_mixture
from d4orm_planners.rl.train_config import VALIDATION_SEED, Many, TrainConfig

__all__ = ["TrainingResult", "TrainingSettings", "train"]

Progress = Callable[[str, int, int], object]
_INSTANCES, _STEPS_PER_INSTANCE = 256, 25_000
"""At most so many of each part are chosen among. All are new in each stage, but where robots look along paths, which
take long to find: there one is new for so many robot-steps."""
Drawn = dict[tuple[int, str, int], dict[int, Problem]]
"""Instances by part, scenario and team size, and by their seeds."""
NETWORKS = ("flat", "sets")
MIXTURE = "mixture"
"""Stands for the scenario of stages that are about several."""


def _as_tuple(value: object) -> object:
    return tuple(value) if isinstance(value, list) else value


@dataclass(frozen=True, kw_only=True)
class TrainingSettings(TrainConfig):
    """Settings of a training.

    Attributes:
        algorithm: ``"ppo"`` or ``"sac"``.
        steps: Robot-steps, rounded up to whole updates.
        num_envs: Robots that act at once; ``None`` is the algorithm's own number.
        curriculum: Whether smaller teams come first.
        stages: Parts of the training, each with a checkpoint and an evaluation at its end.
        start_from: A policy file of the same algorithm, whose network learns on; ``None`` begins with nothing.
        network: ``"flat"``, fully connected from all that is observed; or ``"sets"``, which pools neighbours and
            obstacles, see :mod:`d4orm_planners.rl.set_network`.
        observed_robots: In observations.
        shortest_paths: Whether robots see their goals along their shortest paths, as is wanted among walls, see
            :meth:`~d4orm_planners.rl.features.Features.along`.
        learning_rate: At the beginning; ``None`` is the algorithm's own. It falls linearly to a tenth.
        learner_settings: Further settings of the algorithm, as Stable-Baselines3 calls them, where they are others than
            those of :mod:`d4orm_planners.rl.algorithms`: ``{"gradient_steps": 8}``.
        reward_settings: Weights of the :class:`~d4orm_env.envs.rewards.TrainingReward` to learn from, where they are
            others.
        mixture: Scenarios and team sizes to be trained on all at once, in place of ``scenario`` and ``num_robots``:
            texts as :meth:`~d4orm_planners.rl.task_mixture.TrainTask.parse` takes them, or names of
            :data:`~d4orm_planners.rl.task_mixture.MIXTURES`. Each has as many robots, as nearly as whole worlds allow,
            and as many validation worlds as any other.

    Raises:
        ValueError: If a value makes no sense; the message names it.
    """

    algorithm: Annotated[str, one_of(ALGORITHMS)] = "ppo"
    steps: Annotated[Count, Field(le=10**15)] = 5_000_000
    num_envs: Many | None = None
    curriculum: bool = False
    stages: Annotated[Count, Field(le=1000)] = 50
    start_from: PathText | None = None
    network: Annotated[str, one_of(NETWORKS)] = "flat"
    observed_robots: Annotated[Whole, Field(ge=0, le=1000)] = 4
    shortest_paths: bool = False
    learning_rate: Annotated[Positive, Field(le=1)] | None = None
    learner_settings: Mapping[str, Number] = field(default_factory=dict)
    reward_settings: Mapping[str, Number] = field(default_factory=dict)
    mixture: Annotated[tuple[str, ...], BeforeValidator(_as_tuple)] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        tuned = ALGORITHMS[self.algorithm].checked(self.learner_settings, "learner_settings")
        object.__setattr__(self, "learner_settings", tuned)
        known = TrainingReward.term_names
        for name in self.reward_settings:
            if name not in known:
                raise ValueError(f"reward_settings has {name!r}; the reward takes {', '.join(known)}")
        if not self.mixture:
            return
        for name in ("scenario", "num_robots", "curriculum", "scenario_settings"):
            given = getattr(self, name)
            if given != getattr(TrainingSettings, name, {}):
                raise ValueError(f"{name} is {given!r} beside a mixture, whose parts say all that; leave one out")
        self.tasks  # noqa: B018 - refuses what is none

    @cached_property
    def tasks(self) -> tuple[TrainTask, ...]:
        """The parts of the mixture."""
        return parse_mixture(self.mixture)

    @property
    def reward(self) -> TrainingReward:
        """Reward to learn from."""
        return TrainingReward(**self.reward_settings)

    @property
    def worlds_per_task(self) -> tuple[int, ...]:
        """Number of worlds of each part of the mixture."""
        share = (self.num_envs or ALGORITHMS[self.algorithm].num_envs) / max(len(self.tasks), 1)
        return tuple(max(round(share / task.num_robots), 1) for task in self.tasks)

    @property
    def batch(self) -> int:
        """Robots that act at once."""
        if self.mixture:
            return sum(worlds * part.num_robots for worlds, part in zip(self.worlds_per_task, self.tasks))
        sizes = team_sizes(self.num_robots) if self.curriculum else (self.num_robots,)
        return common_batch(sizes, self.num_envs or ALGORITHMS[self.algorithm].num_envs)

    def parts(self, stage: Stage) -> list[tuple[TrainTask, list[int | None], str | None]]:
        """Return the tasks of a stage, with the observed robots of each of their worlds and the robots' model."""
        if self.mixture:
            return [(*part, self.model) for part in gather_parts(self.tasks, self.worlds_per_task)]
        task = self.task(stage.scenario, stage.num_robots)
        return [(task, [None] * (self.batch // stage.num_robots), self.model_in(stage.scenario))]

    def worlds(
        self, stage: Stage, number: int = 0, done: int = 0, drawn: Drawn | None = None
    ) -> RobotVecEnv | MixedVecEnv:
        """Worlds for a stage.

        Args:
            stage: Stage of the training.
            number: Of the stage.
            done: Robot-steps in the stages before.
            drawn: Instances of earlier stages, from which those that are used again are taken; others are left out,
                and new ones added when they are drawn.
        """
        seed, drawn, parts = derived_seed(self.seed, Stream.TRAINING_WORLDS, number), {} if drawn is None else drawn, []
        for part, (task, max_observed, model) in enumerate(self.parts(stage)):
            count = len(max_observed)
            size = min(_INSTANCES, 2 * count)
            own_steps = done * count * task.num_robots // self.batch
            first = own_steps // _STEPS_PER_INSTANCE if self.shortest_paths else number * size
            seeds = [derived_seed(self.seed, Stream.TRAINING_INSTANCES, part, first + index) for index in range(size)]
            key = part, task.scenario, task.num_robots
            drawn[key] = {own: problem for own, problem in drawn.get(key, {}).items() if own in seeds}
            instances = Instances(partial(task.problem, model=model), seeds, drawn[key])
            own_seed = derived_seed(seed, Stream.TRAINING_WORLDS, part)
            parts.append(task.worlds(max_observed, own_seed, instances, model, **self._options))
        return MixedVecEnv(parts) if self.mixture else parts[0]

    def validation(self, **options: Any) -> RobotVecEnv | MixedVecEnv:
        """Worlds to judge by.

        Raises:
            ValueError: If one policy cannot be learned for the team.
        """
        options = {**self._options, **options}
        if not self.mixture:
            return super().validation(**options)
        count = -(-self.validation_worlds // len(self.tasks))
        return MixedVecEnv([part.validation(count, VALIDATION_SEED, self.model, **options) for part in self.tasks])

    @property
    def _options(self) -> dict[str, Any]:
        """Options of the environments."""
        return {"observed_robots": self.observed_robots, "reward": self.reward, "shortest_paths": self.shortest_paths}


@dataclass(frozen=True)
class TrainingResult:
    """Result of a training.

    Attributes:
        network: The policy with the best validation.
        curve: One evaluation per stage.
        policy_path: Path of the policy.
    """

    network: Network
    curve: tuple[Evaluation, ...]
    policy_path: Path


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
        OSError: If the folder cannot be used.
    """
    run = _TrainingRun(settings, Path(out), progress or (lambda what, done, total: None), command)
    for index in range(len(run.evaluations), len(run.stages)):
        run.learn(index)
    return TrainingResult(run.checkpoints.policy(), tuple(run.evaluations), run.checkpoints.policy_path)


class _TrainingRun:
    """A training under way."""

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
        """A policy that learns on."""
        network, wanted = load_network(path), self._validation.features.frame
        if network.features.frame != wanted:
            raise ValueError(
                f"start_from is {path}, which sees the world from another frame ({network.features.frame}) than is "
                f"trained for ({wanted}); give a policy that was trained for robots of this model"
            )
        if network.header.shortest_paths and not self.settings.shortest_paths:
            raise ValueError(
                f"start_from is {path}, whose robots look along their shortest paths; give --shortest-paths"
            )
        return network

    def learn(self, index: int) -> None:
        """One stage, its evaluation and its checkpoint."""
        begin, stage, settings = time.perf_counter(), self.stages[index], self.settings
        done = sum(earlier.steps for earlier in self.stages[:index])
        self._progress(_describe(stage, self.evaluations), done, self._total)
        robots = settings.worlds(stage, index, done, self._drawn)
        making = time.perf_counter() - begin
        normalized = VecNormalize(robots, clip_obs=CLIP, gamma=self._algorithm.gamma, epsilon=EPSILON)
        if settings.network == "sets":
            leave_as_they_are(normalized)
        model = self._model = self._restored(normalized)
        self._algorithm.prepare(model, robots, self._training_seed(index + 1))
        self._algorithm.set_learning_rate(model, 1 - done / self._total, settings.learning_rate)
        watch = _Watch(lambda steps: self._progress(_describe(stage, self.evaluations), done + steps, self._total))
        model.learn(stage.steps, callback=watch, reset_num_timesteps=False)
        seconds = time.perf_counter() - begin
        before = 0.0 if self._start is None else self._start.training_time or 0.0
        header = self.settings.header(
            self.settings.algorithm, self._validation, command=self._command, stage=index + 1,
            training_time=round(before + seconds + sum(earlier.seconds for earlier in self.evaluations), 1),
        )  # fmt: skip
        network = network_of(header, model, normalized)
        outcome = evaluate_network(network, self._validation, VALIDATION_SEED)
        evaluation = Evaluation(
            done + stage.steps, stage.num_robots, stage.scenario, outcome.success_rate, outcome.travel_time,
            seconds, (making + robots.seconds) / seconds, parts=outcome.parts if settings.mixture else None,
        )  # fmt: skip
        self.evaluations = [*self.evaluations, evaluation]
        self.checkpoints.keep_best(network, self.evaluations)
        # The checkpoint last: what a stage that was broken off has written is written again.
        write_curve(self._out, self.evaluations)
        self._checkpoint = self.checkpoints.save(index, model, normalized, self.evaluations)
        robots.close()

    def _restored(self, env: VecNormalize) -> BaseAlgorithm:
        """The model with the state of the last checkpoint, in a new environment."""
        model, fresh = self._model, self._model is None
        if model is None:
            set_random_seed(self._training_seed(0))
            features = self._validation.features if self.settings.network == "sets" else None
            model = self._algorithm.make(env, features, self.settings.learner_settings)
            model.set_logger(configure(str(self._out / "tensorboard"), ["tensorboard"]))
        else:
            model.set_env(env, force_reset=True)
        if self._checkpoint is not None:
            self._checkpoint.restore(env, model, fresh)
        elif self._start is not None:
            set_network(model, env, self._start)
        return model

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
