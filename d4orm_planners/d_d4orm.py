"""D-D4orm: planning across nodes that exchange their candidates (paper, section VII, Algorithm 5)."""

from __future__ import annotations

import time
from dataclasses import dataclass
from types import MappingProxyType
from typing import Annotated, Any, ClassVar

from pydantic import Field, SkipValidation

from d4orm_env.engine.choice import get_engine
from d4orm_env.engine.threads import available_cores
from d4orm_planners.base import Iteration, Planner, Search
from d4orm_planners.d4orm import D4orm
from d4orm_planners.d4orm_d import D4ormD, D4ormDConfig
from d4orm_planners.distributed.crew import MODES, AsyncCrew, Crew, SyncCrew
from d4orm_planners.distributed.inbox import Inbox
from d4orm_planners.distributed.judge import Judge
from d4orm_planners.distributed.network import NetworkCrew
from d4orm_planners.distributed.node import Node, Selection, node_seed
from d4orm_planners.distributed.ray_connection import RayConnection, host_and_port, import_ray
from d4orm_planners.distributed.ray_planner import ray_planners
from d4orm_planners.distributed.selection import SELECTIONS, shares
from d4orm_planners.distributed.transport import TRANSPORTS, LocalNetwork
from d4orm_planners.distributed.zenoh_transport import ZenohSettings, ZenohTransport
from d4orm_planners.settings import Count, Seconds, Whole, one_of

INNER = MappingProxyType({kind.name: kind for kind in (D4orm, D4ormD)})
"""The planners that a node can run."""

MOST_NODES = 1024
"""Each is a thread or a process with a candidate of its own."""


@dataclass(frozen=True, kw_only=True)
class DD4ormConfig(D4ormDConfig):
    """Settings of D-D4orm and of the planner that its nodes run; those of D4orm-D alone count only where they run it.

    Attributes:
        num_samples: ``M`` of all nodes together; so is ``repair_samples``. Each node gets an equal share.
        planner: What every node refines its candidate with, ``"d4orm"`` or ``"d4orm-d"``.
        nodes: How many, at most 1024; ``None`` for one per robot, as where the robots themselves are the nodes.
        selection: What a node goes on from: one of the ``k`` candidates of most reward (``"top-k"``), the best one
            (``"max"``), or one of the best of ``k`` clusters (``"k-means"``).
        k: How many candidates it draws from.
        mode: ``"sync"``: all nodes refine, then all exchange; the same seed gives the same plan. ``"async"``: each at
            its own pace; plans then depend on who is sooner.
        patience: Seconds that are waited for stragglers: in asynchronous mode in every round, else beyond the time
            limit of the solve, after which a node is given up.
        transport: ``"local"``: nodes are threads of this process. ``"ray"``: their iterations run in actors of Ray.
            ``"zenoh"``: this process is one node among others on a network, each at its own pace (``mode="async"``).
        address: Of the Ray cluster, ``"host:port"``, or ``"auto"`` for the one that this machine belongs to; ``None``
            for an instance on this machine that ends with the solve.
        node: Which of the nodes this process is, from 0; over a network only.
        zenoh: Where the other nodes are: :class:`~d4orm_planners.distributed.zenoh_transport.ZenohSettings`, or a
            mapping of them; over a network only.
    """

    planner: Annotated[str, one_of(INNER)] = "d4orm"
    nodes: Annotated[Count, Field(le=MOST_NODES)] | None = 2
    selection: Annotated[str, one_of(SELECTIONS)] = "top-k"
    k: Count = 4
    mode: Annotated[str, one_of(MODES)] = "sync"
    patience: Seconds = 1.0
    transport: Annotated[str, one_of(TRANSPORTS)] = "local"
    node: Annotated[Whole, Field(ge=0)] | None = None
    zenoh: Annotated[ZenohSettings | None, SkipValidation] = None  # checked once it is known to be of use
    address: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.nodes is not None:
            self.node_settings(self.nodes)
        if self.address is not None:
            if self.transport != "ray":
                raise ValueError(f"address {self.address!r} goes with transport 'ray', not {self.transport!r}")
            host_and_port(self.address)
        if self.transport == "zenoh":
            self._check_network()
        else:
            for name in ("node", "zenoh"):
                if getattr(self, name) is not None:
                    raise ValueError(f"{name} is {getattr(self, name)!r}; it is a setting of transport 'zenoh' only")

    def _check_network(self) -> None:
        object.__setattr__(self, "zenoh", ZenohSettings.of({} if self.zenoh is None else self.zenoh))
        if self.mode != "async":
            raise ValueError(f"mode is {self.mode!r}; over a network it must be 'async', as there are no common rounds")
        if self.node is None:
            raise ValueError("node is None; over a network it must say which of the nodes this process is, from 0")
        if self.nodes is not None:
            self.check_node(self.nodes)

    def check_node(self, nodes: int) -> None:
        """Raise ``ValueError`` if this process is none of so many nodes."""
        if self.node is not None and self.node >= nodes:
            raise ValueError(f"node is {self.node}; of {nodes} nodes the last one is {nodes - 1}")

    def node_settings(self, nodes: int) -> list[dict[str, Any]]:
        """The settings of each node's planner.

        Raises:
            ValueError: If there are not two samples for each.
        """
        names = INNER[self.planner].config_class.setting_names()
        settings = [{name: getattr(self, name) for name in names} for _ in range(nodes)]
        for name in {"num_samples", "repair_samples"}.intersection(names):
            total = getattr(self, name)
            if total < 2 * nodes:
                raise ValueError(
                    f"{name} is {total} for {nodes} nodes together; give each two at least, {2 * nodes} or more"
                )
            for own, share in zip(settings, shares(total, nodes), strict=True):
                own[name] = share
        return settings


class DD4orm(Planner):
    """Distributed planning: nodes refine candidates by themselves, broadcast them, and go on from one of the best."""

    name: ClassVar[str] = "d-d4orm"
    config_class = DD4ormConfig
    presets: ClassVar[dict[str, dict[str, Any]]] = {
        "paper": {
            **D4ormD.presets["paper"],
            "clip_between_iterations": False,
            "num_samples": 2048,
            "planner": "d4orm",
            "nodes": None,
            "selection": "top-k",
            "k": 4,
            "mode": "sync",
        }
    }
    config: DD4ormConfig

    def __init__(self, config: DD4ormConfig) -> None:
        super().__init__(config)
        if config.transport == "ray":
            import_ray("transport 'ray' of d-d4orm")

    def iterate(self, search: Search) -> Iteration:
        """See :meth:`Planner.iterate`: one round of all nodes, and the best candidate that they made in it."""
        if "crew" not in search.memory:
            search.memory["crew"] = self._crew(search)
        crew: Crew = search.memory["crew"]
        return crew.iterate(search)

    def finish(self, search: Search) -> None:
        """See :meth:`Planner.finish`."""
        if "crew" in search.memory:
            crew: Crew = search.memory.pop("crew")
            best = crew.close()
            if best.rank > search.best.rank:
                search.best = best
            search.metrics |= crew.metrics()
        if "ray" in search.memory:
            search.memory.pop("ray").close()

    def _crew(self, search: Search) -> Crew:
        config, problem = self.config, search.problem
        number = config.nodes or problem.num_robots
        kind = INNER[config.planner]
        planners: list[Planner] = [kind(kind.config_class(**settings)) for settings in config.node_settings(number)]
        selection, base = Selection(config.selection, config.k), search.current.planned
        if config.node is not None and config.zenoh is not None:
            config.check_node(number)
            transport = ZenohTransport(config.zenoh)
            engine, planner = get_engine(config.engine), planners[config.node]
            judge = Judge(engine, problem)
            # Numbered by the clock, what a node tells that was started again is newer than what it told before.
            node = Node(
                config.node, number, planner, problem, search.seed, base, engine, transport, selection, judge,
                time.time_ns(),
            )  # fmt: skip
            return NetworkCrew(node, transport, config.patience, judge, config.zenoh.linger)
        if config.transport == "ray":
            with search.watch.paused():
                connection = search.memory["ray"] = RayConnection(config.address or "local", "transport 'ray'")
                seeds = [node_seed(search.seed, i) for i in range(number)]
                planners = list(ray_planners(connection, planners, problem, seeds))
        # Nodes of one machine share its cores.
        engine = get_engine(config.engine, max(available_cores() // number, 1))
        network, judge = LocalNetwork(), Judge(engine, problem, 2 * number)
        ends = [network.join() for _ in planners]
        nodes = [
            Node(i, number, planner, problem, search.seed, base, engine, end, selection, judge)
            for i, (planner, end) in enumerate(zip(planners, ends, strict=True))
        ]
        if config.mode == "sync":
            return SyncCrew(nodes, ends, config.patience, judge)
        observer = network.join()
        inbox = Inbox(problem, engine, observer, number, judge=judge)
        return AsyncCrew(nodes, [*ends, observer], config.patience, judge, inbox)
