"""Reading files of others, and writing files so that they are whole or not there, after a power cut too.

Of ``.npz`` files nothing is unpickled, and nothing is unpacked that is not expected.
"""

from __future__ import annotations

import errno
import json
import os
import time
import zipfile
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import numpy as np


def require_file(path: Path, kind: str) -> None:
    """Refuse a folder, a pipe or a device, whose reading may never end. What is not there is left to whoever opens it.

    Args:
        path: What was given.
        kind: What should have been, as ``"a map"``.

    Raises:
        ValueError: If it is none; without its name.
    """
    if path.exists() and not path.is_file():
        raise ValueError(f"is not a file; give the path of {kind}")


def read_limited(path: Path, kind: str, most: int) -> bytes:
    """Return the content of a file of at most so many bytes.

    Raises:
        ValueError: As :func:`require_file`, or if it has more.
        OSError: If it cannot be read.
    """
    require_file(path, kind)
    with path.open("rb") as file:
        content = file.read(most + 1)
    if len(content) > most:
        raise ValueError(f"is larger than {most // 1_000_000} MB; files of this kind are smaller than that")
    return content


def target_of(path: Path) -> Path:
    """Return where a file is written: at its path, or where a symbolic link leads to.

    Raises:
        OSError: If no file can be there, because of what is there or of a folder that is missing.
    """
    target = Path(os.path.realpath(path))
    if target.is_symlink():
        raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), str(path))
    if not target.parent.is_dir():
        raise FileNotFoundError(f"folder {target.parent} does not exist; create it, or write {path.name} elsewhere")
    if target.is_dir():
        raise IsADirectoryError(f"{path} is a folder; give the name of a file")
    if target.exists() and not target.is_file():
        raise OSError(f"{path} is a device or a pipe; give the name of a file")
    return target


@contextmanager
def replaced_when_done(path: Path, suffixes: tuple[str, ...] = ()) -> Iterator[Path]:
    """Give a temporary path in the same folder; rename it to ``path`` at the end, or remove it after an error.

    Args:
        path: The file to write; where it is a symbolic link, that which it leads to.
        suffixes: Endings that are allowed; none given allows all.

    Raises:
        ValueError: If ``path`` does not end in one of the suffixes.
        OSError: If the folder does not exist or cannot be written to, or ``path`` is a folder. An error while writing
            names ``path``.
    """
    if suffixes and path.suffix.lower() not in suffixes:
        raise ValueError(f"{path} ends in {path.suffix!r}; choose one of {', '.join(suffixes)}")
    target = target_of(path)
    # Of a long name a part, because it must not become longer than a name may be.
    temporary = target.with_name(f".{path.stem[:32]}.{os.getpid()}.{time.monotonic_ns()}{path.suffix[:16]}")
    try:
        try:
            temporary.touch(exist_ok=False)
        except OSError as error:
            raise type(error)(f"cannot write to folder {target.parent}: {error.strerror}") from error
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())  # or a power cut may leave the new name with nothing in it
        temporary.replace(target)
    except OSError as error:
        # A full disk names no file, and others the temporary one.
        if error.errno is not None and error.filename in (None, str(temporary), temporary):
            error.filename = str(path)
        raise
    finally:
        temporary.unlink(missing_ok=True)


def claim_folder(path: Path, identity: Mapping[str, object], kind: str) -> None:
    """Write down what a folder is for, or find out whether it is one for the same.

    Args:
        path: The JSON file in it that says so.
        identity: All that must be the same.
        kind: What the folder holds, as ``"a training"``.

    Raises:
        ValueError: If it is for something else, or does not say.
        OSError: If it cannot be written to.
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
                "same, or choose another folder"
            )


HEADER_BYTES = 16_384
"""Bytes that an array takes in its file beyond its content, at most."""


class ArrayArchive(zipfile.ZipFile):
    """An ``.npz`` file with the arrays that are expected, and no others.

    Args:
        stream: The file.
        names: Of the arrays.

    Raises:
        ValueError: If it holds others.
        zipfile.BadZipFile: If it is no such file.
    """

    def __init__(self, stream: IO[bytes], names: Collection[str]) -> None:
        super().__init__(stream)
        found = sorted(info.filename for info in self.infolist())
        if found != sorted(f"{name}.npy" for name in names):
            raise ValueError(f"it holds {', '.join(found[:20])}; expected {', '.join(sorted(names))}")

    def array(self, name: str, max_bytes: int) -> np.ndarray:
        """An array of at most so many bytes.

        Raises:
            ValueError: If it is larger or damaged.
        """
        info = self.getinfo(f"{name}.npy")
        # The directory may lie: then less is unpacked than it says, or no more, and the checksum fails.
        if info.file_size > max_bytes + HEADER_BYTES:
            raise ValueError(
                f"{name} does not fit: it takes {info.file_size} bytes, and at most {max_bytes} make sense"
            )
        with self.open(info) as file:
            return np.lib.format.read_array(file, allow_pickle=False)
