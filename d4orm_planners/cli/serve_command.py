"""``d4orm serve``: a controller as a ROS 2 node, without ROS."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from d4orm_env.core.arrays import whole_number
from d4orm_env.core.problem import Problem
from d4orm_env.core.yaml_text import read_yaml
from d4orm_planners.base.controller import Controller
from d4orm_planners.cli.node_file import mapping, problem_in, zenoh_in
from d4orm_planners.d_d4orm.zenoh_transport import ZenohSettings
from d4orm_planners.serve.fleet_server import NODE, FleetServer
from d4orm_planners.serve.wire import RosSession

FIELDS = ("problem", "policy", "settings", "controller", "robots", "deadline", "domain", "seed", "zenoh")
SHARE = 0.9
"""Share of a period that the policy may take."""


@dataclass(frozen=True)
class ServeTask:
    """Task of a server.

    Attributes:
        problem: The team and its world.
        controller: What drives it.
        names: Of the robots.
        deadline: Longest silence of one of them [s].
        domain: ROS domain.
        seed: Of the controller.
        zenoh: Network of the robots.
    """

    problem: Problem
    controller: Controller
    names: tuple[str, ...]
    deadline: float
    domain: int
    seed: int
    zenoh: ZenohSettings


def serve(
    config: Annotated[Path, typer.Option("--config", "-c", help="YAML file that says what is to be served.")],
) -> None:
    """Drive robots on a ROS 2 network over Zenoh: odometry in, velocities and setpoints out, until Ctrl-C."""
    task = load_task(config)
    with RosSession(task.zenoh, task.domain, NODE) as session, _signals() as over:
        server = FleetServer(session, task.problem, task.controller, task.names, task.deadline, task.seed)
        typer.echo(f"serving {', '.join(task.names)} on domain {task.domain}; Ctrl-C ends it")
        server.run(over)


def load_task(path: str | os.PathLike[str]) -> ServeTask:
    """Read a server's file; paths in it are relative to its folder.

    Raises:
        ValueError: If it cannot be read, or something in it is missing, unknown or makes no sense; one line that names
            the file and the field.
    """
    try:
        return _task(mapping("the file", read_yaml(path)), Path(path).parent)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: {error}") from error


def _task(fields: Mapping[str, Any], folder: Path) -> ServeTask:
    for name in fields:
        if name not in FIELDS:
            raise ValueError(f"unknown field {name!r}; known are {', '.join(FIELDS)}")
    if "problem" not in fields:
        raise ValueError("field 'problem' is missing")
    problem = problem_in(fields["problem"], folder)
    zenoh = zenoh_in(fields, folder)
    for name in ("namespace", "grace_period"):
        if name in zenoh:
            raise ValueError(f"zenoh has {name!r}, which is for nodes of d4orm node; leave it out")
    own = {"timeout": SHARE * problem.dt} | dict(mapping("controller", fields.get("controller", {})))
    policy = fields.get("policy", "d4orm-c2f")
    settings = mapping("settings", fields.get("settings", {}))
    names = fields.get("robots", [f"robot_{robot}" for robot in range(problem.num_robots)])
    if not isinstance(names, list) or not all(isinstance(name, str) and name.isidentifier() for name in names):
        raise ValueError(f"robots is {names!r}; give a list of names of letters, digits and '_'")
    return ServeTask(
        problem=problem,
        controller=Controller(policy, **own, **settings),
        names=tuple(names),
        deadline=fields.get("deadline", 0.5),
        domain=whole_number(fields.get("domain", 0), "domain", 0, 232),
        seed=whole_number(fields.get("seed", 0), "seed", 0),
        zenoh=ZenohSettings.of(zenoh),
    )


@contextmanager
def _signals() -> Iterator[threading.Event]:
    """The event that SIGINT and SIGTERM set, so that robots are told to stand."""
    over = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield over
        return
    former = {number: signal.signal(number, lambda *_: over.set()) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield over
    finally:
        for number, handler in former.items():
            signal.signal(number, handler)
