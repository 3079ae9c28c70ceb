"""Streams of random numbers: one seed, one purpose and one use never share their numbers with another."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
import pytest
from planner_support import hop_problem

from d4orm_env import navigation_v0
from d4orm_env.core.seeds import Stream, derived_seed, generator
from d4orm_env.scenarios.settings import Settings
from d4orm_planners import make_policy, run_episode
from d4orm_planners.base.planner_registry import make_planner
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.d_d4orm.node import node_seed
from d4orm_planners.engine.cpu_sampling import CpuSamplingEngine

SEEDS = (0, 1, 2, 3, 2**31, 2**32, 2**32 + 1, 2**63 - 1, 2**64)
NUMBERS = (0, 1, 2, 17, 1000, 1001, 1 << 16, 10**6, 1_000_003)


def test_no_two_streams_have_a_seed_in_common() -> None:
    once = {derived_seed(seed, stream, n) for seed, stream, n in product(SEEDS, Stream, NUMBERS)}
    twice = {derived_seed(seed, stream, i, n) for seed, stream, i, n in product(SEEDS, Stream, NUMBERS[:5], NUMBERS)}
    assert len(once | twice) == len(SEEDS) * len(Stream) * len(NUMBERS) * (1 + 5)
    assert not (once | twice) & set(SEEDS)


def test_no_two_searches_have_a_seed_in_common() -> None:
    problem, planner = hop_problem(1), make_planner("d4orm", engine="cpu")
    seeds: list[int] = []
    for solve, node in product(range(4), range(4)):
        search = SolveRun(planner, problem, node_seed(solve, node), None)
        for search.iteration in range(6):
            seeds += [search.iteration_seed(stream, number) for stream in Stream for number in range(4)]
    assert len(set(seeds)) == len(seeds)


def test_generators_of_streams_scenarios_and_environments_differ() -> None:
    draws = [generator(seed, stream).random() for seed in range(50) for stream in Stream]
    draws += [Settings("circle", seed=seed).generator(purpose).random() for seed in range(50) for purpose in range(3)]
    assert len(set(draws)) == len(draws)
    assert not {np.random.default_rng(seed).random() for seed in range(50)} & set(draws[: 50 * len(Stream)])


def seeds_of_an_episode(seed: int, monkeypatch: pytest.MonkeyPatch, **settings: Any) -> list[int]:
    """What the engine was given in an episode of D4orm-C2F."""
    denoise, used = CpuSamplingEngine.denoise, []

    def recorded(engine: Any, *arguments: Any) -> Any:
        used.append(arguments[5])
        return denoise(engine, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(CpuSamplingEngine, "denoise", recorded)
        policy = make_policy(
            "d4orm-c2f", engine="cpu", coarse_samples=32, coarse_steps=3, num_samples=16, num_steps=2, **settings
        )
        run_episode(navigation_v0.parallel_env(problem=hop_problem(2)), policy, seed=seed)
    return used


def test_control_loops_of_neighbouring_seeds_share_no_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    # A loop's seed was once the episode's plus a multiple of its step, and a coarse plan's the episode's plus its step.
    episodes = [
        seeds_of_an_episode(seed, monkeypatch, refine="sync", refine_every=1, replan_distance=0.5, patience=2)
        for seed in (0, 1, 2, 7919)
    ]
    used = [seed for episode in episodes for seed in episode]
    assert min(map(len, episodes)) > 10
    assert len(set(used)) == len(used)


def test_repairs_of_one_iteration_start_apart() -> None:
    search = SolveRun(make_planner("d4orm-d", engine="cpu", random_start=True), hop_problem(2), 0, None)
    base = np.zeros((30, 2, 2), np.float32)
    starts = [search.planner.start(search, base, search.problem.team, number) for number in range(3)]
    assert not any(np.allclose(a, b) for a, b in ((starts[0], starts[1]), (starts[1], starts[2])))


def test_streams_keep_their_numbers() -> None:
    names = """
        SAMPLES DEFORMATION_START REPAIR REPAIR_ORDER DETOURS CHOICE NODE PERTURBATION COARSE_PLAN REFINEMENT
        CONTROL_LOOP CONTROLLER_NOISE RANDOM_CONTROLS PREFERRED_DIRECTION CONTROL_NOISE TRAINING_WORLDS TRAINING
        TAKEOVER GUIDANCE NEIGHBOURHOODS DEMONSTRATIONS TRAINING_INSTANCES GUSTS SHORTENING
    """
    assert {stream.name: stream.value for stream in Stream} == {name: i for i, name in enumerate(names.split())}
