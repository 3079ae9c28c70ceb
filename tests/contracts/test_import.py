"""What importing the package costs, in libraries: nothing that most users do not need."""

from __future__ import annotations

import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

ROOT, PACKAGES = Path(__file__).parents[2], ("d4orm_env", "d4orm_planners")
HEAVY = ("torch", "ray", "casadi", "matplotlib", "jax", "stable_baselines3", "supersuit", "zenoh", "pyrvo",
         "pandas", "pyarrow", "scipy.stats", "typer", "rich", "safetensors", "PIL")  # fmt: skip
CONTRACT = (
    "navigation_v0",
    "make_problem",
    "make_team",
    "load_problem",
    "save_problem",
    "list_scenarios",
    "load_dynobench",
    "load_map",
    "Problem",
    "Team",
    "World",
    "Trajectory",
    "rollout",
    "verify",
)


def test_no_two_classes_of_the_packages_have_one_name() -> None:
    sources = [path.read_text(encoding="utf-8") for name in PACKAGES for path in (ROOT / name).rglob("*.py")]
    names = Counter(name for text in sources for name in re.findall(r"^ *class ([A-Z_]\w*)", text, re.MULTILINE))
    assert [name for name, count in names.items() if count > 1] == []


def run_python(code: str) -> str:
    """Standard output of a fresh interpreter in which warnings are errors."""
    result = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, timeout=120, check=False
    )
    assert result.returncode == 0, result.stderr
    return result.stdout.strip()


def loaded_by(code: str) -> set[str]:
    """Which of the heavy libraries are loaded after running ``code``."""
    report = f"import sys; print(*(name for name in {HEAVY!r} if name in sys.modules))"
    return set(run_python(f"{code}\n{report}").split())


def test_the_package_loads_nothing_heavy() -> None:
    assert loaded_by("import d4orm_env") == set()


def test_making_and_judging_a_problem_loads_nothing_heavy() -> None:
    code = (
        "import numpy as np, d4orm_env\n"
        "problem = d4orm_env.make_problem('circle', num_robots=2, horizon=5)\n"
        "assert not d4orm_env.verify(problem, np.zeros((5, 2, 2))).ok"
    )
    assert loaded_by(code) == set()


def test_the_cpu_engine_does_without_jax() -> None:
    made = "from d4orm_planners.engine.sampling_types import get_sampling_engine\nengine = get_sampling_engine('cpu')"
    code = f"{made}\nassert engine.name == 'cpu'"
    assert loaded_by(code) == set()


def test_making_an_environment_loads_nothing_heavy() -> None:  # nor does stepping it, see tests/release/bare.py
    assert loaded_by("from d4orm_env import navigation_v0\nnavigation_v0.parallel_env(num_robots=2)") == set()


def test_comparing_policies_loads_nothing_heavy_before_there_is_something_to_report() -> None:
    assert loaded_by("from d4orm_planners import evaluate") == set()


@pytest.mark.parametrize("name", CONTRACT)
def test_the_public_names_are_there(name: str) -> None:
    import d4orm_env

    assert getattr(d4orm_env, name) is not None
    assert name in d4orm_env.__all__


def test_the_contracts_import_statement_works_in_a_fresh_process() -> None:
    names = ", ".join(CONTRACT)
    assert run_python(f"from d4orm_env import {names}\nprint(callable(rollout), navigation_v0.__name__)") == (
        "True d4orm_env.navigation_v0"
    )


def test_all_names_resolve() -> None:
    assert run_python("from d4orm_env import *\nprint(functional.__name__)") == "d4orm_env.jax.functional"


def test_unknown_names_are_attribute_errors() -> None:
    import d4orm_env

    with pytest.raises(AttributeError, match="module 'd4orm_env' has no attribute 'teleport'"):
        _ = d4orm_env.teleport


def test_the_planners_are_not_loaded_by_the_environment() -> None:
    code = "import sys, d4orm_env\nprint(any(name.startswith('d4orm_planners') for name in sys.modules))"
    assert run_python(code) == "False"


@pytest.mark.parametrize(
    ("library", "package"),
    [("jaxmarl", "d4orm-env jaxmarl six"), ("torchrl", "'d4orm-env[rl]'"), ("benchmarl", "d4orm-env benchmarl")],
)
@pytest.mark.slow
def test_an_integration_says_which_library_is_missing(library: str, package: str) -> None:
    if library != "jaxmarl":
        pytest.importorskip("torchrl")
    code = f"import sys; sys.modules[{library!r}] = None\nimport d4orm_env.integrations.{library}"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert f"ImportError: this integration needs {library}; " in result.stderr
    assert f" with: pip install {package}\n" in result.stderr
