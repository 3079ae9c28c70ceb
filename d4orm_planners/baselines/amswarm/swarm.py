"""A team that plans by alternating minimisation over a receding horizon, each robot around what others planned last."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray, Floats
from d4orm_env.core.problem import Problem
from d4orm_env.dynamics.robot_model import ACCELERATION, SPEED
from d4orm_env.engine.types import Engine
from d4orm_planners.baselines.amswarm.alternation import Neighbourhood, alternate
from d4orm_planners.baselines.amswarm.bernstein import Guess, Method, first_coefficients, sample_basis
from d4orm_planners.tracking.steering import present_velocities, track_velocities

if TYPE_CHECKING:
    from d4orm_planners.baselines.amswarm.planner import AMSwarmConfig


class Swarm:
    """The robots with their motions of the moment.

    Attributes:
        violation: The largest violation of a constraint that a motion was left with, in SI units.
    """

    def __init__(self, problem: Problem, config: AMSwarmConfig, random: np.random.Generator) -> None:
        self._problem, self._config, self._random = problem, config, random
        self._method = make_method(config, problem.dt, problem.stride)
        self._clearance, self._perturbation = config.clearance * problem.stride, config.perturbation * problem.stride
        d, team = problem.dimension, problem.team
        self._goals = problem.goal.astype(np.float64)
        self._radius = np.asarray(team.radius, np.float64)
        self._boxes = problem.world.shapes.boxes.astype(np.float64)
        self._bounds = problem.world.bounds.astype(np.float64) + self._clearance * np.array([[1.0], [-1.0]])
        # A first-order robot takes any velocity at once; of the others the motion continues velocity and acceleration.
        inertia = np.array([bool(model.speed_indices) for model in team.robot_models])
        self._fixed = np.where(inertia, 3, 1)
        self._limits = team.limits[:, [SPEED, ACCELERATION]].astype(np.float64)
        self._limits[~inertia, 1] = np.inf
        self._motions = np.zeros((team.num_robots, config.degree + 1, d))
        self._accelerations = np.zeros((team.num_robots, d))
        self._guesses = self._warm_start()
        self._first = self._guesses.place[:, 0], self._guesses.velocity[:, 0]
        self.violation = 0.0

    def run(self, engine: Engine, should_stop: Callable[[], bool]) -> FloatArray:
        """Plan and drive step by step until all have arrived, the horizon ends or it must stop; the rest is zero.

        Returns:
            ``(H, K, m)`` controls.
        """
        problem = self._problem
        controls = np.zeros((problem.horizon, problem.num_robots, problem.control_size), np.float32)
        states, arrived = np.asarray(problem.start), np.zeros(problem.num_robots, bool)
        velocities = np.zeros((problem.num_robots, problem.dimension))
        for control in controls:
            stands = arrived & problem.docks
            if stands.all() or not self._replan(states, velocities, stands, should_stop):
                break
            control[:] = track_velocities(problem, states, self._wanted(states))
            step = engine.step(problem.arrays, states, arrived, control)
            states, arrived = step.states, step.arrived
            velocities = present_velocities(problem, states, step.controls).astype(np.float64)
        return controls

    def _replan(
        self, states: FloatArray, velocities: Floats, stands: BoolArray, should_stop: Callable[[], bool]
    ) -> bool:
        """Every robot's motion from here, around where the others are predicted to be; whether time sufficed."""
        config, problem, method = self._config, self._problem, self._method
        places, duration = states[:, : problem.dimension].astype(np.float64), config.lookahead * problem.dt
        moved = self._random.uniform(-self._perturbation, self._perturbation, self._guesses.place.shape)
        predicted = np.where(stands[:, None, None], places[:, None], self._guesses.place)
        bodies = Neighbourhood(predicted, self._radius, problem.margin + self._clearance, self._boxes, self._bounds)
        begins = first_coefficients(config.degree, duration, places, velocities, self._accelerations)
        guesses = Guess(predicted + moved, self._guesses.velocity.copy(), self._guesses.acceleration.copy())
        for robot in np.flatnonzero(~stands):
            if should_stop():
                return False
            motion, fixed = self._motions[robot], self._fixed[robot]
            motion[:fixed] = begins[:fixed, robot]
            own = Guess(*(samples[robot] for samples in guesses))
            violation = alternate(method, bodies, robot, self._limits[robot], self._goals[robot], fixed, motion, own)
            self.violation = max(self.violation, violation)
        self._first = guesses.place[:, 0], guesses.velocity[:, 0]
        self._accelerations = _shortened(guesses.acceleration[:, 0], self._limits[:, 1])
        self._guesses = _one_step_on(guesses, problem.dt)
        return True

    def _wanted(self, states: FloatArray) -> FloatArray:
        """``(K, d)`` velocities that lead along the motions for a step [m/s]."""
        places, velocities = self._first
        mean = (places - states[:, : self._problem.dimension]) / self._problem.dt
        return np.where(self._fixed[:, None] > 1, velocities, mean).astype(np.float32)

    def _warm_start(self) -> Guess:
        """All robots straight to their goals, as fast as allowed."""
        problem = self._problem
        places = problem.start[:, None, : problem.dimension].astype(np.float64)
        ahead = self._goals[:, None] - places
        distance = np.linalg.norm(ahead, axis=2, keepdims=True)
        times = problem.dt * np.arange(1, self._config.lookahead + 1)[None, :, None]
        share = np.minimum(self._limits[:, 0, None, None] * times / np.maximum(distance, problem.goal_radius), 1.0)
        still = np.zeros((problem.num_robots, self._config.lookahead, problem.dimension))
        return Guess(places + share * ahead, still, still)


def make_method(config: AMSwarmConfig, dt: float, stride: float) -> Method:
    """The settings as the kernel takes them, for steps of ``dt`` [s] in which robots drive ``stride`` [m] at most."""
    basis = sample_basis(config.degree, config.lookahead, dt)
    late = basis.place[-min(config.goal_steps, config.lookahead) :]
    squares = [_squares(samples) for samples in basis[:3]]
    squares.append(config.goal_weight * _squares(late) + config.smoothness * _squares(basis.jerk))
    return Method(
        *basis[:3],
        squares=np.stack(squares),
        goal=config.goal_weight * late.sum(axis=0),
        barrier=config.barrier,
        lookout=np.inf if config.lookout is None else config.lookout * stride,
        penalty=config.penalty,
        growth=config.growth,
        alternations=config.alternations,
        tolerance=config.tolerance * stride,
    )


def _squares(samples: Floats) -> Floats:
    """``(n+1, n+1)`` products of the columns, added up in a fixed order, as inner products of NumPy are not."""
    return np.stack([(samples[:, [i]] * samples).sum(axis=0) for i in range(samples.shape[1])])


def _shortened(vectors: Floats, most: Floats) -> Floats:
    square = np.zeros(len(vectors))
    for component in vectors.T:
        square += component * component
    length = np.maximum(np.sqrt(square), np.finfo(np.float64).tiny)
    return vectors * np.minimum(most / length, 1.0)[:, None]


def _one_step_on(guess: Guess, dt: float) -> Guess:
    """The same motions seen from the next step, at their last velocity in the end; each ``(K, T, d)``."""
    place, velocity, acceleration = (np.concatenate([part[:, 1:], part[:, -1:]], axis=1) for part in guess)
    place[:, -1] += dt * velocity[:, -1]
    return Guess(place, velocity, acceleration)
