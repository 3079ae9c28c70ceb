"""Worlds as they go on: ``B`` teams, step by step, behind every environment of this package.

The environments are thin views on :class:`Simulation`, which holds states, clocks, goals and disturbances, and calls an
engine for the physics and the observations. An environment of one team is a batch of one world.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from d4orm_env.core.arrays import BoolArray, FloatArray, Floats
from d4orm_env.core.problem import Problem
from d4orm_env.disturbances.disturbance import DisturbanceEffect, Observed, Scene
from d4orm_env.disturbances.disturbed_worlds import DisturbedWorlds
from d4orm_env.engine.types import LOOK, RESET, SKIP, STEP, ObservationInputs, WorldBatch
from d4orm_env.envs.inputs import checked_states
from d4orm_env.envs.joint_state import state_bounds
from d4orm_env.envs.lifelong import assign_goals, reached_goals
from d4orm_env.envs.rewards import RewardInput, along_paths, compute_rewards, no_terms
from d4orm_env.envs.setup import EnvSetup, WorldPaths, WorldProblems
from d4orm_env.envs.team_step import episode_metrics
from d4orm_env.paths.shortest_paths import observe_paths

_READ_BEFORE = ("state", "distance", "arrived", "total_reward")
"""Inputs of rewards that a step overwrites."""


class Simulation:
    """``B`` worlds in the middle of their episodes.

    Args:
        setup: The environment.
        num_worlds: ``B``.
        num_threads: Threads to spread the worlds over; all available cores unless given.

    Attributes:
        worlds: The worlds as the kernels have them; ``worlds.rewards`` are the paper's.
        problems: Their problems.
        robot_rewards: ``(B, K)`` of the last step; zero where a world was reset instead.
        terms: ``(B, K)`` each, what these were made of, where the reward says so.
        reached: ``(B, K)`` bool after the last step: docked, or in lifelong mode, reached a goal in it.
    """

    reward_rows: int | slice = slice(None)
    """The worlds in what reward functions are given: all, or one without the axis of worlds."""

    def __init__(self, setup: EnvSetup, num_worlds: int = 1, num_threads: int | None = None) -> None:
        # Here, because importing the compiler takes longer than importing all the rest of the package.
        from d4orm_env.engine.cpu import CpuEngine

        self.setup, self.max_cycles = setup, setup.max_cycles
        self._engine = CpuEngine(num_threads)
        self._make_worlds(setup.problem, num_worlds)

    def _make_worlds(self, problem: Problem, num_worlds: int) -> None:
        self._disturbed = DisturbedWorlds(self.setup.disturbances, problem, num_worlds, self.max_cycles)
        start, goal = (np.repeat(values[None], num_worlds, axis=0) for values in (problem.start, problem.goal))
        self._disturbed.begin(np.arange(num_worlds), [0] * num_worlds, start, goal)  # to know what bodies there are
        self.worlds = WorldBatch.from_problem(problem, num_worlds, self._disturbed.bodies.shape[1])
        # What is seen may differ from what the kernel that steps the worlds knows when it observes.
        self._observes_apart = self._disturbed.alters_sight or self._disturbed.alters_limits or self.setup.lifelong
        self._seen: Observed | None = None
        self._random: dict[int, np.random.Generator] = {}
        self.problems = WorldProblems(self.setup, self._disturbed, num_worlds)
        shape = self.worlds.arrived.shape
        self.robot_rewards, self.reached = np.zeros(shape, np.float32), np.zeros(shape, np.bool_)
        self._goals_reached, self._frames = np.zeros(shape, np.int64), np.zeros((*shape, 2), np.float32)
        self.terms = no_terms(self.setup.reward, shape)
        self._paths = WorldPaths(self.problems.all, one_world=num_worlds == 1 or not self.setup.redraws)
        self._follows_paths = self.setup.along_paths or (self.setup.layout.observed_path and not self._observes_apart)

    @property
    def state_bounds(self) -> tuple[FloatArray, FloatArray]:
        """Finite bounds of the joint states, for the present ``max_cycles``."""
        setup, num_bodies = self.setup, self.worlds.bodies.shape[1]
        return state_bounds(setup.problem, setup.region, self.max_cycles, setup.slack, num_bodies)

    def show(self, seen: FloatArray, worlds: slice | BoolArray = slice(None)) -> FloatArray:
        """Observations ``(b, K, D)`` of some worlds as their robots are shown them: as features, if egocentric."""
        if (features := self.setup.features) is None:
            return seen
        parts = features.encode(seen.reshape(-1, seen.shape[2]))
        shown, self._frames[worlds] = (part.reshape(*seen.shape[:2], -1) for part in parts)
        return shown

    def controls(self, actions: FloatArray) -> FloatArray:
        """``(B, K, m)`` controls in physical units for the actions of robots that were shown the worlds."""
        features, most = self.setup.features, self.setup.problem.team.control_limits
        return actions if features is None else features.decode(actions, self._frames, most)

    @property
    def ended(self) -> BoolArray:
        """``(B,)`` bool, episodes that are over."""
        return np.asarray(self.worlds.terminated | self.worlds.truncated)

    def reset_worlds(self, seeds: Mapping[int, int], out: FloatArray, *, others: np.uint8 = LOOK) -> None:
        """Begin the episodes of some worlds, and fill the observations ``out`` ``(B, K, D)``.

        All that is random follows from the seeds, from 0 to ``2**63 - 1``. The ``others`` are to ``LOOK`` or ``SKIP``.
        """
        self._begin(seeds)
        orders = np.full(len(self.problems.all), others)
        orders[list(seeds)] = RESET
        self._advance(orders, out)
        self._observe(orders, out)

    def step_worlds(self, controls: FloatArray, out: FloatArray, restarts: Mapping[int, int] | None = None) -> None:
        """Advance one time step under controls ``(B, K, m)``, of which those of docked robots do not matter.

        Observations ``(B, K, D)`` are filled. ``restarts`` are seeds of the worlds that begin an episode instead.
        """
        worlds, before = self.worlds, None
        if self.setup.reward is not None:
            before = worlds._replace(**{name: getattr(worlds, name).copy() for name in _READ_BEFORE})
        length = self._paths.length.copy() if self._follows_paths else self._paths.length
        orders = np.full(len(worlds.steps), self._move(self._act(controls)))
        if restarts:
            self._begin(restarts)
            orders[list(restarts)] = RESET
        self._advance(orders, out)
        self.reached = self._reached() if self.setup.lifelong else worlds.arrived.copy()
        self._reward(before, length, list(restarts or ()))
        if self.setup.lifelong:
            self._assign_goals()
        self._observe(orders, out)

    def put_robots(self, states: ArrayLike, arrived: BoolArray, out: FloatArray) -> None:
        """Put the robots elsewhere, ``(B, K, n)`` or ``(K, n)`` of one world, in the middle of an episode.

        Goals, clock, the controls executed last and the metrics so far are kept. A robot that has docked stays docked
        where it is put, and must be at rest; one that is put at its goal docks at the end of the next step, if it is
        still there. Contact is allowed. ``out`` ``(B, K, D)`` are the observations.
        """
        problem, shape = self.problems.all[0], self.worlds.arrived.shape
        checked = checked_states(problem, states, arrived & problem.docks, self.state_bounds)
        self._put(checked.reshape(*shape, -1))
        self.terms, orders = no_terms(self.setup.reward, shape), np.full(shape[0], LOOK)
        self._advance(orders, out)
        self._observe(orders, out)

    def episode_metrics(self) -> dict[str, Floats]:
        """``(B,)`` numbers of the present episodes; see :func:`d4orm_env.envs.team_step.episode_metrics`."""
        goals = self._goals_reached if self.setup.lifelong else None
        return episode_metrics(self.worlds, self.problems.all[0].dt, goals, self.effect().lost)

    def effect(self) -> DisturbanceEffect:
        """Return the effect of the disturbances up to now."""
        return self._disturbed.effect(self._scene()) if self.setup.disturbances else DisturbanceEffect()

    @property
    def seen(self) -> Observed:
        """The worlds as they are seen, which is as they are unless something alters it."""
        return self._seen or self.true

    @property
    def true(self) -> Observed:
        """The worlds as they are."""
        return Observed(self.worlds.state, self.worlds.control, self.worlds.bodies)

    def _begin(self, seeds: Mapping[int, int]) -> None:
        """Draw what is random in the next episodes of some worlds."""
        if not self.setup.draws:
            return
        worlds = self.worlds
        for world, seed in seeds.items():
            if self.setup.redraws or self.setup.lifelong:
                self._random[world] = np.random.default_rng(seed)
                self.problems.begin(world, self._random[world], worlds)
                self._goals_reached[world] = 0
        indices = np.array(list(seeds), np.intp)
        self._disturbed.max_cycles = self.max_cycles
        self._disturbed.begin(indices, list(seeds.values()), worlds.start[indices], worlds.goal[indices])
        worlds.bodies[indices] = self._disturbed.bodies[indices]

    def _scene(self, states: FloatArray | None = None) -> Scene:
        """The worlds as disturbances are told of them; robots are in ``states`` ``(B, K, n)``, if these are given."""
        now = self.worlds
        where = now.state if states is None else states
        return self._disturbed.scene(now.start, now.goal, where, now.control, now.arrived, now.steps)

    @property
    def _sensed(self) -> FloatArray:
        """``(B, K, n)`` states as they are seen where no disturbance alters that."""
        return self.worlds.state

    def _act(self, controls: FloatArray) -> FloatArray:
        """Disturb states and controls at the beginning of a step, and return the controls."""
        if not self.setup.disturbances:
            return controls
        states, controls = self._disturbed.act(self._scene(), controls)
        if states is not self.worlds.state:
            self._put(states)
        np.copyto(self.worlds.bodies, self._disturbed.bodies)
        return controls

    def _put(self, states: FloatArray) -> None:
        """Put the robots into ``states`` ``(B, K, n)``."""
        np.copyto(self.worlds.state, states)

    def _move(self, controls: FloatArray) -> np.uint8:
        """Prepare a step of the bodies and return the order for it; another physics steps them here."""
        np.copyto(self.worlds.control, controls)
        return STEP

    def _advance(self, orders: NDArray[np.uint8], out: FloatArray) -> None:
        """Carry out ``orders`` ``(B,)``: states, flags and the paper's rewards, and what is seen if it knows."""
        layout, cycles, made = self.setup.layout, self.max_cycles, out[:0] if self._observes_apart else out
        if self.problems.alike:
            self._engine.advance(self.problems.true[0], layout, cycles, orders, self.worlds, made)
        else:
            for world in np.flatnonzero(orders != SKIP).tolist():
                one = slice(world, world + 1)
                arrays, batch = self.problems.true[world], self.worlds.select(one)
                self._engine.advance(arrays, layout, cycles, orders[one], batch, made[one])
        if self._follows_paths:
            self._paths.update(np.flatnonzero(orders != SKIP), self.worlds.state)

    def _observe(self, orders: NDArray[np.uint8], out: FloatArray) -> None:
        """Complete the observations ``out`` ``(B, K, D)`` of the worlds that are not skipped."""
        layout = self.setup.layout
        if not self._observes_apart:
            self.problems.sense_ranges(self._engine, self.worlds, out)
            if layout.observed_path:
                observe_paths(out, layout, self._paths.direction, self._paths.length)
            return
        worlds = np.flatnonzero(orders != SKIP)
        inputs, every = self._look(worlds), len(worlds) == len(out)
        seen: FloatArray = out if every else np.empty((len(worlds), *out.shape[1:]), np.float32)
        if self.problems.alike:
            self._engine.observe_worlds(self.problems.seen[0], layout, inputs, seen)
        for row, world in enumerate(() if self.problems.alike else worlds):
            one = slice(row, row + 1)
            self._engine.observe_worlds(self.problems.seen[world], layout, inputs.select(one), seen[one])
        if layout.observed_path:
            observe_paths(seen, layout, *self._paths.look(worlds, inputs.state))
        self.problems.sense_ranges(self._engine, self.worlds, seen, None if every else worlds)
        seen = self._disturbed.observe(seen, layout, self._scene(), None if every else worlds)
        if seen is not out:
            out[worlds] = seen

    def _look(self, worlds: NDArray[np.intp]) -> ObservationInputs:
        """Return the inputs to the observations of these worlds now, true or believed."""
        batch, every = self.worlds, len(worlds) == len(self.worlds.steps)
        if every and not self.setup.disturbances:
            seen = self.true._replace(states=self._sensed)
        else:
            seen = self._disturbed.see(self._scene(self._sensed), None if every else worlds)
        if every:
            self._seen = seen
        else:
            # Not in place: of what was seen last some may be the worlds' own arrays, or a disturbance's memory.
            self._seen = Observed(*(np.array(part) for part in self.seen))
            for past, new in zip(self._seen, seen):
                past[worlds] = new
        rows = slice(None) if every else worlds
        time_left = np.maximum(0.0, 1.0 - batch.steps[rows] / self.max_cycles).astype(np.float32)
        return ObservationInputs(batch.goal[rows], *seen[:2], batch.arrived[rows], seen.bodies, time_left)

    def _reward(self, before: WorldBatch | None, length: Floats, restarted: list[int]) -> None:
        """Give the robots rewards for the step from ``before``, with paths of ``length``; none where one restarted."""
        worlds = self.worlds
        self.robot_rewards = worlds.rewards.copy()
        if restarted:
            self.robot_rewards[restarted] = 0
        if self.setup.reward is None or before is None:
            return
        for name in _READ_BEFORE if restarted else ():
            getattr(before, name)[restarted] = getattr(worlds, name)[restarted]
        problem, rows = self.problems.all[0], self.reward_rows
        step = RewardInput.of_worlds(before, worlds, self.robot_rewards, self.reached, problem, rows)
        if self.setup.along_paths:
            length[restarted] = self._paths.length[restarted]
            step = along_paths(step, self._paths.first_length[rows], length[rows], self._paths.length[rows])
        rewards, terms = compute_rewards(self.setup.reward, step)
        self.robot_rewards = rewards.reshape(worlds.arrived.shape)
        self.terms = {name: term.reshape(worlds.arrived.shape) for name, term in terms.items()}
        for values in (self.robot_rewards, *self.terms.values()) if restarted else ():
            values[restarted] = 0
        worlds.reward[:] = self.robot_rewards.mean(axis=1)
        worlds.total_reward[:] = before.total_reward + self.robot_rewards.sum(axis=1)

    def _reached(self) -> BoolArray:
        worlds, problems = self.worlds, self.problems
        parts = zip(problems.all, problems.seen, worlds.goal, worlds.state, worlds.control)
        return np.stack(
            [reached_goals(one.team, seen._replace(goal=goal), *moved) for one, seen, goal, *moved in parts]
        )

    def _assign_goals(self) -> None:
        """Give robots that have reached their goals others."""
        self._goals_reached += self.reached
        for world in np.flatnonzero(self.reached.any(axis=1)).tolist():
            robots, one = np.flatnonzero(self.reached[world]), self.worlds.select(slice(world, world + 1))
            assign_goals(self.problems.all[world], robots, one, self._random[world], self.setup.next_goal)
