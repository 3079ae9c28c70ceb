"""Options that several commands share, commands that take a dataclass of options, and reading what was given.

Here and in all commands, what makes no sense is a ``ValueError`` of one line, which names it and says what to change.
"""

from __future__ import annotations

import inspect
import math
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields
from functools import wraps
from typing import Annotated, Any, TypeVar, get_type_hints

import typer
from typer import Option

from d4orm_env import scenarios
from d4orm_env.core.files import parse_yaml
from d4orm_env.core.lazy import LazyModule
from d4orm_env.core.problem import Problem
from d4orm_env.scenarios.problems import is_scenario_file
from d4orm_planners.base.planner_registry import list_policies

T = TypeVar("T")
N = TypeVar("N", int, float)
_physics: Any = LazyModule("d4orm_planners.base.episode")
MOST_SEEDS = 1_000_000  #: Trials of one policy at most: a slip of the finger must not fill the memory

Model = Annotated[
    str | None,
    Option("--model", "-m", help="Robot model, or one a robot, as car,unicycle; the scenario's own by default."),
]
ScenarioSettings = Annotated[
    list[str] | None, Option("--scenario-set", help="An argument of the scenario, as diameter=8; repeatable.")
]
Seed = Annotated[int, Option("--seed", help="Seed of the scenario and of the planner.")]
Engine = Annotated[str, Option("--engine", help="auto, cpu or jax.")]
TimeLimit = Annotated[float | None, Option("--time-limit", help="Seconds for planning.")]
Quiet = Annotated[bool, Option("--quiet", "-q", help="No progress and no tables.")]
ScenarioName = Annotated[
    str,
    Option("--scenario", "-s", help="Scenario name (see `d4orm scenarios`), a YAML file or package.module:function."),
]
NumRobots = Annotated[int | None, Option("--num-robots", "--robots", "-k", help="Robots; by default the scenario's.")]
Settings = Annotated[
    list[str] | None, Option("--set", help="A setting of the planner or policy, as num_samples=512; repeatable.")
]
NoiseLevel = Annotated[float, Option("--control-noise-std", "--noise", help="Standard deviation of execution noise.")]
Disturb = Annotated[
    list[str] | None, Option("--disturb", help="A disturbance at a level, as delay=2 or push.speed=0.3; repeatable.")
]
Workers = Annotated[int | None, Option("--workers", "-j", help="Processes; all cores by default.")]


def takes(options: type[T]) -> Callable[[Callable[[T], None]], Callable[..., None]]:
    """Make a command of a function of one argument: a dataclass, whose fields, annotated for Typer, are its options."""

    def decorate(function: Callable[[T], None]) -> Callable[..., None]:
        @wraps(function)
        def command(**given: object) -> None:
            function(options(**given))

        hints = get_type_hints(options, include_extras=True)
        fields = inspect.signature(options).parameters.values()
        command.__annotations__ = hints
        command.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
            [field.replace(annotation=hints[field.name]) for field in fields]
        )
        return command

    return decorate


@dataclass(frozen=True, kw_only=True)
class ObservationOptions:
    """Options on what robots observe; what is not given is as the environment has it."""

    observed_robots: Annotated[int | None, Option(help="Nearest robots in an observation.")] = None
    observed_obstacles: Annotated[int | None, Option(help="Nearest obstacles in an observation.")] = None
    observed_rays: Annotated[
        int | None, Option(help="Rays of every robot's range sensor; noise: --disturb ray_noise=0.02.")
    ] = None
    ray_range: Annotated[float | None, Option(help="Range of these [m].")] = None
    observed_path: Annotated[
        bool | None, Option("--observed-path", help="Direction and length of the shortest path.")
    ] = None
    communication_range: Annotated[float | None, Option(help="Distance beyond which no neighbour is observed [m].")] = (
        None
    )
    line_of_sight: Annotated[
        bool | None, Option("--line-of-sight", help="Neighbours behind obstacles are not observed either.")
    ] = None

    @property
    def observation(self) -> dict[str, Any]:
        """Arguments of an environment."""
        given = {field.name: getattr(self, field.name) for field in fields(ObservationOptions)}
        return {name: value for name, value in given.items() if value is not None}


def _imported(physics: str) -> str:
    _physics.find_physics(physics)  # before SciPy, as crazyflow must be
    return physics


Physics = Annotated[
    str,
    Option(
        "--physics",
        callback=_imported,
        help="What moves the robots: model, as planners know them, mujoco or crazyflow; with settings, as "
        "crazyflow:gust=0.02,mass_factor=1.05.",
    ),
]


@dataclass(frozen=True, kw_only=True)
class ProblemOptions:
    """Options on the problem."""

    context: typer.Context
    scenario: ScenarioName = "circle"
    num_robots: NumRobots = None
    model: Model = None
    num_obstacles: Annotated[int | None, Option("--num-obstacles", "--obstacles", help="Random obstacles to add.")] = (
        None
    )
    scenario_settings: ScenarioSettings = None
    seed: Seed = 0

    def problem(self) -> Problem:
        common = ("num_robots", "model", "num_obstacles")
        if is_scenario_file(self.scenario):
            reason = f"does not go with a scenario file; change it in {self.scenario}"
            refuse_options(self.context, (*common, "scenario_settings"), reason)
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", ".*nothing solves this problem")  # the commands tell it at their end
                return scenarios.load_problem(self.scenario)
        own = parse_settings(self.scenario_settings, "--scenario-set")
        for name in (*common, "seed"):
            if name in own:
                raise ValueError(f"--scenario-set {name} is said by --{name.replace('_', '-')}; use that")
        models = names(self.model) or ()
        own["model"] = models if len(models) > 1 else self.model
        return scenarios.make_problem(
            self.scenario, self.num_robots, self.seed, num_obstacles=self.num_obstacles, **own
        )


_EXAMPLES = {"--scenario-set": "diameter=8", "--reward-set": "contact=5", "--learner-set": "gradient_steps=8"}


def parse_settings(settings: list[str] | None, option: str = "--set") -> dict[str, Any]:
    """``name=value`` texts, given to an option, as a dictionary, the values read as YAML 1.2."""
    values: dict[str, object] = {}
    for setting in settings or []:
        name, separator, text = setting.partition("=")
        if not separator or not name:
            example = _EXAMPLES.get(option, "num_samples=512")
            raise ValueError(f"{option} {setting!r} is not of the form name=value, as {example}")
        _add(values, name, text if text.strip() else "null", option, f"{setting!r}: the value")
    return values


def parse_levels(texts: list[str] | None) -> dict[str, list[object]] | None:
    """``name=level,level`` texts of ``--disturb`` as levels by name, read as YAML 1.2; ``None`` stays."""
    if texts is None:
        return None
    parsed: dict[str, object] = {}
    levels: dict[str, list[object]] = {}
    for text in texts:
        brackets, closed, rest = text.rpartition(")")  # what is in them has equals signs of its own
        name, separator, listed = (part.strip() for part in rest.partition("="))
        name = brackets + closed + name
        if not separator or not name or not listed:
            raise ValueError(f"--disturb {text!r} is not of the form name=levels, as delay=0,1,2 or push.speed=0.2,0.5")
        _add(parsed, name, f"[{listed}]", "--disturb", f"{text!r}: the list")
        values = parsed[name]
        if not isinstance(values, list):
            raise ValueError(f"--disturb {text!r} gives no list of levels; give some like delay=0,1,2")
        levels[name] = [math.inf if value == "inf" else value for value in values]
    return levels


def single_levels(texts: list[str] | None) -> dict[str, object]:
    """The same where every name has one level."""
    levels = parse_levels(texts) or {}
    for name, values in levels.items():
        if len(values) != 1:
            raise ValueError(f"--disturb {name}: an episode has one level, not {len(values)}; use d4orm evaluate")
    return {name: values[0] for name, values in levels.items()}


def _add(values: dict[str, object], name: str, text: str, option: str, what: str) -> None:
    """Add a value read as YAML under a new name."""
    if name in values:
        raise ValueError(f"{option} gives {name!r} twice; give it once")
    try:
        values[name] = parse_yaml(text)
    except ValueError as error:
        raise ValueError(f"{option} {what} {error}") from None


def policies_by_label(texts: list[str], option: str = "--policy") -> dict[str, dict[str, object]]:
    """``policy`` and settings by label: a name is its own, a configuration's is what was typed, or what it sets."""
    labelled: list[tuple[str, dict[str, object]]] = []
    for text in texts:
        # The name ends where the first setting begins, for an import path has a colon too.
        policy, colon, _ = text.partition("=")[0].rpartition(":")
        if "=" in text and ("," in policy or not colon):
            raise ValueError(
                f"{option} {text!r}: settings stand behind one policy, as in d4orm:num_samples=64,label=few; give "
                f"{option} once for each"
            )
        if not colon or ("=" not in text and policy not in list_policies()):
            labelled += [(name, {}) for name in names(text) or ()]
            continue
        values = parse_settings(text.removeprefix(policy + colon).split(","), option)
        if reserved := {"policy", "name"} & values.keys():
            raise ValueError(f"{option} {text!r}: {min(reserved)!r} is no setting; the name stands before the colon")
        label = values.pop("label", text)
        if label in (None, ""):
            raise ValueError(f"{option} {text!r}: label is empty; give a name, as in d4orm:label=ours")
        labelled.append((str(label), {"policy": policy, **values}))
    for label, _ in labelled:
        if [one for one, _ in labelled].count(label) > 1:
            raise ValueError(f"{option} gives {label!r} twice; leave one out, or set a label, as in d4orm:label=ours")
    return dict(labelled)


def refuse_options(context: typer.Context, options: Iterable[str], reason: str) -> None:
    """Refuse what was given on the command line although it would count for nothing."""
    for parameter in context.command.params:
        source = context.get_parameter_source(parameter.name or "")
        if parameter.name in options and source is not None and source.name == "COMMANDLINE":
            raise ValueError(f"{parameter.opts[0]} {reason}")


def names(text: str | None) -> tuple[str, ...] | None:
    """A list separated by commas; ``None`` stays."""
    return None if text is None else tuple(name.strip() for name in text.split(","))


def numbers(option: str, text: str | None) -> tuple[int, ...] | None:
    """A list of whole numbers separated by commas; ``None`` stays."""
    return None if text is None else _listed(option, text, int, "whole numbers, as 4,8,16")


def decimals(option: str, text: str) -> tuple[float, ...]:
    """A list of numbers separated by commas."""
    return _listed(option, text, float, "numbers, as 0,0.05,0.1")


def _listed(option: str, text: str, kind: Callable[[str], N], what: str) -> tuple[N, ...]:
    try:
        return tuple(kind(number) for number in text.split(","))
    except ValueError:
        raise ValueError(f"{option} {text!r} is not a list of {what}") from None


def seed_list(text: str) -> list[int]:
    """Seeds of ``--seeds``: how many, a range or a list."""
    try:
        if "," in text:
            return [int(number) for number in text.split(",")]
        first, last = (int(number) for number in text.split("-")) if "-" in text.strip()[1:] else (0, int(text) - 1)
    except ValueError:
        raise ValueError(f"--seeds {text!r} is neither a number, as 50, nor a range, as 10-19, nor a list") from None
    if last < first:
        raise ValueError(f"--seeds {text!r} names no seed; give a number, as 50, or a range, as 10-19")
    if last - first >= MOST_SEEDS:
        raise ValueError(f"--seeds {text!r} asks for more than {MOST_SEEDS} seeds; give fewer")
    return list(range(first, last + 1))
