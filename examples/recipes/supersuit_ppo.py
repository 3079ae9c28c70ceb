"""The usual road to Stable-Baselines3: SuperSuit turns the PettingZoo environment into a vector environment.

    python -m examples.recipes.supersuit_ppo --steps 200000

Every robot is one environment of the vector, with the environment's own observations and rewards. It is simple and
works with any library that takes a PettingZoo environment; ``d4orm train`` learns from the same world many times faster
(see docs/rl.md), because it steps all worlds in one compiled call.
"""

from __future__ import annotations

import time
from pathlib import Path

from examples.outputs import argument_parser, count, require, save_table

require("rl", "supersuit", "stable_baselines3")
import supersuit
from stable_baselines3 import PPO
from stable_baselines3.common.utils import set_random_seed

from d4orm_env import navigation_v0
from d4orm_planners import make_policy, run_episode


def train(num_robots: int, worlds: int, steps: int, path: Path) -> float:
    """Train, save SB3's own zip, and return the steps per second."""
    env = navigation_v0.parallel_env(scenario="random", num_robots=num_robots, randomize_instance=True)
    # Agents leave when they arrive; SB3 needs their number to stay the same, so SuperSuit sends zeros for them.
    vector = supersuit.pettingzoo_env_to_vec_env_v1(supersuit.black_death_v3(env))
    envs = supersuit.concat_vec_envs_v1(vector, worlds, num_cpus=0, base_class="stable_baselines3")
    set_random_seed(0)  # PPO(seed=...) would ask for a method that the vector of SuperSuit lacks
    model = PPO("MlpPolicy", envs, n_steps=64, batch_size=64 * num_robots, device="cpu")
    begin = time.perf_counter()
    model.learn(steps)
    seconds = time.perf_counter() - begin
    envs.close()
    path.parent.mkdir(parents=True, exist_ok=True)
    model.save(path)
    return model.num_timesteps / seconds


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--num-robots", "--robots", type=count, default=2, help="size of the team")
    parser.add_argument("--steps", type=count, default=200_000, help="robot-steps to train")
    arguments = parser.parse_args()
    steps = 512 if arguments.quick else arguments.steps
    path = arguments.out / "supersuit_ppo.zip"
    speed = train(arguments.num_robots, 2 if arguments.quick else 8, steps, path)
    print(f"{speed:.0f} robot-steps per second; wrote {path}")
    # A zip is unpickled when it is loaded: give make_policy only files that you made yourself or trust.
    policy = make_policy("ppo", path=str(path))
    env = navigation_v0.parallel_env(scenario="random", num_robots=arguments.num_robots, randomize_instance=True)
    rows = []
    for seed in range(2 if arguments.quick else 10):
        metrics = run_episode(env, policy, seed=seed).metrics
        rows.append(
            {"seed": seed, "arrived": int(metrics["arrived"]), "travel time [s]": f"{metrics['travel_time']:.2f}"}
        )
    save_table(rows, arguments.out / "supersuit_ppo.csv")


if __name__ == "__main__":
    main()
