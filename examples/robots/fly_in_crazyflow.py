"""Fly exported setpoints in crazyflow, a physics that is not this package's: how far off drones are, and who falls.

    d4orm export plan.npz --format csv --out flight
    python examples/robots/fly_in_crazyflow.py flight --height 1 --mass 1.05 --gust 0.02

It needs numpy and crazyflow only, which wants an environment of its own (``pip install crazyflow``). Each folder is a
flight. Drones hover at their first setpoints, get position, velocity, acceleration and heading at the rate of the files
for the Mellinger controller of the Crazyflie, and hover at their last ones. There is no downwash.
"""

from __future__ import annotations

import argparse
import sys
from functools import cache
from pathlib import Path
from typing import Any, NoReturn

import numpy as np


def refuse(message: str) -> NoReturn:
    print(message, file=sys.stderr)
    raise SystemExit(2)


try:
    from crazyflow.control import Control
    from crazyflow.drones import Drone
    from crazyflow.dynamics import Dynamics
    from crazyflow.sim import Sim
except ModuleNotFoundError as error:
    refuse(f"this example needs {error.name}; install it in an environment of its own with: pip install crazyflow")

PHYSICS = 500
HOVER, GUST = 3.0, 0.5
"""Time to hover before and after a flight, and for which a gust blows in one direction [s]."""
FLOOR, LOST = 0.05, 0.5
"""Height of a centre on the floor, and distance from a setpoint beyond which a drone counts as fallen [m]."""
COLUMNS = ("x", "y", "z", "vx", "vy", "vz", "ax", "ay", "az")


def read_flight(folder: Path, height: float) -> tuple[int, np.ndarray]:
    """The rate [Hz], and ``(T, K, 16)`` full-state commands of crazyflow, ``height`` above the files' z [m]."""
    files = sorted(folder.glob("robot_*.csv"), key=lambda path: int(path.stem.removeprefix("robot_")))
    if not files:
        refuse(f"{folder} has no robot_*.csv; write them with d4orm export --format csv")
    tables = np.stack([np.genfromtxt(file, delimiter=",", names=True) for file in files], axis=1)
    rate = round(1 / (tables["time"][1, 0] - tables["time"][0, 0]))
    if PHYSICS % rate:
        refuse(f"{folder} has {rate} setpoints a second; export at a rate that divides {PHYSICS}")
    commands = np.zeros((*tables.shape, 16))
    for i, name in enumerate(COLUMNS):
        if name in tables.dtype.names:
            commands[..., i] = tables[name]
    commands[..., 11], commands[..., 12] = np.sin(tables["heading"] / 2), np.cos(tables["heading"] / 2)
    commands[..., 2] += height
    if commands[..., 2].min() <= FLOOR:
        refuse(f"{folder} has a drone at a height of {commands[..., 2].min():.2f} m; use a larger --height")
    return rate, commands


@cache
def simulation(**settings: Any) -> Any:
    """A simulation, which compiles slowly."""
    return Sim(dynamics=Dynamics.first_principles, control=Control.state, freq=PHYSICS, **settings)


def fly(
    commands: np.ndarray, rate: int, drone: str, mass: float, gust: float, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """``(T, K)`` distances from the setpoints, and ``(T, K, 3)`` positions, from the start to the last hovering [m]."""
    hover = round(HOVER * rate)
    commands = np.pad(commands, ((hover, hover), (0, 0), (0, 0)), mode="edge").astype(np.float32)
    commands[:hover, :, 3:9] = commands[-hover:, :, 3:9] = 0
    sim = simulation(n_drones=commands.shape[1], drone=Drone(drone), state_freq=rate)
    sim.reset()
    states = sim.data.states.replace(pos=sim.data.states.pos.at[0].set(commands[0, :, :3]))
    params = sim.data.params.replace(mass=sim.default_data.params.mass * mass)
    sim.data = sim.data.replace(states=states, params=params)
    random, places = np.random.default_rng(seed), []
    for step, command in enumerate(commands):
        places.append(np.asarray(sim.data.states.pos[0]))
        if gust and step % round(GUST * rate) == 0:
            wind = random.normal(size=(1, len(command), 3))
            force = sim.data.states.force.at[:].set(gust * wind / np.linalg.norm(wind, axis=2, keepdims=True))
            sim.data = sim.data.replace(states=sim.data.states.replace(force=force))
        sim.state_control(command[None])
        sim.step(PHYSICS // rate)
    flown = np.array(places)[hover:]
    return np.linalg.norm(flown - commands[hover:, :, :3], axis=2), flown


def main() -> None:
    """Fly the folders and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--height", type=float, default=0.0, help="added to the files' z [m] (default 0)")
    parser.add_argument(
        "--drone", choices=[drone.value for drone in Drone], default=Drone.cf2x_L250.value, help="(default %(default)s)"
    )
    parser.add_argument("--mass", type=float, default=1.0, help="times the drone's own (default 1)")
    parser.add_argument("--gust", type=float, default=0.0, help="force on every drone, another way each 0.5 s [N]")
    parser.add_argument("--seed", type=int, default=0, help="of the gusts (default 0)")
    options = vars(parser.parse_args())
    folders, height = options.pop("folders"), options.pop("height")
    print(f"{'flight':24}  error hovering     RMS    most  least distance  falls   [m]")
    for folder in folders:
        rate, commands = read_flight(folder, height)
        error, places = fly(commands, rate, **options)
        apart = np.linalg.norm(places[:, :, None] - places[:, None], axis=3)
        apart[:, np.eye(len(apart[0]), dtype=bool)] = np.inf
        fallen = ((places[..., 2] < FLOOR) | (error > LOST)).any(axis=0).sum()
        rms = np.sqrt((error**2).mean())
        print(f"{folder.name:24}{error[0].max():16.3f}{rms:8.3f}{error.max():8.3f}{apart.min():16.3f}{fallen:7d}")


if __name__ == "__main__":
    main()
