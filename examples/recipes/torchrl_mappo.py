"""MAPPO with TorchRL: robots share a policy of what each sees, and learn by a critic that sees what all see.

    python -m examples.recipes.torchrl_mappo

``TorchRLNavigation`` steps all worlds in one compiled call. An episode is the team's, and a robot's own ends when it
arrives: that is what the per-robot ``done`` is made of here, and robots that stand at their goals are left out of the
loss. With TorchRL's own ``PettingZooWrapper`` give ``use_mask=True, done_on_any=False``: by its default the first robot
that arrives ends the episode for all, and no other ever learns to.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from examples.common import require, save_table
from examples.recipes.task import WORLD, recipe_arguments, solved

require("rl", "torchrl")
import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torchrl.envs.utils import set_exploration_type
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from d4orm_env.integrations.torchrl import TorchRLNavigation
from d4orm_planners.base.adapters import from_torchrl

WORLDS, HORIZON = 256, 32
GAMMA, LAMBDA, CLIP, EPOCHS, MINIBATCHES, LEARNING_RATE = 0.98, 0.95, 0.2, 4, 4, 1e-3
SEEN, ACTION, REWARD, VALUE = (("robots", name) for name in ("observation", "action", "reward", "state_value"))


class OwnAndAll(torch.nn.Module):
    """What each sees, and after it what all see: of that alone, a shared critic gives all robots one value."""

    def forward(self, seen: torch.Tensor) -> torch.Tensor:
        """``(..., K, D)`` to ``(..., K, D + K * D)``."""
        everything = seen.flatten(-2).unsqueeze(-2).expand(*seen.shape[:-1], -1)
        return torch.cat([seen, everything], -1)


def make_critic(env: TorchRLNavigation) -> TensorDictModule:
    """Return the robots' critic, one network."""
    robots, size = env.observation_spec[SEEN].shape[-2:]
    network = MLP((1 + robots) * size, 1, depth=2, num_cells=64, activation_class=torch.nn.Tanh)
    return TensorDictModule(torch.nn.Sequential(OwnAndAll(), network), [SEEN], [VALUE])


def make_actor(env: TorchRLNavigation) -> ProbabilisticActor:
    """Return the robots' actor, one network for any number of them, of what each sees."""
    inputs, outputs = env.observation_spec[SEEN].shape[-1], env.action_spec[ACTION].shape[-1]
    parameters = [("robots", "loc"), ("robots", "scale")]
    network = MLP(inputs, 2 * outputs, depth=2, num_cells=64, activation_class=torch.nn.Tanh)
    means = torch.nn.Sequential(network, NormalParamExtractor())
    return ProbabilisticActor(
        TensorDictModule(means, [SEEN], parameters), in_keys=parameters,
        out_keys=[ACTION], distribution_class=TanhNormal, return_log_prob=True, log_prob_key=("robots", "log_density"),
    )  # fmt: skip


def collect(env: TorchRLNavigation, actor: ProbabilisticActor, state: Any) -> tuple[Any, Any]:
    """Some steps ``(worlds, T)``, and where they lead."""
    moments = []
    with torch.no_grad(), set_exploration_type("RANDOM"):
        for _ in range(HORIZON):
            moment, state = env.step_and_maybe_reset(actor(state))
            moments.append(moment)
    data = torch.stack(moments, dim=1)
    over = data["next", "done"].unsqueeze(-2)
    data["next", "robots", "done"] = over | ~data["next", "robots", "info", "acting"]
    data["next", "robots", "terminated"] = data["next", "robots", "done"]  # running out of time counts as an end
    return data, state


def with_advantages(data: Any, advantages: GAE) -> Any:
    """The steps with advantages of mean zero and variance one over the robots that acted, zero for others."""
    with torch.no_grad():
        advantages(data)
    acting = data["robots", "info", "acting"]
    gains = data["advantage"]
    gains = (gains - gains[acting].mean()) / (gains[acting].std() + 1e-8)
    data["advantage"] = torch.where(acting, gains, 0)
    data["value_target"] = torch.where(acting, data["value_target"], data[VALUE])
    return data.reshape(-1)


def main() -> None:
    arguments = recipe_arguments(__doc__, "--updates", 100, "of 8192 steps of teams each")
    updates, parts = (42, 7) if arguments.quick else (arguments.updates, 10)
    torch.manual_seed(0)
    torch.set_num_threads(1)  # the layers are too small to be shared
    env = TorchRLNavigation(WORLDS, "random", arguments.num_robots, seed=0, num_instances=512, **WORLD)
    state = env.reset()
    actor = make_actor(env)
    critic = make_critic(env)
    loss = ClipPPOLoss(actor, critic, clip_epsilon=CLIP, entropy_coeff=1e-3, loss_critic_type="l2")
    names = {"done": ("robots", "done"), "terminated": ("robots", "terminated")}
    loss.set_keys(action=ACTION, reward=REWARD, value=VALUE, sample_log_prob=("robots", "log_density"), **names)
    advantages = GAE(gamma=GAMMA, lmbda=LAMBDA, value_network=critic)
    advantages.set_keys(reward=REWARD, value=VALUE, **names)
    optimizer = torch.optim.Adam(loss.parameters(), lr=LEARNING_RATE)
    rows, begin, done = [], time.perf_counter(), 0
    for part in np.array_split(np.arange(updates), parts):
        successes: list[Any] = []
        for _ in part:
            data, state = collect(env, actor, state)
            ended = data["next", "done"][..., 0]
            successes += data["next", "robots", "info", "success"][ended][:, 0, 0].tolist()
            done += data["next", *REWARD].numel()
            batch = with_advantages(data, advantages)
            for _ in range(EPOCHS):
                for rows_of in torch.randperm(len(batch)).chunk(MINIBATCHES):
                    terms = loss(batch[rows_of])
                    total = terms["loss_objective"] + terms["loss_critic"] + terms["loss_entropy"]
                    optimizer.zero_grad()
                    total.backward()
                    torch.nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
                    optimizer.step()
        rows.append({"robot-steps": done, "episodes": len(successes), "success": f"{np.mean(successes or [0]):.0%}"})
        print(f"{done} robot-steps, {time.perf_counter() - begin:.0f} s: success {rows[-1]['success']}", flush=True)
    env.close()
    print(solved(from_torchrl(actor, SEEN, ACTION, egocentric=True), arguments))
    save_table(rows, arguments.out / "torchrl_mappo.csv")


if __name__ == "__main__":
    main()
