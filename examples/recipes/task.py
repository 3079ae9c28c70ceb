"""The task of all recipes, and how well a policy does in it on instances that no training saw."""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Mapping
from types import MappingProxyType

from examples.common import argument_parser, count

from d4orm_env import navigation_v0
from d4orm_env.envs.rewards import TrainingReward
from d4orm_planners import Policy, run_episode

WORLD: Mapping[str, object] = MappingProxyType(
    {"reward": TrainingReward(contact=12), "egocentric": True, "goal_speed": math.inf, "max_cycles": 100}
)
"""Arguments of environments to learn in. With contacts at their default price teams of four stop short of 60%."""

SEEDS = range(50_000, 50_100)
"""Seeds of the unseen instances; those of the trainings are small."""


def recipe_arguments(description: str | None, budget: str, default: int, help: str) -> argparse.Namespace:
    """The arguments of a recipe: those of every program, the team's size, and how long to train."""
    parser = argument_parser(description)
    parser.add_argument("--num-robots", "--robots", type=count, default=4, help="size of the team")
    parser.add_argument(budget, type=count, default=default, help=help)
    return parser.parse_args()


def solved(policy: Policy, arguments: argparse.Namespace) -> str:
    """Return a line on how many random instances a policy solves, and the processor time until now.

    Their world is the default one: robots must slow down to arrive, for which egocentric policies brake.
    """
    seconds = time.process_time()
    env = navigation_v0.parallel_env("random", num_robots=arguments.num_robots)
    seeds = SEEDS[:5] if arguments.quick else SEEDS
    successes = sum(run_episode(env, policy, seed=seed).metrics["success"] for seed in seeds)
    return f"solves {successes:.0f} of {len(seeds)} unseen instances, after {seconds / 60:.1f} minutes of a processor"
