"""Numbers that judge a trajectory."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import BoolArray, FloatArray
from d4orm_env.core.problem import Problem
from d4orm_env.core.trajectory import Trajectory
from d4orm_env.dynamics.robot_model import ACCELERATION


def arrival_steps(arrived: BoolArray) -> NDArray[np.intp]:
    """``(K,)`` first row of ``arrived`` ``(H+1, K)`` from which on a robot is at its goal; the last where it is not."""
    last_away = len(arrived) - (~arrived[::-1]).argmax(axis=0)
    return np.where(arrived.all(axis=0), 0, np.minimum(last_away, len(arrived) - 1))


def arrival_times(arrived: BoolArray, dt: float) -> NDArray[np.float64]:
    """``(K,)`` time from which on each robot is at its goal [s]; infinite for one that is not there at the end.

    Args:
        arrived: ``(H+1, K)`` bool.
        dt: Time step [s].
    """
    return np.where(arrived[-1], arrival_steps(arrived) * dt, np.inf)


def mean_squared_jerk(controls: FloatArray, arrived: BoolArray, dt: float) -> float:
    """Mean squared norm of the jerk [m^2/s^6] over robots and over steps before arrival (paper, section VIII-C).

    Args:
        controls: ``(H, K, m)`` executed :func:`accelerations`, of which the jerk is the finite difference.
        arrived: ``(H+1, K)`` bool.
        dt: Time step [s].
    """
    jerk = np.diff(controls.astype(np.float64), axis=0) / dt
    moving = ~arrived[1:-1]
    return float((jerk**2).sum(axis=-1)[moving].mean()) if moving.any() else 0.0


def accelerations(problem: Problem, trajectory: Trajectory) -> FloatArray:
    """``(H, K, m)`` executed controls, or what robots that are driven by their jerk have as accelerations then."""
    values = trajectory.controls.copy()
    for robot, model in enumerate(problem.team.robot_models):
        if indices := [index for index, column in model.state_limits if column == ACCELERATION]:
            values[:, robot] = 0
            values[:, robot, : len(indices)] = trajectory.states[1:, robot, indices]
    return values


def stretch(problem: Problem, trajectory: Trajectory) -> np.ndarray:
    """``(K,)`` length that each robot travelled over its shortest path's, :attr:`Problem.shortest_paths`; 1 is least.

    The rest of the path, from where the robot docked to the goal itself, counts as travelled. Infinite for a robot that
    did not arrive, or that has no free path.

    Among obstacles the first call for a problem takes some 20 ms per robot, so that it is no part of
    :func:`trajectory_metrics`.
    """
    positions = np.asarray(trajectory.positions, np.float64)
    path = np.concatenate([positions, problem.goal[None].astype(np.float64)])
    travelled = np.linalg.norm(np.diff(path, axis=0), axis=-1).sum(axis=0)
    shortest = problem.shortest_paths.length
    counts = trajectory.arrived[-1] & np.isfinite(shortest)
    return np.where(counts, travelled / np.maximum(shortest, problem.goal_radius), np.inf)


def mean_stretch(problem: Problem, trajectory: Trajectory) -> float:
    """Mean :func:`stretch` of the robots that arrived; infinite if none did."""
    values = stretch(problem, trajectory)
    arrived = np.isfinite(values)
    return float(values[arrived].mean()) if arrived.any() else np.inf


def trajectory_metrics(problem: Problem, trajectory: Trajectory) -> dict[str, float]:
    """Success, travel time, makespan, reward, jerk and counts of what went wrong.

    Returns:
        ``success``: 1.0 when every robot arrived and none was in contact. ``travel_time``: mean arrival time [s], the
        full duration for a robot that never arrived. ``makespan``: latest arrival [s], counted likewise. ``reward``:
        mean over steps and robots (paper, Eq. for r(tau)). ``mean_squared_jerk``. ``arrived``, ``collided``,
        ``margin_violated``: number of robots.
    """
    times = np.minimum(arrival_times(trajectory.arrived, problem.dt), len(trajectory.controls) * problem.dt)
    arrived = trajectory.arrived[-1]
    collided = trajectory.collided.any(axis=0)
    return {
        "success": float(arrived.all() and not collided.any()),
        "travel_time": float(times.mean()),
        "makespan": float(times.max()),
        "reward": float(trajectory.rewards.mean()),
        "mean_squared_jerk": mean_squared_jerk(accelerations(problem, trajectory), trajectory.arrived, problem.dt),
        "arrived": float(arrived.sum()),
        "collided": float(collided.sum()),
        "margin_violated": float(trajectory.margin_violated.any(axis=0).sum()),
    }
