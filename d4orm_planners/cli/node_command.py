"""``d4orm node`` and ``d4orm serve``: one of D-D4orm's nodes, or a ROS 2 node without ROS, as a file describes it."""

from __future__ import annotations

import logging
import os
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar

import typer
from typer import Option

from d4orm_env.core.arrays import duration, truth, whole_number
from d4orm_env.core.errors import unknown
from d4orm_env.core.files import read_yaml
from d4orm_env.core.problem import Problem
from d4orm_env.scenarios import load_problem, make_problem
from d4orm_env.scenarios.schema import VERSION, parse
from d4orm_planners.base.controller import Controller
from d4orm_planners.base.disturbance_observer import DisturbanceObserver
from d4orm_planners.base.plan import IterationRecord
from d4orm_planners.base.planner_registry import make_planner
from d4orm_planners.cli import on_signals
from d4orm_planners.cli.outputs import check_target
from d4orm_planners.d_d4orm.planner import DD4orm
from d4orm_planners.d_d4orm.zenoh_transport import ZenohSettings
from d4orm_planners.serve.fleet_server import NODE, FleetServer
from d4orm_planners.serve.wire import WIRES, RosSession

T = TypeVar("T")

REQUIRED = ("node", "nodes", "problem", "time_limit", "out")
OPTIONAL = ("seed", "settings", "zenoh")
OWN = ("node", "nodes", "mode", "transport", "zenoh")
"""Settings of the planner that are not among ``settings``: they have a field of their own, or are given."""

ENDLESS = 10**9  #: Iterations; a node's budget is its time


@dataclass(frozen=True)
class NodeTask:
    """Task of a node, as its file has it."""

    planner: DD4orm
    problem: Problem
    seed: int
    time_limit: float
    out: Path


def load_node(path: str | os.PathLike[str]) -> NodeTask:
    return read_task(path, REQUIRED, OPTIONAL, _task)


def read_task(
    path: str | os.PathLike[str],
    required: tuple[str, ...],
    optional: tuple[str, ...],
    make: Callable[[Mapping[str, Any], Path], T],
) -> T:
    """Read a file of fields and make a task of them; paths in it are relative to its folder."""
    try:
        fields = mapping("the file", read_yaml(path))
        for name in fields:
            if name not in required + optional:
                raise ValueError(f"unknown field {name!r}; known are {', '.join(required + optional)}")
        for name in required:
            if fields.get(name) is None:
                raise ValueError(f"field {name!r} is missing")
        return make(fields, Path(path).parent)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: {error}") from error


def _task(fields: Mapping[str, Any], folder: Path) -> NodeTask:
    settings = mapping("settings", fields.get("settings", {}))
    for name in OWN:
        if name in settings:
            raise ValueError(f"settings has {name!r}, which " + (
                "is a field of the file itself" if name in fields else "is the same for every node of a network"
            ))  # fmt: skip
    network = {"transport": "zenoh", "mode": "async", "zenoh": zenoh_in(fields, folder)}
    if not isinstance(fields["out"], str):
        raise ValueError(f"out must be a path, not {fields['out']!r}")
    planner = make_planner(
        "d-d4orm",
        node=whole_number(fields["node"], "node", 0),
        nodes=whole_number(fields["nodes"], "nodes", 1),
        **{"max_iterations": ENDLESS, **settings, **network},
    )
    assert isinstance(planner, DD4orm)
    return NodeTask(
        planner=planner,
        problem=problem_in(fields["problem"], folder),
        seed=whole_number(fields.get("seed", 0), "seed", 0),
        time_limit=duration(fields["time_limit"], "time_limit"),
        out=folder / fields["out"],
    )


def problem_in(content: object, folder: Path) -> Problem:
    """The problem that a file names or has."""
    if isinstance(content, str):
        return load_problem(folder / content)
    if not isinstance(content, dict):
        raise ValueError(f"problem must be a scenario file or a scenario with its arguments, not {content!r}")
    try:
        if content.get("scenario") == "map" and isinstance(content.get("map"), str):
            # No scenario file reads another file; one that says what a machine has to do names several.
            settings = {name: value for name, value in content.items() if name not in ("scenario", "map")}
            return make_problem("map", map=folder / content["map"], **settings)
        return parse({"version": VERSION, **content})
    except (TypeError, ValueError) as error:
        raise ValueError(f"problem: {error}") from error


def mapping(name: str, content: object) -> Mapping[str, Any]:
    """A part of a file that must be a mapping."""
    if not isinstance(content, dict):
        raise ValueError(f"{name} must be a mapping of fields, not {content!r}")
    return content


def zenoh_in(fields: Mapping[str, Any], folder: Path) -> Mapping[str, Any]:
    zenoh = mapping("zenoh", fields.get("zenoh", {}))
    if isinstance(zenoh.get("config_file"), str):
        zenoh = {**zenoh, "config_file": str(folder / zenoh["config_file"])}
    return zenoh


def node(
    config: Annotated[Path, Option("--config", "-c", help="YAML file that says what the node has to do.")],
) -> None:
    """Plan as one node of several on a network: exchange candidates, end with the best one known, write it."""
    task = load_node(config)
    check_target(task.out, (".npz",))
    number = task.planner.config.node
    typer.echo(f"node {number} of {task.planner.config.nodes}, problem {task.problem.digest[:8]}")
    over = threading.Event()

    def interrupt(*_: object) -> None:
        # The first ends the solve with the best so far; later ones do nothing.
        if not over.is_set():
            over.set()
            raise KeyboardInterrupt

    with _events_as_lines(), on_signals(interrupt):
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


@contextmanager
def _events_as_lines() -> Iterator[None]:
    """Print what the nodes log."""
    logger, handler = logging.getLogger("d4orm_planners.d_d4orm"), logging.StreamHandler(sys.stdout)
    level = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    try:
        yield
    finally:
        logger.setLevel(level)
        logger.removeHandler(handler)


FIELDS = (
    "problem",
    "policy",
    "settings",
    "controller",
    "robots",
    "deadline",
    "watchdog",
    "domain",
    "seed",
    "zenoh",
    "wire",
    "stamps",
)
CONTROLLER = {"mode", "reserve", "timeout", "lag", "tracker"}  #: Settings of the controller
SHARE = 0.9  #: Share of a period that the policy may take


def serve(config: Annotated[Path, Option("--config", "-c", help="YAML file that says what is to be served.")]) -> None:
    """Drive robots on a ROS 2 network over Zenoh: odometry in, velocities and setpoints out, until Ctrl-C."""
    (network, fleet), over = read_task(config, FIELDS[:1], FIELDS[1:], _serve_task), threading.Event()
    # Robots are told to stand once it is set.
    with on_signals(lambda *_: over.set()), RosSession(**network) as session:
        server = FleetServer(session, **fleet)
        typer.echo(f"serving {', '.join(fleet['names'])} on domain {network['domain']}; Ctrl-C ends it")
        server.run(over)


def _serve_task(fields: Mapping[str, Any], folder: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Arguments of the session and of the server of a file."""
    problem = problem_in(fields["problem"], folder)
    zenoh = zenoh_in(fields, folder)
    for name in ("namespace", "grace_period"):
        if name in zenoh:
            raise ValueError(f"zenoh has {name!r}, which is for nodes of d4orm node; leave it out")
    own = {"timeout": SHARE * problem.dt} | dict(mapping("controller", fields.get("controller", {})))
    policy = fields.get("policy", "d4orm-c2f")
    settings = mapping("settings", fields.get("settings", {}))
    if wrong := sorted((own.keys() - CONTROLLER) | (settings.keys() & CONTROLLER), key=str):
        raise ValueError(
            f"{wrong[0]!r} is in the wrong place; controller takes {', '.join(sorted(CONTROLLER))}, and settings what "
            "the policy takes"
        )
    if (wire := fields.get("wire", WIRES[0])) not in WIRES:
        raise unknown("wire", wire, WIRES)
    DisturbanceObserver(problem, own.get("lag", 0.0))  # refuses a lag for another team
    names = fields.get("robots", [f"robot_{robot}" for robot in range(problem.num_robots)])
    if not isinstance(names, list) or not all(isinstance(name, str) and name.isidentifier() for name in names):
        raise ValueError(f"robots is {names!r}; give a list of names of letters, digits and '_'")
    fleet = {
        "problem": problem,
        "controller": Controller(policy, **own, **settings),
        "names": tuple(names),
        "deadline": fields.get("deadline", 0.5),
        "seed": whole_number(fields.get("seed", 0), "seed", 0),
        "stamped": truth(fields.get("stamps", False), "stamps"),
        "watchdog": fields.get("watchdog"),
    }
    domain = whole_number(fields.get("domain", 0), "domain", 0, 232)
    return {"settings": ZenohSettings.of(zenoh), "domain": domain, "node": NODE, "wire": wire}, fleet
