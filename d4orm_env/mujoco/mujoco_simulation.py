"""A team in its world, moved by MuJoCo; all else is the simulation that all environments share."""

from __future__ import annotations

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray, as_float32
from d4orm_env.core.observation_layout import BoundsSlack
from d4orm_env.core.portable import NUMPY_OPS
from d4orm_env.core.problem import Problem
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.dynamics.transition import stands
from d4orm_env.engine.types import StepResult
from d4orm_env.envs.lifelong import reached_goals
from d4orm_env.envs.options import EnvOptions
from d4orm_env.envs.simulation import Simulation
from d4orm_env.envs.team_step import TeamStep
from d4orm_env.mujoco.bodies import TeamBodies
from d4orm_env.mujoco.physics import Physics
from d4orm_env.mujoco.scene import check_problem


class MujocoSimulation(Simulation):
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
        super().__init__(options)
        check_problem(self.problem)

    def reset(self, random: np.random.Generator) -> TeamStep:
        """See :meth:`d4orm_env.envs.simulation.Simulation.reset`."""
        step = super().reset(random)
        radius = self._intruders[:, -1]
        bodies = self.bodies
        if bodies is None or bodies.problem is not self.problem or (bodies.intruder_radius != radius).any():
            self.bodies = TeamBodies(self.problem, self.physics, radius.copy())
        else:
            bodies.begin()
        return step

    def _slack_of(self, problem: Problem) -> BoundsSlack:
        # Who is run into may be faster for a moment than it can drive.
        fastest = float(problem.team.max_speed.max())
        return super()._slack_of(problem).joined(BoundsSlack(speed=fastest, drift=fastest))

    def set_state(self, states: object) -> TeamStep:
        """See :meth:`d4orm_env.envs.simulation.Simulation.set_state`."""
        before = self.states
        step = super().set_state(states)  # type: ignore[arg-type] # it is checked there
        self._put(before)
        return step

    @property
    def _intruders(self) -> FloatArray:
        """``(N, 5)`` place, velocity and radius of bodies that are no robots, at the end of the step under way."""
        none: FloatArray = np.zeros((0, 5), np.float32)
        return none if self._disturbed is None else self._disturbed.bodies[0]

    def _put(self, before: FloatArray) -> None:
        """Have the bodies of robots that are no longer where they were ``before`` where they are."""
        assert self.bodies is not None
        changed = np.flatnonzero((self.states != before).any(axis=1))
        self.bodies.put(changed, self.states)

    def _move(self, arrays: ProblemArrays, states: FloatArray, controls: FloatArray) -> StepResult:
        assert self.bodies is not None
        if states is not self.states:
            before, self.states = self.states, states
            self._put(before)
        standing = np.asarray(stands(self.arrived, self.problem.docks))
        controls = self._limited(controls, arrays.limits, standing)
        states, touched = self.bodies.advance(controls, arrays.limits, self._intruders)
        states = self._measured(states, standing)
        arrived = standing | reached_goals(self.problem.team, arrays, states, controls)
        docking = np.flatnonzero(np.asarray(stands(arrived, self.problem.docks)) & ~standing)
        for robot in docking:
            model = self.problem.team.robot_models[robot]
            states[robot, : model.state_size] = model.functions.rest(states[robot, : model.state_size], np.float32(0))
        self.bodies.hold(docking)
        return self._checked(arrays, states, controls, arrived, touched)

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
        most = self._slack.speed + self.problem.team.max_speed
        for robot, model in enumerate(self.problem.team.robot_models):
            columns = list(model.speed_indices)
            states[robot, columns] = np.clip(states[robot, columns], -most[robot], most[robot])
        return states

    def _checked(
        self, arrays: ProblemArrays, states: FloatArray, controls: FloatArray, arrived: BoolArray, touched: BoolArray
    ) -> StepResult:
        """Return the result of a step: flags and rewards of a team at rest where it is now, and who was touched."""
        still = np.ones(len(states), np.bool_)
        checked = self._engine.step(arrays._replace(docks=np.bool_(True)), states, still, np.zeros_like(controls))
        outcome = checked._replace(states=states, controls=controls, arrived=arrived)
        return outcome.with_contacts(touched, touched & ~checked.margin_violated, arrays.collision_penalty)
