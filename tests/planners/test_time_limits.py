"""Time limits: they end an iteration that would take too long, and change nothing where they are not reached."""

from __future__ import annotations

from itertools import count
from typing import Any

import numpy as np
import pytest
from planner_support import cheap_planner, hop_problem, walled_in_problem

from d4orm_env.scenarios import make_problem
from d4orm_planners import Plan, list_planners, make_planner
from d4orm_planners.base.planner_registry import PLANNERS
from d4orm_planners.base.solve import SolveRun, Stopwatch
from d4orm_planners.baselines.ipopt import ABANDONED, OUT_OF_TIME
from d4orm_planners.engine.sampling_types import SamplingRules, SamplingTask, get_sampling_engine
from d4orm_planners.sampling.weights import SoftmaxWeights

ALL = pytest.mark.parametrize("name", list_planners())
LOOKS = 40
"""A clock of these tests shows a second more at every look, and this many are granted."""
STEPS = 2000


class Clock(Stopwatch):
    """Stands still but for a second at every look at it."""

    def __init__(self) -> None:
        super().__init__()
        self._looks = count(1)

    @property
    def elapsed(self) -> float:
        return float(next(self._looks))


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("d4orm_planners.base.solve.Stopwatch", Clock)


def long_winded(name: str, **settings: Any) -> Any:
    """A planner whose iterations are far too long."""
    known = PLANNERS[name].config_class.setting_names(settings)
    long = {"num_steps": STEPS, "repair_steps": STEPS, "solver_iterations": STEPS, "tolerance": 1e-12}
    return cheap_planner(name, **{key: value for key, value in long.items() if key in known} | settings)


def longest_iteration(plan: Plan) -> int:
    """Denoising steps; every node of D-D4orm has a clock of its own, set anew in every round."""
    return int(np.diff([0, *(record.denoising_steps for record in plan.history)]).max())


@ALL
@pytest.mark.parametrize("scenario", ["walled in", "circle"])
def test_no_iteration_goes_on_beyond_the_limit(name: str, scenario: str, clock: None) -> None:
    problem = walled_in_problem() if scenario == "walled in" else make_problem("circle", num_robots=8)
    start = {"start": "straight"} if name == "d4orm-d" else {}
    plan = long_winded(name, **start, improve=True).solve(problem, time_limit=LOOKS, max_iterations=10**6)
    assert plan.status == "time_limit"
    assert longest_iteration(plan) <= LOOKS
    if name == "ipopt":
        # Where there is no path, a quick solver may have found that out with its last iteration.
        found_out = ("Infeasible_Problem_Detected",) if scenario == "walled in" else ()
        assert plan.history[-1].note in ("User_Requested_Stop", ABANDONED, OUT_OF_TIME, *found_out)
    elif name not in ("mapf", "amswarm") and (name, scenario) != ("mmd", "walled in"):
        assert plan.denoising_steps > 0
    assert plan.iterations == len(plan.history)


@pytest.mark.parametrize("inner", ["d4orm", "d4orm-d"])
@pytest.mark.parametrize("mode", ["sync", "async"])
def test_no_node_goes_on_beyond_the_limit(inner: str, mode: str, clock: None) -> None:
    planner = long_winded("d-d4orm", planner=inner, mode=mode, nodes=3, improve=True, timeout=60)
    plan = planner.solve(make_problem("circle", num_robots=8), time_limit=LOOKS, max_iterations=10**6)
    assert plan.status == "time_limit"
    # Had a node not finished in time, a note would tell.
    assert not any(record.note for record in plan.history)
    assert 0 < longest_iteration(plan) <= LOOKS


def test_mmd_stops_between_the_first_motions_of_robots(monkeypatch: pytest.MonkeyPatch) -> None:
    planned = []
    monkeypatch.setattr("d4orm_planners.baselines.mmd.planner.Planning._plan", lambda *given: planned.append(given))
    planner = make_planner("mmd")
    plan = planner.solve(make_problem("circle", num_robots=4), time_limit=1e-9)
    assert plan.status == "time_limit"
    assert not planned


def test_what_an_iteration_has_by_then_is_a_candidate(clock: None) -> None:
    problem = make_problem("circle", num_robots=2)
    own = {"engine": "cpu", "num_samples": 64, "final_approach": False}
    planner = make_planner("mppi", **own, num_steps=STEPS)
    plan = planner.solve(problem, time_limit=LOOKS)
    # An iteration of the steps that there was time for comes to the same.
    same = make_planner("mppi", **own, num_steps=plan.denoising_steps)
    assert 0 < plan.denoising_steps < STEPS
    assert plan.iterations == 1
    np.testing.assert_array_equal(plan.controls, same.solve(problem, max_iterations=1).controls)


@ALL
def test_a_limit_that_is_not_reached_changes_nothing(name: str) -> None:
    problem = hop_problem(2) if name == "ipopt" else make_problem("circle", num_robots=4)
    plans = [cheap_planner(name).solve(problem, seed=2, time_limit=limit) for limit in (None, 1e6)]
    assert plans[0].status == plans[1].status != "time_limit"
    np.testing.assert_array_equal(plans[0].controls, plans[1].controls)


@pytest.mark.parametrize("name", ["d4orm", "d4orm-d", "mbd"])
def test_a_search_that_is_cancelled_leaves_its_iteration(name: str) -> None:
    search = SolveRun(long_winded(name), walled_in_problem(), 0, None)
    search.cancelled.set()
    assert search.advance().denoising_steps == 0


@pytest.mark.parametrize("engine", ["cpu", "jax"])
def test_an_engine_stops_between_steps(engine: str) -> None:
    task = SamplingTask(hop_problem(2, horizon=10), np.zeros((10, 2, 2), np.float32))
    rules = SamplingRules(SoftmaxWeights(0.3))
    mean, scale = np.zeros_like(task.base), np.linspace(1, 0.1, 9, dtype=np.float32)

    def run(steps: int, should_stop: Any = None) -> Any:
        return get_sampling_engine(engine).denoise(task, rules, mean, scale[:steps], 64, 3, should_stop)

    whole, never = run(9), run(9, lambda: False)
    np.testing.assert_array_equal(whole.mean, never.mean)
    np.testing.assert_array_equal(whole.rewards, never.rewards)
    looks = count()
    part = run(9, lambda: next(looks) == 2)
    done = len(part.rewards)
    # JAX does several steps between two looks.
    assert 2 <= done <= (2 if engine == "cpu" else 3)
    np.testing.assert_array_equal(part.rewards, whole.rewards[:done])
    np.testing.assert_allclose(part.mean, run(done).mean, atol=0 if engine == "cpu" else 1e-6)
    nothing = run(9, lambda: True)
    np.testing.assert_array_equal(nothing.mean, mean)
    assert len(nothing.rewards) == 0


def test_a_stopwatch_leaves_pauses_out_also_while_they_last(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr("time.perf_counter", lambda: now)
    watch = Stopwatch()
    now = 103.0
    with watch.paused():
        now = 105.0
        assert watch.paused_seconds == 2
    now = 110.0
    watch.leave_out(1.5)
    assert (watch.elapsed, watch.paused_seconds) == (6.5, 3.5)
    with watch.paused():
        now = 111.0
        assert watch.paused_seconds == 4.5
    assert (watch.elapsed, watch.paused_seconds) == (6.5, 4.5)
