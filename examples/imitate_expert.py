"""From a planner to a policy: a network learns what D4orm-C2F does, first by cloning, then by DAgger, then by PPO.

    python examples/imitate_expert.py

The clone sees what the expert's own drives led to, and on its own comes into places where the expert never was. DAgger
lets the network drive and asks the expert there. PPO goes on from that by reward. All three are policy files of "ppo".
Broken off, the same command goes on. The same from the command line: ``d4orm train imitation`` and ``d4orm train ppo
--start-from``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from outputs import argument_parser, require, save_table

require("rl", "stable_baselines3", "tensorboard")

from d4orm_env import navigation_v0
from d4orm_planners import make_policy, run_episode
from d4orm_planners.rl.imitation import ImitationSettings, imitate
from d4orm_planners.rl.training import TrainingSettings, train

UNSEEN = range(10_000, 10_020)
"""Seeds to judge by."""


def success(policy: Any, num_robots: int, seeds: Any) -> float:
    """Share of unseen instances in which all arrive and none touches anything."""
    env = navigation_v0.parallel_env(scenario="random", num_robots=num_robots)
    return float(np.mean([run_episode(env, policy, seed=seed).metrics["success"] for seed in seeds]))


def learn(out: Path, quick: bool, num_robots: int) -> dict[str, Path]:
    """Policy files by the way in which they came about."""
    episodes, rounds, epochs, steps = (20, 2, 20, 100_000) if quick else (100, 5, 20, 2_000_000)
    ways = {"clone": 1, "DAgger": rounds}
    files = {}
    for name, count in ways.items():
        settings = ImitationSettings(num_robots=num_robots, episodes=episodes, rounds=count, epochs=epochs)
        files[name] = imitate(settings, out / name, progress=report).policy_path
    further = TrainingSettings(num_robots=num_robots, steps=steps, lessons=5, start_from=files["DAgger"])
    files["DAgger, then PPO"] = train(further, out / "ppo", progress=report).policy_path
    return files


def report(what: str, done: int, total: int) -> None:
    """Say now and then how far it is."""
    if done % max(total // 10, 1) == 0:
        print(f"{done / total:4.0%}  {what}", flush=True)


def main() -> None:
    """Learn, and compare with the expert and with driving straight."""
    arguments = argument_parser(__doc__).parse_args()
    num_robots, judged = (2, UNSEEN[:10]) if arguments.quick else (4, UNSEEN)
    files = learn(arguments.out / "imitation", arguments.quick, num_robots)
    policies = {name: make_policy("ppo", path=path) for name, path in files.items()}
    policies |= {name: make_policy(name) for name in ("d4orm-c2f", "goal")}
    rows = [
        {"policy": name, "success": f"{success(policy, num_robots, judged):.0%}"} for name, policy in policies.items()
    ]
    save_table(rows, arguments.out / "imitate_expert.csv")


if __name__ == "__main__":
    main()
