"""MAPPO of BenchMARL on a task of this package; any other of its algorithms for continuous actions does as well.

pip install -e . benchmarl        # in an environment of its own, see docs/how_to/recipes.md
python -m examples.recipes.benchmarl_mappo
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from examples.common import require, save_table
from examples.recipes.task import WORLD, recipe_arguments, solved

require("rl", "torchrl")
try:
    from benchmarl.algorithms import MappoConfig
except ImportError as error:
    print(f"this example needs BenchMARL by itself, see docs/how_to/recipes.md ({error})", file=sys.stderr)
    raise SystemExit(2) from None
import torch
from benchmarl.experiment import Callback, Experiment, ExperimentConfig
from benchmarl.models.mlp import MlpConfig
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from d4orm_env.integrations.benchmarl import NavigationTask
from d4orm_planners.base.adapters import SharedPolicy

WORLDS, HORIZON = 256, 32


def settings(folder: Path, iterations: int) -> Any:
    """Return the settings of an experiment: short rollouts of many worlds, and small batches."""
    config = ExperimentConfig.get_from_yaml()
    config.save_folder, config.loggers, config.create_json = str(folder), [], True
    config.max_n_iters, config.max_n_frames, config.gamma, config.lr = iterations, None, 0.98, 1e-3
    config.on_policy_n_envs_per_worker = WORLDS
    config.on_policy_collected_frames_per_batch = WORLDS * HORIZON
    config.on_policy_n_minibatch_iters, config.on_policy_minibatch_size = 4, WORLDS * HORIZON // 4
    config.evaluation, config.render = False, False
    return config


class Successes(Callback):
    """Counts of the episodes that ended in each iteration, and of those that succeeded."""

    def __init__(self) -> None:
        super().__init__()
        self.counts: list[tuple[int, int]] = []

    def on_batch_collected(self, batch: Any) -> None:
        ended = batch["next", "done"][..., 0]
        success = batch["next", "robots", "info", "success"][ended][:, 0, 0]
        self.counts.append((len(success), int(success.sum())))


def as_policy(module: Any, num_robots: int) -> SharedPolicy:
    """The policy of an experiment, which wants a row for each robot, for those that have yet to arrive."""

    def predict(seen: np.ndarray) -> np.ndarray:
        rows = torch.zeros(num_robots, seen.shape[1])
        rows[: len(seen)] = torch.as_tensor(seen)
        asked = TensorDict({"robots": TensorDict({"observation": rows}, [num_robots])}, [])
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            return module(asked)["robots", "action"][: len(seen)].numpy()

    return SharedPolicy(predict, module, egocentric=True)


def main() -> None:
    arguments = recipe_arguments(__doc__, "--iterations", 80, "of 8192 steps of teams each")
    iterations, parts = (60, 3) if arguments.quick else (arguments.iterations, 10)
    torch.set_num_threads(1)  # the layers are too small to be shared
    own = {"num_robots": arguments.num_robots, "num_instances": 512, **WORLD}
    counted, folder = Successes(), arguments.out / "benchmarl"
    folder.mkdir(parents=True, exist_ok=True)
    model = MlpConfig.get_from_yaml()
    model.num_cells, model.activation_class = [64, 64], torch.nn.Tanh
    experiment = Experiment(
        task=NavigationTask("random", own), algorithm_config=MappoConfig.get_from_yaml(), model_config=model,
        critic_model_config=model, seed=0, config=settings(folder, iterations), callbacks=[counted],
    )  # fmt: skip
    experiment.run()
    rows = []
    for part in np.array_split(np.arange(iterations), parts):
        ended, succeeded = np.sum([counted.counts[index] for index in part], axis=0)
        steps = (part[-1] + 1) * WORLDS * HORIZON * arguments.num_robots
        rows.append({"robot-steps": steps, "episodes": ended, "success": f"{succeeded / max(ended, 1):.0%}"})
    print(solved(as_policy(experiment.policy, arguments.num_robots), arguments))
    save_table(rows, arguments.out / "benchmarl_mappo.csv")


if __name__ == "__main__":
    main()
