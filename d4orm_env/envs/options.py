"""The arguments that all environments share."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from d4orm_env.core.arrays import check_choice, short_repr, truth
from d4orm_env.core.errors import UnknownKeywordError
from d4orm_env.core.problem import Problem
from d4orm_env.core.problem_checks import check_is_problem
from d4orm_env.disturbances.controls import ControlNoise
from d4orm_env.disturbances.disturbance import AnyDisturbance, Disturbances, at_work, checked_disturbances
from d4orm_env.disturbances.perception import RayNoise
from d4orm_env.envs.inputs import noise_std
from d4orm_env.envs.lifelong import GoalFunction
from d4orm_env.envs.rewards import RewardFunction
from d4orm_env.scenarios.problems import ScenarioLike, find_scenario, make_problem, unknown_argument

__all__ = ["EnvOptions"]


OBSERVATION = (
    "observed_path", "observed_robots", "observed_obstacles", "observed_rays", "ray_range", "communication_range",
    "line_of_sight",
)  # fmt: skip
"""Names of the options on what robots observe."""


@dataclass(frozen=True, kw_only=True, eq=False)
class EnvOptions:
    """Options of an environment; every environment takes these as keyword arguments."""

    #: ``"circle"`` unless a problem is given. The name of a scenario, the path of a YAML file, a callable ``(seed,
    #: num_robots, **settings) -> Problem``, or where to import one, ``"package.module:function"``.
    scenario: ScenarioLike | None = None
    num_robots: int | None = None  #: Size of the team; the scenario's default (8 for most) unless given
    problem: Problem | None = None  #: The problem to run instead of a scenario
    render_mode: str | None = None  #: ``"rgb_array"``, ``"human"`` or ``None``
    #: Standard deviation of Gaussian execution noise, in the controls' units, for all components or one per component,
    #: added before the control is clipped: short for ``ControlNoise(std)`` as the first of the disturbances
    control_noise_std: ArrayLike = 0.0
    #: Disturbances, in the order in which they act: instances of :mod:`d4orm_env.disturbances`, or of subclasses of
    #: your own. Those at level zero leave the environment as it is.
    disturbances: Sequence[AnyDisturbance] = ()
    #: A robot that arrives gets a fresh random goal, keeps moving and is not terminated, and so may arrive at any speed
    #: unless ``goal_speed`` is given; its info says ``arrived`` at that step, and ``distance_to_goal`` is to the new
    #: goal. A :data:`~d4orm_env.envs.lifelong.GoalFunction` gives the goals.
    lifelong: bool | GoalFunction = False
    max_cycles: int | None = None  #: Steps until truncation; the problem's horizon unless given
    #: Draw a new instance of the scenario at every reset. By default wherever the scenario draws at random, that is,
    #: where another seed gives another problem; ``False`` keeps the one of ``seed=``.
    randomize_instance: bool | None = None
    #: ``"paper"``, ``"training"`` (:class:`~d4orm_env.envs.rewards.TrainingReward`), or a function from a
    #: :class:`~d4orm_env.envs.rewards.RewardInput` to the rewards ``(..., K)`` of all robots
    reward: str | RewardFunction = "paper"
    #: Distances of rewards, the paper's among them: ``"straight"``, or the length of the shortest free ``"path"``, see
    #: :mod:`d4orm_env.paths.shortest_paths`; the same in a world without obstacles. Not for ``lifelong``.
    progress: str = "straight"
    #: Whether an observation ends with direction and length of the shortest path. Not for ``lifelong``.
    observed_path: bool = False
    observed_robots: int = 4  #: Nearest robots in an observation; missing ones are marked absent
    observed_obstacles: int = 4  #: Nearest obstacles in an observation; likewise
    observed_rays: int = 0  #: Rays of each robot's range sensor (a planar lidar) in an observation; not in space
    ray_range: float = 5.0  #: Range of that [m]; noise is :class:`~d4orm_env.disturbances.RayNoise`
    #: Distance of centres beyond which no neighbour is observed [m]; ``None`` for no limit
    communication_range: float | None = None
    line_of_sight: bool = False  #: Whether neighbours behind obstacles are not observed either; not in space
    #: Whether observations are :class:`~d4orm_env.envs.features.Features`, seen from where the robot faces its goal and
    #: of order one, and actions are in ``[-1, 1]``, in units of the limits and in that frame: what learns. Policies act
    #: in environments without it.
    egocentric: bool = False
    #: Arguments of the scenario, such as ``model`` or ``seed``: all other keyword arguments
    scenario_settings: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def of(cls, **arguments: Any) -> EnvOptions:
        """Make options from the keyword arguments of an environment.

        Raises:
            TypeError: For one that neither the environments nor the scenario have; the message lists those they have.
            ValueError: If both a problem and a scenario or its arguments are given, or the scenario is unknown.
        """
        own = [attribute.name for attribute in fields(cls) if attribute.name != "scenario_settings"]
        given = {name: arguments.pop(name) for name in own if name in arguments}
        options = cls(**given, scenario_settings=arguments)
        for name in arguments:
            complaint = unknown_argument(None if options.problem is not None else options._scenario, (name,), own)
            if complaint:
                # In Python's words first, by which TorchRL knows that it can do without an argument of its own.
                raise UnknownKeywordError(f"unexpected keyword argument {name!r}: {complaint}")
        options._check()
        return options

    def keywords(self) -> dict[str, Any]:
        """Return the keyword arguments that make such an environment."""
        own = {attribute.name: getattr(self, attribute.name) for attribute in fields(self)}
        return {**own.pop("scenario_settings"), **own}

    def disturbances_of(self, problem: Problem) -> Disturbances:
        """All disturbances that change anything in a problem, noise on the controls included.

        Raises:
            ValueError: If one of them makes no sense, or the robots or the world cannot have it.
        """
        std = noise_std(self.control_noise_std, problem.control_size)
        noise = () if std is None else (ControlNoise(tuple(std.tolist())),)
        return at_work((*noise, *self.disturbances), problem)

    def require_physical_units(self) -> None:
        """Raise ``ValueError`` if robots are egocentric, which policies are not made for."""
        if self.egocentric:
            raise ValueError(
                "this environment is egocentric, and policies act in physical units; make it without, and give "
                "egocentric=True to from_sb3() or whatever makes a policy of what you trained"
            )

    def __post_init__(self) -> None:
        object.__setattr__(self, "disturbances", checked_disturbances(self.disturbances))
        for attribute in fields(self):
            if isinstance(value := getattr(self, attribute.name), np.bool_):
                object.__setattr__(self, attribute.name, bool(value))

    def _check(self) -> None:
        if not isinstance(self.randomize_instance, bool | None):
            raise ValueError(
                f"randomize_instance is {short_repr(self.randomize_instance)}; it must be True, False or None"
            )
        check_choice(self.progress, "progress", ("straight", "path"))
        for name in ("observed_path", "line_of_sight", "egocentric"):
            truth(getattr(self, name), name)
        if not (isinstance(self.lifelong, bool) or callable(self.lifelong)):
            raise ValueError(
                f"lifelong is {short_repr(self.lifelong)}; it must be True or False, or a function that gives goals"
            )
        sensed = "ray_range" if np.any(self.ray_range != type(self).ray_range) else ""
        sensed = "RayNoise" if any(isinstance(one, RayNoise) for one in self.disturbances) else sensed
        if sensed and not self.observed_rays:
            raise ValueError(f"{sensed} is of range sensors, and these robots have none; give observed_rays")
        if self.lifelong and (self.progress == "path" or self.observed_path):
            raise ValueError(
                "progress='path' and observed_path need goals that stay; leave them out in lifelong mode, which draws "
                "new ones all the time"
            )
        if self.egocentric and self.observed_path:
            raise ValueError("egocentric observations have no room for observed_path; leave one of the two out")
        if self.problem is None:
            return
        excluded = {"scenario": self.scenario, "num_robots": self.num_robots}
        named = [name for name, value in excluded.items() if value is not None]
        named += [*self.scenario_settings, *["randomize_instance"] * bool(self.randomize_instance)]
        if named:
            raise ValueError(f"problem= excludes the scenario arguments ({', '.join(named)}); give one or the other")

    @property
    def _scenario(self) -> ScenarioLike:
        return "circle" if self.scenario is None else self.scenario

    @property
    def stochastic(self) -> bool:
        """True if the scenario is known to draw instances that differ in positions and obstacles only."""
        return self.problem is None and find_scenario(self._scenario).draws

    def instances(self) -> tuple[Problem, Callable[..., Problem] | None]:
        """The problem to begin with, and ``(seed=) -> Problem`` for drawing others; ``None`` where there is only one.

        Raises:
            ValueError: If the scenario's arguments are bad, or there is nothing to draw although
                ``randomize_instance`` asks for it.
        """
        if self.problem is not None:
            check_is_problem(self.problem)
            return self.problem, None
        settings = {"num_robots": self.num_robots, **self.scenario_settings}
        if self.lifelong and "goal_speed" in find_scenario(self._scenario).arguments:
            # Nobody stops at a goal that is followed by another.
            settings = {"goal_speed": math.inf} | settings
        first = make_problem(self._scenario, **settings)
        if self.randomize_instance is False:
            return first, None
        draw = partial(make_problem, self._scenario, **settings)
        if self.stochastic or draw(seed=0 if self.scenario_settings.get("seed") else 1) != first:
            return first, draw
        if self.randomize_instance:
            raise ValueError(
                f"scenario {first.name!r} is the same for every seed, so randomize_instance has nothing to draw; "
                "use a scenario with random starts and goals, or leave randomize_instance off"
            )
        return first, None
