"""Bodies on given trajectories: where they are, whom they touch, who sees them."""

from __future__ import annotations

import copy
import pickle
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from env_support import line_problem

from d4orm_env import mujoco, navigation_v0
from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.disturbances import Intruder, MovingObstacle, load_pedestrians
from d4orm_env.envs.joint_state import split_state
from d4orm_env.render import plot_trajectory
from d4orm_planners import evaluate, run_episode
from d4orm_planners.evaluation.store import TrialStore

STILL = Problem(Team(("velocity2d",) * 2, radius=0.25), [[0, 0], [0, 5]], [[0, 3], [3, 5]], horizon=60)
ACROSS = MovingObstacle([1, 3, 4], [[-2, 0], [2, 0], [2, 1]], radius=0.5)
"""Passes the origin after 2 s, at 2 m/s."""


def bodies_of(env: Any) -> np.ndarray:
    return split_state(env.unwrapped.problem, env.state()).bodies


def run(env: Any, steps: int) -> None:
    for _ in range(steps):
        env.step({agent: np.zeros(2, np.float32) for agent in env.agents})


def test_it_is_on_its_trajectory_and_absent_before_and_after() -> None:
    env = navigation_v0.parallel_env(problem=STILL, disturbances=[ACROSS])
    env.reset(seed=0)
    assert (bodies_of(env) == 0).all()
    expected = {10: [-2, 0, 2, 0, 0.5], 15: [-1, 0, 2, 0, 0.5], 30: [2, 0, 0, 1, 0.5], 40: [2, 1, 0, 1, 0.5]}
    for step in range(1, 45):
        run(env, 1)
        here = bodies_of(env)[0]
        if step in expected:
            assert here == pytest.approx(expected[step], abs=1e-5)
        assert (here[4] > 0) == (10 <= step <= 40)
        assert env.state() in env.state_space


def test_contact_is_a_collision_and_an_absent_one_touches_nobody() -> None:
    env = navigation_v0.parallel_env(problem=STILL, disturbances=[ACROSS])
    env.reset(seed=0)
    touched = []
    for _ in range(30):
        touched.append(env.step({agent: np.zeros(2, np.float32) for agent in env.agents})[4]["robot_0"]["collided"])
    # From 0.75 m before the origin to as far behind it; the robot is there from the beginning, as zeros would be.
    assert [step + 1 for step in np.flatnonzero(touched)] == list(range(17, 24))


def test_robots_observe_it_as_a_neighbour() -> None:
    env = navigation_v0.parallel_env(problem=STILL, disturbances=[ACROSS])
    observations, _ = env.reset(seed=0)
    layout = env.unwrapped._simulation.setup.layout
    count = [int(layout.neighbors(observations["robot_0"])[:, 0].sum())]
    run(env, 14)
    observations = env.step({agent: np.zeros(2, np.float32) for agent in env.agents})[0]
    count.append(int(layout.neighbors(observations["robot_0"])[:, 0].sum()))
    assert count == [1, 2]
    assert layout.neighbors(observations["robot_0"])[0] == pytest.approx([1, -1, 0, 2, 0, 0.5], abs=1e-5)
    assert all(values in env.observation_space(agent) for agent, values in observations.items())


def test_batched_worlds_have_it_and_others_beside_it() -> None:
    options = {"problem": STILL, "disturbances": [Intruder(2), ACROSS]}
    batch = gymnasium.make_vec("d4orm/Navigation-v0", 2, "vector_entry_point", **options)
    single = gymnasium.make("d4orm/Navigation-v0", **options)
    observed, one = batch.reset(seed=[1, 2])[0], single.reset(seed=2)[0]
    for _ in range(20):
        np.testing.assert_array_equal(observed[1].ravel(), one)
        controls = np.zeros(batch.action_space.shape, np.float32)
        observed, one = batch.step(controls)[0], single.step(controls[1].ravel())[0]


def test_planners_evade_it_and_pictures_show_it() -> None:
    problem = line_problem([3.0], "holonomic2d", horizon=80)
    start, goal = problem.start[0, :2], problem.goal[0]
    middle, side = (start + goal) / 2, np.array([0.0, 1.0])
    crossing = MovingObstacle([0, 8], [middle + 2 * side, middle - 2 * side], 0.3)
    episode = run_episode(navigation_v0.parallel_env(problem=problem, disturbances=[crossing]), "d4orm-c2f", seed=0)
    assert episode.metrics["success"]
    assert plot_trajectory(problem, episode.trajectory, events=episode.events).get_axes()
    assert ACROSS.replayable


def test_pedestrians_are_read_from_a_file(tmp_path: Path) -> None:
    path = tmp_path / "people.csv"
    path.write_text("id,time,x,y,group\nb,101,5,5,0\na,100,0,0,0\na,102,2,4,0\nb,103,7,5,0\nc,100,1,1,0\n")
    people = load_pedestrians(path)
    assert people.times == pytest.approx([0, 1, 2, 3])
    path.write_text("\ufeff" + path.read_text().replace(",", ", "), encoding="utf-8")  # as spreadsheets write it
    np.testing.assert_array_equal(load_pedestrians(path).positions, people.positions)
    nan = np.nan
    np.testing.assert_allclose(people.positions[:, 0], [[nan] * 2, [5, 5], [6, 5], [7, 5]])
    np.testing.assert_allclose(people.positions[:, 1], [[0, 0], [1, 2], [2, 4], [nan] * 2])
    assert people.radius == 0.25
    env = navigation_v0.parallel_env(problem=STILL, disturbances=[people])
    env.reset(seed=0)
    run(env, 5)
    assert bodies_of(env)[:, 4] == pytest.approx([0, 0.25, 0])
    for again in (pickle.loads(pickle.dumps(people)), copy.deepcopy(people)):
        np.testing.assert_array_equal(again.positions, people.positions)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("id,time,x\na,0,0\n", "has no column y; it needs a header with id, time, x and y"),
        ("id,time,x,y\na,0,0,zero\n", "line 2: time, x and y are '0', '0', 'zero'; give numbers"),
        ("id,time,x,y\na,0,0,0\na,1,nan,1\n", "line 3: time, x and y are '1', 'nan', '1'; give numbers"),
        ("id,time,x,y\na,0,0,0\na,0,1,0\n", "line 3: a is at two places at 0 s"),
        ("id,time,x,y\na,0,0,0\n", "people.csv has rows at 1 different times; give two"),
        ("id,time,x,y\n", "people.csv has rows at 0 different times; give two"),
        ("id,time,x,y\nJos\xe9,0,0,0\n", "people.csv: cannot be read .*give a CSV file of pedestrians, in UTF-8"),
        (f"id,time,x,y\na,0,0,{'1' * 200_000}\n", "people.csv: cannot be read .*field larger than field limit"),
    ],
)
def test_a_bad_file_is_an_error(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "people.csv"
    path.write_text(text, encoding="latin-1")
    with pytest.raises(ValueError, match=message):
        load_pedestrians(path)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([0, 0], [[0, 0], [1, 1]]), "times are .*; give two or more that increase"),
        (([0, 1], [[0, 0]]), r"positions are \[\[0, 0\]\]; they must be numbers \(T, d\)"),
        (([0, 1], "a"), "MovingObstacle positions are 'a'; they must be numbers"),
        (([0, 1], [[0, 0], [1]]), r"positions are \[\[0, 0\], \[1\]\]; they must be numbers"),
        (([0, 1], [[0, 0], [1, 1]], 0), "radius is 0"),
        (([0, 1], [[0, 0], [np.nan, 1]]), r"position \[nan, 1.0\] is half NaN; give all of it, or NaN for absent"),
        (([0, 1], [[0, 0], [1e9, 1]]), "at most 1e\\+06 m"),
    ],
)
def test_a_bad_trajectory_is_an_error(arguments: tuple[Any, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        MovingObstacle(*arguments)


def test_they_are_equal_where_they_move_alike_and_a_study_tells_them_apart(tmp_path: Path) -> None:
    later = MovingObstacle([2, 4, 5], ACROSS.positions, 0.5)
    again = MovingObstacle([1, 3, 4], [[-2, 0], [2, 0], [2, 1]], 0.5)
    assert (again == ACROSS, hash(again) == hash(ACROSS), later == ACROSS) == (True, True, False)
    rates = evaluate(
        "go-to-goal", STILL, out=tmp_path, seeds=[0], workers=1, disturbances={"people": [[], [ACROSS], [later]]}
    )
    assert [rate.undisturbed for rate in rates] == [True, False, False]
    assert [rate.contacts for rate in rates] == [0, 0, 0]
    assert len({trial.disturbances for trial in TrialStore.existing(tmp_path).trials()}) == 3


def test_it_must_fit_the_robots_and_the_physics() -> None:
    with pytest.raises(ValueError, match="positions have 2 components, and the robots move in 3 dimensions"):
        navigation_v0.parallel_env("sphere", 2, disturbances=[ACROSS])
    pytest.importorskip("mujoco")
    env = mujoco.parallel_env(problem=line_problem([2.0] * 2, "holonomic2d"), disturbances=[ACROSS])
    with pytest.raises(ValueError, match="absent at first"):
        env.reset(seed=0)
