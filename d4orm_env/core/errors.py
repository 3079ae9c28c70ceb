"""Errors that callers may want to tell apart."""

from __future__ import annotations


class UnknownKeywordError(TypeError, ValueError):
    """A keyword or setting that does not exist: a TypeError, as Python raises, and bad input like any other."""


def first_line(error: BaseException) -> str:
    """The first line of the message, or the kind of an error without one."""
    return next(iter(str(error).splitlines()), type(error).__name__)


def describe(error: BaseException) -> str:
    """Kind and message on one line."""
    return f"{type(error).__name__}: {' '.join(str(error).split())}"
