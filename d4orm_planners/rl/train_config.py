"""Common settings and worlds of all trainings of a policy that all robots share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from d4orm_env.core.problem import Problem
from d4orm_env.scenarios.problems import unknown_argument
from d4orm_planners.base.settings import CheckedSettings, Count, Whole
from d4orm_planners.rl.robot_vec_env import RobotVecEnv
from d4orm_planners.rl.task_mixture import MixedVecEnv, TrainTask

VALIDATION_SEED = 0
"""Worlds are seeded one by one from here in validation, and in training from numbers of 64 random bits."""

Many = Annotated[Count, Field(le=100_000)]
"""Robots, worlds or episodes at once: beyond, their observations would fill the memory."""
Seed = Annotated[Whole, Field(ge=0)]


@dataclass(frozen=True, kw_only=True)
class TrainConfig(CheckedSettings):
    """Common settings of all trainings.

    Attributes:
        scenario: Scenario to learn. Instances of ``random`` are trained on along with any other scenario.
        num_robots: Size of the full team.
        seed: Of everything that is drawn.
        model: Robot model; ``None`` is the scenario's own.
        validation_worlds: Episodes per evaluation.
        scenario_settings: Arguments of the scenario.

    Raises:
        ValueError: If a value makes no sense; the message names it.
    """

    scenario: str = "random"
    num_robots: Many = 4
    seed: Seed = 0
    model: str | None = None
    validation_worlds: Many = 100
    scenario_settings: Mapping[str, object] = field(default_factory=dict)

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
        """An instance of the scenario."""
        return self.task(self.scenario, self.num_robots).problem(0, self.model)

    def arguments(self, scenario: str) -> dict[str, Any]:
        """Arguments of environments of the scenario to be learned, or of ``random`` with robots like its own, but for
        their number.
        """
        settings = self.task(scenario, self.num_robots).settings
        return {"scenario": scenario, "model": self.model_in(scenario), **settings}

    def task(self, scenario: str, num_robots: int) -> TrainTask:
        """The same scenario with a team of that size."""
        return TrainTask(scenario, num_robots, self.scenario_settings if scenario == self.scenario else {})

    def model_in(self, scenario: str) -> str | None:
        """The model of its robots; ``None`` is the scenario's own."""
        return self.model if scenario == self.scenario else self._example().team.models[0]

    def validation(self, **options: Any) -> RobotVecEnv | MixedVecEnv:
        """Worlds to judge by.

        Args:
            **options: Further arguments of the environments.

        Raises:
            ValueError: If one policy cannot be learned for the team.
        """
        task = self.task(self.scenario, self.num_robots)
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
            "frame": None if frame == "goal" else frame,
            "shortest_paths": worlds.shortest_paths or None,
            "brakes": bool(np.isfinite(worlds.problem.goal_speed).any()) or None,
            "training": {**training, **asdict(self)},
        }
