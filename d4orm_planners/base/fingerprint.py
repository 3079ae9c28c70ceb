"""Fingerprints of objects, by which a store of trials distinguishes a user's instances and functions."""

from __future__ import annotations

import copyreg
import hashlib
import inspect
import json
from collections.abc import Mapping
from functools import partial
from types import CodeType, FunctionType, MethodType, ModuleType

from d4orm_env.core.errors import describe
from d4orm_env.core.problem import Problem


def attributes(thing: object) -> dict[str, object]:
    """All that distinguishes an instance or a function from others of the same source, by name, as JSON has it.

    These are the attributes of an instance, and the default arguments and closure of a function. Numbers, truth values
    and text stay as they are; of all else there is a digest.

    Raises:
        ValueError: If one of them cannot be told from others of its type, as an open file.
    """
    if isinstance(thing, partial):
        given = {str(number): value for number, value in enumerate(thing.args)} | thing.keywords
        return attributes(thing.func) | _described(given, thing.func)
    if isinstance(thing, MethodType):
        return attributes(thing.__self__) | attributes(thing.__func__)
    if isinstance(thing, FunctionType):
        parameters = inspect.signature(thing).parameters.values()
        defaults = {own.name: own.default for own in parameters if own.default is not own.empty}
        return _described(defaults | dict(inspect.getclosurevars(thing).nonlocals), thing)
    if isinstance(thing, type):
        return {}
    return _described(_state(thing), thing)


def _state(thing: object) -> dict[str, object]:
    """Attributes of an instance, those in slots too."""
    state = object.__getstate__(thing)
    parts = state if isinstance(state, tuple) else (state,)
    return {name: value for part in parts if part for name, value in part.items()}


def _described(values: Mapping[str, object], owner: object) -> dict[str, object]:
    digests, found = _Digests(), {}
    for name, value in values.items():
        try:
            found[name] = digests.of(value)
        except Exception as error:  # objects reduce themselves by methods of their own
            called = getattr(owner, "__name__", type(owner).__name__)
            raise ValueError(
                f"{name!r} of {called} cannot be told from others of its kind "
                f"({describe(error)}), so that stored trials could be another policy's; give a class whose method "
                "identity() returns what tells it, as {'gain': 1}"
            ) from error
    return found


class _Digests:
    """Digests of objects by what pickling keeps of them, each object looked at once."""

    def __init__(self) -> None:
        self._known: dict[int, tuple[object, str]] = {}  # the objects too, for others may get their ids

    def of(self, value: object) -> object:
        """A number, truth value or text itself; of all else the SHA-256 of its parts."""
        if value is None or isinstance(value, bool | int | float | str):
            return value
        if id(value) not in self._known:
            self._known[id(value)] = value, "itself"
            text = json.dumps([type(value).__qualname__, *map(self.of, self._parts(value))])
            self._known[id(value)] = value, hashlib.sha256(text.encode()).hexdigest()
        return self._known[id(value)][1]

    def _parts(self, value: object) -> list[object]:
        """The parts that distinguish an object from others of its type."""
        if isinstance(value, list | tuple) and type(value) in (list, tuple):
            return list(value)
        if type(value) is dict:
            return [part for item in value.items() for part in item]
        if isinstance(value, set | frozenset):
            return sorted(map(self.of, value), key=repr)
        if isinstance(value, bytes | bytearray):
            return [value.hex()]
        if isinstance(value, Problem):
            return [value.digest]
        if isinstance(value, FunctionType):
            return [value.__code__, attributes(value)]
        if isinstance(value, CodeType):
            return [value.co_code, value.co_names, value.co_consts]
        if isinstance(value, type | ModuleType):
            return [getattr(value, "__module__", ""), getattr(value, "__qualname__", value.__name__)]
        if hasattr(value, "act") and hasattr(value, "identity"):
            return [type(value), value.identity()]
        if hasattr(value, "__wrapped__"):  # compiled or cached
            return [value.__wrapped__]
        reduce = copyreg.dispatch_table.get(type(value))
        reduced = reduce(value) if reduce else value.__reduce_ex__(4)
        if isinstance(reduced, str):
            return [reduced]
        made, given, state, items, pairs, *_ = (*reduced, None, None, None)
        return [made, given, state, list(items or ()), list(pairs or ())]
