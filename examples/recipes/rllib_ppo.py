"""PPO of RLlib (new API stack), one network for all robots.

pip install -e . "ray[rllib]" torch        # in an environment of its own, see docs/how_to/recipes.md
python -m examples.recipes.rllib_ppo
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from examples.common import save_table
from examples.recipes.task import WORLD, recipe_arguments, solved

try:
    from ray.rllib.algorithms.ppo import PPOConfig
except ImportError as error:
    print(f"this example needs RLlib by itself, see docs/how_to/recipes.md ({error})", file=sys.stderr)
    raise SystemExit(2) from None
from ray.rllib.callbacks.callbacks import RLlibCallback
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig

from d4orm_env.integrations.rllib import RLlibNavigation
from d4orm_planners.base.adapters import from_rllib

WORLDS = 64


class Successes(RLlibCallback):
    """Tells whether all have arrived without contact."""

    def on_episode_end(self, *, episode: Any, metrics_logger: Any, **others: Any) -> None:
        last = [robot.get_infos(-1)["is_success"] for robot in episode.agent_episodes.values()]
        metrics_logger.log_value("success", float(any(last)), reduce="mean")


def settings(env_config: dict[str, Any], iterations: int) -> PPOConfig:
    """Return the algorithm's settings: many worlds in one process, small networks, smaller and smaller steps."""
    config = PPOConfig().environment(RLlibNavigation, env_config=env_config)
    config.env_runners(num_env_runners=0, num_envs_per_env_runner=WORLDS, rollout_fragment_length=32)
    config.multi_agent(policies={"robot"}, policy_mapping_fn=lambda agent, episode, **others: "robot")
    network = DefaultModelConfig(fcnet_hiddens=[64, 64], vf_share_layers=False, free_log_std=True)
    config.rl_module(model_config=network)
    config.training(train_batch_size_per_learner=WORLDS * 32, minibatch_size=1024, num_epochs=8)
    config.training(lr=[[0, 1e-3], [iterations * WORLDS * 32, 1e-4]])
    config.training(gamma=0.98, lambda_=0.95, clip_param=0.2, use_kl_loss=False)
    config.training(grad_clip=0.5, vf_clip_param=1e4, vf_loss_coeff=0.5)
    return config.callbacks(Successes).debugging(seed=0)


def main() -> None:
    arguments = recipe_arguments(__doc__, "--iterations", 120, "of 2048 steps of teams each")
    iterations, parts = (45, 3) if arguments.quick else (arguments.iterations, 10)
    world = {"scenario": "random", "num_robots": arguments.num_robots, **WORLD}
    algorithm = settings(world, arguments.iterations).build_algo()
    results = [algorithm.train()["env_runners"] for _ in range(iterations)]
    rows = []
    for part in np.array_split(np.arange(iterations), parts):
        counted = [[results[index].get(name, 0) for name in ("num_episodes", "success")] for index in part]
        ended, share = np.nan_to_num(counted).T  # not a number where none ended
        steps = sum(results[part[-1]]["num_agent_steps_sampled_lifetime"].values())
        success = (ended * share).sum() / max(ended.sum(), 1)
        rows.append({"robot-steps": int(steps), "episodes": int(ended.sum()), "success": f"{success:.0%}"})
    save_table(rows, arguments.out / "rllib_ppo.csv")
    policy = from_rllib(algorithm.get_module("robot"), normalized=False, egocentric=True)
    print(solved(policy, arguments))
    algorithm.stop()


if __name__ == "__main__":
    main()
