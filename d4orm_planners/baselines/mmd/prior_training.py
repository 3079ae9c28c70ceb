"""Training of the diffusion model, from single-robot plans to a file of weights.

python -m d4orm_planners.baselines.mmd.prior_training --out weights.npz
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from d4orm_env.core.files import replaced_when_done
from d4orm_planners.baselines.mmd.path_frame import FEATURES
from d4orm_planners.baselines.mmd.prior import LEVELS, SIZE, Prior, kept_signal, level_features
from d4orm_planners.baselines.mmd.training_set import Examples, draw_examples

_RESOLUTION = 1000
"""Noise levels that are trained."""
_LEAST = 1e-4
"""Least deviation of a mode or a feature that it is divided by."""


class DenoisingNetwork(nn.Module):
    """The network of :class:`~d4orm_planners.baselines.mmd.prior.Prior`, as torch trains it.

    Args:
        width: Of its layers.
        layers: Hidden ones.
    """

    def __init__(self, width: int, layers: int) -> None:
        super().__init__()
        self.into = nn.Linear(SIZE + LEVELS, width)
        self.context = nn.Linear(FEATURES, width, bias=False)
        self.hidden = nn.ModuleList(nn.Linear(width, width) for _ in range(layers))
        self.out = nn.Linear(width, SIZE)
        nn.init.zeros_(self.out.weight)

    def forward(self, noisy: Tensor, level: Tensor, features: Tensor) -> Tensor:
        """Return what is to be added to ``sqrt(alpha_bar)`` times the noisy motion, over ``sqrt(1 - alpha_bar)``."""
        layer = torch.relu(self.into(torch.cat([noisy, level], dim=1)) + self.context(features))
        for hidden in self.hidden:
            layer = layer + torch.relu(hidden(layer))
        result: Tensor = self.out(layer)
        return result


def train(
    examples: Examples,
    steps: int,
    seed: int,
    width: int = 192,
    layers: int = 3,
    progress: Callable[[int, float], object] = lambda step, loss: None,
) -> Prior:
    """Fit the network to the examples by Adam; the weights are the average of the training's last half.

    Args:
        examples: Training set.
        steps: Minibatches of 256.
        seed: Of weights, minibatches and noise.
        width: Of the layers.
        layers: Hidden ones.
        progress: Called now and then with the step and the loss.
    """
    torch.manual_seed(seed)
    flat, signal = examples.modes.reshape(len(examples.modes), SIZE), kept_signal(_RESOLUTION)[1:]
    deviation = np.maximum(np.sqrt((flat**2).mean(axis=0)), _LEAST)
    mean, spread = examples.features.mean(axis=0), np.maximum(examples.features.std(axis=0), _LEAST)
    motions, features = torch.tensor(flat / deviation), torch.tensor((examples.features - mean) / spread)
    levels, kept = torch.tensor(level_features(signal)), torch.tensor(signal.astype(np.float32))
    network = DenoisingNetwork(width, layers)
    average = torch.optim.swa_utils.AveragedModel(network)
    optimiser = torch.optim.AdamW(network.parameters(), 1e-3, weight_decay=0.01)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 2e-3, total_steps=steps)
    for step in range(steps):
        chosen, at = torch.randint(len(motions), (256,)), torch.randint(_RESOLUTION, (256,))
        loss = _loss(network, motions[chosen], kept[at, None], levels[at], features[chosen])
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
        if step >= steps // 2:
            average.update_parameters(network)
        if step % 100 == 0:
            progress(step, float(loss.detach()))
    network.load_state_dict(average.module.state_dict())
    return _weights(network, deviation, mean, spread)


def _loss(network: DenoisingNetwork, clean: Tensor, share: Tensor, level: Tensor, features: Tensor) -> Any:
    """Mean square error for motions of which that share of the variance is kept as noise is added."""
    noisy = share.sqrt() * clean + (1 - share).sqrt() * torch.randn(clean.shape)
    wanted = (clean - share.sqrt() * noisy) / (1 - share).sqrt()
    return ((network(noisy, level, features) - wanted) ** 2).mean()


def _weights(network: DenoisingNetwork, deviation: np.ndarray, mean: np.ndarray, spread: np.ndarray) -> Prior:
    """The network's weights as the planner reads them: what is multiplied from the left, first."""
    linear = [network.into, *network.hidden, network.out]
    into, *hidden, out = (layer.weight.detach().numpy().T for layer in linear)
    into_bias, *hidden_bias, out_bias = (layer.bias.detach().numpy() for layer in linear)
    context = network.context.weight.detach().numpy().T
    arrays = (deviation, mean, spread, into, context, into_bias, np.stack(hidden), np.stack(hidden_bias), out, out_bias)
    return Prior(*(np.ascontiguousarray(array, np.float32) for array in arrays))


def save_prior(prior: Prior, path: Path) -> None:
    """Write a model into an ``.npz`` file, which is whole or not there."""
    with replaced_when_done(path, (".npz",)) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **prior._asdict())


def main() -> None:
    """Draw examples, train and write the weights."""
    parser = argparse.ArgumentParser(description="Train MMD's diffusion model on plans of single robots.")
    parser.add_argument("--examples", type=int, default=3772, help="two per plan")
    parser.add_argument("--steps", type=int, default=6000, help="minibatches")
    parser.add_argument("--seed", type=int, default=100_000, help="of maps, plans and training")
    parser.add_argument("--out", type=Path, default=Path("weights.npz"), help="file to write")
    given = parser.parse_args()

    def drawn(done: int) -> None:
        if done % 400 == 0:
            print(f"{done} examples", flush=True)  # noqa: T201

    def trained(step: int, loss: float) -> None:
        if step % 500 == 0:
            print(f"step {step}: loss {loss:.3f}", flush=True)  # noqa: T201

    prior = train(draw_examples(given.examples, given.seed, drawn), given.steps, given.seed, progress=trained)
    save_prior(prior, given.out)


if __name__ == "__main__":
    main()
