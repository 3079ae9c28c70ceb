"""One seed, one plan, on every processor: this one's plans, and what its kernels are made of."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from d4orm_env import make_problem, rollout
from d4orm_env.engine import cpu
from d4orm_env.paths import lattice, looking, wavefront
from d4orm_planners.baselines.alternation import alternate
from d4orm_planners.engine import path_index, weighting
from d4orm_planners.engine import score as sampling
from d4orm_planners.engine.weighting import softmax_weights
from d4orm_planners.hybrid.compile_ahead import sample_once
from d4orm_planners.mapf.beam_search import search_kernel
from d4orm_planners.tracking.tracker import straight_kernel

PORTABILITY = Path(__file__).parents[1] / "portability"
sys.path.insert(0, str(PORTABILITY))
import plans  # noqa: E402

DIGESTS = json.loads((PORTABILITY / "digests.json").read_text())

ESTIMATE = re.compile(r"\bv?(rsqrt|rcp)(14|28)?[ps][sdh]\b|\bfr(sqrt|ecp)[esx]\b")
FUSED = re.compile(r"\bvf(n?m(add|sub)|msubadd|maddsub)\w*|\bfn?m(add|sub|la|ls)\b")
MASKED_STORE = re.compile(r"\bvp?maskmov(ps|d)\s+%ymm\d+, %ymm\d+, ")
ROOT = re.compile(r"\bv?sqrt[ps]s\b|\bfsqrt\b")


def test_every_case_has_a_digest() -> None:
    assert list(DIGESTS) == list(plans.CASES)
    assert set(plans.QUICK) <= set(plans.CASES)


QUICK = ("d4orm", "hybrid", "mppi")


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name in QUICK else pytest.mark.slow) for name in plans.CASES]
)
def test_plans_are_the_same_here_as_everywhere(name: str) -> None:
    assert plans.digest(plans.CASES[name]) == DIGESTS[name]


def kernels() -> Iterator[tuple[str, Any]]:
    """Kernels of the CPU engine by name, each called at least once."""
    problem = make_problem("circle", num_robots=2, seed=0)
    plans.digest(plans.CASES["mppi"])
    plans.digest(plans.CASES["amswarm"])
    rollout(problem, np.zeros((problem.horizon, 2, 2), np.float32), engine="cpu")
    softmax_weights(np.zeros((1, 4)), 1.0, 0.0)
    make_problem("four_obstacles").check_reachable()
    yield "score", sampling.score_kernel(("differential_drive",))
    yield "average", weighting.average_noise
    yield "project", weighting.project_noise
    yield "softmax", weighting._softmax
    yield "spread", wavefront._spread
    yield "look", looking.look
    yield "settle", lattice.settle_nodes
    yield "drive", straight_kernel("differential_drive")
    yield "search", search_kernel("differential_drive")
    yield "meetings", path_index._count_meetings
    yield "alternate", alternate
    yield "roll out", cpu.roll_out_of(("holonomic2d",))


@pytest.mark.slow
def test_kernels_estimate_nothing_and_fuse_nothing() -> None:
    plans.digest(plans.CASES["differential drives"])
    sample_once((("differential_drive",) * 2,))
    rooted = 0
    for name, kernel in kernels():
        # Kernels that come from the cache do not show their assembly; but they have been optimised, so this is it.
        library = kernel.overloads[kernel.signatures[0]].library
        assembly = str(library.codegen._tm.emit_assembly(library._get_module_for_linking()))
        for pattern in (ESTIMATE, FUSED):
            found = pattern.search(assembly)
            assert found is None, f"kernel {name} has the instruction {found and found.group()}"
        # Those of AVX2 take long on AMD's processors, see docs/background/performance.md.
        assert name != "score" or MASKED_STORE.search(assembly) is None
        rooted += ROOT.search(assembly) is not None
    assert rooted >= 3  # the patterns match what the assembler writes on this processor
