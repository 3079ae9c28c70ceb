"""Things by where they are written: import paths, the digest of their source, and whether other processes get them."""

from __future__ import annotations

import functools
import hashlib
import inspect
import pickle
import sys
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any

FORMS = "package.module:Name or folder/file.py:Name"


def load_reference(text: str) -> Any:
    """What ``"package.module:Name"`` or ``"folder/file.py:Name"`` names.

    Raises:
        ValueError: If the text has another form, or the module cannot be imported or has no such name.
    """
    place, _, name = text.rpartition(":")
    if not place or not all(part.isidentifier() for part in name.split(".")):
        raise ValueError(f"{text!r} is no import path; give {FORMS}")
    try:
        found: Any = _load_file(Path(place)) if place.endswith(".py") else import_module(place)
    except Exception as error:  # whatever foreign code raises when it is imported
        raise ValueError(
            f"{text!r} cannot be imported ({describe(error)}); give {FORMS}, of a module that Python finds and that "
            "can be imported by itself"
        ) from error
    for part in name.split("."):
        if not hasattr(found, part):
            raise ValueError(f"{text!r} names nothing: {place} has no {name!r}; give a name that the module defines")
        found = getattr(found, part)
    return found


def _load_file(path: Path) -> ModuleType:
    """A file as a module, executed once in a process."""
    name = f"d4orm_file_{hashlib.sha256(str(path.resolve()).encode()).hexdigest()[:16]}"
    if name not in sys.modules:
        spec = spec_from_file_location(name, path)
        assert spec is not None
        assert spec.loader is not None
        module = module_from_spec(spec)
        sys.modules[name] = module  # dataclasses look their module up there while it is executed
        try:
            spec.loader.exec_module(module)
        except BaseException:
            del sys.modules[name]
            raise
    return sys.modules[name]


def source_digest(thing: Any) -> str:
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


def written(thing: Any) -> Any:
    """The class or function whose source makes a thing what it is."""
    while isinstance(thing, functools.partial):
        thing = thing.func
    return thing if inspect.isclass(thing) or inspect.isroutine(thing) else type(thing)


def check_sendable(thing: Any, owner: str) -> None:
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


def describe(error: BaseException) -> str:
    """Kind and message on one line."""
    return f"{type(error).__name__}: {' '.join(str(error).split())}"
