"""Base of the environments of one team: a simulation of one world, and pictures of it in one window or image."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, TypeAlias

import gymnasium
import numpy as np
from numpy.typing import ArrayLike, NDArray

from d4orm_env.core.arrays import BoolArray, FloatArray, is_one_of, short_repr
from d4orm_env.core.gaps import touching
from d4orm_env.core.lazy import LazyModule
from d4orm_env.core.observation_layout import ObservationLayout
from d4orm_env.core.problem import Problem
from d4orm_env.core.trajectory import DisturbanceEvents
from d4orm_env.disturbances.disturbance import DisturbanceEffect, Observed, events_of
from d4orm_env.envs.joint_state import JointState, join_state
from d4orm_env.envs.options import EnvOptions
from d4orm_env.envs.rewards import no_terms
from d4orm_env.envs.setup import EnvSetup
from d4orm_env.envs.simulation import Simulation
from d4orm_env.envs.team_step import TeamStep

if TYPE_CHECKING:
    from d4orm_env.render import frames
else:
    frames = LazyModule("d4orm_env.render.frames")

Frame: TypeAlias = NDArray[np.uint8]
"""``(height, width, 3)``."""

RENDER_MODES = ("human", "rgb_array")
_TRAIL_LENGTH = 50


class TeamSimulation(Simulation):
    """A team in its world, stepped with the whole team's controls; ``last`` is the result of the last step or reset."""

    reward_rows = 0

    def __init__(self, setup: EnvSetup) -> None:
        super().__init__(setup)
        self._running = False

    @property
    def problem(self) -> Problem:
        """The problem of the present episode."""
        return self.problems.all[0]

    @property
    def states(self) -> FloatArray:
        """``(K, n)``, which the next step changes."""
        return self.worlds.state[0]

    @property
    def goals(self) -> FloatArray:
        """``(K, d)`` present goals, which the next step may change [m]."""
        return self.worlds.goal[0]

    @property
    def arrived(self) -> BoolArray:
        """``(K,)`` docked robots, which the next step may change."""
        return self.worlds.arrived[0]

    @property
    def finished(self) -> BoolArray:
        """``(K,)`` robots that are done: those that have docked or, where none docks, all once all are there."""
        return self.arrived if self.problem.docks else self.arrived & self.arrived.all()

    @property
    def out_of_time(self) -> bool:
        """True if ``max_cycles`` steps have been taken."""
        return bool(self.worlds.steps[0] >= self.max_cycles)

    @property
    def trail(self) -> FloatArray:
        """``(T, K, d)`` positions over the last steps, the present last [m]."""
        return np.stack(self._trail)

    def require_reset(self) -> None:
        """Raise ``RuntimeError`` unless an episode has begun."""
        if not self._running:
            raise RuntimeError("no episode has begun; call env.reset() first")

    def reset(self, random: np.random.Generator) -> TeamStep:
        """Begin an episode at the start; everything random in it follows from one draw from ``random``."""
        # One draw per episode, so that an episode does not depend on how long those before it were.
        observations, self._running = self._new_observations(), True
        self.reset_worlds({0: int(random.integers(2**63))}, observations)
        self.terms = no_terms(self.setup.reward, self.worlds.arrived.shape)
        self._trail: deque[FloatArray] = deque(maxlen=_TRAIL_LENGTH)
        return self._report_unrewarded(observations)

    def step(self, controls: FloatArray) -> TeamStep:
        """Advance one time step under ``controls`` ``(K, m)``, or actions; those of docked robots do not matter."""
        self.require_reset()
        observations = self._new_observations()
        self.step_worlds(self.controls(controls[None]), observations)
        return self._report(observations, self.robot_rewards[0], self.reached[0])

    def set_state(self, states: ArrayLike) -> TeamStep:
        """Put the robots into states ``(K, n)``; see :meth:`Simulation.put_robots`."""
        self.require_reset()
        observations = self._new_observations()
        self.put_robots(states, self.arrived, observations)
        return self._report_unrewarded(observations)

    def joined(self, shown: Observed) -> FloatArray:
        """The joint state vector of the world as it is ``seen``, or ``true``."""
        self.require_reset()
        states, controls, bodies = (part[0] for part in shown)
        return join_state(JointState(states, self.goals, controls, self.arrived, int(self.worlds.steps[0]), bodies))

    def metrics(self) -> dict[str, float]:
        """The episode so far in numbers; see :func:`d4orm_env.envs.team_step.episode_metrics`."""
        self.require_reset()
        return {name: float(values[0]) for name, values in self.episode_metrics().items()}

    def events(self) -> DisturbanceEvents | None:
        """Return the disturbances of the present moment, as far as they can be drawn; ``None`` without any."""
        if not self.setup.disturbances:
            return None
        self.require_reset()
        return events_of([self.effect()], self.problem)

    def _new_observations(self) -> FloatArray:
        return np.empty((1, self.problem.num_robots, self.setup.layout.size), np.float32)

    def _report_unrewarded(self, observations: FloatArray) -> TeamStep:
        return self._report(observations, np.zeros(len(self.arrived), np.float32), self.arrived.copy())

    def _report(self, observations: FloatArray, rewards: FloatArray, arrived: BoolArray) -> TeamStep:
        worlds = self.worlds
        self._trail.append(self.states[:, : self.setup.layout.dimension].copy())
        flags = worlds.collided[0].copy(), worlds.violated[0].copy()
        terms = {name: values[0] for name, values in self.terms.items()}
        problem, collided = self.problem, np.flatnonzero(flags[0])
        partners = touching(problem, self.states, collided, problem.rounding) if len(collided) > 1 else {}
        self.last = TeamStep(
            self.show(observations)[0], rewards, arrived, *flags, worlds.distance[0].copy(), partners, terms
        )
        return self.last


class Viewer:
    """Draws a simulation in the environment's render mode: ``"rgb_array"``, ``"human"`` or ``None``."""

    def __init__(self, render_mode: str | None) -> None:
        if render_mode is not None and not is_one_of(render_mode, RENDER_MODES):
            known = ", ".join(RENDER_MODES)
            raise ValueError(f"render_mode is {short_repr(render_mode)}; choose one of {known}, or None")
        self._mode = render_mode
        self._renderer: frames.FrameRenderer | frames.WindowRenderer | None = None
        self._problem: Problem | None = None

    def __getstate__(self) -> dict[str, object]:
        # Figures and windows are neither copied nor sent to other processes; a copy opens its own.
        return self.__dict__ | {"_renderer": None, "_problem": None}

    def render(self, simulation: TeamSimulation) -> Frame | None:
        """``(height, width, 3)`` uint8 frame in mode ``"rgb_array"``, else ``None``."""
        if self._mode is None:
            gymnasium.logger.warn("render() was called without a render mode; give render_mode= when making the env.")
            return None
        simulation.require_reset()
        if self._renderer is None or self._problem is not simulation.problem:
            self.close()
            self._renderer, self._problem = self._open(simulation.problem), simulation.problem
        frame = self._renderer.draw(
            simulation.states,
            simulation.arrived,
            simulation.worlds.collided[0],
            goals=simulation.goals,
            trail=simulation.trail,
            events=simulation.events(),
        )
        return frame if self._mode == "rgb_array" else None

    def close(self) -> None:
        """Close the window or picture; a later frame opens a new one."""
        if self._renderer is not None:
            self._renderer.close()
        self._renderer = self._problem = None

    def _open(self, problem: Problem) -> frames.FrameRenderer | frames.WindowRenderer:
        return frames.FrameRenderer(problem) if self._mode == "rgb_array" else frames.WindowRenderer(problem)


class BaseEnv:
    """A simulation, read and drawn; how it is reset and stepped is up to the environment.

    Before the first reset all that asks about an episode is a ``RuntimeError``.
    """

    options: EnvOptions  #: Options that it was made of
    metadata: dict[str, object]
    render_mode: str | None

    def _begin(self, options: EnvOptions) -> None:
        self.options, self.render_mode = options, options.render_mode
        self._viewer = self._make_viewer(options)
        self._simulation = self._make_simulation(options)
        self.metadata = type(self).metadata | {"render_fps": max(1, round(1 / self.problem.dt))}

    def _make_simulation(self, options: EnvOptions) -> TeamSimulation:
        """Make the environment's simulation; one with another physics overrides it."""
        return TeamSimulation(EnvSetup(options))

    def _make_viewer(self, options: EnvOptions) -> Viewer:
        return Viewer(options.render_mode)

    @property
    def problem(self) -> Problem:
        """The problem being run; where every reset draws a new instance, that of the present episode."""
        return self._simulation.problem

    @property
    def layout(self) -> ObservationLayout:
        """Layout of one robot's observation."""
        return self._simulation.setup.layout

    @property
    def lifelong(self) -> bool:
        """True if robots that arrive get fresh goals instead of staying there."""
        return self._simulation.setup.lifelong

    def state(self) -> FloatArray:
        """The joint state, all a planner needs to go on from here; see :mod:`d4orm_env.envs.joint_state`."""
        return self._simulation.joined(self._simulation.seen)

    def true_state(self) -> FloatArray:
        """:meth:`state` as it truly is, without disturbances of what is seen."""
        return self._simulation.joined(self._simulation.true)

    def effect(self) -> DisturbanceEffect:
        """Return the effect of the disturbances up to now, as arrays with one world as their first axis."""
        self._simulation.require_reset()
        return self._simulation.effect()

    def metrics(self) -> dict[str, float]:
        """The episode so far in numbers; see :func:`d4orm_env.envs.team_step.episode_metrics`."""
        return self._simulation.metrics()

    def render(self) -> Frame | None:
        """``(height, width, 3)`` uint8 frame in mode ``"rgb_array"``, else ``None``."""
        return self._viewer.render(self._simulation)

    def _show(self) -> None:
        """Draw what has just happened, if it is shown."""
        if self.render_mode == "human":
            self.render()

    def close(self) -> None:
        """Close the window or picture, if there is one."""
        self._viewer.close()
