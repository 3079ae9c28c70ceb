"""Success rates of the package's learned policies, on instances that no training saw.

    python -m examples.studies policy_rates --seeds 100

Seeds from 30000 on, of which the first 100 were never trained on, nor was any file chosen by them. Noise is that on the
controls, of a standard deviation of 0.2. Each cell has successes with Wilson's 95% interval and the mean travel time of
the successes. A row per case, as policies are rolled out batched: `make_policy` would take the same file.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

from examples.common import mean_text, require, save_table, solved_columns, study_parser, study_rows
from examples.studies import AS_IN_THE_PAPER

require("rl", "stable_baselines3")
from d4orm_planners.rl.checkpoints import run_worlds
from d4orm_planners.rl.learned import SHIPPED
from d4orm_planners.rl.network import SUFFIX, load_network
from d4orm_planners.rl.robot_vec_env import RobotVecEnv

FIRST_SEED = 30000
NOISE = {"control_noise_std": 0.2}


class Case(NamedTuple):
    """A team somewhere; ``own`` are further arguments of the environment."""

    name: str
    scenario: str
    num_robots: int
    own: Mapping[str, Any]


def noisy(name: str, scenario: str, num_robots: int) -> Case:
    return Case(f"{name}, noise", scenario, num_robots, NOISE)


OPEN = (
    Case("random, 4 robots, 5 m", "random", 4, {}),
    Case("random, 8, 5 m", "random", 8, {}),
    noisy("random, 8, 5 m", "random", 8),
    Case("random, 16, 7.07 m", "random", 16, {"size": 7.07}),
    Case("random, 16, 5 m", "random", 16, {}),
    Case("random, 32, 10 m", "random", 32, {"size": 10.0}),
    *(noisy(f"{name}, {robots}", name, robots) for name, robots in (
        ("circle", 8), ("circle", 16), ("four_obstacles", 8), ("paper_obstacles", 12), ("swap", 8))),
)  # fmt: skip
WALLS = (
    Case("rooms, 4", "rooms", 4, {}),
    Case("rooms, 8", "rooms", 8, {}),
    noisy("rooms, 8", "rooms", 8),
    Case("rooms, 16", "rooms", 16, {}),
    Case("maze, 4", "maze", 4, {}),
    Case("warehouse, 8", "warehouse", 8, {}),
    Case("forest, 8", "forest", 8, {}),
)
FILES: dict[str, tuple[str, str, Sequence[Case]]] = {
    "ppo": ("holonomic2d", "policy_rates", OPEN),
    "ppo-differential_drive": ("differential_drive", "policy_rates", OPEN),
    "sac": ("holonomic2d", "policy_rates", OPEN),
    "ppo-walls": ("holonomic2d", "policy_rates_walls", WALLS),
    "ppo-differential_drive-walls": ("differential_drive", "policy_rates_walls", WALLS),
}
"""Model, table and cases of every file."""
OBSERVED = (4, 8)
"""Robots in an observation: as many as where nothing is said, and more."""

Rows = list[dict[str, Any]]


def measure(files: Sequence[str], seeds: int, observing: Sequence[int]) -> Rows:
    """A row per file, case, number of observed robots, where there are more than the least of them, and world."""
    rows: Rows = []
    for file in files:
        path = SHIPPED / f"{file}{SUFFIX}"
        network, (model, _, cases) = load_network(path), FILES[file]
        digest = hashlib.sha256(path.read_bytes()).hexdigest()[:12]
        for case in cases:
            for observed in observing if case.num_robots > min(observing) else observing[:1]:
                worlds = RobotVecEnv(
                    seeds, case.num_robots, case.scenario, seed=FIRST_SEED, model=model, observed_robots=observed,
                    shortest_paths=bool(network.header.shortest_paths), **AS_IN_THE_PAPER, **case.own,
                )  # fmt: skip
                ends = run_worlds(network, worlds, FIRST_SEED)
                worlds.close()
                rows += [
                    {"file": file, "digest": digest, "case": case.name, "observed": observed, "success": success,
                     "travel_time": travel_time}
                    for success, travel_time in ends
                ]  # fmt: skip
                print(f"{file}, {case.name}, {observed} observed: {sum(one for one, _ in ends)} of {seeds}", flush=True)
    return rows


def cell(rows: Rows) -> tuple[str, str, str]:
    """Successes, their interval and the mean travel time of the successes."""
    if not rows:
        return "", "", ""
    found = solved_columns(rows, lambda row: row["success"])
    return found["solved"], found["interval"], mean_text([row["travel_time"] for row in rows if row["success"]])


def table_of(rows: Rows, table: str) -> list[dict[str, str]]:
    """A row per case and file."""
    lines = []
    files = [file for file in FILES if FILES[file][1] == table]
    for name, file in product(dict.fromkeys(row["case"] for row in rows), files):
        few, more = (
            cell([row for row in rows if (row["file"], row["case"], row["observed"]) == (file, name, observed)])
            for observed in OBSERVED
        )
        if few[0]:
            lines.append(
                {"": name, "policy": f"`{file}`", "succeeded": few[0], "95%": few[1], "travel time [s]": few[2],
                 "8 observed": more[0], "its 95%": more[1]}
            )  # fmt: skip
    return lines


def main() -> None:
    parser = study_parser(__doc__, seeds=100)
    parser.add_argument("--file", choices=FILES, nargs="+", default=list(FILES), help="only these policy files")
    arguments = parser.parse_args()
    out: Path = arguments.out
    quick = (("ppo-walls",), 1, OBSERVED[:1])
    settings = quick if arguments.quick else (arguments.file, arguments.seeds, OBSERVED)
    rows = study_rows(arguments, "policy_rates", partial(measure, *settings))
    for table in dict.fromkeys(table for _, table, _ in FILES.values()):
        if lines := table_of(rows, table):
            save_table(lines, out / f"{table}.csv")
