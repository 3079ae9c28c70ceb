"""The command ``d4orm``.

Exit status 0: done; 1: no solution found in the budget; 2: bad input, with one line on stderr that says what to change.
Heavy imports happen inside the commands, so that ``--help`` is quick.
"""

from __future__ import annotations

import importlib.metadata
import io
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from d4orm_planners.base.escaping import one_line
from d4orm_planners.cli.bench import bench
from d4orm_planners.cli.common_options import Quiet
from d4orm_planners.cli.dataset_command import dataset
from d4orm_planners.cli.demo import demo
from d4orm_planners.cli.evaluate_command import evaluate
from d4orm_planners.cli.export_command import export
from d4orm_planners.cli.leaderboard_command import leaderboard
from d4orm_planners.cli.node_command import node
from d4orm_planners.cli.outputs import print_table
from d4orm_planners.cli.plan_command import plan
from d4orm_planners.cli.play import play
from d4orm_planners.cli.robustness_command import robustness
from d4orm_planners.cli.run import run
from d4orm_planners.cli.train import train

if TYPE_CHECKING:
    from typing_extensions import Buffer

# Typer carries its own copy of click, whose base class it does not export.
ClickException: Any = next(kind for kind in typer.BadParameter.__mro__ if kind.__name__ == "ClickException")

LONGEST = 2000
"""Characters of a complaint at most: a name that was given may have any number."""


class Commands(TyperGroup):
    """The commands. A file that ends too early is not taken for the end of what somebody types, which Typer does."""

    def invoke(self, ctx: Any) -> Any:
        """Run the command that was chosen."""
        try:
            return super().invoke(ctx)
        except EOFError as error:
            raise OSError(f"something that was read ended too early ({error or 'no message'})") from error


app = typer.Typer(
    name="d4orm",
    cls=Commands,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)

COMMANDS = (demo, plan, run, export, play, evaluate, robustness, leaderboard, dataset, train, bench, node)
for command in COMMANDS:
    app.command()(command)


def _tell_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"d4orm {importlib.metadata.version('d4orm-env')}")
        raise typer.Exit


@app.callback(invoke_without_command=True)
def options(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", callback=_tell_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Plan and run teams of robots that cross each other's way without touching."""
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


@app.command()
def warmup(quiet: Quiet = False) -> None:
    """Compile ahead what planning and the environments need, so that the next start is quick."""
    from d4orm_env.engine.caching import check_can_be_kept
    from d4orm_planners.cli.warmup import warm_up

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


@app.command()
def scenarios() -> None:
    """List the scenarios."""
    from d4orm_env.scenarios import describe_scenario, list_scenarios

    def described(name: str) -> str:
        try:
            return describe_scenario(name)
        except ValueError as error:  # an installed package offers it and cannot be imported
            return str(error)

    print_table("Scenarios", [(name, described(name)) for name in list_scenarios()])


@app.command()
def planners(
    name: Annotated[str | None, typer.Argument(help="List the settings of this one, with their defaults.")] = None,
) -> None:
    """List the planners and policies, or what --set can set of one."""
    from d4orm_planners.base.names import PLANNERS, POLICIES
    from d4orm_planners.base.planner_registry import default_settings, describe_planner, describe_policy

    if name is not None:
        settings = default_settings(name).items()
        print_table(name, [(setting, str(value)) for setting, value in settings] or [("no settings", "")])
        return
    for title, table, describe in (("Planners", PLANNERS, describe_planner), ("Policies", POLICIES, describe_policy)):
        print_table(title, [(name, _or_error(describe, name)) for name in table])


def _or_error(describe: Callable[[str], str], name: str) -> str:
    """A description, or why there is none: what another package brings may be broken."""
    try:
        return describe(name)
    except ValueError as error:
        return f"unusable: {error}"


class _Pipe(io.FileIO):
    """A stream that nobody may read to its end, as ``head`` does: what is left is dropped, and the command goes on."""

    _ended = False

    def write(self, data: Buffer, /) -> int:
        try:
            return memoryview(data).nbytes if self._ended else super().write(data)
        except OSError as error:
            self._ended = True  # a full disk is told of once, not at the exit again
            if not isinstance(error, BrokenPipeError):
                raise
            return memoryview(data).nbytes


def _standard_streams() -> None:
    """Have no character that they lack, and no reader that leaves, end a command."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if not isinstance(stream, io.TextIOWrapper):  # closed, or a test's
            continue
        stream.reconfigure(errors="backslashreplace")
        if stream is getattr(sys, f"__{name}__") and not stream.isatty():
            pipe = io.BufferedWriter(_Pipe(stream.fileno(), "w", closefd=False))
            setattr(sys, name, io.TextIOWrapper(pipe, stream.encoding, stream.errors, line_buffering=True))


@contextmanager
def _interrupted_by_sigterm() -> Iterator[None]:
    """Let SIGTERM be what Ctrl-C is, so that nothing half-written is left behind."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    former = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, former)


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and exit."""
    _standard_streams()
    try:
        with _interrupted_by_sigterm(), warnings.catch_warnings():
            warnings.showwarning = _warn
            status = app(arguments, standalone_mode=False)
    except ClickException as error:
        status = _complain(error.format_message() + _given(error))
    except (ValueError, OSError, ImportError) as error:  # ImportError: an extra that is not installed
        status = _complain(_message(error))
    except (KeyboardInterrupt, typer.Abort):
        status = 130
    sys.exit(status if isinstance(status, int) else 0)


def _message(error: Exception) -> str:
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    return str(error)


def _given(error: BaseException) -> str:
    """What was given, which Typer leaves out where a type does not fit."""
    errors = getattr(error.__cause__, "errors", None)
    return f", not {errors()[0]['input']!r}" if errors is not None else ""


def _complain(message: str) -> int:
    line = one_line(" ".join(message.split()))
    if len(line) > LONGEST:
        line = f"{line[: LONGEST // 2]} ... {line[-LONGEST // 2 :]}"
    typer.echo(f"d4orm: {line}", err=True)
    return 2


def _warn(message: Warning | str, *where: object, **more: object) -> None:
    """Say it without the place in the program that Python names."""
    _complain(f"warning: {message}")


if __name__ == "__main__":
    main()
