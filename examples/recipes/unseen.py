"""Success of what a recipe has learned, on instances that it has not seen."""

from __future__ import annotations

import argparse
import time

from d4orm_env import navigation_v0
from d4orm_planners import Policy, run_episode

SEEDS = range(50_000, 50_100)
"""Of the instances; those of the trainings are drawn from small ones."""


def solved(policy: Policy, arguments: argparse.Namespace) -> str:
    """Return a line on how many random instances a policy solves, and the processor time until now.

    The environment is the default one: robots must slow down to arrive, for which egocentric policies brake.
    """
    seconds = time.process_time()
    env = navigation_v0.parallel_env("random", num_robots=arguments.num_robots)
    seeds = SEEDS[:5] if arguments.quick else SEEDS
    successes = sum(run_episode(env, policy, seed=seed).metrics["success"] for seed in seeds)
    return f"solves {successes:.0f} of {len(seeds)} unseen instances, after {seconds / 60:.1f} minutes of a processor"
