"""Goals that robots are sent to under way."""

from __future__ import annotations

import numpy as np

from d4orm_env.core.arrays import Floats
from d4orm_env.core.problem import Problem


class WantedGoals:
    """Goals of robots called ``names``, from when they are heard for ``patience`` [s] at most.

    Those of the last moments are taken together, as two robots may change places, or else one by one.
    """

    def __init__(self, names: tuple[str, ...], patience: float) -> None:
        self._names, self._patience = names, patience
        self._wanted: dict[int, tuple[Floats, float]] = {}  # and when they were heard
        self.refusal = ""  #: Why one was refused last

    def hear(self, number: int, goal: Floats, now: float) -> None:
        self._wanted[number] = goal, now

    def taken(self, problem: Problem, now: float) -> Problem:
        """The problem with what robots can have of it; itself where that changes nothing."""
        self._wanted = {number: goal for number, goal in self._wanted.items() if now - goal[1] <= self._patience}
        together = self._given(problem, list(self._wanted))
        if together is not None:
            return together
        for number in list(self._wanted):
            problem = self._given(problem, [number]) or problem
        return problem

    def _given(self, problem: Problem, numbers: list[int]) -> Problem | None:
        """The problem with the goals that some robots want; ``None`` if they cannot have them."""
        goals = problem.goal.copy()
        for number in numbers:
            goals[number] = self._wanted[number][0]
        if not np.array_equal(goals, problem.goal):
            try:
                problem = problem.replace(goal=goals)
            except ValueError as error:
                self.refusal = f"goal of {', '.join(self._names[number] for number in numbers)}: {error}"
                return None
        for number in numbers:
            del self._wanted[number]
        return problem
