"""Registries for tests: what is registered in one is forgotten after it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from d4orm_env.core.registry import Registry, installed
from d4orm_env.dynamics.models import MODEL_CODES


@contextmanager
def forgetting(*tables: Registry) -> Iterator[None]:
    """Forget what is registered meanwhile, and look things up anew."""
    dictionaries = [MODEL_CODES, *(vars(table)[name] for table in tables for name in ("_registered", "_admitted"))]
    before = [dict(each) for each in dictionaries]
    for table in tables:
        table._admitted.clear()
    _read_anew(tables)
    try:
        yield
    finally:
        for each, content in zip(dictionaries, before):
            each.clear()
            each.update(content)
        _read_anew(tables)


def _read_anew(tables: tuple[Registry, ...]) -> None:
    installed.cache_clear()
    for table in tables:
        vars(table).pop("_entry_points", None)
