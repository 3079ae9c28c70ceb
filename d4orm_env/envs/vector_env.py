"""Many worlds of multi-robot navigation as one Gymnasium vector environment, stepped together in compiled kernels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from d4orm_env.core.arrays import BoolArray, FloatArray, Floats, whole_number
from d4orm_env.core.lazy import LazyModule
from d4orm_env.core.observation_layout import ObservationLayout
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.envs.episode_record import EpisodeCounts, episode_metrics
from d4orm_env.envs.inputs import checked_states, joint_controls
from d4orm_env.envs.joint_env import joint_spaces
from d4orm_env.envs.options import EnvOptions
from d4orm_env.envs.rewards import RewardInput, along_paths, compute_rewards, no_terms
from d4orm_env.envs.simulation import Simulation
from d4orm_env.envs.team_step import Info
from d4orm_env.envs.vector_disturbances import DisturbedBatch
from d4orm_env.envs.vector_infos import final_infos, masked
from d4orm_env.envs.vector_inputs import checked_autoreset_mode, reset_mask, world_seeds
from d4orm_env.envs.world_draws import OWN_ARRAYS, WorldDraws
from d4orm_env.paths.shortest_paths import ahead_in_each, observe_paths
from d4orm_env.scenarios.problems import ScenarioLike

if TYPE_CHECKING:
    from d4orm_env.engine import cpu, episodes
    from d4orm_env.engine.episodes import WorldBatch
    from d4orm_env.engine.types import WorldEngine
else:
    cpu = LazyModule("d4orm_env.engine.cpu")
    episodes = LazyModule("d4orm_env.engine.episodes")

__all__ = ["NavigationVectorEnv"]

MAX_WORLDS = 1_000_000
_READ_BEFORE = ("state", "distance", "docked", "total_reward")
"""Inputs of rewards that a step overwrites."""


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

    Attributes:
        robot_rewards: ``(B, K)`` rewards of the robots in the last step, of which the team's is the mean; zero where a
            world was reset instead.

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
        # It steps no world: it checks the arguments and draws the instances.
        self._template = Simulation(chosen)
        self.problem = self._template.problem
        self.single_observation_space, self.single_action_space = joint_spaces(self._template)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._action_shape = (self.num_envs, self.problem.num_robots * self.problem.control_size)
        self._copy = copy
        self._draws = WorldDraws(self._template, self.num_envs, num_instances)
        self._make_worlds(num_threads)

    def _make_worlds(self, num_threads: int | None) -> None:
        problem, count = self.problem, self.num_envs
        threads = None if num_threads is None else whole_number(num_threads, "num_threads", 1)
        self._engine: WorldEngine = cpu.CpuEngine(threads)
        start, goal, inverse = (np.repeat(getattr(problem.arrays, name)[None], count, axis=0) for name in OWN_ARRAYS)
        self._worlds = episodes.WorldBatch.of(start, goal, inverse, problem.control_size)
        self._disturbances = DisturbedBatch(self._template, self._worlds)
        self._arrays: list[ProblemArrays] = [problem.arrays_to_observe(self._template.layout.num_obstacles)] * count
        self._problems = [problem] * count
        self._apart = False
        self.robot_rewards = np.zeros((count, problem.num_robots), np.float32)
        self._terms = no_terms(self._template.reward, self.robot_rewards.shape)
        # Of the shortest paths from where the robots are, and from their starts.
        self._path_direction = np.zeros((*self.robot_rewards.shape, problem.dimension))
        self._path_length, self._first_length = (np.zeros(self.robot_rewards.shape) for _ in range(2))
        if self._template.along_paths:
            self._first_length[:] = problem.shortest_paths.length
        shape = (count, problem.num_robots, self._template.layout.size)
        self._observations = np.empty(shape, np.float32)
        self._running = np.zeros(count, np.bool_)

    @property
    def autoreset_mode(self) -> AutoresetMode:
        """Moment at which a world whose episode has ended is reset; also in ``metadata``."""
        return self._mode

    @property
    def max_cycles(self) -> int:
        """Steps until truncation."""
        return self._template.max_cycles

    @property
    def layout(self) -> ObservationLayout:
        """Layout of one robot's observation."""
        return self._template.layout

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
                self._draws.seed(world, own_seed)
        self._begin(np.flatnonzero(mask))
        for term in self._terms.values():
            term[mask] = 0
        observations = self._advance(np.where(mask, episodes.RESET, episodes.LOOK))
        self._running[mask] = True
        return observations, self._infos(mask)

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
        self._require_episodes()
        controls = joint_controls(actions, self._action_shape, self.problem.num_robots)
        ended = self._ended
        before, length, worlds = self._before(), self._path_length.copy(), self._worlds
        np.copyto(worlds.control, self._disturbances.act(controls))
        if ended.any():
            self._begin(np.flatnonzero(ended))
        observations = self._advance(np.where(ended, episodes.RESET, episodes.STEP))
        self._reward(before, length, ~ended)
        ended = self._ended
        rewards, terminated, truncated = worlds.reward.copy(), worlds.terminated.copy(), worlds.truncated.copy()
        infos = self._infos()
        if ended.any():
            infos |= {"metrics": masked(self.metrics(), ended), "_metrics": ended}
            if self._mode is AutoresetMode.SAME_STEP:
                final = final_infos(observations, infos, ended)
                self._begin(np.flatnonzero(ended))
                self._advance(np.where(ended, episodes.RESET, episodes.SKIP), observations)
                infos = self._infos() | final
        return observations, rewards, terminated, truncated, infos

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
        worlds, bounds = self._worlds, self._template.state_bounds
        docked = worlds.docked & ~self._ended[:, None]
        np.copyto(worlds.state, checked_states(self.problem, states, docked, bounds, worlds.state.shape))
        observations = self._advance(np.full(self.num_envs, episodes.LOOK))
        self._terms = no_terms(self._template.reward, worlds.docked.shape)
        return observations, self._infos()

    def state(self) -> FloatArray:
        """``(B, S)`` joint states of the worlds; see :mod:`d4orm_env.envs.joint_state`.

        Raises:
            RuntimeError: Before the first reset.
        """
        self._require_reset()
        worlds = self._worlds
        states, controls, bodies = self._disturbances.seen
        parts = (states, worlds.goal, controls, worlds.docked, worlds.steps, bodies)
        return np.concatenate([part.reshape(self.num_envs, -1).astype(np.float32) for part in parts], axis=1)

    def metrics(self) -> dict[str, NDArray[np.float64]]:
        """``(B,)`` numbers of the present episodes; see :func:`d4orm_env.envs.episode_record.episode_metrics`.

        Raises:
            RuntimeError: Before the first reset.
        """
        self._require_reset()
        worlds = self._worlds
        arrival = np.where(worlds.arrival > 0, worlds.arrival, np.inf)
        counts = (worlds.docked, worlds.contacts, worlds.violations, arrival, self._disturbances.lost)
        return episode_metrics(EpisodeCounts(worlds.steps, worlds.total_reward, *counts), self.problem.dt)

    @property
    def _ended(self) -> BoolArray:
        ended: BoolArray = self._worlds.terminated | self._worlds.truncated
        return ended

    def _require_reset(self) -> None:
        if not self._running.all():
            raise RuntimeError("no episode has begun; call reset() first")

    def _require_episodes(self) -> None:
        self._require_reset()
        if self._mode is AutoresetMode.DISABLED and self._ended.any():
            raise RuntimeError(
                f"the episode of world {int(self._ended.argmax())} is over; begin another with reset(options="
                "{'reset_mask': terminations | truncations})"
            )

    def _advance(self, orders: NDArray[np.uint8], observations: FloatArray | None = None) -> FloatArray:
        """Carry out ``orders`` ``(B,)``, and return what is seen ``(B, K * D)``, in ``observations`` if given."""
        if observations is None:
            observations = np.empty_like(self._observations) if self._copy else self._observations
        out = observations.reshape(self._observations.shape)
        advance, layout, cycles = self._engine.advance, self.layout, self.max_cycles
        made, true = out[:0] if self._disturbances.alters_sight else out, self._disturbances.true
        going = np.flatnonzero(orders != episodes.SKIP)
        if not self._apart:
            advance(true(self._arrays[0]), layout, cycles, orders, self._worlds, made)
        else:
            for world in going.tolist():
                one = slice(world, world + 1)
                part = episodes.WorldBatch._make(values[one] for values in self._worlds)
                advance(true(self._arrays[world]), layout, cycles, orders[one], part, made[one])
        self._disturbances.meet(orders == episodes.STEP)
        altered = self._disturbances.alters_sight
        if self._template.along_paths or (layout.observed_path and not altered):
            self._path_direction[going], self._path_length[going] = self._ahead(going, self._worlds.state[going])
        if altered:
            self._look(going, out)
        elif layout.observed_path:
            observe_paths(out, layout, self._path_direction, self._path_length)
        return out.reshape(self.num_envs, -1)

    def _look(self, worlds: NDArray[np.intp], out: FloatArray) -> None:
        """Fill ``out`` ``(B, K, D)`` with what robots of these worlds see where something alters that."""
        sight, layout = self._disturbances.look(worlds), self.layout
        every = len(worlds) == len(out)
        seen: FloatArray = out if every else np.empty((len(worlds), *out.shape[1:]), np.float32)
        if not self._apart:
            self._engine.observe_worlds(self._arrays[0], layout, sight, seen)
        for row, world in enumerate(worlds if self._apart else ()):
            one = slice(row, row + 1)
            self._engine.observe_worlds(self._arrays[world], layout, sight.of(one), seen[one])
        if layout.observed_path:
            observe_paths(seen, layout, *self._ahead(worlds, sight.state))
        seen = self._disturbances.observe(seen, layout)
        if seen is not out:
            out[worlds] = seen

    def _ahead(self, worlds: NDArray[np.intp], states: FloatArray) -> tuple[Floats, Floats]:
        """Directions ``(b, K, d)`` and lengths ``(b, K)`` of paths in some worlds, from ``states`` ``(b, K, n)``."""
        places = states[..., : self.problem.dimension]
        if not self._template.redraws:
            return self.problem.shortest_paths.ahead(places)
        return ahead_in_each([self._problems[world].shortest_paths for world in worlds], places)

    def _before(self) -> WorldBatch | None:
        """The worlds before a step, as far as a reward is computed from them; ``None`` for the paper's."""
        if self._template.reward is None:
            return None
        worlds = self._worlds
        return worlds._replace(**{name: getattr(worlds, name).copy() for name in _READ_BEFORE})

    def _reward(self, before: WorldBatch | None, length: Floats, moved: BoolArray) -> None:
        """Give the robots of the worlds that have ``moved`` from ``before``, with paths of ``length``, rewards."""
        worlds, reward = self._worlds, self._template.reward
        self.robot_rewards = np.where(moved[:, None], worlds.rewards, np.float32(0))
        if reward is None or before is None:
            return
        step = RewardInput(
            previous_states=np.where(moved[:, None, None], before.state, worlds.state),
            states=worlds.state,
            controls=worlds.control,
            goals=worlds.goal,
            previous_distances=np.where(moved[:, None], before.distance, worlds.distance),
            distances=worlds.distance,
            initial_distances=np.float32(1) / worlds.inverse,
            previously_arrived=before.docked & moved[:, None],
            arrived=worlds.docked,
            collided=worlds.collided,
            margin_violated=worlds.violated,
            paper=self.robot_rewards,
            team=self.problem.team,
            dt=self.problem.dt,
        )
        if self._template.along_paths:
            previous = np.where(moved[:, None], length, self._path_length)
            step = along_paths(step, self._first_length, previous, self._path_length)
        rewards, terms = compute_rewards(reward, step)
        self.robot_rewards = np.where(moved[:, None], rewards, np.float32(0))
        self._terms = {name: np.where(moved[:, None], term, np.float32(0)) for name, term in terms.items()}
        worlds.reward[:] = self.robot_rewards.mean(axis=1)
        # Where a world was reset both are zero.
        worlds.total_reward[moved] = before.total_reward[moved] + self.robot_rewards[moved].sum(axis=1)

    def _begin(self, indices: NDArray[np.intp]) -> None:
        """Draw what is random in the next episode of these worlds."""
        if not self._draws.needed:
            return
        for world in indices:
            problem = self._draws.begin(world)
            if problem is not None:
                self._problems[world] = problem
                self._worlds.start[world], self._worlds.goal[world] = problem.start, problem.goal
                self._worlds.inverse[world] = problem.arrays.inverse_initial_distance
                self._arrays[world] = problem.arrays_to_observe(self._template.layout.num_obstacles)
                self._apart |= bool(self._draws.differing(problem))
                if self._template.along_paths:
                    self._first_length[world] = problem.shortest_paths.length
        self._disturbances.begin(indices, self._draws.seeds)

    def _infos(self, mask: BoolArray | None = None) -> Info:
        """Fresh infos, present for the worlds in ``mask``, or for all."""
        worlds, lost = self._worlds, self._disturbances.lost
        there = worlds.docked if lost is None else worlds.docked | lost
        values = {
            "arrived": worlds.docked,
            "collided": worlds.collided,
            "margin_violated": worlds.violated,
            "distance_to_goal": worlds.distance,
            **{f"reward_{name}": term for name, term in self._terms.items()},
            "is_success": np.asarray(there.all(axis=1) & ~worlds.contacts.any(axis=1)),
        }
        return masked(values, np.ones(self.num_envs, np.bool_) if mask is None else mask)
