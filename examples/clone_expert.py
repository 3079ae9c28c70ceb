"""Behaviour cloning: a network learns from a dataset of D4orm-C2F what a robot does, and drives a team.

    python examples/clone_expert.py

Demonstrations are recorded as a Minari dataset, an episode per robot; broken off, the same command goes on. The network
sees what a robot sees, in the robot's own frame, and says what the expert would do. On its own it comes into places
where the expert never was, so that it succeeds less often.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from outputs import argument_parser, require, save_table

require("dataset", "minari")
require("rl", "torch")

import torch

from d4orm_env import make_problem, navigation_v0
from d4orm_env.core.observation_layout import ObservationLayout
from d4orm_planners import run_episode
from d4orm_planners.dataset import Demonstrations, write_dataset
from d4orm_planners.rl.features import Features

ENVIRONMENT = {"scenario": "random", "num_robots": 4}
UNSEEN = range(10_000, 10_020)
"""Seeds to judge by."""


def in_own_frame(frames: Any, controls: Any) -> Any:
    """Controls ``(N, 2)`` that are vectors of the world, seen along the directions ``(N, 2)`` to the goals."""
    (cosine, sine), (x, y) = frames.T, controls.T
    return np.stack([cosine * x + sine * y, cosine * y - sine * x], axis=1)


def learn(inputs: Any, targets: Any, epochs: int) -> torch.nn.Module:
    """A network that tells the targets ``(N, m)`` from the inputs ``(N, F)``, by least squares."""
    torch.manual_seed(0)
    torch.set_num_threads(1)
    network = torch.nn.Sequential(
        torch.nn.Linear(inputs.shape[1], 128), torch.nn.ReLU(),
        torch.nn.Linear(128, 128), torch.nn.ReLU(),
        torch.nn.Linear(128, targets.shape[1]),
    )  # fmt: skip
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-3)
    data = torch.utils.data.TensorDataset(torch.as_tensor(inputs), torch.as_tensor(targets))
    for _ in range(epochs):
        for seen, wanted in torch.utils.data.DataLoader(data, batch_size=256, shuffle=True):
            optimizer.zero_grad()
            torch.nn.functional.mse_loss(network(seen), wanted).backward()
            optimizer.step()
    return network


def drive(features: Features, network: torch.nn.Module, limit: Any, observation: Any) -> Any:
    """What the network does with what a robot sees."""
    inputs, frame = features.encode(observation[None])
    with torch.no_grad():
        action = network(torch.as_tensor(inputs)).numpy()
    return features.decode(action, frame, limit[None])[0]


def success(policy: Any, seeds: Any) -> float:
    """Share of unseen instances in which all arrive and none touches anything."""
    env = navigation_v0.parallel_env(**ENVIRONMENT)
    return float(np.mean([run_episode(env, policy, seed=seed).metrics["success"] for seed in seeds]))


def main() -> None:
    """Record, learn, and compare with the expert and with driving straight."""
    arguments = argument_parser(__doc__).parse_args()
    episodes, epochs, judged = (40, 20, UNSEEN[:10]) if arguments.quick else (400, 40, UNSEEN)
    arguments.out.mkdir(parents=True, exist_ok=True)
    demonstrations = Demonstrations(environment=ENVIRONMENT, seeds=range(episodes), agents="robot", only_success=True)
    dataset = write_dataset(demonstrations, arguments.out / "demonstrations", dataset_id="d4orm/clone-expert-v0")
    problem = make_problem(**ENVIRONMENT)
    features = Features.of(ObservationLayout.for_problem(problem), problem.team.models[0])
    limit = problem.team.control_limits[0]
    robots = list(dataset.iterate_episodes())
    inputs, frames = features.encode(np.concatenate([robot.observations[:-1] for robot in robots]))
    targets = in_own_frame(frames, np.concatenate([robot.actions for robot in robots])) / limit
    network = learn(inputs, np.clip(targets, -1, 1).astype(np.float32), epochs)
    clone = partial(drive, features, network, limit)
    policies = {f"clone of {len(robots)} episodes": clone, "d4orm-c2f": "d4orm-c2f", "goal": "goal"}
    rows = [{"policy": name, "success": f"{success(policy, judged):.0%}"} for name, policy in policies.items()]
    save_table(rows, arguments.out / "clone_expert.csv")


if __name__ == "__main__":
    main()
