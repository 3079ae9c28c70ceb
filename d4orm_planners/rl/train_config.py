"""Settings and worlds of trainings of a policy that all robots share: of all, and of reinforcement with its stages."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property, partial
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, Field

from d4orm_env.core.goal_poses import goal_headings
from d4orm_env.core.problem import Problem
from d4orm_env.core.seeds import Stream, derived_seed
from d4orm_env.envs.rewards import TrainingReward
from d4orm_env.scenarios.problems import unknown_argument
from d4orm_planners.base.settings import CheckedSettings, Count, Number, PathText, Positive, Whole, one_of
from d4orm_planners.rl.algorithms import ALGORITHMS
from d4orm_planners.rl.robot_vec_env import RobotVecEnv
from d4orm_planners.rl.task_mixture import Instances, MixedVecEnv, TrainTask, gather_parts, parse_mixture

VALIDATION_SEED = 0  #: Worlds are seeded from here in validation, and in training from numbers of 64 random bits
Many = Annotated[Count, Field(le=100_000)]  #: Robots, worlds or episodes at once: more would fill the memory
Seed = Annotated[Whole, Field(ge=0)]
MOST_OBSERVED = 1000  #: Robots, or rays, in an observation at most
_INSTANCES, _STEPS_PER_INSTANCE = 256, 25_000
"""At most so many of each part are chosen among. All are new in each stage, but where robots look along paths, which
take long to find: there one is new for so many robot-steps."""
Drawn = dict[tuple[int, str, int], dict[int, Problem]]  #: Instances by part, scenario and team size, and seed
NETWORKS = ("flat", "sets")
MIXTURE = "mixture"  #: Stands for the scenario of stages that are about several


@dataclass(frozen=True, kw_only=True)
class TrainConfig(CheckedSettings):
    """Common settings of all trainings."""

    scenario: str = "random"  #: Scenario to learn. Instances of ``random`` are trained on along with any other scenario
    num_robots: Many = 4  #: Size of the full team
    seed: Seed = 0  #: Of everything that is drawn
    model: str | None = None  #: Robot model; ``None`` is the scenario's own
    validation_worlds: Many = 100  #: Episodes per evaluation
    #: Rays of every robot's range sensor, see :class:`~d4orm_env.envs.options.EnvOptions`
    observed_rays: Annotated[Whole, Field(ge=0, le=MOST_OBSERVED)] = 0
    ray_range: Positive = 5.0  #: Range of that [m]
    scenario_settings: Mapping[str, object] = field(default_factory=dict)  #: Arguments of the scenario

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("num_robots", "seed", "model"):
            if name in self.scenario_settings:
                raise ValueError(f"scenario_settings has {name!r}; give it itself, --{name.replace('_', '-')}")
        complaint = unknown_argument(self.scenario, self.scenario_settings)
        if complaint:
            raise ValueError(f"scenario_settings: {complaint}")
        self._example()

    def _example(self) -> Problem:
        return self.task(self.scenario, self.num_robots).problem(0, self.model)

    @property
    def options(self) -> dict[str, Any]:
        """Arguments of environments: here, which range sensors the robots have."""
        return {"observed_rays": self.observed_rays, "ray_range": self.ray_range}

    @cached_property
    def goal_headings(self) -> int:
        """Bodies whose goal headings are observed: if any robot has one, by all, in worlds without any too."""
        return goal_headings(self._example())

    def task(self, scenario: str, num_robots: int) -> TrainTask:
        """The same scenario with a team of that size."""
        return TrainTask(scenario, num_robots, self.scenario_settings if scenario == self.scenario else {})

    def model_in(self, scenario: str) -> str | None:
        """The model of its robots; ``None`` is the scenario's own."""
        return self.model if scenario == self.scenario else self._example().team.models[0]

    def validation(self) -> RobotVecEnv | MixedVecEnv:
        """Worlds to judge by. Raises ValueError if one policy cannot be learned for the team."""
        task = self.task(self.scenario, self.num_robots)
        options = {**self.options, "goal_headings": self.goal_headings}
        return task.validation(self.validation_worlds, VALIDATION_SEED, self.model, **options)

    def header(self, algorithm: str, worlds: RobotVecEnv | MixedVecEnv, **training: object) -> dict[str, object]:
        """Return the header of a policy file: what a model does not tell."""
        slices, frame = worlds.features.slices, worlds.features.frame
        return {
            "algorithm": algorithm,
            "model": worlds.problem.team.models[0],
            "dimension": slices.dimension,
            "num_neighbors": slices.num_neighbors,
            "num_obstacles": slices.num_obstacles,
            "num_rays": slices.num_rays or None,
            "ray_range": self.ray_range if slices.num_rays else None,
            "goal_headings": True if slices.goal_headings == 1 else slices.goal_headings or None,
            "frame": None if frame == "goal" else frame,
            "shortest_paths": worlds.shortest_paths or None,
            "brakes": bool(np.isfinite(worlds.problem.goal_speed).any()) or None,
            "training": {**training, **asdict(self)},
        }


@dataclass(frozen=True)
class Stage:
    """One part of a training, at whose end there is a checkpoint."""

    num_robots: int
    scenario: str
    steps: int


def team_sizes(num_robots: int) -> tuple[int, ...]:
    """1, 2, 4, ... below ``num_robots``, and ``num_robots``."""
    return (*(2**i for i in range((num_robots - 1).bit_length())), num_robots)


def common_batch(sizes: tuple[int, ...], wanted: int) -> int:
    """The most robots up to ``wanted`` that make whole worlds of every size; at least one world of each."""
    unit = math.lcm(*sizes)
    return max(wanted // unit, 1) * unit


def make_stages(num_robots: int, scenario: str, steps: int, unit: int, count: int, gradual: bool) -> tuple[Stage, ...]:
    """At most ``count`` stages of a training of ``steps`` robot-steps, rounded up to whole updates of ``unit``.

    Where it is gradual, teams grow, and every size gets as many steps of whole worlds as any other. Instances are
    random ones; where another scenario is asked for, every other stage of the full team is about that.
    """
    units = math.ceil(steps / unit)
    count = min(count, units)
    sizes = team_sizes(num_robots) if gradual else (num_robots,)
    turns = np.cumsum(sizes) / sum(sizes)
    stages = []
    for index in range(count):
        size = sizes[int(np.searchsorted(turns, (index + 0.5) / count))]
        name = scenario if size == num_robots and index % 2 == 0 else "random"
        length = units * (index + 1) // count - units * index // count
        stages.append(Stage(size, name, length * unit))
    return tuple(stages)


@dataclass(frozen=True, kw_only=True)
class TrainingSettings(TrainConfig):
    """Settings of a training."""

    algorithm: Annotated[str, one_of(ALGORITHMS)] = "ppo"  #: ``"ppo"`` or ``"sac"``
    steps: Annotated[Count, Field(le=10**15)] = 5_000_000  #: Robot-steps, rounded up to whole updates
    num_envs: Many | None = None  #: Robots that act at once; ``None`` is the algorithm's own number
    curriculum: bool = False  #: Whether smaller teams come first
    stages: Annotated[Count, Field(le=1000)] = 50  #: Parts of the training; a checkpoint and an evaluation ends each
    start_from: PathText | None = None  #: Policy file of the same algorithm that learns on; ``None`` begins anew
    #: ``"flat"``, fully connected from all that is observed; or ``"sets"``, which pools neighbours and obstacles, see
    #: :mod:`d4orm_planners.rl.network`
    network: Annotated[str, one_of(NETWORKS)] = "flat"
    observed_robots: Annotated[Whole, Field(ge=0, le=MOST_OBSERVED)] = 4  #: In observations
    #: Whether robots see their goals along their shortest paths, as is wanted among walls, see
    #: :meth:`~d4orm_env.envs.features.Features.along`
    shortest_paths: bool = False
    #: At the beginning; ``None`` is the algorithm's own. It falls linearly to a tenth
    learning_rate: Annotated[Positive, Field(le=1)] | None = None
    #: Further settings of the algorithm, as Stable-Baselines3 calls them, where they are others than those of
    #: :mod:`d4orm_planners.rl.algorithms`: ``{"gradient_steps": 8}``
    learner_settings: Mapping[str, Number] = field(default_factory=dict)
    #: Weights of the :class:`~d4orm_env.envs.rewards.TrainingReward` to learn from, where they are others
    reward_settings: Mapping[str, Number] = field(default_factory=dict)
    #: Scenarios and team sizes to be trained on all at once, in place of ``scenario`` and ``num_robots``: texts as
    #: :meth:`~d4orm_planners.rl.task_mixture.TrainTask.parse` takes them, or names of
    #: :data:`~d4orm_planners.rl.task_mixture.MIXTURES`. Each has as many robots, as nearly as whole worlds allow, and
    #: as many validation worlds as any other
    mixture: Annotated[
        tuple[str, ...], BeforeValidator(lambda value: tuple(value) if isinstance(value, list) else value)
    ] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        tuned = ALGORITHMS[self.algorithm].checked(self.learner_settings)
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
        return parse_mixture(self.mixture)

    @cached_property
    def goal_headings(self) -> int:
        if not self.mixture:
            return super().goal_headings
        return max(goal_headings(task.problem(0, self.model)) for task in self.tasks)

    @property
    def reward(self) -> TrainingReward:
        return TrainingReward(**self.reward_settings)

    @property
    def worlds_per_task(self) -> tuple[int, ...]:
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
        """Worlds for the stage with this number, after so many robot-steps ``done``.

        Instances of earlier stages that are used again are taken from ``drawn``; others are left out, new ones added.
        """
        seed, drawn, parts = derived_seed(self.seed, Stream.TRAINING_WORLDS, number), {} if drawn is None else drawn, []
        options = {**self.options, "goal_headings": self.goal_headings}
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
            parts.append(task.worlds(max_observed, own_seed, instances, model, **options))
        return MixedVecEnv(parts) if self.mixture else parts[0]

    def validation(self) -> RobotVecEnv | MixedVecEnv:
        if not self.mixture:
            return super().validation()
        count = -(-self.validation_worlds // len(self.tasks))
        options = {**self.options, "goal_headings": self.goal_headings}
        return MixedVecEnv([part.validation(count, VALIDATION_SEED, self.model, **options) for part in self.tasks])

    @property
    def options(self) -> dict[str, Any]:
        """Arguments of environments: what robots observe, and what they are rewarded for."""
        own = {"observed_robots": self.observed_robots, "shortest_paths": self.shortest_paths}
        return {**super().options, **own, "reward": self.reward}
