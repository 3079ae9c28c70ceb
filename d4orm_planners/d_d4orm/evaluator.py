"""State shared by the nodes of one process: their candidates, each evaluated once, and the word to stop."""

from __future__ import annotations

import threading

from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.problem import Problem
from d4orm_planners.base.candidate import Candidate, evaluate_controls
from d4orm_planners.engine.sampling_types import SamplingEngine


class Stopped(Exception):
    """An iteration was left because its result is no longer wanted."""


class Evaluator:
    """Judges candidates, and remembers some.

    Args:
        engine: Engine for rollouts.
        problem: The problem.
        remembered: Candidates of this process's own nodes that are remembered.

    Attributes:
        engine: Engine for rollouts.
        problem: The problem.
        stop: Once set, nodes leave their iterations between denoising steps.
        solution_ends: Whether to set it at the first solution.
    """

    def __init__(self, engine: SamplingEngine, problem: Problem, remembered: int = 0) -> None:
        self.stop = threading.Event()
        self.solution_ends = False
        self.engine, self.problem, self._remembered = engine, problem, remembered
        self._known: dict[bytes, Candidate] = {}
        self._lock = threading.Lock()

    def own(self, controls: FloatArray) -> Candidate:
        """Judge what a node of this process has made.

        Raises:
            Stopped: If it is no longer wanted.
        """
        # Evaluation holds the interpreter's lock: two at once would both be half as fast.
        with self._lock:
            if self.stop.is_set():
                raise Stopped
            candidate = evaluate_controls(self.engine, self.problem, controls)
            self._known[candidate.planned.tobytes()] = candidate
            while len(self._known) > self._remembered:
                del self._known[next(iter(self._known))]
            if candidate.solved and self.solution_ends:
                self.stop.set()
        return candidate

    def received(self, controls: FloatArray) -> Candidate:
        """Judge what has arrived; the very controls that a node of this process has made are known already."""
        return self._known.get(controls.tobytes()) or evaluate_controls(self.engine, self.problem, controls)
