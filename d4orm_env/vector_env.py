"""Many worlds of multi-robot navigation as one Gymnasium vector environment, stepped together in compiled kernels."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from d4orm_env.core.arrays import BoolArray, FloatArray, as_float32, whole_number
from d4orm_env.core.observation import ObservationLayout
from d4orm_env.core.problem import Problem, ProblemArrays
from d4orm_env.episode_record import episode_metrics
from d4orm_env.joint_env import joint_spaces
from d4orm_env.options import EnvOptions
from d4orm_env.rewards import RewardInput, compute_rewards
from d4orm_env.simulation import MAX_ACTION, Simulation, check_options, checked_states, usable

if TYPE_CHECKING:
    from d4orm_env.engine.worlds import WorldBatch

MAX_WORLDS = 1_000_000
_NOISE_STEPS = 32
"""Steps of execution noise that a world draws at a time: drawing costs more per call than per number."""

_OWN_ARRAYS = ("start", "goal", "inverse_initial_distance")
"""What differs from world to world in one kernel call."""
_WORLD_ARRAYS = ("boxes", "triangles", "bounds")
"""What may differ too, at the price of a call for each world; all the rest of a problem is shared."""
_READ_BEFORE = ("state", "distance", "docked", "total_reward")
"""What rewards are computed from that a step overwrites."""


class NavigationVectorEnv(gymnasium.vector.VectorEnv[FloatArray, FloatArray, NDArray[Any]]):
    """``num_envs`` worlds at once, ``gymnasium.make_vec("d4orm/Navigation-v0", num_envs=..., ...)``.

    World for world it is :class:`d4orm_env.joint_env.JointNavigationEnv`: observations ``(B, K * D)``, actions
    ``(B, K * m)``, the team's mean reward, termination when all have arrived, truncation after ``max_cycles`` steps.
    Stepping, observing, rewarding and resetting are compiled; threads share the worlds, which changes no result.

    Infos hold, for every world, ``arrived``, ``collided``, ``margin_violated`` and ``distance_to_goal`` ``(B, K)`` and
    ``is_success`` ``(B,)``. ``metrics`` are those of episodes that have just ended, as the mask ``_metrics`` says.

    Worlds whose obstacles differ are stepped one by one, which takes longer than stepping them together.

    Args:
        num_envs: Number of worlds ``B``.
        scenario: As in :class:`~d4orm_env.options.EnvOptions`, like all arguments not named here.
        num_robots: Size of the team.
        num_instances: Of a scenario that draws at random, draw this many instances at the first reset and choose among
            them at every reset, instead of drawing a new one each time, which takes longer than many steps. Another
            seed draws others.
        autoreset_mode: When a world whose episode has ended is reset, an :class:`gymnasium.vector.AutoresetMode` or
            its value. ``"NextStep"``: by the next step, which ignores its action. ``"SameStep"``: at once, with the
            last observation and infos kept in ``infos["final_obs"]`` and ``infos["final_info"]``. ``"Disabled"``: by
            ``reset(options={"reset_mask": ...})`` only.
        copy: Return a new observation array each time. ``False`` returns the same one, overwritten by the next call.
        num_threads: Threads to spread the worlds over; all available cores unless given.
        **options: Further attributes of :class:`~d4orm_env.options.EnvOptions`, but for ``render_mode`` and
            ``lifelong``, and arguments of the scenario.

    Attributes:
        robot_rewards: ``(B, K)`` rewards of the robots in the last step, of which the team's is the mean; zero where a
            world was reset instead.

    Raises:
        TypeError: For an argument that neither the environment nor the scenario has.
        ValueError: For a bad argument, or instances that differ in their team.
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012

    def __init__(
        self,
        num_envs: int = 1,
        scenario: Any = None,
        num_robots: int | None = None,
        *,
        num_instances: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        copy: bool = True,
        num_threads: int | None = None,
        **options: Any,
    ) -> None:
        chosen = EnvOptions.of(scenario=scenario, num_robots=num_robots, **options)
        if chosen.render_mode is not None:
            raise ValueError(
                f"render_mode is {chosen.render_mode!r}; a batch of worlds is not drawn, use gymnasium.make"
            )
        if chosen.lifelong:
            raise ValueError("lifelong mode needs goals drawn one by one; use gymnasium.make or navigation_v0 for it")
        self.num_envs = whole_number(num_envs, "num_envs", 1, MAX_WORLDS)
        self._mode = _autoreset_mode(autoreset_mode)
        self.metadata = type(self).metadata | {"autoreset_mode": self._mode}
        # It steps no world: it checks the arguments and draws the instances.
        self._template = Simulation(chosen)
        self.problem = self._template.problem
        self.single_observation_space, self.single_action_space = joint_spaces(self._template)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._copy = copy
        if num_instances is not None and not self._template.redraws:
            raise ValueError(
                f"num_instances is {num_instances!r} without randomize_instance, or for a scenario that draws nothing "
                "at random; leave it out"
            )
        self._num_instances = None if num_instances is None else whole_number(num_instances, "num_instances", 1)
        self._pool: list[Problem] = []
        self._make_worlds(num_threads)

    def _make_worlds(self, num_threads: int | None) -> None:
        # Here, because importing the compiler takes longer than importing all the rest of the package.
        from d4orm_env.engine.cpu import CpuEngine
        from d4orm_env.engine.worlds import WorldBatch

        problem, count = self.problem, self.num_envs
        threads = None if num_threads is None else whole_number(num_threads, "num_threads", 1)
        self._engine = CpuEngine(threads)
        start, goal, inverse = (np.repeat(getattr(problem.arrays, name)[None], count, axis=0) for name in _OWN_ARRAYS)
        self._worlds = WorldBatch.of(start, goal, inverse, problem.control_size)
        self._arrays: list[ProblemArrays] = [problem.arrays_to_observe(self._template.layout.num_obstacles)] * count
        self._apart = False
        self.robot_rewards = np.zeros((count, problem.num_robots), np.float32)
        shape = (count, problem.num_robots, self._template.layout.size)
        self._observations = np.empty(shape, np.float32)
        self._running = np.zeros(count, np.bool_)
        self._noise_std = self._template.noise_std
        self._generators: list[np.random.Generator | None] = [None] * count
        self._episodes: list[np.random.Generator | None] = [None] * count
        block = min(_NOISE_STEPS, self.max_cycles) if self._noise_std is not None else 0
        self._noise = np.zeros((count, block, problem.num_robots, problem.control_size), np.float32)
        if self._template.redraws:
            self._drawn(np.random.default_rng(0))

    @property
    def max_cycles(self) -> int:
        """Steps until truncation."""
        return self._template.max_cycles

    @property
    def layout(self) -> ObservationLayout:
        """What the components of one robot's observation mean."""
        return self._template.layout

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[FloatArray, dict[str, Any]]:
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
        from d4orm_env.engine.worlds import LOOK, RESET

        mask = self._reset_mask(options)
        seeds = self._seeds(seed)
        super().reset(seed=seeds[0] if isinstance(seed, (int, np.integer)) else None)
        for world in np.flatnonzero(mask):
            if seeds[world] is not None:
                self._pool = []
                self._generators[world] = seeding.np_random(seeds[world])[0] if self._is_random else None
        self._begin(np.flatnonzero(mask))
        observations = self._advance(np.where(mask, RESET, LOOK))
        self._running[mask] = True
        return observations, self._infos(mask)

    def step(self, actions: FloatArray) -> tuple[FloatArray, NDArray[np.float64], BoolArray, BoolArray, dict[str, Any]]:
        """Advance every world one time step.

        Args:
            actions: ``(B, K * m)`` controls in physical units, clipped to the robots' limits.

        Returns:
            Observations ``(B, K * D)``, rewards ``(B,)`` float64, terminations, truncations ``(B,)`` bool, and infos.

        Raises:
            RuntimeError: Before the first reset, or, without auto-reset, if an episode is over.
            ValueError: If the actions have another shape, or a value that is not finite or beyond 1e15.
        """
        from d4orm_env.engine.worlds import RESET, SKIP, STEP

        self._require_reset()
        controls, ended = self._controls(actions), self._ended
        some_ended = bool(ended.any())
        if some_ended and self._mode is AutoresetMode.DISABLED:
            raise RuntimeError(
                f"the episode of world {int(ended.argmax())} is over; begin another with reset(options="
                "{'reset_mask': terminations | truncations})"
            )
        if self._noise_std is not None:
            controls += self._noise_std * self._next_noise(~ended)
        if some_ended:
            self._begin(np.flatnonzero(ended))
        before, worlds = self._before(), self._worlds
        np.copyto(worlds.control, controls)
        observations = self._advance(np.where(ended, RESET, STEP))
        self._reward(before, ~ended)
        ended = self._ended
        rewards, terminated, truncated = worlds.reward.copy(), worlds.terminated.copy(), worlds.truncated.copy()
        infos = self._infos(np.ones(self.num_envs, np.bool_))
        if ended.any():
            infos |= {"metrics": self._masked(self.metrics(), ended), "_metrics": ended}
            if self._mode is AutoresetMode.SAME_STEP:
                final = _final(observations, infos, ended)
                self._begin(np.flatnonzero(ended))
                self._advance(np.where(ended, RESET, SKIP), observations)
                infos = self._infos(np.ones(self.num_envs, np.bool_)) | final
        return observations, rewards, terminated, truncated, infos

    def set_state(self, states: Any) -> tuple[FloatArray, dict[str, Any]]:
        """Put the robots elsewhere; see :meth:`d4orm_env.navigation_v0.parallel_env.set_state`.

        Args:
            states: ``(B, K, n)`` of all robots. A world whose episode has ended is reset all the same.

        Returns:
            Observations ``(B, K * D)`` and infos, as at a reset.

        Raises:
            RuntimeError: Before the first reset.
            ValueError: If a state is none that the robot may be in; the message names it.
        """
        from d4orm_env.engine.worlds import LOOK

        self._require_reset()
        worlds, bounds = self._worlds, self._template.state_bounds
        docked = worlds.docked & ~self._ended[:, None]
        np.copyto(worlds.state, checked_states(self.problem, states, docked, bounds, worlds.state.shape))
        observations = self._advance(np.full(self.num_envs, LOOK))
        return observations, self._infos(np.ones(self.num_envs, np.bool_))

    def state(self) -> FloatArray:
        """``(B, S)`` joint states of the worlds; see :mod:`d4orm_env.joint_state`.

        Raises:
            RuntimeError: Before the first reset.
        """
        self._require_reset()
        worlds = self._worlds
        parts = (worlds.state, worlds.goal, worlds.control, worlds.docked, worlds.steps)
        return np.concatenate([part.reshape(self.num_envs, -1).astype(np.float32) for part in parts], axis=1)

    def metrics(self) -> dict[str, NDArray[np.float64]]:
        """``(B,)`` numbers of the present episodes; see :func:`d4orm_env.episode_record.episode_metrics`.

        Raises:
            RuntimeError: Before the first reset.
        """
        self._require_reset()
        worlds = self._worlds
        arrival = np.where(worlds.arrival > 0, worlds.arrival, np.inf)
        counts = (worlds.docked, worlds.contacts, worlds.violations, arrival)
        return episode_metrics(worlds.steps, self.problem.dt, worlds.total_reward, *counts)

    @property
    def _ended(self) -> BoolArray:
        ended: BoolArray = self._worlds.terminated | self._worlds.truncated
        return ended

    @property
    def _is_random(self) -> bool:
        return self._noise_std is not None or self._template.redraws

    def _require_reset(self) -> None:
        if not self._running.all():
            raise RuntimeError("no episode has begun; call reset() first")

    def _advance(self, orders: Any, observations: FloatArray | None = None) -> FloatArray:
        """Carry out ``orders`` ``(B,)``, and return what is seen ``(B, K * D)``, in ``observations`` if given."""
        template = self._template
        if observations is None:
            observations = np.empty_like(self._observations) if self._copy else self._observations
        out = observations.reshape(self._observations.shape)
        advance, layout, cycles = self._engine.advance, template.layout, self.max_cycles
        if not self._apart:
            advance(self._arrays[0], layout, cycles, orders, self._worlds, out)
        else:
            for world, arrays in enumerate(self._arrays):
                one = slice(world, world + 1)
                part = type(self._worlds)(*(values[one] for values in self._worlds))
                advance(arrays, layout, cycles, orders[one], part, out[one])
        return out.reshape(self.num_envs, -1)

    def _before(self) -> WorldBatch | None:
        """The worlds before a step, as far as a reward is computed from them; ``None`` for the paper's."""
        if self._template.reward is None:
            return None
        worlds = self._worlds
        return worlds._replace(**{name: getattr(worlds, name).copy() for name in _READ_BEFORE})

    def _reward(self, before: WorldBatch | None, moved: BoolArray) -> None:
        """Give the robots of the worlds that have ``moved`` from ``before`` their rewards."""
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
            initial_distances=1 / worlds.inverse,
            previously_arrived=before.docked & moved[:, None],
            arrived=worlds.docked,
            collided=worlds.collided,
            margin_violated=worlds.violated,
            paper=self.robot_rewards,
            team=self.problem.team,
            dt=self.problem.dt,
        )
        self.robot_rewards = np.where(moved[:, None], compute_rewards(reward, step), np.float32(0))
        worlds.reward[:] = self.robot_rewards.mean(axis=1)
        # Where a world was reset both are zero.
        worlds.total_reward[moved] = before.total_reward[moved] + self.robot_rewards[moved].sum(axis=1)

    def _begin(self, indices: NDArray[np.intp]) -> None:
        """Draw what is random in the next episode of these worlds, as a single environment does."""
        if not self._is_random:
            return
        for world in indices:
            generator = self._generators[world]
            if generator is None:
                generator = self._generators[world] = seeding.np_random()[0]
            episode = self._episodes[world] = np.random.default_rng(int(generator.integers(2**63)))
            if self._template.redraws:
                problem = self._next_instance(episode)
                self._worlds.start[world], self._worlds.goal[world] = problem.start, problem.goal
                self._worlds.inverse[world] = problem.arrays.inverse_initial_distance
                self._arrays[world] = problem.arrays_to_observe(self._template.layout.num_obstacles)
                self._apart |= bool(_differing(problem, self.problem, _WORLD_ARRAYS))

    def _next_instance(self, random: np.random.Generator) -> Problem:
        """A new instance, or one of the pool."""
        if self._num_instances is None:
            return self._drawn(random)
        if not self._pool:
            self._pool = [self._drawn(random) for _ in range(self._num_instances)]
        return self._pool[int(random.integers(self._num_instances))]

    def _drawn(self, random: np.random.Generator) -> Problem:
        """A new instance that differs from the first in places and obstacles only."""
        drawn = self._template.draw_instance(random)
        shared = set(drawn.arrays._fields) - {*_OWN_ARRAYS, *_WORLD_ARRAYS, "index"}
        differing = _differing(drawn, self.problem, shared)
        if differing:
            raise ValueError(
                f"instances of scenario {drawn.name!r} differ in their {', '.join(differing)}, and worlds of a batch "
                "share all but starts, goals and obstacles; use vectorization_mode='sync'"
            )
        return drawn

    def _next_noise(self, moving: BoolArray) -> FloatArray:
        """``(B, K, m)`` standard normals of the step ahead; worlds draw some steps at a time."""
        row = self._worlds.steps % self._noise.shape[1]
        for world in np.flatnonzero(moving & (row == 0)):
            episode = self._episodes[world]
            assert episode is not None
            self._noise[world] = episode.standard_normal(self._noise.shape[1:], dtype=np.float32)
        noise: FloatArray = self._noise[np.arange(self.num_envs), row]
        return noise

    def _controls(self, actions: FloatArray) -> FloatArray:
        """``(B, K, m)`` a checked copy."""
        try:
            controls = as_float32(actions)
        except ValueError as error:
            raise ValueError(
                f"actions must be an array of {self.action_space.shape} numbers, not {actions!r}: {error}"
            ) from None
        if controls.shape != self.action_space.shape:
            raise ValueError(f"actions have shape {controls.shape}; expected (B, K * m) = {self.action_space.shape}")
        controls = controls.reshape(self._worlds.control.shape)
        if not usable(controls).all():
            world, robot = (int(i) for i in np.argwhere(~usable(controls).all(axis=2))[0])
            value = controls[world, robot].tolist()
            raise ValueError(
                f"action of robot_{robot} in world {world} is {value}; every value must be finite and at most "
                f"{MAX_ACTION:g} in magnitude"
            )
        return controls

    def _infos(self, mask: BoolArray) -> dict[str, Any]:
        """Fresh infos, present for the worlds in ``mask``."""
        worlds = self._worlds
        values = {
            "arrived": worlds.docked,
            "collided": worlds.collided,
            "margin_violated": worlds.violated,
            "distance_to_goal": worlds.distance,
            "is_success": worlds.docked.all(axis=1) & ~worlds.contacts.any(axis=1),
        }
        return self._masked(values, mask)

    @staticmethod
    def _masked(values: dict[str, Any], mask: BoolArray) -> dict[str, Any]:
        """Copies of batched values, zero outside ``mask``, each with its mask, as Gymnasium has infos."""
        masked: dict[str, Any] = {}
        whole = bool(mask.all())
        for key, value in values.items():
            masked[key] = value.copy()
            if not whole:
                masked[key][~mask] = 0
            masked[f"_{key}"] = mask.copy()
        return masked

    def _reset_mask(self, options: dict[str, Any] | None) -> BoolArray:
        check_options(options, ("reset_mask",))
        if options is None or "reset_mask" not in options:
            return np.ones(self.num_envs, np.bool_)
        mask = options["reset_mask"]
        if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_:
            raise TypeError(f"options['reset_mask'] must be a NumPy array of bool, not {mask!r}")
        if mask.shape != (self.num_envs,) or not mask.any():
            raise ValueError(
                f"options['reset_mask'] has shape {mask.shape} and {int(mask.sum())} worlds; it must have shape "
                f"({self.num_envs},) and at least one world"
            )
        if not (mask | self._running).all():
            raise RuntimeError("the first reset must not leave worlds out; call reset() without a mask")
        return mask

    def _seeds(self, seed: int | Sequence[int | None] | None) -> list[int | None]:
        if seed is None:
            return [None] * self.num_envs
        if not isinstance(seed, (Sequence, np.ndarray)) or isinstance(seed, str):
            first = whole_number(seed, "seed", 0)
            return [first + world for world in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise ValueError(f"seed has {len(seed)} entries for {self.num_envs} worlds; give one per world")
        return [None if one is None else whole_number(one, f"seed[{world}]", 0) for world, one in enumerate(seed)]


def _differing(one: Problem, other: Problem, names: Iterable[str]) -> list[str]:
    """Those of the arrays in which two problems differ."""
    return [name for name in names if not np.array_equal(getattr(one.arrays, name), getattr(other.arrays, name))]


def _final(observations: FloatArray, infos: dict[str, Any], ended: BoolArray) -> dict[str, Any]:
    """What Gymnasium keeps of episodes that have ended, before their worlds are reset."""
    final_obs = np.full(len(ended), None, dtype=object)
    for world in np.flatnonzero(ended):
        final_obs[world] = observations[world].copy()
    final_info: dict[str, Any] = {}
    for key in [name for name in infos if not name.startswith("_")]:
        final_info[key] = infos[key]
        if isinstance(infos[key], np.ndarray):
            final_info[key][~ended] = 0
        final_info[f"_{key}"] = ended.copy()
    return {
        "final_obs": final_obs,
        "_final_obs": ended.copy(),
        "final_info": final_info,
        "_final_info": ended.copy(),
    }


def _autoreset_mode(value: str | AutoresetMode) -> AutoresetMode:
    try:
        return AutoresetMode(value)
    except ValueError:
        names = ", ".join(repr(mode.value) for mode in AutoresetMode)
        raise ValueError(f"autoreset_mode {value!r} is unknown; choose one of {names}") from None
