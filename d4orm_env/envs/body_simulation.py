"""A team in its world, moved by another physics; all else is the simulation that all environments share."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import BoolArray, FloatArray, as_float32
from d4orm_env.core.observation_layout import BoundsSlack
from d4orm_env.core.portable import NUMPY_OPS
from d4orm_env.core.problem import Problem
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.dynamics.transition import absorbed
from d4orm_env.engine.types import MOVED
from d4orm_env.envs.base_env import TeamSimulation
from d4orm_env.envs.lifelong import reached_goals
from d4orm_env.envs.options import EnvOptions
from d4orm_env.envs.setup import EnvSetup
from d4orm_env.envs.team_step import TeamStep

Robots = NDArray[np.intp]


class Moved(NamedTuple):
    """Result of a step."""

    states: FloatArray  #: ``(K, n)`` as the problem's models have them
    touched: BoolArray  #: ``(K,)`` bool: was in contact with a robot, an obstacle or an intruder at any moment of it


class SimulatedBodies(Protocol):
    """The bodies of a problem's team in another physics."""

    problem: Problem  #: The problem
    intruder_radius: FloatArray  #: ``(N,)`` of bodies that are no robots [m]

    @property
    def sensed(self) -> FloatArray | None:
        """``(K, n)`` states as a controller sees them, if they are not the true ones."""

    def begin(self, seed: int) -> None:
        """Put all robots at the start, and let go of those that were held; the seed is of what is random."""

    def put(self, robots: Robots, states: FloatArray) -> None:
        """Put some robots into the states in their rows of ``states`` ``(K, n)``."""

    def hold(self, robots: Robots) -> None:
        """Keep some robots where they are."""

    def advance(self, controls: FloatArray, arrays: ProblemArrays, intruders: FloatArray) -> Moved:
        """One time step of the problem.

        Args:
            controls: ``(K, m)`` within the robots' limits.
            arrays: The problem with the robots' true limits and present goals.
            intruders: ``(N, 5)`` where bodies that are no robots are at the end of the step, and their velocities.
        """


_OUT_OF_THE_WAY = np.float32(1e4)
"""Coordinate of bodies that are absent, which a simulator cannot take out of its world."""


class BodySimulation(TeamSimulation):
    """A simulation whose bodies another physics moves.

    A robot docks as in any environment, at the end of a step, and is held from then on. It has collided if it was in
    contact at any moment of a step, or is judged to be at its end. What a disturbance does to states is done to the
    bodies. ``check`` refuses a problem whose robots have no bodies, and ``make_bodies`` makes those of a problem, given
    the radii of bodies that are no robots.
    """

    def __init__(
        self,
        options: EnvOptions,
        check: Callable[[Problem], None],
        make_bodies: Callable[[Problem, FloatArray], SimulatedBodies],
    ) -> None:
        self.bodies: SimulatedBodies | None = None
        self._moving = False
        self._make_bodies = make_bodies
        super().__init__(EnvSetup(options, slack=_slack_of))
        check(self.problem)

    def reset(self, random: np.random.Generator) -> TeamStep:
        """See :meth:`d4orm_env.envs.base_env.TeamSimulation.reset`."""
        step = super().reset(random)
        radius = self.worlds.bodies[0, :, -1]
        if not radius.all():
            raise ValueError(
                "a moving obstacle is absent at first, and another physics has it all the time; begin at 0 s"
            )
        if (
            self.bodies is None
            or self.bodies.problem is not self.problem
            or (self.bodies.intruder_radius != radius).any()
        ):
            self.bodies = self._make_bodies(self.problem, radius.copy())
        self.bodies.begin(self._seed)
        self._moving = True
        return step

    def _make_worlds(self, problem: Problem, num_worlds: int) -> None:
        super()._make_worlds(problem, num_worlds)
        self._observes_apart = True

    @property
    def _sensed(self) -> FloatArray:
        true = self.worlds.state
        if not self._moving or self.bodies is None or self.bodies.sensed is None:
            return true
        at_rest = np.asarray(absorbed(self.worlds.arrived, self.problem.docks))
        return np.where(at_rest[..., None], true, self.bodies.sensed)

    def _begin(self, seeds: Mapping[int, int]) -> None:
        super()._begin(seeds)
        self._seed, self._moving = seeds[0], False

    def _put(self, states: FloatArray) -> None:
        assert self.bodies is not None
        changed = np.flatnonzero((states[0] != self.states).any(axis=1))
        super()._put(states)
        self.bodies.put(changed, self.states)

    def _move(self, controls: FloatArray) -> np.uint8:
        assert self.bodies is not None
        worlds, true = self.worlds, self.problems.true[0]
        team, docks = self.problem.team, self.problem.docks
        at_rest = np.asarray(absorbed(self.arrived, docks))
        limited = self._limited(controls[0], true.limits, at_rest)
        true = true._replace(goal=self.goals)
        present = worlds.bodies[0, :, -1:] > 0
        states, touched = self.bodies.advance(limited, true, np.where(present, worlds.bodies[0], _OUT_OF_THE_WAY))
        states = self._measured(states, at_rest)
        arrived = at_rest | reached_goals(team, true, states, limited)
        docking = np.flatnonzero(np.asarray(absorbed(arrived, docks)) & ~at_rest)
        for robot in docking:
            model = team.robot_models[robot]
            states[robot, : model.state_size] = model.functions.rest(states[robot, : model.state_size], np.float32(0))
        self.bodies.hold(docking)
        worlds.state[0], worlds.control[0], worlds.arrived[0], worlds.collided[0] = states, limited, arrived, touched
        return MOVED

    def _limited(self, controls: FloatArray, limits: FloatArray, at_rest: BoolArray) -> FloatArray:
        """``controls`` within the robots' limits, zero for those at rest."""
        limited: FloatArray = np.zeros(controls.shape, np.float32)
        for robot in np.flatnonzero(~at_rest):
            model = self.problem.team.robot_models[robot]
            wanted = as_float32(controls[robot, : model.control_size])
            limited[robot, : model.control_size] = model.functions.limit_control(wanted, limits[robot], NUMPY_OPS)
        return limited

    def _measured(self, states: FloatArray, at_rest: BoolArray) -> FloatArray:
        """Return the known states: robots at rest are where they docked, and no speed is beyond the spaces."""
        states = np.where(at_rest[:, None], self.states, states)
        most = self.setup.slack.speed + self.problem.team.max_speed
        for robot, model in enumerate(self.problem.team.robot_models):
            columns = list(model.speed_indices)
            states[robot, columns] = np.clip(states[robot, columns], -most[robot], most[robot])
        return states


def _slack_of(problem: Problem) -> BoundsSlack:
    # Who is run into may be faster for a moment than it can drive.
    fastest = float(problem.team.max_speed.max())
    return BoundsSlack(speed=fastest, drift=fastest)
