"""D-D4orm: planning across nodes that exchange their candidates (paper, section VII, Algorithm 5).

Nodes run in rounds (:mod:`~d4orm_planners.d_d4orm.node_pool`) or at their own pace
(:mod:`~d4orm_planners.d_d4orm.own_pace`).
"""

from __future__ import annotations

import time
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import ClassVar

from d4orm_env.core.arrays import BoolArray
from d4orm_env.core.problem import Problem
from d4orm_env.engine.observing import communication_links
from d4orm_env.engine.threads import available_cores
from d4orm_planners.base.planner import Iteration, Planner
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.d4orm_d.planner import D4ormD
from d4orm_planners.d_d4orm.inbox import Evaluator, Inbox
from d4orm_planners.d_d4orm.node import Node, PlanningTask, node_seed
from d4orm_planners.d_d4orm.node_pool import NodePool, SyncNodePool
from d4orm_planners.d_d4orm.own_pace import AsyncNodePool, NetworkNodePool
from d4orm_planners.d_d4orm.ray_planner import RayConnection, import_ray, ray_planners
from d4orm_planners.d_d4orm.settings import DD4ormConfig
from d4orm_planners.d_d4orm.transport import LocalNetwork
from d4orm_planners.d_d4orm.zenoh_transport import ZenohSettings, ZenohTransport
from d4orm_planners.engine.sampling_types import get_sampling_engine


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
