"""A team of robots: one model, radius and set of limits per robot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from d4orm_env.core.arrays import FloatArray, frozen_per_robot, restore_frozen
from d4orm_env.core.dynamics import ACCELERATION, SPEED, TURN_RATE, Model, get_model


@dataclass(frozen=True, eq=False)
class Team:
    """The robots, in order. Teams may mix models; all must move in the same number of dimensions.

    Single numbers are given to every robot. All lie from 1e-7 to 1e6, where float32 holds what is computed of them.

    Attributes:
        models: ``K`` model names.
        radius: ``(K,)`` body radius [m].
        max_speed: ``(K,)`` speed limit [m/s].
        max_acceleration: ``(K,)`` acceleration limit [m/s^2]; no use to a first-order robot.
        max_turn_rate: ``(K,)`` turn rate limit [rad/s]; of use to differential drives only. How far one may turn in
            a time step is bounded; see :class:`~d4orm_env.core.problem.Problem`.

    Raises:
        ValueError: For an unknown model, an empty or mixed-dimension team, or a limit that is not positive or out of
            range.
    """

    models: tuple[str, ...]
    radius: FloatArray | float = 0.15
    max_speed: FloatArray | float = 1.0
    max_acceleration: FloatArray | float = 1.0
    max_turn_rate: FloatArray | float = float(np.pi / 2)

    def __post_init__(self) -> None:
        if isinstance(self.models, str) or not isinstance(self.models, Sequence):
            raise ValueError(f"models must be a sequence of model names, not {self.models!r}")
        object.__setattr__(self, "models", tuple(self.models))
        if not self.models:
            raise ValueError("a team needs at least one robot; models is empty")
        dimensions = {get_model(name).dimension for name in self.models}
        if len(dimensions) > 1:
            raise ValueError(f"models {sorted(set(self.models))} mix 2D and 3D robots; a team moves in one dimension")
        for name in ("radius", "max_speed", "max_acceleration", "max_turn_rate"):
            object.__setattr__(self, name, frozen_per_robot(getattr(self, name), name, len(self.models)))

    def __setstate__(self, state: dict[str, Any]) -> None:
        restore_frozen(self, state)

    @property
    def num_robots(self) -> int:
        """``K``."""
        return len(self.models)

    @property
    def robot_models(self) -> tuple[Model, ...]:
        """The ``K`` models themselves."""
        return tuple(get_model(name) for name in self.models)

    @property
    def dimension(self) -> int:
        """Position dimensions ``d``."""
        return self.robot_models[0].dimension

    @property
    def state_size(self) -> int:
        """``n``: the largest state size of the team; smaller states are padded with zeros."""
        return max(model.state_size for model in self.robot_models)

    @property
    def control_size(self) -> int:
        """``m``: the largest control size of the team; smaller controls are padded with zeros."""
        return max(model.control_size for model in self.robot_models)

    @property
    def limits(self) -> FloatArray:
        """``(K, 3)`` limits in the column order that the models use."""
        limits = np.empty((self.num_robots, 3), np.float32)
        limits[:, SPEED] = self.max_speed
        limits[:, ACCELERATION] = self.max_acceleration
        limits[:, TURN_RATE] = self.max_turn_rate
        return limits

    @property
    def control_limits(self) -> FloatArray:
        """``(K, m)`` largest magnitude of each control component; zero on padding."""
        bound = np.zeros((self.num_robots, self.control_size), np.float32)
        for robot, (model, limits) in enumerate(zip(self.robot_models, self.limits, strict=True)):
            bound[robot, : model.control_size] = limits[list(model.control_limits)]
        return bound

    def select(self, robots: Sequence[int]) -> Team:
        """The team of these robots only, in the order given."""
        index = list(robots)
        return Team(
            tuple(self.models[robot] for robot in index),
            np.asarray(self.radius)[index],
            np.asarray(self.max_speed)[index],
            np.asarray(self.max_acceleration)[index],
            np.asarray(self.max_turn_rate)[index],
        )
