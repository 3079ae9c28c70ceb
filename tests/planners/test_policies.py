"""Policies in the environment's loop: what they may read, what they must return, and how well the simple ones do."""

from __future__ import annotations

import sys
from dataclasses import fields
from typing import Any

import numpy as np
import pytest
from env_support import scenario_params
from planner_support import CHEAP, cheap_planner, hop_problem

from d4orm_env import mujoco, navigation_v0
from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.core.world import World
from d4orm_env.envs.joint_state import split_state
from d4orm_env.envs.wrappers import GaussianControlNoise
from d4orm_env.scenarios import make_problem
from d4orm_planners import OpenLoop, Plan, Policy, list_planners, list_policies, make_policy, run_episode
from d4orm_planners.base.adapters import SharedPolicy
from d4orm_planners.base.planner_registry import PLANNERS, POLICIES, describe_policy
from d4orm_planners.rl.learned import LearnedPolicy
from d4orm_planners.tracking.steering import goals_along_paths, limit_controls

ALL = pytest.mark.parametrize("name", list_policies())


def cheap_policy(name: str) -> Policy:
    """A policy with those of the cheap settings that it has."""
    config = (PLANNERS.get(name) or POLICIES[name]).config_class
    known = {field.name for field in fields(config)} if config else set()
    settings = {key: value for key, value in (CHEAP | {"max_iterations": 1}).items() if key in known}
    return make_policy(name, **settings)


def noisy(**arguments: Any) -> Any:
    return navigation_v0.parallel_env(control_noise_std=0.3, **arguments)


def wrapped(**arguments: Any) -> Any:
    return GaussianControlNoise(navigation_v0.parallel_env(**arguments), 0.3)


def rigid(**arguments: Any) -> Any:
    return mujoco.parallel_env(control_noise_std=0.3, **arguments)


ENVIRONMENTS = pytest.mark.parametrize(
    "make_env", [pytest.param(navigation_v0.parallel_env, id="plain"), noisy, wrapped, rigid]
)


# All of them.


@ALL
@ENVIRONMENTS
def test_actions_are_those_of_the_live_agents_and_in_their_spaces(name: str, make_env: Any) -> None:
    # Robots that arrive early, and models whose controls are padded to the team's.
    learned = isinstance(cheap_policy(name), LearnedPolicy)  # for robots of one model
    models = ("holonomic2d",) * 3 if learned else ("velocity2d", "differential_drive", "holonomic2d")
    team = Team(models, max_speed=[1, 1, 2], max_acceleration=[1, 2, 1])
    start = np.zeros((3, 4))
    start[:, 1] = [0, 1, 2]
    env = make_env(problem=Problem(team, start, start[:, :2] + np.array([[0.3], [0.6], [3.0]]) * [1, 0], horizon=25))
    policy = cheap_policy(name)
    observations, _ = env.reset(seed=0)
    policy.reset(env, seed=0)
    steps = 0
    while env.agents:
        acting = {agent: observations[agent] for agent in env.agents}
        actions = policy.act(acting, env.state())
        assert list(actions) == env.agents
        for agent, action in actions.items():
            assert env.action_space(agent).contains(action)
            robot = env.possible_agents.index(agent)
            limit = team.control_limits[robot]
            assert (np.abs(action) <= limit * (1 + 1e-6)).all()
        observations = env.step(actions)[0]
        steps += 1
    assert 3 <= steps <= 25


@ALL
@pytest.mark.parametrize("models", [("velocity2d", "differential_drive", "holonomic2d"), ("holonomic3d",) * 3])
def test_actions_are_executed_as_they_are(name: str, models: tuple[str, ...]) -> None:
    spatial = models[0] == "holonomic3d"
    if spatial and name in ("orca", "ppo", "sac"):
        pytest.skip("in the plane only")
    if isinstance(policy := cheap_policy(name), LearnedPolicy):
        models = ("holonomic2d",) * 3
    env = navigation_v0.parallel_env(scenario="circle", num_robots=3, model=models, horizon=30, max_acceleration=0.7)
    observations, _ = env.reset(seed=0)
    policy.reset(env, seed=0)
    problem, hardest = env.unwrapped.problem, 0.0
    while env.agents:
        actions = policy.act({agent: observations[agent] for agent in env.agents}, env.state())
        observations = env.step(actions)[0]
        executed = split_state(problem, env.state()).controls
        for agent, action in actions.items():
            np.testing.assert_array_equal(executed[env.possible_agents.index(agent)], action)
            hardest = max(hardest, float(np.abs(action).max()))
    assert hardest > 0.1


@pytest.mark.parametrize(
    "policy",
    [
        lambda observations, state: {agent: np.array([3.0, 4.0, 0.0]) for agent in observations},
        lambda observation: [3, 4, 0],
        SharedPolicy(lambda stacked: np.tile(np.float32([3, 4, 0]), (len(stacked), 1)), None),
        SharedPolicy(lambda stacked: np.tile(np.float32([1, 1, 1]), (len(stacked), 1)), None, normalized=True),
    ],
)  # fmt: skip
def test_what_functions_and_models_answer_is_clipped_as_the_step_does(policy: Any) -> None:
    env = navigation_v0.parallel_env(scenario="circle", num_robots=2, model="holonomic3d")
    observations, _ = env.reset(seed=0)
    policy = make_policy(policy)
    policy.reset(env)
    actions = policy.act(observations, env.state())
    wanted = np.float32([1, 1, 1]) / np.sqrt(3) if getattr(policy, "_normalized", False) else [0.6, 0.8, 0]
    np.testing.assert_allclose(list(actions.values()), [wanted] * 2, rtol=1e-6)
    env.step(actions)
    np.testing.assert_array_equal(split_state(env.unwrapped.problem, env.state()).controls, list(actions.values()))


@pytest.mark.parametrize("bad", [[np.nan, 0], [1e16, 0], [0, 0, 0], "fast", None])
def test_the_environment_says_what_is_wrong_with_the_answer_of_a_function(bad: Any) -> None:
    env = navigation_v0.parallel_env(scenario="circle", num_robots=2)
    with pytest.raises(ValueError, match="robot_0"):
        run_episode(env, lambda observation: bad)


@ALL
def test_an_episode_runs_to_its_end(name: str) -> None:
    env = navigation_v0.parallel_env(scenario="circle", num_robots=4)
    episode = run_episode(env, cheap_policy(name), seed=1)
    assert not env.agents
    steps = len(episode.trajectory.controls)
    assert 1 <= steps <= env.unwrapped.problem.horizon
    assert episode.metrics["steps"] == steps
    assert 0 <= episode.metrics["arrived"] <= 4


@ALL
def test_the_same_seed_gives_the_same_episode(name: str) -> None:
    env = noisy_circle()
    policy = cheap_policy(name)
    first, again = (run_episode(env, policy, seed=4) for _ in range(2))
    fresh = run_episode(noisy_circle(), cheap_policy(name), seed=4)
    for other in (again, fresh):
        np.testing.assert_array_equal(first.trajectory.states, other.trajectory.states)
        np.testing.assert_array_equal(first.trajectory.controls, other.trajectory.controls)
        assert first.metrics == other.metrics
    different = run_episode(env, policy, seed=5)
    shared = min(len(first.trajectory.states), len(different.trajectory.states))
    assert not np.allclose(first.trajectory.states[:shared], different.trajectory.states[:shared], atol=1e-2)


def noisy_circle() -> Any:
    return navigation_v0.parallel_env(scenario="circle", num_robots=4, control_noise_std=0.2, max_cycles=25)


@ALL
def test_a_policy_forgets_its_last_episode(name: str) -> None:
    policy = cheap_policy(name)
    small, large = make_problem("circle", num_robots=2), make_problem("circle", num_robots=5)
    run_episode(navigation_v0.parallel_env(problem=small, max_cycles=25), policy, seed=0)
    env = navigation_v0.parallel_env(problem=large, max_cycles=25)
    after, fresh = (run_episode(env, each, seed=0) for each in (policy, cheap_policy(name)))
    np.testing.assert_array_equal(after.trajectory.states, fresh.trajectory.states)


@ALL
def test_a_policy_acts_in_turns_too(name: str) -> None:
    problem = hop_problem()
    policy = cheap_policy(name)
    parallel = run_episode(navigation_v0.parallel_env(problem=problem), policy, seed=2)
    env = navigation_v0.env(problem=problem)
    env.reset(seed=2)
    policy.reset(env, seed=2)
    states, controls = [env.state()], None
    for agent in env.agent_iter():
        _, _, terminated, truncated, _ = env.last()
        if terminated or truncated:
            env.step(None)
            continue
        if agent == env.agents[0]:
            # One round: nobody moves before the last has chosen.
            controls = policy.act({other: env.observe(other) for other in env.agents}, env.state())
        assert controls is not None
        env.step(controls[agent])
        if not np.array_equal(states[-1], env.state()):
            states.append(env.state())
    joints = [split_state(problem, state) for state in states]
    np.testing.assert_array_equal(np.stack([joint.states for joint in joints]), parallel.trajectory.states)


@ALL
def test_every_policy_is_described(name: str) -> None:
    assert len(describe_policy(name)) > 10


def test_every_planner_is_a_policy() -> None:
    assert set(list_planners()) < set(list_policies())
    assert {"go-to-goal", "random"} <= set(list_policies())
    assert all(isinstance(cheap_policy(name), OpenLoop) for name in list_planners())


@pytest.mark.parametrize(
    ("name", "config", "message"),
    [
        ("gaol", {}, "policy 'gaol' is unknown; choose one of .*goal"),
        ("go-to-goal", {"speed": 1}, "policy 'go-to-goal' takes no settings, but was given 'speed'"),
        ("random", {"seed": 1}, "policy 'random' takes no settings"),
        ("orca", {"speed": 1}, "'speed' is no setting of policy 'orca'; it takes time_horizon"),
        ("orca", {"time_horizon": 0}, "time_horizon is 0"),
        ("orca", {"max_neighbors": 1.5}, "max_neighbors must be a whole number"),
        ("orca", {"deviation": -1}, "deviation is -1"),
        ("d4orm", {"num_samples": 1}, "num_samples is 1"),
        ("d4orm", {"samples": 10}, "'samples' is no setting"),
        ("d4orm", {"preset": "none"}, "preset 'none'"),
    ],
)
def test_a_bad_name_or_setting_is_refused(name: str, config: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_policy(name, **config)


# Open loop.


@pytest.mark.parametrize("case", scenario_params(4))
def test_open_loop_reproduces_the_plan(case: dict[str, Any]) -> None:
    problem = make_problem(**case)
    plan = cheap_planner("d4orm").solve(problem, seed=0, max_iterations=1)
    env = navigation_v0.parallel_env(problem=problem)
    episode = run_episode(env, OpenLoop(plan=plan))
    steps = len(episode.trajectory.controls)
    assert steps == problem.horizon or plan.trajectory.arrived[steps].all()
    for name in ("states", "positions", "arrived", "collided", "margin_violated"):
        expected = getattr(plan.trajectory, name)[: steps + 1]
        np.testing.assert_allclose(getattr(episode.trajectory, name), expected, atol=1e-5, err_msg=name)
    for name in ("controls", "rewards"):
        expected = getattr(plan.trajectory, name)[:steps]
        np.testing.assert_allclose(getattr(episode.trajectory, name), expected, atol=1e-5, err_msg=name)


def test_a_solved_plan_succeeds_in_the_environment() -> None:
    env = navigation_v0.parallel_env(scenario="circle", num_robots=4)
    episode = run_episode(env, make_policy("d4orm", engine="cpu"), seed=0)
    assert episode.metrics["success"] == 1
    assert episode.metrics["arrived"] == 4
    assert episode.metrics["margin_violated"] == 0


def test_a_policy_of_a_planner_plans_with_its_settings_and_the_episodes_seed() -> None:
    env = navigation_v0.parallel_env(scenario="circle", num_robots=4)
    policy = make_policy("mppi", preset="paper", engine="cpu", num_samples=64, num_steps=5, max_iterations=1)
    assert isinstance(policy, OpenLoop)
    run_episode(env, policy, seed=6)
    assert policy.plan is not None
    assert policy.plan.planner == "mppi"
    assert policy.plan.seed == 6
    assert policy.plan.iterations == 1
    assert policy.plan.denoising_steps == 5
    assert policy.planner is not None
    assert policy.planner.config.sigma == 1


def test_a_time_limit_reaches_the_planner() -> None:
    policy = make_policy("d4orm", engine="cpu", num_samples=64, num_steps=5, max_iterations=10**9, time_limit=0.05)
    env = navigation_v0.parallel_env(scenario="circle", num_robots=6)
    env.reset(seed=0)
    policy.reset(env)
    assert isinstance(policy, OpenLoop)
    assert policy.plan is not None
    assert policy.plan.status in ("time_limit", "solved")


@pytest.fixture(scope="module")
def plan() -> Plan:
    return cheap_planner("d4orm").solve(hop_problem(), seed=0)


def test_a_foreign_plan_is_refused(plan: Plan) -> None:
    policy = OpenLoop(plan=plan)
    for foreign in (make_problem("circle", num_robots=3), hop_problem(margin=0.06), hop_problem(2)):
        env = navigation_v0.parallel_env(problem=foreign)
        env.reset(seed=0)
        with pytest.raises(ValueError, match="made for another problem"):
            policy.reset(env)


def test_open_loop_needs_a_planner_or_a_plan_and_not_both(plan: Plan) -> None:
    with pytest.raises(ValueError, match="either a planner or a plan"):
        OpenLoop()
    with pytest.raises(ValueError, match="either a planner or a plan"):
        OpenLoop(planner=cheap_planner("d4orm"), plan=plan)


def test_after_the_plan_has_ended_the_controls_are_zero(plan: Plan) -> None:
    env = navigation_v0.parallel_env(problem=walk_away(), max_cycles=40)
    planned = cheap_planner("d4orm").solve(walk_away(), max_iterations=1)
    episode = run_episode(env, OpenLoop(plan=planned))
    assert len(episode.trajectory.controls) == 40
    assert not episode.trajectory.controls[30:].any()
    np.testing.assert_allclose(episode.trajectory.controls[:30], planned.controls, atol=1e-5)


def walk_away() -> Problem:
    """Goals that cannot be reached in the 30 steps there are."""
    problem = hop_problem()
    return problem.replace(goal=problem.goal + np.array([50, 0]))


def test_a_policy_reads_the_time_from_the_state(plan: Plan) -> None:
    env = navigation_v0.parallel_env(problem=plan.problem)
    observations, _ = env.reset(seed=0)
    policy = OpenLoop(plan=plan)
    policy.reset(env)
    for step in range(3):
        actions = policy.act(observations, env.state())
        # Asking twice, or not at all, changes nothing.
        again = policy.act(observations, env.state())
        expected = limit_controls(plan.problem, plan.controls[step])
        np.testing.assert_allclose(expected, plan.controls[step], atol=1e-6)
        for robot, agent in enumerate(env.possible_agents):
            np.testing.assert_array_equal(actions[agent], expected[robot])
            np.testing.assert_array_equal(again[agent], expected[robot])
        observations = env.step(actions)[0]


# ORCA.


@pytest.mark.parametrize("model", ["holonomic2d", "velocity2d", "differential_drive"])
def test_orca_crosses_the_circle_where_driving_straight_collides(model: str) -> None:
    env = navigation_v0.parallel_env(scenario="circle", num_robots=4, model=model)
    assert run_episode(env, make_policy("go-to-goal"), seed=0).metrics["collided"] == 4
    episode = run_episode(env, make_policy("orca"), seed=0)
    assert episode.metrics["success"] == 1
    assert episode.metrics["makespan"] < 8


def test_orca_goes_around_obstacles_and_docked_robots_and_stays_in_bounds() -> None:
    world = World(circles=[[1.5, -0.1, 0.3]], boxes=[[2.5, -0.6, 3.0, -0.1]], lower=[-0.5, -1.0], upper=[6.0, 1.0])
    # The second robot stands at its goal from the start, in the way of the first.
    start = [[0, 0, 0, 0], [4.0, 0, 0, 0]]
    problem = Problem(Team(("holonomic2d",) * 2), start, [[5.0, 0], [4.0, 0]], world)
    assert run_episode(navigation_v0.parallel_env(problem=problem), make_policy("go-to-goal")).metrics["collided"]
    episode = run_episode(navigation_v0.parallel_env(problem=problem), make_policy("orca"), seed=0)
    assert episode.metrics["success"] == 1


@pytest.mark.parametrize("shortest_paths", [True, False])
def test_orca_finds_its_way_through_rooms(shortest_paths: bool) -> None:
    env = navigation_v0.parallel_env("rooms", num_robots=4)
    policy = make_policy("orca", shortest_paths=shortest_paths)
    assert run_episode(env, policy, seed=0).metrics["success"] == shortest_paths


def test_goals_lie_along_the_ways_of_those_that_have_one() -> None:
    problem = make_problem("rooms", num_robots=4, seed=0)
    positions, goals = problem.start[:, :2], problem.goal.copy()
    goals[3] += 0.1
    ahead = goals_along_paths(problem, positions, goals)
    np.testing.assert_array_equal(ahead[3], goals[3])
    np.testing.assert_allclose(
        np.linalg.norm(ahead - positions, axis=1)[:3], problem.shortest_paths.length[:3], rtol=1e-5
    )
    directions = (ahead - positions)[:3] / problem.shortest_paths.length[:3, None]
    np.testing.assert_allclose(directions, problem.shortest_paths.direction(positions)[:3], atol=1e-5)
    np.testing.assert_array_equal(goals_along_paths(problem, problem.goal, problem.goal), problem.goal)
    empty = make_problem("random", num_robots=4)
    assert goals_along_paths(empty, empty.start[:, :2], empty.goal) is empty.goal


def test_orca_keeps_two_velocity_controlled_robots_outside_the_margin() -> None:
    problem = make_problem("circle", num_robots=2, model="velocity2d")
    for seed in range(3):
        metrics = run_episode(navigation_v0.parallel_env(problem=problem), make_policy("orca"), seed=seed).metrics
        assert metrics["success"] == 1
        assert metrics["margin_violated"] == 0


def test_orca_remembers_nothing_between_steps() -> None:
    env = navigation_v0.parallel_env(scenario="circle", num_robots=5)
    observations, _ = env.reset(seed=0)
    policy = make_policy("orca")
    policy.reset(env, seed=0)
    first = policy.act(observations, env.state())
    for _ in range(5):
        state = env.state()
        env.step(policy.act(observations, state))
    policy.reset(env, seed=0)
    env.reset(seed=0)
    for agent, action in policy.act(observations, env.state()).items():
        np.testing.assert_array_equal(action, first[agent])


def test_orca_refuses_a_problem_in_space() -> None:
    env = navigation_v0.parallel_env(scenario="circle", num_robots=2, model="holonomic3d")
    env.reset(seed=0)
    with pytest.raises(ValueError, match="'orca' works in the plane, and this problem has 3 dimensions"):
        make_policy("orca").reset(env)


def test_without_pyrvo_orca_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyrvo", None)
    with pytest.raises(ImportError, match=r"pip install 'd4orm-env\[orca\]'"):
        make_policy("orca")


# Noise.


@ENVIRONMENTS
def test_control_noise_changes_the_outcome(make_env: Any, plan: Plan) -> None:
    env = make_env(problem=plan.problem)
    first, again = (run_episode(env, OpenLoop(plan=plan), seed=3) for _ in range(2))
    np.testing.assert_array_equal(first.trajectory.states, again.trajectory.states)
    shared = min(len(first.trajectory.states), len(plan.trajectory.states))
    off = np.abs(first.trajectory.states[:shared] - plan.trajectory.states[:shared]).max()
    if make_env is navigation_v0.parallel_env:
        assert off <= 1e-5
    else:
        assert off > 0.02
        other = run_episode(env, OpenLoop(plan=plan), seed=4).trajectory.states
        shared = min(len(other), len(first.trajectory.states))
        assert np.abs(other[:shared] - first.trajectory.states[:shared]).max() > 0.02


# The simple policies.


@pytest.mark.parametrize(
    ("model", "start"),
    [
        ("holonomic2d", [0, 0, 0, 0]),
        ("holonomic2d", [0, 0, -0.6, 0.8]),
        ("holonomic3d", [0, 0, 0, 0, 0, 0]),
        ("holonomic3d", [0, 0, 0, 0, 0.6, -0.8]),
        ("velocity2d", [0, 0]),
        ("differential_drive", [0, 0, 0, 0]),
        ("differential_drive", [0, 0, 2.5, 0]),
        ("differential_drive", [0, 0, -7.0, 1.0]),
    ],
)
@pytest.mark.parametrize("goal_speed", [np.inf, 0.3])
def test_driving_to_the_goal_reaches_it_alone(model: str, start: list[float], goal_speed: float) -> None:
    goal = [2.0, 1.0, 1.5] if model == "holonomic3d" else [2.0, 1.0]
    # A first-order robot has no speed but the one it is told, and is told to stop at the goal, not before it.
    goal_speed = np.inf if model == "velocity2d" else goal_speed
    problem = Problem(Team((model,), max_speed=1.0), [start], [goal], goal_speed=goal_speed)
    episode = run_episode(navigation_v0.parallel_env(problem=problem), make_policy("go-to-goal"))
    assert episode.metrics["success"] == 1
    assert episode.metrics["makespan"] < 7


def test_a_full_turn_of_the_heading_makes_no_difference() -> None:
    times = []
    for heading in (0.5, 0.5 + 2 * np.pi, 0.5 - 4 * np.pi):
        problem = Problem(Team(("differential_drive",)), [[0, 0, heading, 0]], [[2.0, 1.0]])
        times.append(
            run_episode(navigation_v0.parallel_env(problem=problem), make_policy("go-to-goal")).metrics["makespan"]
        )
    assert times == pytest.approx([times[0]] * 3)


def test_driving_to_the_goal_is_nearly_as_quick_as_can_be() -> None:
    problem = hop_problem(1, horizon=100)
    far = problem.replace(goal=[[5.0, 0]])
    episode = run_episode(navigation_v0.parallel_env(problem=far), make_policy("go-to-goal"))
    # 1 s to reach 1 m/s within half a metre, 4.5 m at full speed; braking costs at most another half second.
    assert 5.4 <= episode.metrics["makespan"] <= 6.0


def test_driving_to_the_goal_does_not_look_at_the_others() -> None:
    problem = make_problem("circle", num_robots=2)
    episode = run_episode(navigation_v0.parallel_env(problem=problem), make_policy("go-to-goal"))
    assert episode.metrics["collided"] == 2
    assert episode.metrics["success"] == 0


def test_random_controls_differ_by_seed_and_fill_the_limits() -> None:
    env = navigation_v0.parallel_env(problem=walk_away())
    first, second = (run_episode(env, make_policy("random"), seed=seed).trajectory for seed in (0, 1))
    assert not np.allclose(first.controls, second.controls, atol=1e-2)
    assert not np.allclose(first.controls[0], first.controls[1], atol=1e-3)
    assert not np.allclose(first.controls[:, 0], first.controls[:, 1], atol=1e-2)
    drawn = np.concatenate([first.controls.ravel(), second.controls.ravel()])
    assert abs(drawn.mean()) < 0.15
    assert drawn.max() > 0.85
    assert drawn.min() < -0.85


def test_driving_to_the_goal_goes_on_in_lifelong_mode() -> None:
    env = navigation_v0.parallel_env(scenario="random", num_robots=3, size=4.0, lifelong=True, max_cycles=300)
    episode = run_episode(env, make_policy("go-to-goal"), seed=0)
    steps = len(episode.trajectory.controls)
    assert steps == 300
    reached = episode.metrics["goals_reached"]
    # Ten metres at about half a metre per second, and goals some two metres apart: each gets to several.
    assert reached >= 9
    assert episode.metrics["goals_per_robot_minute"] == pytest.approx(reached / (3 * 0.5))
    assert not episode.trajectory.arrived.any()
    assert sum(info[agent]["arrived"] for info in episode.infos for agent in info) == reached


@pytest.mark.parametrize(
    "name", ["go-to-goal", "random", lambda observations, state: {}, lambda observation: observation]
)
def test_acting_before_the_reset_says_what_to_do(name: Any) -> None:
    with pytest.raises(RuntimeError, match=r"call reset\(env\) before act"):
        make_policy(name).act({}, np.zeros(1, np.float32))


@ALL
def test_what_no_policy_can_act_on_is_refused_by_name(name: str) -> None:
    policy, env = cheap_policy(name), navigation_v0.parallel_env(scenario="circle", num_robots=3)
    observations, _ = env.reset(seed=0)
    state = env.state()
    policy.reset(env)
    for seed, message in ((-1, "at least 0"), (1.5, "a whole number, not 1.5"), (True, "a whole number, not True")):
        with pytest.raises(ValueError, match=rf"^seed .*{message}"):
            policy.reset(env, seed=seed)
        with pytest.raises(RuntimeError, match=r"call reset\(env\) before act"):
            policy.act(observations, state)  # a failed reset is none
    policy.reset(env, seed=0)
    assert list(policy.act({"robot_1": observations["robot_1"]}, state)) == ["robot_1"], "nobody else is asked for"
    for agent in ("robot_99", "robot_-1", "x"):
        with pytest.raises(ValueError, match=f"observations hold '{agent}'.* give them by agent, robot_0 to robot_2"):
            policy.act({agent: observations["robot_0"]}, state)
    with pytest.raises(ValueError, match=r"observations are .* give them by agent"):
        policy.act([*observations.values()], state)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"state\[3\] is nan"):
        policy.act(observations, np.where(np.arange(len(state)) == 3, np.nan, state))
    if isinstance(policy, LearnedPolicy):
        with pytest.raises(ValueError, match=r"observation of robot_1 has shape \(2,\); expected"):
            policy.act({**observations, "robot_1": np.zeros(2, np.float32)}, state)


# The policies that come with the package.


@pytest.mark.parametrize("name", ["ppo", "sac"])
def test_a_shipped_policy_solves_random_instances_that_driving_straight_does_not(name: str) -> None:
    env = navigation_v0.parallel_env(scenario="random", num_robots=4, randomize_instance=True)
    learned, straight = (
        sum(bool(run_episode(env, make_policy(policy), seed=seed).metrics["success"]) for seed in range(12))
        for policy in (name, "go-to-goal")
    )
    assert learned >= 7
    assert learned > straight
