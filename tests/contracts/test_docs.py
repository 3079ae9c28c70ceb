"""The pages of the documentation: their programs run, their commands are understood, their paths exist."""

from __future__ import annotations

import importlib.util
import os
import re
import runpy
import shlex
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from d4orm_env.core.robot_types import ROBOTS
from d4orm_planners import list_policies
from d4orm_planners.cli.app import Commands

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
FOLDERS = ("", "getting_started", "tutorials", "how_to", "reference", "background", "background/planners")
GENERATED = ("reference/settings.md", "reference/d4orm_env/modules.rst", "reference/d4orm_planners/modules.rst")
"""Pages that the build makes."""
PAGES = {
    name.removesuffix(".md"): page.read_text(encoding="utf-8")
    for folder in FOLDERS
    for page in sorted((DOCS / folder).glob("*.md"))
    if (name := page.relative_to(DOCS).as_posix()) not in GENERATED
}
REPORT = ROOT / "examples" / "studies" / "REPORT.md"
PAGES["background/report"] = REPORT.read_text(encoding="utf-8")  # which the page shows
OTHERS = (
    "README.md",
    "CONTRIBUTING.md",
    "CHANGELOG.md",
    "examples/README.md",
    "examples/studies/REPORT.md",
    "examples/studies/data/README.md",
)
"""What else links to pages, or is linked to."""
FENCE = re.compile(r"^ *```(\w+)( notest)?\n(.*?)^ *```$", re.DOTALL | re.MULTILINE)
TREE = re.compile(r"^```{toctree}\n(.*?)^```$", re.DOTALL | re.MULTILINE)
PATH = re.compile(r"`((?:examples|d4orm_env|d4orm_planners|tests|docs)/[\w./-]+)`")
EXTRA = re.compile(
    r"pip install 'd4orm-env\[\w+\]'|No module named '(stable_baselines3|supersuit|torch|torchrl|jaxmarl|minari)'"
)
"""Complaints that an extra is not installed."""
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
HEADING = re.compile(r"^#+ (.+)$", re.MULTILINE)
PRINTS = {
    "tutorials/own_policy/mine.py": "3.0 0.0\nin turn 1.0 0\nat once 0.0 0\ngently 0.0 0\ngo-to-goal 0.0 0\n",
    "how_to/own_planner/waiting.py": "True solved True\n",
    "how_to/own_planner/page.py": "solved\nsolved\n",
    "how_to/own_robot/page.py": "solved True\n",
}
"""What some pages' programs print."""


def programs(text: str) -> dict[str, str]:
    """A page's Python by file: what it says to save, and the rest, which builds on that; not what a test lacks."""
    codes = [code for language, skip, code in FENCE.findall(text) if language == "python" and not skip]
    saved = re.search(r"Save this as\s+`(\w+\.py)`", text)
    if not saved:
        return {"page.py": "\n".join(codes)} if codes else {}
    first, *rest = codes
    return {saved.group(1): first, "page.py": "\n".join([f"from {saved.group(1)[:-3]} import *", *rest])}


def commands(text: str) -> list[str]:
    """A page's command lines, without comments."""
    blocks = [code for language, _, code in FENCE.findall(text) if language in ("bash", "console")]
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    return [line.removeprefix("$ ") for line in lines if line.strip()]


@pytest.mark.parametrize("page", [page for page, text in PAGES.items() if programs(text) and page != "how_to/jax"])
@pytest.mark.slow
def test_programs_run(page: str, tmp_path: Path) -> None:
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    for name, code in programs(PAGES[page]).items():
        (tmp_path / name).write_text(code, encoding="utf-8")
        result = subprocess.run(
            [sys.executable, name],
            capture_output=True, text=True, check=False, cwd=tmp_path, env={**os.environ, "PYTHONPATH": path},
        )  # fmt: skip
        if result.returncode and (missing := EXTRA.search(result.stderr)):
            pytest.skip(missing.group())
        assert result.returncode == 0, result.stderr
        assert PRINTS.get(f"{page}/{name}", result.stdout) == result.stdout


@pytest.mark.parametrize("page", [page for page, text in PAGES.items() if commands(text)])
def test_commands_are_understood(page: str) -> None:
    known = Commands()
    for line in commands(PAGES[page]):
        words = shlex.split(line, comments=True)
        if words[:1] == ["d4orm"] and not words[1].startswith("-"):
            try:
                known.get_command(None, words[1]).make_context(words[1], words[2:])
            except ImportError as error:
                if not EXTRA.search(str(error)):
                    raise
        elif words[:2] == ["python", "-m"]:
            assert importlib.util.find_spec(words[2]), line


@pytest.mark.parametrize("page", PAGES)
def test_files_that_a_page_names_exist(page: str) -> None:
    named = PATH.findall(PAGES[page])
    missing = [path for path in named if "output" not in path and not (ROOT / path).exists()]
    assert not missing


def anchors(page: Path) -> set[str]:
    """What a code host calls the headings of a page."""
    headings = HEADING.findall(FENCE.sub("", page.read_text(encoding="utf-8")))
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", [*(f"docs/{page}.md" for page in PAGES), *OTHERS])
def test_links_lead_somewhere(page: str) -> None:
    for link in LINK.findall(FENCE.sub("", (ROOT / page).read_text(encoding="utf-8"))):
        path, _, anchor = link.partition("#")
        if path.startswith(("http://", "https://")):
            continue
        target = (ROOT / page).parent.joinpath(path).resolve() if path else ROOT / page
        if target.is_relative_to(DOCS) and target.relative_to(DOCS).as_posix() in GENERATED:
            continue
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), link


def test_every_page_is_in_a_table_of_contents() -> None:
    listed = {
        os.path.normpath(f"{Path(page).parent}/{line}")
        for page, text in PAGES.items()
        for code in TREE.findall(text)
        for line in code.split()
    }
    assert set(PAGES) - listed == {"index"}


def test_every_setting_is_described(tmp_path: Path) -> None:
    runpy.run_path(str(DOCS / "settings_page.py"))["write_settings"](tmp_path / "settings.md")
    text = (tmp_path / "settings.md").read_text(encoding="utf-8")
    assert set(re.findall("^## (.+)$", text, re.MULTILINE)) - {"Scenarios", "Robots by name"} <= set(list_policies())
    for robot in ROBOTS.values():
        assert all(source.partition("https")[0] in text for source in robot.sources.values())
    assert "|  |" not in text


@pytest.mark.parametrize("name", ["Team", "Team()", "core.Team", "Team.size", "size", "d4orm_env.core.Team", "am", ""])
@pytest.mark.parametrize("module", ["d4orm_env", "d4orm_env.core", ""])
def test_names_in_signatures_lead_where_sphinx_leads_them(name: str, module: str) -> None:
    python = pytest.importorskip("sphinx.domains.python")
    indexed = runpy.run_path(str(DOCS / "python_names.py"))["IndexedPythonDomain"]
    env = SimpleNamespace(domaindata={})
    for known, kind in (("core.Team", "class"), ("core.Team.size", "method"), ("teams.Team", "class")):
        indexed(env).objects[f"d4orm_env.{known}"] = python.ObjectEntry("page", known, kind, False)
    for mode in (0, 1):
        how = (env, module, "Team", name, None, mode)
        assert indexed(env).find_obj(*how) == python.PythonDomain(env).find_obj(*how)
