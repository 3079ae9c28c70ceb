"""The task for BenchMARL: an algorithm of its learns from it."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip(
    "benchmarl", reason="BenchMARL is not installed: it asks for TorchRL before 0.12", exc_type=ImportError
)

from benchmarl.algorithms import MappoConfig
from benchmarl.experiment import Experiment, ExperimentConfig
from benchmarl.models.mlp import MlpConfig

from d4orm_env.integrations.benchmarl import NavigationTask


def test_mappo_learns_from_the_task(tmp_path: Path) -> None:
    config = ExperimentConfig.get_from_yaml()
    config.save_folder, config.loggers, config.create_json = str(tmp_path), [], True
    config.max_n_iters, config.max_n_frames = 2, None
    config.on_policy_collected_frames_per_batch, config.on_policy_n_envs_per_worker = 64 * 16, 64
    config.on_policy_n_minibatch_iters, config.on_policy_minibatch_size = 1, 512
    config.evaluation_interval, config.evaluation_episodes, config.render = 64 * 16, 4, False
    task = NavigationTask("random", {"num_robots": 3, "reward": "training", "max_cycles": 20})
    experiment = Experiment(
        task=task, algorithm_config=MappoConfig.get_from_yaml(), model_config=MlpConfig.get_from_yaml(),
        critic_model_config=MlpConfig.get_from_yaml(), seed=0, config=config,
    )  # fmt: skip
    experiment.run()
    assert experiment.total_frames == 2 * 64 * 16
    assert list(Path(experiment.folder_name).rglob("*.json"))
