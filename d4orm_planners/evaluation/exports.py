"""The store as CSV and Parquet, and the table of an evaluation."""

from __future__ import annotations

import csv
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, fields
from operator import attrgetter
from pathlib import Path

from d4orm_env.core.files import replaced_when_done
from d4orm_planners.evaluation.store import STORE, Trial, TrialStore
from d4orm_planners.evaluation.summary import SuccessRate
from d4orm_planners.evaluation.tables import markdown

PARQUET_HINT = 'trials.parquet is not written, which needs pyarrow; install it with pip install "d4orm-env[evaluate]"'


def write_results(folder: str | os.PathLike[str], rates: Sequence[SuccessRate]) -> list[Path]:
    """Write ``table.md`` and ``table.csv``, and of the store in the folder ``trials.csv`` and ``trials.parquet``.

    Args:
        folder: Where the store is.
        rates: What :func:`~d4orm_planners.evaluation.harness.evaluate` returned.

    Returns:
        The paths; ``trials.parquet`` is not among them, and not written, where pyarrow is not installed.

    Raises:
        OSError: If the folder cannot be written to.
    """
    trials = TrialStore.existing(Path(folder) / STORE).trials()
    paths = [Path(folder, name) for name in ("table.md", "table.csv", "trials.csv", "trials.parquet")]
    with target(paths[0]) as path:
        path.write_text(markdown(rates), encoding="utf-8")
    write_rates(paths[1], rates)
    write_csv(paths[2], trials)
    return paths if write_parquet(paths[3], trials) else paths[:3]


def write_rates(path: Path, rates: Sequence[SuccessRate]) -> None:
    """Write success rates as CSV, with a column ``rate`` in front.

    Raises:
        OSError: If the file cannot be written.
    """
    with target(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, ["rate", *asdict(rates[0])])
        writer.writeheader()
        writer.writerows({"rate": rate.rate, **asdict(rate)} for rate in rates)


def write_csv(path: Path, trials: Sequence[Trial]) -> None:
    """Write trials as CSV, one column per attribute; what is ``None`` is empty.

    Raises:
        OSError: If the file cannot be written.
    """
    names = [field.name for field in fields(Trial)]
    with target(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(names)
        writer.writerows(map(attrgetter(*names), trials))


def write_parquet(path: Path, trials: Sequence[Trial]) -> bool:
    """Write trials as Parquet, one column per attribute.

    Returns:
        Whether it was written: ``False`` where pyarrow is not installed.

    Raises:
        OSError: If the file cannot be written.
    """
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError:
        return False
    kinds = {"str": pyarrow.string(), "int": pyarrow.int64(), "float": pyarrow.float64(), "bool": pyarrow.bool_()}
    columns = {
        field.name: pyarrow.array(
            [getattr(trial, field.name) for trial in trials], kinds[str(field.type).partition(" ")[0]]
        )
        for field in fields(Trial)
    }
    with target(path) as temporary:
        parquet.write_table(pyarrow.table(columns), temporary)
    return True


@contextmanager
def target(path: Path) -> Iterator[Path]:
    """A temporary file that takes the place of ``path``; what goes wrong with it names ``path``.

    Raises:
        OSError: If it cannot be written.
    """
    try:
        with replaced_when_done(path) as temporary:
            yield temporary
    except OSError as error:
        reason = error.strerror or error
        raise OSError(f"{path} cannot be written: {reason}; free some space or choose another folder") from error
