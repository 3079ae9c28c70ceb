"""Six ground robots, each a process with its own node of D-D4orm on a zenoh network, that get new goals for ever.

    python -m examples.studies onboard_lifelong --minutes 2

This is the paper's on-robot demonstration (section VIII-E) in a simulated world: the world tells all robots where they
are, and each robot commands its own body. While they drive, the robots plan on from where they will be; every one draws
its share of the samples and exchanges candidates with the others, and they execute the best plan that all have agreed
on. ``--kill 2:20`` kills the process of robot 2 after 20 simulated seconds; the others go on around its body.

Real is everything between the processes, and the time that planning takes. Simulated are bodies, positioning and the
clock: a tick waits for the commands of all robots that are alive.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import secrets
import signal
import sys
import tempfile
from pathlib import Path

from examples.common import argument_parser, count, require, save_figure, save_gif, save_table
from examples.studies.onboard.mission import TICK, Mission
from examples.studies.onboard.results import Row, draw, pictures, robot_rows, run_row, timeline
from examples.studies.onboard.robot import Robot
from examples.studies.onboard.thinking import COLUMNS, Log
from examples.studies.onboard.world import RobotProcesses, World, free_endpoints

from d4orm_env.core.files import replaced_when_done
from d4orm_planners.d_d4orm.transport import LocalNetwork

REPORT = 10.0
"""Simulated seconds between lines on how it goes."""

SHOWN = 15.0
"""Simulated seconds that the lower half of the picture shows."""


def kill_order(text: str) -> tuple[int, float]:
    """``ROBOT:SECONDS`` of the command line."""
    robot, _, seconds = text.partition(":")
    try:
        order = int(robot), float(seconds)
    except ValueError:
        order = -1, 0.0
    if order[0] < 0 or not order[1] >= 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form ROBOT:SECONDS, as 2:20")
    return order


def main() -> int:
    parser = argument_parser(__doc__)
    parser.add_argument("--minutes", type=float, default=2.0, help="simulated time")
    parser.add_argument("--num-robots", "--robots", type=count, default=6)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--speed", type=float, default=1.0, help="simulated seconds per second at most")
    parser.add_argument("--samples", type=count, default=576, help="of all robots together")
    parser.add_argument("--timeout", type=float, default=10.0, help="seconds after which a silent robot is given up")
    parser.add_argument("--kill", type=kill_order, action="append", default=[], metavar="ROBOT:SECONDS")
    parser.add_argument("--film", type=float, default=30.0, help="seconds of the animation")
    arguments = parser.parse_args()
    require("zenoh", "zenoh")
    robots, minutes = arguments.num_robots, arguments.minutes
    if arguments.quick:
        robots, minutes = 3, 0.1
    for robot, _ in arguments.kill:
        if robot >= robots:
            parser.error(f"--kill names robot {robot}; of {robots} robots the last one is {robots - 1}")
    world_endpoint, team_endpoint = free_endpoints(2)
    mission = Mission(
        robots=robots, seed=arguments.seed, samples=arguments.samples, timeout=arguments.timeout,
        namespace=f"onboard-{secrets.token_hex(4)}", world=world_endpoint, team=team_endpoint,
    )  # fmt: skip
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        with tempfile.TemporaryDirectory() as folder:
            return run(mission, arguments, minutes, Path(folder))
    except KeyboardInterrupt:
        print("interrupted before there was anything to write", file=sys.stderr)
        return 130


def run(mission: Mission, arguments: argparse.Namespace, minutes: float, folder: Path) -> int:
    """One run; the status to exit with."""
    with Log(folder / "first.csv", 0) as log:
        # Compiled once, all processes load it from numba's cache.
        Robot(mission, 0, LocalNetwork().join(), log).prepare()
    status, out = 0, arguments.out
    with contextlib.closing(mission.join("world", listen=True)) as network:
        world = World(mission, network, max(round(60 * minutes / TICK), 1), arguments.speed)
        with RobotProcesses(mission, folder) as processes:

            def each_tick(tick: int) -> None:
                for robot, seconds in arguments.kill:
                    if robot not in processes.killed and tick * TICK >= seconds:
                        print(f"{tick * TICK:.1f} s: the process of robot {robot} is killed", flush=True)
                        processes.kill(robot)
                if tick and tick % round(REPORT / TICK) == 0:
                    print(f"{tick * TICK:.0f} s: {world.record.goals_reached} goals reached", flush=True)

            try:
                world.await_robots(processes.check)
                print(f"{mission.robots} robots are ready", flush=True)
                world.run(each_tick)
            except KeyboardInterrupt:
                print("interrupted; the robots are told to end", file=sys.stderr)
                status = 130
            finally:
                world.end()
        statuses = processes.statuses()
    if world.record.steps:
        write(world, timeline(world.record, processes.logs), out, arguments.film)
    failed = [robot for robot, ended in enumerate(statuses) if ended and robot not in processes.killed]
    if failed:
        print(f"robots {failed} have ended with statuses {[statuses[robot] for robot in failed]}", file=sys.stderr)
    return status or int(bool(failed))


def write(world: World, rows: list[Row], out: Path, seconds: float) -> None:
    """Tables, timeline and animation."""
    record = world.record
    save_table([run_row(record, rows, TICK)], out / "onboard_lifelong.csv")
    save_table(robot_rows(record, rows), out / "onboard_lifelong_robots.csv")
    path = out / "onboard_lifelong_timeline.csv"
    with replaced_when_done(path) as temporary, temporary.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(row | {name: f"{row[name]:.4f}" for name in ("time", "until")} for row in rows)
    print(f"wrote {path}")
    until = record.began[min(round(SHOWN / TICK), record.steps - 1)] - record.began[0]
    save_figure(draw(rows, world.problem.num_robots, until), out / "onboard_lifelong_timeline.png")
    save_gif(pictures(world.problem, record, seconds), out / "onboard_lifelong.gif", TICK)
