"""YAML as it is read everywhere here: text, numbers, lists and mappings, by the rules of YAML 1.2.

No tags and no aliases, so that reading neither runs code nor unfolds a small text into a large one, and no more values
than files of this kind need.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from d4orm_env.core.files import read_limited

SUFFIXES = (".yaml", ".yml")
MAX_BYTES = 10_000_000
MAX_DEPTH = 16
MAX_ITEMS = 10_000
"""Entries of one list: as many robots or obstacles as a scenario makes at most."""
MAX_EVENTS = 500_000
"""Values, field names and brackets in all: so many robots with everything that there is to say about them."""

_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # ten times as fast where libyaml is there
_INTEGER = re.compile(r"[-+]?(0|[1-9][0-9]{0,17})")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
_SPECIAL_FLOAT = re.compile(r"[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)")
_WORDS = {"": None, "~": None, "null": None, "Null": None, "NULL": None} | {
    word: word.lower() == "true" for word in ("true", "True", "TRUE", "false", "False", "FALSE")
}


def is_yaml_path(path: str | os.PathLike[str]) -> bool:
    """Return whether a path ends as those of YAML files do, in letters of either case."""
    return Path(path).suffix.lower() in SUFFIXES


def read_yaml(path: str | os.PathLike[str]) -> object:
    """The content of a YAML file: text, numbers, lists and mappings.

    Raises:
        ValueError: If it cannot be read, is larger than 10 MB, or is refused by :func:`parse_yaml`.
    """
    return parse_yaml(_read_text(Path(path)))


def parse_yaml(text: str) -> object:
    """The one document of a YAML text.

    Raises:
        ValueError: If it is no such YAML, or too large or too deep; one line that says where.
    """
    try:
        events = _not_too_many(yaml.parse(text, Loader=_LOADER))
        documents = [_node(events, event, 0) for event in events if isinstance(event, yaml.NodeEvent)]
    except yaml.MarkedYAMLError as error:
        raise ValueError(f"is not YAML: {error.problem or error.context}{_line(error.problem_mark)}") from error
    except yaml.YAMLError as error:
        raise ValueError(f"is not YAML: {error}") from error
    if len(documents) != 1:
        raise ValueError(f"holds {len(documents)} YAML documents; expected one")
    return documents[0]


def _node(events: Iterator[yaml.Event], event: Any, depth: int) -> object:
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
        items: list[object] = []
        for item in _until(events, yaml.SequenceEndEvent):
            if len(items) == MAX_ITEMS:
                raise ValueError(f"has a list of more than {MAX_ITEMS} entries{line}; give fewer")
            items.append(_node(events, item, depth + 1))
        return items
    mapping: dict[str, object] = {}
    for item in _until(events, yaml.MappingEndEvent):
        key = item.value if isinstance(item, yaml.ScalarEvent) and item.tag is None else None
        if key is None:
            raise ValueError(f"has a field name that is not plain text{_line(item.start_mark)}")
        if key in mapping:
            raise ValueError(f"gives {key!r} twice{_line(item.start_mark)}; remove one")
        mapping[key] = _node(events, next(events), depth + 1)
    return mapping


def _not_too_many(events: Iterator[yaml.Event]) -> Iterator[yaml.Event]:
    for count, event in enumerate(events):
        if count > MAX_EVENTS:
            raise ValueError(f"holds more than {MAX_EVENTS} values, field names and brackets; give fewer")
        yield event


def _until(events: Iterator[yaml.Event], end: type[yaml.Event]) -> Iterator[yaml.Event]:
    for event in events:
        if isinstance(event, end):
            return
        yield event


def _scalar(text: str) -> object:
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


def _read_text(path: Path) -> str:
    try:
        content = read_limited(path, "a YAML file", MAX_BYTES)
    except OSError as error:
        raise ValueError(f"cannot be read ({error.strerror})") from error
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"is not UTF-8 text (byte {error.start}); save it as UTF-8") from error
