"""Pictures, frames and animations show what happened, and leave nothing half-written."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.backend_bases import FigureManagerBase
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from d4orm_env import make_problem, render, rollout
from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.core.trajectory import Trajectory
from d4orm_env.core.world import World
from d4orm_env.render import FrameRenderer, WindowRenderer, plot, plot_trajectory, save_animation, save_picture
from d4orm_env.render.animation import frame_steps
from d4orm_env.render.panels import CONTACT, Axes2D, TeamLayer, robot_colors, view_limits
from d4orm_env.render.pictures import contact_points
from d4orm_planners.cli.outputs import PictureOptions

CONTACT_RGB = np.round(255 * np.array(mpl.colors.to_rgb(CONTACT))).astype(int)


def ring_problem(num_robots: int, models: Any = "holonomic2d", diameter: float = 5.0, **changes: Any) -> Problem:
    """Robots on a circle, each with its goal opposite."""
    models = (models,) * num_robots if isinstance(models, str) else models
    angle = 2 * np.pi * np.arange(num_robots) / num_robots
    team = Team(models, radius=changes.pop("radius", 0.15))
    start = np.zeros((num_robots, team.state_size))
    start[:, 0], start[:, 1] = 0.5 * diameter * np.cos(angle), 0.5 * diameter * np.sin(angle)
    return Problem(team, start, -start[:, : team.dimension], horizon=changes.pop("horizon", 30), **changes)


def straight_drive(problem: Problem, arrival: float = 0.8) -> Trajectory:
    """Everyone drives straight to the goal and arrives at this fraction of the horizon; contacts are found by hand."""
    steps, robots, d = problem.horizon, problem.num_robots, problem.dimension
    progress = np.minimum(np.arange(steps + 1) / (arrival * steps), 1.0)[:, None, None]
    positions = (1 - progress) * problem.start[:, :d] + progress * problem.goal
    states = np.zeros((steps + 1, robots, problem.state_size), np.float32)
    states[..., :d] = positions
    for k, model in enumerate(problem.team.robot_models):
        if model.heading_index is not None:
            offset = problem.goal[k] - problem.start[k, :2]
            states[:, k, model.heading_index] = np.arctan2(offset[1], offset[0])
    radius = np.asarray(problem.team.radius)
    gap = np.linalg.norm(positions[:, :, None] - positions[:, None], axis=-1) - radius[:, None] - radius
    nearest = np.minimum((gap + 1e3 * np.eye(robots)).min(axis=-1), problem.world.clearance(positions) - radius)
    return Trajectory(
        states=states,
        positions=positions.astype(np.float32),
        controls=np.zeros((steps, robots, problem.control_size), np.float32),
        rewards=np.zeros((steps, robots), np.float32),
        arrived=np.broadcast_to(progress[:, :, 0] >= 1, (steps + 1, robots)),
        collided=nearest <= 0,
        margin_violated=nearest <= problem.margin,
    )


def contact_pixels(image: Any) -> int:
    """Pixels in the colour that marks contacts."""
    return int((np.abs(np.asarray(image).astype(int)[..., :3] - CONTACT_RGB).max(axis=-1) <= 2).sum())


def differing_pixels(one: Any, other: Any) -> int:
    return int((np.asarray(one) != np.asarray(other)).any(axis=-1).sum())


def cylinders_and_boxes() -> World:
    return World(
        3, spheres=[(0, 0, 1, 0.3)], cylinders=[(0.5, 0, 0.2)], boxes=[(-1, 1, -1, -0.5, 1.5, 0.5)],
        lower=(-3, -3, -3), upper=(3, 3, 3),
    )  # fmt: skip


PROBLEMS = {
    "one robot": lambda: ring_problem(1),
    "contacts": lambda: ring_problem(8),
    "mixed team": lambda: ring_problem(6, ("differential_drive", "holonomic2d", "velocity2d") * 2),
    "obstacles": lambda: ring_problem(
        3, world=World(2, circles=[(1, 0.5, 0.3)], boxes=[(-1, -1, 0, -0.5)], lower=(-3, -3), upper=(3, 3))
    ),
    "cars and unicycles": lambda: ring_problem(4, ("car", "unicycle") * 2),
    "64 robots": lambda: ring_problem(64, diameter=16.0),
    "space": lambda: ring_problem(5, "holonomic3d", world=cylinders_and_boxes(), radius=0.29),
}


@pytest.fixture(params=PROBLEMS)
def problem(request: pytest.FixtureRequest) -> Problem:
    return PROBLEMS[request.param]()


@pytest.mark.parametrize("suffix", [".png", ".svg", ".pdf"])
def test_pictures_of_every_kind_are_written_whole_and_repeatable(suffix: str, tmp_path: Path) -> None:
    problem = PROBLEMS["contacts"]()
    first, second = (save_picture(problem, straight_drive(problem), tmp_path / f"{i}{suffix}") for i in "ab")
    start = {".png": b"\x89PNG", ".svg": b"<?xml", ".pdf": b"%PDF"}[suffix]
    assert first.read_bytes().startswith(start)
    assert first.read_bytes() == second.read_bytes()
    assert sorted(tmp_path.iterdir()) == [first, second]


def test_picture_of_every_problem_has_axes_in_metres(problem: Problem, tmp_path: Path) -> None:
    figure = plot_trajectory(problem, straight_drive(problem))
    labels = [{axes.get_xlabel(), axes.get_ylabel()} for axes in figure.axes]
    assert labels == [{"x [m]", "y [m]"}] * (2 if problem.dimension == 3 else 1)
    above: Any = figure.axes[-1]
    assert above.get_aspect() == 1.0
    figure.savefig(tmp_path / "picture.png", dpi=50)
    with Image.open(tmp_path / "picture.png") as image:
        pixels = np.asarray(image.convert("RGB")).reshape(-1, 3)
    assert len(np.unique(pixels, axis=0)) > 20


def test_title_tells_the_outcome_unless_one_is_given() -> None:
    problem = ring_problem(8, name="crossing")
    trajectory = straight_drive(problem)
    assert plot_trajectory(problem, trajectory).get_suptitle() == (
        "crossing, 8 robots: all arrived after 2.4 s, 8 in contact"
    )
    stopped = straight_drive(problem, arrival=2.0)
    assert "0 of 8 arrived" in plot_trajectory(problem, stopped).get_suptitle()
    assert plot_trajectory(problem, trajectory, title="mine").get_suptitle() == "mine"
    assert plot_trajectory(problem, trajectory, title="").get_suptitle() == ""


def test_legend_names_only_what_is_there() -> None:
    def legend(problem: Problem) -> set[str]:
        figure = plot_trajectory(problem, straight_drive(problem))
        return {text.get_text() for text in figure.legends[0].get_texts()}

    assert legend(PROBLEMS["one robot"]()) == {"start", "goal", "end"}
    assert legend(PROBLEMS["contacts"]()) == {"start", "goal", "end", "contact", "margin violated"}
    assert "obstacle" in legend(PROBLEMS["obstacles"]())


def test_contacts_are_marked_where_they_begin() -> None:
    problem = ring_problem(2)
    trajectory = straight_drive(problem)
    points = contact_points(trajectory)
    first = int(trajectory.collided.any(axis=1).argmax())
    assert len(points[first - 1]) == 0
    np.testing.assert_array_equal(points[-1], trajectory.positions[first])


def test_colours_are_distinct_for_every_team_size() -> None:
    for num_robots in (1, 8, 9, 64, 200):
        colors = robot_colors(num_robots)
        assert colors.shape == (num_robots, 3)
        assert len({tuple(color) for color in colors}) == num_robots
    lines = np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)[:32]
    assert (1.05 / (lines @ [0.2126, 0.7152, 0.0722] + 0.05) > 2.2).all(), "contrast with white"
    apart = np.linalg.norm(colors[:16, None] - colors[:16], axis=-1) + np.eye(16)
    assert apart.min() > 0.15


def test_trailers_have_their_cars_colour_and_goals_a_cars_size() -> None:
    problem = make_problem("random", num_robots=3, seed=1, model="car_with_2_trailers", size=12.0)
    trajectory = rollout(problem, np.zeros((problem.horizon, 3, 2), np.float32))
    axes = plot(problem, trajectory)
    (starts,) = (part for part in axes.collections if part.get_zorder() == 2.5 and len(part.get_paths()) == 9)
    colors = robot_colors(3)[[body.robot for body in problem.team.bodies]]
    np.testing.assert_allclose(starts.get_edgecolors()[:, :3], colors)
    goals = next(part for part in axes.collections if part.get_zorder() == 3)
    assert np.ptp(goals.get_paths()[0].vertices[:, 0]) < 4 * problem.team.bodies[0].footprint.outline().max()


def test_goal_headings_are_drawn_where_there_are_some() -> None:
    team, start = Team(("unicycle",) * 3), [[0, 0, 0], [0, 1, 0], [0, 2, 0]]
    problem = Problem(team, start, [[2, 0], [2, 1], [2, 2]], goal_heading=[0.0, np.nan, np.pi / 2])
    layer = TeamLayer(Axes2D(problem.plot(), problem, view_limits(problem)), problem)
    layer.update(problem.start, np.zeros(3, bool), problem.goal + 1, np.empty((0, 3, 2)), np.empty((0, 2)))
    lines = np.array(layer.goal_headings.get_segments())
    np.testing.assert_allclose(lines, [[[3, 1], [3.3, 1]], [[3, 3], [3, 3.3]]], atol=1e-6)
    np.testing.assert_allclose(layer.goal_headings.get_colors()[:, :3], layer.colors[[0, 2]])


def test_view_holds_every_robot_and_a_near_bound_but_not_a_far_one() -> None:
    near = ring_problem(4, world=World(2, lower=(-3, -3), upper=(3, 3)))
    limits = view_limits(near, [[2.0, 2.9]])
    assert (limits[0] < -3).all()
    assert (limits[1] > 3).all()
    far = ring_problem(4, world=World(2, lower=(-90, -90), upper=(90, 90)))
    assert np.abs(view_limits(far)).max() < 4
    assert view_limits(far, [[7.0, 0.0]])[1, 0] > 7.15


def test_frames_have_the_size_asked_for_and_belong_to_the_caller(problem: Problem) -> None:
    trajectory = straight_drive(problem)
    renderer = FrameRenderer(problem, size=(320, 200))
    first = renderer.draw(trajectory.states[0], trajectory.arrived[0], trajectory.collided[0])
    kept = first.copy()
    later = renderer.draw(trajectory.states[9], trajectory.arrived[9], trajectory.collided[9])
    assert first.shape == (200, 320, 3)
    assert first.dtype == np.uint8
    assert first.flags.owndata
    assert differing_pixels(first, kept) == 0
    assert differing_pixels(first, later) > 20
    again = renderer.draw(trajectory.states[0], trajectory.arrived[0], trajectory.collided[0])
    np.testing.assert_array_equal(again, first)
    renderer.close()


@pytest.mark.parametrize("kind", ["mixed team", "space"])
def test_frames_show_trail_goals_arrival_heading_and_contact(kind: str) -> None:
    problem = PROBLEMS[kind]()
    trajectory, nobody = straight_drive(problem), np.zeros(problem.num_robots, bool)
    renderer = FrameRenderer(problem)
    states = trajectory.states[6]

    def frame(**changes: Any) -> Any:
        moment = {"states": states, "arrived": nobody, "collided": nobody, "caption": ""} | changes
        return renderer.draw(**moment)

    plain = frame()
    assert contact_pixels(plain) == 0
    assert contact_pixels(frame(collided=~nobody)) > 50
    assert contact_pixels(frame(contacts=[problem.goal[0]])) > 20
    assert differing_pixels(plain, frame(trail=trajectory.positions[:7])) > 100
    assert differing_pixels(plain, frame(goals=0.5 * problem.goal)) > 50
    assert differing_pixels(plain, frame(arrived=~nobody)) > 50
    assert differing_pixels(plain, frame(caption="4.2 s")) > 20
    turned = states.copy()
    drives = [k for k, name in enumerate(problem.team.models) if name == "differential_drive"]
    turned[drives, 2] += 1.0
    assert (differing_pixels(plain, frame(states=turned)) > 5) == bool(drives)
    renderer.close()


@pytest.mark.parametrize("kind", ["contacts", "space"])
def test_view_grows_with_a_robot_that_leaves_it(kind: str) -> None:
    problem = PROBLEMS[kind]()
    renderer = FrameRenderer(problem)
    nobody = np.zeros(problem.num_robots, bool)
    home = renderer.draw(problem.start, nobody, nobody)
    away = problem.start.copy()
    away[0, :2] = 40.0
    far = renderer.draw(away, nobody, nobody)
    axes = renderer._layers[0].panel.axes
    assert axes.get_xlim()[1] > 40.15
    assert differing_pixels(home, far) > 100
    renderer.close()


def test_renderer_refuses_bad_input_and_use_after_close() -> None:
    problem = ring_problem(3)
    nobody = np.zeros(3, bool)
    with pytest.raises(ValueError, match="64 x 64"):
        FrameRenderer(problem, size=(480, 10))
    renderer = FrameRenderer(problem)
    with pytest.raises(ValueError, match=r"\(3, 4\).*\(2, 4\)"):
        renderer.draw(problem.start[:2], nobody, nobody)
    with pytest.raises(ValueError, match="finite"):
        renderer.draw(np.full_like(problem.start, np.nan), nobody, nobody)
    renderer.close()
    renderer.close()
    with pytest.raises(RuntimeError, match="closed"):
        renderer.draw(problem.start, nobody, nobody)


def test_window_renderer_draws_without_a_window_where_there_is_no_display(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mpl, "get_backend", lambda: "agg")
    problem = ring_problem(3)
    nobody = np.zeros(3, bool)
    window, frames = WindowRenderer(problem), FrameRenderer(problem)
    assert window._manager is None
    shown = window.draw(problem.start, nobody, nobody)
    np.testing.assert_array_equal(shown, frames.draw(problem.start, nobody, nobody))
    window.close()
    window.close()


class RecordingCanvas(FigureCanvasAgg):
    """A canvas that claims to be a window's, and notes what is asked of it."""

    required_interactive_framework = "recording"
    waits: list[float]

    def start_event_loop(self, timeout: float = 0) -> None:
        self.waits = [*getattr(self, "waits", []), timeout]


class RecordingManager(FigureManagerBase):
    shown, destroyed = 0, 0

    def show(self) -> None:
        self.shown += 1

    def destroy(self) -> None:
        self.destroyed += 1


setattr(RecordingCanvas, "manager_class", RecordingManager)  # noqa: B010


def test_window_shows_each_frame_and_survives_being_closed_by_the_user(monkeypatch: pytest.MonkeyPatch) -> None:
    backend = ModuleType("recording_backend")
    backend.FigureCanvas = RecordingCanvas  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "recording_backend", backend)
    monkeypatch.setattr(mpl, "get_backend", lambda: "module://recording_backend")
    problem = ring_problem(3, dt=0.25)
    nobody = np.zeros(3, bool)
    window = WindowRenderer(problem, size=(200, 200))
    manager = window._manager
    assert window._manager is not None
    assert manager.shown == 1
    frame = window.draw(problem.start, nobody, nobody)
    np.testing.assert_array_equal(window._image.get_array(), frame)
    window.draw(problem.start, nobody, nobody)
    first, second = manager.canvas.waits
    assert 0 < first < second <= 0.25
    manager.canvas.callbacks.process("close_event", None)
    assert window._manager is None
    window.draw(problem.start, nobody, nobody)
    assert len(manager.canvas.waits) == 2
    window.close()
    other = WindowRenderer(problem)
    closing = other._manager
    other.close()
    assert closing.destroyed == 1


def gif_frames(path: Path) -> tuple[list[Any], list[int]]:
    images, durations = [], []
    image: Any
    with Image.open(path) as image:
        for index in range(image.n_frames):
            image.seek(index)
            images.append(np.asarray(image.convert("RGB")))
            durations.append(image.info["duration"])
    return images, durations


def test_gif_plays_in_real_time_and_stops_after_the_last_arrival(tmp_path: Path) -> None:
    problem = ring_problem(4, horizon=40)
    trajectory = straight_drive(problem, arrival=0.5)
    images, durations = gif_frames(save_animation(problem, trajectory, tmp_path / "drive.gif"))
    assert len(images) == 20 + 5 + 1
    assert durations == [100] * 25 + [1500]
    assert contact_pixels(images[0]) == 0
    assert contact_pixels(images[-1]) > 20
    assert [file.name for file in tmp_path.iterdir()] == ["drive.gif"]


def test_gif_of_sixteen_robots_and_a_hundred_steps_stays_small(tmp_path: Path) -> None:
    problem = ring_problem(16, horizon=100)
    path = save_animation(problem, straight_drive(problem, arrival=1.0), tmp_path / "drive.gif")
    assert path.stat().st_size < 2_000_000
    image: Any
    with Image.open(path) as image:
        assert image.n_frames == 101
        assert 480 <= image.width <= 560


def test_gif_of_space_shows_contacts(tmp_path: Path) -> None:
    problem = ring_problem(4, "holonomic3d", world=cylinders_and_boxes(), horizon=8)
    images, _ = gif_frames(save_animation(problem, straight_drive(problem), tmp_path / "drive.gif", max_frames=3))
    assert len(images) == 3
    assert contact_pixels(images[-1]) > 20


def test_speed_rate_and_frame_limit_choose_the_steps() -> None:
    problem = ring_problem(2, horizon=100)
    never = straight_drive(problem, arrival=2.0)
    steps, fps = frame_steps(problem, never, fps=10.0, speed=1.0, max_frames=400)
    np.testing.assert_array_equal(steps, np.arange(101))
    assert fps == 10.0
    steps, fps = frame_steps(problem, never, fps=10.0, speed=2.0, max_frames=400)
    np.testing.assert_array_equal(steps, np.arange(0, 101, 2))
    steps, fps = frame_steps(problem, never, fps=10.0, speed=1.0, max_frames=11)
    np.testing.assert_array_equal(steps, np.arange(0, 101, 10))
    assert fps == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"fps": 0.0}, "fps"),
        ({"fps": 100.0}, "at most 50"),
        ({"speed": float("nan")}, "speed"),
        ({"max_frames": 1}, "max_frames"),
    ],
)
def test_animation_refuses_numbers_out_of_range_and_leaves_nothing(
    changes: dict[str, Any], words: str, tmp_path: Path
) -> None:
    problem = ring_problem(2)
    with pytest.raises(ValueError, match=words):
        save_animation(problem, straight_drive(problem), tmp_path / "drive.gif", **changes)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("save", "name"), [(save_picture, "drive.bmp"), (save_animation, "drive.avi")])
def test_unknown_suffix_missing_folder_and_folder_as_file(save: Any, name: str, tmp_path: Path) -> None:
    problem = ring_problem(2)
    trajectory = straight_drive(problem)
    with pytest.raises(ValueError, match=r"'\.(bmp|avi)'; choose one of \."):
        save(problem, trajectory, tmp_path / name)
    good = {"drive.bmp": "drive.png", "drive.avi": "drive.gif"}[name]
    with pytest.raises(FileNotFoundError, match="does not exist; create it"):
        save(problem, trajectory, tmp_path / "missing" / good)
    (tmp_path / good).mkdir()
    with pytest.raises(ValueError, match="is a folder"):
        save(problem, trajectory, tmp_path / good)
    assert [file.name for file in tmp_path.iterdir()] == [good]


def test_unwritable_folder_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(self: Path, *_: Any, **__: Any) -> None:
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "touch", refuse)  # the suite may run as root, whom no folder refuses
    problem = ring_problem(2)
    with pytest.raises(ValueError, match=r"drive\.png cannot be written: Permission denied; free some"):
        save_picture(problem, straight_drive(problem), tmp_path / "drive.png")


def test_an_error_on_the_way_keeps_the_old_file_and_leaves_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem = ring_problem(2)
    trajectory = straight_drive(problem)
    path = save_picture(problem, trajectory, tmp_path / "drive.png")
    old = path.read_bytes()

    def fail(self: Figure, target: Any, **_: Any) -> None:
        Path(target).write_bytes(b"half")
        raise OSError("disk full")

    monkeypatch.setattr(Figure, "savefig", fail)
    with pytest.raises(OSError, match="disk full"):
        save_picture(problem, trajectory, path)
    assert path.read_bytes() == old
    assert list(tmp_path.iterdir()) == [path]


def test_trajectory_of_another_problem_or_not_finite_is_refused(tmp_path: Path) -> None:
    problem, other = ring_problem(2), ring_problem(3)
    with pytest.raises(ValueError, match="pass the problem that the trajectory solves"):
        plot_trajectory(problem, straight_drive(other))
    trajectory = straight_drive(problem)
    trajectory.states[4, 1, 0] = np.nan
    for save, name in ((save_picture, "drive.png"), (save_animation, "drive.gif")):
        with pytest.raises(ValueError, match="robot_1 at step 4 is not finite"):
            save(problem, trajectory, tmp_path / name)
    assert list(tmp_path.iterdir()) == []


def fake_ffmpeg(folder: Path, script: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Put a stand-in for ffmpeg on the PATH: it runs where the real one is not installed."""
    if sys.platform == "win32":
        pytest.skip("a script is no program on Windows")
    program = folder / "ffmpeg"
    program.write_text(f"#!{sys.executable}\nimport sys\n{script}\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(folder))


def test_mp4_sends_every_frame_to_ffmpeg(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "bin").mkdir()
    fake_ffmpeg(tmp_path / "bin", "open(sys.argv[-1], 'wb').write(sys.stdin.buffer.read())", monkeypatch)
    problem = ring_problem(2, horizon=10)
    path = save_animation(problem, straight_drive(problem, arrival=1.0), tmp_path / "drive.mp4")
    raw = np.frombuffer(path.read_bytes(), np.uint8).reshape(11, -1, 520, 3)
    assert raw.shape[1] % 2 == 0
    assert contact_pixels(raw[0]) == 0
    assert contact_pixels(raw[-1]) > 20


def test_mp4_reports_what_ffmpeg_says_and_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "bin").mkdir()
    fake_ffmpeg(tmp_path / "bin", "sys.exit('Unknown encoder')", monkeypatch)
    problem = ring_problem(2)
    with pytest.raises(OSError, match="status 1: Unknown encoder"):
        save_animation(problem, straight_drive(problem), tmp_path / "drive.mp4")
    assert [file.name for file in tmp_path.iterdir()] == ["bin"]


def test_mp4_without_ffmpeg_tells_the_way_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    problem = ring_problem(2)
    with pytest.raises(ValueError, match=r"install it, or write a \.gif"):
        save_animation(problem, straight_drive(problem), tmp_path / "drive.mp4")
    with pytest.raises(ValueError, match=r"install it, or write a \.gif"):
        PictureOptions(animation=tmp_path / "drive.mp4").check_pictures()  # before anything is planned
    assert list(tmp_path.iterdir()) == []


def test_package_loads_matplotlib_at_first_use_and_pyplot_never() -> None:
    script = (
        "import sys, d4orm_env.render as render; assert 'matplotlib' not in sys.modules; "
        "assert 'save_picture' in dir(render); render.plot_trajectory; assert 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", script], check=True)
    with pytest.raises(AttributeError, match="no attribute 'draw_everything'"):
        render.draw_everything  # noqa: B018
