"""One team in its world: a simulation of one world, whose results are the team's."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import ArrayLike

from d4orm_env.core.arrays import BoolArray, FloatArray
from d4orm_env.core.footprint_gaps import touching
from d4orm_env.core.problem import Problem
from d4orm_env.core.trajectory import DisturbanceEvents
from d4orm_env.disturbances.disturbance import DisturbanceEffect, Observed, marks_of
from d4orm_env.envs.joint_state import JointState, join_state
from d4orm_env.envs.rewards import no_terms
from d4orm_env.envs.setup import EnvSetup
from d4orm_env.envs.simulation import Simulation
from d4orm_env.envs.team_step import TeamStep

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
        return self.worlds.docked[0]

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
            raise RuntimeError("no episode has begun; call reset() first")

    def reset(self, random: np.random.Generator) -> TeamStep:
        """Begin an episode at the start; everything random in it follows from one draw from ``random``."""
        # One draw per episode, so that an episode does not depend on how long those before it were.
        observations, self._running = self._unseen(), True
        self.reset_worlds({0: int(random.integers(2**63))}, observations)
        self.terms = no_terms(self.setup.reward, self.worlds.docked.shape)
        self._trail: deque[FloatArray] = deque(maxlen=_TRAIL_LENGTH)
        return self._unpaid(observations)

    def step(self, controls: FloatArray) -> TeamStep:
        """Advance one time step under ``controls`` ``(K, m)``; those of docked robots do not matter."""
        self.require_reset()
        observations = self._unseen()
        self.step_worlds(controls[None], observations)
        return self._report(observations, self.robot_rewards[0], self.reached[0])

    def set_state(self, states: ArrayLike) -> TeamStep:
        """Put the robots into states ``(K, n)``; see :meth:`Simulation.put_robots`."""
        self.require_reset()
        observations = self._unseen()
        self.put_robots(states, self.arrived, observations)
        return self._unpaid(observations)

    def state(self) -> FloatArray:
        """The joint state vector as it is seen; see :mod:`d4orm_env.envs.joint_state`."""
        return self._joined(self.seen)

    def true_state(self) -> FloatArray:
        """:meth:`state` as it truly is, whatever is seen."""
        return self._joined(self.true)

    def metrics(self) -> dict[str, float]:
        """The episode so far in numbers; see :func:`d4orm_env.envs.team_step.episode_metrics`."""
        self.require_reset()
        return {name: float(values[0]) for name, values in self.episode_metrics().items()}

    def effect(self) -> DisturbanceEffect:
        """Return the effect of the disturbances up to now, as of a batch of one world."""
        self.require_reset()
        return super().effect()

    def marks(self) -> DisturbanceEvents | None:
        """Return the disturbances of the present moment, as far as they can be drawn; ``None`` without any."""
        return marks_of([self.effect()], self.problem) if self.setup.disturbances else None

    def _joined(self, shown: Observed) -> FloatArray:
        self.require_reset()
        states, controls, bodies = (part[0] for part in shown)
        return join_state(JointState(states, self.goals, controls, self.arrived, int(self.worlds.steps[0]), bodies))

    def _unseen(self) -> FloatArray:
        return np.empty((1, self.problem.num_robots, self.setup.layout.size), np.float32)

    def _unpaid(self, observations: FloatArray) -> TeamStep:
        return self._report(observations, np.zeros(len(self.arrived), np.float32), self.arrived.copy())

    def _report(self, observations: FloatArray, rewards: FloatArray, arrived: BoolArray) -> TeamStep:
        worlds = self.worlds
        self._trail.append(self.states[:, : self.setup.layout.dimension].copy())
        flags = worlds.collided[0].copy(), worlds.violated[0].copy()
        terms = {name: values[0] for name, values in self.terms.items()}
        problem, collided = self.problem, np.flatnonzero(flags[0])
        partners = touching(problem.team, self.states, collided, problem.rounding) if len(collided) > 1 else {}
        self.last = TeamStep(observations[0], rewards, arrived, *flags, worlds.distance[0].copy(), partners, terms)
        return self.last
