"""Stable-Baselines3 on the joint Gymnasium environment: one network sees what all robots see and steers them all.

    python -m examples.recipes.sb3_joint_ppo

It knows one size of team only, and every robot is paid for what all do: teams learn sooner by ``supersuit_ppo.py``.
"""

from __future__ import annotations

from examples.common import require
from examples.recipes.task import WORLD, recipe_arguments, solved

require("rl", "stable_baselines3")
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env

from d4orm_env.envs.joint_env import ENV_ID, register_environments
from d4orm_planners.base.adapters import from_sb3


def main() -> None:
    arguments = recipe_arguments(__doc__, "--steps", 500_000, "steps of teams to train")
    torch.set_num_threads(1)  # the layers are too small to be shared
    register_environments()
    world = {"scenario": "random", "num_robots": arguments.num_robots, **WORLD}
    model = PPO(
        "MlpPolicy", make_vec_env(ENV_ID, n_envs=16, seed=0, env_kwargs=world), n_steps=128, batch_size=256, n_epochs=6,
        gamma=0.98, learning_rate=5e-4, policy_kwargs={"log_std_init": -0.5, "net_arch": [128, 128]}, device="cpu",
    )  # fmt: skip
    model.learn(2048 if arguments.quick else arguments.steps)
    arguments.out.mkdir(parents=True, exist_ok=True)
    model.save(arguments.out / "sb3_joint_ppo.zip")
    print(solved(from_sb3(model, egocentric=True), arguments))


if __name__ == "__main__":
    main()
