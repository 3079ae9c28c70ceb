"""Many worlds of multi-robot navigation as one Gymnasium vector environment, stepped together in compiled kernels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import gymnasium
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from d4orm_env.core.arrays import BoolArray, FloatArray, truth, whole_number
from d4orm_env.core.observation_layout import ObservationLayout
from d4orm_env.engine.types import LOOK, SKIP
from d4orm_env.envs.inputs import checked_autoreset_mode, joint_controls, reset_mask, world_seeds
from d4orm_env.envs.joint_env import joint_spaces
from d4orm_env.envs.options import EnvOptions
from d4orm_env.envs.setup import EnvSetup
from d4orm_env.envs.simulation import Simulation
from d4orm_env.envs.team_step import Info
from d4orm_env.scenarios.problems import ScenarioLike

__all__ = ["NavigationVectorEnv"]

MAX_WORLDS = 1_000_000


class NavigationVectorEnv(gymnasium.vector.VectorEnv[FloatArray, FloatArray, NDArray[np.generic]]):
    """``num_envs`` worlds at once, ``gymnasium.make_vec("d4orm/Navigation-v0", num_envs=..., ...)``.

    World for world it is :class:`d4orm_env.envs.joint_env.JointNavigationEnv`: observations ``(B, K * D)``, actions
    ``(B, K * m)``, the team's mean reward, termination when all have arrived, truncation after ``max_cycles`` steps.
    Stepping, observing, rewarding and resetting are compiled; threads share the worlds, which changes no result.

    Infos hold, for every world, ``arrived``, ``collided``, ``margin_violated`` and ``distance_to_goal`` ``(B, K)`` and
    ``is_success`` ``(B,)``. ``metrics`` are those of episodes that have just ended, as the mask ``_metrics`` says.

    Worlds whose obstacles differ are stepped one by one, which takes longer than stepping them together.

    Args:
        num_envs: Number of worlds ``B``.
        scenario: As in :class:`~d4orm_env.envs.options.EnvOptions`, like all arguments not named here.
        num_robots: Size of the team.
        num_instances: Of a scenario that draws at random, draw this many instances at the first reset and choose among
            them at every reset, instead of drawing a new one each time, which takes longer than many steps. Another
            seed draws others.
        autoreset_mode: Moment of reset after an episode's end, an :class:`gymnasium.vector.AutoresetMode` or its value.
            ``"NextStep"``: by the next step, which ignores its action. ``"SameStep"``: at once, with the last
            observation and infos kept in ``infos["final_obs"]`` and ``infos["final_info"]``. ``"Disabled"``: by
            ``reset(options={"reset_mask": ...})`` only.
        copy: Return a new observation array each time. ``False`` returns the same one, overwritten by the next call.
        num_threads: Threads to spread the worlds over; all available cores unless given.
        **options: Further attributes of :class:`~d4orm_env.envs.options.EnvOptions`, but for ``render_mode`` and
            ``lifelong``, and arguments of the scenario.

    Raises:
        TypeError: For an argument that neither the environment nor the scenario has.
        ValueError: For a bad argument, or instances that differ in their team.
    """

    metadata: dict[str, object] = {"autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012

    def __init__(
        self,
        num_envs: int = 1,
        scenario: ScenarioLike | None = None,
        num_robots: int | None = None,
        *,
        num_instances: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        copy: bool = True,
        num_threads: int | None = None,
        **options: object,
    ) -> None:
        chosen = EnvOptions.of(scenario=scenario, num_robots=num_robots, **options)
        if chosen.render_mode is not None:
            raise ValueError(
                f"render_mode is {chosen.render_mode!r}; a batch of worlds is not drawn, use gymnasium.make"
            )
        if chosen.lifelong:
            raise ValueError("lifelong mode needs goals drawn one by one; use gymnasium.make or navigation_v0 for it")
        self.num_envs = whole_number(num_envs, "num_envs", 1, MAX_WORLDS)
        self._mode = checked_autoreset_mode(autoreset_mode)
        self.metadata = type(self).metadata | {"autoreset_mode": self._mode}
        threads = None if num_threads is None else whole_number(num_threads, "num_threads", 1)
        self._setup = EnvSetup(chosen, num_instances, batched=True)
        self._simulation = Simulation(self._setup, self.num_envs, threads)
        self.problem = self._setup.problem
        self.single_observation_space, self.single_action_space = joint_spaces(self._setup)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._action_shape = (self.num_envs, self.problem.num_robots * self.problem.control_size)
        self._observations = np.empty((self.num_envs, self.problem.num_robots, self.layout.size), np.float32)
        self._copy = truth(copy, "copy")
        self._generators: list[np.random.Generator | None] = [None] * self.num_envs
        self._running = np.zeros(self.num_envs, np.bool_)

    @property
    def autoreset_mode(self) -> AutoresetMode:
        """Moment at which a world whose episode has ended is reset; also in ``metadata``."""
        return self._mode

    @property
    def max_cycles(self) -> int:
        """Steps until truncation."""
        return self._simulation.max_cycles

    @property
    def layout(self) -> ObservationLayout:
        """Layout of one robot's observation."""
        return self._setup.layout

    @property
    def robot_rewards(self) -> FloatArray:
        """``(B, K)`` rewards of the robots in the last step, of which the team's is the mean; zero where a world was
        reset instead.
        """
        return self._simulation.robot_rewards

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, object] | None = None
    ) -> tuple[FloatArray, Info]:
        """Begin episodes.

        Args:
            seed: World ``b`` is seeded with ``seed + b``, or with its entry of a sequence; ``None`` goes on with the
                present generators.
            options: ``"reset_mask"``, ``(B,)`` bool, names the worlds to reset; the others go on.

        Returns:
            Observations ``(B, K * D)`` of all worlds, and infos.

        Raises:
            TypeError: If the mask is not an array of bool.
            ValueError: If mask or seeds have another length, a seed is no whole number of zero or more, the mask is
                empty, or an option is unknown.
            RuntimeError: If the first reset leaves worlds out.
        """
        mask = reset_mask(options, self._running)
        seeds = world_seeds(seed, self.num_envs)
        super().reset(seed=seeds[0] if isinstance(seed, (int, np.integer)) else None)
        for world in np.flatnonzero(mask).tolist():
            own_seed = seeds[world]
            if own_seed is not None:
                self._setup.forget()  # for they were drawn with another seed
                self._generators[world] = seeding.np_random(own_seed)[0] if self._setup.draws else None
        observations = self._new_observations()
        self._begin(mask, observations)
        self._running[mask] = True
        return self._simulation.show(observations).reshape(self.num_envs, -1), self._infos(mask)

    def step(self, actions: FloatArray) -> tuple[FloatArray, NDArray[np.float64], BoolArray, BoolArray, Info]:
        """Advance every world one time step.

        Args:
            actions: ``(B, K * m)`` controls in physical units, clipped to the robots' limits.

        Returns:
            Observations ``(B, K * D)``, rewards ``(B,)`` float64, terminations, truncations ``(B,)`` bool, and infos.

        Raises:
            RuntimeError: Before the first reset, or, without auto-reset, if an episode is over.
            ValueError: If the actions have another shape, or a value that is not finite or beyond 1e15.
        """
        self._require_reset()
        if self._mode is AutoresetMode.DISABLED and self._simulation.ended.any():
            raise RuntimeError(
                f"the episode of world {int(self._simulation.ended.argmax())} is over; begin another with "
                "reset(options={'reset_mask': terminations | truncations})"
            )
        simulation, worlds, seen = self._simulation, self._simulation.worlds, self._new_observations()
        controls = simulation.controls(joint_controls(actions, self._action_shape, self.problem.num_robots))
        simulation.step_worlds(controls, seen, self._drawn(simulation.ended))
        ended, shown = simulation.ended, simulation.show(seen)
        observations = shown.reshape(self.num_envs, -1)
        rewards, terminated, truncated = worlds.reward.copy(), worlds.terminated.copy(), worlds.truncated.copy()
        infos = self._infos()
        if ended.any():
            infos |= {"metrics": _masked(self.metrics(), ended), "_metrics": ended}
            if self._mode is AutoresetMode.SAME_STEP:
                final = _final_infos(observations, infos, ended)
                self._begin(ended, seen, others=SKIP)
                shown[ended] = simulation.show(seen[ended], ended)
                infos = self._infos() | final
        return observations, rewards, terminated, truncated, infos

    def _begin(self, mask: BoolArray, observations: FloatArray, others: np.uint8 = LOOK) -> None:
        """Begin episodes of the worlds in the mask ``(B,)``."""
        for term in self._simulation.terms.values():
            term[mask] = 0
        self._simulation.reset_worlds(self._drawn(mask), observations, others=others)

    def set_state(self, states: ArrayLike) -> tuple[FloatArray, Info]:
        """Put the robots elsewhere; see :meth:`d4orm_env.navigation_v0.parallel_env.set_state`.

        Args:
            states: ``(B, K, n)`` of all robots. A world whose episode has ended is reset all the same.

        Returns:
            Observations ``(B, K * D)`` and infos, as at a reset.

        Raises:
            RuntimeError: Before the first reset.
            ValueError: If a state is none that the robot may be in; the message names it.
        """
        self._require_reset()
        observations = self._new_observations()
        arrived = self._simulation.worlds.arrived & ~self._simulation.ended[:, None]
        self._simulation.put_robots(states, arrived, observations)
        return self._simulation.show(observations).reshape(self.num_envs, -1), self._infos()

    def state(self) -> FloatArray:
        """``(B, S)`` joint states of the worlds; see :mod:`d4orm_env.envs.joint_state`.

        Raises:
            RuntimeError: Before the first reset.
        """
        self._require_reset()
        worlds, (states, controls, bodies) = self._simulation.worlds, self._simulation.seen
        parts = (states, worlds.goal, controls, worlds.arrived, worlds.steps, bodies)
        return np.concatenate([part.reshape(self.num_envs, -1).astype(np.float32) for part in parts], axis=1)

    def metrics(self) -> dict[str, NDArray[np.float64]]:
        """``(B,)`` numbers of the present episodes; see :func:`d4orm_env.envs.team_step.episode_metrics`.

        Raises:
            RuntimeError: Before the first reset.
        """
        self._require_reset()
        return self._simulation.episode_metrics()

    def _require_reset(self) -> None:
        if not self._running.all():
            raise RuntimeError("no episode has begun; call env.reset() first")

    def _new_observations(self) -> FloatArray:
        """``(B, K, D)`` array for observations."""
        return np.empty_like(self._observations) if self._copy else self._observations

    def _drawn(self, mask: BoolArray) -> dict[int, int]:
        """Problems that each world in ``mask`` has drawn for its next episode, from a generator of its own."""
        drawn = dict.fromkeys(np.flatnonzero(mask).tolist(), 0)
        for world in drawn if self._setup.draws else ():
            generator = self._generators[world]
            if generator is None:
                generator = self._generators[world] = seeding.np_random()[0]
            drawn[world] = int(generator.integers(2**63))
        return drawn

    def _infos(self, mask: BoolArray | None = None) -> Info:
        """Fresh infos, present for the worlds in ``mask``, or for all."""
        worlds, lost = self._simulation.worlds, self._simulation.effect().lost
        done = worlds.arrived if lost is None else worlds.arrived | lost
        values = {
            "arrived": worlds.arrived,
            "collided": worlds.collided,
            "margin_violated": worlds.violated,
            "distance_to_goal": worlds.distance,
            **{f"reward_{name}": term for name, term in self._simulation.terms.items()},
            "is_success": np.asarray(done.all(axis=1) & ~worlds.contacts.any(axis=1)),
        }
        return _masked(values, np.ones(self.num_envs, np.bool_) if mask is None else mask)


def _masked(values: Mapping[str, NDArray[np.generic]], mask: BoolArray) -> Info:
    """Copies of batched values, zero outside ``mask`` ``(B,)``, each with its mask."""
    infos: Info = {}
    whole = bool(mask.all())
    for key, value in values.items():
        infos[key] = value.copy()
        if not whole:
            infos[key][~mask] = 0
        infos[f"_{key}"] = mask.copy()
    return infos


def _final_infos(observations: FloatArray, infos: Info, ended: BoolArray) -> Info:
    """Last observations and infos of episodes that have ``ended`` ``(B,)``, kept before their worlds are reset."""
    final_obs = np.full(len(ended), None, dtype=object)
    for world in np.flatnonzero(ended):
        final_obs[world] = observations[world].copy()
    arrays = {name: infos[name] for name in infos if not name.startswith("_") and name != "metrics"}
    final_info = _masked(arrays, ended) | {"metrics": infos["metrics"], "_metrics": ended.copy()}
    return {"final_obs": final_obs, "_final_obs": ended.copy(), "final_info": final_info, "_final_info": ended.copy()}
