"""Settings that hold for every test. They must stand before the first import of JAX or matplotlib."""

from __future__ import annotations

import ctypes
import gc
import itertools
import os
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import pytest
from gymnasium.utils import seeding
from hypothesis import settings

# A rank mismatch that JAX would broadcast silently is a bug here, so it is an error in the suite.
os.environ["JAX_NUMPY_RANK_PROMOTION"] = "raise"
os.environ["MPLBACKEND"] = "Agg"

# Compiling is most of what JAX costs here: what one process has compiled is kept for the others and for the next run.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parents[1] / ".pytest_cache" / "jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")

# Processes of pytest-xdist that each start as many threads as there are cores get in each other's way.
_processes = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
if _processes > 1:
    for _name in ("D4ORM_NUM_THREADS", "OMP_NUM_THREADS"):
        os.environ.setdefault(_name, str(max((os.cpu_count() or 1) // _processes, 1)))

# No deadline: the first example pays for compilation. In CI the examples are the same in every run.
settings.register_profile("local", deadline=None, max_examples=50)
settings.register_profile("ci", settings.get_profile("local"), derandomize=True, print_blob=True)
settings.load_profile("ci" if os.environ.get("CI") else "local")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--fuzz-examples",
        type=int,
        metavar="N",
        help="examples of every test in tests/fuzz, drawn anew; without it a few, the same in every run",
    )


def pytest_configure(config: pytest.Config) -> None:
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        # A shell starts jobs in the background so; the tests press Ctrl-C, and what they start inherits it.
        signal.signal(signal.SIGINT, signal.default_int_handler)
    examples = config.getoption("--fuzz-examples")
    if examples is not None:
        # Read where the tests are imported, and by the processes of pytest-xdist.
        os.environ["FUZZ_EXAMPLES"] = str(examples)


@pytest.fixture(scope="module", autouse=True)
def memory_is_given_back() -> Iterator[None]:
    """What JAX has compiled for a module is dropped once the process is large; the cache on disk has it."""
    yield
    statm = Path("/proc/self/statm")
    if not statm.exists() or int(statm.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") < 2**30:
        return
    if "jax" in sys.modules:
        sys.modules["jax"].clear_caches()
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)


@pytest.fixture(autouse=True)
def unseeded_draws_repeat(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spaces and environments that no test seeds draw the same in every run: what fails once can be seen again."""
    np_random, seeds = seeding.np_random, itertools.count(2**32)
    monkeypatch.setattr(seeding, "np_random", lambda seed=None: np_random(next(seeds) if seed is None else seed))


class Outcome(NamedTuple):
    status: int
    out: str
    err: str


@pytest.fixture
def d4orm(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., Outcome]:
    """Runs the command line inside ``tmp_path``; gives exit status, output and errors."""
    from d4orm_planners.cli import app as cli

    monkeypatch.chdir(tmp_path)

    def call(*arguments: str) -> Outcome:
        with pytest.raises(SystemExit) as exit_:
            cli.main(list(arguments))
        captured = capsys.readouterr()
        return Outcome(int(exit_.value.code or 0), captured.out, captured.err)

    return call
