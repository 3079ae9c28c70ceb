"""Rounds of D4orm-D over Ray, for test_distributed_ray, which runs this in a process of its own.

Writes a line for each part with what came out: all but the last in one instance of Ray, for each takes its time.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from d4orm_env import make_problem
from d4orm_planners import make_planner
from d4orm_planners.base.planner import Callback
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.d_d4orm import ray_planner
from d4orm_planners.d_d4orm.ray_planner import RayConnection

SETTINGS: dict[str, Any] = {"engine": "cpu", "num_samples": 64, "num_steps": 5, "improve": True, "k": 2}


def rounds(transport: str, clip: bool, callback: Callback | None = None) -> tuple[list[float], int]:
    """The rewards of three rounds of two nodes, and how many messages there were."""
    planner = make_planner("d-d4orm", transport=transport, **SETTINGS, clip_between_iterations=clip)
    plan = planner.solve(make_problem("circle", num_robots=4), seed=3, max_iterations=3, callback=callback)
    return [record.reward for record in plan.history], plan.metrics["messages"]


def kill(restarts: int, mode: str) -> tuple[list[int], list[int], list[str], bool]:
    """Kill an actor in mid-round.

    Returns:
        The actors' processes before and after, the notes of the rounds, and whether the team was brought home.
    """
    ray_planner.RESTARTS = restarts
    planner = make_planner("d-d4orm", engine="cpu", transport="ray", mode=mode, improve=True, timeout=60, num_steps=400)
    search = SolveRun(planner, make_problem("circle", num_robots=8), 0, None)
    notes: list[str] = []
    try:
        notes.append(search.advance().note)
        pool = search.state.pool
        before = [node.search.planner.process for node in pool.alive]
        # Into an iteration, or nearly.
        timer = threading.Timer(0.1, os.kill, (before[1], signal.SIGKILL))
        timer.start()
        while len(notes) < 8 and not any(notes):
            notes.append(search.advance().note)
        timer.join()
        after = [node.search.planner.process for node in pool.alive]
    finally:
        search.close()
    return before, after, [note for note in notes if note], search.plan("stopped").solved


def overdue(timeout: float) -> tuple[str, str, int]:
    """A second of rounds that would take minutes: the status, the last note, and the denoising steps that were made."""
    planner = make_planner("d-d4orm", engine="cpu", transport="ray", improve=True, timeout=timeout, num_steps=200000)
    plan = planner.solve(make_problem("circle", num_robots=8), time_limit=1)
    return plan.status, plan.history[-1].note, plan.denoising_steps


def frozen(timeout: float) -> tuple[str, str, int]:
    """The same with actors that are stopped before they begin."""
    start = ray_planner.RayPlanner.start

    def start_and_freeze(planner: ray_planner.RayPlanner) -> None:
        start(planner)
        os.kill(planner.process, signal.SIGSTOP)

    ray_planner.RayPlanner.start = start_and_freeze
    try:
        return overdue(timeout)
    finally:
        ray_planner.RayPlanner.start = start


def family() -> set[int]:
    """This process and all that it has started."""
    parents = {}
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            parents[int(folder.name)] = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
    mine = {os.getpid()}
    while more := {child for child, parent in parents.items() if parent in mine} - mine:
        mine |= more
    return mine


def listening() -> Iterator[str]:
    """Addresses that they listen on, in the kernel's notation."""
    sockets = set()
    for process in family():
        for link in Path(f"/proc/{process}/fd").glob("*"):
            with suppress(OSError):
                sockets.add(os.readlink(link))
    for name in ("tcp", "tcp6"):
        for line in Path("/proc/net", name).read_text().splitlines()[1:]:
            row = line.split()
            if row[3] == "0A" and f"socket:[{row[9]}]" in sockets:
                yield row[1].partition(":")[0]


def report(part: str, result: Any) -> None:
    """Tell what came out of a part."""
    sys.stdout.write(f"RESULT {json.dumps([part, result])}\n")
    sys.stdout.flush()


def main() -> None:
    """Every part, those that leave something behind last."""
    connection = RayConnection("local", "this test")
    report("rounds", {clip: rounds("ray", clip == "clipped") for clip in ("clipped", "unclipped")})
    report("shared", connection.ray.is_initialized())
    for restarts in (3, 0):
        report(f"killed, {restarts} restarts", [kill(restarts, mode) for mode in ("sync", "async")])
    report("in time", overdue(timeout=60))
    report("frozen", frozen(timeout=0.1))
    connection.close()
    heard: set[str] = set()
    look = (lambda record: heard.update(listening())) if Path("/proc/net/tcp").exists() else None
    report("again", rounds("ray", clip=True, callback=look))
    report("listening", sorted(heard))
    report("left open", connection.ray.is_initialized())


if __name__ == "__main__":
    main()
