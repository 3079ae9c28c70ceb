"""``d4orm node``: one node of D-D4orm on a network, as on a robot's own computer."""

from __future__ import annotations

import logging
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from d4orm_planners.cli.arguments import check_target
from d4orm_planners.cli.node_file import load_node

if TYPE_CHECKING:
    from d4orm_planners.base.plan import IterationRecord


def node(
    config: Annotated[Path, typer.Option("--config", "-c", help="YAML file that says what the node has to do.")],
) -> None:
    """Plan as one node of several on a network: exchange candidates, end with the best one known, write it."""
    task = load_node(config)
    check_target(task.out, (".npz",))
    number = task.planner.config.node
    typer.echo(f"node {number} of {task.planner.config.nodes}, problem {task.problem.digest[:8]}")
    with _events_as_lines(), _ended_by_signals() as over:
        plan = task.planner.solve(task.problem, task.seed, task.time_limit, callback=_tell)
        over.set()
        plan.save(task.out)
    typer.echo(
        f"node {number} ends ({plan.status.replace('_', ' ')}): best candidate "
        f"{'solves the problem' if plan.solved else 'does not solve the problem'}, reward {plan.metrics['reward']:.6f}"
    )
    typer.echo(f"wrote {task.out}")
    if not plan.solved:
        raise typer.Exit(1)


def _tell(record: IterationRecord) -> None:
    outcome = "solved" if record.solved else f"{record.num_failed} robots fail"
    note = f"; {record.note}" if record.note else ""
    typer.echo(f"iteration {record.iteration} at {record.wall_time:.2f} s: reward {record.reward:.3f}, {outcome}{note}")


class _Lines(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        typer.echo(record.getMessage())


@contextmanager
def _events_as_lines() -> Iterator[None]:
    """Print what the nodes log."""
    logger, handler = logging.getLogger("d4orm_planners.d_d4orm"), _Lines()
    level = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    try:
        yield
    finally:
        logger.setLevel(level)
        logger.removeHandler(handler)


@contextmanager
def _ended_by_signals() -> Iterator[threading.Event]:
    """The first SIGINT or SIGTERM interrupts the solve, which then ends with the best so far; later ones do nothing.

    Nor does the first, once the event that is handed out is set.
    """
    over = threading.Event()

    def interrupt(number: int, frame: object) -> None:
        if not over.is_set():
            over.set()
            raise KeyboardInterrupt

    former = {number: signal.signal(number, interrupt) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield over
    finally:
        for number, handler in former.items():
            signal.signal(number, handler)
