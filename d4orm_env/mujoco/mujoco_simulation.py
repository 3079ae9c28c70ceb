"""A team in its world, moved by MuJoCo; all else is the simulation that all environments share."""

from __future__ import annotations

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray, as_float32
from d4orm_env.core.observation_layout import BoundsSlack
from d4orm_env.core.portable import NUMPY_OPS
from d4orm_env.core.problem import Problem
from d4orm_env.dynamics.transition import stands
from d4orm_env.engine.types import MOVED
from d4orm_env.envs.lifelong import reached_goals
from d4orm_env.envs.options import EnvOptions
from d4orm_env.envs.setup import EnvSetup
from d4orm_env.envs.team_simulation import TeamSimulation
from d4orm_env.envs.team_step import TeamStep
from d4orm_env.mujoco.bodies import TeamBodies
from d4orm_env.mujoco.physics import Physics
from d4orm_env.mujoco.scene import check_problem


class MujocoSimulation(TeamSimulation):
    """A simulation whose bodies MuJoCo moves.

    A robot docks as in any environment, at the end of a step, and is held fast from then on. It has collided if it was
    in contact at any moment of a step, or is judged to be at its end. What a disturbance does to states is done to the
    bodies.

    Args:
        options: Options of the simulation.
        physics: Material of the bodies.

    Raises:
        ValueError: For an argument out of range, or a robot that has no body in MuJoCo.
    """

    def __init__(self, options: EnvOptions, physics: Physics) -> None:
        self.physics = physics
        self.bodies: TeamBodies | None = None
        super().__init__(EnvSetup(options, slack=_slack_of))
        check_problem(self.problem)

    def reset(self, random: np.random.Generator) -> TeamStep:
        """See :meth:`d4orm_env.envs.team_simulation.TeamSimulation.reset`."""
        step = super().reset(random)
        bodies, radius = self.bodies, self.worlds.bodies[0, :, -1]
        if bodies is None or bodies.problem is not self.problem or (bodies.intruder_radius != radius).any():
            self.bodies = TeamBodies(self.problem, self.physics, radius.copy())
        else:
            bodies.begin()
        return step

    def _put(self, states: FloatArray) -> None:
        assert self.bodies is not None
        changed = np.flatnonzero((states[0] != self.states).any(axis=1))
        super()._put(states)
        self.bodies.put(changed, self.states)

    def _move(self, controls: FloatArray) -> np.uint8:
        assert self.bodies is not None
        worlds, true = self.worlds, self.problems.true[0]
        team, docks = self.problem.team, self.problem.docks
        standing = np.asarray(stands(self.arrived, docks))
        limited = self._limited(controls[0], true.limits, standing)
        states, touched = self.bodies.advance(limited, true.limits, worlds.bodies[0])
        states = self._measured(states, standing)
        arrived = standing | reached_goals(team, true._replace(goal=self.goals), states, limited)
        docking = np.flatnonzero(np.asarray(stands(arrived, docks)) & ~standing)
        for robot in docking:
            model = team.robot_models[robot]
            states[robot, : model.state_size] = model.functions.rest(states[robot, : model.state_size], np.float32(0))
        self.bodies.hold(docking)
        worlds.state[0], worlds.control[0], worlds.docked[0], worlds.collided[0] = states, limited, arrived, touched
        return MOVED

    def _limited(self, controls: FloatArray, limits: FloatArray, standing: BoolArray) -> FloatArray:
        """``controls`` within the robots' limits, zero for those at rest."""
        limited: FloatArray = np.zeros(controls.shape, np.float32)
        for robot in np.flatnonzero(~standing):
            model = self.problem.team.robot_models[robot]
            wanted = as_float32(controls[robot, : model.control_size])
            limited[robot, : model.control_size] = model.functions.limit_control(wanted, limits[robot], NUMPY_OPS)
        return limited

    def _measured(self, states: FloatArray, standing: BoolArray) -> FloatArray:
        """Return the known states: robots at rest are where they docked, and no speed is beyond the spaces."""
        states = np.where(standing[:, None], self.states, states)
        most = self.setup.slack.speed + self.problem.team.max_speed
        for robot, model in enumerate(self.problem.team.robot_models):
            columns = list(model.speed_indices)
            states[robot, columns] = np.clip(states[robot, columns], -most[robot], most[robot])
        return states


def _slack_of(problem: Problem) -> BoundsSlack:
    # Who is run into may be faster for a moment than it can drive.
    fastest = float(problem.team.max_speed.max())
    return BoundsSlack(speed=fastest, drift=fastest)
