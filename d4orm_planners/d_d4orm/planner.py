"""D-D4orm: planning across nodes that exchange their candidates (paper, section VII, Algorithm 5).

Settings are those of the network, and those of the planner that every node runs.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, fields, replace
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, Self, TypeAlias

from pydantic import Field, InstanceOf, SkipValidation

from d4orm_env.core.arrays import BoolArray, short_repr
from d4orm_env.core.errors import unknown
from d4orm_env.core.problem import Problem
from d4orm_env.engine.observing import communication_links
from d4orm_env.engine.threads import available_cores
from d4orm_planners.base.planner import Iteration, Planner, PlannerConfig
from d4orm_planners.base.settings import NOTHING, Count, Positive, Seconds, Whole, one_of
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.d4orm_d.planner import D4ormD
from d4orm_planners.d_d4orm.inbox import SELECTIONS, Evaluator, Inbox, shares
from d4orm_planners.d_d4orm.node import Node, PlanningTask, node_seed
from d4orm_planners.d_d4orm.node_pool import MODES, AsyncNodePool, NetworkNodePool, NodePool, SyncNodePool
from d4orm_planners.d_d4orm.ray_planner import RayConnection, host_and_port, import_ray, ray_planners
from d4orm_planners.d_d4orm.transport import TRANSPORTS, LocalNetwork
from d4orm_planners.d_d4orm.zenoh_transport import ZenohSettings, ZenohTransport
from d4orm_planners.engine.sampling_types import get_sampling_engine
from d4orm_planners.hybrid.planner import Hybrid
from d4orm_planners.sampling.d4orm import D4orm, D4ormConfig, DeformationConfig

NodePlanner: TypeAlias = D4orm | D4ormD | Hybrid
NODE_PLANNERS: Mapping[str, type[NodePlanner]] = MappingProxyType({k.name: k for k in (D4orm, D4ormD, Hybrid)})
"""The planners that a node can run."""

MOST_NODES = 1024  #: Each is a thread or a process with a candidate of its own


@dataclass(frozen=True, kw_only=True)
class DD4ormConfig(PlannerConfig):
    """Settings of D-D4orm. :func:`~d4orm_planners.make_planner` takes those of ``refinement`` as well.

    There, ``planner`` says what every node refines its candidate with, ``"d4orm"`` (the default), ``"d4orm-d"`` or
    ``"hybrid"``.
    """

    #: The settings of that planner. Its ``num_samples`` and ``repair_samples`` are those of all nodes together, of
    #: which each gets an equal share; what every planner takes is as it is here.
    refinement: InstanceOf[DeformationConfig] = field(default_factory=D4ormConfig)
    #: Number of nodes, at most 1024; ``None`` for one per robot, as where the robots themselves are the nodes
    nodes: Annotated[Count, Field(le=MOST_NODES)] | None = 2
    #: Distance of two robots' starts beyond which their nodes do not hear each other [m], where the robots themselves
    #: are the nodes; ``None`` for no limit. What a node hears it may pass on, in what it makes of it. Not over a
    #: network, which has its own limits.
    communication_range: Positive | None = None
    #: Candidate that a node goes on from: one of the ``k`` candidates of most reward (``"top-k"``), the best one
    #: (``"max"``), or one of the best of ``k`` clusters (``"k-means"``)
    selection: Annotated[str, one_of(SELECTIONS)] = "top-k"
    k: Count = 4  #: Number of candidates that it draws from
    #: ``"sync"``: all nodes refine, then all exchange; the same seed gives the same plan. ``"async"``: each at its own
    #: pace; plans then depend on which is sooner.
    mode: Annotated[str, one_of(MODES)] = "sync"
    #: Seconds that are waited for stragglers: in asynchronous mode in every round, else beyond the time limit of the
    #: solve, after which a node is given up
    timeout: Seconds = 1.0
    #: ``"local"``: nodes are threads of this process. ``"ray"``: their iterations run in actors of Ray. ``"zenoh"``:
    #: this process is one node among others on a network, each at its own pace (``mode="async"``).
    transport: Annotated[str, one_of(TRANSPORTS)] = "local"
    node: Annotated[Whole, Field(ge=0)] | None = None  #: Number of this process among the nodes, from 0; networks only
    #: Network of the nodes: :class:`~d4orm_planners.d_d4orm.zenoh_transport.ZenohSettings`, or a mapping of them; over
    #: a network only
    zenoh: Annotated[ZenohSettings | None, SkipValidation] = None  # checked once it is known to be of use
    #: Of the Ray cluster, ``"host:port"``, or ``"auto"`` for the one that this machine belongs to; ``None`` for an
    #: instance on this machine that ends with the solve
    address: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.nodes is not None:
            self.node_planners(self.nodes)
        if self.communication_range is not None and (self.nodes is not None or self.transport == "zenoh"):
            raise ValueError(
                f"communication_range is {self.communication_range:g}, and the nodes are not this process's robots; "
                "give nodes=None, and transport 'local' or 'ray'"
            )
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

    @classmethod
    def setting_names(cls, given: Mapping[str, object] = NOTHING) -> tuple[str, ...]:
        """See :meth:`CheckedSettings.setting_names`: those of the nodes' planner are among them."""
        return tuple(dict.fromkeys((*_node_planner(given).config_class.setting_names(), "planner", *_own_names())))

    @classmethod
    def _made_of(cls, given: Mapping[str, Any]) -> Self:
        own = {name: value for name, value in given.items() if name in _own_names()}
        rest = {name: value for name, value in given.items() if name not in own and name != "planner"}
        return cls(refinement=_node_planner(given).config_class(**rest), **own)

    def keywords(self) -> dict[str, object]:
        own = super().keywords()
        del own["refinement"]
        return {"planner": self.node_planner.name, **self.refinement.keywords(), **own}

    @property
    def node_planner(self) -> type[NodePlanner]:
        """Planner that every node refines its candidate with."""
        return next(kind for kind in NODE_PLANNERS.values() if kind.config_class is type(self.refinement))

    def node_planners(self, nodes: int) -> list[NodePlanner]:
        """The planner of each of so many nodes. Raises ValueError if there are not two samples for each."""
        settings: list[dict[str, Any]] = [{"engine": self.engine, "improve": self.improve} for _ in range(nodes)]
        for name in ("num_samples", "repair_samples"):
            total = getattr(self.refinement, name, None)
            if total is None:
                continue
            if total < 2 * nodes:
                raise ValueError(
                    f"{name} is {total} for {nodes} nodes together; give each two at least, {2 * nodes} or more"
                )
            for own, share in zip(settings, shares(total, nodes), strict=True):
                own[name] = share
        make: Callable[[Any], NodePlanner] = self.node_planner  # whose settings these are
        return [make(replace(self.refinement, **own)) for own in settings]

    def check_node(self, nodes: int) -> None:
        """Raise ``ValueError`` if this process is none of so many nodes."""
        if self.node is not None and self.node >= nodes:
            raise ValueError(f"node is {self.node}; of {nodes} nodes the last one is {nodes - 1}")

    def _check_network(self) -> None:
        object.__setattr__(self, "zenoh", ZenohSettings.of({} if self.zenoh is None else self.zenoh))
        if self.mode != "async":
            raise ValueError(f"mode is {self.mode!r}; over a network it must be 'async', as there are no common rounds")
        if self.node is None:
            raise ValueError("node is None; over a network it must say which of the nodes this process is, from 0")
        if self.nodes is not None:
            self.check_node(self.nodes)


def _own_names() -> tuple[str, ...]:
    return tuple(own.name for own in fields(DD4ormConfig) if own.name != "refinement")


def _node_planner(given: Mapping[str, object]) -> type[NodePlanner]:
    name = given.get("planner", D4orm.name)
    if not isinstance(name, str):
        raise ValueError(f"planner must be text, not {short_repr(name)}")
    if name not in NODE_PLANNERS:
        raise unknown("planner", name, NODE_PLANNERS)
    return NODE_PLANNERS[name]


@dataclass(frozen=True)
class RunningNodes:
    """The state of a solve: its nodes live from one iteration to the next."""

    pool: NodePool
    opened: ExitStack


class DD4orm(Planner):
    """Distributed planning: nodes refine candidates by themselves, broadcast them, and go on from one of the best."""

    name: ClassVar[str] = "d-d4orm"
    config_class = DD4ormConfig
    presets: ClassVar = {
        "paper": {
            **D4ormD.presets["paper"],
            "penalty": 1.0,
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

    def init(self, search: SolveRun) -> RunningNodes:
        """See :meth:`Planner.init`: the nodes, ready to begin."""
        with ExitStack() as opened:
            number = self.config.nodes or search.problem.num_robots
            selection = self.config.selection, self.config.k
            task = PlanningTask(number, search.seed, search.current.planned, *selection, self._links(search.problem))
            zenoh = self.config.zenoh
            pool = self._local_pool(search, task, opened) if zenoh is None else self._network_pool(search, task, zenoh)
            return RunningNodes(pool, opened.pop_all())

    def within(self, communication_range: float) -> DD4orm:
        """See :meth:`Planner.within`: where the robots are the nodes they hear each other within the range only."""
        if self.config.nodes is not None or self.config.transport == "zenoh":
            return self
        return DD4orm(replace(self.config, communication_range=communication_range))

    def _links(self, problem: Problem) -> BoolArray | None:
        """``(N, N)`` bool: nodes that hear each other; ``None`` for all."""
        limit, starts = self.config.communication_range, problem.start[:, : problem.dimension]
        return None if limit is None else communication_links(problem, starts, limit, line_of_sight=False)

    def iterate(self, search: SolveRun, state: RunningNodes) -> tuple[RunningNodes, Iteration]:
        """See :meth:`Planner.iterate`: one round of all nodes, and the best candidate that they made in it."""
        return state, state.pool.iterate(search)

    def finish(self, search: SolveRun, state: RunningNodes) -> None:
        with state.opened:
            best = state.pool.close()
            if best.rank > search.best.rank:
                search.best = best
            search.metrics |= state.pool.metrics()

    def _network_pool(self, search: SolveRun, task: PlanningTask, zenoh: ZenohSettings) -> NodePool:
        """The one node of a network that this process is."""
        config = self.config
        config.check_node(task.num_nodes)
        assert config.node is not None
        planner = config.node_planners(task.num_nodes)[config.node]
        transport = ZenohTransport(zenoh)
        evaluator = Evaluator(get_sampling_engine(config.engine), search.problem)
        # Numbered by the clock, what a restarted node sends is newer than what it sent before.
        node = Node(config.node, task, planner, transport, evaluator, sequence=time.time_ns())
        return NetworkNodePool(node, transport, config.timeout, evaluator, zenoh.grace_period)

    def _local_pool(self, search: SolveRun, task: PlanningTask, opened: ExitStack) -> NodePool:
        """All nodes, in threads of this process; what is to be closed after them is ``opened``."""
        config, problem, number = self.config, search.problem, task.num_nodes
        planners: list[Planner] = list(config.node_planners(number))
        if config.transport == "ray":
            with search.watch.paused():
                connection = RayConnection(config.address or "local", "transport 'ray'")
                opened.callback(connection.close)
                seeds = [node_seed(search.seed, i) for i in range(number)]
                planners = list(ray_planners(connection, planners, problem, seeds))
        # Nodes of one machine share its cores.
        engine = get_sampling_engine(config.engine, max(available_cores() // number, 1))
        network, evaluator = LocalNetwork(), Evaluator(engine, problem, 2 * number)
        ends = [network.join() for _ in planners]
        nodes = [
            Node(i, task, planner, end, evaluator) for i, (planner, end) in enumerate(zip(planners, ends, strict=True))
        ]
        if config.mode == "sync":
            return SyncNodePool(nodes, ends, config.timeout, evaluator)
        observer = network.join()
        return AsyncNodePool(nodes, [*ends, observer], config.timeout, evaluator, Inbox(evaluator, observer, number))
