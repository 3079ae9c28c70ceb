"""Rollout of controls: states, rewards and flags over time, disturbances of an execution, and numbers that judge it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import BoolArray, FloatArray
from d4orm_env.core.lazy import LazyModule
from d4orm_env.core.problem import Problem
from d4orm_env.core.summary_line import KeyFigure, count, joined
from d4orm_env.dynamics.robot_model import ACCELERATION

if TYPE_CHECKING:
    from d4orm_env.render import pictures
else:
    pictures = LazyModule("d4orm_env.render.pictures")


@dataclass(frozen=True, eq=False, repr=False)
class Trajectory:
    """The motion of a team. Index 0 along time is the start, index ``t`` the state after ``t`` steps."""

    states: FloatArray  #: ``(H+1, K, n)`` states, padded with zeros
    positions: FloatArray  #: ``(H+1, K, d)`` positions [m]
    controls: FloatArray  #: ``(H, K, m)`` controls as executed: within the limits, zero once docked
    rewards: FloatArray  #: ``(H, K)`` reward of each robot at each step
    arrived: BoolArray  #: ``(H+1, K)`` whether the robot has docked at its goal
    collided: BoolArray  #: ``(H+1, K)`` hard contact with a robot, an obstacle or the bounds
    margin_violated: BoolArray  #: ``(H+1, K)`` the same with the safety margin added

    @property
    def key_figures(self) -> list[KeyFigure]:
        """Robots at their goals at the end, and those that were ever too near anything."""
        robots = self.arrived.shape[1]
        return [
            ("arrived", f"{self.arrived[-1].sum()} of {robots}"),
            ("in contact", f"{self.collided.any(axis=0).sum()}"),
            ("within the margin", f"{self.margin_violated.any(axis=0).sum()}"),
        ]

    @property
    def title(self) -> str:
        """Title: how many robots, and for how long."""
        steps, robots = self.controls.shape[:2]
        return f"{count(robots, 'robot')}, {count(steps, 'step')}"

    def __repr__(self) -> str:
        return f"Trajectory: {self.title}\n  {joined(self.key_figures)}"

    def _repr_html_(self) -> str:
        return pictures.paths_html(self, f"Trajectory: {self.title}", self.key_figures)


@dataclass(frozen=True, eq=False)
class DisturbanceEvents:
    """Disturbances that a team met in ``T`` steps."""

    pushed: FloatArray  #: ``(T + 1, K, d)`` velocity that the step before gave to each robot [m/s]; zero for none
    stalled: BoolArray  #: ``(T + 1, K)`` bool: does not obey
    #: ``(T + 1, N, 2 d + 1)`` position [m], velocity [m/s] and radius [m] of what moves among the robots
    bodies: FloatArray

    def until(self, step: int) -> DisturbanceEvents:
        """The same up to that step."""
        return DisturbanceEvents(self.pushed[: step + 1], self.stalled[: step + 1], self.bodies[: step + 1])

    @property
    def stall_starts(self) -> BoolArray:
        """``(T + 1, K)`` bool: where a robot stops obeying."""
        return beginnings(self.stalled)


def beginnings(flags: BoolArray) -> BoolArray:
    """``(T, K)`` bool: where flags ``(T, K)`` become true."""
    return flags & ~np.concatenate([np.zeros_like(flags[:1]), flags[:-1]])


def arrival_steps(arrived: BoolArray) -> NDArray[np.intp]:
    """``(K,)`` first row of ``arrived`` ``(H+1, K)`` from which on a robot is at its goal; the last without one."""
    last_away = len(arrived) - (~arrived[::-1]).argmax(axis=0)
    return np.where(arrived.all(axis=0), 0, np.minimum(last_away, len(arrived) - 1))


def resting_steps(positions: FloatArray) -> NDArray[np.intp]:
    """``(K,)`` step of positions ``(H+1, K, d)`` from which on a robot does not move."""
    still = (positions[1:] == positions[:-1]).all(axis=2)
    return arrival_steps(np.concatenate([still, np.ones_like(still[:1])]))


def arrival_times(arrived: BoolArray, dt: float) -> NDArray[np.float64]:
    """``(K,)`` time from which on each robot is at its goal [s], of ``arrived`` ``(H+1, K)``; infinite without one."""
    return np.where(arrived[-1], arrival_steps(arrived) * dt, np.inf)


def mean_squared_jerk(controls: FloatArray, arrived: BoolArray, dt: float) -> float:
    """Mean squared norm of the jerk [m^2/s^6] over robots and over steps before arrival (paper, section VIII-C).

    It is the finite difference of ``controls`` ``(H, K, m)``, executed :func:`accelerations`; arrived ``(H+1, K)``.
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
