"""Smooth curves of robots on wheels, which roll along their headings and never slip sideways.

A robot's way along its heading is a quintic spline of time. So is the heading, or, where a robot does not turn on the
spot, the curvature of its way. What they lead to is fitted to a plan with the motion within each step as an equality
constraint (direct collocation: J. T. Betts, Practical Methods for Optimal Control and Estimation Using Nonlinear
Programming, 2010, chapter 4), by sequential quadratic programming.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.interpolate import BSpline
from scipy.sparse import block_array, block_diag, csc_array, diags_array
from scipy.sparse.linalg import splu

from d4orm_env.core.arrays import Floats, IntArray
from d4orm_env.core.problem import Problem
from d4orm_env.dynamics.robot_model import PYTHON_OPS, Model
from d4orm_planners.tracking.splines import DEGREE, Steps, quadrature, through

MAX_ITERATIONS = 30
FRESH = 2  #: Iterations whose slopes are found anew; later ones keep them as long as no coefficients are newly held
SETTLED = 1e-5  #: Largest change of a pose in the last iteration, as a share of the radius
END_WEIGHT = 1e6  #: Weight of the squared distance from the plan at the end, against that at any other step
STEERING_WEIGHT = 0.1  #: Weight of the squared distance from the plan's curvature, of the largest, times the radius
BOUND_WEIGHT = 1e9  #: Weight of coefficients that are held at the largest curvature
WITHIN = 1 - 1e-3  #: Share of the largest curvature that is used
STANDING = 1e-3  #: Way in a step below which a robot counts as standing, in radii
FINER = 8  #: Knots in a step of the splines that poses become


class Wheeled(NamedTuple):
    """``R`` robots on wheels, which all turn on the spot or all do not."""

    poses: Floats  #: ``(R, N+1, 3)`` the plan's positions [m] and headings [rad]
    speed: Floats  #: ``(R,)`` along their headings at the start [m/s]
    radius: Floats  #: ``(R,)`` [m]
    curvature: Floats  #: ``(R,)`` largest that they steer [1/m]; infinite where they turn on the spot
    steered: Floats  #: ``(R,)`` the curvature that they steer at the start [1/m]; NaN where it may be any

    @property
    def steers(self) -> bool:
        """True if they do not turn on the spot."""
        return bool(np.isfinite(self.curvature[0]))


def groups_on_wheels(problem: Problem) -> list[list[int]]:
    """The robots that roll along their headings: those that turn on the spot, and those that do not."""
    groups: dict[bool, list[int]] = {}
    for robot, model in enumerate(problem.team.robot_models):
        if _rolls(model):
            groups.setdefault(model.turns_in_place, []).append(robot)
    return list(groups.values())


def _rolls(model: Model) -> bool:
    """Return True if the model has a heading, and no velocity across it."""
    if model.heading_index is None:
        return False
    state, heading = [0.5] * model.state_size, 0.3
    state[model.heading_index] = heading
    controls, limits = [0.4, 0.3, 0.2][: model.control_size], [1.0] * len(model.limit_names)
    x, y = model.functions.velocity(state, controls, limits, PYTHON_OPS)
    return abs(y * math.cos(heading) - x * math.sin(heading)) < SETTLED


def on_wheels(problem: Problem, robots: list[int], poses: Floats, velocity: Floats) -> Wheeled:
    """Some robots of a team, from poses ``(N+1, K, 3)`` and velocities at the start ``(K, 2)`` [m/s]."""
    team, heading = problem.team, poses[0, robots, 2]
    speed = velocity[robots, 0] * np.cos(heading) + velocity[robots, 1] * np.sin(heading)
    turning_radius = team.turning_radius[robots].astype(np.float64)
    curvature = np.divide(1, turning_radius, out=np.full(len(robots), np.inf), where=turning_radius > 0)
    steered = np.array([_steered(problem, robot) for robot in robots])
    radius = team.radius[robots].astype(np.float64)
    return Wheeled(np.moveaxis(poses[:, robots], 1, 0), speed, radius, curvature, steered)


def _steered(problem: Problem, robot: int) -> float:
    """The curvature that a robot steers at the start [1/m]; NaN where it may be any."""
    model = problem.team.robot_models[robot]
    if model.first_order or model.turns_in_place:
        return np.nan
    state = problem.start[robot, : model.state_size].astype(np.float64)
    state[list(model.speed_indices)] = 1.0
    limits, nothing = problem.team.limits[robot].tolist(), (0.0,) * model.control_size
    rate: float = model.functions.derivative(tuple(state.tolist()), nothing, limits, PYTHON_OPS)[model.heading_index]
    return rate


def finer(spline: BSpline, steps: int) -> BSpline:
    """The same spline over so many steps, from its velocity to rest, with as many knots as those that roll have."""
    times = np.linspace(0, spline.t[-1], steps * FINER + 1)
    return through(times, spline(times), spline(0.0, 1), spline(0.0, 2))


def roll(robots: Wheeled, dt: float, smoothness: float) -> tuple[BSpline, BSpline]:
    """Splines of their positions [m] and headings [rad], ``(R, 3)``, from their speed to rest, and curvatures ``(R,)``.

    The curvatures [1/m] are those steered, also at rest; zero for robots that turn on the spot. Poses are ``dt``
    [s] apart; ``smoothness`` weights squared third differences of coefficients, of ways, and of turns times the radius.
    """
    count = len(robots.poses)
    grid = Steps(robots.poses.shape[1] - 1, dt, count)
    parts = (part.reshape(count, grid.size).T for part in _fit(grid, robots, smoothness))
    way, turn = (BSpline(grid.knots, part, DEGREE) for part in parts)
    return _poses(grid, robots, way, turn), BSpline(grid.knots, turn.c * robots.steers, DEGREE)


def _fit(grid: Steps, robots: Wheeled, smoothness: float) -> tuple[Floats, Floats]:
    """``(R C,)`` coefficients of ways and of turns."""
    size, (quadratic, linear) = grid.roughness.shape[0], _objective(grid, robots, smoothness)
    (expand, offset), values = _free(grid, robots), _guess(grid, robots, smoothness)
    held, bounds = np.zeros((2, len(linear)))
    turns, most = slice(size, 2 * size), np.repeat(WITHIN * robots.curvature, grid.size)
    order, fresh = _by_time(grid, len(robots.poses), expand), FRESH
    back = np.argsort(order)[: expand.shape[1]]
    for number in range(MAX_ITERATIONS):
        form, (missed, slopes) = quadratic + diags_array(held), _constraints(grid, robots, values)
        if number < fresh:
            used, free = slopes, slopes @ expand
            system = csc_array(block_array([[expand.T @ form @ expand, free.T], [free, None]]))
            solver = splu(system[order][:, order], permc_spec="NATURAL")
        sides = expand.T @ (linear + held * bounds - form @ offset), used @ (values - offset) - missed
        found = offset + expand @ solver.solve(np.concatenate(sides)[order])[back]
        change, values = np.abs(found - values)[turns.stop :].max(), found
        before, beyond = held, np.abs(values[turns]) > most
        held, bounds[turns] = np.zeros(len(linear)), np.where(beyond, np.copysign(most, values[turns]), 0)
        held[turns][beyond] = BOUND_WEIGHT
        if (held != before).any():
            fresh = number + 2
        elif change < SETTLED * robots.radius.min():
            break
    return values[:size], values[turns].clip(-most, most)


def _objective(grid: Steps, robots: Wheeled, smoothness: float) -> tuple[csc_array, Floats]:
    """Roughness and the squared distance from the plan: ``values @ quadratic @ values - 2 * linear @ values``."""
    weights, count = np.ones(robots.poses.shape[:2]), len(grid.times)
    weights[:, -1] = END_WEIGHT
    turned, near = weights * robots.radius[:, None] ** 2, diags_array(weights.ravel())
    scale = robots.radius / robots.curvature if robots.steers else robots.radius
    turn, wanted = (
        smoothness * diags_array(np.repeat(scale**2, grid.size)) @ grid.roughness,
        np.zeros(len(scale) * grid.size),
    )
    if robots.steers:
        data = diags_array(np.repeat(STEERING_WEIGHT * scale**2, count)) @ grid.at_steps
        turn, wanted = turn + grid.at_steps.T @ data, data.T @ _curvatures(robots).ravel()
    x, y, heading = np.moveaxis(robots.poses, 2, 0)
    linear = np.zeros(len(wanted)), wanted, *(part.ravel() for part in (weights * x, weights * y, turned * heading))
    forms = smoothness * grid.roughness, turn, near, near, diags_array(turned.ravel())
    return csc_array(block_diag(forms)), np.concatenate(linear)


def _ways(robots: Wheeled) -> Floats:
    """``(R, N+1)`` ways along headings until each step, but for what chords are shorter [m]."""
    middle, moved = (robots.poses[:, 1:, 2] + robots.poses[:, :-1, 2]) / 2, np.diff(robots.poses[..., :2], axis=1)
    ways = np.cumsum(moved[..., 0] * np.cos(middle) + moved[..., 1] * np.sin(middle), axis=1)
    return np.pad(ways, ((0, 0), (1, 0)))


def _curvatures(robots: Wheeled) -> Floats:
    """``(R, N+1)`` curvatures of the plan from each step on [1/m]; while a robot stands, from the last to the next."""
    moved, turned = np.diff(_ways(robots), axis=1), np.diff(robots.poses[..., 2], axis=1)
    curvatures, steps = np.zeros(robots.poses.shape[:2]), np.arange(robots.poses.shape[1])
    for robot, most in enumerate(robots.curvature):
        moving = np.flatnonzero(np.abs(moved[robot]) > STANDING * robots.radius[robot])
        if len(moving):
            known = turned[robot, moving] / moved[robot, moving]
            curvatures[robot] = np.interp(steps, moving, known.clip(-most, most))
    return curvatures


def _guess(grid: Steps, robots: Wheeled, smoothness: float) -> Floats:
    """Values near those that are sought, which need not keep to the constraints."""
    turns = _curvatures(robots) if robots.steers else robots.poses[..., 2]
    smooth = splu(csc_array(grid.at_steps.T @ grid.at_steps + smoothness * grid.roughness))
    coefficients = [smooth.solve(grid.at_steps.T @ rows.ravel()) for rows in (_ways(robots), turns)]
    return np.concatenate([*coefficients, *(part.ravel() for part in np.moveaxis(robots.poses, 2, 0))])


def _free(grid: Steps, robots: Wheeled) -> tuple[csc_array, Floats]:
    """Matrix from free variables to values, and the values without them, which the ends of curves fix."""
    robot, count, size = np.arange(len(robots.poses)), len(grid.times), grid.size
    ways, turns = robot[:, None] * size, (len(robot) + robot[:, None]) * size
    offset = np.zeros(len(robot) * (2 * size + 3 * count))
    fixed, source = np.zeros(len(offset), bool), np.arange(len(offset))
    fixed[ways + np.arange(3)] = True
    offset[ways + np.arange(3)] = robots.speed[:, None] * grid.dt / DEGREE * np.array([0, 1, 3])
    # At rest at the end, wherever that is.
    source[ways + size - np.arange(1, 4)] = ways + size - 4
    known = np.flatnonzero(~np.isnan(robots.steered))
    fixed[turns[known, 0]], offset[turns[known, 0]] = True, robots.steered[known]
    if not robots.steers:
        for ends, step in ((np.arange(3), 0), (np.arange(size - 4, size), -1)):
            fixed[turns + ends], offset[turns + ends] = True, robots.poses[:, step, 2, None]
    begin = len(robot) * (2 * size + np.arange(3) * count) + robot[:, None] * count
    fixed[begin], offset[begin] = True, robots.poses[:, 0]
    number = np.cumsum(~fixed & (source == np.arange(len(source)))) - 1
    rows = np.flatnonzero(~fixed)
    return csc_array((np.ones(len(rows)), (rows, number[source[rows]])), shape=(len(offset), number[-1] + 1)), offset


def _by_time(grid: Steps, count: int, expand: csc_array) -> IntArray:
    """The order of free variables and constraints by robots and steps, in which systems are banded."""
    robot, steps = np.arange(count)[:, None] * 2 * grid.size, np.arange(grid.size)
    splines, poses, changes = robot + steps - DEGREE // 2, robot + steps[: len(grid.times)], robot + steps[: grid.steps]
    times = np.concatenate([part.ravel() for part in (splines, splines, poses, poses, poses)])
    first = np.full(expand.shape[1], np.inf)
    np.minimum.at(first, expand.tocoo().coords[1], times[expand.tocoo().coords[0]])
    return np.argsort(np.concatenate([first, np.tile(changes.ravel() + 0.5, 3)]), kind="stable")


def _constraints(grid: Steps, robots: Wheeled, values: Floats) -> tuple[Floats, csc_array]:
    """Errors of the changes of poses within steps from those that ways and turns lead to, and their slopes."""
    count, size = len(robots.poses) * len(grid.times), len(robots.poses) * grid.size
    way, turn, x, y, heading = np.split(values, [size, 2 * size, 2 * size + count, 2 * size + 2 * count])
    pace, turned = grid.slope @ way, grid.value @ turn
    if robots.steers:
        rates = diags_array(turned) @ grid.slope, diags_array(pace) @ grid.value
        now = grid.begin @ heading + grid.until @ (turned * pace)
        now_by = [*(grid.until @ rate for rate in rates), grid.begin]
        changed, changed_by = grid.over @ (turned * pace), [grid.over @ rate for rate in rates]
    else:
        now, now_by = turned, [csc_array(grid.slope.shape), grid.value, csc_array(grid.begin.shape)]
        ends = grid.change @ grid.at_steps
        changed, changed_by = ends @ turn, [csc_array(ends.shape), ends]
    missed, rows = [], []
    for number, (part, ahead, aside) in enumerate(((x, np.cos(now), -np.sin(now)), (y, np.sin(now), np.cos(now)))):
        across, along = grid.over @ diags_array(pace * aside), grid.over @ diags_array(ahead) @ grid.slope
        by_way, by_turn, by_heading = (across @ own for own in now_by)
        places = [None, None]
        places[number] = grid.change
        rows.append([-along - by_way, -by_turn, *places, -by_heading])
        missed.append(grid.change @ part - grid.over @ (pace * ahead))
    rows.append([*(-own for own in changed_by), None, None, grid.change])
    return np.concatenate([*missed, grid.change @ heading - changed]), csc_array(block_array(rows))


def _poses(grid: Steps, robots: Wheeled, way: BSpline, turn: BSpline) -> BSpline:
    """Splines of the poses that ways and turns lead to."""
    fine = np.linspace(0, grid.times[-1], grid.steps * FINER + 1)
    points, weights, until = quadrature(fine[1])
    times, start = fine[:-1, None] + points, robots.poses[:, 0]
    pace, turning, poses = way(times, 1), turn(times), np.tile(start, (len(fine), 1, 1))
    # First and second derivatives at the start; the curves end at rest.
    begin = np.zeros((2, *start.shape))
    if robots.steers:
        rate = turning * pace
        poses[1:, :, 2] += np.cumsum(np.einsum("g,tgr->tr", weights, rate), axis=0)
        heading = poses[:-1, None, :, 2] + np.einsum("gh,thr->tgr", until, rate)
        begin[..., 2] = turn(0.0) * robots.speed, turn(0.0, 1) * robots.speed
    else:
        heading, poses[..., 2] = turning, turn(fine)
    for axis, direction in enumerate((np.cos, np.sin)):
        poses[1:, :, axis] += np.cumsum(np.einsum("g,tgr->tr", weights, pace * direction(heading)), axis=0)
        begin[0, :, axis] = robots.speed * direction(start[:, 2])
    begin[1, :, :2] = begin[0, :, 2, None] * np.column_stack([-begin[0, :, 1], begin[0, :, 0]])
    return through(fine, poses, *begin)
