"""The playground: what may be done to a scene, and a session that goes on by itself."""

from __future__ import annotations

import gc
import http.client
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest
from network_support import wait_until as until

from d4orm_env import World, make_problem
from d4orm_env.core.gaps import nearest
from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.disturbances.disturbance_registry import DISTURBANCES
from d4orm_env.footprints import Box
from d4orm_env.scenarios.problem_files import scenario_text
from d4orm_planners.base.display import markdown_text
from d4orm_planners.base.policy import GoToGoal
from d4orm_planners.play import edits
from d4orm_planners.play.session import Session

TIMEOUT = 60.0


@pytest.fixture
def scene() -> Problem:
    return make_problem("circle", num_robots=4, seed=0)


@pytest.fixture
def random() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.fixture
def session(scene: Problem) -> Iterator[Session]:
    session = Session(scene, "go-to-goal")
    session.start()
    yield session
    session.close()
    assert session.failure is None


def test_a_goal_goes_where_it_is_dragged(scene: Problem) -> None:
    moved = edits.move_goal(scene, 1, [0.5, 0.25])
    assert moved.goal[1].tolist() == [0.5, 0.25]
    np.testing.assert_array_equal(moved.goal[[0, 2, 3]], scene.goal[[0, 2, 3]])
    np.testing.assert_array_equal(moved.start, scene.start)


def test_a_robot_stands_where_it_is_put(scene: Problem) -> None:
    start = np.array(scene.start)
    start[2, 2:] = 0.3
    moved = edits.move_robot(scene.with_state(start, scene.goal), 2, [0.1, 0.2])
    np.testing.assert_allclose(moved.start[2], [0.1, 0.2, 0, 0])


@pytest.mark.parametrize(
    ("edit", "complaint"),
    [
        (lambda p: edits.move_goal(p, 0, p.goal[1]), "the goal of robot_0 would touch that of robot_1"),
        (lambda p: edits.move_robot(p, 0, p.start[1, :2]), "the robot of robot_0 would touch that of robot_1"),
        (lambda p: edits.move_goal(p, 0, [np.nan, 0]), r"goal\[0, 0\] is nan"),
        (lambda p: edits.move_goal(p, 0, [1e5, 0]), "float32 resolves"),
        (edits.remove_obstacle, "there is no obstacle to remove"),
        (lambda p: edits.remove_robot(p.select([0])), "the last robot stays"),
    ],
)
def test_what_makes_no_sense_is_refused(scene: Problem, edit: edits.Edit, complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        edit(scene)


def test_walls_stop_goals_and_robots(scene: Problem) -> None:
    walled = scene.with_state(scene.start, scene.goal, world=World(boxes=[[-0.2, -0.2, 0.2, 0.2]]))
    with pytest.raises(ValueError, match="would touch an obstacle"):
        edits.move_goal(walled, 0, [0, 0])
    with pytest.raises(ValueError, match="the obstacle would touch the robot_"):
        edits.move_obstacle(walled, "boxes", 0, walled.start[0, :2])


def test_rectangles_may_be_where_the_discs_round_them_would_touch() -> None:
    """Boxes of 1 m by 0.2 m along x, 0.3 m beside each other and beside a wall."""
    team = Team(("differential_drive",) * 2, footprint=Box(1.0, 0.2))
    start, goal = [[0, 0, 0, 0], [0, 1, 0, 0]], [[5, 0], [5, 1]]
    scene = Problem(team, start=start, goal=goal, world=World(boxes=[[-1, -0.6, 1, -0.4]]), goal_heading=0.0)
    beside = edits.move_goal(edits.move_robot(scene, 1, [0, 0.3]), 1, [5, 0.3])
    assert nearest(beside, beside.start) == pytest.approx(0.1, abs=1e-6)
    nearer = edits.move_obstacle(beside, "boxes", 0, [0, 0.25])
    assert nearest(nearer, nearer.start) == pytest.approx(0.05, abs=1e-6)
    with pytest.raises(ValueError, match="the robot of robot_1 would touch that of robot_0"):
        edits.move_robot(scene, 1, [0, 0.19])
    with pytest.raises(ValueError, match="the goal of robot_1 would touch that of robot_0"):
        edits.move_goal(scene, 1, [5.9, 0.0])
    with pytest.raises(ValueError, match="the obstacle would touch the robot_0"):
        edits.move_obstacle(scene, "boxes", 0, [0, 0.35])


@pytest.mark.parametrize("scenario", ["circle", "sphere", "heterogeneous"])
def test_robots_come_and_go(scenario: str, random: np.random.Generator) -> None:
    scene = make_problem(scenario, num_robots=4)
    more = edits.add_robot(scene, random)
    assert more.num_robots == 5
    assert more.team.models[4] == scene.team.models[0]
    assert nearest(more, more.start) > 0
    again = edits.remove_robot(more)
    np.testing.assert_array_equal(again.goal, scene.goal)
    assert again.team.models == scene.team.models


@pytest.mark.parametrize("scenario", ["circle", "sphere"])
@pytest.mark.parametrize("kind", ["disc", "box"])
def test_obstacles_come_and_go(scenario: str, kind: str, random: np.random.Generator) -> None:
    scene = make_problem(scenario, num_robots=3)
    more = edits.add_obstacle(scene, kind, random)
    assert more.world.num_obstacles == 1
    assert nearest(more, more.start) > 0
    assert edits.remove_obstacle(more).world.num_obstacles == 0


@pytest.mark.parametrize(
    "world",
    [
        World(circles=[[0, 0, 0.2]]),
        World(boxes=[[-0.1, -0.1, 0.1, 0.1]]),
        World(polygons=[[[0, 0], [0.2, 0], [0, 0.2]]]),
    ],
)
def test_obstacles_move(scene: Problem, world: World) -> None:
    kind = next(name for name in ("circles", "boxes", "polygons") if len(getattr(world, name)))
    moved = edits.move_obstacle(scene.with_state(scene.start, scene.goal, world=world), kind, 0, [0.3, 0.1])
    points = np.random.default_rng(1).uniform(-1, 1, (50, 2))
    np.testing.assert_allclose(moved.world.clearance(points + np.array([0.3, 0.1])), world.clearance(points), atol=1e-5)


def test_the_clock_runs_pauses_and_steps(session: Session) -> None:
    until(lambda: session.frame.status.time > 0.2)
    session.pause(True)
    until(lambda: session.frame.status.state == "paused")
    before = session.frame
    time.sleep(0.3)
    assert session.frame is before, "pause pauses"
    session.step()
    until(lambda: session.frame.status.number > before.status.number)
    assert session.frame.status.time == pytest.approx(before.status.time + 0.1)
    assert session.frame.status.state == "paused"


def test_a_team_goes_on_from_where_it_is(session: Session) -> None:
    until(lambda: session.frame.status.time > 0.4)
    session.pause(True)
    until(lambda: session.frame.status.state == "paused")
    states, elapsed = session.frame.states, session.frame.status.time
    session.edit(lambda scene: edits.move_goal(scene, 0, [0.7, 0.9]))
    until(lambda: np.allclose(session.frame.goals[0], [0.7, 0.9]))
    np.testing.assert_array_equal(session.frame.states, states)
    assert session.frame.status.time == elapsed
    assert session.frame.replanned >= 0


def test_a_robot_is_pushed_in_all_that_drive_and_nobody_plans_anew(session: Session) -> None:
    session.choose("go-to-goal", "random")
    session.pause(True)
    until(lambda: len(session.frames) == 2 and session.frame.status.state == "paused")
    before, planned = session.frames, [frame.replanned for frame in session.frames]
    session.push(1, [0.1, -0.2])
    until(lambda: session.frame.status.number > before[0].status.number)
    for old, new in zip(before, session.frames, strict=True):
        np.testing.assert_allclose(new.states[1] - old.states[1], [0, 0, 0.1, -0.2], atol=1e-6)
        np.testing.assert_array_equal(np.delete(new.states, 1, 0), np.delete(old.states, 1, 0))
    assert [frame.replanned for frame in session.frames] == planned
    session.push(1, [50.0, 0.0], viewport=1)
    until(lambda: session.frame.states[1, 2] > 0.5)
    speeds = np.linalg.norm(session.frame.states[:, 2:], axis=1)
    assert (speeds <= session.frame.problem.team.max_speed + 1e-5).all(), "none is faster than it may be"


def test_what_is_let_go_after_somebody_took_it_away_is_refused(session: Session) -> None:
    drops = (
        lambda: session.push(9, [0.1, 0.0]),
        lambda: session.edit(lambda scene: edits.move_robot(scene, 9, [0.1, 0.2])),
        lambda: session.edit(lambda scene: edits.move_goal(scene, 9, [0.1, 0.2])),
        lambda: session.edit(lambda scene: edits.move_obstacle(scene, "boxes", 3, [0.1, 0.2])),
    )
    for drop in drops:
        drop()
    until(lambda: session.frame.status.refused == len(drops))
    assert session.failure is None


def test_who_is_farthest_from_its_goal_is_pushed_and_who_has_docked_is_not(session: Session) -> None:
    session.set_speed(50)
    until(lambda: session.frame.status.state == "arrived")
    session.push(0, [0.3, 0.0])
    until(lambda: session.frame.status.message)
    assert "robot_0 of go-to-goal has docked" in session.frame.status.message
    session.edit(lambda scene: edits.move_goal(scene, 2, [0.7, 0.9]))
    until(lambda: session.frame.status.state == "running")
    session.pause(True)
    until(lambda: session.frame.status.state == "paused")
    before = session.frame
    session.push(None, [0.0, 0.1])
    until(lambda: session.frame.status.number > before.status.number)
    assert np.flatnonzero((session.frame.states != before.states).any(axis=1)).tolist() == [2]


def test_a_change_that_is_refused_leaves_the_scene_and_says_why(session: Session) -> None:
    session.edit(lambda scene: edits.move_goal(scene, 0, scene.goal[1]))
    until(lambda: session.frame.status.message)
    assert "would touch" in session.frame.status.message
    session.choose("nobody")
    until(lambda: "nobody" in session.frame.status.message)
    assert session.policies == ("go-to-goal",)
    assert session.failure is None


def test_a_step_that_fails_pauses_and_says_why(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(actions: object) -> None:
        raise RuntimeError("no room for a goal")

    with monkeypatch.context() as patch:
        patch.setattr(session._viewports[0]._env, "step", fail)
        until(lambda: session.frame.status.message)
    assert session.frame.status.message == "no room for a goal"
    assert session.frame.status.state == "paused"
    session.pause(False)
    until(lambda: session.frame.status.state == "running" and not session.frame.status.message)


def test_everybody_arrives_and_is_sent_on(session: Session) -> None:
    session.set_speed(50)
    until(lambda: session.frame.status.state == "arrived")
    session.edit(lambda scene: edits.move_goal(scene, 0, [0.7, 0.9]))
    until(lambda: session.frame.status.state == "running")
    until(lambda: session.frame.status.state == "arrived")
    assert np.linalg.norm(session.frame.states[0, :2] - [0.7, 0.9]) < 0.1
    session.set_lifelong(True)
    until(lambda: session.frame.status.state == "running")


def test_what_happened_becomes_a_replay(session: Session) -> None:
    until(lambda: len(session._viewports[0].recording) > 3)
    assert "circle, 4 robots by go-to-goal" in session.replay().html
    session.edit(edits.remove_robot)
    until(lambda: session.frame.problem.num_robots == 3)
    assert "circle, 3 robots by go-to-goal" in session.replay().html


def test_a_replay_shows_intruders_while_they_were_there(session: Session) -> None:
    until(lambda: len(session._viewports[0].recording) > 3)
    assert "bodies" not in session.replay().motions[0].content
    session.disturb({"intruder": 2})
    until(lambda: session.levels)
    steps = len(session._viewports[0].recording) - 1
    until(lambda: len(session._viewports[0].recording) > steps + 2)
    bodies = session.replay().motions[0].content["bodies"]
    assert bodies["count"] == 2
    assert bodies["low"][-1] == 0, "at first there were none"


def test_reset_begins_the_scene_anew(session: Session, scene: Problem) -> None:
    until(lambda: session.frame.status.time > 0.2)
    session.pause(True)
    session.reset()
    until(lambda: session.frame.status.time == 0)
    np.testing.assert_array_equal(session.frame.states, scene.start)


def test_another_scene_is_loaded(session: Session) -> None:
    session.load(lambda: make_problem("sphere", num_robots=2))
    until(lambda: session.frame.problem.dimension == 3)
    assert session.frame.problem.num_robots == 2


def test_a_scene_that_the_policy_cannot_drive_in_is_left(session: Session) -> None:
    pytest.importorskip("pyrvo")
    session.choose("orca")
    until(lambda: session.policies == ("orca",))
    session.load(lambda: make_problem("sphere", num_robots=2))
    until(lambda: session.frame.status.message)
    assert "orca" in session.frame.status.message
    status = session.frame.status.time
    until(lambda: session.frame.status.time > status + 0.3)
    assert session.frame.problem.dimension == 2


def test_policies_drive_side_by_side_with_the_same_seed(session: Session, scene: Problem) -> None:
    until(lambda: session.frame.status.time > 0.3)
    session.choose("go-to-goal", "random")
    session.reset()
    until(lambda: len(session.frames) == 2 and len(session._viewports[0].recording) > 4)
    session.pause(True)
    until(lambda: session.frame.status.state == "paused")
    first, second = session.frames
    assert [frame.policy for frame in session.frames] == ["go-to-goal", "random"]
    assert not np.array_equal(first.states, second.states)
    assert first.status is second.status
    motions = session.replay().motions
    assert [motion.content["title"].partition(",")[0] for motion in motions] == ["go-to-goal", "random"]
    session.choose("random")
    until(lambda: len(session.frames) == 1)
    np.testing.assert_array_equal(session.frame.states, second.states, "and goes on alone")
    session.choose("random", "go-to-goal")
    session.reset()
    until(lambda: len(session.frames) == 2 and np.array_equal(session.frame.states, scene.start))
    np.testing.assert_array_equal(session.frames[1].states, scene.start, "both from the same start")


def test_what_is_changed_for_one_is_changed_for_all(session: Session) -> None:
    session.choose("go-to-goal", "random")
    session.set_speed(5)
    until(lambda: len(session.frames) == 2 and len(session._viewports[0].recording) > 26)
    session.pause(True)
    until(lambda: session.frame.status.state == "paused")
    before = session.frames
    session.edit(lambda scene: edits.move_goal(scene, 0, [0.7, 0.9]), viewport=1)
    until(lambda: np.allclose(session.frame.goals[0], [0.7, 0.9]))
    for old, new in zip(before, session.frames, strict=True):
        np.testing.assert_array_equal(new.states, old.states)
        assert np.allclose(new.goals[0], [0.7, 0.9])
    session.edit(lambda scene: edits.add_robot(scene, np.random.default_rng(0)))
    until(lambda: session.frame.problem.num_robots == 5)
    assert session.frames[1].problem.team == session.frame.problem.team
    session.edit(lambda scene: edits.add_obstacle(scene, "box", np.random.default_rng(1)))
    until(lambda: session.frame.problem.world.num_obstacles == 1)
    assert session.frames[1].problem.world == session.frame.problem.world
    occupied = session.frames[1].states[2, :2]
    session.edit(lambda scene: edits.move_robot(scene, 0, occupied))
    until(lambda: session.frame.status.message)
    assert session.frame.status.message.startswith("random: the robot of robot_0 would touch")


@pytest.mark.parametrize("policies", [(), ("go-to-goal", "go-to-goal"), ("go-to-goal", "nobody")])
def test_a_choice_that_cannot_be_leaves_who_drives(session: Session, policies: tuple[str, ...]) -> None:
    session.choose(*policies)
    until(lambda: session.frame.status.message)
    assert session.policies == ("go-to-goal",)
    status = session.frame.status.time
    session.pause(False)
    until(lambda: session.frame.status.time > status)


# The playground's robots have no range sensors.
@pytest.mark.parametrize("name", sorted(set(DISTURBANCES) - {"ray_noise"}))
def test_whatever_goes_wrong_goes_wrong_from_the_next_step_on(session: Session, name: str) -> None:
    level = {"delay": 2, "state_delay": 2, "intruder": 2, "limit_mismatch": 0.5, "occlusion": 1.0}.get(name, 0.3)
    session.set_speed(20)
    session.disturb({name: level})
    until(lambda: session.levels == {name: level})
    assert session._viewports[0]._env.unwrapped._simulation.setup.disturbances
    assert len(session.frame.bodies) == (2 if name == "intruder" else 0)
    status = session.frame.status
    assert not status.message
    until(lambda: session.frame.status.time > status.time or session.frame.status.state == "arrived")
    session.disturb({})
    until(lambda: not session.levels)
    assert not session._viewports[0]._env.unwrapped._simulation.setup.disturbances


def test_the_page_shows_the_truth_and_not_what_the_policy_sees(session: Session) -> None:
    session.pause(True)
    until(lambda: session.frame.status.state == "paused")
    states = session.frame.states
    session.disturb({"state_noise": 0.2})
    until(lambda: session.levels)
    np.testing.assert_array_equal(session.frame.states, states)
    np.testing.assert_array_equal(session.scene.start, states)


def test_a_level_that_makes_no_sense_is_left(session: Session) -> None:
    session.disturb({"dropout": 0.5})
    until(lambda: session.levels)
    session.disturb({"dropout": 7.0})
    until(lambda: session.frame.status.message)
    assert session.levels == {"dropout": 0.5}


def test_a_slow_planner_holds_nobody_up(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    go_on = threading.Event()
    monkeypatch.setattr(GoToGoal, "_begin", lambda *_: go_on.wait(TIMEOUT))
    session.reset()
    until(lambda: session.frame.status.state == "planning")
    begin = time.monotonic()
    session.set_speed(2)
    session.disturb({})
    assert session.replay().html
    assert session.scene.num_robots == 4
    assert time.monotonic() - begin < TIMEOUT, "nobody waits for the planner"
    assert session.frame.status.state == "planning"
    go_on.set()
    until(lambda: session.frame.status.state == "running")


def test_a_policy_that_predicts_looks_as_far_as_it_is_told(scene: Problem) -> None:
    session = Session(scene, "d4orm-c2f")
    session.start()
    session.set_horizon(7)
    until(lambda: session.frame.status.number > 2)
    session.choose("go-to-goal")
    until(lambda: session.policies == ("go-to-goal",) and session.frame.guidance is None)
    session.set_horizon(0)
    session.choose("d4orm-c2f")
    until(lambda: session.frame.status.message)
    assert "predict_horizon" in session.frame.status.message
    session.close()
    assert session.failure is None


def test_scenes_go_through_files(scene: Problem, random: np.random.Generator) -> None:
    panel = pytest.importorskip("d4orm_planners.play.panel")
    changed = edits.add_obstacle(edits.add_robot(scene, random), "box", random)
    start = np.array(changed.start)
    start[:, 2] = 0.4
    under_way = changed.with_state(start, changed.goal)
    read = panel.read_scene(scenario_text(edits.at_rest(under_way)).encode())
    assert read.replace(name="x") == changed.replace(name="x")


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (b"\xff\xfe", "not UTF-8"),
        (b"x" * 3_000_000, "a scene has at most"),
        (b"!!python/object/apply:os.system ['true']", "tags are not supported"),
        (b"version: 1\nscenario: os:system\n", "scenario 'os:system' is unknown"),
        (b"version: 1\nscenario: circle\nnum_robots: 300\n", "num_robots is 300; at most 200"),
    ],
)
def test_a_file_that_is_no_scene_is_refused(content: bytes, complaint: str) -> None:
    panel = pytest.importorskip("d4orm_planners.play.panel")
    with pytest.raises(ValueError, match=complaint):
        panel.read_scene(content)


def test_messages_are_shown_as_they_are() -> None:
    assert markdown_text("<b>[x](y)</b> *\n{z}") == "\\<b\\>\\[x\\](y)\\</b\\> \\* \\{z\\}"


def test_without_the_extra_one_line_names_it() -> None:
    code = (
        "import sys; sys.modules['viser'] = None; from d4orm_planners.cli.app import main;"
        "main(['play', '--num-robots', '2', '--no-open'])"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert result.returncode == 2
    assert result.stderr == "d4orm: d4orm play needs viser; install it with: pip install 'd4orm-env[viz]'\n"


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # viser leaves a loop open
def test_a_page_cannot_ask_for_a_tunnel_to_elsewhere(scene: Problem) -> None:
    playground = pytest.importorskip("d4orm_planners.play.playground").Playground(scene, "go-to-goal")
    server = playground._server
    assert server.get_host() == "127.0.0.1"
    assert server.request_share_url() is None
    assert server._share_tunnel is None
    playground.close()
    del playground, server
    gc.collect()


@pytest.mark.slow
def test_ctrl_c_leaves_no_process_and_no_port() -> None:
    pytest.importorskip("viser")
    command = [
        sys.executable,
        "-c",
        "from d4orm_planners.cli.app import main; main()",
        "play",
        "-k",
        "2",
        "-p",
        "go-to-goal",
    ]
    environment = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY")}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env={**environment, "PYTHONUNBUFFERED": "1"}
    ) as process:
        assert process.stdout is not None
        told = "".join(process.stdout.readline() for _ in range(2))
        port = int(re.search(r"http://127\.0\.0\.1:(\d+)/", told)[1])  # type: ignore[index]
        page = http.client.HTTPConnection("127.0.0.1", port, timeout=TIMEOUT)
        page.request("GET", "/")
        assert b"<html" in page.getresponse().read()
        page.close()
        process.send_signal(signal.SIGINT)
        assert process.wait(TIMEOUT) == 130
        assert process.stderr is not None
        assert "Traceback" not in process.stderr.read()
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", port), timeout=TIMEOUT)


@pytest.mark.parametrize(("module", "program"), [("typer", "cli"), ("viser", "cli"), ("viser", "cli.app")])
def test_ctrl_c_while_it_is_loaded_is_quiet_even_where_a_library_swallows_it(module: str, program: str) -> None:
    pytest.importorskip("viser")
    code = f"""
import signal, sys
class Finder:
    @staticmethod
    def find_spec(name, path, target=None):
        if name == "typer" == {module!r}:
            raise KeyboardInterrupt
        if name == "viser" == {module!r}:
            try:
                signal.raise_signal(signal.SIGINT)
            except KeyboardInterrupt:
                pass
sys.meta_path.insert(0, Finder)
sys.argv[1:] = ["play", "-k", "2", "--no-open"]
from d4orm_planners.{program} import main
main()
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=TIMEOUT)
    assert (result.returncode, result.stdout, result.stderr) == (130, "", "")


@pytest.mark.parametrize("options", [("--port", "70000"), ("--host", "203.0.113.1"), ("--host", "\xe4" * 70)])
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # viser leaves a loop open
def test_an_address_where_one_cannot_listen_is_said(d4orm, options: tuple[str, str]) -> None:
    pytest.importorskip("viser")
    outcome = d4orm("play", "-k", "2", "-p", "go-to-goal", *options)
    assert outcome.status == 2
    assert outcome.err.startswith("d4orm: cannot listen at")
    assert outcome.err.count("\n") == 1
