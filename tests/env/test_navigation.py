from __future__ import annotations

import copy
import pickle
from typing import Any

import numpy as np
import pytest
from env_support import act, line_problem, mixed_problem, sampled_actions, scenario_params, straight_drive
from gymnasium.utils.env_checker import data_equivalence
from pettingzoo.utils import aec_to_parallel

from d4orm_env import navigation_v0
from d4orm_env.core.trajectory import trajectory_metrics
from d4orm_env.core.world import World
from d4orm_env.engine.choice import get_engine
from d4orm_env.envs.joint_env import JointNavigationEnv
from d4orm_env.envs.joint_state import split_state
from d4orm_env.envs.vector_env import NavigationVectorEnv
from d4orm_env.scenarios import make_problem

INFO_TYPES = {"arrived": bool, "collided": bool, "margin_violated": bool, "distance_to_goal": float, "contacts": list}


def run(env: Any, controls: np.ndarray, seed: int | None = 0) -> list[tuple[Any, ...]]:
    """All that an episode under ``controls`` ``(H, K, m)`` returns."""
    log: list[tuple[Any, ...]] = [env.reset(seed=seed)]
    for control in controls:
        if not env.agents:
            break
        log.append((*env.step(act(env, control)), env.state()))
    return log


@pytest.mark.parametrize("case", scenario_params(5))
def test_stepping_a_plan_gives_its_trajectory(case: dict[str, Any]) -> None:
    env = navigation_v0.parallel_env(**case, randomize_instance=False)
    problem = env.unwrapped.problem
    throttle = np.linspace(1, 0.8, problem.num_robots)
    noise = np.random.default_rng(0).normal(0, 0.3, (problem.horizon, problem.num_robots, problem.control_size))
    controls = (straight_drive(problem, throttle) + noise * (np.arange(problem.horizon) < 30)[:, None, None]).astype(
        np.float32
    )
    trajectory = get_engine("cpu").rollout(problem, controls)
    _, infos = env.reset()
    t, alive = 0, list(env.agents)
    while env.agents:
        alive = list(env.agents)
        _, rewards, terminations, _, infos = env.step(act(env, controls[t]))
        t += 1
        joint = split_state(problem, env.state())
        np.testing.assert_allclose(joint.states, trajectory.states[t], atol=1e-5)
        np.testing.assert_allclose(joint.controls, trajectory.controls[t - 1], atol=1e-5)
        np.testing.assert_array_equal(joint.arrived, trajectory.arrived[t])
        for agent in alive:
            robot = env.possible_agents.index(agent)
            assert rewards[agent] == pytest.approx(trajectory.rewards[t - 1, robot], abs=1e-5)
            assert terminations[agent] == infos[agent]["arrived"] == trajectory.arrived[t, robot]
            assert infos[agent]["collided"] == trajectory.collided[t, robot]
            assert infos[agent]["margin_violated"] == trajectory.margin_violated[t, robot]
            distance = np.linalg.norm(trajectory.positions[t, robot] - problem.goal[robot])
            assert infos[agent]["distance_to_goal"] == pytest.approx(distance, abs=1e-5)
    assert t == problem.horizon or trajectory.arrived[t].all()


def test_some_plan_above_ends_early_and_metrics_agree_with_the_trajectory() -> None:
    problem = make_problem("circle", num_robots=5, goal_speed=np.inf)
    controls = straight_drive(problem, np.linspace(1, 0.8, 5))
    env = navigation_v0.parallel_env(problem=problem)
    run(env, controls)
    metrics = env.unwrapped.metrics()
    steps = int(metrics["steps"])
    assert steps < problem.horizon
    expected = trajectory_metrics(problem, get_engine("cpu").rollout(problem.replace(horizon=steps), controls[:steps]))
    assert metrics["arrived"] == 5
    for name in ("success", "travel_time", "makespan", "arrived", "collided", "margin_violated"):
        assert metrics[name] == pytest.approx(expected[name])
    assert metrics["reward"] == pytest.approx(expected["reward"], abs=1e-5)


def test_an_agent_that_arrives_leaves_and_its_body_stays() -> None:
    # 0.1 m per step and a goal radius of 0.075 m: robot_0 is at 0.3 m after three steps.
    problem = line_problem([0.3, 2.0])
    env = navigation_v0.parallel_env(problem=problem)
    env.reset()
    controls = np.array([[1, 0], [1, 0]], np.float32)
    for _ in range(2):
        _, _, terminations, truncations, _ = env.step(act(env, controls))
        assert terminations == truncations == {"robot_0": False, "robot_1": False}
    observations, rewards, terminations, truncations, infos = env.step(act(env, controls))
    assert terminations == {"robot_0": True, "robot_1": False}
    assert truncations == {"robot_0": False, "robot_1": False}
    assert set(observations) == set(rewards) == set(infos) == {"robot_0", "robot_1"}
    assert infos["robot_0"]["arrived"] is True
    assert env.agents == ["robot_1"]
    arrived = split_state(problem, env.state()).states[0]
    # An action for the one that left is ignored, whatever it is.
    result = env.step({"robot_0": np.array([-1, np.nan]), "robot_1": controls[1]})
    assert all(set(part) == {"robot_1"} for part in result)
    np.testing.assert_array_equal(split_state(problem, env.state()).states[0], arrived)
    assert split_state(problem, env.state()).controls[0].tolist() == [0, 0]


def test_a_docked_robot_is_an_obstacle() -> None:
    env = navigation_v0.parallel_env(problem=line_problem([0.1, 1.0]))
    env.reset()
    north = np.array([[1, 0], [0, -1]], np.float32)
    hit = []
    for _ in range(8):
        _, _, _, _, infos = env.step(act(env, north))
        hit.append(infos["robot_1"]["collided"])
    assert env.agents == ["robot_1"]
    # After t steps the centres are sqrt(0.1^2 + (1 - 0.1 t)^2) apart: in contact (0.3 m) from step 8 on.
    assert hit == [False] * 7 + [True]
    assert env.metrics()["collisions"] == 2


def test_running_out_of_steps_truncates_the_rest() -> None:
    env = navigation_v0.parallel_env(problem=line_problem([0.1, 9.0]), max_cycles=3)
    env.reset()
    seen = []
    while env.agents:
        seen.append(env.step(act(env, np.array([[1, 0], [1, 0]], np.float32)))[2:4])
    assert [terminations for terminations, _ in seen] == [
        {"robot_0": True, "robot_1": False},
        {"robot_1": False},
        {"robot_1": False},
    ]
    assert [truncations["robot_1"] for _, truncations in seen] == [False, False, True]
    assert env.step({}) == ({}, {}, {}, {}, {})


def test_arriving_at_the_last_step_is_a_termination() -> None:
    env = navigation_v0.parallel_env(problem=line_problem([0.3], horizon=3))
    log = run(env, np.ones((3, 1, 2), np.float32) * [1, 0])
    assert len(log) == 4
    assert log[-1][2] == {"robot_0": True}
    assert log[-1][3] == {"robot_0": False}
    assert env.agents == []


def test_max_cycles_can_be_assigned() -> None:
    env = navigation_v0.parallel_env(problem=line_problem([9.0]))
    assert env.max_cycles == 100
    env.max_cycles = 130
    env.reset()
    while env.agents:
        env.step({"robot_0": [-1, 0]})
        assert env.state_space.contains(env.state())
    assert env.metrics()["steps"] == 130
    with pytest.raises(ValueError, match="max_cycles is 0"):
        env.max_cycles = 0
    env.max_cycles = 5  # the episode is over
    env.reset()
    for _ in range(3):
        env.step({"robot_0": [-1, 0]})
    with pytest.raises(ValueError, match="max_cycles is 3 after 3 steps; give more, or assign it before the reset"):
        env.max_cycles = 3
    env.max_cycles = 4
    env.step({"robot_0": [-1, 0]})
    assert not env.agents
    assert env.state_space.contains(env.state())


def test_types_are_plain_and_dictionaries_fresh() -> None:
    env = navigation_v0.parallel_env("circle", 4)
    first = env.reset(seed=0)
    results = [env.step(sampled_actions(env)) for _ in range(2)]
    for observations, infos in [first, *((result[0], result[4]) for result in results)]:
        for agent in env.possible_agents:
            assert {name: type(value) for name, value in infos[agent].items()} == INFO_TYPES
            assert observations[agent].dtype == np.float32
            assert env.observation_space(agent).contains(observations[agent])
    for _, rewards, terminations, truncations, _ in results:
        assert {type(reward) for reward in rewards.values()} == {float}
        assert {type(flag) for flags in (terminations, truncations) for flag in flags.values()} == {bool}
    for old, new in zip(*results, strict=True):
        assert old is not new
    for agent in env.possible_agents:
        assert results[0][4][agent] is not results[1][4][agent]
        assert not np.shares_memory(results[0][0][agent], results[1][0][agent])
    before = copy.deepcopy(results[0])
    env.step(sampled_actions(env))
    assert data_equivalence(before, results[0], exact=True)


def test_what_is_returned_is_the_callers() -> None:
    env, twin = (navigation_v0.parallel_env("circle", 3, control_noise_std=0.1) for _ in range(2))
    actions = {agent: np.array([0.3, -0.2], np.float32) for agent in env.possible_agents}
    for world in (env, twin):
        world.reset(seed=4)
    for _ in range(5):
        result, expected = env.step(actions), twin.step(actions)
        assert data_equivalence(result, expected, exact=True)
        state = env.state()
        for part in result:
            part.clear()
        state[:] = -7


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"robot_1": None}, "action of robot_1 is None"),
        ({"robot_1": "left"}, "action of robot_1 is 'left'"),
        ({"robot_1": 0.5}, "action of robot_1 is 0.5; it must be 2 finite numbers"),
        ({"robot_1": [0.0, 0.0, 0.0]}, "action of robot_1"),
        ({"robot_1": [0.0, float("nan")]}, "action of robot_1"),
        ({"robot_2": [float("inf"), 0.0]}, "action of robot_2"),
        ({"robot_2": [1e300, 0.0]}, "action of robot_2"),
        ({"robot_2": [2e19, 0.0]}, r"action of robot_2 is \[2e\+19, 0.0\]; .* at most 1e\+15 in magnitude"),
        ({"robot_2": [10**400, 0.0]}, "action of robot_2"),
        ({"robot_7": [0.0, 0.0]}, "unknown agents robot_7"),
    ],
)
def test_bad_actions_are_refused_by_name(change: dict[str, Any], message: str) -> None:
    env = navigation_v0.parallel_env("circle", 3)
    env.reset()
    before = env.state()
    actions = {agent: np.zeros(2, np.float32) for agent in env.agents} | change
    with pytest.raises(ValueError, match=message):
        env.step(actions)
    np.testing.assert_array_equal(env.state(), before)


@pytest.mark.parametrize("actions", [None, 3, [[0, 0]] * 3])
def test_actions_that_are_no_dictionary_are_refused(actions: Any) -> None:
    env = navigation_v0.parallel_env("circle", 3)
    env.reset()
    with pytest.raises(ValueError, match="actions must be a dictionary with an action for every agent"):
        env.step(actions)


@pytest.mark.parametrize("make", [navigation_v0.raw_env, navigation_v0.env])
def test_robots_that_act_in_turn_are_blamed_at_their_own_step(make: Any) -> None:
    env = make("circle", 3)
    env.reset()
    env.step(np.zeros(2, np.float32))
    for action in ([np.nan, 0], None, [0, 0, 0], [1e20, 0]):
        with pytest.raises(ValueError, match="action of robot_1 is"):
            env.step(action)
    assert env.agent_selection == "robot_1"
    for _ in range(2):
        env.step(np.zeros(2, np.float32))
    assert env.agent_selection == "robot_0"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"colour": "red"}, "scenario 'circle' takes no argument 'colour'; it takes .*control_noise_std, .*diameter"),
        ({"max_cycle": 5}, "takes no argument 'max_cycle'.*did you mean 'max_cycles'?"),
        ({"scenario": "swap", "diameter": 5.0}, "scenario 'swap' takes no argument 'diameter'"),
        (
            {"problem": line_problem([1.0]), "render": "human"},
            "takes no argument 'render'.*did you mean 'render_mode'?",
        ),
    ],
)
def test_unknown_arguments_are_type_errors(arguments: dict[str, Any], message: str) -> None:
    for make in (navigation_v0.parallel_env, navigation_v0.env, JointNavigationEnv, NavigationVectorEnv):
        with pytest.raises(TypeError, match=message):
            make(**arguments)


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_of_an_environment_that_has_drawn_draws_too(duplicate: Any) -> None:
    env = navigation_v0.parallel_env("circle", 2, render_mode="rgb_array")
    env.reset(seed=0)
    frame = env.render()
    twin = duplicate(env)
    np.testing.assert_array_equal(twin.render(), frame)
    env.close()
    twin.close()


def test_a_missing_action_is_refused_by_name() -> None:
    env = navigation_v0.parallel_env("circle", 3)
    env.reset()
    with pytest.raises(ValueError, match="actions lack robot_2"):
        env.step({"robot_0": [0, 0], "robot_1": [0, 0]})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"problem": line_problem([1.0]), "scenario": "circle"}, "excludes the scenario arguments .scenario."),
        ({"problem": line_problem([1.0]), "num_robots": 2}, "num_robots"),
        ({"problem": line_problem([1.0]), "diameter": 4.0}, "diameter"),
        ({"problem": line_problem([1.0]), "randomize_instance": True}, "randomize_instance"),
        ({"scenario": "circle", "randomize_instance": True}, "same for every seed"),
        ({"scenario": "nowhere"}, "nowhere"),
        ({"render_mode": "ansi"}, "render_mode is 'ansi'"),
        ({"control_noise_std": -0.1}, "control_noise_std"),
        ({"control_noise_std": float("nan")}, "control_noise_std"),
        ({"control_noise_std": 1e300}, "control_noise_std"),
        ({"control_noise_std": 1e7}, r"control_noise_std is .*; it must be at most 1e\+06"),
        ({"control_noise_std": 10**400}, "control_noise_std must be a number"),
        ({"max_cycles": 10**12}, "max_cycles is 1000000000000; it must be at most 1000000000"),
        ({"observed_robots": 10**9}, "observed_robots is 1000000000; it must be at most 10000"),
        ({"control_noise_std": "much"}, "control_noise_std must be a number"),
        ({"control_noise_std": True}, "control_noise_std must be a number .*, not True"),
        ({"control_noise_std": [0.1, 0.1, 0.1]}, "control_noise_std has shape"),
        ({"max_cycles": 0}, "max_cycles is 0"),
        ({"observed_robots": -1}, "observed_robots"),
    ],
)
def test_bad_arguments_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        navigation_v0.parallel_env(**arguments)


@pytest.mark.parametrize("call", ["step", "state", "render", "metrics"])
def test_calls_before_reset_are_refused(call: str) -> None:
    env = navigation_v0.parallel_env("circle", 2, render_mode="rgb_array")
    with pytest.raises(RuntimeError, match="reset"):
        getattr(env, call)(*([{}] if call == "step" else []))


def test_episodes_repeat_with_their_seed() -> None:
    controls = straight_drive(make_problem("circle", num_robots=4), 0.9)
    env, other = (navigation_v0.parallel_env("circle", 4, control_noise_std=0.2) for _ in range(2))
    first = run(env, controls, seed=7)
    assert data_equivalence(first, run(other, controls, seed=7), exact=True)
    assert data_equivalence(first, run(env, controls, seed=7), exact=True)
    assert not data_equivalence(first[1], run(env, controls, seed=8)[1])


def test_reset_without_seed_goes_on_with_the_generator() -> None:
    controls = straight_drive(make_problem("circle", num_robots=3), 0.9)[:20]
    logs = []
    for length in (20, 3):
        env = navigation_v0.parallel_env("circle", 3, control_noise_std=0.2)
        first = run(env, controls[:length], seed=1)
        second = run(env, controls, seed=None)
        assert not data_equivalence(first[1], second[1])
        logs.append(second)
    # The second episode does not depend on how long the first one was.
    assert data_equivalence(logs[0], logs[1], exact=True)


def test_options_that_would_be_ignored_are_refused() -> None:
    env = navigation_v0.parallel_env("circle", 2)
    with pytest.raises(ValueError, match="reset takes no option 'problem'; it takes none"):
        env.reset(seed=0, options={"problem": env.problem})
    with pytest.raises(TypeError, match="options must be a dictionary"):
        env.reset(options="fast")  # type: ignore[arg-type]
    assert data_equivalence(env.reset(seed=0), env.reset(seed=0, options={}), exact=True)


def test_noise_has_its_standard_deviation_per_component() -> None:
    problem = line_problem([50.0] * 40, "differential_drive")
    env = navigation_v0.parallel_env(problem=problem, control_noise_std=(0.2, 0.0))
    env.reset(seed=0)
    executed = []
    for _ in range(50):
        env.step(act(env, np.tile(np.float32([0.1, 0.5]), (40, 1))))
        executed.append(split_state(problem, env.state()).controls)
    noise = np.array(executed)
    # 2000 draws: the mean is within four standard errors, 0.2 / sqrt(2000) each, and the deviation within 7 %.
    assert noise[..., 0].mean() == pytest.approx(0.1, abs=0.018)
    assert noise[..., 0].std() == pytest.approx(0.2, rel=0.07)
    assert (noise[..., 1] == 0.5).all()


def test_noisy_controls_keep_the_limits() -> None:
    env = navigation_v0.parallel_env("circle", 6, control_noise_std=3.0)
    env.reset(seed=0)
    for _ in range(10):
        env.step(act(env, np.ones((6, 2), np.float32)))
        executed = split_state(env.problem, env.state()).controls
        assert np.linalg.norm(executed, axis=1).max() <= 1 + 1e-6
        assert np.ptp(executed) > 0.1


def test_actions_beyond_the_limits_are_clipped_by_norm() -> None:
    env = navigation_v0.parallel_env(problem=line_problem([5.0], "holonomic2d"))
    env.reset()
    env.step({"robot_0": [30.0, 40.0]})
    np.testing.assert_allclose(split_state(env.problem, env.state()).controls, [[0.6, 0.8]], rtol=1e-6)


def test_spaces_are_distinct_equal_and_stable() -> None:
    env = navigation_v0.parallel_env(problem=mixed_problem())
    for space in (env.observation_space, env.action_space):
        spaces = [space(agent) for agent in env.possible_agents]
        assert all(space(agent) is known for agent, known in zip(env.possible_agents, spaces))
        assert len({id(known) for known in spaces}) == 3
        assert spaces[0] == spaces[1] == spaces[2]
    # Largest of the team: turn rate pi/2 of the differential drive, acceleration 2 m/s^2 of the last robot.
    np.testing.assert_allclose(env.action_space("robot_0").high, [2.0, 2.0])
    np.testing.assert_allclose(env.action_space("robot_0").low, [-2.0, -2.0])


@pytest.mark.parametrize("problem", [mixed_problem(), make_problem("sphere", num_robots=3)], ids=["mixed", "sphere"])
def test_the_state_holds_everything(problem: Any) -> None:
    env = navigation_v0.parallel_env(problem=problem)
    env.reset()
    assert split_state(problem, env.state()).steps == 0
    np.testing.assert_array_equal(split_state(problem, env.state()).states, problem.start)
    env.action_space("robot_0").seed(0)
    for steps in range(1, 20):
        env.step({agent: env.action_space("robot_0").sample() for agent in env.agents})
        state = env.state()
        joint = split_state(problem, state)
        assert state.dtype == np.float32
        assert env.state_space.contains(state)
        assert joint.steps == steps
        np.testing.assert_array_equal(joint.goals, problem.goal)
        # The physics go on from the parts as they would have in the environment.
        engine = get_engine("cpu")
        control = np.full((3, problem.control_size), 0.1, np.float32)
        expected = engine.step(problem.arrays, joint.states, joint.arrived, control)
    env.step(dict.fromkeys(env.agents, control[0]))
    np.testing.assert_array_equal(split_state(problem, env.state()).states, expected.states)


def test_a_state_of_another_problem_is_refused() -> None:
    env = navigation_v0.parallel_env("circle", 3)
    env.reset()
    with pytest.raises(ValueError, match=r"state has shape \(28,\)"):
        split_state(make_problem("circle", num_robots=4), env.state())
    with pytest.raises(ValueError, match=r"state is <bound method.*; give the vector that env.state\(\) returns"):
        split_state(env.problem, env.state)
    with pytest.raises(ValueError, match=r"problem is array.*; give a Problem"):
        split_state(env.state(), env.problem)  # type: ignore[arg-type]


def test_time_left_runs_out() -> None:
    env = navigation_v0.parallel_env(problem=line_problem([9.0]), max_cycles=4)
    index = env._simulation.setup.layout.names.index("time_left")
    observations, _ = env.reset()
    left = [observations["robot_0"][index]]
    while env.agents:
        left.append(env.step({"robot_0": [0, 0]})[0]["robot_0"][index])
    assert left == [1.0, 0.75, 0.5, 0.25, 0.0]


def test_new_instances() -> None:
    env = navigation_v0.parallel_env("random", 4, randomize_instance=True)
    spaces = env.state_space, env.observation_space("robot_0")
    problems = []
    for seed in (3, None, 3):
        env.reset(seed=seed)
        problems.append(env.unwrapped.problem)
        joint = split_state(env.problem, env.state())
        np.testing.assert_array_equal(joint.states, env.problem.start)
        np.testing.assert_array_equal(joint.goals, env.problem.goal)
        assert env.state_space.contains(env.state())
    assert problems[0] == problems[2] != problems[1]
    assert (env.state_space, env.observation_space("robot_0")) == spaces


def test_without_new_instances_the_problem_stays() -> None:
    env = navigation_v0.parallel_env("random", 4, seed=5, randomize_instance=False)
    for seed in (0, None, 1):
        env.reset(seed=seed)
        assert env.problem == make_problem("random", num_robots=4, seed=5)


def test_frames() -> None:
    env = navigation_v0.parallel_env("circle", 3, render_mode="rgb_array")
    env.reset()
    first = env.render()
    assert first.shape == (480, 480, 3)
    assert first.dtype == np.uint8
    for _ in range(10):
        env.step(act(env, straight_drive(env.problem)[0]))
    assert (env.render() != first).any()
    env.close()
    env.close()


def test_rendering_without_a_mode_warns() -> None:
    env = navigation_v0.parallel_env("circle", 2)
    env.reset()
    with pytest.warns(UserWarning, match="render_mode"):
        assert env.render() is None


def test_metadata() -> None:
    env = navigation_v0.parallel_env("circle", 2, dt=0.05)
    assert env.metadata["name"] == "d4orm_navigation_v0"
    assert env.metadata["render_modes"] == ["human", "rgb_array"]
    assert env.metadata["render_fps"] == 20
    assert navigation_v0.parallel_env.metadata["render_fps"] == 10
    assert env.possible_agents == ["robot_0", "robot_1"]


def test_an_env_in_mid_episode_survives_pickling() -> None:
    env = navigation_v0.parallel_env("circle", 3, control_noise_std=0.1)
    controls = straight_drive(env.problem)
    env.reset(seed=2)
    for control in controls[:10]:
        env.step(act(env, control))
    twin = pickle.loads(pickle.dumps(env))
    for control in controls[10:20]:
        assert data_equivalence(env.step(act(env, control)), twin.step(act(twin, control)), exact=True)


def test_an_env_with_new_instances_survives_pickling() -> None:
    env = navigation_v0.parallel_env("random", 2, randomize_instance=True)
    env.reset(seed=0)
    twin = pickle.loads(pickle.dumps(env))
    assert env.problem == twin.problem
    env.reset()
    twin.reset()
    assert env.problem == twin.problem


def test_aec_and_parallel_agree() -> None:
    parallel = navigation_v0.parallel_env(problem=line_problem([0.3, 0.5, 9.0]), control_noise_std=0.05, max_cycles=9)
    aec = navigation_v0.env(problem=line_problem([0.3, 0.5, 9.0]), control_noise_std=0.05, max_cycles=9)
    parallel.reset(seed=0)
    aec.reset(seed=0)
    control = np.array([1, 0], np.float32)
    while parallel.agents:
        observations, rewards, terminations, truncations, infos = parallel.step(dict.fromkeys(parallel.agents, control))
        for _ in observations:
            aec.step(control)
        np.testing.assert_array_equal(aec.state(), parallel.state())
        for agent in sorted(observations):
            np.testing.assert_array_equal(aec.observe(agent), observations[agent])
        assert aec.rewards == rewards
        assert aec.terminations == terminations
        assert aec.truncations == truncations
        assert aec.infos == infos
        while aec.agents and (aec.terminations[aec.agent_selection] or aec.truncations[aec.agent_selection]):
            aec.step(None)
    assert aec.agents == []
    assert isinstance(aec_to_parallel(aec), navigation_v0.parallel_env)
    assert aec.unwrapped.metrics() == parallel.metrics()


def chase(env: Any, seed: int = 0) -> list[dict[str, Any]]:
    """A lifelong episode in which every velocity2d robot drives at its goal; the infos of all steps."""
    env.reset(seed=seed)
    log = []
    while env.agents:
        joint = split_state(env.problem, env.state())
        offsets = joint.goals - joint.states[:, : env.problem.dimension]
        log.append(env.step(act(env, (offsets / np.linalg.norm(offsets, axis=1, keepdims=True)).astype(np.float32))))
    return log


@pytest.mark.parametrize("obstacles", [0, 3])
def test_lifelong_goals_touch_nobody(obstacles: int) -> None:
    env = navigation_v0.parallel_env(
        "circle", 4, model="velocity2d", num_obstacles=obstacles, lifelong=True, max_cycles=400
    )
    problem, seen = env.problem, 0
    env.reset(seed=0)
    old = problem.goal
    while env.agents:
        joint = split_state(problem, env.state())
        offsets = joint.goals - joint.states[:, :2]
        actions = act(env, (offsets / np.linalg.norm(offsets, axis=1, keepdims=True)).astype(np.float32))
        _, _, terminations, _, infos = env.step(actions)
        assert not any(terminations.values())
        joint = split_state(problem, env.state())
        assert env.state_space.contains(env.state())
        assert not joint.arrived.any()
        for robot in range(4):
            got_there = infos[f"robot_{robot}"]["arrived"]
            assert got_there == (joint.goals[robot] != old[robot]).any()
            if got_there:
                seen += 1
                goal, others = joint.goals[robot], np.arange(4) != robot
                assert np.linalg.norm(joint.goals[others] - goal, axis=1).min() > 0.3
                assert np.linalg.norm(joint.states[others, :2] - goal, axis=1).min() > 0.3
                assert problem.world.clearance(goal) > 0.15
                distance = np.linalg.norm(joint.states[robot, :2] - goal)
                assert distance > problem.goal_radius
                assert infos[f"robot_{robot}"]["distance_to_goal"] == pytest.approx(distance, abs=1e-5)
        old = joint.goals
    metrics = env.metrics()
    assert seen > 20
    assert metrics["goals_reached"] == seen
    assert metrics["goals_per_robot_minute"] == pytest.approx(seen / (4 * 40 / 60))
    assert metrics["steps"] == 400


def test_lifelong_goals_stay_in_bounds() -> None:
    env = navigation_v0.parallel_env("amswarm_2", lifelong=True, max_cycles=150)
    env.reset(seed=0)
    controls = straight_drive(env.problem)
    goals = []
    for _ in range(150):
        env.step(act(env, controls[0]))
        goals.append(split_state(env.problem, env.state()).goals)
    changed = np.array(goals)[-1] != env.problem.goal
    assert changed.any()
    assert np.abs(goals).max() <= 3 - 0.29
    for cylinder in env.problem.world.cylinders:
        assert np.linalg.norm(np.array(goals)[..., :2] - cylinder[:2], axis=-1).min() > 0.49


def test_a_lifelong_robot_does_not_stop_at_its_goal() -> None:
    env = navigation_v0.parallel_env(problem=line_problem([0.5], "holonomic2d"), lifelong=True)
    env.reset(seed=0)
    for _ in range(40):
        *_, infos = env.step({"robot_0": [1.0, 0.0]})
        if infos["robot_0"]["arrived"]:
            break
    assert infos["robot_0"]["arrived"]
    # Half a metre at 1 m/s^2 ends at about 1 m/s.
    assert split_state(env.problem, env.state()).states[0, 2] > 0.8
    env.step({"robot_0": [1.0, 0.0]})
    assert split_state(env.problem, env.state()).states[0, 0] > 0.5


def test_lifelong_goal_speed_counts() -> None:
    problem = line_problem([0.5], "holonomic2d", goal_speed=0.1)
    env = navigation_v0.parallel_env(problem=problem, lifelong=True)
    env.reset(seed=0)
    # Full speed ahead runs through the goal; brakes that stop there do arrive.
    assert not any(env.step({"robot_0": [1.0, 0.0]})[4]["robot_0"]["arrived"] for _ in range(15))
    env.reset(seed=0)
    drive = [1.0] * 7 + [-1.0] * 7
    assert any(env.step({"robot_0": [a, 0.0]})[4]["robot_0"]["arrived"] for a in drive)


def test_lifelong_episodes_repeat_with_their_seed() -> None:
    def log(seed: int) -> list[Any]:
        env = navigation_v0.parallel_env("circle", 3, model="velocity2d", lifelong=True, max_cycles=150)
        return [chase(env, seed), env.metrics()]

    assert data_equivalence(log(0), log(0), exact=True)
    assert not data_equivalence(log(0), log(1))


def test_lifelong_without_room_says_so() -> None:
    # Centres may be 0 to 0.2 m in x, nowhere far enough from the robot to be a new goal.
    problem = line_problem([0.2], world=World(lower=[-0.2, -0.25], upper=[0.4, 0.25]))
    env = navigation_v0.parallel_env(problem=problem, lifelong=True)
    with pytest.raises(RuntimeError, match="no free position for a new goal of robot_0"):
        chase(env)


def test_metrics_count_robot_steps_in_contact() -> None:
    # Two robots one metre apart close in at 0.2 m per step: 0.8, 0.6, 0.4, 0.2, 0.0. Contact is at 0.3, margin at 0.35.
    env = navigation_v0.parallel_env(problem=line_problem([9.0, 9.0]), max_cycles=5)
    run(env, np.repeat(np.array([[[0, 1], [0, -1]]], np.float32), 5, axis=0))
    metrics = env.metrics()
    assert metrics["collisions"] == 4
    assert metrics["margin_violations"] == 4
    assert metrics["collided"] == 2
    assert metrics["success"] == 0
    assert metrics["travel_time"] == metrics["makespan"] == pytest.approx(0.5)
    assert metrics["goals_reached"] == metrics["goals_per_robot_minute"] == 0


def test_metrics_of_a_success() -> None:
    env = navigation_v0.parallel_env(problem=line_problem([0.3, 0.6]))
    run(env, np.repeat(np.array([[[1, 0], [1, 0]]], np.float32), 100, axis=0))
    metrics = env.metrics()
    assert metrics["success"] == 1
    assert metrics["travel_time"] == pytest.approx(0.45)
    assert metrics["makespan"] == pytest.approx(0.6)
    assert metrics["steps"] == 6
    # Distances after each step over the first distance, with robot_0 docked: the mean of 1 - d / d0.
    arrived = 1 - np.array([0.2, 0.1, 0, 0, 0, 0]) / 0.3
    driving = 1 - np.array([0.5, 0.4, 0.3, 0.2, 0.1, 0]) / 0.6
    assert metrics["reward"] == pytest.approx((arrived.mean() + driving.mean()) / 2, abs=1e-5)
