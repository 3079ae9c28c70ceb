"""Imitation: behaviour cloning of an expert, then DAgger, into the network that PPO learns and goes on from.

A round collects episodes, learns from all that there are so far, and ends with an evaluation and a checkpoint. In the
first the expert drives, or a dataset of it stands for that; in the others the learner drives and the expert says at
every step what it would do there (S. Ross, G. Gordon, D. Bagnell: A Reduction of Imitation Learning and Structured
Prediction to No-Regret Online Learning, AISTATS 2011; here the expert drives in the first round only). An episode is on
disk as soon as it ends, and a round depends on those and on the checkpoint before it only: a killed training goes on.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any

import numpy as np
import torch
from pettingzoo import ParallelEnv
from pydantic import Field
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecNormalize

from d4orm_env import navigation_v0
from d4orm_env.core.arrays import FloatArray, as_float32
from d4orm_env.core.files import checked_path
from d4orm_env.core.seeds import Stream, derived_seed, generator
from d4orm_planners.base.planner_registry import make_policy, setting_names
from d4orm_planners.base.policy import Policy, robot_indices
from d4orm_planners.base.settings import Count, PathText
from d4orm_planners.evaluation.pool import only_writer
from d4orm_planners.rl.algorithms import ALGORITHMS, network_of
from d4orm_planners.rl.checkpoints import Checkpoints, Evaluation, evaluate_network
from d4orm_planners.rl.dataset.minari_files import Samples, dataset_samples
from d4orm_planners.rl.network import CLIP, EPSILON, Network
from d4orm_planners.rl.task_mixture import Instances
from d4orm_planners.rl.train_config import VALIDATION_SEED, Many, TrainConfig
from d4orm_planners.rl.training import Progress, TrainingResult

__all__ = ["ImitationSettings", "imitate"]

Driver = Callable[[FloatArray, FloatArray], FloatArray]
LEARNER = "ppo"  #: Algorithm whose network learns, and whose policy it is then
HELD_OUT = 10  #: One in so many episodes is not learned from but tells the imitation error

OTHERS_DRIVE: Mapping[str, object] = MappingProxyType(
    {"delay": 0, "filter_states": False, "learn_limits": False, "stalls": False, "reaction_time": 0.0, "refine": "sync"}
)
"""Settings of an expert that has them: it is asked while another drives, and must not conclude from what robots do that
they are late, weak, noisy or stalled."""

BATCH = 128
LEARNING_RATE = 1e-3  #: At the beginning of a round; it falls linearly to nothing


@dataclass(frozen=True, kw_only=True)
class ImitationSettings(TrainConfig):
    """Settings of imitation: the expert, and how long.

    Raises:
        TypeError: For a setting that the expert does not have.
    """

    #: A planner or policy by name or import path. A planner's plan is executed open loop, which tells nothing of what
    #: to do elsewhere: with one, leave it at one round
    expert: str = "d4orm-c2f"
    expert_settings: Mapping[str, object] = field(default_factory=dict)  #: Its settings, over :data:`OTHERS_DRIVE`
    #: Folder or name of a dataset of ``d4orm dataset`` that stands for the first round's episodes; ``None`` has them
    #: recorded
    dataset: PathText | None = None
    #: To record in each round. Every other one is of ``random`` where another scenario is to be learned
    episodes: Annotated[Many, Field(ge=2)] = 100
    rounds: Annotated[Count, Field(le=1000)] = 5  #: The first clones the expert, the others are DAgger's
    epochs: Annotated[Count, Field(le=100_000)] = 20  #: Of each round

    def __post_init__(self) -> None:
        super().__post_init__()
        make_policy(self.expert, **self.expert_settings)

    @property
    def all_expert_settings(self) -> dict[str, object]:
        """All settings of the expert."""
        own = {name: value for name, value in OTHERS_DRIVE.items() if name in setting_names(self.expert)}
        return own | dict(self.expert_settings)


def imitate(
    settings: ImitationSettings, out: str | os.PathLike[str], progress: Progress | None = None, command: str = ""
) -> TrainingResult:
    """Learn from an expert, or go on with what was broken off.

    ``out`` then holds ``policy.safetensors``, the policy that did best in validation, which is one of ``"ppo"``;
    ``curve.csv`` and ``curve.png``, the evaluations; ``checkpoints/``, the last two; and ``episodes/``, all that was
    recorded.

    Args:
        settings: Settings of the imitation.
        out: Folder to write to, and to go on from.
        progress: Called as ``progress(what, episodes and epochs done, in all)``.
        command: Command of the training, for the policy file.

    Raises:
        ValueError: For settings that make no sense, or other settings than those of the training in ``out``.
        OSError: If the folder cannot be used, or another process trains into it.
    """
    folder = checked_path(out, "the folder of a training")
    run = _ImitationRun(settings, folder, progress or (lambda what, done, total: None), command)
    with only_writer(folder):
        for index in range(len(run.evaluations), settings.rounds):
            run.learn(index)
    return TrainingResult(run.checkpoints.policy(), tuple(run.evaluations), run.checkpoints.policy_path)


class _ImitationRun:
    def __init__(self, settings: ImitationSettings, out: Path, progress: Progress, command: str) -> None:
        self.settings, self._progress, self._command = settings, progress, command
        # First of all, because it refuses what cannot be learned, and nothing is to be written then.
        self._validation = settings.validation()
        self._given = self._from_dataset()
        self.checkpoints = Checkpoints(out, asdict(settings))
        self._episodes = out / "episodes"
        self._episodes.mkdir(exist_ok=True)
        self._env = VecNormalize(self._validation, clip_obs=CLIP, epsilon=EPSILON)
        set_random_seed(derived_seed(settings.seed, Stream.TRAINING, 0) % 2**32)
        self._model = ALGORITHMS[LEARNER].make(self._env, None, {})
        checkpoint = self.checkpoints.latest()
        self.evaluations: list[Evaluation] = [] if checkpoint is None else checkpoint.evaluations
        if checkpoint is not None:
            checkpoint.restore(self._env, self._model, fresh=True)

    def learn(self, index: int) -> None:
        begin, settings = time.perf_counter(), self.settings
        each, drivers = settings.episodes + settings.epochs, ("cloning", "DAgger")
        success = f"; success {self.evaluations[-1].success_rate:.0%}" if self.evaluations else ""
        what = f"{drivers[min(index, 1)]}, round {index + 1} of {settings.rounds}{success}"

        def report(done: int) -> None:
            self._progress(what, index * each + done, settings.rounds * each)

        for episode in range(settings.episodes if index or self._given is None else 0):
            report(episode)
            self._record(index, episode)
        recorded = time.perf_counter() - begin
        known, held = self._samples(index)
        if not index:
            seen: Any = self._env.obs_rms
            seen.mean, seen.var = (of(known[0], axis=0, dtype=np.float64) for of in (np.mean, np.var))
            seen.count = float(len(known[0]))
        random = generator(settings.seed, Stream.TRAINING, index + 1)
        clone(
            self._model, self._env, *known, epochs=settings.epochs, random=random,
            report=lambda epoch: report(settings.episodes + epoch),
        )  # fmt: skip
        self._conclude(index, len(known[0]), held, time.perf_counter() - begin, recorded)

    def _conclude(
        self, index: int, steps: int, held: tuple[FloatArray, FloatArray], seconds: float, recorded: float
    ) -> None:
        network, (inputs, targets) = self._network(index, seconds), held
        error = float(np.sqrt(np.mean((network(inputs) - targets) ** 2)))
        success, travel_time, _ = evaluate_network(network, self._validation, VALIDATION_SEED)
        evaluation = Evaluation(
            steps, self.settings.num_robots, self.settings.scenario, success, travel_time,
            seconds, recorded / seconds, error,
        )  # fmt: skip
        self.evaluations = [*self.evaluations, evaluation]
        self.checkpoints.conclude(index, self._model, self._env, network, self.evaluations)

    def _network(self, index: int, seconds: float = 0.0) -> Network:
        """Return the network as it is now, the last ``seconds`` in this round."""
        spent = round(seconds + sum(earlier.seconds for earlier in self.evaluations), 1)
        details = {"command": self._command, "round": index + 1, "training_time": spent}
        return network_of(self.settings.header(LEARNER, self._validation, **details), self._model, self._env)

    def _path(self, index: int, episode: int) -> Path:
        return self._episodes / f"{index:03d}-{episode:06d}.npz"

    def _record(self, index: int, episode: int) -> None:
        """Record an episode of a round, unless it is there."""
        settings, path = self.settings, self._path(index, episode)
        if path.exists():
            return
        scenario = "random" if episode % 2 else settings.scenario
        task = settings.task(scenario, settings.num_robots)
        instances = Instances(partial(task.problem, model=settings.model_in(scenario)), None, {})
        env = navigation_v0.parallel_env(instances, settings.num_robots, **settings.options)
        expert = make_policy(settings.expert, **settings.all_expert_settings)
        seed = derived_seed(settings.seed, Stream.DEMONSTRATIONS, index, episode)
        learner, turns = self._network(index).controls if index else None, settings.goal_headings
        record_samples(env, expert, seed, learner, goal_headings=turns).save(path)
        env.close()

    def _samples(self, last: int) -> tuple[tuple[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]:
        """Inputs and targets of all rounds so far: those to learn from, and those held out."""
        recorded = self.settings.episodes
        episodes = [*(self._given or ())]
        for index in range(0 if self._given is None else 1, last + 1):
            episodes += [Samples.load(self._path(index, episode)) for episode in range(recorded)]
        held = episodes[::HELD_OUT]
        learned = [samples for number, samples in enumerate(episodes) if number % HELD_OUT]
        features = self._validation.features
        return Samples.joined(learned).learnable(features), Samples.joined(held).learnable(features)

    def _from_dataset(self) -> list[Samples] | None:
        path = self.settings.dataset
        if path is None:
            return None
        worlds = self._validation
        episodes = dataset_samples(path, worlds.problem.team.models[0], worlds.features.slices.size)
        if len(episodes) < 2:
            raise ValueError(f"dataset {path!r} has {len(episodes)} episodes; at least 2 are needed")
        return episodes


def record_samples(
    env: ParallelEnv, expert: Policy, seed: int, learner: Driver | None = None, *, goal_headings: int = 0
) -> Samples:
    """Observations of a team of one model until its robots arrived, and what the expert said they should do.

    The expert drives, or a ``learner``, ``(observations (N, D), limits (N, m)) -> controls (N, m)``: then it is asked
    where that has led the team. The samples and the learner have ``goal_headings`` of so many bodies, zeros where there
    are none.
    """
    observations, _ = env.reset(seed=seed)
    expert.reset(env, seed=seed)
    limits, parts = env.unwrapped.problem.team.control_limits, []
    while env.agents:
        acting = {agent: observations[agent] for agent in env.agents}
        seen = env.unwrapped.layout.with_goal_headings(np.stack(list(acting.values())), goal_headings)
        asked = expert.act(acting, env.state())
        own = limits[robot_indices(acting)]
        controls = as_float32([asked[agent] for agent in acting])
        parts.append(Samples(seen, controls, own))
        driven = controls if learner is None else learner(seen, own)
        observations, *_ = env.step(dict(zip(acting, driven, strict=True)))
    return Samples.joined(parts)


def clone(
    model: Any,
    env: VecNormalize,
    inputs: FloatArray,
    targets: FloatArray,
    *,
    epochs: int,
    random: np.random.Generator,
    report: Callable[[int], object],
) -> None:
    """Have the mean of a PPO model's actions follow an expert's, by Adam on the mean squared difference.

    ``inputs`` ``(N, F)`` are features, ``targets`` ``(N, m)`` the expert's actions in ``[-1, 1]``; ``report`` is called
    with the number of epochs done.
    """
    policy = model.policy
    seen, wanted = torch.as_tensor(env.normalize_obs(inputs)), torch.as_tensor(targets)
    policy.set_training_mode(True)
    batches = max(len(inputs) // BATCH, 1)
    for epoch in range(epochs):
        report(epoch)
        for number, part in enumerate(np.array_split(random.permutation(len(inputs)), batches)):
            left = 1 - (epoch + number / batches) / epochs
            for group in policy.optimizer.param_groups:
                group["lr"] = LEARNING_RATE * left
            loss = torch.nn.functional.mse_loss(policy.get_distribution(seen[part]).distribution.mean, wanted[part])
            policy.optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            policy.optimizer.step()
    report(epochs)
