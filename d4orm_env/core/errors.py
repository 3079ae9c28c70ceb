"""Errors that callers may want to tell apart."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches

from d4orm_env.core.arrays import short_repr


class UnknownKeywordError(TypeError, ValueError):
    """A keyword or setting that does not exist: a TypeError, as Python raises, and bad input like any other."""


class MissingFileError(ValueError, FileNotFoundError):
    """A file that does not exist: a FileNotFoundError, as Python raises, and bad input like any other."""


class FileAccessError(ValueError, OSError):
    """A file that the system does not read or write: an OSError, as Python raises, and bad input like any other."""


def first_line(error: BaseException) -> str:
    """The first line of the message, or the kind of an error without one."""
    return next(iter(str(error).splitlines()), type(error).__name__)


def describe(error: BaseException) -> str:
    """Kind and message on one line, which any file holds."""
    try:
        message = " ".join(str(error).split()).encode("utf-8", "backslashreplace").decode("utf-8")
    except Exception as another:  # a user's own may fail to say what it is
        message = f"its message fails with {type(another).__name__}"
    return f"{type(error).__name__}: {message}"


def unknown(what: str, value: object, known: Iterable[str], *others: str) -> ValueError:
    """The error for a name that is none of those known, with the one that was meant perhaps, and ``others`` to give."""
    names = list(known)
    remedy = ", or ".join((f"choose one of {', '.join(names)}", *others))
    return ValueError(f"{what} {short_repr(value)} is unknown; {remedy}{did_you_mean(value, names)}".lstrip())


def no_setting(name: str, owner: str, known: Iterable[str]) -> UnknownKeywordError:
    """The error for a setting that ``owner`` does not take, with the one that was meant perhaps."""
    names = list(known)
    return UnknownKeywordError(
        f"{name!r} is no setting of {owner}; it takes {', '.join(names)}{did_you_mean(name, names)}"
    )


ELSEWHERE = {
    "max_steps": "max_cycles", "max_episode_steps": "max_cycles", "time_limit": "max_cycles", "robots": "num_robots",
    "n_agents": "num_robots", "num_agents": "num_robots", "n_robots": "num_robots", "bicycle": "car",
    "double_integrator": "holonomic2d", "single_integrator": "velocity2d", "lidar": "observed_rays",
}  # fmt: skip
"""Names that other libraries have for the same."""


def did_you_mean(value: object, known: Iterable[str]) -> str:
    """The end of a message that names the known name that is meant, or most similar; empty if none is."""
    if not isinstance(value, str) or len(value) >= 100:
        return ""
    names = list(known)
    same = ELSEWHERE.get(value)
    close = [same] if same in names else get_close_matches(value, names, 1)
    return f"; did you mean {close[0]!r}?" if close else ""
