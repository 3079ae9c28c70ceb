"""D4orm-C2F brings everyone home without contact, disturbed or not, keeps to its deadlines and says what it did."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from env_support import slow

from d4orm_env import navigation_v0
from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.core.world import World
from d4orm_env.disturbances import Delay, Intruder, Push
from d4orm_env.dynamics.robot_model import ACCELERATION
from d4orm_env.engine.threads import Threads
from d4orm_env.envs.joint_state import JointState, split_state
from d4orm_env.scenarios import make_problem
from d4orm_env.verify import verify
from d4orm_planners import Episode, make_policy, run_episode
from d4orm_planners.base import candidate
from d4orm_planners.base.episode import open_env
from d4orm_planners.base.policy_threads import SWITCH, Background
from d4orm_planners.d4orm_c2f import fine_plan
from d4orm_planners.d4orm_c2f.coarse_plan import CoarsePlanning, coarse_problem
from d4orm_planners.d4orm_c2f.direct_final_approach import direct_final_approach
from d4orm_planners.d4orm_c2f.fine_plan import Situation, Window
from d4orm_planners.d4orm_c2f.receding_horizon import D4ormC2F
from d4orm_planners.d4orm_c2f.settings import D4ormC2FConfig
from d4orm_planners.engine.cpu_sampling import CpuSamplingEngine
from d4orm_planners.engine.sampling_types import SamplingResult, get_sampling_engine
from d4orm_planners.mapf import beam_search
from d4orm_planners.tracking.steering import straight_drives

CASES = [
    slow({"scenario": "circle", "num_robots": 16, "horizon": 150}, id="circle-16"),
    pytest.param({"scenario": "four_obstacles", "num_robots": 12}, id="four-obstacles-12"),
    slow({"scenario": "random", "num_robots": 16}, id="random-16"),
    pytest.param({"scenario": "swap", "num_robots": 8}, id="swap-8"),
    pytest.param({"scenario": "circle", "num_robots": 8, "model": "differential_drive"}, id="differential-drive-8"),
    pytest.param({"scenario": "circle", "num_robots": 8, "model": "velocity2d"}, id="velocity2d-8"),
    pytest.param({"scenario": "sphere", "num_robots": 12}, id="sphere-12"),
    pytest.param({"scenario": "heterogeneous", "num_robots": 6}, id="heterogeneous-6"),
    pytest.param({"scenario": "circle", "num_robots": 1}, id="circle-1"),
]


def controller(**config: Any) -> D4ormC2F:
    """On the CPU engine, without refinement: quick, and the same every time."""
    policy = make_policy("d4orm-c2f", **{"engine": "cpu", "refine": "off", **config})
    assert isinstance(policy, D4ormC2F)
    return policy


def episode(policy: D4ormC2F, problem: Problem, *, seed: int = 0, **env: Any) -> Episode:
    """One episode in the single environment."""
    return run_episode(navigation_v0.parallel_env(problem=problem, **env), policy, seed=seed)


def circle(num_robots: int = 4, **changes: Any) -> Problem:
    return make_problem("circle", num_robots=num_robots, **changes)


def assert_verified(problem: Problem, executed: Episode) -> None:
    """What was executed is a plan of its own, and is judged as one."""
    controls = np.zeros((problem.horizon, problem.num_robots, problem.control_size), np.float32)
    controls[: len(executed.trajectory.controls)] = executed.trajectory.controls
    report = verify(problem, controls)
    assert report.ok, report.violations


@pytest.mark.parametrize("case", CASES)
def test_everyone_arrives_and_keeps_the_margin(case: dict[str, Any]) -> None:
    problem = make_problem(**case, seed=0)
    executed = episode(controller(), problem)
    assert executed.metrics["success"], executed.metrics
    assert_verified(problem, executed)


@pytest.mark.parametrize(
    ("config", "beside"),
    [
        ({"refine": "sync"}, False),
        ({"refine": "background"}, True),
        ({"refine": None}, False),
        ({"refine": None, "deadline": 60.0}, True),
    ],
)
def test_refined_guidance_leads_home_too(config: dict[str, Any], beside: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    problem, jobs = circle(8), []
    policy = controller(refine_every=2, **config)
    act = policy.act

    def act_and_let_the_background_work(*arguments: Any) -> Any:
        actions = act(*arguments)
        if policy._refinement._job is not None:
            policy._refinement._job.exception()
            jobs.append(policy._refinement._job)
        return actions

    # On a busy machine it might not come to an end before the episode does.
    monkeypatch.setattr(policy, "act", act_and_let_the_background_work)
    executed = episode(policy, problem)
    assert_verified(problem, executed)
    assert any(loop.refined for loop in policy.loops)
    assert bool(jobs) == beside


@pytest.mark.parametrize("config", [{"coarse_factor": 4}, {"coarse_factor": 1}, {"check_interval": 10}], ids=str)
def test_how_coarse_the_guidance_is_may_be_chosen(config: dict[str, int]) -> None:
    problem = circle(8)
    policy = controller(**config)
    executed = episode(policy, problem)
    assert_verified(problem, executed)
    assert policy.guidance.problem.dt == pytest.approx(problem.dt * config.get("coarse_factor", 2))


@pytest.mark.parametrize("model", ["holonomic2d", "differential_drive"])
@pytest.mark.parametrize("seed", [0, slow(1)])
def test_noise_that_ruins_a_plan_is_made_up_for(model: str, seed: int) -> None:
    problem = circle(8, model=model)
    assert episode(controller(), problem, seed=seed, control_noise_std=0.3).metrics["success"]
    plan = make_policy("d4orm-d", engine="cpu")
    assert not run_episode(navigation_v0.parallel_env(problem=problem, control_noise_std=0.3), plan, seed=seed).metrics[
        "success"
    ]


def test_noise_may_be_added_by_the_controller() -> None:
    problem = circle(4)
    quiet, noisy = (episode(controller(control_noise_std=noise), problem) for noise in (0.0, 0.3))
    assert noisy.metrics["success"]
    assert noisy.trajectory.controls.std() > 0
    limits = problem.team.control_limits
    assert (np.abs(noisy.trajectory.controls) <= limits * (1 + 1e-6)).all()
    steps = min(len(quiet.trajectory.controls), len(noisy.trajectory.controls), 5)
    assert not np.allclose(quiet.trajectory.controls[:steps], noisy.trajectory.controls[:steps], atol=0.05)


def test_a_seed_gives_the_same_episode_again() -> None:
    problem = circle(6)
    first, again = (
        episode(make_policy("d4orm-c2f", refine_every=2), problem, seed=3, control_noise_std=0.2) for _ in range(2)
    )
    np.testing.assert_array_equal(first.trajectory.states, again.trajectory.states)
    np.testing.assert_array_equal(first.trajectory.controls, again.trajectory.controls)


def test_every_loop_is_recorded() -> None:
    problem = circle(4)
    policy = controller()
    executed = episode(policy, problem)
    steps = len(executed.trajectory.controls)
    assert [loop.step for loop in policy.loops] == list(range(steps))
    assert all(loop.wall_time > 0 and not loop.missed and not loop.replanned for loop in policy.loops)
    indices = [loop.subgoal_index for loop in policy.loops]
    assert indices == sorted(indices)
    assert policy.config.subgoal_offset <= indices[0]
    assert indices[-1] < len(policy.guidance.path)
    # Without disturbances what was predicted to be kept apart stays apart.
    assert min(loop.predicted_margin for loop in policy.loops) >= problem.margin - 1e-4
    assert policy.missed == 0
    assert policy.coarse_time > 0


def test_a_lone_robot_has_nobody_to_keep_a_margin_to() -> None:
    policy = controller()
    episode(policy, circle(1))
    assert all(loop.predicted_margin == float("inf") for loop in policy.loops)


@pytest.mark.parametrize("execute", [1, 3])
def test_a_plan_may_be_executed_for_some_steps(execute: int) -> None:
    problem = circle(4)
    policy = controller(execute_horizon=execute)
    executed = episode(policy, problem)
    assert_verified(problem, executed)
    assert [loop.step for loop in policy.loops] == list(range(0, len(executed.trajectory.controls), execute))


@pytest.mark.parametrize("execute", [1, 3])
def test_a_loop_deforms_what_is_left_of_the_last_plan(monkeypatch: pytest.MonkeyPatch, execute: int) -> None:
    """A lone robot in the open: nothing stops it from doing as it has planned."""
    problem, ahead, samples = circle(1, horizon=20), 12, 72
    bases, plans = [], []
    sample = CpuSamplingEngine.denoise

    def denoise(
        self: CpuSamplingEngine,
        task: Any,
        rules: Any,
        mean: Any,
        scale: Any,
        num_samples: int,
        *more: Any,
        **options: Any,
    ) -> Any:
        result = sample(self, task, rules, mean, scale, num_samples, *more, **options)
        if num_samples == samples:  # a control loop, and not the coarse plan
            limit = task.problem.team.control_limits
            bases.append(task.base)
            plans.append(np.clip(task.base + result.mean, -limit, limit))
        return result

    policy = controller(predict_horizon=ahead, execute_horizon=execute, num_samples=samples)
    monkeypatch.setattr(CpuSamplingEngine, "denoise", denoise)
    executed = episode(policy, problem).trajectory.controls
    bases, plans = bases[-len(policy.loops) :], plans[-len(policy.loops) :]
    assert len(bases) == len(policy.loops) >= 6
    for last, base in zip(plans, bases[1:]):
        assert np.abs(base[: ahead - execute]).max() > 0.1
        np.testing.assert_allclose(base[: ahead - execute], last[execute:], atol=1e-6)
    # And the plan is what is executed, but for the circle that limits a control, where clipping takes a square.
    limit = problem.team.limits[0, ACCELERATION]
    for loop, plan in enumerate(plans):
        push = plan[0, 0] * min(1, limit / np.linalg.norm(plan[0, 0]))
        np.testing.assert_allclose(executed[loop * execute, 0], push, atol=1e-5)


def test_loops_that_miss_their_deadline_are_counted_and_the_last_plan_goes_on() -> None:
    policy = controller(deadline=1e-6)
    executed = episode(policy, circle(4, horizon=10))
    # No plan was ever in time, so nobody moves.
    assert policy.missed == len(policy.loops) == 10
    assert not executed.trajectory.controls.any()
    assert not executed.trajectory.collided.any()


def test_a_loop_that_is_late_goes_on_with_the_last_plan(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = circle(4)
    policy = controller(deadline=1.0)
    in_time = Window.predict

    def predict(self: Window, now: Any, *rest: Any) -> Any:
        if now.joint.steps == 10:
            time.sleep(1.3)
        return in_time(self, now, *rest)

    monkeypatch.setattr(Window, "predict", predict)
    executed = episode(policy, problem)
    assert policy.loops[10].missed
    assert np.isnan(policy.loops[10].predicted_margin)
    assert executed.trajectory.controls[10].any()
    assert not policy.loops[20].missed
    assert_verified(problem, executed)


def test_robots_rest_once_the_last_plan_has_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every loop is late from step 5 on; much later two robots are set in motion, and stop for good."""
    problem = circle(2).replace(horizon=120)
    env, policy = navigation_v0.parallel_env(problem=problem), controller(deadline=60.0)
    observations, _ = env.reset(seed=0)
    policy.reset(env, seed=0)
    for step in range(100):
        if step == 5:
            monkeypatch.setattr(Background, "run", lambda *_: None)
        if step == 60:
            env.set_state([[-0.6, 0, -0.6, 0.3], [0.6, 0, 0.6, 0]])
        observations = env.step(policy.act(observations, env.state()))[0]
    assert np.abs(split_state(problem, env.state()).states[:, 2:]).max() < 1e-3


def test_loops_with_a_deadline_make_as_many_steps_as_there_is_time_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """By a clock on which a denoising step takes 50 ms and all else nothing; a fifth of the time is kept back."""
    env, policy = navigation_v0.parallel_env(problem=circle(4)), controller(deadline=60.0)
    observations, _ = env.reset(seed=0)
    policy.reset(env, seed=0)
    at_once, predict, seen, clock = CpuSamplingEngine.denoise, Window.predict, [], [0.0]

    def slow(self: CpuSamplingEngine, task: Any, rules: Any, mean: Any, schedule: Any, *rest: Any) -> Any:
        if threading.current_thread() is threading.main_thread():  # loops of other tests may still be under way
            clock[0] += 0.05 * len(schedule)
        return at_once(self, task, rules, mean, schedule, *rest)

    def keep(self: Window, now: Any, *rest: Any) -> Any:
        seen.append((self, now))
        return predict(self, now, *rest)

    monkeypatch.setattr(CpuSamplingEngine, "denoise", slow)
    monkeypatch.setattr(fine_plan, "perf_counter", lambda: clock[0])
    monkeypatch.setattr(Window, "predict", keep)
    policy.act(observations, env.state())
    window, now = seen[0]
    made = [predict(window, now, 0, seconds).num_steps for seconds in (None, 1.3, 1.2, 0.7, 0.6, 0.01, None)]
    assert made == [20, 20, 10, 10, 5, 5, 20]


def test_no_loop_waits_for_a_new_coarse_plan(monkeypatch: pytest.MonkeyPatch) -> None:
    policy, env = controller(deadline=0.2, replan_distance=2.0), navigation_v0.parallel_env(problem=circle(4))
    plan, asked, released = CoarsePlanning.plan, threading.Event(), threading.Event()

    def late(self: CoarsePlanning, problem: Problem, joint: JointState, *rest: Any) -> Any:
        if joint.steps:
            asked.set()
            assert released.wait(60)
        return plan(self, problem, joint, *rest)

    monkeypatch.setattr(CoarsePlanning, "plan", late)
    observations, _ = env.reset(seed=0)
    policy.reset(env, seed=0)
    first = policy.guidance

    def steps(count: int) -> None:
        nonlocal observations
        for _ in range(count):
            observations = env.step(policy.act(observations, env.state()))[0]

    steps(5)
    states = split_state(env.problem, env.state()).states.copy()
    states[:, :2] += [0.6, 0.6]
    env.set_state(states)
    steps(10)
    assert asked.is_set()
    assert policy.guidance is first
    assert len(policy.loops) == 15
    assert not any(loop.replanned for loop in policy.loops)
    released.set()
    policy._replanning._job.result()
    steps(1)
    assert policy.guidance is not first
    assert policy.loops[-1].replanned


@pytest.mark.parametrize("deadline", [None, 60.0])
def test_what_thorough_plans_need_is_there_before_the_first_loop_with_a_deadline(deadline: float | None) -> None:
    beam_search.search_kernel.cache_clear()
    env = navigation_v0.parallel_env(problem=circle(4))
    env.reset(seed=0)
    controller(deadline=deadline).reset(env)
    assert bool(beam_search.search_kernel("holonomic2d").signatures) == (deadline is not None)


@pytest.mark.parametrize(("deadline", "judged"), [(None, True), (60.0, False)])
def test_coarse_plans_are_not_judged_in_real_time(
    deadline: float | None, judged: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    reports: list[Any] = []
    monkeypatch.setattr(candidate, "verify", lambda *plan: reports.append(verify(*plan)) or reports[-1])
    assert episode(controller(deadline=deadline), circle(4)).metrics["success"]
    assert bool(reports) == judged


def test_ample_deadlines_change_nothing() -> None:
    problem = circle(4)
    waiting, pressed = (episode(controller(deadline=deadline), problem) for deadline in (None, 60.0))
    np.testing.assert_array_equal(waiting.trajectory.states, pressed.trajectory.states)


def test_others_stay_safe_where_one_goal_is_walled_in() -> None:
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    ring = np.column_stack([3 + 0.9 * np.cos(angle), 0.9 * np.sin(angle), np.full(12, 0.25)])
    start = np.zeros((3, 4))
    start[:, :2] = [[0, 0], [0, 2.5], [0, -2.5]]
    team = Team(("holonomic2d",) * 3)
    problem = Problem(team, start, [[3, 0], [0, -2.5], [0, 2.5]], World(circles=ring), horizon=120)
    executed = episode(controller(coarse_iterations=3), problem)
    assert not executed.metrics["success"]
    assert not executed.trajectory.collided.any()
    np.testing.assert_array_equal(executed.trajectory.arrived[-1], [False, True, True])


def test_the_guidance_is_planned_anew_for_robots_pushed_away() -> None:
    env = navigation_v0.parallel_env(problem=circle(4))
    policy = controller(replan_distance=2.0)
    observations, _ = env.reset(seed=0)
    policy.reset(env, seed=0)
    while env.agents:
        actions = policy.act({agent: observations[agent] for agent in env.agents}, env.state())
        if 10 <= len(policy.loops) < 25:
            # Somebody else has the robots' controls.
            actions = {agent: -action for agent, action in actions.items()}
        observations = env.step(actions)[0]
    assert any(loop.replanned for loop in list(policy.loops)[10:])


def test_refined_guidance_is_one_plan_from_beginning_to_end() -> None:
    problem = circle(4)
    policy = controller(refine="sync", refine_every=2)
    episode(policy, problem)
    assert any(loop.refined for loop in policy.loops)
    guidance = policy.guidance
    plan = get_sampling_engine("cpu").rollout(guidance.problem, guidance.controls)
    # Who has docked by the waypoint from which the rest is refined may drive on a little.
    positions = guidance.states[..., : problem.dimension]
    np.testing.assert_allclose(positions, plan.positions, atol=problem.goal_radius)
    np.testing.assert_array_equal(guidance.path[:: policy.config.coarse_factor], positions)


def test_a_job_in_the_background_is_one_at_a_time_and_gives_its_result_once() -> None:
    background, go = Background(), threading.Event()
    assert background.result() == (True, None)
    background.start(lambda: go.wait(60))
    assert background.result() == (False, None)
    go.set()
    background._job.result()  # type: ignore[union-attr]
    assert background.result() == (True, True)
    assert background.result() == (True, None)


def test_threads_let_the_interpreter_go_soon_beside_a_job(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[float] = []
    monkeypatch.setattr(sys, "setswitchinterval", asked.append)
    for interval in (0.005, 1e-4):
        monkeypatch.setattr(sys, "getswitchinterval", lambda interval=interval: interval)
        background = Background[None]()
        background.start(lambda: None)
        background.forget()
    assert asked == [SWITCH, 1e-4]


def test_an_error_of_late_work_is_raised_once() -> None:
    background, go = Background(), threading.Event()

    def broken() -> None:
        assert go.wait(60)
        raise ValueError("broken")

    assert background.run(broken, 0.01) is None
    go.set()
    with pytest.raises(ValueError, match="broken"):
        background.run(lambda: None, 60)
    assert background.run(lambda: 1, 60) == 1
    background.start(broken)
    with pytest.raises(ValueError, match="broken"):
        background.forget()
    background.forget()


def test_the_control_loop_is_compiled_before_the_first_step(monkeypatch: pytest.MonkeyPatch) -> None:
    prepared = []
    monkeypatch.setattr(
        CpuSamplingEngine,
        "prepare",
        lambda self, task, rules, scale, samples: prepared.append((task.problem.horizon, samples)),
    )
    env = navigation_v0.parallel_env(problem=circle(2))
    env.reset(seed=0)
    controller(predict_horizon=13, num_samples=72).reset(env, seed=0)
    assert (13, 72) in prepared


@pytest.mark.skipif(sys.platform != "linux", reason="threads have priorities of their own on Linux only")
@pytest.mark.parametrize(("own", "refining"), [(0, 10), (15, 15)])
def test_refinement_yields_to_the_control_loop_and_takes_no_priority(
    monkeypatch: pytest.MonkeyPatch, own: int, refining: int
) -> None:
    asked: list[int] = []
    monkeypatch.setattr(os, "getpriority", lambda which, who: own)
    monkeypatch.setattr(os, "setpriority", lambda which, who, priority: asked.append(priority))
    for background in (Background(), Background(yielding=True)):
        background.start(lambda: None)
        background.forget()
    assert asked == [refining]


def test_no_control_loop_has_to_compile_its_last_resort() -> None:
    script = """if True:
        from d4orm_env import navigation_v0
        from d4orm_planners import make_policy
        from d4orm_planners.d4orm_c2f.barrier import find_nearest
        env = navigation_v0.parallel_env("circle", num_robots=2)
        env.reset(seed=0)
        make_policy("d4orm-c2f", engine="cpu").reset(env)
        assert len(find_nearest.signatures) == 1
    """
    assert subprocess.run([sys.executable, "-c", script]).returncode == 0


def test_work_that_yields_leaves_other_cores_to_the_control_loop() -> None:
    for yielding, expected in ((False, [[0, 2], [2, 4]]), (True, [[0, 4]])):
        background, parts = Background[None](yielding=yielding), []
        background.start(lambda parts=parts: Threads(2).over(4, lambda part: parts.append(part.tolist())))
        background.forget()
        assert sorted(parts) == expected


def replanned(
    monkeypatch: pytest.MonkeyPatch, policy: D4ormC2F, step: Callable[[dict[str, Any]], dict[str, Any]], **env: Any
) -> list[tuple[JointState, Any, int, Any, int]]:
    """Where it was replanned, from which controls and with how many iterations, and the guidance until then."""
    calls = []
    plan = CoarsePlanning.plan

    def coarse_plan(
        self: CoarsePlanning, problem: Problem, joint: JointState, arrived: Any, initial: Any, iterations: int,
        *more: Any,
    ) -> Any:  # fmt: skip
        if initial is not None:
            calls.append((joint, initial.copy(), iterations, policy._tracker.guidance, policy._tracker.index))
        return plan(self, problem, joint, arrived, initial, iterations, *more)

    monkeypatch.setattr(CoarsePlanning, "plan", coarse_plan)
    world = navigation_v0.parallel_env(**env)
    observations, _ = world.reset(seed=0)
    policy.reset(world, seed=0)
    while world.agents:
        actions = policy.act({agent: observations[agent] for agent in world.agents}, world.state())
        observations = world.step(step(actions))[0]
    return calls


def straight(problem: Problem, joint: JointState, factor: int) -> Any:
    return straight_drives(coarse_problem(problem.with_state(joint.states, joint.goals), factor)).controls[:, :, 0]


class Still(CpuSamplingEngine):
    """Sampling that changes nothing."""

    def denoise(self, task: Any, rules: Any, mean: Any, noise_scale: Any, *more: Any, **options: Any) -> SamplingResult:
        return SamplingResult(np.zeros_like(task.base), np.zeros(len(noise_scale), np.float32), 0)


def test_who_cannot_follow_its_path_carefully_moves_as_sampled() -> None:
    """Its path leads into a wall; what was sampled leads along that."""
    wall = World(2, boxes=[[0.9, -5, 1, 5]])
    problem = Problem(Team(("holonomic2d",)), np.zeros((1, 4)), [[0, 9]], wall, horizon=100, dt=0.1)
    window = Window(problem, D4ormC2FConfig(), Still(), docks=True)
    along, into = window.no_controls(), window.no_controls()
    along[:, 0, 1], into[:, 0, 0] = 0.3, 1.0
    nobody, nothing = np.zeros(1, bool), np.zeros((1, 2), np.float32)
    present = JointState(states=problem.start, goals=problem.goal, controls=nothing, arrived=nobody, steps=0)
    now = Situation(present, nobody, problem.goal / 3, along, along[:0], into, np.ones(1, bool), inflation=0.0)
    np.testing.assert_array_equal(window.predict(now, seed=0).controls[: len(along)], along)


@pytest.mark.parametrize(("aside", "goes_on"), [(0.36, False), (0.34, True)])
def test_who_would_come_too_near_in_the_first_step_goes_on_with_its_last_plan(aside: float, goes_on: bool) -> None:
    """It passes a robot that has docked, and is nearest to it, 1 cm more or less than the margin, after one step."""
    start = np.float32([[0, 0, 1, 0], [0.1, -aside, 0, 0]])
    problem = Problem(Team(("holonomic2d",) * 2), start, [[9, 0], start[1, :2]], horizon=100, dt=0.1, margin=0.05)
    window = Window(problem, D4ormC2FConfig(), Still(), docks=True)
    sampled, left = window.no_controls(), window.no_controls()
    left[:, 0, 1] = 0.3
    docked, nothing = np.array([False, True]), np.zeros((2, 2), np.float32)
    present = JointState(states=problem.start, goals=problem.goal, controls=nothing, arrived=docked, steps=0)
    now = Situation(present, docked, problem.goal, sampled, left, None, np.zeros(2, bool), inflation=0.0)
    expected = left if goes_on else sampled
    np.testing.assert_array_equal(window.predict(now, seed=0).controls[: len(left)], expected)


@pytest.mark.parametrize(("apart", "touches"), [(0.44, True), (0.46, False)])
def test_robots_at_rest_touch_what_moves_within_the_gap(apart: float, touches: bool) -> None:
    """A robot of 0.15 m, a body of 0.25 m that passes it at that distance, and a gap of 5 cm."""
    problem = Problem(Team(("holonomic2d",)), np.zeros((1, 4)), [[9, 0]], horizon=100, dt=0.1)
    window = Window(problem, D4ormC2FConfig(), get_sampling_engine("cpu"), docks=True)
    nobody, nothing = np.zeros(1, bool), np.zeros((1, 2), np.float32)
    body = np.float32([[-1, apart, 1, 0, 0.25]])
    present = JointState(problem.start, problem.goal, nothing, nobody, 0, body)
    assert window.touching(present, nobody, window.no_controls(), gap=0.05).tolist() == [touches]


def test_robots_within_the_margin_of_each_other_part() -> None:
    start = np.array([[0, 0, 0, 0], [0.33, 0, 0, 0]], np.float32)
    problem = Problem(Team(("holonomic2d",) * 2), start, start[:, :2] + [[-1, 0], [1, 0]], horizon=60, margin=0.05)
    executed = episode(controller(), problem)
    assert executed.metrics["success"], executed.metrics


def test_who_gets_no_nearer_has_lost_the_guidance() -> None:
    env, policy = navigation_v0.parallel_env(problem=circle(1)), controller(replan_distance=500.0, stalls=False)
    observations, _ = env.reset(seed=0)
    policy.reset(env, seed=0)
    for _ in range(50):
        policy.act(observations, env.state())
        observations = env.step({"robot_0": np.zeros(2, np.float32)})[0]  # something holds it
    first, second = np.flatnonzero([loop.replanned for loop in policy.loops])
    assert 15 <= second - first < 20, "sooner than one is stuck"


def test_who_is_led_to_its_goal_and_has_not_docked_drives_straight_in(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def recorded(*arguments: Any) -> Any:
        asked.append(arguments[-2:])
        return direct_final_approach(*arguments)

    monkeypatch.setattr("d4orm_planners.d4orm_c2f.fine_plan.direct_final_approach", recorded)
    assert episode(controller(), circle(2)).metrics["success"]
    assert not asked[0][0].any()
    assert asked[-1][0].any()
    assert not any((near & arrived).any() for near, arrived in asked)


def test_undisturbed_robots_are_where_they_are_expected() -> None:
    policy = controller()
    assert episode(policy, circle(1)).metrics["success"]
    assert not any(loop.replanned for loop in policy.loops), "it gets nearer all the time"
    assert episode(policy, circle(3)).metrics["success"]
    assert policy._deviation.speed.max() < 1e-4
    assert policy._deviation.speed_slack == 0
    episode(policy, circle(3), disturbances=[Push(1.0, 0.3)])
    assert 0.1 < policy._deviation.speed.max() < 0.7
    assert 0.1 < policy._deviation.speed_slack <= 0.4


def test_commands_under_way_are_counted() -> None:
    policy = controller(delay=2)
    assert episode(policy, circle(4), disturbances=[Delay(2)]).metrics["success"]
    assert policy._deviation.speed.max() < 1e-4
    policy = controller(delay=0)
    episode(policy, circle(4), disturbances=[Delay(2)])
    assert policy._deviation.speed.max() > 0.01


@pytest.mark.parametrize("seed", [0, 1])
def test_intruders_are_avoided(seed: int) -> None:
    executed = episode(controller(), circle(6), seed=seed, disturbances=[Intruder(1, 0.5)])
    assert executed.metrics["success"], executed.metrics


def test_paths_through_rooms_are_kept_in_order() -> None:
    problem = make_problem("rooms", num_robots=6, seed=1)
    policy = controller()
    executed = episode(policy, problem)
    assert policy.guidance.ordered
    assert executed.metrics["success"], executed.metrics
    assert not executed.metrics["collided"]


def test_who_lost_the_guidance_begins_anew_straight_to_the_goals(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = circle(4)
    limits = {"learn_limits": False}  # whoever does the opposite is not weak
    policy = controller(replan_distance=2.0, patience=1000, coarse_iterations=3, replan_iterations=2, **limits)
    steps = iter(range(10**6))

    def pushed(actions: dict[str, Any]) -> dict[str, Any]:
        return {agent: -action for agent, action in actions.items()} if 10 <= next(steps) < 25 else actions

    calls = replanned(monkeypatch, policy, pushed, problem=problem)
    assert calls[0][0].steps < 30
    begun = [
        (initial == straight(problem, joint, policy.config.coarse_factor)).all(axis=(0, 2))
        for joint, initial, *_ in calls
    ]
    assert all(rerouted.any() for rerouted in begun)


def test_the_first_coarse_plan_may_begin_with_what_a_policy_does() -> None:
    problem = make_problem("circle", num_robots=8)
    env = navigation_v0.parallel_env(problem=problem)
    env.reset(seed=0)
    policy = make_policy("d4orm-c2f", warm_start="ppo", refine="off")
    policy.reset(env, seed=0)
    coarse = coarse_problem(problem, policy.config.coarse_factor)
    driver = make_policy("ppo")
    episode = run_episode(open_env(coarse, policy=driver), driver, seed=0)
    assert episode.metrics["success"], "so that there is nothing left to plan"
    guided = policy.guidance.controls
    np.testing.assert_array_equal(guided[: len(episode.controls)], episode.controls)
    assert not guided[len(episode.controls) :].any()
    with pytest.raises(ValueError, match="nobody"):
        make_policy("d4orm-c2f", warm_start="nobody").reset(env, seed=0)


def test_with_new_goals_for_some_the_others_keep_to_their_ways(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = make_problem("random", num_robots=3, seed=1, goal_speed=np.inf)
    policy = controller(replan_distance=500.0, patience=1000, coarse_iterations=3, replan_iterations=2)
    factor = policy.config.coarse_factor
    calls = replanned(monkeypatch, policy, lambda actions: actions, problem=problem, lifelong=True, max_cycles=80)
    goals, some = problem.goal, 0
    for joint, initial, iterations, guidance, index in calls:
        changed = (joint.goals != goals).any(axis=1)
        goals = joint.goals
        if iterations == 3:  # at the end of the guidance
            continue
        assert iterations == 2
        some += changed.any() and not changed.all()
        coarse = coarse_problem(problem.with_state(joint.states, joint.goals), factor)
        expected = guidance.path[index - index % factor :: factor][: len(initial) + 1, ~changed]
        driven = get_sampling_engine("cpu").rollout(coarse, initial).positions[: len(expected), ~changed]
        off = np.linalg.norm(driven - expected, axis=2)
        assert (off <= np.maximum(off[0], 0.25)).all()
        np.testing.assert_array_equal(initial[:, changed], straight(problem, joint, factor)[:, changed])
    assert some


def test_paths_of_robots_that_were_pushed_lead_on_to_their_ends() -> None:
    problem = circle(4)
    policy, env = controller(), navigation_v0.parallel_env(problem=problem)
    env.reset(seed=0)
    policy.reset(env, seed=0)
    joint = split_state(problem, env.state())
    states = joint.states + np.float32([0.1, -0.1, 0.4, 0.3])
    everybody = np.ones(4, bool)
    initial = policy._tracker._beginning(joint._replace(states=states), everybody)
    coarse = coarse_problem(problem.with_state(states, problem.goal), policy.config.coarse_factor)
    assert get_sampling_engine("cpu").rollout(coarse, initial).arrived[-1].all()


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_plan_that_comes_before_the_episode_ends_is_preferred(seed: int) -> None:
    problem, nobody = circle(16), np.zeros(16, bool)
    policy, env = controller(), navigation_v0.parallel_env(problem=problem)
    env.reset(seed=seed)
    policy.reset(env, seed=seed)
    joint, left = split_state(problem, env.state()), 38
    states = joint.states.copy()
    states[0, 2:] = -1.1, 0.0  # A push may make a robot faster than a problem lets it start.
    late = joint._replace(states=states, steps=env.max_cycles - left * policy.config.coarse_factor)
    guide = policy._tracker
    plan = guide._planning.plan(guide.problem, late, nobody, None, 20, thorough=True)
    assert get_sampling_engine("cpu").rollout(plan.problem, plan.controls).arrived[left].all()


def test_only_thorough_plans_keep_to_paths_between_others() -> None:
    planning = CoarsePlanning(D4ormC2FConfig(), seed=0, last_step=None)
    assert [planner.config.reroute for planner in (planning.planner, planning.thorough)] == [False, True]  # type: ignore[attr-defined]


def test_who_is_behind_robots_that_have_docked_is_barred() -> None:
    problem = circle(4)
    policy, env = controller(), navigation_v0.parallel_env(problem=problem)
    env.reset(seed=0)
    policy.reset(env, seed=0)
    joint, arrived = split_state(problem, env.state()), np.array([True, False, False, False])
    states = joint.states.copy()
    states[0, :2] = policy.guidance.path[10, 2]
    barred = policy._tracker._barred(joint._replace(states=states), arrived, np.ones(4, bool))
    assert barred[2]
    assert not barred[0]
    assert not policy._tracker._barred(joint._replace(states=states), arrived, np.arange(4) == 1)[2]
    far = joint.states.copy()
    far[0, :2] = 50
    assert not policy._tracker._barred(joint._replace(states=far), arrived, np.ones(4, bool)).any()


@pytest.mark.parametrize("seed", [0, 2])
def test_who_docked_at_the_rim_of_its_goal_stays_there_in_new_plans(seed: int) -> None:
    problem = make_problem("random", num_robots=20, seed=seed)
    policy, env = controller(coarse_iterations=1), navigation_v0.parallel_env(problem=problem)
    env.reset(seed=0)
    policy.reset(env, seed=0)
    joint, arrived = split_state(problem, env.state()), np.arange(20) % 2 == 0
    away = np.random.default_rng(seed).normal(size=(20, 2))
    states = joint.states.copy()
    states[arrived] = 0
    rim = problem.goal + 0.99 * problem.goal_radius * away / np.linalg.norm(away, axis=1, keepdims=True)
    states[arrived, :2] = rim[arrived]
    guide = policy._tracker
    plan = guide._planning.plan(
        guide.problem, joint._replace(states=states, arrived=arrived), arrived, None, 20, thorough=True
    )
    assert np.linalg.norm(plan.path[:, arrived] - states[arrived, :2], axis=2).max() <= problem.goal_radius


@pytest.mark.slow
def test_robots_with_ever_new_goals_never_touch() -> None:
    problem = make_problem("random", num_robots=12, seed=1)
    env = navigation_v0.parallel_env(problem=problem, lifelong=True, max_cycles=300)
    policy = controller()
    executed = run_episode(env, policy, seed=1)
    assert not executed.trajectory.collided.any()
    assert executed.metrics["goals_reached"] >= 3 * problem.num_robots
    assert any(loop.replanned for loop in policy.loops)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"coarse_factor": 0}, "coarse_factor"),
        ({"check_interval": 0}, "check_interval"),
        ({"num_samples": 1}, "num_samples"),
        ({"coarse_samples": 1}, "coarse_samples"),
        ({"predict_horizon": 0}, "predict_horizon"),
        ({"execute_horizon": 30}, "predict_horizon"),
        ({"subgoal_offset": 0}, "subgoal_offset"),
        ({"temperature": 0}, "temperature"),
        ({"beta_end": 1e-5}, "beta_start"),
        ({"beta_end": 1.0}, "beta_end"),
        ({"penalty": -1}, "penalty"),
        ({"extra_margin": -0.1}, "extra_margin"),
        ({"control_noise_std": -1}, "control_noise_std"),
        ({"control_noise_std": float("nan")}, "control_noise_std"),
        ({"credit": "nobody"}, "robot, team"),
        ({"refine": "always"}, "background, sync, off"),
        ({"deadline": 0}, "deadline"),
        ({"engine": "abacus"}, "abacus"),
        ({"num_sample": 10}, "num_sample"),
    ],
    ids=str,
)
def test_settings_that_make_no_sense_are_named(config: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_policy("d4orm-c2f", **config)


@pytest.mark.parametrize("model", ["unicycle", "differential_drive"])
def test_teams_turn_to_their_goal_headings_in_time(model: str) -> None:
    # They are planned one after another: the coarse paths of those planned last wait.
    env = navigation_v0.parallel_env("circle", num_robots=3, model=model, goal_heading=2.5)
    assert run_episode(env, "d4orm-c2f", seed=0).metrics["success"]
