"""``d4orm serve``: a controller as a ROS 2 node, without ROS."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from d4orm_env.core.arrays import whole_number
from d4orm_env.core.problem import Problem
from d4orm_planners.base.controller import Controller
from d4orm_planners.cli.node_command import mapping, problem_in, read_task, zenoh_in
from d4orm_planners.cli.signals import on_signals
from d4orm_planners.d_d4orm.zenoh_transport import ZenohSettings
from d4orm_planners.serve.fleet_server import NODE, FleetServer
from d4orm_planners.serve.wire import RosSession

FIELDS = ("problem", "policy", "settings", "controller", "robots", "deadline", "domain", "seed", "zenoh")
SHARE = 0.9
"""Share of a period that the policy may take."""


@dataclass(frozen=True)
class ServeTask:
    """Task of a server, as its file has it."""

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
    task, over = read_task(config, FIELDS[:1], FIELDS[1:], _task), threading.Event()
    # Robots are told to stand once it is set.
    with on_signals(lambda *_: over.set()), RosSession(task.zenoh, task.domain, NODE) as session:
        server = FleetServer(session, task.problem, task.controller, task.names, task.deadline, task.seed)
        typer.echo(f"serving {', '.join(task.names)} on domain {task.domain}; Ctrl-C ends it")
        server.run(over)


def _task(fields: Mapping[str, Any], folder: Path) -> ServeTask:
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
