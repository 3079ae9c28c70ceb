"""What a planner keeps between iterations: made once, handed from one to the next, and let go of however it ends."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from planner_support import cheap_planner, hop_problem, walled_in_problem

from d4orm_planners import Iteration, Planner, PlannerConfig, SolveRun, list_planners


class Counting(Planner):
    """Its state is a number that grows by one in every iteration."""

    def __init__(self, fails_at: int | None = None, error: type[BaseException] = ZeroDivisionError) -> None:
        super().__init__(PlannerConfig())
        self.calls: list[Any] = []
        self._fails_at, self._error = fails_at, error

    def init(self, search: SolveRun) -> int:
        self.calls.append("init")
        return 0

    def iterate(self, search: SolveRun, state: int) -> tuple[int, Iteration]:
        self.calls.append(state)
        if state == self._fails_at:
            raise self._error
        return state + 1, Iteration(np.zeros_like(search.current.controls))

    def finish(self, search: SolveRun, state: int) -> None:
        self.calls.append(("finish", state))


def test_every_iteration_gets_what_the_last_one_returned() -> None:
    planner = Counting()
    planner.solve(walled_in_problem(), max_iterations=3)
    assert planner.calls == ["init", 0, 1, 2, ("finish", 3)]


def test_an_error_lets_go_of_the_last_state() -> None:
    planner = Counting(fails_at=1)
    with pytest.raises(ZeroDivisionError):
        planner.solve(walled_in_problem())
    assert planner.calls == ["init", 0, 1, ("finish", 1)]


def test_so_does_an_interrupt() -> None:
    planner = Counting(fails_at=1, error=KeyboardInterrupt)
    assert planner.solve(walled_in_problem()).status == "interrupted"
    assert planner.calls == ["init", 0, 1, ("finish", 1)]


@pytest.mark.parametrize("solved", [True, False])
def test_what_needs_no_iteration_begins_nothing(solved: bool) -> None:
    planner = Counting()
    arguments: dict[str, Any] = {"time_limit": 1e-9}
    if solved:
        arguments = {"initial_controls": cheap_planner("d4orm", num_steps=20).solve(hop_problem(1)).controls}
    plan = planner.solve(hop_problem(1), **arguments)
    assert (plan.status, plan.solved) == (("solved", True) if solved else ("time_limit", False))
    assert planner.calls == []


STATEFUL: list[tuple[str, dict[str, Any]]] = [(name, {}) for name in list_planners() if name != "ipopt"]
STATEFUL += [("d4orm-d", {"decoupling": "groups"}), ("d4orm-d", {"decoupling": "joint"})]


@pytest.mark.parametrize(("name", "settings"), STATEFUL)
def test_states_are_data_that_nobody_changes(name: str, settings: dict[str, Any]) -> None:
    search = SolveRun(cheap_planner(name, **settings), hop_problem(2), 0)
    try:
        search.advance()
        before = search.state
        assert before is None or (dataclasses.is_dataclass(before) and before.__dataclass_params__.frozen)  # type: ignore[attr-defined]
        kept = [array.copy() for array in vars(before or object).values() if isinstance(array, np.ndarray)]
        search.advance()
        now = [array for array in vars(before or object).values() if isinstance(array, np.ndarray)]
        for array, copy in zip(now, kept, strict=True):
            np.testing.assert_array_equal(array, copy)
    finally:
        search.close()
