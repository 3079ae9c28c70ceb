"""The motion of a whole team as one nonlinear program, written for CasADi (paper, Eq. 1 and section IV-B).

M. Kelly, "An Introduction to Trajectory Optimization", SIAM Review, 2017.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import Floats, IntArray
from d4orm_env.core.lazy import LazyModule, load
from d4orm_env.core.problem import Problem
from d4orm_env.core.problem_arrays import inverse_initial_distance
from d4orm_env.core.team import DEFAULT_RADIUS
from d4orm_env.dynamics.collision import axis_gap
from d4orm_env.dynamics.robot_model import ACCELERATION, SPEED, Ops
from d4orm_env.dynamics.transition import TimeStep

casadi: Any = LazyModule("casadi", "planner 'ipopt'", "ipopt")
Expression: TypeAlias = Any  #: CasADi's matrices, symbolic or of numbers; the library carries no types
OBJECTIVE_SCALE = 10.0  #: Scale of the mean cost of a step, so that IPOPT's tolerance tells good motions from bad ones
TINY = 1e-9  #: Added to squared distances, since the square root has no derivative at zero, in the program's units
CERTAIN = 0.98  #: Share of the tolerance of a goal heading within which a robot faces it beyond doubt
Contacts = dict[tuple[int, int], NDArray[np.int64]]
"""Steps at which robot ``k`` is kept clear of body ``b``: robot ``b``, or from ``K`` on obstacle ``b - K``."""

Rows = tuple[Expression, float, float]  #: A matrix of expressions with their lower and their upper bound


class CollocatedMotion(NamedTuple):
    """Decision variables of the program."""

    states: Floats  #: ``(H+1, K, n)``, the start first
    controls: Floats  #: ``(H, K, m)``


class TeamProgram:
    """Direct collocation of a problem: the states and controls of all robots at all steps are variables.

    A control is held over its step, and the defect of a step is that of the environment's own RK4, so that a solution
    is what the engines roll out. Limits hold as in the engines: on a norm, or on single components.

    IPOPT's tolerances are absolute, so that it is given lengths in a unit in which robots have the default size. Every
    distance to keep is larger by ``clearance`` [m].
    """

    def __init__(self, problem: Problem, clearance: float) -> None:
        self.casadi = ca = load(casadi)
        self.problem, self.clearance = problem, clearance
        self.ops = Ops(ca.cos, ca.sin, ca.sqrt, ca.fmin, ca.fmax, ca.atan2, ca.if_else)
        self.models = problem.team.robot_models
        self.limits, self.radius = problem.team.limits.astype(float), np.asarray(problem.team.radius, float)
        self.obstacles = list(self._obstacles())
        steps = problem.horizon
        self.unit = problem.team.largest_radius / DEFAULT_RADIUS
        self.units = self._units()
        self.variables = [
            [ca.MX.sym(name, own[robot].size, steps) for robot in range(problem.num_robots)]
            for name, own in zip("xu", self.units)
        ]
        self.states, self.controls = (
            [ca.repmat(ca.DM(unit), 1, steps) * variable for unit, variable in zip(own, variables, strict=True)]
            for own, variables in zip(self.units, self.variables)
        )
        # Each robot's states with the start ahead of them, so that columns are steps.
        self.paths = [
            ca.horzcat(ca.DM(problem.start[robot, : model.state_size].astype(float)), self.states[robot])
            for robot, model in enumerate(self.models)
        ]

    def write(self, contacts: Contacts, arrivals: IntArray) -> tuple[dict[str, Expression], dict[str, Floats]]:
        """The program as CasADi takes it, with robots at their goals from steps ``arrivals`` ``(K,)`` on.

        Variables ``x``, cost ``f`` and constraints ``g``, each one column; and their bounds.
        """
        ca = self.casadi
        rows = [*self._motion_rows(), *self._goal_rows(arrivals), *self._contact_rows(contacts, arrivals)]
        sizes = [row.numel() for row, _, _ in rows]
        lower, upper = (np.repeat([row[bound] for row in rows], sizes) for bound in (1, 2))
        lowest, highest = self._variable_bounds()
        functions = {
            "x": ca.vertcat(*map(ca.vec, chain(*self.variables))),
            "f": self._cost(),
            "g": ca.vertcat(*(ca.vec(row) for row, _, _ in rows)),
        }
        return functions, {"lbx": lowest, "ubx": highest, "lbg": lower, "ubg": upper}

    def contacts(self, motion: CollocatedMotion, lookout: float | None) -> Contacts:
        """Find what comes within ``lookout`` [m] of the distance to keep, and when; everything always, for ``None``."""
        steps = np.arange(1, self.problem.horizon + 1)
        if lookout is None:
            return dict.fromkeys(self._encounters(), steps)
        states = motion.states[1:, :, : self.problem.dimension].transpose(1, 2, 0)
        points = [self.casadi.DM(own) for own in states]
        found = {}
        for robot, body in self._encounters():
            gap = self._gap(robot, body, points).full()  # NumPy's conversion turns a Ctrl-C into a SystemError
            near = steps[gap.ravel() < self._min_gap(robot, body) + lookout]
            if len(near):
                found[robot, body] = near
        return found

    def _encounters(self) -> Iterator[tuple[int, int]]:
        bodies = self.problem.num_robots + len(self.obstacles)
        return ((robot, body) for robot in range(self.problem.num_robots) for body in range(robot + 1, bodies))

    def _gap(self, robot: int, body: int, positions: Expression) -> Expression:
        """Distance from a robot's centre to another's, or to an obstacle's surface [m], per column."""
        if body >= self.problem.num_robots:
            return self.obstacles[body - self.problem.num_robots](positions[robot])
        return self._norm(positions[robot] - positions[body])

    def _units(self) -> tuple[list[Floats], list[Floats]]:
        """Return the units of every component of each robot's state and control: only lengths have one."""
        states, controls = [], []
        for model in self.models:
            lengths = [*range(model.dimension), *model.speed_indices]
            states.append(np.where(np.isin(range(model.state_size), lengths), self.unit, 1.0))
            controls.append(np.where(np.isin(model.control_limits, (SPEED, ACCELERATION)), self.unit, 1.0))
        return states, controls

    def _norm(self, vectors: Expression) -> Expression:
        """Norm of every column; nowhere without a derivative."""
        return self.casadi.sqrt(self.casadi.sum1(vectors**2) + TINY * self.unit**2)

    def _min_gap(self, robot: int, body: int | None = None) -> float:
        """Distance to keep from a robot's centre to another's, or to an obstacle's surface or the bounds [m].

        The margin holds at the steps only. Between them, on a chord of length ``L`` whose ends are at distance ``D``,
        a robot comes as near as ``sqrt(D^2 - L^2 / 4)``, which must not be contact.
        """
        robots = [robot] if body is None or body >= self.problem.num_robots else [robot, body]
        radius, chord = self.radius[robots].sum(), self.limits[robots, SPEED].sum() * self.problem.dt
        return float(max(radius + self.problem.margin, np.hypot(radius, chord / 2)) + self.clearance)

    def _obstacles(self) -> Iterator[Expression]:
        """Yield, per obstacle, the distance to its surface, negative inside, as a function of columns of points."""
        ca, world = self.casadi, self.problem.world
        dimension = world.dimension
        for centre, radius, axes in chain(
            ((ball[:-1], ball[-1], dimension) for ball in world.balls.astype(float)),
            ((cylinder[:2], cylinder[2], 2) for cylinder in world.cylinders.astype(float)),
        ):
            yield lambda p, c=centre, r=radius, n=axes: self._norm(p[:n, :] - ca.repmat(ca.DM(c), 1, p.shape[1])) - r
        for box in world.boxes.astype(float):
            yield lambda p, low=box[:dimension], high=box[dimension:]: self._box_gap(p, low, high)
        for corners in world.shapes.triangles.astype(float).reshape(-1, 3, 2):
            yield lambda p, corners=corners: self._triangle_gap(p, corners)

    def _triangle_gap(self, points: Expression, corners: Floats) -> Expression:
        ca = self.casadi
        deepest, nearest = [], []
        for begin, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            along, offset = end - begin, points - ca.repmat(ca.DM(begin), 1, points.shape[1])
            share = ca.fmin(ca.fmax((along[0] * offset[0, :] + along[1] * offset[1, :]) / (along @ along), 0.0), 1.0)
            nearest.append(self._norm(offset - ca.DM(along) @ share))
            deepest.append((along[1] * offset[0, :] - along[0] * offset[1, :]) / np.hypot(*along))
        depth = ca.fmax(ca.fmax(*deepest[:2]), deepest[2])
        return ca.if_else(depth < 0, depth, ca.fmin(ca.fmin(*nearest[:2]), nearest[2]))

    def _box_gap(self, points: Expression, lower: Floats, upper: Floats) -> Expression:
        ca = self.casadi
        rows = [points[axis, :] for axis in range(len(lower))]
        outside = [axis_gap(row, low, high, 0.0, self.ops) for row, low, high in zip(rows, lower, upper)]
        inside = [ca.fmax(low - row, row - high) for row, low, high in zip(rows, lower, upper)]
        depth = inside[0]
        for axis in inside[1:]:
            depth = ca.fmax(depth, axis)
        return self._norm(ca.vertcat(*outside)) + ca.fmin(depth, 0.0)

    def _cost(self) -> Expression:
        """The mean of distance over initial distance, smoothed within the goal radius."""
        problem, ca = self.problem, self.casadi
        weight = inverse_initial_distance(problem.start[:, : problem.dimension], problem.goal, problem.goal_radius)
        distances = (
            float(weight[robot]) * ca.sum2(ca.sqrt(self._squared_goal_distance(robot) + problem.goal_radius**2))
            for robot in range(problem.num_robots)
        )
        return OBJECTIVE_SCALE * sum(distances) / (problem.num_robots * problem.horizon)

    def _squared_goal_distance(self, robot: int) -> Expression:
        goal = self.casadi.DM(self.problem.goal[robot].astype(float))
        return self.casadi.sum1((self.states[robot][: self.problem.dimension, :] - goal) ** 2)

    def _motion_rows(self) -> Iterator[Rows]:
        """The dynamics, and the limits on norms."""
        ca = self.casadi
        step = TimeStep(*(self.problem.dt / part for part in (1, 2, 3, 6)))
        for robot, model in enumerate(self.models):
            x, u = ca.SX.sym("x", model.state_size), ca.SX.sym("u", model.control_size)
            limits = self.limits[robot].tolist()
            after = model.functions.integrate(ca.vertsplit(x), ca.vertsplit(u), limits, step, self.ops)
            advance = ca.Function("advance", [x, u], [ca.vertcat(*after)]).map(self.problem.horizon)
            defect = self.states[robot] - advance(self.paths[robot][:, :-1], self.controls[robot])
            yield defect / ca.repmat(ca.DM(self.units[0][robot]), 1, self.problem.horizon), 0.0, 0.0
            for values, components, _, limit in self._limited(robot):
                if len(components) > 1:  # of a velocity or an acceleration
                    yield ca.sum1((values[components, :] / self.unit) ** 2), -np.inf, (limit / self.unit) ** 2

    def _limited(self, robot: int) -> Iterator[tuple[Expression, list[int], float, float]]:
        """Variables, the components of theirs that share a limit, the lowest value of each, and the limit."""
        model, limits = self.models[robot], self.limits[robot]
        lower = model.lower_bounds(limits)
        for column, components in model.limited_components.items():
            yield self.states[robot], components, -float(lower[column]), float(limits[column])
        for column in dict.fromkeys(model.control_limits):
            components = [index for index, own in enumerate(model.control_limits) if own == column]
            yield self.controls[robot], components, -float(lower[column]), float(limits[column])

    def _goal_rows(self, arrivals: IntArray) -> Iterator[Rows]:
        """At its arrival a robot is within the goal radius, at most at its goal speed, and faces as it is to."""
        problem = self.problem
        radius = problem.goal_radius - min(self.clearance, problem.goal_radius / 2)
        for robot, arrival in enumerate(arrivals):
            yield self._squared_goal_distance(robot)[arrival - 1] / self.unit**2, -np.inf, (radius / self.unit) ** 2
            if np.isfinite(problem.goal_speed[robot]):
                variables = self.states[robot][:, arrival - 1], self.controls[robot][:, arrival - 1]
                x, u = map(self.casadi.vertsplit, variables)
                limits = self.limits[robot].tolist()
                velocity = self.models[robot].functions.velocity(x, u, limits, self.ops)
                pace = sum((part / self.unit) ** 2 for part in velocity)
                yield pace, -np.inf, (float(problem.goal_speed[robot]) / self.unit) ** 2
            yield from self._facing_rows(robot, self.states[robot][:, arrival - 1])

    def _facing_rows(self, robot: int, state: Expression) -> Iterator[Rows]:
        """In this state a robot has its goal heading, and its trailers their hitch angles, as far as they are given."""
        problem, tolerance = self.problem, CERTAIN * float(self.problem.goal_heading_tolerance[robot])
        if not np.isnan(wanted := float(problem.goal_heading[robot])):
            off = state[self.models[robot].heading_index] - wanted
            yield (1 - self.casadi.cos(off)) / (1 - np.cos(tolerance)), -np.inf, 1.0
        for (hitch, _), angle in zip(self.models[robot].trailers, problem.goal_hitches[robot].tolist()):
            if not np.isnan(angle):
                yield (state[hitch] - angle) / tolerance, -1.0, 1.0

    def _contact_rows(self, contacts: Contacts, arrivals: IntArray) -> Iterator[Rows]:
        for (robot, body), steps in contacts.items():
            pair = [robot] if body >= self.problem.num_robots else [robot, body]
            # Once both have arrived nothing changes any more.
            moving = steps[steps <= arrivals[pair].max()]
            if len(moving):
                positions = {
                    one: self.paths[one][: self.problem.dimension, np.minimum(moving, arrivals[one]).tolist()]
                    for one in pair
                }
                yield self._gap(robot, body, positions) / self.unit, self._min_gap(robot, body) / self.unit, np.inf

    def _variable_bounds(self) -> tuple[Floats, Floats]:
        """Bounds of the world on positions, and limits of every single component."""
        problem = self.problem
        states = np.full((problem.horizon + 1, problem.num_robots, problem.state_size), np.inf)
        controls = np.full((problem.horizon, problem.num_robots, problem.control_size), np.inf)
        low, high = CollocatedMotion(-states, -controls), CollocatedMotion(states, controls)
        for robot in range(problem.num_robots):
            for values, components, least, most in self._limited(robot):
                for motion, end in ((low, least), (high, most)):
                    (motion.states if values is self.states[robot] else motion.controls)[:, robot, components] = end
        distances = np.array([[self._min_gap(robot)] for robot in range(problem.num_robots)])
        low.states[:, :, : problem.dimension] = problem.world.bounds[0] + distances
        high.states[:, :, : problem.dimension] = problem.world.bounds[1] - distances
        return self.packed(low), self.packed(high)

    def packed(self, motion: CollocatedMotion) -> Floats:
        """The values of the variables, in the order of the program."""
        states = [motion.states[1:, robot, : unit.size] / unit for robot, unit in enumerate(self.units[0])]
        controls = [motion.controls[:, robot, : unit.size] / unit for robot, unit in enumerate(self.units[1])]
        return np.concatenate([part.ravel() for part in (*states, *controls)])

    def unpacked(self, values: Floats) -> CollocatedMotion:
        """The motion that these values of the variables are."""
        problem = self.problem
        states = np.zeros((problem.horizon + 1, problem.num_robots, problem.state_size))
        states[0] = problem.start
        controls = np.zeros((problem.horizon, problem.num_robots, problem.control_size))
        sizes = [variable.numel() for variable in chain(*self.variables)]
        parts = np.split(values, np.cumsum(sizes)[:-1])
        for values_of, units, first in zip((states[1:], controls), self.units, (0, problem.num_robots)):
            for robot, unit in enumerate(units):
                values_of[:, robot, : unit.size] = unit * parts[first + robot].reshape(problem.horizon, -1)
        return CollocatedMotion(states, controls)
