"""A team as rigid bodies in motion: put somewhere, moved by commands, looked at; and the control of drives' wheels."""

from __future__ import annotations

import math

import mujoco
import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import BoolArray, FloatArray, Floats
from d4orm_env.core.portable import NUMPY_OPS
from d4orm_env.core.problem import Problem
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.core.winding import unwound
from d4orm_env.dynamics.robot_model import ACCELERATION, SPEED, TURN_RATE, TimeStep
from d4orm_env.dynamics.unicycle2 import MAX_TURN_ACCELERATION, UNICYCLE2
from d4orm_env.envs.body_simulation import Moved, Robots
from d4orm_env.mujoco.scene import (
    DRIVES,
    GRAVITY,
    HALF_TRACK,
    NOT_SOLID,
    OBSTACLE,
    PUCKS,
    WHEEL_RADIUS,
    Physics,
    build_scene,
)

_HELD = 1e6
"""Weight added to a docked robot, per degree of freedom [kg]: nothing moves it."""
_SPIN, _FREE_DOFS, _FREE_POSITIONS = 2, 6, 7
TURNING = 4
"""State component of second-order unicycles that is their turn rate."""


class TeamBodies:
    """The bodies of a problem's team, which all have one, and of bodies that are no robots, of radii ``(N,)`` [m]."""

    sensed = None

    def __init__(self, problem: Problem, intruder_radius: FloatArray, physics: Physics) -> None:
        self.problem, self.intruder_radius = problem, intruder_radius
        self._substeps = math.ceil(problem.dt / physics.time_step - 1e-9)
        self._step = problem.dt / self._substeps
        self.scene = build_scene(problem, physics, intruder_radius, self._step)
        self.data = mujoco.MjData(self.scene.model)
        self._settling_time = physics.settling_time
        self._grip = physics.wheel_friction * GRAVITY
        names = np.array(problem.team.models)
        self._pucks, self._drives = np.flatnonzero(np.isin(names, PUCKS)), np.flatnonzero(np.isin(names, DRIVES))
        self._servos = np.flatnonzero(names == "velocity2d")
        radius = self.scene.radius[self._drives]
        mass = self.scene.mass[self._drives]
        self._wheels = WheelControl(WHEEL_RADIUS * radius, HALF_TRACK * radius, mass, physics.settling_time)
        dofs = self.scene.dofs
        self._push_dofs = dofs[self._pucks][:, None] + np.arange(2)
        self._servo_dofs = dofs[self._servos][:, None] + np.arange(2)
        self._wheel_dofs = dofs[self._drives][:, None] + _FREE_DOFS + np.arange(2)
        self._headings: Floats = np.zeros(problem.num_robots)
        self._wanted: Floats = np.zeros((problem.num_robots, 2))
        self._held: BoolArray = np.zeros(problem.num_robots, np.bool_)

    def begin(self, seed: int) -> None:
        """Put all robots at the start, at whatever speed the problem says, and let go of those that were held."""
        mujoco.mj_resetData(self.scene.model, self.data)
        self._held[:] = False
        self.scene.model.dof_armature[:] = 0
        self.put(np.arange(self.problem.num_robots), self.problem.start)

    def put(self, robots: Robots, states: FloatArray) -> None:
        """Put some robots into the states in the rows of ``states`` ``(K, n)``."""
        for robot in robots.tolist():
            self._put(robot, states[robot].astype(np.float64))
        self._wheels.reset(np.isin(self._drives, robots))

    def hold(self, robots: Robots) -> None:
        """Stop some robots where they are, so that nothing moves them any more."""
        for robot in robots.tolist():
            dofs = self._dofs(robot)
            self.data.qvel[dofs] = self.data.qfrc_applied[dofs] = 0
            self.scene.model.dof_armature[dofs] = _HELD
        self._held[robots] = True

    def advance(self, controls: FloatArray, arrays: ProblemArrays, intruders: FloatArray) -> Moved:
        """See :class:`~d4orm_env.envs.body_simulation.SimulatedBodies`.

        Raises:
            RuntimeError: If the simulation has become unstable.
        """
        states, limits = self.states(), arrays.limits
        self._push(controls, states, limits)
        commands = self._commands(controls, states, limits)
        touched = np.zeros(self.problem.num_robots, np.bool_)
        for number in range(1, self._substeps + 1):
            left = self.problem.dt - number * self._step
            for position, body in zip(self.data.mocap_pos, intruders):
                position[:2] = body[:2] - left * body[2:4]
            self._serve(controls)
            self._turn_wheels(commands, number * self._step)
            mujoco.mj_step(self.scene.model, self.data)
            self._note_contacts(touched)
        if self.data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number:
            raise RuntimeError("MuJoCo's simulation has become unstable; use a smaller Physics time_step")
        return Moved(self.states(), touched)

    def states(self) -> FloatArray:
        """``(K, n)`` the robots' states, headings wound up no farther than the models' are."""
        states: FloatArray = np.zeros(self.problem.start.shape, np.float32)
        qpos, qvel = self.data.qpos, self.data.qvel
        for robot, model in enumerate(self.problem.team.robot_models):
            joint, dof = self.scene.joints[robot], self.scene.dofs[robot]
            states[robot, :2] = qpos[joint : joint + 2]
            if model.heading_index is None:
                velocity = qvel[dof : dof + 2]
            else:
                states[robot, model.heading_index] = heading = self._heading(robot)
                velocity = qvel[dof] * math.cos(heading) + qvel[dof + 1] * math.sin(heading)
            if model.speed_indices:
                states[robot, list(model.speed_indices)] = velocity
            if model.name == UNICYCLE2.name:
                states[robot, TURNING] = qvel[dof + _FREE_DOFS - 1]
        return states

    def _put(self, robot: int, state: Floats) -> None:
        model, data = self.problem.team.robot_models[robot], self.data
        joint, dof = int(self.scene.joints[robot]), int(self.scene.dofs[robot])
        data.qpos[joint : joint + 2] = state[:2]
        data.qvel[self._dofs(robot)] = 0
        data.qfrc_applied[self._dofs(robot)] = 0
        if model.heading_index is None:
            data.qpos[joint + _SPIN] = 0
            if model.speed_indices:
                data.qvel[dof : dof + 2] = state[list(model.speed_indices)]
            return
        self._headings[robot] = heading = state[model.heading_index]
        data.qpos[joint + 2 : joint + _FREE_POSITIONS] = [0, math.cos(heading / 2), 0, 0, math.sin(heading / 2)]
        data.qpos[joint + _FREE_POSITIONS : joint + _FREE_POSITIONS + 2] = 0
        speed = float(sum(state[index] for index in model.speed_indices))
        turning = float(state[TURNING]) if model.name == UNICYCLE2.name else 0.0
        self._wanted[robot] = speed, turning
        data.qvel[dof : dof + 2] = speed * math.cos(heading), speed * math.sin(heading)
        data.qvel[dof + _FREE_DOFS - 1] = turning
        sides = speed + turning * HALF_TRACK * float(self.scene.radius[robot]) * np.array([-1.0, 1.0])
        data.qvel[dof + _FREE_DOFS : dof + _FREE_DOFS + 2] = sides / (WHEEL_RADIUS * float(self.scene.radius[robot]))

    def _dofs(self, robot: int) -> slice:
        first = int(self.scene.dofs[robot])
        return slice(first, first + (_FREE_DOFS + 2 if robot in self._drives else _SPIN + 1))

    def _heading(self, robot: int) -> float:
        """The angle of a drive over the floor, wound on from where it was last seen [rad]."""
        joint = self.scene.joints[robot] + 3
        w, x, y, z = self.data.qpos[joint : joint + 4].tolist()
        angle = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        turned = self._headings[robot] + math.remainder(angle - self._headings[robot], 2 * math.pi)
        self._headings[robot] = heading = float(unwound(turned, NUMPY_OPS))
        return heading

    def _push(self, controls: FloatArray, states: FloatArray, limits: FloatArray) -> None:
        """Push the pucks that are controlled by acceleration, no faster than they may be, for a whole step."""
        h = TimeStep(*self.problem.arrays.time_step)
        for robot, dofs in zip(self._pucks.tolist(), self._push_dofs):
            model = self.problem.team.robot_models[robot]
            if not model.speed_indices or self._held[robot]:
                continue
            x, u, limit = tuple(states[robot]), tuple(controls[robot]), tuple(limits[robot])
            wanted = model.functions.limit_state(model.functions.integrate(x, u, limit, h, NUMPY_OPS), limit, NUMPY_OPS)
            change = [wanted[index] - states[robot, index] for index in model.speed_indices]
            self.data.qfrc_applied[dofs] = self.scene.mass[robot] / self.problem.dt * np.array(change, np.float64)

    def _serve(self, controls: FloatArray) -> None:
        """Push the pucks that are controlled by velocity, as hard as tyres would hold, until they have it."""
        if not len(self._servos):
            return
        pull = (controls[self._servos, :2] - self.data.qvel[self._servo_dofs]) / self._settling_time
        size = np.sqrt((pull * pull).sum(axis=1, keepdims=True))
        pull *= self._grip / np.maximum(size, self._grip)
        pull[self._held[self._servos]] = 0
        self.data.qfrc_applied[self._servo_dofs] = self.scene.mass[self._servos, None] * pull

    def _turn_wheels(self, commands: Floats, time: float) -> None:
        """Have the wheels follow commands that were given so long before the end of MuJoCo's next step [s]."""
        if not len(self._drives):
            return
        torque = self._wheels.torque(commands, time, self._step, self.data.qvel[self._wheel_dofs])
        torque[self._held[self._drives]] = 0
        self.data.qfrc_applied[self._wheel_dofs] = torque

    def _commands(self, controls: FloatArray, states: FloatArray, limits: FloatArray) -> Floats:
        """``(D, 2, 4)`` the drives' commands, for :meth:`WheelControl.torque`."""
        rows = []
        for robot in self._drives.tolist():
            first, second = controls[robot, :2].tolist()
            model, own = self.problem.team.robot_models[robot], limits[robot]
            lower, speeds = model.lower_bounds(own), states[robot, list(model.speed_indices)].tolist()
            allowed, turns = ((-float(lower[limit]), float(own[limit])) for limit in (SPEED, TURN_RATE))
            if not speeds:
                rows.append(((first, 0.0, *allowed), (second, 0.0, *turns)))
                continue
            push, turn, swing = second, first, 0.0
            if model.name == UNICYCLE2.name:
                push, swing, now = first, second, float(states[robot, TURNING])
                turn = self._onward(robot, 1, now, swing, float(own[MAX_TURN_ACCELERATION]), turns)
            speed = self._onward(robot, 0, speeds[0], push, float(own[ACCELERATION]), allowed)
            rows.append(((speed, push, *allowed), (turn, swing, *turns)))
        return np.array(rows, np.float64).reshape(-1, 2, 4)

    def _onward(
        self, robot: int, which: int, now: float, change: float, most: float, limits: tuple[float, float]
    ) -> float:
        """A speed or turn rate from which it changes on: what it was to be, which it nearly is unless it is held up."""
        most *= self.problem.dt
        begin = now + min(max(float(self._wanted[robot, which]) - now, -most), most)
        self._wanted[robot, which] = min(max(begin + self.problem.dt * change, limits[0]), limits[1])
        return begin

    def _note_contacts(self, touched: BoolArray) -> None:
        contact = self.data.contact
        owners = self.scene.owner[contact.geom]
        meeting = owners[(owners != NOT_SOLID).all(axis=1) & (contact.dist <= 0)].ravel()
        touched[meeting[meeting != OBSTACLE]] = True


class WheelControl:
    """PI control of ``D`` drives' left and right wheels.

    A command is a speed and a turn rate. The kinematics of the differential drive makes wheel speeds of them (R.
    Siegwart, I. R. Nourbakhsh and D. Scaramuzza, Introduction to Autonomous Mobile Robots, 2nd edition, chapter 3), and
    each wheel follows its own by PI control with feedforward. Its gains place both poles of a wheel, an integrator from
    torque to speed, at the inverse of the settling time, and its integral stands still while the motor is at its limit
    (K. J. Åström and R. M. Murray, Feedback Systems, chapter "PID Control").

    Args:
        radius: ``(D,)`` of the wheels [m].
        half_track: ``(D,)`` distance of a wheel from the middle [m].
        mass: ``(D,)`` of the drives [kg].
        settling_time: [s].

    Attributes:
        radius: ``(D,)`` of the wheels [m].
    """

    def __init__(self, radius: Floats, half_track: Floats, mass: Floats, settling_time: float) -> None:
        self.radius, self._half_track = radius, half_track
        # Each wheel carries half of the robot along.
        self._inertia = (mass * radius * radius / 2)[:, None]
        self._proportional = 2 * self._inertia / settling_time
        self._integral_gain = self._inertia / settling_time**2
        # What the tyres could hold if they carried all of the weight.
        self._max_torque = (mass * GRAVITY * radius / 2)[:, None]
        self._integral = np.zeros((len(mass), 2))

    def reset(self, drives: NDArray[np.bool_]) -> None:
        """Forget the past of some drives ``(D,)``."""
        self._integral[drives] = 0

    def torque(self, commands: Floats, time: float, step: float, spin: Floats) -> Floats:
        """``(D, 2)`` torques of left and right wheels for the next step [N m].

        ``commands`` ``(D, 2, 4)`` are a speed and a turn rate when they were given, their changes from there on, and
        the least and the most that they may be [m/s, rad/s]; ``time`` is since then, at the end of the step [s], and
        ``spin`` ``(D, 2)`` the present speeds of the wheels [rad/s].
        """
        begin, change, least, most = commands.transpose(2, 0, 1)
        wanted = begin + time * change
        speed, turning = np.clip(wanted, least, most).T
        turning = turning * self._half_track
        reference = np.stack([speed - turning, speed + turning], axis=1) / self.radius[:, None]
        ahead = np.where(speed == wanted[:, 0], change[:, 0], 0.0) / self.radius
        error = reference - spin
        integral = self._integral + step * error
        torque = self._inertia * ahead[:, None] + self._proportional * error + self._integral_gain * integral
        limited = np.clip(torque, -self._max_torque, self._max_torque)
        self._integral = np.where(limited == torque, integral, self._integral)
        return limited
