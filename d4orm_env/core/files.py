"""Reading files of others, and writing files so that they are whole or not there, after a power cut too.

Of ``.npz`` files nothing is unpickled, and nothing is unpacked that is not expected. YAML is text, numbers, lists and
mappings, by the rules of YAML 1.2: no tags and no aliases, so that reading neither runs code nor unfolds a small text
into a large one, and no more values than files of this kind need.
"""

from __future__ import annotations

import errno
import json
import os
import re
import time
import zipfile
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

import numpy as np
import yaml

from d4orm_env.core.arrays import short_repr
from d4orm_env.core.errors import FileAccessError, MissingFileError


def checked_path(path: object, what: str) -> Path:
    """Return the path of ``what``. Raises ValueError if it is neither text nor a path, or empty."""
    if not isinstance(path, (str, os.PathLike)) or path == "":
        raise ValueError(f"the path of {what} must be text or a path, not {short_repr(path)}")
    return Path(path)


def make_folder(folder: Path) -> None:
    """Make a folder and those that it is in, unless it is there; a ``ValueError`` says why it cannot be made."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"folder {str(folder)!r} cannot be made ({error.strerror}); choose another") from None


def require_file(path: Path, kind: str) -> None:
    """Refuse a folder, a pipe or a device, whose reading may never end, in place of a ``kind`` such as ``"a map"``.

    A path without a file passes.
    """
    if path.exists() and not path.is_file():
        raise ValueError(f"is not a file; give the path of {kind}")


def read_limited(path: Path, kind: str, most: int) -> bytes:
    """Return the content of a file of at most so many bytes."""
    require_file(path, kind)
    with path.open("rb") as file:
        content = file.read(most + 1)
    if len(content) > most:
        raise ValueError(f"is larger than {most // 1_000_000} MB; files of this kind are smaller than that")
    return content


@contextmanager
def naming(path: str | os.PathLike[str]) -> Iterator[None]:
    """Raise errors within as a ``ValueError`` of one line that begins with the path of the file.

    For a file that does not exist it is a ``FileNotFoundError`` too.
    """
    try:
        yield
    except ValueError as error:
        kind = MissingFileError if isinstance(error, MissingFileError) else ValueError
        raise kind(f"{path}: {' '.join(str(error).split())}") from error
    except OSError as error:
        raise _unreadable(error, f"{error.filename or path}: ") from error


def _unreadable(error: OSError, where: str = "") -> ValueError:
    """The error for a file that cannot be read."""
    kind = MissingFileError if isinstance(error, FileNotFoundError) else ValueError
    return kind(f"{where}cannot be read ({error.strerror}); check name and permissions")


def target_of(path: Path) -> Path:
    """Path at which a file is written: its own, or a symbolic link's target. Raises FileAccessError if it cannot be."""
    target = Path(os.path.realpath(path))
    if target.is_symlink():
        raise FileAccessError(f"{path}: {os.strerror(errno.ELOOP)}; give the name of a file")
    if not target.parent.is_dir():
        raise MissingFileError(f"folder {target.parent} does not exist; create it, or write {path.name} elsewhere")
    if target.is_dir():
        raise FileAccessError(f"{path} is a folder; give the name of a file")
    if target.exists() and not target.is_file():
        raise FileAccessError(f"{path} is a device or a pipe; give the name of a file")
    return target


@contextmanager
def writing(path: Path, *parts: object) -> Iterator[None]:
    """Raise errors of the system on ``path``, on these ``parts`` of it if there are any, or on no file in particular,
    as a FileAccessError that names it.
    """
    try:
        yield
    except OSError as error:
        if error.errno is None or (parts and error.filename not in (None, *parts)):
            raise
        reason = f"{path} cannot be written: {error.strerror}"
        raise FileAccessError(f"{reason}; free some space or choose another folder") from error


@contextmanager
def replaced_when_done(path: Path, suffixes: tuple[str, ...] = ()) -> Iterator[Path]:
    """Give a temporary path in the same folder; rename it to ``path`` at the end, or remove it after an error.

    A symbolic link stays one. A path that ends in none of the ``suffixes``, if there are any, is a ValueError, and one
    that cannot be written to a FileAccessError that names it.
    """
    if suffixes and path.suffix.lower() not in suffixes:
        raise ValueError(f"{path} ends in {path.suffix!r}; choose one of {', '.join(suffixes)}")
    target = target_of(path)
    # Of a long name a part, because it must not become longer than a name may be.
    temporary = target.with_name(f".{path.stem[:32]}.{os.getpid()}.{time.monotonic_ns()}{path.suffix[:16]}")
    try:
        # A full disk names no file, and others the temporary one.
        with writing(path, temporary, str(temporary)):
            temporary.touch(exist_ok=False)
            yield temporary
            with temporary.open("rb+") as file:
                os.fsync(file.fileno())  # or a power cut may leave the new name with nothing in it
            temporary.replace(target)
    finally:
        with suppress(OSError):  # a folder that is read-only refuses before it looks
            temporary.unlink(missing_ok=True)


def claim_folder(path: Path, identity: Mapping[str, object], kind: str, remedy: str = "choose another folder") -> None:
    """Write the purpose of a folder, which holds ``kind``, to a JSON file at ``path``, or check that it is the same.

    A folder for something else is a ValueError, which ends with the ``remedy``.
    """
    wanted = json.loads(json.dumps(identity))
    if not path.exists():
        with replaced_when_done(path) as temporary:
            temporary.write_text(json.dumps(wanted, indent=2) + "\n", encoding="utf-8")
        return
    try:
        before = dict(json.loads(path.read_text(encoding="utf-8")))
    except (ValueError, TypeError, RecursionError):
        raise ValueError(f"{path} cannot be read; remove it, or choose another folder") from None
    for name, value in wanted.items():
        if before.get(name) != value:
            raise ValueError(
                f"folder {path.parent} holds {kind} with {name} {before.get(name)!r}, not {value!r}; go on with the "
                f"same, or {remedy}"
            )


HEADER_BYTES = 16_384
"""Bytes that an array takes in its file beyond its content, at most."""


class ArrayArchive(zipfile.ZipFile):
    """An ``.npz`` file with the arrays of these names; a ValueError if it holds others."""

    def __init__(self, stream: IO[bytes], names: Collection[str]) -> None:
        super().__init__(stream)
        found = sorted(info.filename for info in self.infolist())
        if found != sorted(f"{name}.npy" for name in names):
            raise ValueError(f"it holds {', '.join(found[:20])}; expected {', '.join(sorted(names))}")

    def array(self, name: str, max_bytes: int) -> np.ndarray:
        """An array of at most so many bytes."""
        info = self.getinfo(f"{name}.npy")
        # The directory may lie: then less is unpacked than it says, or no more, and the checksum fails.
        if info.file_size > max_bytes + HEADER_BYTES:
            raise ValueError(
                f"{name} does not fit: it takes {info.file_size} bytes, and at most {max_bytes} make sense"
            )
        with self.open(info) as file:
            return np.lib.format.read_array(file, allow_pickle=False)


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
    """Check whether a path ends as those of YAML files do, in letters of either case."""
    return Path(path).suffix.lower() in SUFFIXES


def read_yaml(path: str | os.PathLike[str]) -> object:
    """The content of a YAML file: text, numbers, lists and mappings. Raises ValueError as :func:`parse_yaml`."""
    try:
        content = read_limited(Path(path), "a YAML file", MAX_BYTES)
    except OSError as error:
        raise _unreadable(error) from error
    try:
        return parse_yaml(content.decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        raise ValueError(f"is not UTF-8 text (byte {error.start}); save it as UTF-8") from error


def parse_yaml(text: str) -> object:
    """The one document of a YAML text; a ValueError of one line says where it is none, or too large or too deep."""
    try:
        events = _not_too_many(yaml.parse(text, Loader=_LOADER))
        documents = [_node(events, event, 0) for event in events if isinstance(event, yaml.NodeEvent)]
    except yaml.MarkedYAMLError as error:
        raise ValueError(
            f"is not YAML: {error.problem or error.context}{_line(error.problem_mark)}; correct that"
        ) from error
    except yaml.YAMLError as error:
        raise ValueError(f"is not YAML: {error}; correct that") from error
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
            raise ValueError(f"has a field name that is not plain text{_line(item.start_mark)}; write it as text")
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
