"""Multi-robot navigation among rigid bodies: the PettingZoo environment, moved by MuJoCo."""

from __future__ import annotations

from functools import partial

from pettingzoo import AECEnv
from pettingzoo.utils import OrderEnforcingWrapper

from d4orm_env import navigation_v0
from d4orm_env.core.arrays import FloatArray, shown
from d4orm_env.envs.base_env import RENDER_MODES
from d4orm_env.envs.body_simulation import BodySimulation
from d4orm_env.envs.options import EnvOptions
from d4orm_env.mujoco.bodies import TeamBodies
from d4orm_env.mujoco.camera import RENDERERS, MujocoViewer
from d4orm_env.mujoco.scene import Physics, check_problem
from d4orm_env.navigation_v0 import AECNavigationEnv
from d4orm_env.scenarios.problems import ScenarioLike


class parallel_env(navigation_v0.parallel_env):
    """:class:`d4orm_env.navigation_v0.parallel_env` with the team as rigid bodies in MuJoCo.

    Observations, actions, infos, docking, rewards and metrics are the same; what differs is how robots move. Planar
    problems of ``holonomic2d`` and ``velocity2d``, which are pushed pucks, and of ``differential_drive`` and
    ``unicycle``, which have two wheels and a caster. ``collided`` is contact at any moment of a step.

    Args:
        scenario: As in :class:`~d4orm_env.envs.options.EnvOptions`, like all arguments not named here.
        num_robots: Size of the team.
        physics: Material of the bodies.
        renderer: Renderer of ``"rgb_array"`` frames: ``"mujoco"``; ``"pictures"``, which are those of the other
            environments; or by default ``"auto"``, MuJoCo where EGL or OSMesa is there, else pictures. A window is
            always of pictures.
        **options: Further attributes of :class:`~d4orm_env.envs.options.EnvOptions`, and arguments of the scenario.

    Raises:
        TypeError: For an argument that neither the environment nor the scenario has.
        ValueError: For a bad argument, or a robot that has no body in MuJoCo.
    """

    metadata: dict[str, object] = {  # noqa: RUF012 - declared mutable by PettingZoo
        "name": "d4orm_mujoco",
        "render_modes": list(RENDER_MODES),
        "render_fps": 10,
        "is_parallelizable": True,
    }

    def __init__(
        self,
        scenario: ScenarioLike | None = None,
        num_robots: int | None = None,
        *,
        physics: Physics | None = None,
        renderer: str = "auto",
        **options: object,
    ) -> None:
        if not isinstance(physics, Physics | None):
            raise ValueError(f"physics is {shown(physics)}; give d4orm_env.mujoco.Physics(...), or leave it out")
        if renderer not in RENDERERS:
            raise ValueError(f"renderer is {shown(renderer)}; choose one of {', '.join(RENDERERS)}")
        self._physics, self._renderer = physics or Physics(), renderer
        super().__init__(scenario, num_robots, **options)

    def _make_simulation(self, options: EnvOptions) -> BodySimulation:
        return BodySimulation(options, check_problem, partial(TeamBodies, physics=self._physics))

    def _make_viewer(self, options: EnvOptions) -> MujocoViewer:
        return MujocoViewer(options.render_mode, self._renderer)


def raw_env(
    scenario: ScenarioLike | None = None, num_robots: int | None = None, **options: object
) -> AECEnv[str, FloatArray, FloatArray | None]:
    """The robots act in turn and move together when the last has chosen; arguments of :class:`parallel_env`."""
    return AECNavigationEnv(parallel_env(scenario, num_robots, **options))  # type: ignore[arg-type] # checked there


def env(
    scenario: ScenarioLike | None = None, num_robots: int | None = None, **options: object
) -> AECEnv[str, FloatArray, FloatArray | None]:
    """:func:`raw_env`, with calls in the wrong order caught; arguments of :class:`parallel_env`."""
    return OrderEnforcingWrapper(raw_env(scenario, num_robots, **options))
