"""Results of a study as tables and files: Markdown, CSV and Parquet."""

from __future__ import annotations

import csv
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from d4orm_env.core.arrays import short_repr
from d4orm_env.core.errors import first_line
from d4orm_env.core.files import replaced_when_done, require_file
from d4orm_env.core.lazy import LazyModule, load
from d4orm_planners.base.display import markdown_text, one_line, spreadsheet_cell
from d4orm_planners.evaluation.store import STORE, Trial, TrialStore, checked_trial
from d4orm_planners.evaluation.summary import SuccessRate, SuccessWithin

if TYPE_CHECKING:
    from pyarrow.parquet import ParquetFile

pyarrow: Any = LazyModule("pyarrow", "Parquet", "evaluate")
parquet: Any = LazyModule("pyarrow.parquet", "Parquet", "evaluate")
MAX_TRIALS, MAX_BYTES = 10**7, 2**32  #: Limits of a Parquet file that is read
LATER = {"denoising_share"}  #: Columns that files of earlier versions do not have
PARQUET_HINT = "trials.parquet is not written, which needs pyarrow; install it with: pip install 'd4orm-env[evaluate]'"
HEADER = ("policy", "noise", "success", "95% interval", "verified", "contact", "not in time", "errors",
          "travel time, s", "stretch", "denoising steps", "denoising, iterations", "denoising, time", "planning, s",
          "decision, ms", "training, min", "computing per s of motion, s")  # fmt: skip


def write_results(folder: str | os.PathLike[str], rates: Sequence[SuccessRate]) -> list[Path]:
    """Write ``table.md`` and ``table.csv``, and of the store in the folder ``trials.csv`` and ``trials.parquet``.

    The paths are returned; the last is not among them, and not written, where pyarrow is not installed.
    """
    trials = TrialStore.existing(Path(folder) / STORE).trials()
    paths = [Path(folder, name) for name in ("table.md", "table.csv", "trials.csv", "trials.parquet")]
    with replaced_when_done(paths[0]) as path:
        path.write_text(markdown(rates), encoding="utf-8")
    write_rates(paths[1], rates)
    write_csv(paths[2], [vars(trial) for trial in trials])
    return paths if write_parquet(paths[3], trials) else paths[:3]


def write_rates(path: Path, rates: Sequence[SuccessRate]) -> None:
    """Write success rates as CSV, with a column ``rate`` in front."""
    write_csv(path, [{"rate": rate.rate, **vars(rate)} for rate in rates])


def write_csv(path: Path, rows: Sequence[Mapping[str, object]]) -> None:
    """Write at least one row, all with the same columns, as CSV; what is ``None`` is empty, and no text a formula."""
    with replaced_when_done(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows({name: spreadsheet_cell(value) for name, value in row.items()} for row in rows)


def write_parquet(path: Path, trials: Sequence[Trial]) -> bool:
    """Write trials as Parquet, one column per attribute; ``False``, and nothing written, without pyarrow."""
    try:
        load(pyarrow)
    except ImportError:
        return False
    kinds = {"str": pyarrow.string(), "int": pyarrow.int64(), "float": pyarrow.float64(), "bool": pyarrow.bool_()}
    columns = {
        field.name: pyarrow.array(
            [getattr(trial, field.name) for trial in trials], kinds[str(field.type).partition(" ")[0]]
        )
        for field in fields(Trial)
    }
    with replaced_when_done(path) as temporary:
        parquet.write_table(pyarrow.table(columns), temporary)
    return True


def read_parquet(path: str | os.PathLike[str]) -> list[Trial]:
    """The trials that :func:`write_parquet` wrote; ImportError where pyarrow is not installed.

    A ValueError if the file is no Parquet, has other columns, or more than a store has room for, or a value of another
    type.
    """
    try:
        require_file(Path(path), "one that d4orm evaluate wrote")
        with parquet.ParquetFile(path) as file:
            return list(_trials(file))
    except (pyarrow.ArrowException, OSError, TypeError, KeyError, ValueError, OverflowError) as error:
        if isinstance(error, OSError) and error.errno is not None:
            raise
        # A damaged file is to pyarrow an OSError as well.
        raise ValueError(
            f"{os.fspath(path)} is no Parquet file of trials ({first_line(error)}); give one that d4orm evaluate wrote"
        ) from error


def _trials(file: ParquetFile) -> Iterator[Trial]:
    """The trials of a file that another may have written, which says first how much it holds."""
    about = file.metadata
    size = sum(about.row_group(group).total_byte_size for group in range(about.num_row_groups))
    if about.num_rows > MAX_TRIALS or size > MAX_BYTES:
        raise ValueError(f"it has {about.num_rows} rows of {size} bytes; at most {MAX_TRIALS} of {MAX_BYTES} are read")
    defaults = {field.name: field.default for field in fields(Trial) if field.name in LATER}
    names, known = set(file.schema_arrow.names), {field.name for field in fields(Trial)}
    if wrong := sorted((names - known) | (known - names - LATER)):
        raise ValueError(f"its columns differ from those of trials in {', '.join(map(short_repr, wrong[:5]))}")
    number = 0
    for batch in file.iter_batches(batch_size=1024):
        for row in batch.to_pylist():
            try:
                yield checked_trial({**defaults, **row})
            except ValueError as error:
                raise ValueError(f"trial {number} {error}") from None
            number += 1


def markdown(rates: Sequence[SuccessRate]) -> str:
    """One table per scenario and team, with errors below. Intervals of means are in brackets."""
    blocks = [rate_table(title, group) for title, group in panels(rates).items()]
    return "\n\n".join([*blocks, *errors((rate.label, rate.error) for rate in rates)]) + "\n"


def rate_table(title: str, rates: Sequence[SuccessRate]) -> str:
    """A table of rates, with a column more where something but noise went wrong."""
    disturbed = any(rate.disturbance for rate in rates)
    header = (*HEADER[:2], "disturbance", *HEADER[2:]) if disturbed else HEADER
    # The undisturbed trials are the same for all disturbances.
    once = {(rate.label, rate.control_noise_std) if rate.undisturbed else number: rate
            for number, rate in reversed(list(enumerate(rates)))}  # fmt: skip
    return table(title, header, [_cells(rate, disturbed) for rate in reversed(once.values())])


def _cells(rate: SuccessRate, disturbed: bool) -> tuple[str, ...]:
    level = "" if rate.level is None else f" {rate.level:g}"
    what = "-" if rate.undisturbed else f"{rate.disturbance}{level}" or "-"
    return (
        rate.label,
        f"{rate.control_noise_std:g}",
        *[what] * disturbed,
        f"{rate.successes} of {rate.trials} ({rate.rate:.0%})",
        f"{rate.lower:.0%} to {rate.upper:.0%}",
        "-" if rate.verified is None else str(rate.verified),
        *(str(count) for count in (rate.contacts, rate.late, rate.errors)),
        interval(rate.travel_time, rate.travel_time_lower, rate.travel_time_upper, 2),
        "-" if rate.stretch is None else f"{rate.stretch:.2f}",
        "-" if rate.denoising_steps is None else f"{rate.denoising_steps:g}",
        "-" if rate.denoising_share is None else f"{rate.denoising_share:.0%}",
        "-" if rate.denoising_time_share is None else f"{rate.denoising_time_share:.0%}",
        "-" if rate.wall_time is None else f"{rate.wall_time:.2f}",
        "-" if rate.decision is None else f"{1e3 * rate.decision:.2f}",
        "-" if rate.training_time is None else f"{rate.training_time / 60:.0f}",
        interval(rate.compute, rate.compute_lower, rate.compute_upper, 3),
    )


def interval(mean: float | None, lower: float | None, upper: float | None, digits: int) -> str:
    """A mean with its interval in brackets; a dash where nothing was measured."""
    if mean is None:
        return "-"
    return f"{mean:.{digits}f}" + ("" if lower is None else f" ({lower:.{digits}f} to {upper:.{digits}f})")


def table(title: str, header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    head, *body = (f"| {' | '.join(map(markdown_text, row))} |" for row in (header, *rows))
    return "\n".join([f"### {markdown_text(title)}", "", head, "|" + "---|" * len(header), *body])


def share(rate: SuccessRate | SuccessWithin) -> str:
    """A success rate with its interval in brackets."""
    return f"{rate.rate:.0%} ({rate.lower:.0%} to {rate.upper:.0%})"


def deadline_table(title: str, rows: Iterable[tuple[str, Sequence[SuccessWithin]]]) -> str:
    """Success by deadline: one row per policy, one column per deadline."""
    listed = list(rows)
    header = ("policy", *(f"{within.deadline:g} s" for within in listed[0][1]))
    lines = [(label, *map(share, line)) for label, line in listed]
    return table(title, header, lines)


def panels(rates: Iterable[SuccessRate]) -> dict[str, list[SuccessRate]]:
    """Rates by scenario, team size, models and physics, as titles, in order of appearance."""
    groups: dict[str, list[SuccessRate]] = {}
    for rate in rates:
        title = f"{rate.scenario}, {rate.num_robots} robots, {rate.model}{in_physics(rate.physics)}"
        groups.setdefault(title, []).append(rate)
    return groups


def in_physics(physics: str) -> str:
    """Return the physics, to put behind a title; nothing for what planners believe in."""
    return "" if physics == "model" else f", in {physics}"


def errors(found: Iterable[tuple[str, str]]) -> list[str]:
    """Labels with their errors, listed as the only block; no block where all errors are empty."""
    lines = dict.fromkeys(
        f"- `{one_line(label).replace('`', chr(39))}`: {markdown_text(error)}" for label, error in found if error
    )
    return ["\n".join(["### Errors", "", *lines])] if lines else []
