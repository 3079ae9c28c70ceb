"""Reading and checking what was given on the command line.

Here and in all commands, what makes no sense is a ``ValueError`` of one line, which names it and says what to change.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

import typer

from d4orm_env.core.files import parse_yaml, target_of
from d4orm_planners.base.planner_registry import list_policies

N = TypeVar("N", int, float)

MOST_SEEDS = 1_000_000
"""Trials of one policy at most: a slip of the finger must not fill the memory."""


def parse_settings(settings: list[str] | None, option: str = "--set") -> dict[str, Any]:
    """``name=value`` texts, given to an option, as a dictionary, the values read as YAML 1.2."""
    values: dict[str, object] = {}
    for setting in settings or []:
        name, separator, text = setting.partition("=")
        if not separator or not name:
            raise ValueError(f"{option} {setting!r} is not of the form name=value, as num_samples=512")
        _add(values, name, text if text.strip() else "null", option, f"{setting!r}: the value")
    return values


def parse_levels(texts: list[str] | None) -> dict[str, list[object]] | None:
    """``name=level,level`` texts of ``--disturb`` as levels by name, read as YAML 1.2; ``None`` stays."""
    if texts is None:
        return None
    parsed: dict[str, object] = {}
    levels: dict[str, list[object]] = {}
    for text in texts:
        brackets, closed, rest = text.rpartition(")")  # what is in them has equals signs of its own
        name, separator, listed = (part.strip() for part in rest.partition("="))
        name = brackets + closed + name
        if not separator or not name or not listed:
            raise ValueError(f"--disturb {text!r} is not of the form name=levels, as delay=0,1,2 or push.speed=0.2,0.5")
        _add(parsed, name, f"[{listed}]", "--disturb", f"{text!r}: the list")
        values = parsed[name]
        if not isinstance(values, list):
            raise ValueError(f"--disturb {text!r} gives no list of levels; give some like delay=0,1,2")
        levels[name] = [math.inf if value == "inf" else value for value in values]
    return levels


def single_levels(texts: list[str] | None) -> dict[str, object]:
    """The same where every name has one level."""
    levels = parse_levels(texts) or {}
    for name, values in levels.items():
        if len(values) != 1:
            raise ValueError(f"--disturb {name}: an episode has one level, not {len(values)}; use d4orm evaluate")
    return {name: values[0] for name, values in levels.items()}


def _add(values: dict[str, object], name: str, text: str, option: str, what: str) -> None:
    """Add a value read as YAML under a new name."""
    if name in values:
        raise ValueError(f"{option} gives {name!r} twice; give it once")
    try:
        values[name] = parse_yaml(text)
    except ValueError as error:
        raise ValueError(f"{option} {what} {error}") from None


def policies_by_label(texts: list[str], option: str = "--policy") -> dict[str, dict[str, object]]:
    """``policy`` and settings by label: a name stands for itself, a configuration for what was typed, or what it sets
    as label.
    """
    labelled: list[tuple[str, dict[str, object]]] = []
    for text in texts:
        # The name ends where the first setting begins, for an import path has a colon too.
        policy, colon, _ = text.partition("=")[0].rpartition(":")
        if "=" in text and ("," in policy or not colon):
            raise ValueError(
                f"{option} {text!r}: settings stand behind one policy, as in d4orm:num_samples=64,label=few; give "
                f"{option} once for each"
            )
        if not colon or ("=" not in text and policy not in list_policies()):
            labelled += [(name, {}) for name in names(text) or ()]
            continue
        values = parse_settings(text.removeprefix(policy + colon).split(","), option)
        if reserved := {"policy", "name"} & values.keys():
            raise ValueError(f"{option} {text!r}: {min(reserved)!r} is no setting; the name stands before the colon")
        labelled.append((str(values.pop("label", text)), {"policy": policy, **values}))
    for label, _ in labelled:
        if [one for one, _ in labelled].count(label) > 1:
            raise ValueError(f"{option} gives {label!r} twice; leave one out, or set a label, as in d4orm:label=ours")
    return dict(labelled)


def refuse_options(context: typer.Context, options: Iterable[str], reason: str) -> None:
    """Refuse what was given on the command line although it would count for nothing."""
    for parameter in context.command.params:
        source = context.get_parameter_source(parameter.name or "")
        if parameter.name in options and source is not None and source.name == "COMMANDLINE":
            raise ValueError(f"{parameter.opts[0]} {reason}")


def names(text: str | None) -> tuple[str, ...] | None:
    """A list separated by commas; ``None`` stays."""
    return None if text is None else tuple(name.strip() for name in text.split(","))


def numbers(option: str, text: str | None) -> tuple[int, ...] | None:
    """A list of whole numbers separated by commas; ``None`` stays."""
    return None if text is None else _listed(option, text, int, "whole numbers, as 4,8,16")


def decimals(option: str, text: str) -> tuple[float, ...]:
    """A list of numbers separated by commas."""
    return _listed(option, text, float, "numbers, as 0,0.05,0.1")


def _listed(option: str, text: str, kind: Callable[[str], N], what: str) -> tuple[N, ...]:
    try:
        return tuple(kind(number) for number in text.split(","))
    except ValueError:
        raise ValueError(f"{option} {text!r} is not a list of {what}") from None


def seed_list(text: str) -> list[int]:
    """Seeds of ``--seeds``: how many, a range or a list."""
    try:
        if "," in text:
            return [int(number) for number in text.split(",")]
        first, last = (int(number) for number in text.split("-")) if "-" in text.strip()[1:] else (0, int(text) - 1)
    except ValueError:
        raise ValueError(f"--seeds {text!r} is neither a number, as 50, nor a range, as 10-19, nor a list") from None
    if last < first:
        raise ValueError(f"--seeds {text!r} names no seed; give a number, as 50, or a range, as 10-19")
    if last - first >= MOST_SEEDS:
        raise ValueError(f"--seeds {text!r} asks for more than {MOST_SEEDS} seeds; give fewer")
    return list(range(first, last + 1))


@contextmanager
def output_folder(folder: Path) -> Iterator[None]:
    """Make a folder, unless it is there; what was made is removed again where nothing was written to it."""
    made = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"folder {str(folder)!r} cannot be made ({error.strerror}); choose another") from None
    check_writable(folder)
    try:
        yield
    finally:
        with suppress(OSError):  # it is not empty
            for path in made:
                path.rmdir()


def check_writable(folder: Path) -> None:
    """Find out whether files can be made in a folder."""
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        reason = error.strerror or "refused"
        raise ValueError(f"folder {str(folder)!r} cannot be written to ({reason}); choose another") from None


def check_target(path: Path | None, suffixes: tuple[str, ...]) -> None:
    """Find out before planning whether a file can be written."""
    if path is None:
        return
    if path.suffix not in suffixes:
        raise ValueError(f"output file {str(path)!r} must end in {' or '.join(suffixes)}")
    check_writable(target_of(path).parent)
