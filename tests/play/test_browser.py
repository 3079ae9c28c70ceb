"""Pages in a real browser, headless Chromium: they load without complaint and do what is asked of them."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser_support import TIMEOUT, Page, browser, missing

from d4orm_env import Problem, World, load_problem, make_problem
from d4orm_planners import make_planner, register_policy
from d4orm_planners.base.policy import GoToGoal

pytestmark = pytest.mark.skipif(bool(missing()), reason=missing())


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with browser(tmp_path_factory.mktemp("profile")) as page:
        yield page


@pytest.fixture(scope="module")
def replay(tmp_path_factory: pytest.TempPathFactory) -> Path:
    problem = make_problem("circle", num_robots=4, seed=0).replace(name="<b>circle</b> & friends")
    return make_planner().solve(problem, seed=0).to_html(tmp_path_factory.mktemp("replay") / "plan.html")


@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
@pytest.mark.parametrize("width", [400, 1300])
@pytest.mark.browser
def test_a_replay_plays_without_a_network(page: Page, replay: Path, width: int, dark: bool) -> None:
    page.offline()
    page.look(width, 800, dark)
    page.requests.clear()
    page.open(replay.as_uri())
    assert page.evaluate("document.documentElement.dataset.theme") == ("dark" if dark else "light")
    assert "<b>circle</b> & friends" in page.evaluate("document.querySelector('h1').textContent")
    page.evaluate("document.getElementById('play').click()")
    page.until("player.time > 0.3")
    page.evaluate("document.getElementById('play').click()")
    time, frames = page.evaluate("[player.time, player.frames]")
    assert frames > 3
    page.evaluate("new Promise((done) => setTimeout(done, 200))")
    assert page.evaluate("player.time") == time, "pause pauses"
    assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth"), "nothing sticks out"
    assert page.complaints == []
    assert [address for address in page.requests if not address.startswith(("file:", "data:"))] == []


def test_keys_and_the_slider_go_through_a_replay(page: Page, replay: Path) -> None:
    page.look()
    page.open(replay.as_uri())
    duration, dt = page.evaluate("[player.duration, player.dt]")
    page.press("End")
    assert page.evaluate("player.time") == pytest.approx(duration)
    page.press("Home")
    page.press("ArrowRight")
    assert page.evaluate("player.time") == pytest.approx(dt)
    page.press("+")
    assert page.evaluate("player.speed") == 2
    page.press(" ")
    page.until("player.playing && player.time > 1")
    page.press(" ")
    assert not page.evaluate("player.playing")
    page.evaluate("const s = document.getElementById('scrub'); s.value = 500; s.dispatchEvent(new Event('input'))")
    assert page.evaluate("player.time") == pytest.approx(duration / 2)
    page.press("]")
    page.until("document.querySelector('.robot').textContent.startsWith('robot_0 (holonomic2d): speed')")
    assert page.complaints == []


@pytest.mark.browser
def test_a_robot_under_the_pointer_tells_about_itself(page: Page, replay: Path) -> None:
    page.look()
    page.open(replay.as_uri())
    x, y = page.evaluate(
        "(() => { const { painter, scene } = shows[0], box = painter.canvas.getBoundingClientRect();"
        "const place = scene.place(scene.moment(player.time), 2);"
        "return [box.left + painter.view.x(place), box.top + painter.view.y(place)]; })()"
    )
    page.mouse("Moved", x, y)
    text = page.until("document.querySelector('.robot').textContent")
    assert text.startswith("robot_2 (holonomic2d): speed 0.0")
    assert "clearance" in text


@pytest.mark.browser
def test_a_hundred_robots_play(page: Page, tmp_path: Path) -> None:
    from d4orm_env.engine.choice import rollout
    from d4orm_env.render.replay import Replay, motion

    problem = make_problem("circle", num_robots=100, diameter=24)
    trajectory = rollout(problem, np.full((problem.horizon, 100, 2), 0.05, np.float32))
    page.look()
    page.open(Replay("many", (motion(problem, trajectory, "many"),)).save(tmp_path / "many.html").as_uri())
    page.until("(player.playing || play(true), player.frames > 60)")
    assert page.complaints == []


def running(problem: Problem, *policies: str, **options: str) -> AbstractContextManager[Any]:
    """A playground with its page."""
    pytest.importorskip("viser")
    import play_support

    return play_support.running(problem, *policies, **options)


viser_leaves_loops = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")


def pixel(playground: Any, position: Sequence[float]) -> tuple[float, float]:
    """Where on the page a place of the plane, or of space, is."""
    from viser import transforms

    camera = next(iter(playground._server.get_clients().values())).camera
    point = np.array([*position, 0.0])[:3]
    x, y, z = transforms.SO3(np.asarray(camera.wxyz)).inverse() @ (point - camera.position)
    scale = 0.5 * camera.image_height / np.tan(camera.fov / 2)
    return camera.image_width / 2 + scale * x / z, camera.image_height / 2 + scale * y / z


def tick(page: Page, label: str) -> None:
    """Click on the check box with a label, as a mouse does."""
    box = beside(label, "input[type=checkbox]")
    page.until(f"!!{box}")
    before = page.evaluate(f"{box}.checked")
    repeat_until(lambda: page.evaluate(f"{box}.checked") != before, lambda: click_on(page, box))


def beside(label: str, selector: str) -> str:
    """The part of the page next to a label, in JavaScript."""
    return f"""(() => {{
      let row = [...document.querySelectorAll('label')].find((part) => part.textContent === {label!r});
      while (row && !row.querySelector({selector!r})) row = row.parentElement;
      return row?.querySelector({selector!r});
    }})()"""


def click_on(page: Page, part: str) -> None:
    """Click with the mouse on the middle of a part of the page, once it stands still."""
    position = f"""(() => {{
      {part}.scrollIntoView({{block: 'center'}});
      const box = {part}.getBoundingClientRect();
      return [box.x + box.width / 2, box.y + box.height / 2];
    }})()"""
    before, (x, y) = None, page.evaluate(position)
    while before != (x, y):  # the page is still making itself up
        time.sleep(1.0)
        before, (x, y) = (x, y), page.evaluate(position)
    for kind in ("Moved", "Pressed", "Released"):
        page.mouse(kind, x, y)


def look_at(page: Page, playground: Any, text: str) -> None:
    """Open the playground's page, and wait until it says something."""
    page.look()
    page.offline(False)
    page.open(playground.address)
    page.until(f"document.body.textContent.includes('{text}')")


def click(page: Page, text: str) -> None:
    """Click on a button, or open a folder, as soon as it is there."""
    find = f"[...document.querySelectorAll('button, div')].findLast((part) => part.textContent.trim() === {text!r})"
    page.until(f"!!{find}")
    time.sleep(0.5)
    page.evaluate(f"{find}.click()")


def drag_until(
    condition: Callable[[], object], page: Page, start: tuple[float, float], end: tuple[float, float], **keys: bool
) -> None:
    """Drag from one place of the page to another until something has come of it."""
    repeat_until(condition, lambda: page.drag(start, end, **keys))


def repeat_until(condition: Callable[[], object], act: Callable[[], None]) -> None:
    """Act, and again as long as that does nothing: a busy machine may not have drawn yet what is acted on."""
    end = time.monotonic() + TIMEOUT
    while not condition():
        assert time.monotonic() < end
        act()
        soon = time.monotonic() + 10
        while not condition() and time.monotonic() < soon:
            time.sleep(0.01)


def wait_for(condition: Callable[[], object]) -> None:
    end = time.monotonic() + TIMEOUT
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


@viser_leaves_loops
@pytest.mark.browser
def test_the_playground_pauses_and_a_dragged_goal_replans(page: Page, tmp_path: Path) -> None:
    with running(make_problem("circle", num_robots=4, seed=0)) as playground:
        pause_and_drag(page, playground, tmp_path)


def pause_and_drag(page: Page, playground: Any, tmp_path: Path) -> None:
    session = playground.session
    page.complaints.clear()
    look_at(page, playground, "circle, 4 robots, d4orm-c2f")
    tick(page, "Paused")
    wait_for(lambda: session.frame.status.state == "paused")
    page.until("document.body.textContent.includes('d4orm-c2f: paused')")
    number = session.frame.status.number
    page.evaluate("new Promise((done) => setTimeout(done, 500))")
    assert session.frame.status.number == number, "pause pauses"

    wait_for(lambda: len(playground._server.get_clients()) == 1)
    goal = session.frame.goals[0]
    # By the corner of the diamond: a robot may stand on its middle.
    corner, end = pixel(playground, goal + np.array([0.0, 0.19])), pixel(playground, (0.4, 0.6))
    drag_until(lambda: not np.array_equal(session.frame.goals[0], goal), page, corner, end)
    assert np.abs(session.frame.goals[0] - [0.4, 0.6]).max() < 0.25
    assert session.frame.status.state == "paused"
    tick(page, "Paused")
    wait_for(lambda: session.frame.arrived[0])
    assert np.linalg.norm(session.frame.states[0, :2] - session.frame.goals[0]) < 0.1
    assert session.failure is None
    page.screenshot(tmp_path / "play.png")
    assert (tmp_path / "play.png").stat().st_size > 10_000
    assert [line for line in page.complaints if "passive event listener" not in line] == [], "but for viser's own"


@viser_leaves_loops
@pytest.mark.browser
def test_obstacles_are_dragged_and_scenes_and_replays_saved(page: Page, tmp_path: Path) -> None:
    world = World(boxes=[[-0.2, -0.2, 0.2, 0.2]])
    problem = make_problem("circle", num_robots=2, seed=0)
    with running(problem.with_state(problem.start, problem.goal, world=world), "go-to-goal") as playground:
        session = playground.session
        page.call("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path))
        look_at(page, playground, "circle, 2 robots, go-to-goal")
        tick(page, "Paused")
        wait_for(lambda: session.frame.status.state == "paused" and len(playground._server.get_clients()) == 1)
        start, end = pixel(playground, (0, 0)), pixel(playground, (0.9, 0.9))
        drag_until(lambda: session.frame.problem.world.boxes[0, 0] > 0, page, start, end)
        assert np.abs(session.frame.problem.world.boxes[0] - [0.7, 0.7, 1.1, 1.1]).max() < 0.3

        click(page, "Files")
        for button, name in (("Save scene", "scene.yaml"), ("Save replay", "replay.html")):
            click(page, button)
            wait_for((tmp_path / name).exists)
        saved = load_problem(tmp_path / "scene.yaml")
        np.testing.assert_array_equal(saved.world.boxes, session.frame.problem.world.boxes)
        assert "circle, 2 robots by go-to-goal" in (tmp_path / "replay.html").read_text(encoding="utf-8")


@viser_leaves_loops
@pytest.mark.browser
def test_a_robot_that_is_dragged_with_shift_is_pushed(page: Page, tmp_path: Path) -> None:
    with running(make_problem("circle", num_robots=3, seed=0), "go-to-goal") as playground:
        session = playground.session
        session.pause(True)
        look_at(page, playground, "circle, 3 robots, go-to-goal: paused")
        wait_for(lambda: len(playground._server.get_clients()) == 1)
        page.frames(8)
        before = session.frame.states
        begin = before[0, :2]
        end = pixel(playground, begin + np.array([0.4, 0.6]))
        drag_until(
            lambda: not np.array_equal(session.frame.states, before), page, pixel(playground, begin), end, shift=True
        )
        given = session.frame.states[0] - before[0]
        np.testing.assert_array_equal(given[:2], 0, "it gets a velocity and is left where it is")
        assert np.abs(given[2:] - [0.4, 0.6]).max() < 0.25
        np.testing.assert_array_equal(session.frame.states[1:], before[1:])


@viser_leaves_loops
@pytest.mark.browser
def test_goals_are_dragged_in_space(page: Page) -> None:
    with running(make_problem("sphere", num_robots=3, seed=0), "go-to-goal") as playground:
        session = playground.session
        session.pause(True)
        look_at(page, playground, "sphere, 3 robots, go-to-goal: paused")
        wait_for(lambda: len(playground._server.get_clients()) == 1)
        page.frames(8)
        goal, wanted = session.frame.goals[0], pixel(playground, np.zeros(3))
        drag_until(lambda: not np.array_equal(session.frame.goals[0], goal), page, pixel(playground, goal), wanted)
        moved = session.frame.goals[0]
        assert np.abs(np.array(pixel(playground, moved)) - wanted).max() < 30, "it is where it was let go"
        eye = next(iter(playground._server.get_clients().values())).camera.position
        assert np.linalg.norm(moved - eye) == pytest.approx(np.linalg.norm(goal - eye), rel=0.2), "and as far away"
        np.testing.assert_array_equal(session.frame.goals[1:], session.frame.problem.goal[1:])


@viser_leaves_loops
@pytest.mark.browser
def test_policies_are_ticked_and_drive_side_by_side(page: Page, tmp_path: Path) -> None:
    with running(make_problem("circle", num_robots=3, seed=0), "go-to-goal") as playground:
        session = playground.session
        session.pause(True)  # nobody stands on a goal yet
        page.call("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path))
        look_at(page, playground, "circle, 3 robots, go-to-goal: paused")
        wait_for(lambda: len(playground._server.get_clients()) == 1)
        click(page, "Who drives")
        tick(page, "D4orm-C2F")
        wait_for(lambda: session.policies == ("go-to-goal", "d4orm-c2f"))
        page.until("document.body.textContent.includes('circle, 3 robots, go-to-goal, d4orm-c2f')")
        wait_for(lambda: len(playground._view._viewports) == 2)
        offset = playground._view._viewports[1]._nodes[""].position[:2]
        goal = session.frames[1].goals[0]
        wait_for(lambda: abs(pixel(playground, goal + offset)[0]) < 1200)
        page.frames(8)
        start, end = pixel(playground, goal + offset), pixel(playground, offset + np.array([0.3, 0.5]))
        drag_until(lambda: not np.array_equal(session.frame.goals[0], goal), page, start, end)
        np.testing.assert_array_equal(session.frame.goals, session.frames[1].goals)
        click(page, "Files")
        click(page, "Save replay")
        wait_for((tmp_path / "replay.html").exists)
        text = (tmp_path / "replay.html").read_text(encoding="utf-8")
        assert "by go-to-goal, d4orm-c2f" in text


@viser_leaves_loops
@pytest.mark.browser
def test_two_browsers_play_with_one_team(page: Page, tmp_path: Path) -> None:
    with running(make_problem("circle", num_robots=3, seed=0), "go-to-goal") as playground:
        session = playground.session
        session.pause(True)
        look_at(page, playground, "circle, 3 robots, go-to-goal: paused")
        with browser(tmp_path) as other:
            look_at(other, playground, "circle, 3 robots, go-to-goal: paused")
            wait_for(lambda: len(playground._server.get_clients()) == 2)
            tick(other, "Lifelong goals")
            lifelong = beside("Lifelong goals", "input[type=checkbox]")
            page.until(f"{lifelong}.checked")
            wait_for(lambda: session._options.lifelong)
            wait_for(lambda: abs(pixel(playground, session.frame.goals[0])[0]) < 1200)
            goals = session.frame.goals
            for each in (page, other):
                each.frames(8)
            hands = [(page, pixel(playground, goals[0]), pixel(playground, (0.4, 0.9))),
                     (other, pixel(playground, goals[1]), pixel(playground, (-0.6, -0.5)))]  # fmt: skip
            for each, start, _ in hands:
                each.mouse("Moved", *start, held=False)
                each.frames(8)
                each.mouse("Pressed", *start)
            for share in (0.2, 0.6, 1.0):
                for each, (x, y), (right, down) in hands:
                    each.mouse("Moved", x + share * (right - x), y + share * (down - y))
                    each.frames(2)
            for each, _, end in hands:
                each.mouse("Released", *end)
            wait_for(lambda: (session.frame.goals[:2] != goals[:2]).any(axis=1).all())
            other.mouse("Moved", *pixel(playground, session.frame.states[2, :2]), held=False)
            other.frames(8)
            other.mouse("Pressed", *pixel(playground, session.frame.states[2, :2]))
            other.mouse("Moved", *pixel(playground, (0.1, 0.1)))
            other.frames(4)
        wait_for(lambda: len(playground._server.get_clients()) == 1)  # it is killed with the robot in its hand
        wait_for(lambda: not playground._view._viewports[0]._held)
        session.pause(False)
        wait_for(lambda: session.frame.status.time > 0)
        assert session.failure is None


@viser_leaves_loops
@pytest.mark.browser
def test_a_slow_planner_does_not_freeze_the_page(page: Page) -> None:
    with running(make_problem("circle", num_robots=3, seed=0), "go-to-goal") as playground:
        session = playground.session
        look_at(page, playground, "circle, 3 robots, go-to-goal")
        ended = threading.Event()
        register_policy("slow", lambda: Slow(ended))
        session.choose("slow")
        page.until("document.body.textContent.includes('planning')")
        page.frames(5)
        click(page, "Show")
        tick(page, "Margins")
        wait_for(lambda: playground._view.shown["margins"])
        assert session.frame.status.state == "planning"
        ended.set()
        page.until("document.body.textContent.includes('circle, 3 robots, slow')")


class Slow(GoToGoal):
    """A policy that plans until it is told that it has found something, in compiled code as it were."""

    def __init__(self, ended: threading.Event) -> None:
        self._ended = ended

    def _begin(self, env: object, seed: int) -> None:
        self._ended.wait(TIMEOUT)


@viser_leaves_loops
@pytest.mark.browser
def test_a_slider_disturbs_from_the_next_step_on(page: Page) -> None:
    with running(make_problem("circle", num_robots=3, seed=0), "go-to-goal") as playground:
        session = playground.session
        look_at(page, playground, "circle, 3 robots, go-to-goal")
        session.set_lifelong(True)
        click(page, "What goes wrong")
        bar = beside("Intruders", ".mantine-Slider-track")
        page.until(f"!!{bar}")
        repeat_until(lambda: session.levels.get("intruder"), lambda: click_on(page, bar))
        wait_for(lambda: len(session.frame.bodies) == session.levels["intruder"])
        wait_for(lambda: "bodies" in playground._view._viewports[0]._nodes)
        click(page, "Nothing")
        wait_for(lambda: not session.levels)


@viser_leaves_loops
def test_elsewhere_the_playground_asks_for_its_token(page: Page) -> None:
    with running(make_problem("circle", num_robots=2), "go-to-goal", host="127.0.0.2") as playground:
        page.offline(False)
        page.open(playground.address.partition("?")[0])
        assert page.evaluate("document.body.textContent").startswith("open the address that d4orm play has printed")
        assert not playground._server.get_clients()
        page.open("about:blank")
        page.open(playground.address)
        page.until("document.body.textContent.includes('circle, 2 robots, go-to-goal')")
        assert "token" not in page.evaluate("location.href"), "nor in the browser's history"
