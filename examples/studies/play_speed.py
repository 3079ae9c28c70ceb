"""Speed of `d4orm play`: control loops, frames that are sent and drawn, and from a drop to the new plan.

    python -m examples.studies play_speed --seconds 30
    python -m examples.studies play_speed --seconds 30 --browser
    python -m examples.studies play_speed --minutes 20 --browser

A team with lifelong goals is driven live, and shown to a viewer: a client that draws nothing, or with `--browser`
headless Chromium, which without a graphics processor draws on the processor that plans. Where Chromium runs, the time
that it takes is part of the measurement.
"""

from __future__ import annotations

import argparse
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from examples.common import require
from numpy.typing import NDArray

require("viz", "viser")

import viser
import zstandard
from websockets.sync.client import connect

from d4orm_env import make_problem
from d4orm_planners.play import edits
from d4orm_planners.play.playground import Playground
from d4orm_planners.play.session import Session


class Client:
    """A client that receives what is sent, and draws nothing."""

    def __init__(self, address: str) -> None:
        protocols: Any = [f"viser-v{viser.__version__}"]
        self._socket = connect(address.replace("http", "ws"), subprotocols=protocols, max_size=None)
        self._ended = threading.Event()
        self._received = 0
        self._thread = threading.Thread(target=self._receive, daemon=True)
        self._thread.start()

    def _receive(self) -> None:
        while not self._ended.is_set():
            data = self._socket.recv()
            assert isinstance(data, bytes)
            size = int.from_bytes(data[8:16], "little")
            self._received += b"/robots" in zstandard.decompress(data[16 : 16 + size])

    def frames(self) -> dict[str, float]:
        """Return the number up to now."""
        return {"frames received": self._received}

    def close(self) -> None:
        self._ended.set()
        self._thread.join()  # more is sent all the time
        self._socket.close()


class Browser:
    """A browser that draws."""

    def __init__(self, page: Any, address: str) -> None:
        self._page = page
        page.look(1200, 800)
        page.open(address)
        page.until("document.body.textContent.includes(' robots, ') && window.__viserTestpoints !== undefined")
        page.evaluate("window.drawn = 0; (function count() { drawn++; requestAnimationFrame(count); })()")

    def frames(self) -> dict[str, float]:
        """Return the number up to now: chances to draw, and scenes drawn."""
        chances, scenes = self._page.evaluate("[drawn, __viserTestpoints.rendererInfo.render.frame]")
        return {"animation frames": chances, "scenes drawn": scenes}


@contextmanager
def looking(address: str, in_browser: bool) -> Iterator[Client | Browser]:
    """Connect a client or a browser."""
    if not in_browser:
        client = Client(address)
        yield client
        client.close()
        return
    sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))
    import browser_support

    if browser_support.missing():
        sys.exit(f"--browser {browser_support.missing()}")
    with TemporaryDirectory(ignore_cleanup_errors=True) as folder, browser_support.browser(Path(folder)) as page:
        yield Browser(page, address)


class Watched(NamedTuple):
    """Measurements of the control loops, one after the other."""

    milliseconds: NDArray[np.float64]
    megabytes: NDArray[np.float64]
    in_contact: NDArray[np.int64]


def watch(session: Session, seconds: float) -> Watched:
    """The control loops of so many seconds."""
    seen: list[tuple[float, float, int]] = []
    last, end = session.frame.status.time, time.perf_counter() + seconds
    while time.perf_counter() < end:
        if (status := (frame := session.frame).status).time != last:
            last = status.time
            seen.append((1e3 * frame.loop, memory(), int(frame.collided.sum())))
        time.sleep(0.005)
    loops, held, contacts = zip(*seen)
    return Watched(np.array(loops), np.array(held), np.array(contacts))


def drop(session: Session, random: np.random.Generator) -> float:
    """Seconds from a goal's being dropped to the first frame with the new plan; nan if there was no room for it."""
    goal, refused = session.frame.goals[0], session.frame.status.refused
    position = random.uniform(-1.2, 1.2, session.frame.problem.dimension)
    begin = time.perf_counter()
    session.edit(lambda scene: edits.move_goal(scene, 0, position))
    while np.array_equal(session.frame.goals[0], goal):
        if session.frame.status.refused > refused:
            return float("nan")
        time.sleep(0.001)
    return time.perf_counter() - begin


def memory() -> float:
    """Return the memory of this process [MB], on Linux."""
    pages = Path("/proc/self/statm")
    return int(pages.read_text().split()[1]) * 4096 / 1e6 if pages.exists() else float("nan")


def measure(arguments: argparse.Namespace) -> None:
    """Play, and print what was measured."""
    problem = make_problem(arguments.scenario, num_robots=arguments.num_robots, seed=0)
    playground = Playground(problem, *arguments.policy.split(","))
    session = playground.session
    session.set_lifelong(True)
    thread = threading.Thread(target=playground.run)
    thread.start()
    try:
        with looking(playground.address, arguments.browser) as viewer:
            watch(session, arguments.warmup)
            seconds = 60 * arguments.minutes or arguments.seconds
            before, begin = viewer.frames(), time.perf_counter()
            loops, held, contacts = watch(session, seconds)
            passed, after = time.perf_counter() - begin, viewer.frames()
            drops = [drop(session, np.random.default_rng(seed)) for seed in range(arguments.drops)]
            print(f"{problem.name}, {problem.num_robots} robots, {', '.join(session.policies)}: {passed:.0f} s")
            for name, number in after.items():
                print(f"{name}: {(number - before[name]) / passed:.1f} per second")
            print(f"steps: {len(loops) / passed:.1f} of {1 / problem.dt:.0f} per second")
            middle, late, most, step = np.median(loops), np.percentile(loops, 95), loops.max(), 1e3 * problem.dt
            print(
                f"control loop: median {middle:.0f} ms, 95% {late:.0f} ms, most {most:.0f} ms, "
                f"{100 * np.mean(loops > step):.1f}% over {step:.0f} ms"
            )
            print(f"from a drop to the new plan: median {np.nanmedian(drops):.2f} s, most {np.nanmax(drops):.2f} s")
            quarters = held[np.linspace(0, len(held) - 1, 5).astype(int)]
            print(f"memory, every quarter of that: {', '.join(f'{size:.0f}' for size in quarters)} MB")
            print(f"steps in which anybody touched anything: {int((contacts > 0).sum())}")
    finally:
        playground.stop()
        thread.join()
        playground.close()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="circle")
    parser.add_argument("--num-robots", type=int, default=16)
    parser.add_argument("--policy", default="d4orm-c2f", help="several, separated by commas, drive side by side")
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--minutes", type=float, default=0.0, help="instead of seconds")
    parser.add_argument("--warmup", type=float, default=5.0, help="seconds before")
    parser.add_argument("--drops", type=int, default=5)
    parser.add_argument("--browser", action="store_true", help="measure in headless Chromium")
    measure(parser.parse_args())
