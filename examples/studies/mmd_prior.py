"""Train MMD's diffusion model on plans of single robots among obstacles that it does not observe.

    python -m examples.studies mmd_prior --out weights.npz

The weights that come with the package are of the defaults. Needs ``pip install -e '.[rl]'``.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from d4orm_env.core.arrays import FloatArray, Floats
from d4orm_env.core.files import replaced_when_done
from d4orm_env.core.problem import Problem
from d4orm_env.scenarios import make_problem
from d4orm_planners.base.planner_registry import make_planner
from d4orm_planners.baselines.mmd.path_frame import FEATURES, POINTS, PathFrame, make_frame, sine_table, world_space
from d4orm_planners.baselines.mmd.prior import LEVELS, SIZE, Prior, kept_signal, level_features

KINDS: tuple[tuple[str, dict[str, object]], ...] = (
    ("random", {"size": 5.0}),
    ("random", {"size": 8.0, "num_obstacles": 6}),
    ("rooms", {}),
    ("warehouse", {}),
    ("forest", {}),
    ("corridor", {}),
)
"""Scenarios and their settings that maps are drawn from, in turn."""
PLANNERS = ("mapf", "hybrid")
"""Planners whose plans are learned from, in turn."""
_PHANTOMS = 3
"""Most circles near the path that a plan has to go round and the model is not told of."""
_SIZES, _ASIDE = (0.1, 0.45), 0.5
"""Radius of these, and distance from the path at most [m]."""
_LONGEST = 1.4
"""Times the length of the path that a plan may be; a longer one leads elsewhere."""
_PER_MAP = 4
_FINENESS = 16
"""Places per point at which the path is compared with a plan."""


_RESOLUTION = 1000
"""Noise levels that are trained."""
_LEAST = 1e-4
"""Least deviation of a mode or a feature that it is divided by."""


class Examples(NamedTuple):
    """Motions and what the model is told of them."""

    features: FloatArray  #: ``(E, FEATURES)`` float32
    modes: FloatArray  #: ``(E, 2, MODES)`` float32 differences from the path, ahead and aside, in lengths of the path


def draw_examples(count: int, seed: int, progress: Callable[[int], object] = lambda done: None) -> Examples:
    """Plan for single robots until there are so many examples; every plan gives two, one the mirror image of the other.

    Args:
        count: Examples, at least.
        seed: Non-negative; maps are drawn from it on.
        progress: Called with the examples that there are.
    """
    features: list[FloatArray] = []
    modes: list[FloatArray] = []
    for frame, positions in islice(_motions(seed), -(-count // 2)):
        ahead, aside = modes_of(frame, positions).astype(np.float32)
        features.extend(frame.features)
        modes += [np.stack([ahead, aside]), np.stack([ahead, -aside])]
        progress(len(modes))
    return Examples(np.stack(features), np.stack(modes))


def modes_of(frame: PathFrame, positions: Floats) -> Floats:
    """``(2, MODES)`` of planar positions ``(POINTS + 1, 3)``: how far ahead on the way they are, and to its left."""
    fine = np.linspace(0, POINTS, _FINENESS * POINTS + 1)
    path, tangents = (
        np.column_stack([np.interp(fine, np.arange(POINTS + 1), rows[:, axis]) for axis in range(2)])
        for rows in (frame.reference, frame.tangents)
    )
    nearest, at = np.zeros(POINTS + 1, int), 0
    for i, position in enumerate(positions[:, :2]):
        # Paths may come near to themselves: only what lies next on them counts.
        ahead = path[at : at + _FINENESS * POINTS // 8]
        at += int(((ahead - position) ** 2).sum(axis=1).argmin())
        nearest[i] = at
    offset = positions[:, :2] - path[nearest]
    aside = (offset[:, 1] * tangents[nearest, 0] - offset[:, 0] * tangents[nearest, 1]) / frame.length
    differences = np.stack([fine[nearest] / POINTS - np.arange(POINTS + 1) / POINTS, aside])
    # A plan ends within the goal's radius, and a motion at the goal.
    differences -= differences[:, -1:] * (np.arange(POINTS + 1) / POINTS)
    return 2 / POINTS * differences @ sine_table()


def _motions(seed: int) -> Iterator[tuple[PathFrame, Floats]]:
    """Frames and ``(POINTS + 1, 3)`` positions at equal times from start to arrival."""
    random, number = np.random.default_rng(seed), seed
    while True:
        kind, settings = KINDS[number % len(KINDS)]
        problem = make_problem(kind, num_robots=1, seed=number, **settings)
        number += 1
        frame = make_frame(problem, 0, world_space(problem), np.zeros(3))
        if frame is None or frame.length < 2 * problem.goal_radius:
            continue
        for attempt in range(_PER_MAP):
            hindered = _with_phantoms(problem, frame, random, attempt)
            if hindered is None:
                continue
            planner = make_planner(PLANNERS[(number + attempt) % len(PLANNERS)], engine="cpu")
            plan = planner.solve(hindered, seed=number, max_iterations=8)
            positions = _evenly(plan.trajectory.positions[:, 0], int(plan.trajectory.arrived[:, 0].argmax()))
            if plan.solved and np.linalg.norm(np.diff(positions, axis=0), axis=1).sum() < _LONGEST * frame.length:
                yield frame, positions


def _with_phantoms(problem: Problem, frame: PathFrame, random: np.random.Generator, number: int) -> Problem | None:
    """The problem with so many circles near its path; ``None`` if they leave no path."""
    number = min(number, _PHANTOMS)
    at = frame.reference[random.integers(0, POINTS + 1, number), :2]
    circles = np.column_stack(
        [at + random.uniform(-_ASIDE, _ASIDE, (number, 2)), random.uniform(*_SIZES, number)]
    ).astype(np.float32)
    ends = np.stack([problem.start[0, :2], problem.goal[0]])
    gaps = np.linalg.norm(circles[:, None, :2] - ends, axis=2) - circles[:, 2:]
    circles = circles[(gaps > frame.safety_distance + problem.goal_radius).all(axis=1)]
    if len(circles) == 0 < number:
        return None
    world = problem.world
    hindered = problem.replace(world=world.replace(circles=np.concatenate([world.circles, circles])))
    return hindered if np.isfinite(hindered.shortest_paths.length).all() else None


def _evenly(positions: FloatArray, arrival: int) -> Floats:
    """``(POINTS + 1, 3)`` positions of a robot at equal times, interpolated."""
    times = np.linspace(0, arrival, POINTS + 1)
    points = np.zeros((POINTS + 1, 3))
    for axis in range(2):
        points[:, axis] = np.interp(times, np.arange(arrival + 1), positions[: arrival + 1, axis])
    return points


class DenoisingNetwork(nn.Module):
    """The network of :class:`~d4orm_planners.baselines.mmd.prior.Prior`, as torch trains it."""

    def __init__(self, width: int, layers: int) -> None:
        super().__init__()
        self.into = nn.Linear(SIZE + LEVELS, width)
        self.context = nn.Linear(FEATURES, width, bias=False)
        self.hidden = nn.ModuleList(nn.Linear(width, width) for _ in range(layers))
        self.out = nn.Linear(width, SIZE)
        nn.init.zeros_(self.out.weight)

    def forward(self, noisy: Tensor, level: Tensor, features: Tensor) -> Tensor:
        """The term added to ``sqrt(alpha_bar)`` times the noisy motion, over ``sqrt(1 - alpha_bar)``."""
        layer = torch.relu(self.into(torch.cat([noisy, level], dim=1)) + self.context(features))
        for hidden in self.hidden:
            layer = layer + torch.relu(hidden(layer))
        return self.out(layer)


def train(
    examples: Examples,
    steps: int,
    seed: int,
    width: int = 192,
    layers: int = 3,
    progress: Callable[[int, float], object] = lambda step, loss: None,
) -> Prior:
    """Fit the network to the examples by Adam; the weights are the average of the training's last half."""
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
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--examples", type=int, default=3772, help="two per plan")
    parser.add_argument("--steps", type=int, default=6000, help="minibatches")
    parser.add_argument("--seed", type=int, default=100_000, help="of maps, plans and training")
    parser.add_argument("--out", type=Path, default=Path("weights.npz"), help="file to write")
    given = parser.parse_args()

    def drawn(done: int) -> None:
        if done % 400 == 0:
            print(f"{done} examples", flush=True)

    def trained(step: int, loss: float) -> None:
        if step % 500 == 0:
            print(f"step {step}: loss {loss:.3f}", flush=True)

    prior = train(draw_examples(given.examples, given.seed, drawn), given.steps, given.seed, progress=trained)
    save_prior(prior, given.out)
