"""PPO in a single file on the batched environment, in the manner of CleanRL: copy it and change what you like.

    python -m examples.recipes.cleanrl_ppo

``gymnasium.make_vec`` gives worlds of one joint observation and action each. Here every robot of every world is a row,
and all rows share one small network, so that the same file learns for teams of any size. What a robot does after it has
arrived is left out of the learning.
"""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from examples.common import require, save_table
from examples.recipes.task import WORLD, recipe_arguments, solved

require("rl", "torch")
import torch
from torch import nn
from torch.distributions import Normal

import d4orm_env  # noqa: F401 - its environments are registered by the import
from d4orm_planners.base.adapters import from_torch

WORLDS, HORIZON = 256, 32
GAMMA, LAMBDA, CLIP, EPOCHS, MINIBATCHES = 0.98, 0.95, 0.2, 4, 4
ENTROPY, VALUE, LEARNING_RATE = 1e-3, 0.5, 1e-3


class Agent(nn.Module):
    """Actor and critic of a robot."""

    def __init__(self, inputs: int, outputs: int, width: int = 64) -> None:
        super().__init__()
        self.actor, self.critic = (self._network(inputs, width, size) for size in (outputs, 1))
        with torch.no_grad():
            self.actor[-1].weight.mul_(0.01)
        self.log_std = nn.Parameter(torch.full((outputs,), -0.5))

    @staticmethod
    def _network(inputs: int, width: int, outputs: int) -> nn.Sequential:
        layers = (nn.Linear(inputs, width), nn.Tanh(), nn.Linear(width, width), nn.Tanh(), nn.Linear(width, outputs))
        return nn.Sequential(*layers)

    def actions(self, seen: Any) -> Normal:
        """Their distribution."""
        return Normal(self.actor(seen), self.log_std.exp())

    def value(self, seen: Any) -> Any:
        """``(...,)``."""
        return self.critic(seen)[..., 0]


class Batch(NamedTuple):
    """Batch of experience: each array with the leading axes time and robot."""

    seen: Any
    action: Any
    log_density: Any
    value: Any
    reward: Any
    done: Any
    acted: Any


class Robots:
    """The robots of all worlds, one row each."""

    def __init__(self, num_robots: int, seed: int) -> None:
        self.env = gymnasium.make_vec(
            "d4orm/Navigation-v0", num_envs=WORLDS, vectorization_mode="vector_entry_point", scenario="random",
            num_robots=num_robots, autoreset_mode="SameStep", num_instances=512, **WORLD,
        )  # fmt: skip
        observations, infos = self.env.reset(seed=seed)
        self.num_actions = self.env.single_action_space.shape[0] // num_robots
        self.num_robots, self.acting = num_robots, ~infos["arrived"]
        self.seen = self._rows(observations)

    def _rows(self, observations: np.ndarray) -> Any:
        return torch.as_tensor(observations.reshape(WORLDS * self.num_robots, -1))

    def step(self, actions: Any) -> tuple[Any, Any, Any, list[bool]]:
        """Rewards, whether episodes of robots ended and whether they acted ``(rows,)``; how worlds that ended did."""
        observations, _, terminated, truncated, infos = self.env.step(actions.numpy().reshape(WORLDS, -1))
        acted, ended = self.acting, terminated | truncated
        arrived, successes = infos["arrived"], []
        if ended.any():
            final = infos["final_info"]
            arrived = np.where(ended[:, None], final["arrived"], arrived)
            successes = final["metrics"]["success"][ended].astype(bool).tolist()
        rewards = self.env.unwrapped.robot_rewards * acted
        done = (arrived | ended[:, None]) & acted
        self.acting = (acted & ~arrived) | ended[:, None]
        self.seen = self._rows(observations)
        flat = [torch.as_tensor(np.float32(values)).reshape(-1) for values in (rewards, done, acted)]
        return (*flat, successes)


def collect(robots: Robots, agent: Agent) -> tuple[Batch, list[bool]]:
    moments, successes = [], []
    for _ in range(HORIZON):
        seen = robots.seen
        with torch.no_grad():
            distribution, value = agent.actions(seen), agent.value(seen)
            action = distribution.sample()
        reward, done, acted, ended = robots.step(action)
        moments.append((seen, action, distribution.log_prob(action).sum(-1), value, reward, done, acted))
        successes += ended
    return Batch(*(torch.stack(values) for values in zip(*moments, strict=True))), successes


def advantages(batch: Batch, last: Any) -> Any:
    """Generalised advantage estimates (Schulman et al., 2016), ``(T, rows)``; running out of time counts as an end."""
    advantage, following, found = torch.zeros_like(last), last, []
    for step in reversed(range(HORIZON)):
        going_on = 1 - batch.done[step]
        error = batch.reward[step] + GAMMA * following * going_on - batch.value[step]
        advantage = error + GAMMA * LAMBDA * going_on * advantage
        following = batch.value[step]
        found.append(advantage)
    return torch.stack(found[::-1])


def update(agent: Agent, optimizer: Any, batch: Batch, advantage: Any) -> None:
    """The clipped objective (Schulman et al., 2017), over the moments in which a robot acted."""
    acted = batch.acted.bool()
    seen, action, before = batch.seen[acted], batch.action[acted], batch.log_density[acted]
    gains, target = advantage[acted], (advantage + batch.value)[acted]
    for _ in range(EPOCHS):
        for part in torch.randperm(len(seen)).chunk(MINIBATCHES):
            scaled = (gains[part] - gains[part].mean()) / (gains[part].std() + 1e-8)
            ratio = (agent.actions(seen[part]).log_prob(action[part]).sum(-1) - before[part]).exp()
            gain = torch.minimum(ratio * scaled, ratio.clamp(1 - CLIP, 1 + CLIP) * scaled).mean()
            error = (agent.value(seen[part]) - target[part]).square().mean()
            loss = VALUE * error - gain - ENTROPY * agent.log_std.sum()
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(agent.parameters(), 0.5)
            optimizer.step()


def main() -> None:
    arguments = recipe_arguments(__doc__, "--updates", 100, "of 8192 steps of teams each")
    updates, parts = (42, 7) if arguments.quick else (arguments.updates, 10)
    torch.manual_seed(0)
    torch.set_num_threads(1)  # the layers are too small to be shared
    robots = Robots(arguments.num_robots, seed=0)
    agent = Agent(robots.seen.shape[1], robots.num_actions)
    optimizer = torch.optim.Adam(agent.parameters(), lr=LEARNING_RATE, eps=1e-5)
    rows, begin, done = [], time.perf_counter(), 0
    for part in np.array_split(np.arange(updates), parts):
        successes: list[bool] = []
        for _ in part:
            batch, ended = collect(robots, agent)
            with torch.no_grad():
                last = agent.value(robots.seen)
            update(agent, optimizer, batch, advantages(batch, last))
            successes += ended
            done += batch.reward.numel()
        rows.append({"robot-steps": done, "episodes": len(successes), "success": f"{np.mean(successes or [0]):.0%}"})
        print(f"{done} robot-steps, {time.perf_counter() - begin:.0f} s: success {rows[-1]['success']}", flush=True)
    robots.env.close()
    print(solved(from_torch(agent.actor, egocentric=True), arguments))
    save_table(rows, arguments.out / "cleanrl_ppo.csv")


if __name__ == "__main__":
    main()
