"""Train a policy by reinforcement for some minutes, and compare it with D4orm-C2F and ORCA under noise.

    python -m examples.train_and_compare

Five million robot-steps with four robots take about five minutes on two cores. Broken off, the script goes on where it
was: the training from its last checkpoint, the comparison after its last trial.
"""

from __future__ import annotations

from examples.common import argument_parser, count, require, save_table

require("orca", "pyrvo")
require("rl", "stable_baselines3", "tensorboard")

from d4orm_planners import evaluate
from d4orm_planners.evaluation import write_robustness
from d4orm_planners.rl.training import TrainingSettings, train


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--num-robots", "--robots", type=count, default=4, help="size of the team")
    parser.add_argument("--steps", type=count, default=5_000_000, help="robot-steps to train")
    parser.add_argument("--trials", type=count, default=20, help="random instances per policy and level of noise")
    arguments = parser.parse_args()
    settings = TrainingSettings(num_robots=arguments.num_robots, steps=arguments.steps, stages=20)
    noise, trials = (0.0, 0.2, 0.5), arguments.trials
    if arguments.quick:
        settings = TrainingSettings(num_robots=2, steps=2048, num_envs=32, stages=2, validation_worlds=4)
        noise, trials = (0.0, 0.5), 2
    result = train(settings, arguments.out / "ppo", progress=report)
    policies = {"ppo": {"path": str(result.policy_path)}, "d4orm-c2f": {"refine": "sync"}, "orca": {}}
    folder = arguments.out / "comparison"
    rates = evaluate(
        policies, "random", out=folder, seeds=range(trials), control_noise_std=noise, num_robots=settings.num_robots
    )
    for path in write_robustness(folder, rates):
        print(f"wrote {path}")
    rows = [
        {
            "policy": rate.policy,
            "control_noise_std": rate.control_noise_std,
            "success": f"{rate.successes} of {rate.trials}",
            "travel time [s]": "" if rate.travel_time is None else f"{rate.travel_time:.2f}",
            "computing [s]": f"{rate.wall_time:.2f}",
        }
        for rate in rates
    ]
    save_table(rows, arguments.out / "train_and_compare.csv")


def report(what: str, done: int, total: int) -> None:
    """Say now and then how far the training is."""
    if done % (total // 20 or 1) < 33_000:
        print(f"{done / total:4.0%}  {what}", flush=True)


if __name__ == "__main__":
    main()
