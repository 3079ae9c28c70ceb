"""``d4orm warmup``: kernels compiled ahead."""

from __future__ import annotations

import typer

from d4orm_env.engine.caching import check_can_be_kept
from d4orm_planners.cli.common_options import Quiet
from d4orm_planners.cli.warmup import warm_up


def warmup(quiet: Quiet = False) -> None:
    """Compile ahead what planning and the environments need, so that the next start is quick."""
    check_can_be_kept()
    report = warm_up()
    if not quiet:
        typer.echo(
            f"{len(report.compiled)} kernels compiled, {len(report.loaded)} found in the cache, {report.seconds:.1f} s"
        )
        for folder in report.folders:
            typer.echo(f"cache {folder}")
    if report.lost:
        raise OSError(f"{len(report.lost)} kernels could not be kept; free some space, or set NUMBA_CACHE_DIR")
