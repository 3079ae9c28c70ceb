"""Disturbances of the worlds of a batch."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import BoolArray, FloatArray
from d4orm_env.core.observation_layout import ObservationLayout
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.disturbances.disturbance import Observed, Scene
from d4orm_env.disturbances.disturbed_worlds import DisturbedWorlds
from d4orm_env.engine.types import ObservationInputs
from d4orm_env.envs.simulation import Simulation

if TYPE_CHECKING:
    from d4orm_env.engine.episodes import WorldBatch

Worlds = NDArray[np.intp]


class DisturbedBatch:
    """The disturbances of ``B`` worlds; without any it leaves the worlds as they are.

    Args:
        template: The simulation whose problem and disturbances the worlds share.
        worlds: The worlds, which are changed in place.
    """

    def __init__(self, template: Simulation, worlds: WorldBatch) -> None:
        problem, cycles = template.problem, template.max_cycles
        self._worlds, self._cycles = worlds, cycles
        self._disturbed = DisturbedWorlds(template.disturbances, problem, len(worlds.steps), cycles)
        self._penalty = problem.arrays.collision_penalty
        self._limits = self._disturbed.true_limits(problem.arrays.limits)
        self._seen: Observed | None = None
        self._nothing = not template.disturbances

    @property
    def alters_sight(self) -> bool:
        """True if what is seen may differ from what the kernel that steps the worlds knows of the robots."""
        return self._disturbed.alters_sight or self._disturbed.alters_limits

    @property
    def lost(self) -> BoolArray | None:
        """``(B, K)`` robots that will never arrive, if there can be any."""
        return self._disturbed.effect(self._scene).lost

    @property
    def seen(self) -> Observed:
        """Return the view of all worlds, which is the truth unless something alters it."""
        worlds = self._worlds
        return self._seen or Observed(worlds.state, worlds.control, self._disturbed.bodies)

    def true(self, arrays: ProblemArrays) -> ProblemArrays:
        """A problem with the limits that its robots truly have."""
        return arrays if self._nothing else arrays._replace(limits=self._limits)

    def begin(self, worlds: Worlds, seeds: NDArray[np.int64]) -> None:
        """Begin the episodes of these worlds, where they start now, by what they have drawn."""
        if not self._nothing:
            start, goal = self._worlds.start[worlds], self._worlds.goal[worlds]
            self._disturbed.begin(worlds, seeds[worlds].tolist(), start, goal)

    def act(self, controls: FloatArray) -> FloatArray:
        """Disturb ``controls`` ``(B, K, m)`` at the beginning of a step, in which states may change too."""
        if self._nothing:
            return controls
        states, controls = self._disturbed.act(self._scene, controls)
        if states is not self._worlds.state:
            np.copyto(self._worlds.state, states)
        return controls

    def meet(self, moved: BoolArray) -> None:
        """Count what robots of the worlds that have ``moved`` ``(B,)`` have met that is no robot."""
        if not self._disturbed.bodies.shape[1]:
            return
        worlds = self._worlds
        touched, near = self._disturbed.touched(worlds.state)
        worlds.contacts[moved] += (touched & ~worlds.collided)[moved]
        worlds.violations[moved] += (near & ~worlds.violated)[moved]
        cost = self._penalty * near[moved]
        worlds.rewards[moved] -= cost
        worlds.reward[moved] -= cost.mean(axis=1)
        worlds.total_reward[moved] -= cost.sum(axis=1)
        worlds.collided[:] |= touched
        worlds.violated[:] |= near

    def look(self, worlds: Worlds) -> ObservationInputs:
        """Return the inputs to the observations of these worlds now, true or believed."""
        batch = self._worlds
        rows: Worlds | slice = slice(None) if len(worlds) == len(batch.steps) else worlds
        seen = self._disturbed.see(self._scene, None if isinstance(rows, slice) else worlds)
        if isinstance(rows, slice):
            self._seen = seen
        else:
            # Not in place: of what was seen last some may be the worlds' own arrays, or a disturbance's memory.
            self._seen = Observed(*(np.array(part) for part in self.seen))
            for past, new in zip(self._seen, seen):
                past[worlds] = new
        states, controls, bodies = (part[rows] for part in self._seen)
        time_left = np.maximum(0.0, 1.0 - batch.steps[rows] / self._cycles).astype(np.float32)
        return ObservationInputs(batch.goal[rows], states, controls, batch.docked[rows], bodies, time_left)

    def observe(self, observations: FloatArray, layout: ObservationLayout) -> FloatArray:
        """``(b, K, D)`` observations of what is seen, as robots make them."""
        return self._disturbed.observe(observations, layout)

    @property
    def _scene(self) -> Scene:
        worlds = self._worlds
        return self._disturbed.scene(
            worlds.start, worlds.goal, worlds.state, worlds.control, worlds.docked, worlds.steps
        )
