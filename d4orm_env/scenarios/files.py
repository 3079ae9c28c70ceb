"""Scenario files: problems as YAML that people can write.

``examples/scenarios/mixed_team.yaml`` documents the format. Only text, numbers, lists and mappings can come out of a
file: no tags and no aliases, so that reading neither runs code nor unfolds a small file into a large one.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from d4orm_env.core.files import replaced_when_done
from d4orm_env.core.problem import Problem
from d4orm_env.scenarios.schema import describe, parse

MAX_BYTES = 10_000_000
MAX_DEPTH = 16

_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # ten times as fast where libyaml is there
_INTEGER = re.compile(r"[-+]?(0|[1-9][0-9]{0,17})")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
_SPECIAL_FLOAT = re.compile(r"[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)")
_WORDS = {"": None, "~": None, "null": None, "Null": None, "NULL": None} | {
    word: word.lower() == "true" for word in ("true", "True", "TRUE", "false", "False", "FALSE")
}


def load_problem(path: str | os.PathLike[str]) -> Problem:
    """Read a scenario file.

    Args:
        path: A YAML file of at most 10 MB, in the explicit form (every robot listed) or the short form (a scenario and
            its arguments).

    Raises:
        ValueError: If the file cannot be read, is not YAML, breaks the schema, or makes no valid problem. One line that
            names the file, the field, and what was expected.
    """
    if not isinstance(path, (str, os.PathLike)):
        raise ValueError(f"the path of a scenario file must be text or a path, not {path!r}")
    try:
        return parse(read_yaml(path))
    except ValueError as error:
        raise ValueError(f"{path}: {' '.join(str(error).split())}") from error


def read_yaml(path: str | os.PathLike[str]) -> Any:
    """The content of a YAML file: text, numbers, lists and mappings.

    Raises:
        ValueError: If it cannot be read, is larger than 10 MB, or is no such YAML.
    """
    return _read_yaml(_read_text(Path(path)))


def save_problem(problem: Problem, path: str | os.PathLike[str]) -> None:
    """Write a problem in the explicit form; :func:`load_problem` returns an equal one, to the bit.

    The file is written under another name in the same folder and renamed, so that it is never half there.

    Raises:
        ValueError: If the file cannot be written; nothing is left behind.
    """
    target = Path(path)
    try:
        with replaced_when_done(target) as temporary:
            temporary.write_text(_format(describe(problem)), encoding="utf-8")
    except OSError as error:
        raise ValueError(
            f"{target}: cannot be written ({error.strerror or error}); choose a file in a folder you own"
        ) from error


def _read_text(path: Path) -> str:
    try:
        if path.exists() and not path.is_file():
            raise ValueError("is not a file; give the path of a YAML file")
        with path.open("rb") as file:
            content = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise ValueError(f"cannot be read ({error.strerror})") from error
    if len(content) > MAX_BYTES:
        raise ValueError(f"is larger than {MAX_BYTES // 1_000_000} MB; files of this kind are smaller than that")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"is not UTF-8 text (byte {error.start}); save it as UTF-8") from error


def _read_yaml(text: str) -> Any:
    """The one document of a YAML text."""
    try:
        events = yaml.parse(text, Loader=_LOADER)
        documents = [_node(events, event, 0) for event in events if isinstance(event, yaml.NodeEvent)]
    except yaml.MarkedYAMLError as error:
        raise ValueError(f"is not YAML: {error.problem or error.context}{_line(error.problem_mark)}") from error
    except yaml.YAMLError as error:
        raise ValueError(f"is not YAML: {error}") from error
    if len(documents) != 1:
        raise ValueError(f"holds {len(documents)} YAML documents; expected one")
    return documents[0]


def _node(events: Iterator[yaml.Event], event: Any, depth: int) -> Any:
    """The value that begins with ``event``; takes the rest of it from ``events``."""
    line = _line(event.start_mark)
    if depth > MAX_DEPTH:
        raise ValueError(f"is nested more than {MAX_DEPTH} deep{line}; files of this kind are not")
    if isinstance(event, yaml.AliasEvent):
        raise ValueError(f"uses the alias *{event.anchor}{line}; write the value out")
    if event.tag is not None:
        raise ValueError(f"uses the tag {event.tag}{line}; tags are not supported, remove it")
    if isinstance(event, yaml.ScalarEvent):
        return _scalar(event.value) if event.implicit[0] else event.value
    if isinstance(event, yaml.SequenceStartEvent):
        return [_node(events, item, depth + 1) for item in _until(events, yaml.SequenceEndEvent)]
    mapping: dict[str, Any] = {}
    for item in _until(events, yaml.MappingEndEvent):
        key = item.value if isinstance(item, yaml.ScalarEvent) and item.tag is None else None
        if key is None:
            raise ValueError(f"has a field name that is not plain text{_line(item.start_mark)}")
        if key in mapping:
            raise ValueError(f"gives {key!r} twice{_line(item.start_mark)}; remove one")
        mapping[key] = _node(events, next(events), depth + 1)
    return mapping


def _until(events: Iterator[yaml.Event], end: type[yaml.Event]) -> Iterator[yaml.Event]:
    for event in events:
        if isinstance(event, end):
            return
        yield event


def _scalar(text: str) -> Any:
    """A plain scalar by the rules of YAML 1.2: ``1e-3`` is a number, ``on`` is text, nothing is octal or base 60."""
    if text in _WORDS:
        return _WORDS[text]
    if _INTEGER.fullmatch(text):
        return int(text)
    if _FLOAT.fullmatch(text):
        return float(text)
    return float(text.replace(".", "")) if _SPECIAL_FLOAT.fullmatch(text) else text


def _line(mark: Any) -> str:
    return "" if mark is None else f" in line {mark.line + 1}"


def _format(content: dict[str, Any]) -> str:
    """One line for each robot and obstacle."""
    lines = []
    for key, value in content.items():
        if key == "robots":
            lines += ["robots:", *(f"  - {_flow(robot)}" for robot in value)]
        elif key == "world":
            lines += ["world:" if value else "world: {}"]
            for part, entries in value.items():
                if part == "bounds":
                    lines += [f"  bounds: {_flow(entries)}"]
                else:
                    lines += [f"  {part}:", *(f"    - {_flow(entry)}" for entry in entries)]
        else:
            lines += [f"{key}: {_flow(value)}"]
    return "\n".join(lines) + "\n"


def _flow(value: Any) -> str:
    if isinstance(value, str):
        return _dump(value, default_style='"')
    return _dump(value, default_flow_style=True)


def _dump(value: Any, **style: Any) -> str:
    text: str = yaml.safe_dump(value, width=2**31 - 1, sort_keys=False, explicit_end=False, **style)
    return text.removesuffix("...\n").strip()
