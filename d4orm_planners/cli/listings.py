"""``d4orm scenarios`` and ``d4orm planners``: lists of names."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

from typer import Argument

from d4orm_env.scenarios import describe_scenario, list_scenarios
from d4orm_planners.base.names import PLANNERS, POLICIES
from d4orm_planners.base.planner_registry import default_settings, describe_policy, preset_names
from d4orm_planners.cli.outputs import print_table


def scenarios() -> None:
    """List the scenarios."""
    print_table("Scenarios", [(name, _or_error(describe_scenario, name)) for name in list_scenarios()])


def planners(
    name: Annotated[str | None, Argument(help="List the settings of this one, with their defaults.")] = None,
) -> None:
    """List the planners and policies, or what --set can set of one, and its presets."""
    if name is not None:
        settings = [(setting, str(value)) for setting, value in default_settings(name).items()]
        presets = [("preset", ", ".join(names))] if (names := preset_names(name)) else []
        print_table(name, [*settings, *presets] or [("no settings", "")])
        return
    for title, table in (("Planners", PLANNERS), ("Policies", POLICIES)):
        print_table(title, [(name, _or_error(describe_policy, name)) for name in table])


def _or_error(describe: Callable[[str], str], name: str) -> str:
    """A description as plain text, or why there is none: what another package brings may be broken."""
    try:
        return describe(name).replace("``", "")
    except ValueError as error:
        return f"unusable: {error}"
