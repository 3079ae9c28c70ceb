"""Goal headings in observations: as numbers, in every environment, and only where a robot has one."""

from __future__ import annotations

import math
from typing import Any

import jax
import numpy as np
import pytest

from d4orm_env import Problem, Team, make_problem, navigation_v0
from d4orm_env.core.observation_layout import ObservationLayout, ObservationSlices
from d4orm_env.disturbances import StateNoise
from d4orm_env.envs.features import Features
from d4orm_env.envs.joint_env import JointNavigationEnv
from d4orm_env.envs.vector_env import NavigationVectorEnv
from d4orm_env.jax.functional_env import FunctionalEnv

DRIVES = Problem(
    Team(("differential_drive",) * 3),
    [[0, 0, 0.5, 0.2], [0, 3, 3, 0], [3, 0, -1, 0.1]],
    [[2, 0], [2, 3], [3, 3]],
    goal_heading=[2.0, -3.0, math.nan],
)
"""A quarter turn and a little to the left, a little over a quarter of a radian to the left, and any heading."""
TRAINS = Problem(
    Team(("car_with_1_trailer", "unicycle", "car_with_3_trailers")),
    [[0, 0, 0.5, 0.2, 0, 0], [0, 3, 1, 0, 0, 0], [3, 0, 0, 0.1, -0.3, 0.4]],
    [[2, 0], [2, 3], [4, 0]],
    goal_heading=[2.0, 1.5, 0.0],
    goal_hitches=[[0.1, math.nan], [math.nan, math.nan], [math.nan, 0.2]],
)
"""A trailer that is bent too far to the right, none, and of three one that is bent to the wrong side."""
HITCHES = [[math.cos(0.1), -math.sin(0.1), 0, 0], [0, 0, 0, 0], [0, 0, math.cos(0.5), math.sin(0.5)]]
EXPECTED = [[math.cos(1.5), math.sin(1.5)], [0.96017029, 0.27941550], [0, 0]]


def stacked(values: dict[str, Any]) -> np.ndarray:
    return np.stack(list(values.values()))


def test_a_robot_sees_how_far_it_has_to_turn() -> None:
    env = navigation_v0.parallel_env(problem=DRIVES)
    seen, layout = stacked(env.reset(seed=0)[0]), env.unwrapped.layout
    np.testing.assert_allclose(seen[:, layout.own.goal_heading], EXPECTED, atol=1e-6)
    assert layout.names[11:15] == ("max_acceleration", "goal_heading_cos", "goal_heading_sin", "neighbor_0.present")
    # Robot 0's nearest neighbours are 3 m off, and come after that.
    np.testing.assert_allclose(layout.neighbors(seen)[0, :2, 1:3], [[0, 3], [3, 0]], atol=1e-6)


def test_a_robot_that_turns_sees_it() -> None:
    env = navigation_v0.parallel_env(problem=DRIVES)
    env.reset(seed=0)
    for count in range(1, 4):
        seen, *_ = env.step({agent: np.array([1, 0], np.float32) for agent in env.agents})
        turned = 1.5 - count * DRIVES.dt
        np.testing.assert_allclose(seen["robot_0"][12:14], [math.cos(turned), math.sin(turned)], atol=1e-5)


def test_robots_without_a_heading_have_none() -> None:
    team = Team(("unicycle", "velocity2d"))
    problem = Problem(team, [[0, 0, 1], [0, 3, 0]], [[2, 0], [2, 3]], goal_heading=[1.0, math.nan])
    seen, _ = navigation_v0.parallel_env(problem=problem).reset(seed=0)
    np.testing.assert_allclose(stacked(seen)[:, 12:14], [[1, 0], [0, 0]], atol=1e-6)


def test_where_no_robot_has_one_nothing_is_said_of_it() -> None:
    plain = DRIVES.replace(goal_heading=None)
    with_headings, without = (ObservationLayout.for_problem(problem) for problem in (DRIVES, plain))
    assert without.size == with_headings.size - 2 == 12 + 4 * 6 + 4 * 4
    assert not [name for name in without.names if name.startswith("goal_heading")]
    seen = [stacked(navigation_v0.parallel_env(problem=problem).reset(seed=0)[0]) for problem in (DRIVES, plain)]
    np.testing.assert_array_equal(np.delete(seen[0], [12, 13], axis=1), seen[1])
    np.testing.assert_array_equal(with_headings.with_goal_headings(seen[0], wanted=False), seen[1])
    np.testing.assert_array_equal(without.with_goal_headings(seen[1], wanted=True)[:, 12:14], 0)


def test_a_robot_sees_how_its_trailers_have_to_bend() -> None:
    """As far as any robot's do: the last trailer may arrive as it likes."""
    env = navigation_v0.parallel_env(problem=TRAINS)
    seen, layout = stacked(env.reset(seed=0)[0]), env.unwrapped.layout
    np.testing.assert_allclose(seen[:, layout.own.goal_hitches], HITCHES, atol=1e-6)
    names = [f"goal_hitch_{number}_{turn}" for number in (1, 2) for turn in ("cos", "sin")]
    assert layout.names[12:19] == ("goal_heading_cos", "goal_heading_sin", *names, "neighbor_0.present")
    headings = TRAINS.replace(goal_hitches=None)
    plain = stacked(navigation_v0.parallel_env(problem=headings).reset(seed=0)[0])
    np.testing.assert_array_equal(layout.with_goal_headings(seen, 1), plain)
    np.testing.assert_array_equal(layout.with_goal_headings(seen, 4)[:, 18:20], 0)
    without = ObservationLayout.for_problem(headings)
    np.testing.assert_array_equal(without.with_goal_headings(plain, 3)[:, 14:18], 0)


@pytest.mark.parametrize(
    ("problem", "egocentric", "expected"),
    [(DRIVES, False, EXPECTED), (DRIVES, True, EXPECTED), (TRAINS, False, HITCHES)],
)
def test_all_environments_show_the_same(problem: Problem, egocentric: bool, expected: list[list[float]]) -> None:
    options: dict[str, Any] = {"problem": problem, "egocentric": egocentric, "max_cycles": 8}
    parallel, joint = navigation_v0.parallel_env(**options), JointNavigationEnv(**options)
    by_turns, batched = navigation_v0.env(**options), NavigationVectorEnv(2, **options)
    pure, random = FunctionalEnv(**options), np.random.default_rng(0)
    by_turns.reset(seed=0)
    seen, once, many = stacked(parallel.reset(seed=0)[0]), joint.reset(seed=0)[0], batched.reset(seed=0)[0]
    (state, pure_seen), advance = pure.reset(jax.random.key(0)), jax.jit(pure.advance)
    first = 11 if egocentric else 14 if problem is TRAINS else 12
    np.testing.assert_allclose(seen[:, first : first + len(expected[0])], expected, atol=1e-6)
    for _ in range(6):
        assert all(parallel.observation_space(f"robot_{k}").contains(row) for k, row in enumerate(seen))
        assert joint.observation_space.contains(once)
        assert batched.observation_space.contains(many)
        np.testing.assert_array_equal(seen.ravel(), once)
        np.testing.assert_array_equal(seen.ravel(), many[1])
        np.testing.assert_array_equal(seen, [by_turns.observe(agent) for agent in by_turns.agents])
        np.testing.assert_allclose(pure_seen, seen, atol=1e-4)
        actions = random.uniform(-1, 1, (3, 2)).astype(np.float32)
        for action in actions:
            by_turns.step(action)
        seen = stacked(parallel.step(dict(zip(parallel.agents, actions)))[0])
        once, many = joint.step(actions.ravel())[0], batched.step(np.tile(actions.ravel(), (2, 1)))[0]
        state, transition = advance(jax.random.key(0), state, actions)
        pure_seen = transition.observations


def test_noise_on_what_is_seen_of_the_heading_is_in_it_too() -> None:
    env = navigation_v0.parallel_env(problem=DRIVES, disturbances=[StateNoise(0.0, heading_std=0.1)])
    seen, space = stacked(env.reset(seed=3)[0]), env.observation_space("robot_0")
    own = np.arctan2(seen[:2, 3], seen[:2, 2])
    to_turn = np.arctan2(seen[:2, 13], seen[:2, 12])
    np.testing.assert_allclose(np.cos(own + to_turn), np.cos([2.0, -3.0]), atol=1e-5)
    assert not np.allclose(to_turn, [1.5, 2 * math.pi - 6], atol=1e-3)
    assert all(space.contains(row) for row in seen)


def test_literal_features() -> None:
    # Faces left, the goal 3 m up the y axis, where it is to face up: a quarter turn to the right.
    own = [0, 0, -1, 0, 0, 0, 3, 0.25, 0, 0.15, 1, 2, 0, -1]
    neighbor = [1, 0, 1, 0, -0.5, 0.15]
    features = Features.of(ObservationSlices(2, 1, 0, goal_headings=1), "differential_drive")
    seen, _ = features.encode(np.array([own + neighbor], np.float32))
    plain, _ = Features.of(ObservationSlices(2, 1, 0), "differential_drive").encode(
        np.array([own[:-2] + neighbor], np.float32)
    )
    assert seen.shape == (1, features.size)
    assert seen[0, 11:13].tolist() == [0, -1]
    np.testing.assert_array_equal(np.delete(seen, [11, 12], axis=1), plain)
    assert [part.shape[-1] for part in features.parts(seen)] == [13, 9, 5]
    with_hitches = Features.of(ObservationSlices(2, 1, 0, goal_headings=2), "car_with_1_trailer")
    bent, _ = with_hitches.encode(np.array([[*own, 0.6, 0.8, *neighbor]], np.float32))
    np.testing.assert_allclose(bent[0, 13:15], [0.6, 0.8], atol=1e-6)
    np.testing.assert_array_equal(np.delete(bent, [13, 14], axis=1), seen)
    assert [part.shape[-1] for part in with_hitches.parts(bent)] == [15, 9, 5]


def test_instances_all_have_some_or_none() -> None:
    def scenario(seed: int, num_robots: int) -> Problem:
        problem = make_problem("random", num_robots, seed=seed, model="differential_drive")
        return problem.replace(goal_heading=0.5 * seed if seed < 1000 else None)

    env = navigation_v0.parallel_env(scenario, 2, randomize_instance=True)
    with pytest.raises(ValueError, match="differ in whether any robot has a goal heading, or goal hitch angles, by"):
        env.reset(seed=0)


def test_instances_all_have_goal_hitches_or_none() -> None:
    def scenario(seed: int, num_robots: int) -> Problem:
        problem = make_problem("random", num_robots, seed=seed, model="car_with_1_trailer")
        return problem.replace(goal_heading=0.0, goal_hitches=[[0.1], [math.nan if seed < 1000 else 0.2]])

    navigation_v0.parallel_env(scenario, 2, randomize_instance=True).reset(seed=0)

    def mixed(seed: int, num_robots: int) -> Problem:
        return scenario(seed, num_robots).replace(**({"goal_hitches": None} if seed >= 1000 else {}))

    env = navigation_v0.parallel_env(mixed, 2, randomize_instance=True)
    with pytest.raises(ValueError, match="differ in whether any robot has a goal heading, or goal hitch angles, by"):
        env.reset(seed=0)


def test_each_instance_tells_its_own() -> None:
    def scenario(seed: int, num_robots: int) -> Problem:
        problem = make_problem("random", num_robots, seed=seed, model="differential_drive")
        return problem.replace(goal_heading=[seed % 6, math.nan])

    env = navigation_v0.parallel_env(scenario, 2, randomize_instance=True)
    wanted = set()
    for seed in range(4):
        seen = stacked(env.reset(seed=seed)[0])
        problem = env.unwrapped.problem
        turn = float(problem.goal_heading[0] - problem.start[0, 2])
        np.testing.assert_allclose(seen[:, 12:14], [[math.cos(turn), math.sin(turn)], [0, 0]], atol=1e-5)
        wanted.add(float(problem.goal_heading[0]))
    assert len(wanted) > 1
