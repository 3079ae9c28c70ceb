"""The problems of a batch of worlds, as the engines read them."""

from __future__ import annotations

import numpy as np

from d4orm_env.core.problem import Problem
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.disturbances.disturbed_worlds import DisturbedWorlds
from d4orm_env.engine.types import WorldBatch
from d4orm_env.envs.setup import EnvSetup


class WorldProblems:
    """The problem of each of ``B`` worlds.

    Args:
        setup: The environment.
        disturbed: Its disturbances, which may alter limits.
        num_worlds: ``B``.

    Attributes:
        all: ``B`` problems.
        seen: Arrays that robots are observed with, of each.
        true: Arrays that they are stepped with, of each.
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

    def _arrays_of(self, problem: Problem) -> tuple[ProblemArrays, ProblemArrays]:
        seen = problem.arrays_to_observe(self._setup.layout.num_obstacles)
        true = seen
        if self._disturbed.alters_limits:
            true = true._replace(limits=self._disturbed.true_limits(seen.limits))
        if self._setup.lifelong:
            # A goal radius that nothing is within: a robot under way to its next goal neither docks nor stops.
            true = true._replace(squared_goal_radius=np.float32(-1))
        return seen, true
