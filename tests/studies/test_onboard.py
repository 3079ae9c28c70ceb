"""The on-robot demonstration: what its robots decide by themselves, and real processes that are killed and stopped."""

from __future__ import annotations

import csv
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from examples.studies.onboard.course import Course, digest, goals_to_plan_for, present_problem
from examples.studies.onboard.mission import Command, Mission, Tick, decode, encode
from hypothesis import given
from hypothesis import strategies as st
from network_support import TIMEOUT
from PIL import Image
from test_examples import PNG, ROOT, run, table

from d4orm_env import Problem, Team, World
from d4orm_env.envs.joint_state import JointState
from d4orm_planners.base.candidate import evaluate_controls
from d4orm_planners.d_d4orm.planner import DD4orm
from d4orm_planners.engine.sampling_types import get_sampling_engine
from d4orm_planners.tracking.steering import straight_drives

pytestmark = pytest.mark.studies


def test_robots_get_out_of_where_denoising_of_the_whole_team_stayed_for_ever() -> None:
    """Six robots of a run, at rest round after round after 155 s."""
    mission = Mission(robots=6, seed=0, samples=576, timeout=10.0, namespace="", world="", team="")
    problem = mission.problem().with_state(
        np.float32(
            [[1.365, 1.017], [1.068, -1.525], [-1.031, -0.958], [-1.094, -0.415], [1.023, -0.811], [-1.148, 0.704]]
        ),
        np.float32(
            [[-0.599, 1.236], [-1.024, 1.464], [-0.002, -1.396], [-0.497, -1.071], [-0.627, 0.388], [1.191, 0.231]]
        ),
    )
    assert DD4orm(mission.planning()).solve(problem, seed=0, max_iterations=6).solved


def corridor() -> Problem:
    """Robot 0 drives two metres to the right, robot 1 follows it, robot 2 is far off."""
    return Problem(
        team=Team(("velocity2d",) * 3),
        start=[[0, 0], [-0.5, 0], [0, 1.5]],
        goal=[[1.5, 0], [1.0, 0], [1.0, 1.5]],
        world=World(lower=[-2, -2], upper=[2, 2]),
        horizon=40,
        margin=0.15,
    )


def under_way(problem: Problem) -> Course:
    """Everybody drives straight to the goal."""
    engine = get_sampling_engine("cpu", 1)
    candidate = evaluate_controls(engine, problem, straight_drives(problem).controls[:, :, 0])
    course = Course.of(10, problem, engine, candidate)
    assert course is not None, "driving straight solves it"
    return course


def joint_at(problem: Problem, course: Course, tick: int) -> JointState:
    controls = np.zeros((3, 2), np.float32)
    return JointState(course.states_at(tick), np.asarray(problem.goal), controls, np.zeros(3, bool), tick)


def test_course_ends_at_rest() -> None:
    problem = corridor()
    course = under_way(problem)
    assert course.controls_at(10)[0] == pytest.approx([1, 0])
    assert course.states_at(12)[0] == pytest.approx([0.2, 0], abs=1e-5)
    assert not course.controls_at(10_000).any()
    assert np.linalg.norm(course.states_at(10_000) - problem.goal, axis=1).max() <= problem.goal_radius
    assert course.rest(12, 3)[:, 0] == pytest.approx(np.tile([1.0, 0], (3, 1)))


def test_who_would_run_into_a_body_stops_and_the_others_go_on() -> None:
    problem, engine = corridor(), get_sampling_engine("cpu", 1)
    course = under_way(problem)
    stopped = course.with_stops(problem, engine, joint_at(problem, course, 12), [0])
    assert stopped.begin == 12
    assert not stopped.controls[:, :2].any(), "robot 1 would run into robot 0"
    assert np.linalg.norm(stopped.states_at(1000)[2] - [1.0, 1.5]) <= problem.goal_radius
    assert stopped.digest != course.digest


def test_who_follows_does_not_touch_a_robot_that_stops_for_a_tick() -> None:
    """The margin that plans keep is more than the distance of a tick."""
    problem = mission().problem()
    assert problem.margin > float(np.max(np.asarray(problem.team.max_speed))) * problem.dt


def test_robots_whose_goal_a_body_covers_stay() -> None:
    problem = corridor()
    states = np.array([[0, 0], [1.5, 0.2], [0, 1.5]], np.float32)
    joint = JointState(states, np.asarray(problem.goal), np.zeros((3, 2), np.float32), np.zeros(3, bool), 5)
    assert goals_to_plan_for(problem, joint, []) == pytest.approx(np.asarray(problem.goal))
    assert goals_to_plan_for(problem, joint, [1]) == pytest.approx(np.array([[0, 0], [1.5, 0.2], [1, 1.5]]))


def test_plans_begin_with_less_margin_only_where_robots_are_nearer() -> None:
    problem = corridor()
    assert present_problem(problem, problem.start, problem.goal, []).margin == 0.15
    near = np.array([[0, 0], [-0.4, 0], [0, 1.5]], np.float32)
    assert present_problem(problem, near, problem.goal, []).margin == pytest.approx(0.1, abs=2e-3)
    lost = present_problem(problem, near, problem.goal, [1]).team
    assert np.asarray(lost.max_speed) == pytest.approx([1, 1e-6, 1])


@pytest.mark.parametrize("lost", [[], [1]])
def test_a_plan_has_the_same_name_after_it_was_passed_on(lost: list[int]) -> None:
    engine, whole = get_sampling_engine("cpu", 1), corridor()
    problem = present_problem(whole, whole.start, whole.goal, lost)
    random = np.random.default_rng(0)
    candidate = evaluate_controls(engine, problem, random.normal(0, 2, (40, 3, 2)).astype(np.float32))
    again = evaluate_controls(engine, problem, candidate.controls)
    other = evaluate_controls(engine, problem, 0.5 * candidate.controls)
    assert digest(engine, problem, again) == digest(engine, problem, candidate) != digest(engine, problem, other)


def mission(**changes: Any) -> Mission:
    settings = {
        "robots": 3, "seed": 0, "samples": 96, "iterations": 1, "timeout": 1.0, "silence": 1.0, "namespace": "test",
        "world": "tcp/127.0.0.1:1", "team": "tcp/127.0.0.1:2",
    }  # fmt: skip
    return Mission(**(settings | changes))


def test_the_team_drives_in_a_square() -> None:
    assert mission().problem().world.bounds.tolist() == [[-2, -2], [2, 2]]


def test_messages_are_the_same_after_they_were_sent() -> None:
    tick = Tick(3, [0.1, float(np.float32(0.1))], [2], ["a", ""], [0.5, 0.0])
    command = Command(3, 1, [0.25, -1.0], "a", 0.5, "b")
    assert decode(encode(tick), Tick) == tick
    assert decode(encode(command), Command) == command
    assert decode(encode(command), Tick) is None
    for bad in (
        replace(command, control=[float("nan")]), replace(command, number=True), replace(command, ballot=1),
        replace(tick, lost=["1"]), replace(tick, state=None),
    ):  # fmt: skip
        assert decode(encode(bad), type(bad)) is None


@given(data=st.binary(max_size=64) | st.text(max_size=64).map(str.encode))
def test_whatever_else_arrives_is_no_message(data: bytes) -> None:
    assert decode(data, Tick) is None
    assert decode(b'{"kind": "Tick", "number": ' + data, Tick) is None


def timeline(out: Path) -> list[dict[str, str]]:
    with (out / "onboard_lifelong_timeline.csv").open() as file:
        return list(csv.DictReader(file))


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs kill -9")
def test_the_others_drive_on_when_a_robot_is_killed(tmp_path: Path) -> None:
    pytest.importorskip("zenoh")
    out = tmp_path / "out"
    result = run("onboard_lifelong", out, "--kill", "1:2.5")
    assert result.returncode == 0, result.stdout + result.stderr
    assert "the process of robot 1 is killed" in result.stdout
    (total,) = table(out / "onboard_lifelong.csv")
    assert total["simulated [s]"] == "6.0"
    assert total["robot-steps in contact"] == total["ticks with different plans"] == "0"
    assert total["robots given up"] == "1"
    robots = table(out / "onboard_lifelong_robots.csv")
    assert [row["given up"] for row in robots] == ["", "yes", ""]
    assert sum(int(row["goals reached"]) for row in robots) == int(total["goals reached"]) >= 2
    rows = timeline(out)
    assert {row["event"] for row in rows} >= {"computed", "sent", "received", "selected", "announces", "takes over"}
    (gone,) = [row for row in rows if row["event"] == "is given up"]
    assert (gone["robot"], gone["tick"]) == ("1", "26")
    later = [row for row in rows if float(row["time"]) > float(gone["time"])]
    assert {row["robot"] for row in later if row["event"] == "takes over"} == {"0", "2"}
    for name in ("0", "2"):
        taken = [row["plan"] for row in rows if row["event"] == "takes over" and row["robot"] == name]
        assert taken == [row["plan"] for row in rows if row["event"] == "takes over" and row["robot"] == "0"]
    assert (out / "onboard_lifelong_timeline.png").read_bytes().startswith(PNG)
    with Image.open(out / "onboard_lifelong.gif") as animation:
        assert animation.n_frames > 5


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "killpg"), reason="needs process groups")
def test_ctrl_c_ends_all_processes_and_writes_what_there_is(tmp_path: Path) -> None:
    pytest.importorskip("zenoh")
    out = tmp_path / "out"
    command = [sys.executable, "-m", "examples.studies", "onboard_lifelong", "--robots", "2", "--out", str(out)]
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    process = subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "PYTHONPATH": path},
        start_new_session=True,
    )
    try:
        assert process.stdout is not None
        line = ""
        while "are ready" not in line:
            line = process.stdout.readline()
            assert line, "it ended before the robots were ready"
        time.sleep(2)
        os.killpg(process.pid, signal.SIGINT)
        rest, _ = process.communicate(timeout=TIMEOUT)
        assert process.returncode == 130, rest
        assert "Traceback" not in rest
        (row,) = table(out / "onboard_lifelong.csv")
        assert 0 < float(row["simulated [s]"]) < 120
        assert row["robots given up"] == "0"
        with pytest.raises(ProcessLookupError):
            os.killpg(process.pid, 0)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()


def test_order_to_kill_nobody_is_refused(tmp_path: Path) -> None:
    pytest.importorskip("zenoh")
    result = run("onboard_lifelong", tmp_path / "out", "--kill", "3:1")
    assert result.returncode == 2
    assert "of 3 robots the last one is 2" in result.stderr
    result = run("onboard_lifelong", tmp_path / "out", "--kill", "soon")
    assert result.returncode == 2
    assert "'soon' is not of the form ROBOT:SECONDS" in result.stderr
