"""Upload exported polynomials to Crazyflies, start them together, and land; never flown by those who wrote it.

    d4orm export plan.npz --format crazyswarm2 --height 1 --out flight
    python examples/robots/fly_crazyflies.py flight radio://0/80/2M/E7E7E7E701 radio://0/80/2M/E7E7E7E702

It needs `pip install cflib` (it was read beside 0.1.34), drones that know where they are (motion capture, Lighthouse),
and URIs in the order of the plan's robots. Each drone must stand below its start. Ctrl-C stops the motors. Try it with
one drone, low, first.
"""

from __future__ import annotations

import csv
import sys
import time
from pathlib import Path
from typing import Any

TAKE_OFF, LAND, SETTLE, LOW = 3.0, 4.0, 2.0, 0.05
"""Times for take-off, landing and in between [s], and the height to land at [m]."""


def read_pieces(path: Path) -> list[list[float]]:
    """The pieces of a drone: a duration, then eight coefficients for each of x, y, z and yaw."""
    with path.open(newline="") as file:
        return [[float(value) for value in row] for row in list(csv.reader(file))[1:]]


def upload(link: Any, pieces: list[list[float]]) -> None:
    """Write the pieces into a drone's memory, as trajectory 1."""
    from cflib.crazyflie.mem import MemoryElement, Poly4D

    memory = link.cf.mem.get_mems(MemoryElement.TYPE_TRAJ)[0]
    memory.trajectory = [
        Poly4D(piece[0], *(Poly4D.Poly(piece[1 + 8 * axis : 9 + 8 * axis]) for axis in range(4))) for piece in pieces
    ]
    if not memory.write_data_sync():
        raise RuntimeError(f"{link.cf.link_uri} took no trajectory; nobody takes off")
    link.cf.high_level_commander.define_trajectory(1, 0, len(pieces))


def arm(link: Any) -> None:
    """Allow the motors of a drone to turn, which brushless ones do not by themselves."""
    link.cf.supervisor.send_arming_request(True)


def command(link: Any, name: str, *values: float) -> None:
    """Give a drone's high-level commander a command."""
    getattr(link.cf.high_level_commander, name)(*values)


def fly(flight: dict[str, list[list[float]]]) -> None:
    """Fly the pieces of each URI."""
    import cflib.crtp
    from cflib.crazyflie.swarm import CachedCfFactory, Swarm

    cflib.crtp.init_drivers()
    duration = max(sum(piece[0] for piece in pieces) for pieces in flight.values())
    starts = {uri: (pieces[0][1], pieces[0][9], pieces[0][17]) for uri, pieces in flight.items()}
    with Swarm(set(flight), factory=CachedCfFactory(rw_cache="./cache")) as swarm:
        swarm.reset_estimators()
        swarm.parallel_safe(upload, {uri: [pieces] for uri, pieces in flight.items()})
        try:
            swarm.parallel_safe(arm)
            time.sleep(SETTLE)
            swarm.parallel_safe(command, {uri: ["takeoff", z, TAKE_OFF] for uri, (_, _, z) in starts.items()})
            time.sleep(TAKE_OFF + SETTLE)
            swarm.parallel_safe(command, {uri: ["go_to", *start, 0.0, SETTLE] for uri, start in starts.items()})
            time.sleep(2 * SETTLE)
            swarm.parallel_safe(command, {uri: ["start_trajectory", 1] for uri in flight})
            time.sleep(duration + SETTLE)
            swarm.parallel_safe(command, {uri: ["land", LOW, LAND] for uri in flight})
            time.sleep(LAND)
        finally:
            swarm.parallel_safe(command, {uri: ["stop"] for uri in flight})


def main() -> None:
    if len(sys.argv) < 3:
        raise SystemExit("give a folder of d4orm export, and a URI for each of its robots")
    folder, uris = Path(sys.argv[1]), sys.argv[2:]
    files = [folder / f"robot_{robot}.csv" for robot in range(len(uris))]
    if (folder / f"robot_{len(uris)}.csv").exists() or not all(file.exists() for file in files):
        raise SystemExit(f"{folder} has another number of robots than the {len(uris)} URIs given; give one for each")
    fly({uri: read_pieces(file) for uri, file in zip(uris, files, strict=True)})


if __name__ == "__main__":
    main()
