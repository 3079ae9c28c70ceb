"""The file that tells one node of a network what it has to do."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from d4orm_env.core.arrays import duration, whole_number
from d4orm_env.core.yaml_text import read_yaml
from d4orm_env.scenarios import load_problem
from d4orm_env.scenarios.schema import VERSION, parse
from d4orm_planners.base.planner_registry import make_planner
from d4orm_planners.d_d4orm.planner import DD4orm

if TYPE_CHECKING:
    from d4orm_env.core.problem import Problem

REQUIRED = ("node", "nodes", "problem", "time_limit", "out")
OPTIONAL = ("seed", "settings", "zenoh")
OWN = ("node", "nodes", "mode", "transport", "zenoh")
"""Settings of the planner that are not among ``settings``: they have a field of their own, or are given."""

ENDLESS = 10**9
"""Iterations; a node's budget is its time."""


@dataclass(frozen=True)
class NodeTask:
    """Task of a node.

    Attributes:
        planner: The planner, as one node.
        problem: The problem.
        seed: That of all nodes.
        time_limit: Seconds.
        out: The file for the plan.
    """

    planner: DD4orm
    problem: Problem
    seed: int
    time_limit: float
    out: Path


def load_node(path: str | os.PathLike[str]) -> NodeTask:
    """Read a node's file; paths in it are relative to its folder.

    Raises:
        ValueError: If it cannot be read, or something in it is missing, unknown or makes no sense; one line that names
            the file and the field.
    """
    try:
        return _task(read_yaml(path), Path(path).parent)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _task(content: object, folder: Path) -> NodeTask:
    fields = mapping("the file", content)
    for name in fields:
        if name not in REQUIRED + OPTIONAL:
            raise ValueError(f"unknown field {name!r}; known are {', '.join(REQUIRED + OPTIONAL)}")
    for name in REQUIRED:
        if fields.get(name) is None:
            raise ValueError(f"field {name!r} is missing")
    settings = mapping("settings", fields.get("settings", {}))
    for name in OWN:
        if name in settings:
            raise ValueError(f"settings has {name!r}, which " + (
                "is a field of the file itself" if name in fields else "is the same for every node of a network"
            ))  # fmt: skip
    network = {"transport": "zenoh", "mode": "async", "zenoh": zenoh_in(fields, folder)}
    if not isinstance(fields["out"], str):
        raise ValueError(f"out must be a path, not {fields['out']!r}")
    planner = make_planner(
        "d-d4orm",
        node=whole_number(fields["node"], "node", 0),
        nodes=whole_number(fields["nodes"], "nodes", 1),
        **{"max_iterations": ENDLESS, **settings, **network},
    )
    assert isinstance(planner, DD4orm)
    return NodeTask(
        planner=planner,
        problem=problem_in(fields["problem"], folder),
        seed=whole_number(fields.get("seed", 0), "seed", 0),
        time_limit=duration(fields["time_limit"], "time_limit"),
        out=folder / fields["out"],
    )


def problem_in(content: object, folder: Path) -> Problem:
    """The problem that a file names or has."""
    if isinstance(content, str):
        return load_problem(folder / content)
    if not isinstance(content, dict):
        raise ValueError(f"problem must be a scenario file or a scenario with its arguments, not {content!r}")
    try:
        return parse({"version": VERSION, **content})
    except ValueError as error:
        raise ValueError(f"problem: {error}") from error


def mapping(name: str, content: object) -> Mapping[str, Any]:
    """A part of a file that must be a mapping."""
    if not isinstance(content, dict):
        raise ValueError(f"{name} must be a mapping of fields, not {content!r}")
    return content


def zenoh_in(fields: Mapping[str, Any], folder: Path) -> Mapping[str, Any]:
    """The settings of zenoh in a file."""
    zenoh = mapping("zenoh", fields.get("zenoh", {}))
    if isinstance(zenoh.get("config_file"), str):
        zenoh = {**zenoh, "config_file": str(folder / zenoh["config_file"])}
    return zenoh
