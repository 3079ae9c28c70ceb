"""Animations: GIF with Pillow, MP4 with ffmpeg where it is installed."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from d4orm_env.core.arrays import positive_number, whole_number
from d4orm_env.core.files import checked_path, replaced_when_done
from d4orm_env.core.problem import Problem
from d4orm_env.core.trajectory import DisturbanceEvents, Trajectory
from d4orm_env.render.frames import FrameRenderer
from d4orm_env.render.panels import picture_palette, view_limits
from d4orm_env.render.pictures import checked_trajectory, contact_points, last_moment

ANIMATION_SUFFIXES = (".gif", ".mp4")

_MOST_FRAMES_PER_SECOND = {".gif": 50.0, ".mp4": 120.0}
_AFTERMATH = 0.5
_LAST_FRAME = 1.5

Frame = NDArray[np.uint8]


def save_animation(
    problem: Problem,
    trajectory: Trajectory,
    path: str | Path,
    fps: float | None = None,
    speed: float = 1.0,
    max_frames: int = 400,
    events: DisturbanceEvents | None = None,
) -> Path:
    """Write a trajectory as a moving picture, up to half a second after the last robot has arrived, or to its end.

    Args:
        problem: The problem that the trajectory belongs to.
        trajectory: Motion to show.
        path: A ``.gif`` file, or ``.mp4`` where ffmpeg is installed.
        fps: Frames per second; by default one frame per time step, at most 20.
        speed: Speed of playing, in multiples of real time.
        max_frames: A longer animation gets fewer frames per second, at the same speed.
        events: Its disturbances, as for :func:`~d4orm_env.render.plot_trajectory`.

    Returns:
        The path.

    Raises:
        ValueError: For another suffix, ``.mp4`` without ffmpeg, a number or trajectory that does not fit, or if it
            cannot be written; nothing is left behind then.
        OSError: If ffmpeg fails.
    """
    checked_trajectory(problem, trajectory)
    with replaced_when_done(path := checked_path(path, "an animation"), ANIMATION_SUFFIXES) as temporary:
        kind = path.suffix.lower()
        check_ffmpeg(path)
        most = _MOST_FRAMES_PER_SECOND[kind]
        steps, rate = frame_steps(problem, trajectory, _frame_rate(problem, fps, speed, most), speed, max_frames)
        write = _write_gif if kind == ".gif" else _write_mp4
        with closing(FrameRenderer(problem, frame_size(problem, trajectory), trajectory.positions)) as renderer:
            write(temporary, _Frames(renderer, trajectory, steps, events), rate)
    return path


def check_ffmpeg(path: Path) -> None:
    """Raise ``ValueError`` if an animation at this path needs ffmpeg and it is not installed."""
    if path.suffix.lower() == ".mp4" and shutil.which("ffmpeg") is None:
        raise ValueError(f"{path} needs ffmpeg, which is not on the PATH; install it, or write a .gif instead")


def _frame_rate(problem: Problem, fps: float | None, speed: float, most: float) -> float:
    speed = positive_number(speed, "speed")
    rate = min(speed / problem.dt, 20.0) if fps is None else positive_number(fps, "fps")
    if rate > most:
        raise ValueError(f"fps is {rate:g}; at most {most:g} can be played in this format")
    return rate


def frame_steps(
    problem: Problem, trajectory: Trajectory, fps: float, speed: float, max_frames: int
) -> tuple[NDArray[np.int64], float]:
    """Return the time step that each frame shows, and the frames per second after ``max_frames`` has been kept to."""
    whole_number(max_frames, "max_frames", 2)
    last = last_moment(problem, trajectory, _AFTERMATH)
    duration = last * problem.dt / speed
    intervals = max(1, round(duration * fps))
    if intervals + 1 > max_frames:
        intervals = max_frames - 1
        fps = intervals / duration
    return np.round(np.linspace(0, last, intervals + 1)).astype(np.int64), fps


def frame_size(problem: Problem, trajectory: Trajectory) -> tuple[int, int]:
    """Width and height [pixels] that suit the world's shape; even numbers, as video wants them."""
    if problem.dimension == 3:
        return 880, 460
    width, height = np.ptp(view_limits(problem, trajectory.positions), axis=0)
    return 520, 2 * int(np.clip(0.5 * (520 * 0.85 * height / width + 90), 120, 390))


@dataclass(frozen=True, eq=False)
class _Frames:
    """The images of an animation, drawn when asked for."""

    renderer: FrameRenderer
    trajectory: Trajectory
    steps: NDArray[np.int64]
    events: DisturbanceEvents | None

    def __iter__(self) -> Iterator[Frame]:
        trajectory, problem, contacts = self.trajectory, self.renderer.problem, contact_points(self.trajectory)
        for step in self.steps.tolist():
            arrived = np.asarray(trajectory.arrived[step])
            yield self.renderer.draw(
                trajectory.states[step],
                arrived,
                trajectory.collided[step],
                trail=trajectory.positions[: step + 1],
                contacts=contacts[step],
                events=None if self.events is None else self.events.until(step),
                caption=f"{problem.name}    {step * problem.dt:.1f} s    arrived {arrived.sum()} of {len(arrived)}",
            )


def _write_gif(path: Path, frames: _Frames, fps: float) -> None:
    # One palette for all frames: what stands still then keeps its colours to the bit, and costs nothing.
    palette = Image.new("P", (1, 1))
    palette.putpalette(picture_palette(frames.renderer.problem.num_robots, 256).tobytes())
    images = (Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames)
    # GIF counts in hundredths of a second, so the times are rounded, not the durations: they must not drift.
    times = np.round(100 * np.arange(len(frames.steps)) / fps).astype(int)
    durations = [10 * int(d) for d in np.diff(times)] + [int(1000 * _LAST_FRAME)]
    next(images).save(path, format="GIF", save_all=True, append_images=images, duration=durations, loop=0, disposal=1)


def _write_mp4(path: Path, frames: _Frames, fps: float) -> None:
    width, height = frames.renderer.size
    raw = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{fps:g}", "-i", "-"]
    coded = ["-an", "-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "20", "-movflags", "+faststart", "-f", "mp4"]
    command: list[str | Path] = ["ffmpeg", "-y", "-loglevel", "error", *raw, *coded, path]
    with TemporaryFile() as log:
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=log) as ffmpeg:
            assert ffmpeg.stdin is not None
            try:
                for frame in frames:
                    ffmpeg.stdin.write(frame.tobytes())
                ffmpeg.stdin.close()
            except BrokenPipeError:
                pass  # ffmpeg has given up; its own words, below, say why
            except BaseException:
                ffmpeg.kill()
                raise
        if ffmpeg.returncode:
            log.seek(0)
            words = log.read().decode(errors="replace").strip().splitlines()
            raise OSError(f"ffmpeg failed with status {ffmpeg.returncode}: {words[-1] if words else 'no message'}")
