"""Things by name or by import path, of users and of installed packages: scenarios, planners and so on."""

from __future__ import annotations

import functools
import hashlib
import inspect
import os
import pickle
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

from d4orm_env.core.arrays import short_repr
from d4orm_env.core.errors import describe, did_you_mean, unknown

T = TypeVar("T", covariant=True)

FORMS = "package.module:Name or folder/file.py:Name"

_NAME = re.compile(r"[\w][\w.-]*")


class Registry(Mapping[str, T]):
    """Things by name: registered in this process, or entry points, of a ``group``, of packages; loaded when looked up.

    ``admit`` gives what is handed out under a name, or refuses it. Two things of equal identity are the same one,
    defined anew as in a notebook. Messages call them ``what``.
    """

    def __init__(
        self,
        what: str,
        group: str,
        admit: Callable[[str, Any], T],
        identity: Callable[[object], object] | None = None,
    ) -> None:
        self.what, self.group = what, group
        self._admit, self._identity = admit, identity or _qualified_name
        self._registered: dict[str, object] = {}
        self._admitted: dict[str, T] = {}

    def add(self, name: str, thing: object) -> None:
        """Register a thing, or the text ``"package.module:Name"`` of one; again if defined anew."""
        if not isinstance(name, str) or not _NAME.fullmatch(name):
            raise ValueError(
                f"{self.what} name {short_repr(name)} is none; give one of letters, digits, hyphens, dots and "
                "underscores"
            )
        if not isinstance(thing, str):
            self._admit(name, thing)
        known = self._registered.get(name, thing)
        if known is not thing and self._identity(known) != self._identity(thing):
            raise ValueError(f"{self.what} name {name!r} is taken; register yours under another")
        self._registered[name] = thing
        self._admitted.pop(name, None)

    def own(self) -> tuple[str, ...]:
        """Names registered in this process, in order."""
        return tuple(self._registered)

    def origin(self, name: str) -> object:
        """The thing registered under a name, or its import path."""
        claims = [self._registered[name]] if name in self._registered else []
        claims += [f"{entry.module}:{entry.attr}" for entry in self._entry_points.get(name, ())]
        if not claims:
            raise KeyError(name)
        if len(claims) > 1 and not self._same(claims):
            owners = " and ".join(claim if isinstance(claim, str) else short_repr(claim) for claim in claims)
            raise ValueError(f"{self.what} name {name!r} is claimed by {owners}; uninstall one of them")
        return claims[0]

    def _same(self, claims: list[object]) -> bool:
        """Check whether all are the same thing, such as one that its module registers and its package offers too."""
        try:
            first, *others = (self._identity(load_reference(one) if isinstance(one, str) else one) for one in claims)
        except ValueError:
            return False
        return all(other == first for other in others)

    def look_up(self, name: object) -> T:
        """Return the thing of this name."""
        return self._known(
            name,
            f"import its module (as --scenario FILE.py:FUNCTION does), or offer it by an entry point of {self.group}",
        )

    def _known(self, name: object, remedy: str) -> T:
        if not isinstance(name, str) or name not in self:
            raise unknown(self.what, name, self, remedy)
        return self[name]

    def find(self, text: object, others: str = "") -> T:
        """Return the thing that a name, or an import path, stands for; ``others`` is what else the caller takes."""
        if not isinstance(text, str) or text in self or ":" not in text:
            return self._known(text, f"give {others}{FORMS}")
        try:
            thing = load_reference(text)
        except ValueError as error:
            raise ValueError(f"{self.what} {error}") from error
        return self._admit(text, thing)

    def __getitem__(self, name: str) -> T:
        if name not in self._admitted:
            thing = self.origin(name)
            try:
                thing = load_reference(thing) if isinstance(thing, str) else thing
            except ValueError as error:
                raise ValueError(f"{self.what} {name!r}: {error}") from error
            self._admitted[name] = self._admit(name, thing)
        return self._admitted[name]

    def __contains__(self, name: object) -> bool:
        return name in self._registered or name in self._entry_points

    def __iter__(self) -> Iterator[str]:
        return iter(dict.fromkeys((*self._registered, *self._entry_points)))

    def __len__(self) -> int:
        return len(list(iter(self)))

    @functools.cached_property
    def _entry_points(self) -> dict[str, list[EntryPoint]]:
        found: dict[str, list[EntryPoint]] = {}
        for entry in installed().select(group=self.group):
            found.setdefault(entry.name, []).append(entry)
        return found


@functools.cache
def installed() -> Any:
    """``EntryPoints`` of all packages, read once for all registries, from a file of each package."""
    return entry_points()


def load_reference(text: str) -> object:
    """Load ``"package.module:Name"`` or ``"folder/file.py:Name"``; modules of the present folder are found too.

    Text of another form, or of which nothing can be imported, is a ValueError.
    """
    module, _, name = text.rpartition(":")
    if not module or not all(part.isidentifier() for part in name.split(".")):
        raise ValueError(f"{text!r} is no import path; give {FORMS}")
    try:
        found: object = _load_file(Path(module)) if module.endswith(".py") else _import(module)
    except Exception as error:  # whatever foreign code raises when it is imported
        raise ValueError(
            f"{text!r} cannot be imported ({describe(error)}); give {FORMS}, of a module that Python finds and that "
            "can be imported by itself"
        ) from error
    for part in name.split("."):
        if not hasattr(found, part):
            hint = did_you_mean(part, vars(found)) if hasattr(found, "__dict__") else ""
            raise ValueError(
                f"{text!r} names nothing: {module} has no {name!r}; give a name that the module defines{hint}"
            )
        found = getattr(found, part)
    return found


def _import(name: str) -> ModuleType:
    try:
        return import_module(name)
    except ModuleNotFoundError:
        if os.getcwd() in sys.path:
            raise
        sys.path.append(os.getcwd())
        return import_module(name)


def _load_file(path: Path) -> ModuleType:
    """A file as a module, executed once in a process."""
    name = f"d4orm_file_{hashlib.sha256(str(path.resolve()).encode()).hexdigest()[:16]}"
    if name not in sys.modules:
        spec = spec_from_file_location(name, path)
        assert spec is not None
        assert spec.loader is not None
        module = module_from_spec(spec)
        sys.modules[name] = module  # dataclasses look their module up there while it is executed
        if (folder := str(path.resolve().parent)) not in sys.path:
            sys.path.append(folder)  # its neighbours are found, as when Python runs it
        try:
            spec.loader.exec_module(module)
        except BaseException:
            del sys.modules[name]
            raise
    return sys.modules[name]


def _qualified_name(thing: object) -> object:
    """Module and name of a class or function; anything else is identified by itself."""
    name = getattr(thing, "__qualname__", "<")
    return thing if "<" in name else (thing.__module__, name)


def source_digest(thing: object) -> str:
    """SHA-256 of the file in which a class, a function or an instance's class is written; ValueError where there is
    none.
    """
    code = source_object(thing)
    try:
        file = inspect.getsourcefile(code)
        source = Path(file).read_bytes() if file and Path(file).is_file() else inspect.getsource(code).encode()
    except (OSError, TypeError):
        raise ValueError(
            f"the source of {code.__qualname__} cannot be read, so that a later version could not be told from this "
            "one; write it into a file"
        ) from None
    return hashlib.sha256(source).hexdigest()


def source_object(thing: Any) -> type | Callable[..., object]:
    """The class or function whose source makes a thing what it is."""
    while isinstance(thing, functools.partial) or _is_compiled(thing):
        thing = thing.func if isinstance(thing, functools.partial) else inspect.unwrap(thing)
    return thing if inspect.isclass(thing) or inspect.isroutine(thing) else type(thing)


def _is_compiled(thing: object) -> bool:
    """Check for a function in other clothes, as of ``jax.jit``; what Python wraps in a function has that's source."""
    return hasattr(thing, "__wrapped__") and not (inspect.isfunction(thing) or inspect.ismethod(thing))


def required_parameters(function: Callable[..., object]) -> int | None:
    """Return the number of positional parameters that a function requires; ``None`` if that says nothing about it."""
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        return None
    count = sum(
        parameter.kind in (parameter.POSITIONAL_ONLY, parameter.POSITIONAL_OR_KEYWORD)
        and parameter.default is parameter.empty
        for parameter in parameters
    )
    return None if not count and any(parameter.kind is parameter.VAR_POSITIONAL for parameter in parameters) else count


def check_call(function: Callable[..., object], owner: str, *arguments: str, **keywords: object) -> None:
    """Refuse a function of a user that cannot be called so, by a ValueError that begins with its ``owner``."""
    try:
        signature = inspect.signature(function)
    except ValueError:  # of built-in functions nobody knows
        return
    try:
        signature.bind(*arguments, **keywords)
    except TypeError as error:
        call = ", ".join((*arguments, *(f"{name}={value!r}" for name, value in keywords.items())))
        raise ValueError(f"{owner} takes {signature}, and is called with ({call}); {error}") from None


def check_sendable(thing: object, owner: str) -> None:
    """Find out whether other processes can import what a thing is made of."""
    remedy = "define it at the top level of a module that is a file, or run with workers=1 and no trial_timeout"
    try:
        pickle.dumps(thing)
    except Exception as error:  # pickle raises whatever the thing's own methods do
        raise ValueError(f"{owner} cannot be handed to worker processes ({describe(error)}); {remedy}") from error
    main = sys.modules["__main__"]
    if (
        source_object(thing).__module__ == "__main__"
        and not Path(getattr(main, "__file__", None) or "<stdin>").is_file()
    ):
        raise ValueError(f"{owner} cannot be handed to worker processes (it was typed in); {remedy}")
