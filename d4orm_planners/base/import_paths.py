"""Things by where they are written: the digest of their source, and whether other processes get them."""

from __future__ import annotations

import functools
import hashlib
import inspect
import pickle
import sys
from collections.abc import Callable
from pathlib import Path

from d4orm_env.core.errors import describe


def source_digest(thing: object) -> str:
    """SHA-256 of the file in which a class, a function or an instance's class is written.

    Raises:
        ValueError: If there is no source to be read.
    """
    code = written(thing)
    try:
        file = inspect.getsourcefile(code)
        source = Path(file).read_bytes() if file and Path(file).is_file() else inspect.getsource(code).encode()
    except (OSError, TypeError):
        raise ValueError(
            f"the source of {code.__qualname__} cannot be read, so that a later version could not be told from this "
            "one; write it into a file"
        ) from None
    return hashlib.sha256(source).hexdigest()


def written(thing: object) -> type | Callable[..., object]:
    """The class or function whose source makes a thing what it is."""
    while isinstance(thing, functools.partial):
        thing = thing.func
    return thing if inspect.isclass(thing) or inspect.isroutine(thing) else type(thing)


def check_sendable(thing: object, owner: str) -> None:
    """Find out whether other processes can import what a thing is made of.

    Raises:
        ValueError: If not.
    """
    remedy = "define it at the top level of a module that is a file, or run with workers=1 and no trial_timeout"
    try:
        pickle.dumps(thing)
    except Exception as error:  # pickle raises whatever the thing's own methods do
        raise ValueError(f"{owner} cannot be handed to worker processes ({describe(error)}); {remedy}") from error
    main = sys.modules["__main__"]
    if written(thing).__module__ == "__main__" and not Path(getattr(main, "__file__", None) or "<stdin>").is_file():
        raise ValueError(f"{owner} cannot be handed to worker processes (it was typed in); {remedy}")
