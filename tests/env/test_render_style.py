"""Pictures are the same whatever the user's rcParams say, and leave these as they were."""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
from test_render import ring_problem, straight_drive

from d4orm_env import navigation_v0
from d4orm_env.render import FrameRenderer, own_style, plot_trajectory, save_animation, save_picture
from d4orm_env.render.pictures import motion_html, paths_html, problem_html
from d4orm_env.render.replay import Denoising, save_denoising
from d4orm_planners.rl.checkpoints import Evaluation, write_curve

# Without LaTeX each text would end the drawing; with it, take seconds.
THEIRS = {
    "text.usetex": True,
    "axes.facecolor": "black",
    "savefig.facecolor": "red",
    "figure.facecolor": "red",
    "font.size": 30,
    "lines.linewidth": 9,
    "axes.grid": True,
    "xtick.color": "blue",
    "savefig.bbox": "tight",
    "axes.prop_cycle": mpl.cycler(color=["red"]),
}
FLAT, SPACE = ring_problem(3, "differential_drive"), ring_problem(3, "holonomic3d")


def frame(problem: Any) -> Any:
    flags = np.zeros(problem.num_robots, bool)
    return FrameRenderer(problem, (160, 120)).draw(problem.start, flags, flags).tobytes()


def environment_frame(folder: Path) -> Any:
    env = navigation_v0.parallel_env(problem=FLAT, render_mode="rgb_array")
    env.reset(seed=0)
    frame = env.render()
    env.close()
    return frame.tobytes()


def denoising(folder: Path) -> Any:
    paths = straight_drive(FLAT).positions[None]
    return save_denoising(FLAT, Denoising(("1",), paths, paths[:, None], np.ones((1, 1), np.float32)), folder / "d.png")


def curve(folder: Path) -> Any:
    values = {field.name: 1.0 for field in dataclasses.fields(Evaluation)}
    write_curve(folder, [Evaluation(**values)] * 2)  # type: ignore[arg-type]
    return folder / "curve.png"


def returned_figure(folder: Path) -> Any:
    """What the user saves is the user's affair, but must not need LaTeX."""
    plot_trajectory(FLAT, straight_drive(FLAT)).savefig(folder / "own.png")
    return b""


DRAWN: dict[str, Callable[[Path], Any]] = {
    "frame": lambda folder: frame(FLAT),
    "frame of space": lambda folder: frame(SPACE),
    "environment": environment_frame,
    "picture": lambda folder: save_picture(FLAT, straight_drive(FLAT), folder / "p.png"),
    "animation": lambda folder: save_animation(FLAT, straight_drive(FLAT), folder / "a.gif", max_frames=3),
    "denoising": denoising,
    "motion": lambda folder: motion_html(FLAT, straight_drive(FLAT), "a", [("b", "c")]).encode(),
    "problem": lambda folder: problem_html(FLAT, "a", []).encode(),
    "paths": lambda folder: paths_html(straight_drive(FLAT), "a", []).encode(),
    "curve": curve,
    "returned figure": returned_figure,
}


def drawn(name: str, folder: Path) -> bytes:
    result = DRAWN[name](folder)
    content: bytes = result.read_bytes() if isinstance(result, Path) else result
    return content


@pytest.mark.parametrize("name", DRAWN)
def test_pictures_do_not_follow_the_users_style(name: str, tmp_path: Path) -> None:
    expected = drawn(name, tmp_path)
    with mpl.rc_context(THEIRS):
        before = dict(mpl.rcParams)
        assert drawn(name, tmp_path) == expected
        assert dict(mpl.rcParams) == before


@pytest.mark.parametrize("problem", [FLAT, SPACE], ids=["flat", "space"])
def test_so_it_is_on_the_axes_of_plot(problem: Any) -> None:
    from matplotlib import pyplot

    with mpl.rc_context(THEIRS):
        axes = problem.plot()
        assert mpl.colors.to_rgb(axes.get_facecolor()) == (1, 1, 1)
        assert not axes.title.get_usetex()
        pyplot.close(axes.figure)


def test_threads_that_draw_at_once_leave_the_users_style() -> None:
    with mpl.rc_context({"font.size": 30}):
        inside, done = threading.Event(), []

        def draw() -> None:
            inside.wait()
            with own_style():
                done.append(mpl.rcParams["font.size"])

        thread = threading.Thread(target=draw)
        thread.start()
        with own_style({"font.size": 5}):
            inside.set()
            thread.join(0.2)
            assert mpl.rcParams["font.size"] == 5
        thread.join()
        assert done == [10.0]
        assert mpl.rcParams["font.size"] == 30
