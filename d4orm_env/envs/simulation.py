"""The world as it goes on: one team, step by step, behind every environment of this package.

The environments are thin shells around :class:`Simulation`, which holds the state, the clock, the goals and the
execution noise, and calls an engine for the physics and the observations.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from d4orm_env.core.arrays import BoolArray, FloatArray, frozen_array, whole_number
from d4orm_env.core.disturbance_events import DisturbanceEvents
from d4orm_env.core.lazy import LazyModule
from d4orm_env.core.observation_layout import BoundsSlack, ObservationLayout
from d4orm_env.core.problem import Problem
from d4orm_env.core.problem_arrays import ProblemArrays, inverse_initial_distance
from d4orm_env.disturbances.chosen import total_slack
from d4orm_env.disturbances.disturbance import DisturbanceEffect, Observed, Scene
from d4orm_env.disturbances.disturbed_worlds import DisturbedWorlds
from d4orm_env.disturbances.recorded_events import marks_of
from d4orm_env.engine.types import ObservationInputs, StepResult, WorldEngine
from d4orm_env.envs.episode_record import EpisodeRecord
from d4orm_env.envs.inputs import checked_cycles, checked_states
from d4orm_env.envs.joint_state import JointState, join_state, state_bounds
from d4orm_env.envs.lifelong import fresh_goal, goal_region, reached_goals
from d4orm_env.envs.options import EnvOptions
from d4orm_env.envs.rewards import (
    RewardFunction,
    RewardInput,
    along_paths,
    compute_rewards,
    find_reward,
    no_terms,
    paper_reward,
)
from d4orm_env.envs.team_step import TeamStep
from d4orm_env.paths.shortest_paths import observe_paths

if TYPE_CHECKING:
    from d4orm_env.engine import cpu
else:
    cpu = LazyModule("d4orm_env.engine.cpu")

_MAX_OBSERVED = 10_000
_OPEN_WORLD_EXTENT = 1000.0
_TRAIL_LENGTH = 50


class Simulation:
    """A team in its world, stepped with the whole team's controls.

    Args:
        options: Options of the simulation.

    Raises:
        ValueError: For an argument out of range.
    """

    def __init__(self, options: EnvOptions) -> None:
        problem, self._redraw = options.instances()
        self.stochastic = options.stochastic
        self.problem = problem
        self.max_cycles = checked_cycles(problem.horizon if options.max_cycles is None else options.max_cycles)
        self.disturbances = options.disturbances_of(problem)
        self._slack = self._slack_of(problem)
        self.lifelong = options.lifelong
        self.reward = find_reward(options.reward)
        self.layout = ObservationLayout.for_problem(
            problem,
            num_neighbors=whole_number(options.observed_robots, "observed_robots", 0, _MAX_OBSERVED),
            num_obstacles=whole_number(options.observed_obstacles, "observed_obstacles", 0, _MAX_OBSERVED),
            observed_path=options.observed_path,
            slack=self._slack,
        )
        self._disturbed: DisturbedWorlds | None = None
        self._disturb(0)  # to know what bodies there are
        # In an open world the two are the same.
        self.along_paths = options.progress == "path" and problem.world.num_obstacles > 0
        if self.along_paths:
            self.reward = self.reward or paper_reward
            problem.check_reachable()
        self._engine: WorldEngine = cpu.CpuEngine()
        self._dimension = problem.dimension
        self._places = goal_region(problem)
        if self.redraws and problem.world.lower is None:
            # Nothing but the scenario bounds its instances in an open world, so leave ample room.
            extent = max(_OPEN_WORLD_EXTENT, 10 * float(np.abs(self._places).max()))
            self._places = np.array([[-extent], [extent]], np.float32).repeat(problem.dimension, axis=1)
        self._running = False

    def __setstate__(self, state: dict[str, object]) -> None:
        # NumPy unpickles read-only arrays as writable ones, for which the engine would have to compile anew.
        self.__dict__ |= state
        low, high = (frozen_array(bound, "bounds", (None,)) for bound in (self.layout.low, self.layout.high))
        self.layout = replace(self.layout, low=low, high=high)
        if self._running:
            for array in (*self.arrays, *self.arrays.grid):
                if isinstance(array, np.ndarray):
                    array.setflags(write=False)
            if self._disturbed is not None:
                self._true_limits.setflags(write=False)

    @property
    def state_bounds(self) -> tuple[FloatArray, FloatArray]:
        """Finite bounds of :meth:`state`, for the present ``max_cycles``."""
        num_bodies = 0 if self._disturbed is None else self._disturbed.bodies.shape[1]
        return state_bounds(self.problem, self._places, self.max_cycles, self._slack, num_bodies)

    @property
    def out_of_time(self) -> bool:
        """True if ``max_cycles`` steps have been taken."""
        return self.steps >= self.max_cycles

    @property
    def trail(self) -> FloatArray:
        """``(T, K, d)`` positions over the last steps, the present last [m]."""
        return np.stack(self._trail)

    @property
    def redraws(self) -> bool:
        """True if every reset draws a new instance."""
        return self._redraw is not None

    def draw_instance(self, random: np.random.Generator) -> Problem:
        """A new instance of the scenario.

        Raises:
            RuntimeError: If there is nothing to draw from.
            ValueError: If the spaces that were made for the first instance do not hold it.
        """
        if self._redraw is None:
            raise RuntimeError("this simulation keeps its problem; give redraw to draw instances")
        drawn, old, places = self._redraw(int(random.integers(2**31))), self.problem, self._places
        points = np.concatenate([drawn.start[:, : old.dimension], drawn.goal])
        if (
            drawn.team.models != old.team.models
            or (drawn.team.control_limits != old.team.control_limits).any()
            or (points < places[0]).any()
            or (points > places[1]).any()
        ):
            raise ValueError(
                f"the instance drawn from scenario {drawn.name!r} has another team or lies outside "
                f"{places.tolist()} m, where the state space ends; use a scenario whose seed changes places only"
            )
        if self.along_paths:
            drawn.check_reachable()
        return drawn

    def require_reset(self) -> None:
        """Raise ``RuntimeError`` unless an episode has begun."""
        if not self._running:
            raise RuntimeError("no episode has begun; call reset() first")

    def reset(self, random: np.random.Generator) -> TeamStep:
        """Begin an episode at the start; everything random in it follows from one draw from ``random``.

        Raises:
            ValueError: If the instance drawn does not fit the spaces fixed by the first one.
        """
        # One draw per episode, so that an episode does not depend on how long those before it were.
        seed = int(random.integers(2**63))
        self._random = np.random.default_rng(seed)
        if self.redraws:
            self.problem = self.draw_instance(self._random)
        problem = self.problem
        self.arrays = problem.arrays_to_observe(self.layout.num_obstacles)
        self.states = problem.start
        self.arrived = np.zeros(problem.num_robots, np.bool_)
        self.controls = np.zeros((problem.num_robots, problem.control_size), np.float32)
        self.steps = 0
        self._disturb(seed)
        self.collided, margin_violated = self._contacts()
        self.record = EpisodeRecord(problem.num_robots, problem.dt, self.lifelong)
        self._terms = no_terms(self.reward, (problem.num_robots,))
        self._trail: deque[FloatArray] = deque([self.states[:, : self._dimension]], _TRAIL_LENGTH)
        self._running = True
        return self._report(np.zeros(problem.num_robots, np.float32), self.arrived.copy(), margin_violated)

    def step(self, controls: FloatArray) -> TeamStep:
        """Advance one time step under ``controls`` ``(K, m)``; those of docked robots do not matter.

        Raises:
            RuntimeError: Before the first reset, or if lifelong mode finds no room for a goal.
        """
        self.require_reset()
        arrays, states = self.arrays, self.states
        if self._disturbed is not None:
            acted = self._disturbed.act(self._scene(), controls[None])
            states, controls = acted[0][0], acted[1][0]
            if self._disturbed.alters_limits:
                arrays = arrays._replace(limits=self._true_limits)
        if self.lifelong:
            # A goal radius that nothing is within: a robot under way to its next goal neither docks nor stops.
            arrays = arrays._replace(squared_goal_radius=np.float32(-1))
        result = self._with_disturbers(self._move(arrays, states, controls))
        if self.lifelong:
            arrived = reached_goals(self.problem.team, self.arrays, result.states, result.controls)
        else:
            arrived = result.arrived.copy()
        rewards = result.rewards if self.reward is None else self._rewards(self.reward, result, arrived)
        self.states, self.controls, self.collided = result.states, result.controls, result.collided
        self.arrived = result.arrived
        self.steps += 1
        self._trail.append(self.states[:, : self._dimension])
        if self.lifelong:
            self._assign_goals(np.flatnonzero(arrived))
        self.record.add(rewards, arrived, result.collided, result.margin_violated)
        return self._report(rewards, arrived, result.margin_violated)

    def _slack_of(self, problem: Problem) -> BoundsSlack:
        """Room beyond the limits of the robots that the spaces need."""
        return total_slack(self.disturbances, problem)

    def _move(self, arrays: ProblemArrays, states: FloatArray, controls: FloatArray) -> StepResult:
        """One step of the bodies, which another physics overrides; arguments as of the engine's step."""
        return self._engine.step(arrays, states, self.arrived, controls)

    def set_state(self, states: ArrayLike) -> TeamStep:
        """Put the robots elsewhere in the middle of an episode; all else stays as it is.

        Goals, clock, the controls executed last and the metrics so far are kept. A robot that has docked stays docked
        where it is put; one that is put at its goal docks at the end of the next step, if it is still there.

        Args:
            states: ``(K, n)``.

        Raises:
            RuntimeError: Before the first reset.
            ValueError: If the states have another shape, are not finite, faster than the robots may be, outside the
                state space, have padding that is not zero, or move a docked robot. Contact is allowed.
        """
        self.require_reset()
        shape = self.problem.start.shape
        self.states = checked_states(self.problem, states, self.arrived & self.problem.docks, self.state_bounds, shape)
        self.collided, margin_violated = self._contacts()
        self._terms = no_terms(self.reward, self.arrived.shape)
        self._trail.append(self.states[:, : self._dimension])
        return self._report(np.zeros(len(self.states), np.float32), self.arrived.copy(), margin_violated)

    def state(self) -> FloatArray:
        """The joint state vector; see :mod:`d4orm_env.envs.joint_state`."""
        return self._joined(self._seen)

    def true_state(self) -> FloatArray:
        """:meth:`state` as it truly is, whatever is seen."""
        return self._joined(None)

    def _joined(self, seen: Observed | None) -> FloatArray:
        self.require_reset()
        states, controls, bodies = self.states, self.controls, None
        if seen is not None:
            states, controls, bodies = (part[0] for part in seen)
        elif self._disturbed is not None:
            bodies = self._disturbed.bodies[0]
        joint = JointState(states, self.arrays.goal, controls, self.arrived, self.steps)
        return join_state(joint if bodies is None else joint._replace(bodies=bodies))

    def metrics(self) -> dict[str, float]:
        """The episode so far in numbers; see :meth:`d4orm_env.envs.episode_record.EpisodeRecord.metrics`."""
        self.require_reset()
        lost = self.effect().lost
        return self.record.metrics(None if lost is None else lost[0])

    def effect(self) -> DisturbanceEffect:
        """Return the effect of the disturbances up to now, as of a batch of one world."""
        self.require_reset()
        return DisturbanceEffect() if self._disturbed is None else self._disturbed.effect(self._scene())

    @property
    def finished(self) -> BoolArray:
        """``(K,)`` robots that are done: those that have docked or, where none docks, all once all are there."""
        if self.lifelong:
            return np.zeros_like(self.arrived)
        return self.arrived if self.problem.docks else self.arrived & self.arrived.all()

    def marks(self) -> DisturbanceEvents | None:
        """Return the disturbances of the present moment, as far as they can be drawn; ``None`` without any."""
        return marks_of([self.effect()], self.problem) if self.disturbances else None

    def _disturb(self, seed: int) -> None:
        """Begin the disturbances of an episode."""
        self._seen: Observed | None = None
        if not self.disturbances:
            return
        problem, disturbed = self.problem, self._disturbed
        if disturbed is None or disturbed.problem is not problem or disturbed.max_cycles != self.max_cycles:
            self._disturbed = disturbed = DisturbedWorlds(self.disturbances, problem, 1, self.max_cycles)
            self._true_limits = disturbed.true_limits(problem.arrays.limits)
        disturbed.begin(np.arange(1), [seed], problem.start[None], problem.goal[None])

    def _scene(self) -> Scene:
        assert self._disturbed is not None
        start, goal, steps = self.problem.start[None], self.arrays.goal[None], np.array([self.steps])
        return self._disturbed.scene(start, goal, self.states[None], self.controls[None], self.arrived[None], steps)

    def _contacts(self) -> tuple[BoolArray, BoolArray]:
        """``(K,)`` robots in contact, and within the margin, where all are now."""
        collided, violated = self._engine.contacts(self.arrays, self.states)
        if self._disturbed is None or not self._disturbed.bodies.shape[1]:
            return collided, violated
        touched, near = self._disturbed.touched(np.array(self.states)[None])
        return collided | touched[0], violated | near[0]

    def _with_disturbers(self, result: StepResult) -> StepResult:
        """The result of a step with contacts with bodies that are no robots."""
        if self._disturbed is None or not self._disturbed.bodies.shape[1]:
            return result
        touched, near = self._disturbed.touched(result.states[None])
        return result.with_contacts(touched[0], near[0], self.arrays.collision_penalty)

    def _rewards(self, reward: RewardFunction, result: StepResult, arrived: BoolArray) -> FloatArray:
        """``(K,)`` of the step from the present states to ``result``."""
        step = RewardInput(
            previous_states=self.states,
            states=result.states,
            controls=result.controls,
            goals=self.arrays.goal,
            previous_distances=self._distances(self.states),
            distances=self._distances(result.states),
            initial_distances=np.float32(1) / self.arrays.inverse_initial_distance,
            previously_arrived=self.arrived,
            arrived=arrived,
            collided=result.collided,
            margin_violated=result.margin_violated,
            paper=result.rewards,
            team=self.problem.team,
            dt=self.problem.dt,
        )
        if self.along_paths:
            lengths = map(self.problem.shortest_paths.distance, (step.previous_positions, step.positions))
            step = along_paths(step, self.problem.shortest_paths.length, *lengths)
        rewards, self._terms = compute_rewards(reward, step)
        return rewards

    def _distances(self, states: FloatArray) -> FloatArray:
        """``(K,)`` to the present goals [m]."""
        offsets = self.arrays.goal - states[:, : self._dimension]
        distances: FloatArray = np.sqrt(np.add.reduce(offsets * offsets, axis=1))
        return distances

    def _report(self, rewards: FloatArray, arrived: BoolArray, margin_violated: BoolArray) -> TeamStep:
        observations, distances = self._observe(), self._distances(self.states)
        self.last = TeamStep(observations, rewards, arrived, self.collided, margin_violated, distances, self._terms)
        return self.last

    def _observe(self) -> FloatArray:
        """``(K, D)`` what the robots see, or believe to see."""
        layout = self.layout
        time_left = max(0.0, 1.0 - self.steps / self.max_cycles)
        states, controls, bodies = self.states, self.controls, None
        if self._disturbed is not None and self._disturbed.alters_sight:
            self._seen = self._disturbed.see(self._scene())
            states, controls, bodies = (part[0] for part in self._seen)
        sight = ObservationInputs.of_team(self.arrays.goal, states, controls, self.arrived, time_left, bodies)
        observations: FloatArray = np.empty((len(self.states), layout.size), np.float32)
        self._engine.observe_worlds(self.arrays, layout, sight, observations[None])
        if layout.observed_path:
            observe_paths(observations, layout, *self.problem.shortest_paths.ahead(states[:, : self._dimension]))
        return observations if self._disturbed is None else self._disturbed.observe(observations[None], layout)[0]

    def _assign_goals(self, robots: NDArray[np.intp]) -> None:
        if not len(robots):
            return
        problem, positions = self.problem, self.states[:, : self._dimension]
        goals, scale = self.arrays.goal.copy(), self.arrays.inverse_initial_distance.copy()
        for robot in robots:
            goals[robot] = fresh_goal(problem, int(robot), positions, goals, self._random)
        scale[robots] = inverse_initial_distance(positions[robots], goals[robots], problem.goal_radius)
        self._set_goals(goals, scale)

    def _set_goals(self, goals: FloatArray, inverse_initial_distance: FloatArray) -> None:
        # Read-only like the arrays they replace: the engine compiles anew for writable ones.
        goals.setflags(write=False)
        inverse_initial_distance.setflags(write=False)
        self.arrays = self.arrays._replace(goal=goals, inverse_initial_distance=inverse_initial_distance)
