"""Tracking a velocity, and driving straight to a point as if alone: one law for every model."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, TypeAlias, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from d4orm_env.core.arrays import BoolArray, FloatArray, Floats
from d4orm_env.core.lazy import LazyModule
from d4orm_env.core.portable import NUMPY_OPS
from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.dynamics.models import MODELS
from d4orm_env.dynamics.robot_model import OWN_LIMITS, STANDARD_LIMITS, UNLIMITED, Model, ModelFunctions
from d4orm_env.dynamics.transition import TimeStep
from d4orm_env.paths.shortest_paths import along_paths

Rows = TypeVar("Rows", FloatArray, Floats)
Columns: TypeAlias = tuple[FloatArray, ...]  #: Components of the states, velocities, controls or limits of some robots

if TYPE_CHECKING:
    from d4orm_env.engine import threads as thread_counts
    from d4orm_planners.tracking import tracker as drive_kernels
else:
    thread_counts = LazyModule("d4orm_env.engine.threads")
    drive_kernels = LazyModule("d4orm_planners.tracking.tracker")

CREEPING = np.float32(2.0**-20)  #: Share of its speed with which a robot at its goal turns to its heading
NEAR_VIA = 10 / 3  #: Distance to a point on its way at which a robot turns to its goal, in radii of the largest robot


def preferred_velocities(problem: Problem, states: FloatArray, goals: FloatArray) -> FloatArray:
    """``(K, d)`` velocities straight to goals ``(K, d)`` [m], from which robots in ``states`` ``(K, n)`` can still stop
    there [m/s]. At its goal a robot turns to its goal heading.
    """
    h = TimeStep(*problem.arrays.time_step)
    wanted = _by_rows(
        problem, goals.shape[1], (states, goals), lambda model, *rows: model.approach(*rows, h, NUMPY_OPS)
    )
    directions = problem.arrays.goal_direction
    if directions is None:
        return wanted
    offset = goals - states[:, : problem.dimension]
    turning = ~np.isnan(problem.goal_heading) & ((offset * offset).sum(axis=1) <= problem.arrays.squared_goal_radius)
    turning &= problem.team.turning_radius == 0
    creep = problem.team.max_speed[:, None] * CREEPING * directions[:, :2]
    return np.where(turning[:, None], creep, wanted)


def goals_along_paths(problem: Problem, positions: FloatArray | Floats, goals: FloatArray) -> FloatArray:
    """``(K, d)`` aims from ``positions`` ``(K, d)`` along the shortest paths, as far off as these are long [m].

    They are the present ``goals`` ``(K, d)`` where the world is empty, for robots with other goals than the problem's,
    to which the paths lead, and for those without a path.
    """
    if not problem.world.num_obstacles:
        return goals
    direction, length = problem.shortest_paths.ahead(positions)
    first = (goals == problem.goal).all(axis=1)
    ahead, known = along_paths(direction, np.where(first, length, np.inf))
    return np.where(known[:, None], positions + ahead, goals).astype(np.float32)


def track_velocities(problem: Problem, states: FloatArray, velocities: FloatArray) -> FloatArray:
    """``(K, m)`` controls inside each robot's limits that bring the team from ``states`` ``(K, n)`` to ``velocities``
    ``(K, d)`` [m/s] as soon as they allow.
    """
    h = TimeStep(*problem.arrays.time_step)

    def law(model: ModelFunctions, x: Columns, velocity: Columns, limits: Columns) -> Columns:
        return model.limit_control(model.track(x, velocity, limits, h, NUMPY_OPS), limits, NUMPY_OPS)

    controls = _by_rows(problem, problem.control_size, (states, velocities), law)
    # The norm may come out above the limit by a rounding error.
    return np.clip(controls, *problem.team.control_bounds)


def limited_states(problem: Problem, states: FloatArray) -> FloatArray:
    """``(..., K, n)`` states within the robots' limits."""
    return _by_rows(
        problem, problem.state_size, (states,), lambda model, x, limits: model.limit_state(x, limits, NUMPY_OPS)
    )


def advanced(problem: Problem, states: FloatArray, controls: FloatArray) -> FloatArray:
    """``(..., K, n)`` states a step later, of robots that do not dock, under controls ``(..., K, m)`` in the limits."""
    return limited_states(problem, integrated(problem, states, controls))


def integrated(problem: Problem, states: FloatArray, controls: FloatArray) -> FloatArray:
    """``(..., K, n)`` states a time step later if neither these nor the controls ``(..., K, m)`` had limits."""
    h = TimeStep(*problem.arrays.time_step)

    def law(model: ModelFunctions, x: Columns, u: Columns, limits: Columns) -> Columns:
        moved: Columns = model.integrate(x, u, limits, h, NUMPY_OPS)
        return moved

    return _by_rows(problem, problem.state_size, (states, controls), law)


def weaker(team: Team, share: ArrayLike, control_share: Floats | None = None) -> Team:
    """The team with a share, one or ``(K,)``, of its limits of speed, acceleration and turn rate, either way; of those
    that bound its controls, whatever they are, a share ``(K, m)`` of their own where it is given.
    """
    factors, own = np.ones_like(team.limits), {name: values.copy() for name, values in team.own_limits.items()}
    factors[:, :OWN_LIMITS] = np.reshape(share, (-1, 1))
    for robot, model in enumerate(team.robot_models):
        if control_share is not None:
            factors[robot, list(model.control_limits)] = control_share[robot, : model.control_size]
        for column, backwards in model.lower_limits:
            factors[robot, backwards] = factors[robot, column]
        for column, limit in enumerate(model.own_limits, OWN_LIMITS):
            own[limit.name][robot] = min(own[limit.name][robot] * factors[robot, column], UNLIMITED)
    standard = {name: getattr(team, name) * factors[:, column] for column, name in enumerate(STANDARD_LIMITS)}
    return team.replace(own_limits=own, **standard)


def limit_controls(problem: Problem, controls: FloatArray) -> FloatArray:
    """Return finite controls ``(K, m)`` as a step executes them: inside each robot's own limits, zero on padding."""
    limited = np.zeros_like(controls)
    for model, robots in by_model(problem):
        limits = tuple(problem.team.limits[robots].T)
        before, after = None, controls[robots, : model.control_size].T
        # Scaling may leave a control a rounding above its limit, and the step would scale it again.
        while before is None or before.tobytes() != after.tobytes():
            before, after = after, np.stack(model.functions.limit_control(tuple(after), limits, NUMPY_OPS))
        limited[robots, : model.control_size] = after.T
    return limited


def present_velocities(problem: Problem, states: FloatArray, controls: FloatArray) -> FloatArray:
    """``(K, d)`` velocities [m/s] in ``states`` ``(K, n)``; of a first-order robot that of its last ``controls``."""
    return _by_rows(
        problem, problem.dimension, (states, controls), lambda model, *rows: model.velocity(*rows, NUMPY_OPS)
    )


def rates(problem: Problem, states: FloatArray, controls: FloatArray) -> FloatArray:
    """``(K, n)`` time derivatives of ``states`` ``(K, n)`` under ``controls`` ``(K, m)``."""
    return _by_rows(
        problem, problem.state_size, (states, controls), lambda model, *rows: model.derivative(*rows, NUMPY_OPS)
    )


def _by_rows(problem: Problem, width: int, rows: tuple[FloatArray, ...], law: Callable[..., Columns]) -> FloatArray:
    """``(..., K, width)`` results of ``law(functions, *rows, limits)`` for all robots' rows ``(..., K, n)``."""
    results = np.zeros((*rows[0].shape[:-1], width), np.float32)
    for model, robots in by_model(problem):
        columns = (tuple(np.moveaxis(part[..., robots, :], -1, 0)) for part in (*rows, problem.team.limits))
        result = np.stack(law(model.functions, *columns), axis=-1)
        results[..., robots, : result.shape[-1]] = result
    return results


def must_brake(problem: Problem, states: FloatArray, controls: FloatArray, goals: FloatArray) -> BoolArray:
    """``(K,)`` robots with a goal speed that are so near to their goals ``(K, d)`` that they must brake now.

    ``controls`` ``(K, m)`` are those executed last.
    """
    speed = np.linalg.norm(present_velocities(problem, states, controls), axis=1)
    gap = np.linalg.norm(goals - states[:, : problem.dimension], axis=1) - problem.goal_radius
    braking = speed * (speed / (2 * problem.team.max_acceleration) + np.float32(problem.dt))
    return np.isfinite(problem.goal_speed) & (gap <= braking)


def braking_share(problem: Problem, velocities: Floats, accelerations: Floats) -> float:
    """Share of its pace that a team on its way can give up in a step, so that no robot need brake harder than it can.

    At full pace it has ``velocities`` [m/s] and ``accelerations`` [m/s^2] ``(K, d)``. Where a robot brakes anyway it
    is down to half of that. Models without inertia stop at once.
    """
    team, inertia = problem.team, [not model.first_order for model in problem.team.robot_models]
    speeds, can = np.linalg.norm(velocities, axis=1), team.max_acceleration * problem.dt
    along = (velocities * accelerations).sum(axis=1) / np.maximum(speeds, np.finfo(float).tiny)
    brakes = np.clip(-along / team.max_acceleration, 0.0, 1.0)[inertia]
    shares = (can / np.maximum(speeds, can))[inertia]
    return float(min(shares, default=1.0) * (1 - max(brakes, default=0.0) / 2))


def short_way_round(problem: Problem, differences: Rows) -> Rows:
    """Differences ``(K, n)`` of states, of headings the short way round; changed in place."""
    for model, robots in by_model(problem):
        if model.heading_index is not None:
            angle = differences[robots, model.heading_index]
            differences[robots, model.heading_index] = (angle + np.pi) % (2 * np.pi) - np.pi
    return differences


def by_model(problem: Problem) -> Iterator[tuple[Model, list[int]]]:
    """The models of the team, each with its robots."""
    for name, robots in _robots_by_name(problem.team.models):
        yield MODELS[name], list(robots)


@lru_cache(maxsize=64)
def _robots_by_name(models: tuple[str, ...]) -> tuple[tuple[str, tuple[int, ...]], ...]:
    own = {name: tuple(k for k, model in enumerate(models) if model == name) for name in dict.fromkeys(models)}
    return tuple(own.items())


@dataclass(frozen=True)
class Rollouts:
    """Paths of robots that each drive alone: ``R`` robots, ``V`` paths each."""

    controls: FloatArray  #: ``(H, R, V, m)``, zero after arrival
    states: FloatArray  #: ``(H+1, R, V, n)``
    arrived: BoolArray  #: ``(R, V)`` bool
    dimension: int  #: ``d``

    @property
    def positions(self) -> FloatArray:
        """``(H+1, R, V, d)`` [m]."""
        return self.states[..., : self.dimension]


def drives(
    problem: Problem, states: FloatArray, controls: FloatArray, switch_times: ArrayLike, vias: ArrayLike | None = None
) -> Rollouts:
    """Follow the controls up to a time, and from there drive straight from point to point and on to the goal.

    At :data:`NEAR_VIA` from a point a robot turns to the next one.

    Args:
        problem: The robots.
        states: ``(H+1, R, n)`` their states under ``controls``.
        controls: ``(H, R, m)`` as executed: clipped, zero after arrival.
        switch_times: ``(R, V)`` time steps.
        vias: ``(R, V, P, d)`` the points [m]; none by default.
    """
    switch, dimension = np.asarray(switch_times, np.int64), problem.dimension
    points = np.empty((*switch.shape, 0, dimension), np.float32) if vias is None else np.asarray(vias, np.float32)
    u, x = (np.repeat(rows.swapaxes(0, 1)[:, None], switch.shape[1], axis=1) for rows in (controls, states))
    u, x, arrived = u.astype(np.float32, copy=False), x.astype(np.float32, copy=False), np.zeros(switch.shape, bool)
    near = NEAR_VIA * problem.team.largest_radius
    rest = switch, np.ascontiguousarray(points), np.float32(near * near), u, x, arrived
    threads = thread_counts.Threads(thread_counts.available_cores())
    for model, robots in by_model(problem):
        kernel, index = drive_kernels.straight_kernel(model.name), np.array(robots)
        threads.over(len(index), lambda part: kernel(problem.arrays, index[part[0] : part[1]], *rest))  # noqa: B023
    return Rollouts(np.moveaxis(u, 2, 0), np.moveaxis(x, 2, 0), arrived, dimension)


def prepare_drives(problem: Problem) -> None:
    """Compile what drives of this team need, if it is not yet."""
    if not all(drive_kernels.straight_kernel(name).signatures for name in set(problem.team.models)):
        straight_drives(problem)


def straight_drives(problem: Problem) -> Rollouts:
    """Drive from the start straight to the goal: a single path for every robot."""
    return drives(problem, *at_rest(problem), np.zeros((problem.num_robots, 1), int))


def at_rest(problem: Problem) -> tuple[FloatArray, FloatArray]:
    """States ``(H+1, K, n)`` and controls ``(H, K, m)`` of robots that stay where they start."""
    states = np.repeat(np.asarray(problem.start)[None], problem.horizon + 1, axis=0)
    return states, np.zeros((problem.horizon, problem.num_robots, problem.control_size), np.float32)
