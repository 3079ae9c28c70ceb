"""Motion of robots under a plan, written again in float64: clipping, the models in continuous time, the speed limit.

Within a control step holonomic robots move on parabolas, integrated in closed form; the heading and speed of a
differential drive or a unicycle are linear in time and its position is their Simpson quadrature. Other models are
:mod:`integrated <d4orm_env.verify.integrated>`. Robots do not act on each other, so
each is moved over the whole horizon at once, as if it never docked. Models and limits: paper, sections III and IV-B.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core import portable
from d4orm_env.verify.geometry import Floats, norm
from d4orm_env.verify.integrated import Integrated

if TYPE_CHECKING:
    from d4orm_env.core.problem import Problem

MODELS = ("holonomic2d", "holonomic3d", "velocity2d", "differential_drive", "unicycle")
"""The models that have equations here; the others are integrated."""


class TeamMotion:
    """All robots under a plan's controls, over the whole horizon.

    Attributes:
        limits: ``(K, m)`` limits of the controls.
        sizes: ``(H, K, m)`` the quantities that they limit, before clipping: one norm, or two components.
        pace: ``(H, K)`` speed after each step [m/s].
        bend: ``(H, K)`` bound on the acceleration within each step, curvature included [m/s^2].
        integration_error: ``(H, K)`` bound on what RK4, one step at a time, may differ from this by [m].
    """

    def __init__(self, problem: Problem, controls: Floats) -> None:
        team, start = problem.team, np.asarray(problem.start, np.float64)
        self.dt, self.size = problem.dt, np.shape(problem.goal)[1]
        names = np.array(team.models)
        self._drives, self._unicycles = names == "differential_drive", names == "unicycle"
        self.wheeled = self._drives | self._unicycles
        # Integrated robots stand still as long as the equations are at work.
        integrated = ~np.isin(names, MODELS)
        self.first_order = integrated | self._unicycles | (names == "velocity2d")
        self._names = {robot: team.robot_models[robot].control_names for robot in np.flatnonzero(integrated).tolist()}
        self.max_speed, self.max_acceleration, self.max_turn_rate = (
            np.asarray(values, np.float64) for values in (team.max_speed, team.max_acceleration, team.max_turn_rate)
        )
        self._max_reverse_speed = np.asarray(team.own_limits.get("max_reverse_speed", self.max_speed), np.float64)
        models = list(enumerate(team.robot_models))
        self.trailer_robots = [robot for robot, model in models for _ in model.trailers]
        self.hitches = [float(team.limits[robot, column]) for robot, model in models for _, column in model.trailers]
        self.limits = self._limits()
        commands, self.sizes = self._clip(np.where(integrated[:, None], 0.0, controls[..., : self.size]))
        self._turn_rate = np.where(self.wheeled, np.where(self._drives, commands[..., 0], commands[..., 1]), 0.0)
        self._thrust = np.where(self._drives, commands[..., 1], 0.0)
        self._acceleration = np.where((self.wheeled | self.first_order)[:, None], 0.0, commands)
        self._set_velocities(start, commands)
        thrust, turn_rate = np.abs(self._thrust), np.abs(self._turn_rate)
        fastest = np.abs(self._speed) + thrust * self.dt
        sideways = fastest * turn_rate
        self.bend = norm(self._acceleration) + np.sqrt(thrust * thrust + sideways * sideways)
        # With constant controls RK4 is Simpson's rule, whose error is dt^5/2880 of the fourth derivative.
        angle = turn_rate * self.dt
        error = angle * angle * angle * (fastest * angle + 4 * thrust * self.dt) * self.dt / 2880
        self.groups = self._integrated(problem, start, controls)
        self._insert_groups(controls.shape[2], error)
        self.integration_error = np.cumsum(error, axis=0)

    def _integrated(self, problem: Problem, start: Floats, controls: Floats) -> list[Integrated]:
        models = {problem.team.models[robot]: problem.team.robot_models[robot] for robot in self._names}
        names = np.array(problem.team.models)
        return [
            Integrated(model, np.flatnonzero(names == name), start, controls, problem.team, problem.dt)
            for name, model in models.items()
        ]

    def _insert_groups(self, control_size: int, error: Floats) -> None:
        padding = control_size - self.size
        self.limits = np.pad(self.limits, ((0, 0), (0, padding)), constant_values=1.0)
        self.sizes = np.pad(self.sizes, ((0, 0), (0, 0), (0, padding)))
        for group in self.groups:
            columns = slice(group.limits.shape[1])
            self.limits[group.robots, columns] = group.limits
            self.sizes[:, group.robots, columns] = group.sizes
            self.pace[:, group.robots], self.bend[:, group.robots] = group.pace, group.bend
            error[:, group.robots] = group.step_error

    def _limits(self) -> Floats:
        limits = np.ones((len(self.wheeled), self.size))  # a column that limits nothing meets sizes of zero
        limits[:, 0] = np.where(self.first_order, self.max_speed, self.max_acceleration)
        limits[self._drives, 0], limits[self._drives, 1] = (
            most[self._drives] for most in (self.max_turn_rate, self.max_acceleration)
        )
        limits[self._unicycles, 1] = self.max_turn_rate[self._unicycles]
        return limits

    def limited_quantity(self, robot: int, column: int) -> str:
        """Return the quantity that a column of :attr:`limits` limits, with its unit."""
        if robot in self._names:
            return self._names[robot][column]
        if self.wheeled[robot]:
            turn, other = "turn rate [rad/s]", "acceleration [m/s^2]" if self._drives[robot] else "speed [m/s]"
            return turn if self._drives[robot] == (column == 0) else other
        return "speed [m/s]" if self.first_order[robot] else "acceleration [m/s^2]"

    def _clip(self, controls: Floats) -> tuple[Floats, Floats]:
        """``(H, K, d)`` controls within the limits, and the size of each limited quantity before."""
        sizes = np.abs(controls)
        # Scaled by the largest component, so that the square of a huge control does not overflow.
        largest = np.maximum(sizes.max(axis=2), np.finfo(float).tiny)
        norms = largest * norm(controls / largest[..., None])
        sizes[:, ~self.wheeled] = 0.0
        sizes[..., 0] = np.where(self.wheeled, sizes[..., 0], norms)
        scale = self.limits / np.maximum(sizes, self.limits)
        return controls * np.where(self.wheeled[:, None], scale, scale[..., :1]), sizes

    def _set_velocities(self, start: Floats, commands: Floats) -> None:
        """Velocity, heading and speed at the beginning of every step; the speed limit acts between steps."""
        dt, state = self.dt, np.zeros((len(start), max(4, 2 * self.size, start.shape[1])))
        state[:, : start.shape[1]] = start
        self._velocity = np.where((self.first_order & ~self.wheeled)[:, None], commands, 0.0)
        self._speed = np.where(self._unicycles, commands[..., 0], 0.0)
        self.pace = np.where(self.wheeled, np.abs(self._speed), np.minimum(norm(self._velocity), self.max_speed))
        slow = np.flatnonzero(~self.first_order)  # by inertia
        most, drives = self.max_speed[slow], self._drives[slow]
        reverse = np.minimum(self._max_reverse_speed[slow], most)
        velocity = np.where(drives[:, None], 0.0, state[slow, self.size : 2 * self.size])
        speed = np.where(drives, state[slow, 3], 0.0)
        for step in range(len(commands) if len(slow) else 0):
            self._velocity[step, slow], self._speed[step, slow] = velocity, speed
            velocity = velocity + self._acceleration[step, slow] * dt
            pace = norm(velocity)
            velocity = velocity * (most / np.maximum(pace, most))[:, None]
            speed = np.clip(speed + self._thrust[step, slow] * dt, -reverse, most)
            self.pace[step, slow] = np.where(drives, np.abs(speed), np.minimum(pace, most))
        heading = np.where(self.wheeled, state[:, 2], 0.0)
        self._heading = np.cumsum(np.concatenate([heading[None], self._turn_rate * dt]), axis=0)

    @property
    def moving(self) -> NDArray[np.bool_]:
        """``(H,)`` steps in which any robot moves, even if it ends a step as it began it."""
        parts = (self._velocity, self._acceleration, self._speed, self._thrust, self._turn_rate)
        moving: NDArray[np.bool_] = np.any([(part != 0).reshape(len(part), -1).any(axis=1) for part in parts], axis=0)
        for group in self.groups:
            moving |= group.moving.any(axis=1)
        return moving

    def displacement(self, steps: slice, sub_steps: int) -> Floats:
        """``(T, S+1, K, d)`` where the robots are at the ends of sub-steps, from where each step began [m]."""
        time = np.linspace(0.0, self.dt, sub_steps + 1)[:, None, None]
        displacement: Floats = self._velocity[steps, None] * time + self._acceleration[steps, None] * (time * time / 2)
        if self.wheeled.any():
            displacement[:, 1:, self.wheeled] = self._wheeled_displacement(steps, sub_steps)
        for group in self.groups:
            displacement[:, :, group.robots] = group.displacement(steps, sub_steps)
        return displacement

    def headings(self, steps: slice, sub_steps: int) -> Floats:
        """``(T, S+1, F)`` headings at the ends of sub-steps [rad], those of trailers last; zero without one."""
        time = np.linspace(0.0, self.dt, sub_steps + 1)[:, None]
        headings: Floats = self._heading[:-1][steps, None] + self._turn_rate[steps, None] * time
        return self._with_groups(headings, [group.headings(steps, sub_steps) for group in self.groups])

    @property
    def end_headings(self) -> Floats:
        """``(H, F)`` headings after each step [rad]."""
        return self._with_groups(self._heading[1:].copy(), [group.end_headings for group in self.groups])

    def _with_groups(self, headings: Floats, of_groups: list[Floats]) -> Floats:
        """``(..., F)`` headings ``(..., K)`` with those of the integrated robots ``(..., R, 1 + trailers)`` in."""
        trailers, robots = np.zeros((*headings.shape[:-1], len(self.trailer_robots))), np.array(self.trailer_robots)
        for group, own in zip(self.groups, of_groups, strict=True):
            headings[..., group.robots] = own[..., 0]
            for column, robot in enumerate(group.robots.tolist() if own.shape[-1] > 1 else ()):
                trailers[..., robots == robot] = own[..., column, 1:]
        return np.concatenate([headings, trailers], axis=-1)

    def _wheeled_displacement(self, steps: slice, sub_steps: int) -> Floats:
        """``(T, S, ., 2)`` the wheeled robots' part of :meth:`displacement`, but for its beginning."""
        turn_rate, thrust, speed, heading = (
            values[steps, self.wheeled] for values in (self._turn_rate, self._thrust, self._speed, self._heading[:-1])
        )
        half = self.dt / (2 * sub_steps)  # Simpson's rule asks for the middles of the sub-steps too
        sine, cosine = portable.sin_cos(heading)
        turn_sine, turn_cosine = portable.sin_cos(turn_rate * half)
        rates = []
        for node in range(2 * sub_steps + 1):
            pace = speed + thrust * (node * half)
            rates.append(np.stack([pace * cosine, pace * sine], axis=-1))
            cosine, sine = cosine * turn_cosine - sine * turn_sine, sine * turn_cosine + cosine * turn_sine
        rate = np.stack(rates, axis=1)
        six_means = rate[:, :-1:2] + 4 * rate[:, 1::2] + rate[:, 2::2]
        return np.cumsum(six_means, axis=1) * (half / 3)
