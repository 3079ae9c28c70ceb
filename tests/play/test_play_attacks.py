"""What a program that talks to the playground may not do, whatever it sends."""

from __future__ import annotations

import logging
import math
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("viser")

from play_support import CAMERA, TIMEOUT, control, drag, running, say, until, update, visitor
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection

from d4orm_env import make_problem
from d4orm_env.disturbances.disturbance_registry import disturbances_at
from d4orm_planners.base.policy import GoToGoal
from d4orm_planners.play import edits, panel
from d4orm_planners.play.edits import MOST_WAITING
from d4orm_planners.play.origin_check import LARGEST_UPLOAD
from d4orm_planners.play.playground import Playground
from d4orm_planners.play.session import Session

pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # viser leaves a loop open


@pytest.fixture(scope="module")
def playground() -> Iterator[Playground]:
    with running(make_problem("circle", num_robots=3), "go-to-goal") as shown:
        shown.session.pause(True)
        until(lambda: shown.session.frame.status.state == "paused")
        yield shown


@pytest.fixture
def connection(playground: Playground) -> Iterator[ClientConnection]:
    with visitor(playground) as connection:
        yield connection


def refused(playground: Playground, act: Callable[[], None]) -> str:
    """What the page says after something that it refuses."""
    before = playground.session.frame.status.refused
    act()
    until(lambda: playground.session.frame.status.refused > before)
    assert playground.session.failure is None
    return playground.session.frame.status.message


def test_no_file_is_imported_that_a_page_names(
    playground: Playground, connection: ClientConnection, tmp_path: Path
) -> None:
    code, marker = tmp_path / "theirs.py", tmp_path / "was here"
    code.write_text(f"open({str(marker)!r}, 'w').close()\nfrom d4orm_env import make_problem\n"
                    "def scene(seed=0, num_robots=2): return make_problem('circle', num_robots)\n")  # fmt: skip
    scenario = control(playground, "Scenario")
    told = refused(playground, lambda: say(connection, update(scenario, f"{code}:scene")))
    assert told.startswith("Scenario cannot be ")
    assert scenario.value == "circle"
    scenario._impl.value = f"{code}:scene"  # had it come in by another way
    told = refused(playground, lambda: say(connection, update(control(playground, "Begin"), True)))
    scenario._impl.value = "circle"
    assert "is unknown" in told
    assert not marker.exists()


@pytest.mark.parametrize(
    ("label", "value", "said"),
    [
        ("Robots", 10_000, "1 to 64 by 1"),
        ("Robots", 0, "1 to 64 by 1"),
        ("Robots", 2.5, "1 to 64 by 1"),
        ("Robots", "16", "1 to 64 by 1"),
        ("Robots", math.nan, "1 to 64 by 1"),
        ("Robots", True, "1 to 64 by 1"),
        ("Speed", 1e9, "0.1 to 8.0 by 0.1"),
        ("Delay", -1, ""),
        ("Seed", -1, "0 to 2147483647 by 1"),
        ("Noise on controls", 0.013, "0.0 to 1.0 by 0.02"),
        ("Model", "os:system", "one of scenario's own, holonomic2d"),
        ("Scenario", "map", "one of circle, sphere"),
        ("Scenario", ["circle"], "one of circle, sphere"),
        ("Paused", "yes", "true or false"),
        ("D4orm-C2F", {"a": 1}, "true or false"),
        ("Load scene", "x", "no such control"),
    ],
)
def test_a_control_takes_what_it_offers(
    playground: Playground, connection: ClientConnection, label: str, value: object, said: str
) -> None:
    if label == "Delay":
        label, said = "Controls late [steps]", "0 to 10 by 1"
    used = control(playground, label)
    before = used.value
    assert said in refused(playground, lambda: say(connection, update(used, value)))
    assert used.value is before


def test_a_control_takes_all_that_it_offers(playground: Playground, connection: ClientConnection) -> None:
    until(lambda: playground._panel._refused == playground.session.frame.status.refused)  # or it sets sliders back
    for label, value in (("Robots", 64), ("Noise on controls", 0.06), ("Noise on controls", 0.0), ("Seed", 7),
                         ("Scenario", "maze"), ("Trails", False), ("Model", "car")):  # fmt: skip
        used = control(playground, label)
        say(connection, update(used, value))
        until(lambda used=used, value=value: used.value == value)  # type: ignore[misc]


@pytest.mark.parametrize("name", panel.SLIDERS)
def test_every_level_on_a_slider_is_one(name: str) -> None:
    levels = panel.SLIDERS[name]
    for level in {levels.low, levels.high} - {levels.off}:
        assert disturbances_at({name: level})


def test_after_a_step_that_fails_the_page_shows_a_pause(monkeypatch: pytest.MonkeyPatch) -> None:
    playground = Playground(make_problem("circle", num_robots=2), "go-to-goal")  # whose clock does not run
    try:
        for viewport in playground.session._viewports:
            monkeypatch.setattr(viewport, "advance", lambda: 1 / 0)
        playground.session._advance_or_pause()
        playground._panel.update()
        assert playground._panel.paused.value
        playground.session._obey()
        # It goes on saying why.
        assert playground.session.frame.status.message == "ZeroDivisionError: division by zero"
    finally:
        playground.close()


def test_a_refusal_takes_no_change_back_that_waits() -> None:
    playground = Playground(make_problem("circle", num_robots=2), "go-to-goal")  # whose clock does not run
    try:
        slider = control(playground, "Drag [1/s]")
        slider.value = 0.5
        playground.session.disturb({"drag": 0.5})
        playground.session._say_refused(1, "another change")
        playground._panel.update()
        assert slider.value == 0.5
        playground.session._obey()
        playground._panel._status_at = 0.0
        playground._panel.update()
        assert slider.value == playground.session.levels["drag"] == 0.5
    finally:
        playground.close()


@pytest.mark.parametrize("name", ["update_cb", "uuid", "removed", "gui_api", "value_"])
def test_nothing_but_the_value_of_a_control_is_set(
    playground: Playground, connection: ClientConnection, name: str
) -> None:
    used = control(playground, "Trails")
    before = dict(vars(used._impl))
    say(connection, update(used, [], name))
    say(connection, {"type": "GuiUpdateMessage", "uuid": used._impl.uuid, "updates": {"value": used.value, name: []}})
    refused(playground, lambda: say(connection, update(used, "the end")))
    assert {key: value for key, value in vars(used._impl).items() if key != "update_timestamp"} == {
        key: value for key, value in before.items() if key != "update_timestamp"
    }


@pytest.mark.parametrize("index", [3, 10**6, None])
def test_a_robot_that_is_not_there_is_not_dragged(
    playground: Playground, connection: ClientConnection, index: int | None
) -> None:
    states = playground.session.frame.states
    said = refused(playground, lambda: [say(connection, drag(phase, index)) for phase in ("start", "end")])
    assert "is not there any more" in said
    np.testing.assert_array_equal(playground.session.frame.states, states)


@pytest.mark.parametrize(
    "message",
    [
        drag("end", -4),
        drag("start", 0, (math.nan, 0, 0)),
        drag("start", 0, (math.inf, 0, 0)),
        drag("start", 0, (0, 0)),
        drag("jump", 0),
        {**CAMERA, "position": [math.nan] * 3},
        {**CAMERA, "image_height": 0},
        {"type": "ShareUrlRequest"},
        {"type": "GuiFormDirtyMessage", "uuid": "x" * 1000},
        {"type": "RunJavascriptMessage", "source": "alert(1)"},
        {"type": 7},
        [],
    ],
    ids=str,
)
def test_other_messages_end_nothing(
    playground: Playground, connection: ClientConnection, message: object, caplog: pytest.LogCaptureFixture
) -> None:
    states = playground.session.frame.states
    say(connection, message)
    refused(playground, lambda: say(connection, update(control(playground, "Robots"), 0)))
    np.testing.assert_array_equal(playground.session.frame.states, states)
    assert not caplog.records


def test_edits_know_no_robot_from_the_end() -> None:
    scene = make_problem("circle", num_robots=3)
    for edit in (edits.move_robot, edits.move_goal):
        with pytest.raises(ValueError, match="robot_-2 is not there"):
            edit(scene, -2, [0.0, 0.1])
    with pytest.raises(ValueError, match="is not there any more"):
        edits.move_obstacle(scene, "circles", -1, [0.0, 0.1])


DEEP = b"\x83\xa4type\xb0GuiUpdateMessage\xa4uuid\xa1x\xa7updates\x81\xa5value" + b"\x91" * 100_000 + b"\xc0"
"""A list in a list in a list ..."""


@pytest.mark.parametrize(
    "frame", ["text", b"", b"\xc1", b"\xd9\xffx", DEEP, b"\x00" * 3_000_000], ids=lambda frame: len(frame)
)
def test_who_sends_garbage_is_hung_up_on_in_silence(
    playground: Playground, frame: str | bytes, caplog: pytest.LogCaptureFixture
) -> None:
    with visitor(playground) as other, visitor(playground) as connection:
        connection.send(frame)
        with pytest.raises(ConnectionClosed):  # noqa: PT012 - it may have been told something before
            while True:
                connection.recv(timeout=TIMEOUT)
        refused(playground, lambda: say(other, update(control(playground, "Robots"), 0)))
    assert not caplog.records


REQUESTS = [
    b"GET http://[ HTTP/1.1\r\n\r\n",
    b"GET //[/?token=x HTTP/1.1\r\n\r\n",
    b"GET /?token=%ff%fe HTTP/1.1\r\n\r\n",
    b"GET /?token=\xff HTTP/1.1\r\n\r\n",
    b"GET\r\n\r\n",
    b"\r\n\r\n",
    b"\x00\xff\x80\r\n\r\n",
    b"\x16\x03\x01garbage\r\n\r\n",
    b"GET / HTTP/1.1\r\nno header\r\n\r\n",
    b"GET / HTTP/1.1\r\n: :\r\n\xff\r\nCookie\r\n\r\n",
    b"GET / HTTP/1.1\r\nCookie: a[b]=c; d4orm_play_1=\xff; =; ;;\r\n\r\n",
    b"GET / HTTP/1.1\r\nX: " + b"y" * 15_000 + b"\r\n\r\n",
    b"GET /",
    b"",
    b"x" * 100_000,
]


@pytest.fixture(scope="module", params=["127.0.0.1", "127.0.0.2"])
def address(request: pytest.FixtureRequest) -> Iterator[tuple[str, int]]:
    """Host and port of a page for this machine, and of one with a token."""
    with running(make_problem("circle", num_robots=2), "go-to-goal", host=request.param) as shown:
        yield request.param, shown._server.get_port()


@pytest.mark.parametrize("sent", REQUESTS, ids=lambda sent: sent[:30])
def test_a_request_that_cannot_be_read_is_refused_in_silence(
    address: tuple[str, int], sent: bytes, capfd: pytest.CaptureFixture[str]
) -> None:
    handlers, heard = logging.root.handlers[:], b""
    logging.root.handlers.clear()  # as without pytest: what nobody takes, Python prints
    try:
        with socket.create_connection(address, timeout=TIMEOUT) as raw, suppress(ConnectionError):
            raw.sendall(sent)
            raw.shutdown(socket.SHUT_WR)
            while data := raw.recv(1000):
                heard += data
    finally:
        logging.root.handlers[:] = handlers
    assert heard[:12] in (b"", b"HTTP/1.1 400", b"HTTP/1.1 403", b"HTTP/1.1 414", b"HTTP/1.1 431")
    assert capfd.readouterr().err == ""


def test_many_who_say_nothing_keep_nobody_out(address: tuple[str, int]) -> None:
    silent = [socket.create_connection(address, timeout=TIMEOUT) for _ in range(300)]
    try:
        with socket.create_connection(address, timeout=TIMEOUT) as raw:
            raw.sendall(b"GET / HTTP/1.1\r\nHost: elsewhere.example\r\n\r\n")
            assert raw.recv(12) == b"HTTP/1.1 403"
    finally:
        for raw in silent:
            raw.close()


def upload(playground: Playground, size: int, parts: int = 1) -> dict[str, object]:
    return {
        "type": "FileTransferStartUpload", "source_component_uuid": control(playground, "Load scene")._impl.uuid,
        "transfer_uuid": "mine", "filename": "scene.yaml", "mime_type": "text/yaml", "part_count": parts,
        "size_bytes": size,
    }  # fmt: skip


def part(content: bytes, index: int = 0) -> dict[str, object]:
    return {"type": "FileTransferPart", "source_component_uuid": None, "transfer_uuid": "mine", "part_index": index,
            "content": content}  # fmt: skip


def test_files_have_a_size(playground: Playground, connection: ClientConnection) -> None:
    said = refused(playground, lambda: say(connection, upload(playground, LARGEST_UPLOAD + 1)))
    assert said == f"the file has {LARGEST_UPLOAD + 1} bytes; a scene has at most {LARGEST_UPLOAD}"
    assert "at most" in refused(playground, lambda: say(connection, upload(playground, 10, 10**9)))
    assert "not taken" in refused(playground, lambda: say(connection, part(b"x")))
    say(connection, upload(playground, 10, 2))
    assert "on its way" in refused(playground, lambda: say(connection, upload(playground, 10)))
    assert "than it has bytes" in refused(playground, lambda: say(connection, part(b"x" * 11)))
    with visitor(playground) as other:
        assert "not taken" in refused(playground, lambda: say(other, part(b"x")))


@pytest.mark.parametrize(
    ("scene", "said"),
    [
        ("scenario: {code}:scene", "is unknown"),
        ("scenario: random\nmodel: {code}:scene", "is unknown"),
        ("robots:\n- {{model: '{code}:scene', start: [0, 0], goal: [1, 1]}}", "is unknown"),
        ("scenario: random\ndisturbances: ['{code}:scene']", "disturbances"),
        ("scenario: map\nmap: {code}", "reads another file"),
        ("scenario: random\nnum_robots: 10000\nsize: 9000", "num_robots is 10000; at most 200"),
        ("scenario: random\nnum_robots: 2\nsize: 90\nnum_obstacles: 501", "num_obstacles is 501; at most 500"),
    ],
)
def test_a_scene_names_no_code(tmp_path: Path, scene: str, said: str) -> None:
    code, marker = tmp_path / "theirs.py", tmp_path / "was here"
    code.write_text(f"open({str(marker)!r}, 'w').close()\nscene = None\n")
    with pytest.raises(ValueError, match=said):
        panel.read_scene(b"version: 1\n" + scene.format(code=code).encode())
    assert not marker.exists()


def test_more_obstacles_than_a_page_shows_are_refused() -> None:
    circles = "".join(f"\n  - {{center: [{9 + x}, 9], radius: 0.1}}" for x in range(501))
    text = f"version: 1\nrobots:\n- {{model: holonomic2d, start: [0, 0], goal: [1, 1]}}\nworld:\n  circles:{circles}"
    with pytest.raises(ValueError, match="num_obstacles is 501; at most 500"):
        panel.read_scene(text.encode())


def test_the_name_of_a_scene_is_text(playground: Playground) -> None:
    frame = playground.session.frame
    problem = frame.problem.replace(name="{alert(1)}\n# <img src=x>")
    text = panel.status_text([type(frame)(**{**vars(frame), "problem": problem})])
    assert text.startswith("**\\{alert(1)\\} # \\<img src=x\\>, 3 robots, go-to-goal: ")


class Broken(GoToGoal):
    """A policy that takes its time to plan."""

    begun = 0

    def _begin(self, env: object, seed: int) -> None:
        type(self).begun += 1
        threading.Event().wait(0.05)


def test_a_flood_of_edits_does_not_stop_the_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(GoToGoal, "_begin", Broken._begin)
    monkeypatch.setattr(GoToGoal, "begun", 0, raising=False)
    session = Session(make_problem("circle", num_robots=3), "go-to-goal")
    session.set_speed(0.05)
    session.start()
    times: set[float] = set()
    for number in range(1000):
        session.edit(lambda scene, number=number: edits.move_goal(scene, 0, [0.1 + 1e-4 * number, 0.3]))
    until(lambda: times.add(session.frame.status.number) or session.frame.status.refused)  # type: ignore[func-returns-value]
    until(lambda: not session.commands._waiting)
    status = session.frame.status
    session.close()
    assert session.failure is None
    assert status.refused >= 1000 - 2 * MOST_WAITING
    assert status.time > 0, "it went on in between"
    assert GoToGoal.begun <= 2 * MOST_WAITING  # type: ignore[attr-defined]


def test_of_a_setting_the_last_one_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    session = Session(make_problem("circle", num_robots=3), "go-to-goal")
    begun: list[object] = []
    monkeypatch.setattr(GoToGoal, "_begin", lambda *_: begun.append(None))
    for level in range(1, 301):
        session.disturb({"drag": level / 300})
    session.start()
    until(lambda: session.levels == {"drag": 1.0})
    session.close()
    assert len(begun) == 1


@pytest.mark.parametrize("error", [IndexError(-4), KeyError("x"), ZeroDivisionError("by zero"), AssertionError()])
def test_no_edit_ends_the_session(error: Exception) -> None:
    def fail(scene: Any) -> Any:
        raise error

    session = Session(make_problem("circle", num_robots=3), "go-to-goal")
    session.start()
    session.edit(fail)
    until(lambda: session.frame.status.message)
    assert session.frame.status.message.startswith(type(error).__name__)
    time = session.frame.status.time
    until(lambda: session.frame.status.time > time)
    session.close()
    assert session.failure is None


@pytest.mark.parametrize("wrong", [{"look_at": [0, 0, 9]}, {"up_direction": [0, 0, 0]}, {"wxyz": [0, 0, 0, 0]}])
def test_a_camera_that_looks_nowhere_ends_nothing(wrong: dict[str, object], capfd: pytest.CaptureFixture[str]) -> None:
    with running(make_problem("circle", num_robots=2), "go-to-goal") as playground, visitor(playground) as connection:
        say(connection, {**CAMERA, **wrong})
        refused(playground, lambda: say(connection, update(control(playground, "Robots"), 0)))
        playground.session.load(lambda: make_problem("sphere", num_robots=2))
        until(lambda: playground._view._looked_at == ("sphere", 2, 3, 1))
        shown = playground._panel._status.content
        until(lambda: playground._panel._status.content != shown)
    assert "Traceback" not in capfd.readouterr().err


def test_closing_does_not_wait_for_a_plan(monkeypatch: pytest.MonkeyPatch) -> None:
    ended = threading.Event()
    with running(make_problem("circle", num_robots=2), "go-to-goal") as playground:
        visitor(playground)  # who does not hang up
        monkeypatch.setattr(GoToGoal, "_begin", lambda *_: ended.wait(TIMEOUT))
        playground.session.reset()
        until(lambda: playground.session.frame.status.state == "planning")
    assert playground.session._thread.is_alive(), "it was not waited for"
    ended.set()


STUCK = """
import concurrent.futures, threading
from d4orm_planners.base.policy import GoToGoal

class Stuck(GoToGoal):
    def act(self, observations, state):
        pool = concurrent.futures.ThreadPoolExecutor(1)
        pool.submit(threading.Event().wait).result()
"""


@pytest.mark.slow
def test_ctrl_c_ends_what_never_ends(tmp_path: Path) -> None:
    (tmp_path / "stuck.py").write_text(STUCK)
    command = [sys.executable, "-uc", "from d4orm_planners.cli.app import main; main()", "play", "-k", "2", "--no-open"]
    command += ["-p", f"{tmp_path / 'stuck.py'}:Stuck"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        while "Ctrl-C" not in process.stdout.readline():
            pass
        process.send_signal(signal.SIGINT)
        assert process.wait(TIMEOUT) == 130
        assert process.stderr is not None
        assert "Traceback" not in process.stderr.read()
