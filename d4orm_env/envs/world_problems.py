"""The problems of a batch of worlds as the engines read them, shortest paths in them, and range sensors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import FloatArray, Floats
from d4orm_env.core.problem import Problem
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.disturbances.disturbed_worlds import DisturbedWorlds
from d4orm_env.engine.types import WorldBatch
from d4orm_env.envs.setup import EnvSetup
from d4orm_env.paths.shortest_paths import ahead_in_each

if TYPE_CHECKING:
    from d4orm_env.engine.cpu import CpuEngine


class WorldProblems:
    """The problem of each of ``B`` worlds.

    Attributes:
        all: ``B`` problems.
        seen: Arrays that robots are observed with, of each.
        true: Arrays that they are stepped with, of each, as disturbances leave the limits.
        alike: Whether those of the first do for all, in one kernel call.
    """

    def __init__(self, setup: EnvSetup, disturbed: DisturbedWorlds, num_worlds: int) -> None:
        self._setup, self._disturbed = setup, disturbed
        self.all = [setup.problem] * num_worlds
        self.seen, self.true = ([arrays] * num_worlds for arrays in self._arrays_of(setup.problem))
        self.alike = True

    def __setstate__(self, state: dict[str, object]) -> None:
        # NumPy unpickles read-only arrays as writable ones, for which the engine would have to compile anew.
        self.__dict__ |= state
        self.seen, self.true = map(list, zip(*map(self._arrays_of, self.all)))

    def begin(self, world: int, random: np.random.Generator, worlds: WorldBatch) -> None:
        """Give a world of ``worlds`` the start and the goals of its next episode, of a problem drawn if any is."""
        problem = self.all[world]
        if self._setup.redraws:
            problem = self.all[world] = self._setup.choose(random)
            self.seen[world], self.true[world] = self._arrays_of(problem)
            if len(self.all) == 1:
                self._disturbed.problem = problem
            else:
                self.alike &= self._setup.shares_world(problem)
        worlds.start[world], worlds.goal[world] = problem.start, problem.goal
        worlds.inverse[world] = problem.arrays.inverse_initial_distance

    def sense_ranges(
        self, engine: CpuEngine, batch: WorldBatch, out: FloatArray, worlds: NDArray[np.intp] | None = None
    ) -> None:
        """Fill the rays of the observations ``out`` ``(b, K, D)`` of some worlds, or of all, as these truly are."""
        layout = self._setup.layout
        if not layout.num_rays:
            return
        rows = slice(None) if worlds is None else worlds
        state, bodies = batch.state[rows], batch.bodies[rows]
        if self.alike:
            engine.cast_rays(self.true[0], layout, state, bodies, out)
            return
        for row, world in enumerate(range(len(out)) if worlds is None else worlds):
            one = slice(row, row + 1)
            engine.cast_rays(self.true[world], layout, state[one], bodies[one], out[one])

    def _arrays_of(self, problem: Problem) -> tuple[ProblemArrays, ProblemArrays]:
        seen = problem.arrays_to_observe(self._setup.layout.num_obstacles)
        true = seen
        if self._disturbed.alters_limits:
            true = true._replace(limits=self._disturbed.true_limits(seen.limits))
        if self._setup.lifelong:
            # A goal radius that nothing is within: a robot under way to its next goal neither docks nor stops.
            true = true._replace(squared_goal_radius=np.float32(-1))
        return seen, true


class WorldPaths:
    """Paths of ``B`` worlds to the goals, as they were last looked for; ``one_world`` where all are one.

    Attributes:
        direction: ``(B, K, d)`` unit vectors.
        length: ``(B, K)`` [m].
    """

    def __init__(self, problems: Sequence[Problem], *, one_world: bool) -> None:
        self._problems, self._one_world = problems, one_world
        shape = len(problems), problems[0].num_robots
        self.direction: Floats = np.zeros((*shape, problems[0].dimension))
        self.length: Floats = np.zeros(shape)

    @property
    def first_length(self) -> Floats:
        """``(B, K)`` length of the paths from the starts [m]."""
        return np.stack([problem.shortest_paths.length for problem in self._problems])

    def update(self, worlds: NDArray[np.intp], states: FloatArray) -> None:
        """Look for the paths in some worlds, where the robots are in ``states`` ``(B, K, n)``."""
        self.direction[worlds], self.length[worlds] = self.look(worlds, states[worlds])

    def look(self, worlds: NDArray[np.intp], states: FloatArray) -> tuple[Floats, Floats]:
        """Directions ``(b, K, d)`` and lengths ``(b, K)`` of paths in some worlds, from ``states`` ``(b, K, n)``."""
        positions = states[..., : self.direction.shape[-1]]
        if self._one_world:
            return self._problems[0].shortest_paths.ahead(positions)
        return ahead_in_each([self._problems[world].shortest_paths for world in worlds], positions)
