"""Serve a simulated fleet for long: ``python tests/release/soak_serve.py 30``.

A process of ``d4orm serve`` drives six robots that lose a tenth of the messages. Whoever arrives gets a new goal, and
once a minute all are stopped. Printed are the least gap, the server's memory and how long a stop takes. With a second
number the server is held up (SIGSTOP) up to so many seconds long at random, once in five seconds or so:
``python tests/release/soak_serve.py 30 0.4``.
"""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))
sys.path.insert(0, str(Path(__file__).parents[1]))

from d4orm_env import Problem, Team, save_problem
from tests.planners.test_serve import DT, Fleet, until

NUM_ROBOTS, RADIUS, SIZE = 6, 0.1, 3.0
WATCHDOG = 0.2
"""Silence after which a robot stops by itself, as the page on real robots asks for [s]."""
ENDPOINT = "tcp/127.0.0.1:7449"
START = np.array([[SIZE * (k % 3) / 2, SIZE * (k // 3)] for k in range(NUM_ROBOTS)])


def problem() -> Problem:
    team = Team(("holonomic2d",) * NUM_ROBOTS, radius=RADIUS, max_acceleration=2.0)
    start = np.hstack([START, np.zeros_like(START)])
    return Problem(team, start, START, dt=DT, horizon=400, goal_radius=0.06)


def least_gap(positions: np.ndarray) -> float:
    between = np.linalg.norm(positions[:, None] - positions, axis=-1) + 9 * np.eye(NUM_ROBOTS)
    return float(between.min() - 2 * RADIUS)


def megabytes(process: int) -> float:
    return int(Path(f"/proc/{process}/statm").read_text().split()[1]) * os.sysconf("SC_PAGESIZE") / 2**20


def new_goals(fleet: Fleet, goals: np.ndarray, rng: np.random.Generator) -> int:
    """Give one to whoever has arrived, away from all others' goals and from who stands; count them."""
    arrived = np.flatnonzero(np.linalg.norm(fleet.position - goals, axis=1) < 0.1)
    for robot in arrived.tolist():
        others = np.delete(goals, robot, axis=0)
        position = goals[robot]
        while (
            np.linalg.norm(others - position, axis=1).min() < 0.4
            or np.linalg.norm(position - fleet.position[robot]) < 1
        ):
            position = rng.uniform(0, SIZE, 2)
        goals[robot] = position
        fleet.goal(robot, position.tolist())
    return len(arrived)


def spread(seconds: list[float]) -> list[float] | None:
    return [float(np.median(seconds)), max(seconds)] if seconds else None


def hold_up(server: int, longest: float, over: threading.Event) -> None:
    """Stop the process now and then, as a machine does that has too much to do."""
    random = np.random.default_rng(1)
    while not over.wait(random.uniform(0.1, 10.0)):
        os.kill(server, signal.SIGSTOP)
        time.sleep(random.uniform(0.0, longest))
        os.kill(server, signal.SIGCONT)


def soak(minutes: float, server: int) -> dict[str, object]:
    fleet, rng = Fleet(ENDPOINT, START, loss=0.1, watchdog=WATCHDOG), np.random.default_rng(0)
    fleet.heading = np.zeros(NUM_ROBOTS)
    goals, gap, given, stops, memory = START.copy(), (math.inf, ""), 0, [], []
    passed_on: list[float] = []
    try:
        until(lambda: fleet.diagnosis[-1] == "driving", 300)
        begin = stopped = time.monotonic()
        while time.monotonic() - begin < 60 * minutes:
            gap = min(gap, (least_gap(fleet.position), fleet.diagnosis[-1]))
            given += new_goals(fleet, goals, rng) if fleet.diagnosis[-1] == "driving" else 0
            if time.monotonic() - stopped > 60 and (fleet.velocity != 0).any():
                told, wanted = time.monotonic(), time.time()
                fleet.e_stop(True)
                until(lambda: bool((fleet.velocity == 0).all()))
                stops.append(time.monotonic() - told)
                passed_on.append(max(fleet.told_to_stand) - wanted)
                memory.append(megabytes(server))
                fleet.e_stop(False)
                stopped = time.monotonic()
            time.sleep(DT / 10)
    finally:
        fleet.close()
    return {
        "minutes": minutes, "goals": given, "least gap [m], while": gap,
        "stops": len(stops), "all stood after [s]: median, longest": spread(stops),
        "all told to after [s], by the stamps of commands": spread(passed_on),
        "memory [MB]": memory,
    }  # fmt: skip


def main(minutes: float, longest: float = 0.0) -> None:
    """Run the server and the fleet, and print what was seen."""
    with tempfile.TemporaryDirectory() as folder:
        config, scenario = Path(folder, "serve.yaml"), Path(folder, "scenario.yaml")
        save_problem(problem(), scenario)
        task = {
            "problem": str(scenario),
            "deadline": 0.5,
            "watchdog": WATCHDOG,
            "zenoh": {"listen": [ENDPOINT]},
            "controller": {"mode": "measured"},
        }
        names = [f"robot_{number}" for number in range(NUM_ROBOTS)]
        config.write_text(json.dumps(task | {"robots": names}))  # JSON is YAML
        server = subprocess.Popen([Path(sys.executable).with_name("d4orm"), "serve", "--config", config])
        over = threading.Event()
        holding_up = threading.Thread(target=hold_up, args=(server.pid, longest, over), daemon=True)
        try:
            if longest:
                holding_up.start()
            print(json.dumps(soak(minutes, server.pid), indent=1))
        finally:
            over.set()
            if longest:
                holding_up.join()
            server.send_signal(signal.SIGINT)
            server.wait(30)


if __name__ == "__main__":
    main(*map(float, sys.argv[1:]))
