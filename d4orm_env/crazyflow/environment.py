"""Multi-robot navigation by drones in flight: the PettingZoo environment, moved by crazyflow, and its drones."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from crazyflow.drones import Drone

from d4orm_env import navigation_v0
from d4orm_env.core.arrays import BoolArray, FloatArray, Floats, as_float32, check_choice, positive_number, short_repr
from d4orm_env.core.portable import NUMPY_OPS
from d4orm_env.core.problem import Problem
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.core.seeds import Stream, generator
from d4orm_env.crazyflow.flight import SETPOINT_RATE, Flight, FlightRecord, least_gaps
from d4orm_env.dynamics.robot_model import TimeStep
from d4orm_env.dynamics.transition import advance
from d4orm_env.envs.body_simulation import BodySimulation, Moved, Robots
from d4orm_env.envs.lifelong import reached_goals
from d4orm_env.envs.options import EnvOptions
from d4orm_env.scenarios.problems import ScenarioLike

DRONES = tuple(drone.value for drone in Drone)


@dataclass(frozen=True, kw_only=True)
class DronePhysics:
    """The drones of a team in crazyflow.

    Raises:
        ValueError: For an unknown type, or a number out of range.
    """

    drone: str = Drone.cf2x_L250.value  #: Their type, as crazyflow names it: ``"cf2x_L250"`` is the Crazyflie 2.x
    mass_factor: float = 1.0  #: Their mass over that which their controller reckons with
    thrust_factor: float = 1.0  #: Thrust of their rotors likewise: below 1 with a low battery
    gust: float = 0.0  #: Force on every drone, in another random direction every 0.5 s [N]

    def __post_init__(self) -> None:
        check_choice(self.drone, "drone", DRONES)
        for name in ("mass_factor", "thrust_factor"):
            object.__setattr__(self, name, positive_number(getattr(self, name), name, least=0.1, most=10))
        object.__setattr__(self, "gust", positive_number(self.gust, "gust", zero_allowed=True, most=10))


MODEL = "holonomic3d"
LAG = 0.2
"""Time constant of a drone's accelerations [s]: it is not seen to be off its setpoint for less than twice that."""
HOVER, GUST = 3.0, 0.5
"""Time to hover at the start before a flight, and for which a gust blows in one direction [s]."""
FLOOR, LOST = 0.05, 0.5
"""Height of a centre on the floor, and distance from a setpoint beyond which a drone is out of control [m]."""


def check_problem(problem: Problem) -> None:
    """Refuse what cannot be flown here.

    Raises:
        ValueError: For a robot that is no drone or does not start at rest, a start or goal that is not above the floor,
            or a time step that is no whole number of setpoints.
    """
    for robot, name in enumerate(problem.team.models):
        if name != MODEL:
            raise ValueError(f"robot_{robot} is a {name}, which is no drone in crazyflow; use {MODEL}")
    for what, height in (("start", problem.start[:, 2]), ("goal", problem.goal[:, 2])):
        lowest = int(np.argmin(height))
        if height[lowest] <= max(FLOOR, float(problem.team.wall_radius[lowest])):
            raise ValueError(
                f"{what} of robot_{lowest} is {height[lowest]:.3g} m high, and the floor is at 0; give the scenario a "
                "height, as height=1"
            )
    if (problem.start[:, 3:] != 0).any():
        raise ValueError("robots fly at the start, and drones in crazyflow begin at rest; use starts at rest")
    if abs(problem.dt * SETPOINT_RATE - _periods(problem)) > 1e-6:
        raise ValueError(f"dt is {problem.dt:g} s; in crazyflow it must be a multiple of {1 / SETPOINT_RATE:g} s")


def _periods(problem: Problem) -> int:
    return max(1, round(problem.dt * SETPOINT_RATE))


class DroneBodies:
    """The drones of a problem's team; see :class:`~d4orm_env.envs.body_simulation.SimulatedBodies`.

    Drones follow setpoints, which move as the team's model does under the controls and stay at the goal where that has
    arrived. Drones that are held hover. What is seen of a drone is its setpoint, and how far it is off that on the
    average of half a second: a controller that saw what its attitude has yet to do would ask for it again.

    Args:
        problem: The problem; see :func:`check_problem`.
        intruder_radius: ``(N,)`` of bodies that are no robots [m].
        physics: The drones.

    Attributes:
        sensed: ``(K, 6)`` states as they are seen.
        record: Figures of the flight.
    """

    def __init__(self, problem: Problem, intruder_radius: FloatArray, physics: DronePhysics) -> None:
        self.problem, self.intruder_radius, self._physics = problem, intruder_radius, physics
        self._flight = Flight(problem.num_robots, physics.drone, physics.mass_factor, physics.thrust_factor)
        self._radius = problem.team.inner_radius  # the air that ellipsoids keep free is not simulated
        self._step = TimeStep(*problem.arrays.time_step)
        self.record = FlightRecord.empty(problem.num_robots)

    def begin(self, seed: int) -> None:
        """Have all drones hover at the start until they are calm."""
        self._setpoints: FloatArray = self.problem.start.copy()
        self._parked: BoolArray = np.zeros(self.problem.num_robots, np.bool_)
        self._random, self._clock = generator(seed, Stream.GUSTS), 0
        position = self.problem.start[:, :3].astype(np.float64)
        self._flight.begin(position)
        still = np.zeros((round(HOVER * SETPOINT_RATE), *position.shape))
        self._flight.fly(position + still, still, still, still)
        self._position = self._flight.position
        self._off, self._acceleration = self._position - position, np.zeros_like(position)
        self._look()
        self.record = FlightRecord.empty(self.problem.num_robots)

    def put(self, robots: Robots, states: FloatArray) -> None:
        chosen = np.isin(np.arange(len(states)), robots)
        self._flight.put(chosen, states[:, :3].astype(np.float64), states[:, 3:].astype(np.float64))
        self._setpoints[robots], self._parked[robots] = states[robots], False
        self._position = self._flight.position
        self._off[robots] = 0
        self._look()

    def hold(self, robots: Robots) -> None:
        self._setpoints[robots, 3:] = 0
        self._parked[robots] = True

    def advance(self, controls: FloatArray, arrays: ProblemArrays, intruders: FloatArray) -> Moved:
        before = self._setpoints.copy()
        for robot in np.flatnonzero(~self._parked):
            model, control = self.problem.team.robot_models[robot].functions, tuple(controls[robot])
            self._setpoints[robot] = as_float32(
                advance(model, tuple(before[robot]), control, tuple(arrays.limits[robot]), self._step, NUMPY_OPS)
            )
        touched = self.lead(before, self._setpoints, intruders)
        if self.problem.docks:
            self.hold(np.flatnonzero(reached_goals(self.problem.team, arrays, self._setpoints, controls)))
        share = self.problem.dt / (self.problem.dt + 2 * LAG)
        self._off += share * (self._position - self._setpoints[:, :3] - self._off)
        self._look()
        return Moved(self.states, touched)

    def _look(self) -> None:
        self.sensed = self._setpoints.copy()
        self.sensed[:, :3] += as_float32(self._off)

    @property
    def states(self) -> FloatArray:
        """``(K, 6)`` positions and velocities."""
        return as_float32(np.concatenate([self._flight.position, self._flight.velocity], axis=1))

    def lead(self, before: FloatArray, after: FloatArray, intruders: FloatArray | None = None) -> BoolArray:
        """Fly from state to state ``(K, 6)`` within a time step; see :meth:`follow`.

        Acceleration changes evenly: a jump by twice the limit ten times a second is more than attitude can follow.
        """
        position, velocity, acceleration = between(before, after, self.problem.dt, _periods(self.problem))
        ramp = (np.arange(1, len(position) + 1) / len(position))[:, None, None]
        former, self._acceleration = self._acceleration, acceleration[-1]
        return self.follow(position, velocity, former + ramp * (acceleration - former), intruders)

    def follow(
        self, position: Floats, velocity: Floats, acceleration: Floats, intruders: FloatArray | None = None
    ) -> BoolArray:
        """Fly setpoints ``(S, K, 3)``, one every 0.01 s, and return ``(K,)`` bool: touched something, or fell."""
        path = self._flight.fly(position, velocity, acceleration, self._gusts(len(position)))
        error = np.linalg.norm(path - position, axis=2)
        walked = np.concatenate([self._position[None], path])
        fallen = ((path[..., 2] < FLOOR) | (error > LOST)).any(axis=0)
        clearance = self.problem.world.clearance(path).min(axis=0) - self._radius
        gap = least_gaps(walked, self._radius)
        self._position = path[-1]
        part = FlightRecord(error.max(axis=0), (error**2).mean(axis=0), gap, clearance, fallen, len(path))
        self.record = self.record.joined(part)
        touched: BoolArray = (gap <= 0) | (clearance <= 0) | fallen
        return touched if intruders is None else touched | self._run_into(path, intruders)

    def _run_into(self, path: Floats, intruders: FloatArray) -> BoolArray:
        left = (len(path) - 1 - np.arange(len(path))) / SETPOINT_RATE
        bodies = intruders[:, :3] - left[:, None, None] * intruders[:, 3:6]
        apart = np.linalg.norm(path[:, :, None] - bodies[:, None], axis=3) - self._radius[:, None]
        return (apart <= self.intruder_radius).any(axis=(0, 2))

    def _gusts(self, count: int) -> Floats:
        force, each = np.zeros((count, self.problem.num_robots, 3)), round(GUST * SETPOINT_RATE)
        for period in range(count):
            if (self._clock + period) % each == 0:
                wind = self._random.normal(size=force.shape[1:])
                self._wind = self._physics.gust * wind / np.linalg.norm(wind, axis=1, keepdims=True)
            force[period] = self._wind
        self._clock += count
        return force


def between(before: FloatArray, after: FloatArray, duration: float, count: int) -> tuple[Floats, Floats, Floats]:
    """``(count, K, 3)`` positions, velocities and mean accelerations on the way between two states ``(K, 6)``.

    Positions are cubic in time; the last ones are those of the state after.
    """
    p0, v0, p1, v1 = (
        states[:, part].astype(np.float64) for states in (before, after) for part in (slice(3), slice(3, 6))
    )
    s = (np.arange(1, count + 1) / count)[:, None, None]
    position = p0 + s * duration * v0
    linear, bend = p1 - p0 - duration * v0, duration * (v1 - v0)
    position = position + s**2 * (3 * linear - bend) + s**3 * (bend - 2 * linear)
    velocity = v0 + (2 * s * (3 * linear - bend) + 3 * s**2 * (bend - 2 * linear)) / duration
    return position, velocity, np.broadcast_to((v1 - v0) / duration, position.shape)


class parallel_env(navigation_v0.parallel_env):
    """:class:`d4orm_env.navigation_v0.parallel_env` with the team as drones in crazyflow.

    Problems of ``holonomic3d`` above the floor. ``collided`` is contact at any moment of a step, or a fall.

    Args:
        scenario: As in :class:`~d4orm_env.envs.options.EnvOptions`, like all arguments not named here.
        num_robots: Size of the team.
        physics: The drones.
        **options: Further attributes of :class:`~d4orm_env.envs.options.EnvOptions`, and arguments of the scenario.

    Raises:
        TypeError: For an argument that neither the environment nor the scenario has.
        ValueError: For a bad argument, or a problem that drones cannot fly.
    """

    metadata: dict[str, object] = navigation_v0.parallel_env.metadata | {"name": "d4orm_crazyflow"}

    def __init__(
        self,
        scenario: ScenarioLike | None = None,
        num_robots: int | None = None,
        *,
        physics: DronePhysics | None = None,
        **options: object,
    ) -> None:
        if not isinstance(physics, DronePhysics | None):
            raise ValueError(
                f"physics is {short_repr(physics)}; give d4orm_env.crazyflow.DronePhysics(...), or leave it out"
            )
        self._physics = physics or DronePhysics()
        super().__init__(scenario, num_robots, **options)

    def _make_simulation(self, options: EnvOptions) -> BodySimulation:
        return BodySimulation(options, check_problem, partial(DroneBodies, physics=self._physics))

    @property
    def flight(self) -> FlightRecord:
        """Figures of the present episode's flight.

        Raises:
            RuntimeError: Before the first reset.
        """
        self._simulation.require_reset()
        assert isinstance(self._simulation, BodySimulation)
        assert isinstance(self._simulation.bodies, DroneBodies)
        return self._simulation.bodies.record
