"""Learning curve: success of a policy in training on instances that it is not trained on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from d4orm_env.core.files import replaced_when_done
from d4orm_env.core.lazy import LazyModule
from d4orm_env.render.style import own_style
from d4orm_planners.evaluation.tables import write_csv
from d4orm_planners.rl.network import Network
from d4orm_planners.rl.robot_vec_env import RobotVecEnv
from d4orm_planners.rl.task_mixture import MixedVecEnv

backend_agg: Any = LazyModule("matplotlib.backends.backend_agg")
figures: Any = LazyModule("matplotlib.figure")


class Outcome(NamedTuple):
    """Success rate, mean travel time [s], and the success rates of the parts of a mixture."""

    success_rate: float
    travel_time: float
    parts: list[float]


@dataclass(frozen=True)
class Evaluation:
    """A point of the curve.

    Attributes:
        steps: Robot-steps trained, or in an imitation, learned from.
        num_robots: Size of the team trained last.
        scenario: Scenario trained last.
        success_rate: Share of the validation episodes in which all arrived and none ever touched anything.
        travel_time: Their mean arrival time [s], with the whole episode for robots that did not arrive.
        seconds: Time that the stage took.
        env_share: Share of it that went into the environments, instances that are drawn included; in an imitation, into
            recording.
        imitation_error: Root mean square of the actions less those of the expert, in units of the limits, in episodes
            that were not learned from; ``None`` without an expert.
        parts: Success rates of the parts of a mixture, in their order, of which ``success_rate`` is the mean.
    """

    steps: int
    num_robots: int
    scenario: str
    success_rate: float
    travel_time: float
    seconds: float
    env_share: float
    imitation_error: float | None = None
    parts: Sequence[float] | None = None

    @property
    def rank(self) -> tuple[float, float]:
        """Larger is better."""
        return self.success_rate, -self.travel_time


def evaluate_network(network: Network, worlds: RobotVecEnv | MixedVecEnv, seed: int) -> Outcome:
    """Run one episode in each world, without exploring; of a mixture, the mean of its parts."""
    parts = worlds.parts if isinstance(worlds, MixedVecEnv) else (worlds,)
    means = [np.mean(run_worlds(network, part, seed), axis=0) for part in parts]
    success, travel_time = (float(np.mean(values)) for values in zip(*means))
    return Outcome(success, travel_time, [float(mean[0]) for mean in means])


def run_worlds(network: Network, worlds: RobotVecEnv, seed: int) -> list[tuple[bool, float]]:
    """``(success, travel time)`` of the first episode of every world, in the order in which they end."""
    worlds.seed(seed)
    features = worlds.reset()
    pending = np.ones(worlds.num_worlds, np.bool_)
    outcomes = []
    while pending.any():
        worlds.step_async(network(features))
        features, *_ = worlds.step_wait()
        outcomes += [(success, travel) for world, success, travel in worlds.finished if pending[world]]
        pending[[world for world, *_ in worlds.finished]] = False
    return outcomes


def write_curve(folder: Path, evaluations: Sequence[Evaluation]) -> None:
    """Write ``curve.csv`` and ``curve.png``."""
    write_csv(folder / "curve.csv", [vars(evaluation) for evaluation in evaluations])
    with replaced_when_done(folder / "curve.png") as temporary:
        _draw(temporary, evaluations)


@own_style()
def _draw(path: Path, evaluations: Sequence[Evaluation]) -> None:
    figure = figures.Figure(figsize=(7, 3), layout="constrained")
    backend_agg.FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    steps = [evaluation.steps / 1e6 for evaluation in evaluations]
    left.plot(steps, [100 * evaluation.success_rate for evaluation in evaluations])
    left.set(xlabel="robot-steps [million]", ylabel="success [%]", ylim=(0, 100))
    right.plot(steps, [evaluation.travel_time for evaluation in evaluations], color="tab:orange")
    right.set(xlabel="robot-steps [million]", ylabel="travel time [s]")
    for axes in (left, right):
        axes.grid(alpha=0.3)
    figure.savefig(path, dpi=120)
