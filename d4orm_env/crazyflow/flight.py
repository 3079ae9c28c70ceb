"""crazyflow's simulation, flown through many setpoints at once, and the figures of a flight."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from crazyflow.control import Control
from crazyflow.drones import Drone
from crazyflow.dynamics import Dynamics
from crazyflow.sim import Sim
from crazyflow.sim.functional import state_control

from d4orm_env.core.arrays import BoolArray, Floats

PHYSICS_RATE, SETPOINT_RATE = 500, 100
"""Steps of dynamics and controller, and setpoints, per second [Hz]."""
COMMAND_SIZE = 16
"""Numbers of crazyflow's full-state command: position, velocity, acceleration, quaternion, turn rates."""
_QUATERNION_W = 12


class Flight:
    """Drones in the air, at ``position`` ``(K, 3)`` [m] and ``velocity`` ``(K, 3)`` [m/s].

    Their mass and the thrust of their rotors are ``mass_factor`` and ``thrust_factor`` times those which their
    controller reckons with.
    """

    def __init__(self, num_drones: int, drone: str, mass_factor: float, thrust_factor: float) -> None:
        self._sim, self._fly = _compiled(num_drones, drone)
        params = self._sim.default_data.params
        params = params.replace(mass=params.mass * mass_factor, rpm2thrust=params.rpm2thrust * thrust_factor)
        self._fresh = self._sim.default_data.replace(params=params)
        self._data = self._fresh
        self._look()

    def begin(self, position: Floats) -> None:
        """Put all drones level and at rest at ``(K, 3)``."""
        self._data = self._fresh
        self.put(np.ones(len(position), np.bool_), position, np.zeros_like(position))

    def put(self, chosen: BoolArray, position: Floats, velocity: Floats) -> None:
        """Put the drones that are true in ``(K,)`` level at ``(K, 3)`` positions, at velocities."""
        states, rows = self._data.states, jnp.asarray(chosen)[None, :, None]
        quaternion = jnp.array([0.0, 0.0, 0.0, 1.0], states.quat.dtype)
        self._data = self._data.replace(
            states=states.replace(
                pos=jnp.where(rows, jnp.asarray(position, states.pos.dtype), states.pos),
                vel=jnp.where(rows, jnp.asarray(velocity, states.vel.dtype), states.vel),
                quat=jnp.where(rows, quaternion, states.quat),
                ang_vel=jnp.where(rows, 0.0, states.ang_vel),
            )
        )
        self._look()

    def fly(self, position: Floats, velocity: Floats, acceleration: Floats, force: Floats) -> Floats:
        """Follow setpoints ``(S, K, 3)`` [m, m/s, m/s^2], one after the other, each for a period.

        The force ``(S, K, 3)`` acts on the drones from outside [N]. Returned are positions at the ends of the periods.
        """
        commands = np.zeros((*position.shape[:2], COMMAND_SIZE), np.float32)
        commands[..., :9] = np.concatenate([position, velocity, acceleration], axis=2)
        commands[..., _QUATERNION_W] = 1
        self._data, path = self._fly(self._data, commands, force.astype(np.float32))
        self._look()
        return np.asarray(path, np.float64)

    def _look(self) -> None:
        states = self._data.states
        self.position, self.velocity = (np.asarray(part[0], np.float64) for part in (states.pos, states.vel))


@contextmanager
def _no_warnings_of_mujoco() -> Iterator[None]:
    """Warnings of MuJoCo, neither printed nor written to a MUJOCO_LOG.TXT in the current folder."""
    handler = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(handler)


@cache
def _compiled(num_drones: int, drone: str) -> tuple[Any, Any]:
    """The simulation of so many drones, and the function that flies setpoints; both take seconds to make."""
    with warnings.catch_warnings(), _no_warnings_of_mujoco():
        warnings.simplefilter("ignore")  # of the scene that crazyflow draws
        sim = Sim(
            n_drones=num_drones,
            drone=Drone(drone),
            dynamics=Dynamics.first_principles,
            control=Control.state,
            freq=PHYSICS_RATE,
            state_freq=SETPOINT_RATE,
        )
    step = sim.build_step_fn()

    def period(data: Any, inputs: tuple[Any, Any]) -> tuple[Any, Any]:
        command, force = inputs
        data = state_control(data, command[None])
        data = data.replace(states=data.states.replace(force=force[None]))
        data = step(data, n_steps=PHYSICS_RATE // SETPOINT_RATE)
        return data, data.states.pos[0]

    return sim, jax.jit(lambda data, commands, force: jax.lax.scan(period, data, (commands, force)))


@dataclass(frozen=True, eq=False)
class FlightRecord:
    """Figures of a team's flight."""

    largest_error: Floats  #: ``(K,)`` largest distance of each drone from its setpoints [m]
    mean_squared_error: Floats  #: ``(K,)`` mean square of it [m^2]
    least_gap: Floats  #: ``(K,)`` least gap between a drone's sphere and another's [m]
    least_clearance: Floats  #: ``(K,)`` least gap between it and obstacles or bounds [m]
    fallen: BoolArray  #: ``(K,)`` bool: was on the floor, or out of control
    samples: int  #: Moments that the mean is of

    @classmethod
    def empty(cls, num_robots: int) -> FlightRecord:
        """The record before take-off."""
        nothing, far = np.zeros(num_robots), np.full(num_robots, np.inf)
        return cls(nothing, nothing, far, far, np.zeros(num_robots, np.bool_), 0)

    def joined(self, later: FlightRecord) -> FlightRecord:
        """The record of this flight and of what came after it."""
        samples = self.samples + later.samples
        total = self.samples * self.mean_squared_error + later.samples * later.mean_squared_error
        return replace(
            self,
            largest_error=np.maximum(self.largest_error, later.largest_error),
            mean_squared_error=total / samples,
            least_gap=np.minimum(self.least_gap, later.least_gap),
            least_clearance=np.minimum(self.least_clearance, later.least_clearance),
            fallen=self.fallen | later.fallen,
            samples=samples,
        )


def least_gaps(path: Floats, radius: Floats) -> Floats:
    """``(K,)`` least gaps to other robots along positions ``(S, K, d)``, joined by straight lines [m]."""
    if len(radius) < 2:
        return np.full(len(radius), np.inf)
    apart = path[:, :, None] - path[:, None]
    begin, change = apart[:-1], apart[1:] - apart[:-1]
    squared = (change * change).sum(axis=-1)
    nearest = np.clip(-(begin * change).sum(axis=-1) / np.maximum(squared, 1e-12), 0, 1)
    gaps = np.linalg.norm(begin + nearest[..., None] * change, axis=-1).min(axis=0) - (radius[:, None] + radius)
    np.fill_diagonal(gaps, np.inf)
    return gaps.min(axis=1)
