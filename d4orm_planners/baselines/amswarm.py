"""AMSwarm, ours after the rival of the paper's section VIII-C: receding-horizon planning, every robot for itself.

Motions are Bernstein polynomials of the time, sampled at every step of a horizon (R. T. Farouki, *The Bernstein
polynomial basis: a centennial retrospective*, Computer Aided Geometric Design, 2012).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field

from d4orm_env.core.arrays import BoolArray, FloatArray, Floats
from d4orm_env.core.problem import Problem
from d4orm_env.core.seeds import Stream
from d4orm_env.dynamics.robot_model import ACCELERATION, SPEED
from d4orm_env.engine.types import Engine
from d4orm_planners.base.planner import Iteration, Planner, PlannerConfig, State
from d4orm_planners.base.settings import Count, NotNegative, Number, Positive, Share, Steps
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.baselines.alternation import Method, MotionSamples, Neighbourhood, alternate
from d4orm_planners.tracking.steering import present_velocities, track_velocities


class Swarm:
    """The robots with their motions of the moment."""

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
        self._limits = np.ascontiguousarray(team.limits[:, [SPEED, ACCELERATION]], np.float64)
        self._limits[~inertia, 1] = np.inf
        self._motions = np.zeros((team.num_robots, config.degree + 1, d))
        self._accelerations = np.zeros((team.num_robots, d))
        self._guesses = self._warm_start()
        self._first = self._guesses.position[:, 0], self._guesses.velocity[:, 0]
        self.violation = 0.0  #: The largest violation of a constraint that a motion was left with, in SI units

    def run(self, engine: Engine, should_stop: Callable[[], bool]) -> FloatArray:
        """``(H, K, m)`` controls, planned and driven until all have arrived or it must stop; the rest is zero."""
        problem = self._problem
        controls = np.zeros((problem.horizon, problem.num_robots, problem.control_size), np.float32)
        states, arrived = np.asarray(problem.start), np.zeros(problem.num_robots, bool)
        velocities = np.zeros((problem.num_robots, problem.dimension))
        for control in controls:
            absorbed = arrived & problem.docks
            if absorbed.all() or not self._replan(states, velocities, absorbed, should_stop):
                break
            control[:] = track_velocities(problem, states, self._wanted(states))
            step = engine.step(problem.arrays, states, arrived, control)
            states, arrived = step.states, step.arrived
            velocities = present_velocities(problem, states, step.controls).astype(np.float64)
        return controls

    def _replan(
        self, states: FloatArray, velocities: Floats, absorbed: BoolArray, should_stop: Callable[[], bool]
    ) -> bool:
        """Every robot's motion from here, around where the others are predicted to be; whether time sufficed."""
        config, problem, method = self._config, self._problem, self._method
        positions, duration = states[:, : problem.dimension].astype(np.float64), config.lookahead * problem.dt
        moved = self._random.uniform(-self._perturbation, self._perturbation, self._guesses.position.shape)
        predicted = np.where(absorbed[:, None, None], positions[:, None], self._guesses.position)
        bodies = Neighbourhood(predicted, self._radius, problem.margin + self._clearance, self._boxes, self._bounds)
        begins = first_coefficients(config.degree, duration, positions, velocities, self._accelerations)
        guesses = MotionSamples(predicted + moved, self._guesses.velocity.copy(), self._guesses.acceleration.copy())
        for robot in np.flatnonzero(~absorbed):
            if should_stop():
                return False
            motion, fixed = self._motions[robot], self._fixed[robot]
            motion[:fixed] = begins[:fixed, robot]
            own = MotionSamples(*(samples[robot] for samples in guesses))
            violation = alternate(method, bodies, robot, self._limits[robot], self._goals[robot], fixed, motion, own)
            self.violation = max(self.violation, violation)
        self._first = guesses.position[:, 0], guesses.velocity[:, 0]
        self._accelerations = _shortened(guesses.acceleration[:, 0], self._limits[:, 1])
        self._guesses = _one_step_on(guesses, problem.dt)
        return True

    def _wanted(self, states: FloatArray) -> FloatArray:
        """``(K, d)`` velocities that lead along the motions for a step [m/s]."""
        positions, velocities = self._first
        mean = (positions - states[:, : self._problem.dimension]) / self._problem.dt
        return np.where(self._fixed[:, None] > 1, velocities, mean).astype(np.float32)

    def _warm_start(self) -> MotionSamples:
        """All robots straight to their goals, as fast as allowed."""
        problem = self._problem
        positions = problem.start[:, None, : problem.dimension].astype(np.float64)
        ahead = self._goals[:, None] - positions
        distance = np.linalg.norm(ahead, axis=2, keepdims=True)
        times = problem.dt * np.arange(1, self._config.lookahead + 1)[None, :, None]
        share = np.minimum(self._limits[:, 0, None, None] * times / np.maximum(distance, problem.goal_radius), 1.0)
        still = np.zeros((problem.num_robots, self._config.lookahead, problem.dimension))
        return MotionSamples(positions + share * ahead, still, still)


def sample_basis(degree: int, steps: int, dt: float) -> Floats:
    """``(4, T, n+1)`` the basis of a degree ``n`` of at least 3, sampled after each of ``T`` steps of ``dt`` [s].

    A motion with coefficients ``c`` ``(n+1, d)`` has the positions ``basis[0] @ c``, and then velocities [1/s],
    accelerations [1/s^2] and jerks [1/s^3].
    """
    times = np.arange(1, steps + 1) / steps
    scale, derivatives = 1.0, []
    for order in range(4):
        values = scale * _polynomials(degree - order, times)
        # A polynomial's derivative is n times the difference of two of degree n - 1.
        for _ in range(order):
            values = -np.diff(values, axis=1, prepend=0, append=0)
        derivatives.append(values)
        scale *= (degree - order) / (steps * dt)
    return np.stack(derivatives)


def first_coefficients(
    degree: int, duration: float, position: Floats, velocity: Floats, acceleration: Floats
) -> Floats:
    """``(3, ...)`` the coefficients that a motion of ``duration`` [s] begins with in that state."""
    second = position + velocity * duration / degree
    third = 2 * second - position + acceleration * duration**2 / (degree * (degree - 1))
    return np.stack([position, second, third])


def _polynomials(degree: int, times: Floats) -> Floats:
    """``(T, degree+1)`` values of the Bernstein polynomials at times from 0 to 1."""
    values = np.empty((len(times), degree + 1))
    for index in range(degree + 1):
        values[:, index] = math.comb(degree, index) * _power(times, index) * _power(1 - times, degree - index)
    return values


def _power(base: Floats, exponent: int) -> Floats:
    """Return a power by multiplication, which has the same bits on every processor."""
    result = np.ones_like(base)
    for _ in range(exponent):
        result = result * base
    return result


def make_method(config: AMSwarmConfig, dt: float, stride: float) -> Method:
    """The settings as the kernel takes them, for steps of ``dt`` [s] in which robots drive ``stride`` [m] at most."""
    basis = sample_basis(config.degree, config.lookahead, dt)
    late = basis[0, -min(config.goal_steps, config.lookahead) :]
    squares = [_squares(samples) for samples in basis[:3]]
    squares.append(config.goal_weight * _squares(late) + config.smoothness * _squares(basis[3]))
    return Method(
        position=basis[0],
        velocity=basis[1],
        acceleration=basis[2],
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


def _one_step_on(guess: MotionSamples, dt: float) -> MotionSamples:
    """The same motions seen from the next step, at their last velocity in the end; each ``(K, T, d)``."""
    position, velocity, acceleration = (np.concatenate([part[:, 1:], part[:, -1:]], axis=1) for part in guess)
    position[:, -1] += dt * velocity[:, -1]
    return MotionSamples(position, velocity, acceleration)


@dataclass(frozen=True, kw_only=True)
class AMSwarmConfig(PlannerConfig):
    """Settings of :class:`AMSwarm`; lengths are in steps of the fastest robot at full speed."""

    max_iterations: Count = 20  #: Runs, with other guesses each, after which :meth:`Planner.solve` gives up
    lookahead: Annotated[Count, Field(ge=2, le=1000)] = 40  #: Steps that a motion is planned for; the first is driven
    degree: Annotated[Count, Field(ge=5, le=30)] = 10  #: Of the Bernstein polynomials
    goal_steps: Count = 32  #: Steps at the end of a motion that are to be at the goal
    goal_weight: Positive = 1.0  #: Weight of their squared distances from it
    smoothness: NotNegative = 1e-4  #: Weight of the squared jerk
    #: Share of its distance beyond the safety distance that a robot may use up in a step; 1 allows all of it
    barrier: Share = 0.25
    #: Bodies are avoided that are predicted to come within the safety distance and this; ``None`` is all
    lookout: NotNegative | None = 10.0
    clearance: NotNegative = 0.3  #: Added to every distance to keep, for what is driven between the steps
    perturbation: NotNegative = 0.5  #: Largest perturbation of every guess, lest symmetric teams block themselves
    penalty: Positive = 2.0  #: First weight of the constraints
    growth: Annotated[Number, Field(ge=1, le=10)] = 1.05  #: Factor by which it grows from one alternation to the next
    alternations: Steps = 100  #: Of a replanning, at most
    tolerance: Positive = 0.05  #: Largest violation, and change of a position, at which a replanning ends


class AMSwarm(Planner):
    """Receding-horizon planning by alternating minimisation, every robot around what the others planned last.

    After Adajania, Zhou, Singh and Schoellig, ICRA 2023, written anew. An iteration is one run of the team from start
    to horizon. The method is for holonomic robots: those with a heading follow their motions' velocities as well as
    they can, and may violate the margin.
    """

    name: ClassVar[str] = "amswarm"
    config_class = AMSwarmConfig
    presets: ClassVar = {
        # The authors' code (utiasDSL/AMSwarm, config_am_swarm.yaml), but for the smoothness, which is of snap there.
        "paper": {
            "lookahead": 30,
            "goal_steps": 15,
            "goal_weight": 7000.0,
            "smoothness": 0.7,
            "barrier": 1.0,
            "lookout": 2.0,
            "clearance": 0.6,
            "penalty": 1.0,
            "growth": 1.3,
            "alternations": 3000,
            "tolerance": 0.1,
        }
    }
    config: AMSwarmConfig

    def iterate(self, search: SolveRun, state: State) -> tuple[State, Iteration]:
        _refuse_polygons(search.problem)
        if search.iteration == 0:
            with search.watch.paused():
                self._compile(search)
        random = np.random.default_rng(search.iteration_seed(Stream.PERTURBATION))
        swarm = Swarm(search.problem, self.config, random)
        controls = swarm.run(search.engine, search.should_stop)
        return state, Iteration(controls, note=f"largest violation planned: {swarm.violation:.3f}")

    def _compile(self, search: SolveRun) -> None:
        """Compile the alternation and the step of such a team, if they are not yet."""
        problem, engine = search.problem, search.engine
        arrived, controls = np.zeros(problem.num_robots, bool), search.current.controls[0]
        engine.step(problem.arrays, np.asarray(problem.start), arrived, controls)
        if not alternate.signatures:
            alone = problem.select([0])
            step = alone.with_state(alone.start, alone.goal, horizon=1)
            Swarm(step, self.config, np.random.default_rng(0)).run(engine, lambda: False)


def _refuse_polygons(problem: Problem) -> None:
    if problem.world.polygons:
        raise ValueError(
            f"the world has {len(problem.world.polygons)} polygons, and planner 'amswarm' knows circles, spheres, "
            f"cylinders and boxes only; give boxes in their place, or use planner 'hybrid'"
        )
