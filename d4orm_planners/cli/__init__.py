"""Commands of the command line that fill a module of their own."""

from __future__ import annotations

import sys


def main() -> None:
    """Run the command line and exit, without a traceback if Ctrl-C comes while it is loaded."""
    try:
        from d4orm_planners.cli.app import main as run
    except KeyboardInterrupt:
        sys.exit(130)
    run()
