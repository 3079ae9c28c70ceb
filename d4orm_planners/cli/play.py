"""``d4orm play``: a team live in a browser."""

from __future__ import annotations

import os
import sys
import threading
import webbrowser
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import rich
import typer

from d4orm_planners.cli import on_signals
from d4orm_planners.cli.arguments import names
from d4orm_planners.cli.common_options import ObservationOptions, ProblemOptions, takes

if TYPE_CHECKING:
    from d4orm_planners.play.playground import Playground

LAST_WAIT = 2.0
"""Seconds from Ctrl-C to the end of the process."""


@dataclass(frozen=True, kw_only=True)
class PlayOptions(ObservationOptions, ProblemOptions):
    """Options on the first scene, and on the page's address."""

    policy: Annotated[
        str, typer.Option("--policy", "-p", help="What drives (see `d4orm planners`); several, separated by commas.")
    ] = "d4orm-c2f"
    host: Annotated[str, typer.Option(help="Where to be found; elsewhere than here the address has a token.")] = (
        "127.0.0.1"
    )
    port: Annotated[int, typer.Option(help="Port; any free one by default.")] = 0
    open_browser: Annotated[bool, typer.Option("--open/--no-open", help="Open a browser if there is one.")] = True


@takes(PlayOptions)
def play(options: PlayOptions) -> None:
    """Look at a team live in a browser, and meddle with it; needs the extra viz."""
    # Some libraries, while they are loaded, swallow what a signal raises.
    with on_signals(lambda *_: os._exit(130)):
        playground = _playground(options)
    try:
        typer.echo(f"open {playground.address}\nCtrl-C ends it")
        if options.open_browser and has_display():
            webbrowser.open(playground.address)
        playground.run()
    except KeyboardInterrupt:
        # Python waits for threads of planners, which may be in the middle of a plan.
        watchdog = threading.Timer(LAST_WAIT, os._exit, (130,))
        watchdog.daemon = True
        watchdog.start()
        raise
    finally:
        playground.close()


def _playground(options: PlayOptions) -> Playground:
    try:
        from d4orm_planners.play.playground import Playground
    except ImportError as error:
        raise ImportError("d4orm play needs viser; install it with: pip install 'd4orm-env[viz]'") from error

    quieten_viser()
    typer.echo("getting ready; the first time this compiles for a while ...")
    policies = names(options.policy) or ()
    return Playground(
        options.problem(), *policies, seed=options.seed, host=options.host, port=options.port, **options.observation
    )


def quieten_viser() -> None:
    """Keep viser from printing, by rich, a line for every client of another version."""
    rich.get_console().quiet = True


def has_display() -> bool:
    """Check whether a browser would have something to draw on."""
    return sys.platform in ("darwin", "win32") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
