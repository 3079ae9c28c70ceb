"""Sphinx's search for what a name in a signature means, without a walk through all objects for each."""

from __future__ import annotations

from typing import Any

from sphinx.domains.python import PythonDomain


class IndexedPythonDomain(PythonDomain):
    """Sphinx's own, but it looks only for names that the last part of some object's name is.

    Most names in signatures are Python's or other libraries', and Sphinx compares each with every object.
    """

    _last_parts: tuple[int, frozenset[str]] = (0, frozenset())

    def find_obj(self, env: Any, modname: str, classname: str, name: str, *how: Any) -> list[tuple[str, Any]]:
        """Objects of a name, by name; what Sphinx finds."""
        if self._last_parts[0] != len(self.objects):
            self._last_parts = len(self.objects), frozenset(known.rpartition(".")[2] for known in self.objects)
        if name.removesuffix("()").rpartition(".")[2] not in self._last_parts[1]:
            return []
        return super().find_obj(env, modname, classname, name, *how)
