"""Scenario files: problems as YAML that people can write.

``examples/scenarios/mixed_team.yaml`` documents the format.
"""

from __future__ import annotations

import os
import warnings
from pathlib import Path

import yaml

from d4orm_env.core.files import replaced_when_done
from d4orm_env.core.infeasibility import prove_infeasible
from d4orm_env.core.problem import Problem
from d4orm_env.core.yaml_text import read_yaml
from d4orm_env.scenarios.dynobench import load_dynobench
from d4orm_env.scenarios.schema import describe, parse


def load_problem(path: str | os.PathLike[str]) -> Problem:
    """Read a scenario file.

    Args:
        path: A YAML file of at most 10 MB, 10,000 robots and 5 * 10^7 robots times steps, in the explicit form (every
            robot listed) or the short form (a scenario and its arguments); or an instance of dynobench or db-CBS, see
            :func:`~d4orm_env.scenarios.dynobench.load_dynobench`.

    Warns:
        UserWarning: If it is proved that nothing solves the problem, with the robots and why.

    Raises:
        ValueError: If the file cannot be read, is not YAML, breaks the schema, or makes no valid problem. One line that
            names the file, the field, and what was expected.
    """
    if not isinstance(path, (str, os.PathLike)):
        raise ValueError(f"the path of a scenario file must be text or a path, not {path!r}")
    try:
        content = read_yaml(path)
        is_dynobench = isinstance(content, dict) and "environment" in content
        problem = load_dynobench(path) if is_dynobench else parse(content)
    except ValueError as error:
        raise ValueError(f"{path}: {' '.join(str(error).split())}") from error
    proofs = [f"robot_{robot} {proof}" for robot, proof in prove_infeasible(problem).items()]
    if proofs:
        more = f", and {len(proofs) - 1} more" if len(proofs) > 1 else ""
        warnings.warn(f"{path}: nothing solves this problem: {proofs[0]}{more}", stacklevel=2)
    return problem


def save_problem(problem: Problem, path: str | os.PathLike[str]) -> None:
    """Write a problem in the explicit form; :func:`load_problem` returns an equal one, to the bit.

    The file is written under another name in the same folder and renamed, so that it is never half there.

    Raises:
        ValueError: If the file cannot be written; nothing is left behind.
    """
    target = Path(path)
    try:
        with replaced_when_done(target) as temporary:
            temporary.write_text(scenario_text(problem), encoding="utf-8")
    except OSError as error:
        raise ValueError(
            f"{target}: cannot be written ({error.strerror or error}); choose a file in a folder you own"
        ) from error


def scenario_text(problem: Problem) -> str:
    """Return the text that :func:`save_problem` writes: one line for each robot and obstacle."""
    lines = []
    for key, value in describe(problem).items():
        if isinstance(value, list):
            lines += [f"{key}:", *(f"  - {_flow(entry)}" for entry in value)]
        elif isinstance(value, dict):
            lines += [f"{key}:" if value else f"{key}: {{}}"]
            for part, entries in value.items():
                if part in ("bounds", "origin"):
                    lines += [f"  {part}: {_flow(entries)}"]
                else:
                    lines += [f"  {part}:", *(f"    - {_flow(entry)}" for entry in entries)]
        else:
            lines += [f"{key}: {_flow(value)}"]
    return "\n".join(lines) + "\n"


def _flow(value: object) -> str:
    """Write a value on one line; text in quotes."""
    style = '"' if isinstance(value, str) else None
    text: str = yaml.safe_dump(
        value, width=2**31 - 1, sort_keys=False, explicit_end=False, default_style=style, default_flow_style=True
    )
    return text.removesuffix("...\n").strip()
