"""A team of robots: one model, radius and set of limits per robot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from d4orm_env.core import bodies as parts
from d4orm_env.core.arrays import (
    LARGEST,
    FloatArray,
    Floats,
    Frozen,
    frozen_per_robot,
    positive_number,
    read_only,
    short_repr,
    whole_number,
)
from d4orm_env.dynamics.models import get_model
from d4orm_env.dynamics.robot_model import ACCELERATION, SPEED, STANDARD_LIMITS, TURN_RATE, Model
from d4orm_env.footprints import Disc, Footprint

Flattened = TypeVar("Flattened", FloatArray, Floats)

DEFAULT_RADIUS, DEFAULT_MARGIN = 0.15, 0.05
"""Radius of a robot and safety margin [m]."""
DEFAULT_LIMITS = (1.0, 1.0, float(np.pi / 2))
"""Limits of speed [m/s], acceleration [m/s^2] and turn rate [rad/s]."""


@dataclass(frozen=True, eq=False, init=False)
class Team(Frozen):
    """The robots, in order. Teams may mix models; all must move in the same number of dimensions.

    Single numbers are given to every robot. All lie from 1e-7 to 1e6, where float32 holds what is computed of them.

    Attributes:
        models: ``K`` model names.
        radius: ``(K,)`` body radius [m]; of a footprint that is no disc, its outer radius, and with trailers how far
            they may reach about the robot. Given to robots with trailers without footprints it is that of each body.
        max_speed: ``(K,)`` speed limit [m/s].
        max_acceleration: ``(K,)`` acceleration limit [m/s^2]; no use to a first-order robot.
        max_turn_rate: ``(K,)`` turn rate limit [rad/s]; of use to differential drives and unicycles. How far a robot
            may turn in a time step is bounded; see :class:`~d4orm_env.core.problem.Problem`.
        own_limits: ``(K,)`` by name for every limit that a model of the team has for itself, such as the ``wheelbase``
            of a car; of use to its robots only. What is left out has the model's default.
        lag: ``(K,)`` time constant of the actuators [s], for controllers of real robots: the simulation has none.
        margin: Safety margin that its problems have where they are given none [m].
        shapes: ``K`` :mod:`footprints <d4orm_env.footprints>`, given as ``footprint``, one for all or one each; empty
            for discs.

    Raises:
        ValueError: For an unknown model, an empty or mixed-dimension team, a limit that is not positive or out of
            range, one that no model of the team has, a footprint of another dimension, or a radius that is not its.
    """

    models: tuple[str, ...]
    radius: FloatArray
    max_speed: FloatArray
    max_acceleration: FloatArray
    max_turn_rate: FloatArray
    own_limits: Mapping[str, FloatArray]
    shapes: tuple[Footprint, ...]
    lag: FloatArray
    margin: float

    def __init__(
        self,
        models: Sequence[str],
        radius: ArrayLike | None = None,
        max_speed: ArrayLike = DEFAULT_LIMITS[SPEED],
        max_acceleration: ArrayLike = DEFAULT_LIMITS[ACCELERATION],
        max_turn_rate: ArrayLike = DEFAULT_LIMITS[TURN_RATE],
        own_limits: Mapping[str, ArrayLike] = MappingProxyType({}),
        footprint: Footprint | Sequence[Footprint] | None = None,
        lag: ArrayLike = 0.0,
        margin: float = DEFAULT_MARGIN,
    ) -> None:
        if isinstance(models, str) or not isinstance(models, Sequence):
            raise ValueError(f"models must be a sequence of model names, not {short_repr(models)}")
        if not models:
            raise ValueError("a team needs at least one robot; models is empty")
        if len({get_model(name).dimension for name in models}) > 1:
            raise ValueError(f"models {sorted(set(models))} mix 2D and 3D robots; a team moves in one dimension")
        limits = zip(STANDARD_LIMITS, (max_speed, max_acceleration, max_turn_rate), strict=True)
        self._set(models=tuple(models), **{name: frozen_per_robot(value, name, len(models)) for name, value in limits})
        self._set(
            own_limits=parts.complete_own_limits(own_limits, self.robot_models),
            margin=positive_number(margin, "margin", zero_allowed=True, most=LARGEST),
            lag=frozen_per_robot(lag, "lag", len(models), zero_allowed=True),
        )
        self._set_footprints(radius, footprint)

    def _set_footprints(self, radius: ArrayLike | None, given: Footprint | Sequence[Footprint] | None) -> None:
        """Set shapes and radius, of which one follows from the other."""
        count, models = len(self.models), self.robot_models
        if given is None:
            radii = frozen_per_robot(DEFAULT_RADIUS if radius is None else radius, "radius", count)
            if not any(model.trailers for model in models):
                self._set(radius=radii, shapes=())
                return
            given, radius = parts.discs_of(radii, models), None
        footprints = parts.checked_footprints(given, models)
        outer = [parts.outer_radius(*robot) for robot in zip(footprints, models, self.limits, strict=True)]
        radii = frozen_per_robot(outer, "radius", count)
        if radius is not None and (frozen_per_robot(radius, "radius", count) != radii).any():
            raise ValueError(
                f"radius {short_repr(radius)} is not that of the footprints, {radii.tolist()}; leave it out"
            )
        shaped = not all(isinstance(footprint, Disc) for footprint in footprints)
        self._set(radius=radii, shapes=footprints if shaped else ())

    def replace(self, **changes: object) -> Team:
        """A copy with some attributes changed, checked again; of radius and footprint, what is not given follows."""
        given: dict[str, Any] = self.__getstate__()
        shapes = given.pop("shapes")
        if "models" in changes:  # others may not have what these have by default
            default = Team(self.models).own_limits
            given["own_limits"] = {name: own for name, own in self.own_limits.items() if (own != default[name]).any()}
        if shapes or "footprint" in changes:
            given |= {"radius": None, "footprint": None if "radius" in changes else shapes}
        return Team(**given | changes)

    @property
    def footprint(self) -> tuple[Footprint, ...]:
        """``K`` footprints."""
        return self.shapes or tuple(Disc(radius) for radius in self.radius.tolist())

    @cached_property
    def wall_radius(self) -> FloatArray:
        """``(K,)`` outer radius of what obstacles and bounds meet [m]."""
        return self._sizes("wall_radius")

    @cached_property
    def girth(self) -> FloatArray:
        """``(K,)`` radius of the upright cylinder, or of the disc, round each robot [m]; see :meth:`flattening`."""
        return self._sizes("girth")

    def _sizes(self, name: str) -> FloatArray:
        """``(K,)`` a radius of the robots, that is of ellipsoids another than the outer one."""
        if not self.shapes or self.dimension == 2:
            return self.radius
        return read_only(np.array([getattr(shape, name) for shape in self.shapes], np.float32))

    def flattening(self, margin: float) -> float:
        """Factor for heights, at most one, by which robots that are within the margin are as near as balls.

        Where heights are so much less, no two robots are within the margin unless balls of their girths are; of robots
        with the same upright ellipsoid these are just those.
        """
        if not self.shapes or self.dimension == 2:
            return 1.0
        axes, wider = np.array([shape.semi_axes for shape in self.shapes]), margin / 2
        return float(((axes[:, :2].max(axis=1) + wider) / (axes[:, 2] + wider)).min(initial=1.0))

    def flattened(self, positions: Flattened, margin: float) -> Flattened:
        """Positions ``(..., d)`` with heights so much less."""
        factor = self.flattening(margin)
        if factor == 1:
            return positions
        flat: Flattened = positions * np.array([1, 1, factor], positions.dtype)
        return flat

    @property
    def inner_radius(self) -> Floats:
        """``(K,)`` radii of the discs or balls that the footprints cover however they turn [m]."""
        inner = self.all_footprint_arrays.inner[: self.num_robots] if self.shapes else self.radius
        return inner.astype(np.float64)

    def headings(self, states: FloatArray) -> FloatArray:
        """``(..., K)`` what turns the robots' footprints in states ``(..., K, n)`` [rad]; zero without a heading."""
        columns = [model.heading_index for model in self.robot_models]
        turned = np.stack([states[..., robot, column or 0] for robot, column in enumerate(columns)], axis=-1)
        return np.where([column is None for column in columns], np.float32(0), turned)

    @cached_property
    def footprint_arrays(self) -> parts.FootprintArrays | None:
        """The footprints as the engines read them; ``None`` where all robots are discs, which need none."""
        return self.all_footprint_arrays if self.shapes else None

    @cached_property
    def all_footprint_arrays(self) -> parts.FootprintArrays:
        """The same, discs too: for teams that others have other footprints than."""
        return parts.as_arrays(self.bodies)

    @cached_property
    def bodies(self) -> tuple[parts.Body, ...]:
        """The robots' bodies, and then those of their trailers."""
        return parts.find_bodies(self.footprint, self.robot_models, self.hitches)

    @cached_property
    def hitches(self) -> tuple[float, ...]:
        """Lengths of the hitches of all trailers, robot by robot [m]."""
        models = enumerate(self.robot_models)
        return tuple(float(self.limits[robot, column]) for robot, model in models for _, column in model.trailers)

    def body_poses(self, states: FloatArray) -> Floats:
        """``(..., F, d + 1)`` reference points and headings of the bodies in states ``(..., K, n)``."""
        return parts.body_poses(self.bodies, states, self.dimension)

    @property
    def num_robots(self) -> int:
        """``K``."""
        return len(self.models)

    @cached_property
    def robot_models(self) -> tuple[Model, ...]:
        """The ``K`` models themselves."""
        return tuple(get_model(name) for name in self.models)

    @property
    def dimension(self) -> int:
        """Position dimensions ``d``."""
        return self.robot_models[0].dimension

    @cached_property
    def state_size(self) -> int:
        """``n``: the largest state size of the team; smaller states are padded with zeros."""
        return max(model.state_size for model in self.robot_models)

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the state's components; none for a team in which they differ."""
        first, *others = {model.state_names for model in self.robot_models}
        return () if others else first

    @cached_property
    def control_size(self) -> int:
        """``m``: the largest control size of the team; smaller controls are padded with zeros."""
        return max(model.control_size for model in self.robot_models)

    @cached_property
    def limits(self) -> FloatArray:
        """``(K, L)`` limits in the order of :attr:`Model.limit_names`; one on padding."""
        models = self.robot_models
        limits = np.ones((self.num_robots, max(len(model.limit_names) for model in models)), np.float32)
        for column, name in enumerate(STANDARD_LIMITS):
            limits[:, column] = getattr(self, name)
        for robot, model in enumerate(models):
            for column, limit in enumerate(model.own_limits, len(STANDARD_LIMITS)):
                limits[robot, column] = self.own_limits[limit.name][robot]
        return read_only(limits)

    @cached_property
    def control_limits(self) -> FloatArray:
        """``(K, m)`` largest magnitude of each control component; zero on padding."""
        return read_only(np.abs(self.control_bounds).max(axis=0))

    @cached_property
    def control_bounds(self) -> FloatArray:
        """``(2, K, m)`` lowest and highest value of each control component; zero on padding."""
        bounds = np.zeros((2, self.num_robots, self.control_size), np.float32)
        for robot, (model, limits) in enumerate(zip(self.robot_models, self.limits, strict=True)):
            bounds[0, robot, : model.control_size] = -model.lower_bounds(limits)[list(model.control_limits)]
            bounds[1, robot, : model.control_size] = limits[list(model.control_limits)]
        return read_only(bounds)

    @cached_property
    def control_units(self) -> FloatArray:
        """``(K, m)`` what methods measure each control component in: its limit over the limit's default."""
        units = np.ones((self.num_robots, self.control_size), np.float32)
        for robot, model in enumerate(self.robot_models):
            defaults = np.array([*DEFAULT_LIMITS, *(limit.default for limit in model.own_limits)], np.float32)
            size, columns = model.control_size, list(model.control_limits)
            units[robot, :size] = self.limits[robot, columns] / defaults[columns]
        return read_only(units)

    @cached_property
    def largest_radius(self) -> float:
        """The largest of the radii, of ellipsoids the girths [m], by which methods measure lengths.

        It is rounded as float32 is, but so that it is the decimal number for robots of the default radius.
        """
        return DEFAULT_RADIUS * (float(self.girth.max()) / float(np.float32(DEFAULT_RADIUS)))

    @cached_property
    def turning_radius(self) -> FloatArray:
        """``(K,)`` radius of the smallest circle that each can drive [m]; zero for those that turn in place."""
        models = zip(self.robot_models, self.limits, strict=True)
        return read_only(np.array([model.turning_radius(limits) for model, limits in models], np.float32))

    def select(self, robots: Sequence[int]) -> Team:
        """The team of these robots only, in the order given; a number that is no robot's is a ValueError."""
        index = [whole_number(robot, "robot", 0, self.num_robots - 1) for robot in robots]
        own = {limit.name for robot in index for limit in self.robot_models[robot].own_limits}
        return Team(
            tuple(self.models[robot] for robot in index),
            None if self.shapes else self.radius[index],
            **{name: getattr(self, name)[index] for name in (*STANDARD_LIMITS, "lag")},
            own_limits={name: values[index] for name, values in self.own_limits.items() if name in own},
            footprint=[self.shapes[robot] for robot in index] if self.shapes else None,
            margin=self.margin,
        )
