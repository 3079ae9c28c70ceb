"""Independent streams of random numbers from one seed: every purpose has its own, for every seed."""

from __future__ import annotations

from collections.abc import Iterable
from enum import IntEnum

import numpy as np

from d4orm_env.core.arrays import LARGEST_WHOLE, short_repr, whole_number


class Stream(IntEnum):
    """Purposes that random numbers are drawn for. The numbers are part of what a seed means, so append.

    Scenarios draw their instances from ``default_rng([seed, purpose])``, and environments seed themselves as Gymnasium
    has it; neither coincides with any of these.
    """

    SAMPLES = 0  # of an iteration's denoising run, by stage
    DEFORMATION_START = 1  # U_N, by run of the iteration
    REPAIR = 2  # samples of D4orm-D's repairs, by repair of the iteration
    REPAIR_ORDER = 3
    DETOURS = 4  # of D4orm-D, by sweep of the iteration
    CHOICE = 5  # of the plan that a node continues
    NODE = 6  # the seed of a node of D-D4orm
    PERTURBATION = 7  # of IPOPT's warm start
    COARSE_PLAN = 8  # the seeds of D4orm-C2F's solver runs and loops, by step of the episode
    REFINEMENT = 9
    CONTROL_LOOP = 10
    CONTROLLER_NOISE = 11
    RANDOM_CONTROLS = 12
    PREFERRED_DIRECTION = 13  # of ORCA
    CONTROL_NOISE = 14  # of the environment wrapper
    TRAINING_WORLDS = 15  # by stage
    TRAINING = 16  # first weights (0), then exploration and minibatches by stage (from 1)
    TAKEOVER = 17  # the seeds of the plans that a team makes on the way, by takeover
    GUIDANCE = 18  # ties of path finding, by try, and which robots are replanned, by iteration
    NEIGHBOURHOODS = 19  # which robots look for faster paths, and how, by iteration
    DEMONSTRATIONS = 20  # of an expert, by round and episode
    TRAINING_INSTANCES = 21  # by part of the task mixture and number
    GUSTS = 22  # on drones in crazyflow
    SHORTENING = 23  # steps that motions leave out, by iteration


def derived_seed(seed: int, stream: Stream, *key: int) -> int:
    """A 64-bit seed for one purpose, another one for every other seed, stream and key, none of them negative.

    The key tells the uses of a stream apart, as by the iteration; all uses of a stream have keys of one length.
    """
    return int(_sequence(seed, stream, key).generate_state(1, np.uint64)[0])


def generator(seed: int, stream: Stream, *key: int) -> np.random.Generator:
    """Random numbers for one purpose; arguments as for :func:`derived_seed`."""
    return np.random.default_rng(_sequence(seed, stream, key))


def _sequence(seed: int, stream: Stream, key: tuple[int, ...]) -> np.random.SeedSequence:
    # A spawn key is hashed after the seed, filled up to full length: the two cannot be mistaken for each other as the
    # words of a list can, where [5] is [5, 0].
    return np.random.SeedSequence(seed, spawn_key=(int(stream), *key))


def checked_seeds(seeds: Iterable[int]) -> tuple[int, ...]:
    """Seeds of several episodes, each once, at least one, and none larger than files have room for."""
    if isinstance(seeds, bytes) or not isinstance(seeds, Iterable) or getattr(seeds, "ndim", 1) == 0:
        raise ValueError(f"seeds is {short_repr(seeds)}; give the seeds themselves, as range(50)")
    checked = tuple(dict.fromkeys(whole_number(seed, "seed", 0, LARGEST_WHOLE) for seed in seeds))
    if not checked:
        raise ValueError("seeds is empty; give at least one")
    return checked
