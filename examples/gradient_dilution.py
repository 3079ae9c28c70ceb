"""How the team's common reward drowns each robot's signal, and what a reward of its own changes.

    python examples/gradient_dilution.py --seeds 3

One iteration of the paper's denoising (1024 samples, 100 steps) for teams of 1 to 64 robots that cross a circle. Robots
do not see each other, so every robot has the same easy task whatever the size of the team. Weighted by the team's mean
reward, a sample's weight says less and less about any one robot as the team grows; weighted by each robot's own reward
(credit assignment) it says as much as with one.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from outputs import COLOURS, argument_parser, count, plt, save_figure, save_table

from d4orm_env import Problem, make_problem
from d4orm_env.engine.base import SamplingRules, SamplingTask
from d4orm_env.engine.choice import get_engine
from d4orm_planners.sampling.schedule import annealed
from d4orm_planners.sampling.weights import SoftmaxWeights

CREDITS = {"team": "team reward (the paper)", "robot": "each robot's own reward"}


def crossing(num_robots: int) -> Problem:
    """Robots on a circle of 5 m, small enough that 64 of them stand on it without touching."""
    return make_problem("circle", num_robots=num_robots, diameter=5.0, radius=0.02, margin=0.01)


def reward_after_one_iteration(
    problem: Problem, credit: str, num_samples: int, num_steps: int, seed: int
) -> tuple[float, float]:
    """Mean of ``1 - distance / initial distance`` over robots and time, and the share of robots that arrive."""
    engine = get_engine("cpu")
    base = np.zeros((problem.horizon, problem.num_robots, problem.control_size), np.float32)
    task = SamplingTask(problem, base, collisions=False, credit=credit)
    rules = SamplingRules(weights=SoftmaxWeights(temperature=0.3))
    result = engine.denoise(task, rules, base, annealed(num_steps, 1e-4, 2e-2), num_samples, seed)
    trajectory = engine.rollout(problem, result.mean)
    distance = np.linalg.norm(trajectory.positions - problem.goal, axis=-1)
    # Not trajectory.rewards, which count the collisions that this study leaves out.
    return float((1 - distance[1:] / distance[0]).mean()), float(trajectory.arrived[-1].mean())


def draw(sizes: list[int], rewards: dict[str, np.ndarray], out: Any) -> None:
    """Reward against the number of robots, mean and range over seeds."""
    figure, axes = plt.subplots(figsize=(5, 3.4), layout="constrained")
    for credit, colour in (("team", COLOURS["mppi"]), ("robot", COLOURS["d4orm"])):
        values = rewards[credit]
        axes.plot(sizes, values.mean(axis=1), "o-", color=colour, label=CREDITS[credit])
        axes.fill_between(sizes, values.min(axis=1), values.max(axis=1), color=colour, alpha=0.2, linewidth=0)
    axes.set_xscale("log", base=2)
    axes.set_xticks(sizes, [str(size) for size in sizes])
    axes.set(xlabel="robots", ylabel="reward after one iteration")
    axes.set_title("Samples weighted by")
    axes.legend()
    save_figure(figure, out / "gradient_dilution.png")


def main() -> None:
    """Run every team size, credit and seed, and write the table and the plot."""
    parser = argument_parser(__doc__)
    parser.add_argument("--seeds", type=count, default=3)
    arguments = parser.parse_args()
    sizes, seeds, num_samples, num_steps = [1, 2, 4, 8, 16, 32, 64], arguments.seeds, 1024, 100
    if arguments.quick:
        sizes, seeds, num_samples, num_steps = [1, 64], 1, 256, 20
    rewards = {credit: np.zeros((len(sizes), seeds)) for credit in CREDITS}
    rows = []
    for index, size in enumerate(sizes):
        row: dict[str, Any] = {"robots": size}
        for credit in CREDITS:
            runs = np.array(
                [
                    reward_after_one_iteration(crossing(size), credit, num_samples, num_steps, seed)
                    for seed in range(seeds)
                ]
            )
            rewards[credit][index] = runs[:, 0]
            row[f"{credit} credit: reward"] = f"{runs[:, 0].mean():.3f}"
            row[f"{credit} credit: arrived"] = f"{runs[:, 1].mean():.0%}"
        rows.append(row)
        print(row, flush=True)
    save_table(rows, arguments.out / "gradient_dilution.csv")
    draw(sizes, rewards, arguments.out)


if __name__ == "__main__":
    main()
