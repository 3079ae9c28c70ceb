"""What is released: what it requires, what the required packages alone can do, one version, and what is public."""

from __future__ import annotations

import ast
import importlib
import re
import subprocess
import sys
import tomllib
from importlib.metadata import PackageNotFoundError, packages_distributions, requires
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import d4orm_env

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
REQUIRED = {canonicalize_name(Requirement(text).name) for text in PROJECT["dependencies"]}
API = (ROOT / "docs" / "reference" / "api.md").read_text(encoding="utf-8")
ROWS = re.findall(r"^\| `(d4orm_[\w.]+)` \| (.+) \|$", API, re.MULTILINE)
PUBLIC = {module: re.findall(r"`(\w+)`", names) for module, names in ROWS}
"""The public names that the page of the policy lists, by module."""
OF_EXTRAS = ("d4orm_env.crazyflow", "d4orm_env.integrations.", "d4orm_env.mujoco")


def brought_by(name: str) -> set[str]:
    """Everything that comes with a distribution, itself not counted."""
    found: set[str] = set()
    waiting = [name]
    while waiting:
        try:
            texts = requires(waiting.pop()) or []
        except PackageNotFoundError:  # needed elsewhere, as colorama on Windows
            continue
        wanted = [Requirement(text) for text in texts]
        names = {canonicalize_name(one.name) for one in wanted if not one.marker or one.marker.evaluate({"extra": ""})}
        waiting += names - found
        found |= names
    return found


def test_few_packages_are_required_and_none_that_another_brings() -> None:
    assert len(REQUIRED) <= 10
    assert "jax" in REQUIRED
    brought = set().union(*(brought_by(name) for name in REQUIRED))
    assert REQUIRED & brought <= {"pydantic"}, "typer brings it too, but only of late"


def test_the_required_packages_alone_import_step_plan_and_draw() -> None:
    kept = REQUIRED.union(*(brought_by(name) for name in REQUIRED)) | {"d4orm-env"}
    blocked = [
        module
        for module, owners in packages_distributions().items()
        if not {canonicalize_name(owner) for owner in owners} & kept
    ]
    assert "pytest" in blocked
    bare = str(ROOT / "tests" / "release" / "bare.py")
    code = (
        f"import runpy, sys; sys.modules.update(dict.fromkeys({blocked!r}))\n"
        f"runpy.run_path({bare!r}, run_name='__main__')"
    )
    result = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert "imports, steps, plans and draws" in result.stdout


def test_there_is_one_version() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    changelog = re.findall(r"^## \[(.+?)\]", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert PROJECT["dynamic"] == ["version"]
    assert citation["version"] == d4orm_env.__version__
    assert next(name for name in changelog if name != "Unreleased") == d4orm_env.__version__


def exported(name: str) -> list[str]:
    """``__all__`` of a module, read without its libraries."""
    path = ROOT.joinpath(*name.split("."))
    source = (path / "__init__.py" if path.is_dir() else path.with_suffix(".py")).read_text(encoding="utf-8")
    (names,) = (
        ast.literal_eval(line.value)
        for line in ast.parse(source).body
        if isinstance(line, ast.Assign) and ast.unparse(line.targets[0]) == "__all__"
    )
    return list(names)


@pytest.mark.parametrize("name", PUBLIC)
def test_the_policy_lists_what_a_public_module_exports(name: str) -> None:
    assert PUBLIC[name] == sorted(exported(name))
    if not name.startswith(OF_EXTRAS):
        module = importlib.import_module(name)
        assert all(getattr(module, public) is not None for public in PUBLIC[name])


def test_the_packages_are_in_the_policy() -> None:
    assert {"d4orm_env", "d4orm_planners"} < PUBLIC.keys()


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 80


def test_make_clean_removes_nothing_of_the_repository() -> None:
    def output(*command: str) -> str:
        return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout

    folders = [
        name for name in output("make", "--dry-run", "clean").split() if name not in ("rm", "-rf", "\\", ".venv*")
    ]
    assert "docs/_build" in folders
    assert not output("git", "ls-files", *folders)
