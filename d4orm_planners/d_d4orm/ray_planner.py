"""The ``"ray"`` transport: every node's iterations run in an actor of Ray, a process on this machine or a cluster.

The connection is to a cluster, or to an instance of one's own that only this machine can reach.
"""

from __future__ import annotations

import os
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from math import ceil
from types import ModuleType
from typing import Any, NamedTuple

from d4orm_env.core.errors import describe, first_line
from d4orm_env.core.lazy import LazyModule, load
from d4orm_env.core.problem import Problem
from d4orm_env.engine.threads import available_cores
from d4orm_planners.base.candidate import evaluate_controls
from d4orm_planners.base.planner import Iteration, Planner
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.d_d4orm.transport import Message, decode, encode
from d4orm_planners.engine.sampling_types import get_sampling_engine

TIMEOUT = 10.0  #: Seconds to wait for the head of a cluster to answer
LOOPBACK = ("127.0.0.1", "::1")
RESTARTS = 3  #: Number of times that a lost actor is started again, before its node is done without
START = 120.0  #: Seconds that actors may take to start and to compile
GLANCE = 0.1  #: Seconds between looks at whether an iteration under way is still wanted


def import_ray(what: str) -> ModuleType:
    """Ray, or an ``ImportError`` that says what needs it and how to install it."""
    return load(LazyModule("ray", what, "distributed"))


class RayConnection:
    """A connection to Ray for ``what``. One that this process has already is used, and left open.

    Its address is ``"auto"`` for the cluster that this machine belongs to, an address, or ``"local"`` for a new
    instance here. Raises ValueError if it is none, ImportError without Ray, ConnectionError if there is no cluster.
    """

    def __init__(self, address: str, what: str) -> None:
        host, port = host_and_port(address)
        self.ray = import_ray(what)
        self._owner = not self.ray.is_initialized()
        try:
            if host:
                # Ray itself tries for minutes.
                socket.create_connection((host, port), TIMEOUT).close()
            if self._owner and address == "local":
                self._start_here()
            elif self._owner:
                self.ray.init(address=address, log_to_driver=False)
        except Exception as error:  # Ray raises errors of many kinds
            raise ConnectionError(
                f"Ray cluster {address!r} cannot be reached ({describe(error)}); start one with `ray start --head`, or "
                "leave the address out to run on this machine"
            ) from error

    def _start_here(self) -> None:
        with _loopback_only():
            self.ray.init(address="local", log_to_driver=False, include_dashboard=False)
        if (address := self.ray.util.get_node_ip_address()) not in LOOPBACK:
            self.ray.shutdown()
            raise RuntimeError(f"Ray {self.ray.__version__} would listen on {address}, beyond this machine")

    def close(self) -> None:
        """Disconnect, which ends an instance of one's own."""
        if self._owner:
            self.ray.shutdown()


@contextmanager
def _loopback_only() -> Iterator[None]:
    """Have Ray use the loopback address, which on Linux it replaces by one of the network, even if given it."""
    from ray._private import ray_constants

    usual = ray_constants.ENABLE_RAY_CLUSTER
    ray_constants.ENABLE_RAY_CLUSTER = False
    try:
        yield
    finally:
        ray_constants.ENABLE_RAY_CLUSTER = usual


def host_and_port(address: str) -> tuple[str, int]:
    """Host and port of an address, none for ``auto`` and ``local``; ValueError for others that are no ``host:port``."""
    if address in ("auto", "local"):
        return "", 0
    host, _, port = str(address).removeprefix("ray://").rpartition(":")
    if not host or not port.isdigit():
        raise ValueError(f"Ray address {address!r} is neither auto, nor local, nor of the form host:port")
    return host.strip("[]"), int(port)


class ActorOutcome(NamedTuple):
    """Outcome of an actor's iteration."""

    data: bytes  #: The candidate, a message
    denoising_steps: int  #: Spent on it
    denoising_time: float  #: Seconds that these took
    excluded: int  #: See :class:`~d4orm_planners.base.planner.Iteration`
    compiling: float  #: Seconds of it that went into compiling
    process: int  #: The process that did it


class Worker:
    """Runs a planner's iterations in a process of its own."""

    def __init__(self, node: int, num_nodes: int, planner: Planner, problem: Problem, seed: int, sharing: int) -> None:
        self._node, self._num_nodes = node, num_nodes
        self._engine = get_sampling_engine(planner.config.engine, max(available_cores() // sharing, 1))
        self._search = SolveRun(planner, problem, seed, None, self._engine)

    def ready(self) -> int:
        """Compile what an iteration needs, by one of a single step; the number of this process."""
        planner, config = self._search.planner, self._search.planner.config
        short: dict[str, Any] = {name: 1 for name in ("num_steps", "repair_steps") if name in config.setting_names()}
        SolveRun(type(planner)(replace(config, **short)), self._search.problem, 0, None, self._engine).advance()
        return os.getpid()

    def advance(self, iteration: int, data: bytes, time_left: float | None) -> ActorOutcome:
        """One iteration from a candidate, a message, in the time left [s], compilation not counted; ``None`` for any.

        Iterations done are all that a worker must know of the past: a new one can take a lost one's place.
        """
        search = self._search
        search.time_limit = None if time_left is None else search.watch.elapsed + time_left
        controls = decode(data, search.problem, self._num_nodes).controls
        search.iteration = iteration
        search.current = evaluate_controls(self._engine, search.problem, controls)
        steps, seconds, compiling = search.denoising_steps, search.denoising_time, search.watch.paused_seconds
        record = search.advance()
        return ActorOutcome(
            _message(self._node, search),
            search.denoising_steps - steps,
            search.denoising_time - seconds,
            record.excluded,
            search.watch.paused_seconds - compiling,
            os.getpid(),
        )


class RayPlanner(Planner):
    """A planner whose iterations run in an actor."""

    def __init__(self, planner: Planner, node: int, num_nodes: int, ray: ModuleType, actor: Any) -> None:
        super().__init__(planner.config)
        self.process = 0  #: Number of the actor's process
        self._node, self._num_nodes = node, num_nodes
        self._ray, self._actor = ray, actor
        self._calling, self._closed = threading.Lock(), threading.Event()

    def start(self) -> None:
        """Wait until the actor is there. Raises ConnectionError if it does not start."""
        try:
            self.process = self._ray.get(self._actor.ready.remote(), timeout=START)
        except self._ray.exceptions.RayTaskError as error:
            raise error.cause from error
        except (self._ray.exceptions.RayError, TimeoutError) as error:
            raise ConnectionError(
                f"the actor of node {self._node} does not start ({first_line(error)}); "
                "check that d4orm-env is installed on every machine of the cluster"
            ) from error

    def iterate(self, search: SolveRun, state: None) -> tuple[None, Iteration]:
        with self._calling:
            outcome = self._outcome(search.iteration, _message(self._node, search), search.time_left)
        search.watch.leave_out(outcome.compiling)
        search.denoising_time += outcome.denoising_time
        note = "" if outcome.process == self.process else f"the actor of node {self._node} was lost and restarted"
        self.process = outcome.process
        controls = decode(outcome.data, search.problem, self._num_nodes).controls
        return None, Iteration(controls, outcome.denoising_steps, outcome.excluded, note)

    def finish(self, search: SolveRun, state: None) -> None:
        """See :meth:`Planner.finish`: end the actor, whatever it is at."""
        self._closed.set()
        self._ray.kill(self._actor)
        # Ray ends the process of whoever calls it once it is shut down.
        with self._calling:
            pass

    def _outcome(self, iteration: int, data: bytes, time_left: float | None) -> ActorOutcome:
        if self._closed.is_set():
            raise ChildProcessError("its actor has been ended")
        try:
            call = self._actor.advance.remote(iteration, data, time_left)
            # An actor whose machine cannot be reached may not be seen to end for long.
            while not self._ray.wait([call], timeout=GLANCE)[0]:
                if self._closed.is_set():
                    raise ChildProcessError("its actor has been ended")
            outcome: ActorOutcome = self._ray.get(call)
        except self._ray.exceptions.RayTaskError as error:
            raise error.cause from error
        except self._ray.exceptions.RayError as error:
            raise ChildProcessError(f"its actor was lost for good ({first_line(error)})") from error
        return outcome


def ray_planners(
    connection: RayConnection, planners: list[Planner], problem: Problem, seeds: list[int]
) -> list[RayPlanner]:
    """Planners that do what these do, each in an actor, once all are there; ConnectionError if one does not start."""
    ray, number = connection.ray, len(planners)
    machines = sum(bool(machine["Alive"]) for machine in ray.nodes())
    # Without a claim on cores no actor waits for a place, however many there are; they share what a machine has.
    kind = ray.remote(num_cpus=0, scheduling_strategy="SPREAD", max_restarts=RESTARTS, max_task_retries=RESTARTS)(
        Worker
    )
    sharing = ceil(number / machines)
    remote = [
        RayPlanner(planner, node, number, ray, kind.remote(node, number, planner, problem, seed, sharing))
        for node, (planner, seed) in enumerate(zip(planners, seeds, strict=True))
    ]
    for planner in remote:
        planner.start()
    return remote


def _message(node: int, search: SolveRun) -> bytes:
    candidate = search.current
    message = Message(node, search.iteration, candidate.planned, candidate.reward, bool(candidate.solved))
    return encode(message, search.problem)
