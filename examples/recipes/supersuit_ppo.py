"""The usual road to Stable-Baselines3: SuperSuit turns the PettingZoo environment into a vector environment.

    python -m examples.recipes.supersuit_ppo

Every robot is one environment of the vector. It is simple and works with any library that takes a PettingZoo
environment; ``d4orm train`` learns from the same world many times faster (see docs/tutorials/rl.md), because it steps
all worlds in one compiled call.
"""

from __future__ import annotations

from pathlib import Path

from examples.common import require
from examples.recipes.task import WORLD, recipe_arguments, solved

require("rl", "supersuit", "stable_baselines3")
import supersuit
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.utils import set_random_seed

from d4orm_env import navigation_v0
from d4orm_planners.base.adapters import from_sb3


def train(num_robots: int, worlds: int, steps: int, path: Path) -> PPO:
    """Train, and save SB3's own zip."""
    env = navigation_v0.parallel_env("random", num_robots=num_robots, **WORLD)
    # Agents leave when they arrive; SB3 needs their number to stay the same, so SuperSuit sends zeros for them.
    vector = supersuit.pettingzoo_env_to_vec_env_v1(supersuit.black_death_v3(env))
    envs = supersuit.concat_vec_envs_v1(vector, worlds, num_cpus=0, base_class="stable_baselines3")
    set_random_seed(0)  # PPO(seed=...) would ask for a method that the vector of SuperSuit lacks
    model = PPO(
        "MlpPolicy", envs, n_steps=64, batch_size=512, n_epochs=6, gamma=0.98, learning_rate=1e-3,
        policy_kwargs={"log_std_init": -0.5}, device="cpu",
    )  # fmt: skip
    model.learn(steps)
    envs.close()
    path.parent.mkdir(parents=True, exist_ok=True)
    model.save(path)
    return model


def main() -> None:
    arguments = recipe_arguments(__doc__, "--steps", 500_000, "robot-steps to train")
    torch.set_num_threads(1)  # the layers are too small to be shared
    path = arguments.out / "supersuit_ppo.zip"
    model = train(arguments.num_robots, 2 if arguments.quick else 16, 512 if arguments.quick else arguments.steps, path)
    print(f"wrote {path}; the policy {solved(from_sb3(model, egocentric=True), arguments)}")


if __name__ == "__main__":
    main()
