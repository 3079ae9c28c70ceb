"""Multi-robot navigation by drones in flight: the PettingZoo environment, moved by crazyflow."""

from __future__ import annotations

from functools import partial

from d4orm_env import navigation_v0
from d4orm_env.core.arrays import shown
from d4orm_env.crazyflow.drone_bodies import DroneBodies, DronePhysics, check_problem
from d4orm_env.crazyflow.flight import FlightRecord
from d4orm_env.envs.body_simulation import BodySimulation
from d4orm_env.envs.options import EnvOptions
from d4orm_env.scenarios.problems import ScenarioLike


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
                f"physics is {shown(physics)}; give d4orm_env.crazyflow.DronePhysics(...), or leave it out"
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
