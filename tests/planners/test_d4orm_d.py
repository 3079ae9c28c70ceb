"""D4orm-D solves big and dense teams, touches only robots that fail, and in its paper preset is Algorithm 3."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from env_support import slow
from planner_support import hop_problem, walled_in_problem

from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.core.world import World
from d4orm_env.scenarios import make_problem
from d4orm_env.verify import verify
from d4orm_planners import make_planner
from d4orm_planners.base.candidate import conflicts
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.d4orm_d.decoupling import failure_groups, failure_labels, regrouped
from d4orm_planners.d4orm_d.planner import D4ormD
from d4orm_planners.engine.cpu_sampling import CpuSamplingEngine
from d4orm_planners.engine.sampling_types import SamplingResult, SamplingTask

CASES = [
    pytest.param({"scenario": "circle", "num_robots": 16}, id="circle-16"),
    pytest.param({"scenario": "four_obstacles", "num_robots": 16}, id="four-obstacles-16"),
    pytest.param({"scenario": "random", "num_robots": 24, "size": 6.0}, id="random-24"),
    pytest.param({"scenario": "amswarm_5", "num_robots": 10}, id="amswarm-5"),
    pytest.param({"scenario": "heterogeneous", "num_robots": 8}, id="heterogeneous-8"),
    pytest.param({"scenario": "circle", "num_robots": 8, "model": "velocity2d"}, id="velocity2d-8"),
    pytest.param({"scenario": "random", "num_robots": 16, "model": "differential_drive"}, id="differential-drive-16"),
    pytest.param({"scenario": "swap", "num_robots": 8}, id="swap-8"),
]
BIG = [
    pytest.param({"scenario": "random", "num_robots": 64, "size": 10.0}, id="random-64"),
    pytest.param({"scenario": "circle", "num_robots": 64, "diameter": 12.0}, id="circle-64"),
    pytest.param({"scenario": "sphere", "num_robots": 64}, id="sphere-64"),
]


def assert_solves(case: dict[str, Any], seed: int, name: str = "d4orm-d", **config: Any) -> None:
    """Whatever is claimed to be solved is checked here anew."""
    problem = make_problem(**case, seed=seed)
    plan = make_planner(name, engine="cpu", **config).solve(problem, seed=seed, max_iterations=100)
    assert plan.solved, [(record.num_not_arrived, record.num_margin_violated) for record in plan.history]
    report = verify(problem, plan.controls)
    assert report.ok, report.violations


@pytest.mark.parametrize("seed", [0, slow(1)])
@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("name", ["d4orm-d", "hybrid"])
def test_default_settings_solve(name: str, case: dict[str, Any], seed: int) -> None:
    if name == "d4orm-d" and case["scenario"] == "amswarm_5":
        pytest.skip("denoising alone does not get ten robots through its gaps")
    assert_solves(case, seed, name)


@pytest.mark.slow
@pytest.mark.parametrize("case", BIG)
@pytest.mark.parametrize("name", ["d4orm-d", "hybrid"])
def test_default_settings_solve_64_robots(name: str, case: dict[str, Any]) -> None:
    assert_solves(case, 0, name)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_groups_solve_a_circle(seed: int) -> None:
    assert_solves({"scenario": "circle", "num_robots": 12}, seed, decoupling="groups")


def search_of(problem: Problem, iterations: int = 0, **config: Any) -> SolveRun:
    """A search after some iterations."""
    search = SolveRun(make_planner("d4orm-d", engine="cpu", **config), problem, 0, None)
    for _ in range(iterations):
        search.advance()
    return search


CROSSING = make_problem("circle", num_robots=12)
FEW = {"num_samples": 64, "num_steps": 10, "repair_samples": 64, "repair_steps": 10}


@pytest.mark.parametrize("clip", [True, False])
def test_the_paper_preset_replans_exactly_the_groups_that_fail(clip: bool) -> None:
    search = search_of(CROSSING, iterations=1, preset="paper", clip_between_iterations=clip, **FEW)
    assert search.current.failed.any()
    previous = None
    for _ in range(4):
        before = search.current
        graph = conflicts(before.trajectory.positions, CROSSING.team.radius, CROSSING.margin)
        grouping = regrouped(graph, previous)
        groups = failure_groups(before.failed, grouping.groups)
        replanned = {robot for group in groups for robot in group}
        search.advance()
        # Clipping what is clipped already may change the last bit.
        change = np.abs(search.current.controls - before.controls).max(axis=(0, 2))
        assert set(np.flatnonzero(change > 1e-5)) == replanned
        kept = [k for k in range(12) if k not in replanned]
        went_on_from = before.controls if clip else before.planned
        np.testing.assert_allclose(search.current.planned[:, kept], went_on_from[:, kept], atol=1e-6)
        previous = grouping


def test_the_first_iteration_of_the_paper_preset_minds_no_collisions() -> None:
    search = search_of(CROSSING, preset="paper", **FEW)
    planner = search.planner
    assert isinstance(planner, D4ormD)
    assert not planner.task(search, search.current.controls).collisions
    search.advance()
    assert planner.task(search, search.current.controls).collisions


def test_a_plan_that_the_paper_preset_makes_better_keeps_apart() -> None:
    """Without contacts in mind all would cut through the middle."""
    problem = make_problem("circle", num_robots=4, goal_speed=np.inf)
    solved = make_planner("d4orm", engine="cpu").solve(problem, seed=0)
    assert solved.solved
    search = SolveRun(
        make_planner("d4orm-d", preset="paper", engine="cpu", improve=True, num_samples=256, num_steps=20),
        problem, 0, solved.controls,
    )  # fmt: skip
    assert not search.advance().num_margin_violated


def test_an_independent_repair_leaves_whoever_does_not_fail_alone() -> None:
    search = search_of(
        make_problem("random", num_robots=16, size=6.0, seed=3, goal_speed=np.inf), iterations=1, start="straight"
    )
    repairs = 0
    while search.current.failed.any() and repairs < 8:
        before = search.current
        search.advance()
        repairs += 1
        if not search.current.failed.any():
            break  # The last repair shortens everybody's path.
        same = (search.current.controls == before.controls).all(axis=(0, 2))
        assert same[~before.failed].all()
    assert repairs >= 1
    assert search.best.solved


class Astray(CpuSamplingEngine):
    """Sampling that goes wrong: it sends everybody to the right at full throttle."""

    def denoise(self, task: Any, rules: Any, mean: Any, noise_scale: Any, *more: Any, **options: Any) -> Any:
        away = np.zeros_like(task.base)
        away[..., 0] = task.problem.team.control_limits[:, 0]
        return SamplingResult(away - task.base, np.zeros(len(noise_scale), np.float32), 0)


def test_a_repair_that_makes_things_worse_is_not_taken_over() -> None:
    """Robot 0 cannot reach its goal, and on every path there it meets robot 1, which has docked in between."""
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    ring = np.column_stack([4 + 0.8 * np.cos(angle), 0.8 * np.sin(angle), np.full(12, 0.25)])
    start = [[0, 0, 0, 0], [1.5, -0.5, 0, 0]]
    problem = Problem(
        Team(("holonomic2d",) * 2), start, [[4, 0], [1.5, 0]], World(circles=ring), horizon=60, goal_speed=np.inf
    )
    controls = np.zeros((60, 2, 2), np.float32)
    controls[:, 1, 1] = 0.5
    search = SolveRun(make_planner("d4orm-d", engine="cpu"), problem, 0, controls, Astray())
    before = search.current
    assert before.failed.tolist() == [True, False]
    search.advance()
    assert search.denoising_steps > 0, "a repair was tried"
    np.testing.assert_array_equal(search.current.trajectory.states, before.trajectory.states)


class Recorded(Astray):
    """Keeps how it was asked to sample."""

    def __init__(self) -> None:
        super().__init__()
        self.tasks: list[SamplingTask] = []
        self.scales: list[float] = []

    def prepare(self, *arguments: Any) -> None:
        """Nothing has to be compiled for what it does."""

    def denoise(self, task: Any, rules: Any, mean: Any, noise_scale: Any, *more: Any, **options: Any) -> Any:
        self.tasks.append(task)
        self.scales.append(float(np.max(noise_scale)))
        return super().denoise(task, rules, mean, noise_scale, *more, **options)


def test_the_paper_preset_goes_on_with_the_whole_team_once_there_was_a_solution() -> None:
    """Even from a worse plan: sampling goes wrong, and nobody comes to its goal on the left in the first iteration."""
    problem, engine = hop_problem(3), Recorded()
    problem = problem.replace(goal=problem.start[:, :2] - [0.5, 0])
    controls = np.zeros((problem.horizon, 3, 2), np.float32)
    controls[..., 0] = -1
    search = SolveRun(make_planner("d4orm-d", preset="paper", engine="cpu", improve=True), problem, 0, controls, engine)
    assert search.best.solved
    search.advance()
    assert search.current.failed.all()
    search.advance()
    assert [task.problem.num_robots for task in engine.tasks] == [3, 3]


def test_robots_that_were_repaired_in_vain_are_repaired_jointly_and_every_other_noise_is_wider() -> None:
    """Two robots meet in a lane where neither can pass the other, whatever they are told."""
    start = [[0, 0, 0, 0], [2, 0, 0, 0]]
    lane = World(lower=[-1, -0.25], upper=[3, 0.25])
    problem = Problem(Team(("holonomic2d",) * 2), start, [[2, 0], [0, 0]], lane, horizon=90)
    engine = Recorded()
    towards = np.zeros((90, 2, 2), np.float32)
    towards[:20, :, 0], towards[20:40, :, 0] = [0.5, -0.5], [-0.5, 0.5]
    search = SolveRun(make_planner("d4orm-d", engine="cpu"), problem, 0, towards, engine)
    recency = []
    for _ in range(7):
        search.advance()
        assert search.current.failed.all()
        recency.append(np.sort(search.state.recency))
    np.testing.assert_allclose(recency[0], [0, 0.21], err_msg="one of them was repaired, an iteration ago")
    # Six repairs, one robot at a time: before the fourth, one of them had failed only once.
    assert [task.credit for task in engine.tasks] == ["robot"] * 6 + ["team"]
    assert [task.problem.num_robots for task in engine.tasks] == [1] * 6 + [2]
    assert search.state.failures.min() >= 3
    # No longer than they move, and a little: nor are the others looked at beyond that.
    assert [len(task.moving.positions) for task in engine.tasks[:6]] == [
        task.problem.horizon for task in engine.tasks[:6]
    ]
    assert engine.tasks[0].problem.horizon < 90
    np.testing.assert_allclose(np.divide(engine.scales, engine.scales[0]), [1, 2, 1, 2, 1, 2, 1], rtol=1e-6)


def test_who_arrives_without_conflict_was_not_repaired_in_vain() -> None:
    """Few samples end somewhere; from there everybody turns straight home."""
    search = search_of(hop_problem(2), 1, start="team", **FEW)
    assert not search.current.failed.any()
    assert search.state.failures.tolist() == [0, 0]


def test_teams_of_more_than_32_are_sampled_half_as_often() -> None:
    for robots, given, samples in ((32, 256, 256), (33, 256, 128), (33, 3, 2)):
        search = search_of(make_problem("random", num_robots=robots, size=12.0), num_samples=given)
        assert isinstance(search.planner, D4ormD)
        assert search.planner.num_samples(search) == samples


@pytest.mark.parametrize(("scenario", "straight"), [("circle", False), ("random", True)])
def test_sparse_teams_start_straight(scenario: str, straight: bool) -> None:
    search = search_of(make_problem(scenario, num_robots=16, seed=0), iterations=1, big_team=8)
    assert (search.denoising_steps == 0) == straight
    drives = search_of(make_problem(scenario, num_robots=16, seed=0), iterations=1, start="straight").current
    assert drives.trajectory.arrived[-1].all()
    assert np.array_equal(drives.controls, search.current.controls) == straight


def test_given_controls_are_repaired_rather_than_thrown_away() -> None:
    problem = make_problem("random", num_robots=16, seed=0)
    drives = search_of(problem, iterations=1, start="straight").current
    assert drives.failed.any()
    assert not drives.failed.all()
    planner = make_planner("d4orm-d", engine="cpu", start="team", decoupling="independent")
    search = SolveRun(planner, problem, 0, drives.controls)
    search.advance()
    assert (search.current.controls == drives.controls).all(axis=(0, 2))[~drives.failed].all()


@pytest.mark.parametrize("preset", [None, "paper"])
def test_a_goal_that_cannot_be_reached_ends_at_the_budget(preset: str | None) -> None:
    plan = make_planner("d4orm-d", preset=preset, engine="cpu", **FEW).solve(walled_in_problem(), max_iterations=6)
    assert not plan.solved
    assert plan.status == "iteration_limit"
    assert plan.iterations == 6
    assert list(plan.failures) == ["robot_0"]
    assert "m from its goal" in plan.failures["robot_0"] or "an obstacle" in plan.failures["robot_0"]


def test_failures_name_robots_and_reasons() -> None:
    problem = make_problem("circle", num_robots=4)
    plan = make_planner("d4orm-d", start="straight", engine="cpu").solve(problem, max_iterations=1)
    assert not plan.solved
    assert plan.failures == {
        f"robot_{k}": "comes within the margin of " + ", ".join(f"robot_{i}" for i in range(4) if i != k)
        for k in range(4)
    }
    assert (plan.history[0].num_not_arrived, plan.history[0].num_margin_violated) == (0, 4)
    still = make_planner("d4orm-d", engine="cpu").solve(problem, max_iterations=10)
    assert still.solved
    assert still.failures == {}


@pytest.mark.parametrize(
    ("setting", "value", "message"),
    [
        ("decoupling", "all", "decoupling 'all' is unknown; choose one of independent, groups, joint"),
        ("start", "zero", "start 'zero' is unknown; choose one of auto, team, straight"),
        ("first_collisions", 1, "first_collisions must be True or False"),
        ("repair_samples", 1, "repair_samples is 1.*at least 2"),
        ("repair_steps", 0, "repair_steps is 0.*at least 1"),
        ("penalty", 0, "penalty is 0.*positive"),
        ("penalty_rise", 0.5, "penalty_rise is 0.5; it goes with decoupling 'joint', not 'independent'"),
        ("clip_after", 6, "clip_after is 6; it goes with decoupling 'joint'"),
        ("reset_after_probe", True, "reset_after_probe is True; it goes with decoupling 'joint'"),
    ],
)
def test_a_bad_setting_is_refused_by_name(setting: str, value: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_planner("d4orm-d", **{setting: value})


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"clip_between_iterations": True}, "clip_after is 6, but every iteration is clipped; set clip_between"),
        ({"first_collisions": True}, "reset_after_probe is True.*set first_collisions=False, or start='straight'"),
        ({"penalty": 4.0}, "penalty_limit 3 is below penalty 4; raise it"),
        ({"decoupling": "groups"}, "penalty_rise is 0.5; it goes with decoupling 'joint', not 'groups'"),
    ],
)
def test_settings_that_contradict_the_authors_preset_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_planner("d4orm-d", preset="authors", **settings)


class Lost(Recorded):
    """Keeps how it was asked to sample, and the groups; deformations are nothing, so that failures repeat."""

    def denoise(self, task: Any, rules: Any, mean: Any, noise_scale: Any, *more: Any, **options: Any) -> Any:
        self.tasks.append(task)
        self.groups = getattr(rules.weights, "groups", None)
        return SamplingResult(np.zeros_like(mean), np.zeros(len(noise_scale), np.float32), 0)


def meeting_in_pairs() -> tuple[Problem, np.ndarray]:
    """Robots 0 and 1 drive into each other, 2 drives home by itself, and 3 never does; all by far too much."""
    start = [[0, 0, 0, 0], [3, 0, 0, 0], [0, 5, 0, 0], [0, 9, 0, 0]]
    problem = Problem(
        Team(("holonomic2d",) * 4), start, [[3, 0], [0, 0], [3, 5], [3, 9]], horizon=80, goal_speed=np.inf
    )
    controls = np.zeros((80, 4, 2), np.float32)
    controls[:, :3, 0] = [5, -5, 5]
    return problem, controls


def test_the_joint_run_deforms_who_fails_by_groups_and_raises_penalties() -> None:
    problem, controls = meeting_in_pairs()
    engine = Lost()
    search = SolveRun(make_planner("d4orm-d", preset="authors", engine="cpu"), problem, 0, controls, engine)
    for _ in range(8):
        search.advance()
    first = engine.tasks[0]
    assert engine.groups == ((0, 1), (2,), (3,))
    assert first.credit == "robot"
    assert first.collisions
    assert first.penalty_per_pair
    np.testing.assert_array_equal(first.first_factor.any(axis=(0, 2)), [True, True, False, True])
    risen = [task.penalties[:2].tolist() for task in engine.tasks[:6]]
    assert risen == [[1, 1], [1.5, 1.5], [2, 2], [2.5, 2.5], [3, 3], [3, 3]]
    assert all((task.penalties[2:] == 1).all() for task in engine.tasks)
    # As wide as they were until the failure has come back six times.
    assert [float(task.base[0, 0, 0]) for task in engine.tasks] == [5] * 6 + [1] * 2


def test_a_failure_is_another_one_in_another_group() -> None:
    failed = np.array([True, True, False, True, True, True])
    labels = failure_labels(((0, 1), (2,), (3,), (4, 5)), failed)
    assert labels.tolist() == [1, 1, 0, -1, 2, 2]


def test_groups_that_are_stuck_are_repaired_jointly_in_turn() -> None:
    rows = 5 * np.arange(3)
    start, goal = np.zeros((6, 4)), np.zeros((6, 2))
    start[:, 1] = goal[:, 1] = np.repeat(rows, 2)
    start[1::2, 0] = goal[::2, 0] = 2
    towards = np.zeros((60, 6, 2), np.float32)
    towards[:20, ::2, 0], towards[:20, 1::2, 0] = 0.5, -0.5
    engine = Lost()
    problem = Problem(Team(("holonomic2d",) * 6), start, goal, horizon=60)
    search = SolveRun(make_planner("d4orm-d", engine="cpu"), problem, 0, towards, engine)
    for _ in range(13):
        search.advance()
    jointly = [task.problem.start[:, 1].tolist() for task in engine.tasks if task.credit == "team"]
    assert jointly == [[10, 10], [0, 0], [5, 5]]


@pytest.mark.parametrize("start", ["team", "straight"])
def test_after_the_probe_of_the_authors_preset_only_the_groups_stay(start: str) -> None:
    problem, _ = meeting_in_pairs()
    engine = Lost()
    search = SolveRun(make_planner("d4orm-d", preset="authors", engine="cpu", start=start), problem, 0, None, engine)
    search.advance()
    assert len(engine.tasks) == (start == "team")
    if start == "team":
        probe = engine.tasks.pop()
        assert probe.credit == "robot"
        assert not probe.collisions
    search.advance()
    assert not engine.tasks[0].base.any()
    assert engine.groups == (((0,), (1,), (2,), (3,)) if start == "team" else ((0, 1), (2,), (3,)))


def test_the_authors_preset_solves_a_circle() -> None:
    assert_solves({"scenario": "paper_circle", "num_robots": 8}, 0, preset="authors", num_samples=256)
