"""The page of settings: what every planner and policy takes, from the comments on the fields of the code."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

from sphinx.pycode import ModuleAnalyzer

from d4orm_env.core.robot_types import ROBOTS
from d4orm_env.scenarios import describe_scenario, list_scenarios
from d4orm_planners import list_policies
from d4orm_planners.base.planner_registry import default_settings, find_policy, preset_names
from d4orm_planners.sampling.d4orm import D4ormConfig

HEAD = """\
# Settings and scenarios

Made from the code when these pages are built. `make_planner(name, **settings)`, `make_policy` and `--set` take
these; `d4orm planners NAME` lists them too. A preset gives the values of its column.

## Scenarios

"""

NODES = {"planner": 'What every node refines its candidate with: `"d4orm"`, `"d4orm-d"` or `"hybrid"`.'}
"""Settings of D-D4orm that no class lists; others are those of D4orm."""


def described(config: type) -> dict[str, str]:
    """Meanings of settings, from the comments on the fields of a configuration class and those it is made of."""
    meanings: dict[str, str] = {}
    for kind in config.__mro__[-2::-1]:
        for (owner, name), comment in ModuleAnalyzer.for_module(kind.__module__).find_attr_docs().items():
            if owner == kind.__name__:
                meanings[name] = plain(" ".join(comment))
    return meanings


def plain(text: str) -> str:
    """Docstring text as Markdown in one line."""
    text = re.sub(r":\w+:(?:\w+:)?`~?(?:[\w.]*\.)?([\w\[\], ]+)`", r"`\1`", " ".join(text.split()))
    return text.replace("``", "`").replace("|", "\\|")


def shown(value: object) -> str:
    """A value in a cell."""
    return f"`{value!r}`"


def section(name: str) -> str:
    """The heading and table of one planner or policy."""
    kind = find_policy(name)
    defaults, config = default_settings(name), getattr(kind, "config_class", None) or kind
    presets: Mapping[str, Mapping[str, object]] = getattr(kind, "presets", {})
    shown_presets = preset_names(name)
    meanings = NODES | described(D4ormConfig) | described(config)
    head = ["setting", "default", *(f'`"{preset}"`' for preset in shown_presets), "meaning"]
    rows = []
    for key, value in defaults.items():
        of_presets = [shown(presets[preset].get(key, value)) for preset in shown_presets]
        rows.append([f"`{key}`", shown(value), *of_presets, meanings.get(key, "")])
    return f"## {name}\n\n```{{table}}\n:class: settings\n\n{table(head, rows)}```\n" if rows else ""


def table(head: list[str], rows: list[list[str]]) -> str:
    """Rows in Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def robots() -> str:
    """The numbers of the robots that are known by name, and where each comes from."""
    rows = [
        [f"`{name}`", f"`{attribute}`", f"{getattr(robot, attribute):g}", sourced(source)]
        for name, robot in ROBOTS.items()
        for attribute, source in robot.sources.items()
    ]
    return "## Robots by name\n\n" + table(["robot", "attribute", "in SI units", "source"], rows)


def sourced(text: str) -> str:
    """Text whose addresses are links."""
    return re.sub(r"https://[^\s,)]+", r"<\g<0>>", text)


def write_settings(path: Path) -> None:
    """Write the page."""
    rows = [[f"`{name}`", plain(describe_scenario(name))] for name in list_scenarios()]
    scenarios = table(["name", "what it is"], rows)
    sections = filter(None, (section(name) for name in list_policies()))
    path.parent.mkdir(exist_ok=True)
    path.write_text(HEAD + scenarios + "\n" + robots() + "\n" + "\n".join(sections), encoding="utf-8")
