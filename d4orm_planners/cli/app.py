"""The command ``d4orm``.

Exit status 0: done; 1: no solution found in the budget; 2: bad input, with one line on stderr that says what to change.
A command's module is imported when it is run, so that ``--help`` is quick.
"""

from __future__ import annotations

import gc
import importlib.metadata
import io
import re
import signal
import sys
import warnings
from collections import Counter
from collections.abc import Mapping
from dataclasses import fields
from importlib import import_module
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Option
from typer.core import TyperCommand, TyperGroup

from d4orm_env.scenarios.settings import Settings
from d4orm_planners.base.display import one_line
from d4orm_planners.cli import on_signals

if TYPE_CHECKING:
    from typing_extensions import Buffer

# Typer carries its own copy of click, whose base class it does not export.
ClickException: Any = next(kind for kind in typer.BadParameter.__mro__ if kind.__name__ == "ClickException")
LONGEST = 2000  #: Characters of a complaint at most: a name that was given may have any number

INSTEAD = {
    "planner": ("--policy", "here it is --policy"),
    "policy": ("--planner", "here it is --planner, and d4orm run takes policies"),
    "policies": ("--compare", "for several give --compare"),
    "set": ("--compare", "settings stand behind the policy, as in --policy d4orm:num_samples=64"),
}
"""Options of other commands: one that a command has in place, and what to say there."""

COMMANDS: Mapping[str, tuple[str, str]] = {
    "demo": ("run:demo", "Plan, execute, verify and draw a team in a warehouse."),
    "plan": ("plan_command:plan", "Plan for a team; write plan, picture or animation."),
    "run": ("run:run", "Run a plan or a policy in the environment."),
    "export": ("plan_command:export", "Write a plan as setpoints for robots to execute."),
    "play": ("run:play", "Look at a team live in a browser, and meddle with it."),
    "evaluate": ("evaluate_command:evaluate", "Compare policies on scenarios, seeds and disturbances."),
    "robustness": ("evaluate_command:robustness", "Measure success when something goes wrong."),
    "leaderboard": ("evaluate_command:leaderboard", "Write a page with the results of stored trials."),
    "dataset": ("train:dataset", "Record demonstrations as a Minari dataset."),
    "train": ("train:train", "Train a policy by reinforcement or imitation."),
    "bench": ("bench:bench", "Measure the speed of this machine."),
    "node": ("node_command:node", "Plan as one node of several on a network."),
    "serve": ("node_command:serve", "Drive robots on a ROS 2 network over Zenoh."),
    "warmup": ("warmup:warmup", "Compile ahead, so that the next start is quick."),
    "scenarios": ("listings:scenarios", "List the scenarios."),
    "planners": ("listings:planners", "List planners and policies, or the settings of one."),
}
"""Module and function of each command, and its line in the help."""


class OnceEach(TyperCommand):
    """A command with no empty option, as a variable of a shell may be, and none twice, unless it takes several.

    An empty path would be the present folder, and one of two options would count for nothing.
    """

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        values, _, order = self.make_parser(ctx).parse_args(args=list(args))
        for parameter, times in Counter(order).items():
            value = values[parameter.name]
            if "" in (value if isinstance(value, list | tuple) else [value]):
                raise ValueError(f"{parameter.opts[0]} is empty; give it a value, or leave it out")
            if times > 1 and not parameter.multiple:
                raise ValueError(f"{parameter.opts[0]} is given {times} times; give it once")
        return super().parse_args(ctx, args)


class Commands(TyperGroup):
    """The commands, each imported when it is looked up: help needs none of them.

    A file that ends too early is an error, which Typer takes for the end of the user's input.
    """

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.commands: Any = COMMANDS  # whose names it lists and suggests

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        if cmd_name not in COMMANDS:
            return None
        module, _, function = COMMANDS[cmd_name][0].partition(":")
        alone = typer.Typer(add_completion=False, rich_markup_mode=None)
        alone.command(cmd_name, cls=OnceEach)(getattr(import_module(f"d4orm_planners.cli.{module}"), function))
        command = typer.main.get_command(alone)
        if not gc.isenabled():  # see d4orm_planners.cli.main
            gc.freeze()
            gc.enable()
        return command

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, help_) for name, (_, help_) in COMMANDS.items()])

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except EOFError as error:
            raise OSError(f"something that was read ended too early ({error or 'no message'})") from error


app = typer.Typer(
    name="d4orm", cls=Commands, add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False
)


def _tell_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"d4orm {importlib.metadata.version('d4orm-env')}")
        raise typer.Exit


@app.callback(invoke_without_command=True)
def options(
    context: typer.Context,
    version: Annotated[
        bool, Option("--version", callback=_tell_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Plan and run teams of robots that cross each other's way without touching."""
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


class _Pipe(io.FileIO):
    """A stream whose reader may leave, as ``head`` does: what is left is dropped, and the command goes on."""

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


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and exit."""
    _standard_streams()
    try:
        # SIGTERM is what Ctrl-C is, so that nothing half-written is left behind.
        with on_signals(signal.default_int_handler, signal.SIGTERM), warnings.catch_warnings():
            warnings.showwarning = _warn
            status = app(arguments, standalone_mode=False)
    except ClickException as error:
        status = _complain(_in_plain_words(error.format_message()) + _given(error))
    except (ValueError, OSError, ImportError) as error:  # ImportError: an extra that is not installed
        status = _complain(_message(error))
    except (KeyboardInterrupt, typer.Abort):
        status = 130
    sys.exit(status if isinstance(status, int) else 0)


def _message(error: Exception) -> str:
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    return str(error)


def _in_plain_words(message: str) -> str:
    """The message without the words of the library that reads numbers."""
    for kind, what in (("integer", "a whole number"), ("number", "a number")):
        message = re.sub(
            f"Input should be a valid {kind}, unable to parse string as an? {kind}", f"must be {what}", message
        )
    return message


def _given(error: Any) -> str:
    """Remedy for an argument of scenarios; or the value given, which Typer leaves out where a type does not fit."""
    name = getattr(error, "option_name", "").lstrip("-").replace("-", "_")
    context = getattr(error, "ctx", None)
    known = {option for parameter in context.command.params for option in parameter.opts} if context else ()
    if context and type(error).__name__ == "MissingParameter":
        return f" See d4orm {context.info_name} --help."
    if "unexpected extra argument" in error.message and "--scenario" in known:
        return "; a scenario or its file goes by --scenario"
    if INSTEAD.get(name, ("",))[0] in known:
        return "; " + INSTEAD[name][1]
    if "--scenario-set" in known and name in (field.name for field in fields(Settings)):
        return f"; arguments of scenarios go by --scenario-set {name}=..."
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
