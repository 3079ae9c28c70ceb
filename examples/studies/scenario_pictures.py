"""Draw the paper's scenarios, those with walls, and a map from a file: the pictures of docs/reference/scenarios.md.

python -m examples.studies scenario_pictures
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from examples.common import argument_parser, count

from d4orm_env import make_problem, rollout
from d4orm_env.render import save_picture

SCENARIOS: dict[str, dict[str, Any]] = {
    "paper_circle": {},
    "paper_sphere": {},
    "paper_random": {},
    "paper_heterogeneous": {},
    "paper_obstacles": {},
    "rooms": {},
    "maze": {},
    "warehouse": {},
    "forest": {},
    "corridor": {},
    "doorway": {},
    "mmd_conveyor": {},
    "mmd_highways": {},
    "mmd_drop_region": {},
    "map": {"map": Path(__file__).parents[1] / "maps" / "office.map"},
}


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--num-robots", "--robots", type=count, default=8)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    for name, settings in list(SCENARIOS.items())[: 2 if arguments.quick else None]:
        problem = make_problem(name, num_robots=arguments.num_robots, seed=arguments.seed, **settings)
        at_rest = rollout(problem.replace(horizon=1), np.zeros((1, problem.num_robots, problem.control_size)))
        path = save_picture(
            problem, at_rest, arguments.out / f"scenario_{name}.png", title=f"{name}, {problem.num_robots} robots"
        )
        print(f"wrote {path}")
