"""Replays and what notebooks show: one self-contained page, whatever a problem is called, and short texts."""

from __future__ import annotations

import base64
import json
import re
import runpy
import subprocess
import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from d4orm_env import Problem, Team, World, make_problem, navigation_v0
from d4orm_env.core.trajectory import Trajectory
from d4orm_env.disturbances import Intruder
from d4orm_env.engine.choice import rollout
from d4orm_env.render.replay import Replay, motion, rounded
from d4orm_planners import make_planner, run_episode
from d4orm_planners.base.episode import Episode
from d4orm_planners.base.plan import Plan

NASTY = "</script><script>alert(1)</script><!-- \u2028 & \" ' {{data}}"
TEAMS = {"circle": {"num_robots": 3, "model": "differential_drive"}, "sphere": {"num_robots": 2, "num_obstacles": 2}}


def content(page: str) -> dict:
    """The data of a page."""
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)
    assert found is not None
    return json.loads(found[1])


@pytest.fixture(scope="module", params=TEAMS)
def plan(request: pytest.FixtureRequest) -> Plan:
    return make_planner().solve(make_problem(request.param, seed=0, **TEAMS[request.param]), seed=0)


@pytest.fixture(scope="module")
def episode() -> Episode:
    env = navigation_v0.parallel_env("circle", num_robots=3, lifelong=True, max_cycles=60)
    return run_episode(env, "go-to-goal", seed=0)


def test_texts_are_short(plan: Plan, episode: Episode) -> None:
    for thing in (plan, plan.problem, plan.trajectory, episode):
        assert len(repr(thing).splitlines()) <= 5
        assert len(repr(thing)) < 400
        assert repr(thing).startswith(type(thing).__name__)
    assert f"arrived {plan.problem.num_robots} of {plan.problem.num_robots}" in repr(plan)


def test_notebooks_get_a_picture_and_key_figures(plan: Plan, episode: Episode) -> None:
    for thing in (plan, plan.problem, plan.trajectory, episode):
        html = thing._repr_html_()
        assert html.count("data:image/png;base64,") == 1
        for name, value in thing.key_figures:
            assert f"<th>{name}</th><td>{value}</td>" in html


def test_a_name_is_escaped_wherever_it_is_shown(plan: Plan) -> None:
    problem = plan.problem.replace(name=NASTY)
    trajectory = rollout(problem, plan.controls)
    for html in (problem._repr_html_(), Replay(NASTY, (motion(problem, trajectory, NASTY, NASTY),)).html):
        assert "<script>alert" not in html
    page = Replay(NASTY, (motion(problem, trajectory, NASTY, NASTY),)).html
    assert page.count("</script>") == 2, "those of the page itself"
    assert content(page)["scenes"][0]["title"] == NASTY
    frame = Replay(NASTY, (motion(problem, trajectory, NASTY),))._repr_html_()
    assert frame.startswith('<iframe sandbox="allow-scripts"')
    assert frame.count("<") == 2, "the page is an attribute"


def test_a_page_loads_nothing(plan: Plan) -> None:
    page = plan.animate().html
    assert "default-src 'none'" in page
    assert not re.search(r"(src|href)=(?!\"data:)|https?:|url\(", page)
    assert not re.search(r"\b(fetch|XMLHttpRequest|import\(|WebSocket)\b", page)


def test_a_page_holds_the_motion(plan: Plan) -> None:
    scene = content(plan.animate().html)["scenes"][0]
    assert scene["dimension"] == plan.problem.dimension
    assert len(scene["radius"]) == len(scene["names"]) == plan.problem.num_robots
    assert len(scene["world"]["balls"]) == plan.problem.world.num_obstacles
    assert scene["heading"] == [model.heading_index for model in plan.problem.team.robot_models]


def test_sixteen_robots_take_less_than_three_megabytes(tmp_path: Path) -> None:
    problem = make_problem("circle", num_robots=16, horizon=2000)
    trajectory = rollout(problem, np.full((2000, 16, 2), 0.001, np.float32))
    assert len(Replay("long", (motion(problem, trajectory, "long"),)).html) < 3e6


@given(arrays(np.float32, st.tuples(st.integers(1, 20), st.integers(1, 4)), elements=st.floats(-1e6, 1e6, width=32)))
def test_rounding_is_to_a_65535th_of_the_range(values: np.ndarray) -> None:
    part = rounded(values)
    back = np.frombuffer(base64.b64decode(part["data"]), "<u2").reshape(values.shape) * part["step"] + part["low"]
    span = np.ptp(values.astype(np.float64), axis=0)
    assert (np.abs(back - values) <= 0.51 * span / 65535 + 1e-9).all()


DOCS = Path(__file__).resolve().parents[2] / "docs"


def test_the_replays_that_the_pages_show_are_made() -> None:
    made = runpy.run_path(str(DOCS / "replays.py"))["REPLAYS"]
    shown = {name for page in DOCS.rglob("*.md") for name in re.findall(r"replays/(\w+)\.html", page.read_text())}
    assert shown == set(made)


def test_the_pages_replays_are_made_anew_when_the_code_was_changed(tmp_path: Path, plan: Plan) -> None:
    write = runpy.run_path(str(DOCS / "replays.py"))["write_replays"]
    made = []
    write.__globals__["REPLAYS"] = {"one": lambda: made.append(digest) or plan.animate()}
    for digest in ("a", "a", "b"):
        write.__globals__["code_digest"] = lambda digest=digest: digest
        write(tmp_path / "replays")
    assert made == ["a", "b"]
    assert (tmp_path / "replays" / "one.html").is_file()


def test_a_replay_of_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="has no motion"):
        Replay("nothing", ())


def test_changing_goals_are_shown(episode: Episode) -> None:
    assert episode.goals.shape == (len(episode.trajectory.states), 3, 2)
    assert (episode.goals != episode.goals[0]).any(), "somebody reached a goal and got another"
    scene = content(episode.animate().html)["scenes"][0]
    moments = len(episode.goals)
    assert len(scene["goals"]["data"]) >= moments * 3 * 2 * 2 * 4 / 3 - 4


def test_a_replay_shows_what_moves_among_the_robots_and_is_none() -> None:
    env = navigation_v0.parallel_env("circle", num_robots=2, disturbances=[Intruder(3, radius=0.2)], max_cycles=8)
    episode = run_episode(env, "go-to-goal", seed=0)
    bodies = content(episode.animate().html)["scenes"][0]["bodies"]
    assert bodies["count"] == 3
    raw = np.frombuffer(base64.b64decode(bodies["data"]), "<u2").reshape(-1, 3, 3)
    read = bodies["low"] + raw * np.array(bodies["step"])
    np.testing.assert_allclose(read[..., :2], episode.events.bodies[: len(read), :, :2], atol=1e-3)
    np.testing.assert_allclose(read[..., 2], 0.2, atol=1e-6)


@pytest.mark.parametrize("bodies", [np.zeros((1, 2, 5)), np.zeros((4, 5)), np.full((41, 1, 5), np.nan)])
def test_bodies_that_do_not_fit_are_refused(bodies: np.ndarray) -> None:
    problem = make_problem("circle", num_robots=2, horizon=40)
    trajectory = rollout(problem, np.zeros((40, 2, 2), np.float32))
    with pytest.raises(ValueError, match="bodies have shape"):
        motion(problem, trajectory, "still", bodies=bodies)


def test_goals_that_do_not_fit_are_refused(plan: Plan) -> None:
    with pytest.raises(ValueError, match=r"goals have shape \(1, 2\); they must be"):
        motion(plan.problem, plan.trajectory, "x", goals=np.zeros((1, 2)))


def test_contacts_and_arrivals_are_flags() -> None:
    problem = Problem(Team(["velocity2d"] * 2, radius=0.2), [[0, 0], [1, 0]], [[1.5, 0], [2.5, 0]], World(), horizon=9)
    controls = np.zeros((9, 2, 2), np.float32)
    controls[:, 0, 0] = 1.0
    trajectory = rollout(problem, controls)
    assert trajectory.collided.any()
    scene = motion(problem, trajectory, "x").content
    flags = np.frombuffer(base64.b64decode(scene["flags"]), np.uint8).reshape(-1, 2)
    assert ((flags & 2) > 0).tolist() == trajectory.collided.tolist()
    assert ((flags & 4) > 0).tolist() == trajectory.margin_violated.tolist()


def test_replays_are_written_whole_or_not_at_all(plan: Plan, tmp_path: Path) -> None:
    path = plan.to_html(tmp_path / "plan.html")
    assert path.read_text(encoding="utf-8") == plan.animate().html
    with pytest.raises(ValueError, match=r"choose one of \.html"):
        plan.to_html(tmp_path / "plan.htm")
    assert [file.name for file in tmp_path.iterdir()] == ["plan.html"]


@pytest.fixture
def _pyplot() -> object:
    from matplotlib import pyplot

    before = mpl.get_backend()
    pyplot.switch_backend("agg")
    yield
    pyplot.close("all")
    pyplot.switch_backend(before)


@pytest.mark.usefixtures("_pyplot")
def test_plots_are_axes_of_the_right_kind(plan: Plan, episode: Episode) -> None:
    name = "3d" if plan.problem.dimension == 3 else "rectilinear"
    assert plan.plot().name == plan.problem.plot().name == name
    assert episode.plot().name == "rectilinear"
    assert plan.problem.name in plan.plot().get_title()


@pytest.mark.usefixtures("_pyplot")
def test_plots_go_where_they_are_told() -> None:
    from matplotlib.figure import Figure

    space = make_problem("sphere", num_robots=2)
    flat, spatial = Figure().add_subplot(), Figure().add_subplot(projection="3d")
    assert space.plot(flat) is flat
    assert space.plot(spatial) is spatial
    with pytest.raises(ValueError, match="axes are spatial and the problem is planar"):
        make_problem("circle", num_robots=2).plot(spatial)


def test_printing_needs_no_matplotlib() -> None:
    code = (
        "import sys; from d4orm_env import make_problem; repr(make_problem('circle', num_robots=2));"
        "assert 'matplotlib' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_trajectory_alone_is_drawn_from_above(plan: Plan) -> None:
    assert isinstance(plan.trajectory, Trajectory)
    assert f"{plan.problem.num_robots} robots" in plan.trajectory._repr_html_()
