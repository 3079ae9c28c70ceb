"""Writing files so that they are whole or not there."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def replaced_when_done(path: Path, suffixes: tuple[str, ...] = ()) -> Iterator[Path]:
    """Give a temporary path in the same folder; rename it to ``path`` at the end, or remove it after an error.

    Args:
        path: The file to write.
        suffixes: Endings that are allowed; none given allows all.

    Raises:
        ValueError: If ``path`` does not end in one of the suffixes.
        OSError: If the folder does not exist or cannot be written to, or ``path`` is a folder. An error while writing
            names ``path``.
    """
    if suffixes and path.suffix.lower() not in suffixes:
        raise ValueError(f"{path} ends in {path.suffix!r}; choose one of {', '.join(suffixes)}")
    if not path.parent.is_dir():
        raise FileNotFoundError(f"folder {path.parent} does not exist; create it, or write {path.name} elsewhere")
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder; give the name of a file")
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.{time.monotonic_ns()}{path.suffix}")
    try:
        try:
            temporary.touch(exist_ok=False)
        except OSError as error:
            raise type(error)(f"cannot write to folder {path.parent}: {error.strerror}") from error
        yield temporary
        temporary.replace(path)
    except OSError as error:
        # A full disk names no file, and others the temporary one.
        if error.errno is not None and error.filename in (None, str(temporary), temporary):
            error.filename = str(path)
        raise
    finally:
        temporary.unlink(missing_ok=True)
