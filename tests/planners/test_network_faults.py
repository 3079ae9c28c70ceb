"""Nodes of D-D4orm on a zenoh network, on loopback, while the network or one of them fails.

Each node is a solve in a thread of its own with a zenoh session of its own. A weak node cannot find a solution by
itself: if it ends with one, then because messages came through.
"""

from __future__ import annotations

import itertools
import logging
import math
import random
import struct
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from network_support import TIMEOUT, FaultyTransport, Link, free_endpoint, has_listeners, wait_until
from planner_support import hop_problem, walled_in_problem

from d4orm_env.core.problem import Problem
from d4orm_env.scenarios import make_problem
from d4orm_env.verify import verify
from d4orm_planners import Plan, make_planner
from d4orm_planners.base.planner import Callback, Iteration
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.d_d4orm import transport as message_module
from d4orm_planners.d_d4orm.node import node_seed
from d4orm_planners.d_d4orm.transport import KINDS, Message, encode
from d4orm_planners.d_d4orm.zenoh_transport import ZenohSettings, ZenohTransport
from d4orm_planners.sampling.d4orm import D4orm

pytestmark = pytest.mark.slow

CIRCLE = make_problem("circle", num_robots=4, goal_speed=math.inf)
SEED = 3
LIMIT = 2**16
"""A limit of messages [bytes] that a busy machine is quick to exceed."""

STRONG = {"num_samples": 512, "num_steps": 50}
WEAK = {"num_samples": 6, "num_steps": 2}


class Solve:
    """A node's solve, in a thread."""

    def __init__(
        self,
        problem: Problem,
        *,
        node: int,
        nodes: int,
        zenoh: dict[str, Any],
        time_limit: float = TIMEOUT,
        callback: Callback | None = None,
        **settings: Any,
    ) -> None:
        planner = make_planner(
            "d-d4orm",
            **{"engine": "cpu", "max_iterations": 10**6, "timeout": 0.2, **settings},
            transport="zenoh",
            mode="async",
            node=node,
            nodes=nodes,
            zenoh={"grace_period": TIMEOUT, **zenoh},
        )
        self.iterations = 0
        self.found = False
        self._callback = callback
        self._plan: Plan | None = None
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, args=(planner, problem, time_limit), daemon=True)
        self._thread.start()

    def _run(self, planner: Any, problem: Problem, time_limit: float) -> None:
        try:
            self._plan = planner.solve(problem, seed=SEED, time_limit=time_limit, callback=self._record)
        except BaseException as error:
            self._error = error

    def _record(self, record: Any) -> Any:
        self.iterations, self.found = record.iteration, record.best_solved
        return self._callback(record) if self._callback is not None else None

    @property
    def running(self) -> bool:
        """Whether it has not ended."""
        return self._thread.is_alive()

    @property
    def plan(self) -> Plan:
        """The plan, once there is one."""
        self._thread.join(3 * TIMEOUT)
        assert not self._thread.is_alive(), "the solve hangs"
        if self._error is not None:
            raise self._error
        assert self._plan is not None
        return self._plan


@pytest.fixture
def attacker() -> Iterator[Callable[[str], ZenohTransport]]:
    """Opens ends of the network that send what they like."""
    ends: list[ZenohTransport] = []

    def opened(endpoint: str) -> ZenohTransport:
        ends.append(ZenohTransport(ZenohSettings(connect=(endpoint,))))
        wait_until(lambda: has_listeners(ends[-1]))
        return ends[-1]

    yield opened
    for end in ends:
        end.close()


def assert_verified(plan: Plan) -> None:
    assert plan.solved
    assert plan.status == "solved"
    assert verify(plan.problem, plan.controls).ok


def assert_all_have_the_same(plans: list[Plan]) -> None:
    for plan in plans:
        assert_verified(plan)
        # To rounding: what was clipped once is clipped again.
        np.testing.assert_allclose(plan.controls, plans[0].controls, atol=1e-5)


def test_all_nodes_end_with_the_best_candidate_of_all() -> None:
    endpoint = free_endpoint()
    solves = [
        Solve(CIRCLE, node=node, nodes=3, zenoh={"connect": [endpoint]} if node else {"listen": [endpoint]}, **STRONG)
        for node in range(3)
    ]
    assert_all_have_the_same([solve.plan for solve in solves])


def test_a_node_that_joins_late_gets_what_was_found() -> None:
    endpoint = free_endpoint()
    early = Solve(CIRCLE, node=0, nodes=2, zenoh={"listen": [endpoint]}, **STRONG)
    wait_until(lambda: early.found, "a solution")
    late = Solve(CIRCLE, node=1, nodes=2, zenoh={"connect": [endpoint]}, **WEAK)
    assert_all_have_the_same([early.plan, late.plan])


def test_a_node_that_was_started_again_is_heard_again() -> None:
    """What it tells now counts as newer than what it told before."""
    endpoint = free_endpoint()
    stop = threading.Event()
    other = Solve(CIRCLE, node=0, nodes=2, zenoh={"listen": [endpoint]}, **WEAK)
    first = Solve(CIRCLE, node=1, nodes=2, zenoh={"connect": [endpoint]}, callback=lambda record: stop.is_set(), **WEAK)
    wait_until(lambda: first.iterations > 20 and other.iterations > 20, "some iterations")
    stop.set()
    assert first.plan.status == "stopped"
    again = Solve(CIRCLE, node=1, nodes=2, zenoh={"connect": [endpoint]}, **STRONG)
    assert_all_have_the_same([other.plan, again.plan])


def test_messages_that_are_lost_doubled_and_late_do_no_harm(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    seeds = iter(range(10))
    monkeypatch.setattr(
        "d4orm_planners.d_d4orm.planner.ZenohTransport",
        lambda settings: FaultyTransport(ZenohTransport(settings), next(seeds), loss=0.2, duplicates=0.2, delay=1.0),
    )
    endpoint = free_endpoint()
    # Who loses the last word of another waits for it until this is over.
    listens, connects = {"listen": [endpoint], "grace_period": 10.0}, {"connect": [endpoint], "grace_period": 10.0}
    weak = [Solve(CIRCLE, node=1, nodes=3, zenoh=listens, **WEAK)]
    weak += [Solve(CIRCLE, node=2, nodes=3, zenoh=connects, **WEAK)]
    wait_until(lambda: all(solve.iterations > 3 for solve in weak), "some iterations")
    strong = Solve(CIRCLE, node=0, nodes=3, zenoh=connects, **STRONG)
    plans = [solve.plan for solve in [strong, *weak]]
    assert_all_have_the_same(plans)
    assert "(stale)" in caplog.text, "histories lack what comes after a node's last iteration"


@pytest.fixture
def ends(monkeypatch: pytest.MonkeyPatch) -> list[ZenohTransport]:
    """The ends of the network that solves have opened."""
    opened: list[ZenohTransport] = []

    def open_end(settings: ZenohSettings) -> ZenohTransport:
        opened.append(ZenohTransport(settings))
        return opened[-1]

    monkeypatch.setattr("d4orm_planners.d_d4orm.planner.ZenohTransport", open_end)
    return opened


def hold(monkeypatch: pytest.MonkeyPatch, node: int) -> threading.Event:
    """A node begins no iteration before this event."""
    iterate, go = D4orm.iterate, threading.Event()

    def held(self: D4orm, search: SolveRun, state: Any) -> tuple[Any, Iteration]:
        if search.seed == node_seed(SEED, node):
            go.wait()
        return iterate(self, search, state)

    monkeypatch.setattr(D4orm, "iterate", held)
    return go


def test_of_two_nodes_with_one_number_the_second_is_refused() -> None:
    endpoint, problem, enough = free_endpoint(), walled_in_problem(), threading.Event()
    zenoh = {"listen": [endpoint]}
    first = Solve(problem, node=0, nodes=2, zenoh=zenoh, callback=lambda record: enough.is_set(), **WEAK)
    wait_until(lambda: first.iterations > 0)
    second = Solve(problem, node=0, nodes=2, zenoh={"connect": [endpoint]}, **WEAK)
    with pytest.raises(ValueError, match=r"another process on the network is node 0 already; .* from 0 to 1"):
        second.plan  # noqa: B018 - raises what the solve raised
    before = first.iterations
    wait_until(lambda: first.iterations > before, "the first one goes on")
    enough.set()
    assert first.plan.status == "stopped"


def test_a_message_in_its_own_name_costs_no_node_its_solution(attacker: Callable[[str], ZenohTransport]) -> None:
    endpoint = free_endpoint()
    solve = Solve(
        CIRCLE, node=0, nodes=1, zenoh={"listen": [endpoint], "grace_period": 0.1}, improve=True,
        callback=lambda record: "x node" in record.note, **STRONG,
    )  # fmt: skip
    end = attacker(endpoint)
    wait_until(lambda: solve.found, "a solution")
    false = encode(Message(0, 1, np.zeros((CIRCLE.horizon, CIRCLE.num_robots, 2), np.float32), 0.0, False), CIRCLE)
    end.publish(false)
    assert solve.plan.solved
    assert solve.plan.status == "stopped"


@pytest.mark.parametrize("stalls", [True, False])
def test_a_partition_that_heals(
    stalls: bool, tmp_path: Path, ends: list[ZenohTransport], monkeypatch: pytest.MonkeyPatch
) -> None:
    # Without gossip nodes know of each other only through the link.
    path = tmp_path / "zenoh.json5"
    path.write_text("{scouting: {gossip: {enabled: false}}}")
    endpoint, go = free_endpoint(), hold(monkeypatch, 0)
    link = Link(endpoint, stalls)
    try:
        strong = Solve(CIRCLE, node=0, nodes=2, zenoh={"listen": [endpoint], "config_file": str(path)}, **STRONG)
        weak = Solve(CIRCLE, node=1, nodes=2, zenoh={"connect": [link.endpoint], "config_file": str(path)}, **WEAK)
        wait_until(lambda: len(ends) == 2 and all(has_listeners(end) for end in ends), "a connection")
        link.cut()
        go.set()
        wait_until(lambda: strong.found, "a solution")
        before = weak.iterations
        wait_until(lambda: weak.iterations > before + 20, "iterations without the other")
        assert not weak.found
        link.mend()
        assert_all_have_the_same([strong.plan, weak.plan])
    finally:
        go.set()
        link.close()


def test_what_arrives_while_a_node_hangs_is_not_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    endpoint, go = free_endpoint(), hold(monkeypatch, 1)
    try:
        hanging = Solve(CIRCLE, node=1, nodes=2, time_limit=10, zenoh={"listen": [endpoint]}, **STRONG)
        other = Solve(CIRCLE, node=0, nodes=2, zenoh={"connect": [endpoint]}, **STRONG)
        assert_verified(other.plan)
        assert_verified(hanging.plan)
        assert hanging.plan.history[-1].note == "node 1 did not finish in time"
    finally:
        go.set()


@pytest.mark.parametrize("heard", [True, False])
def test_what_has_arrived_is_not_lost_with_the_planner_here(heard: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    iterate, go = D4orm.iterate, threading.Event()

    def broken(self: D4orm, search: SolveRun, state: Any) -> tuple[Any, Iteration]:
        if search.seed != node_seed(SEED, 1):
            return iterate(self, search, state)
        go.wait()
        raise ArithmeticError("out of order")

    monkeypatch.setattr(D4orm, "iterate", broken)
    endpoint = free_endpoint()
    try:
        failing = Solve(CIRCLE, node=1, nodes=2, zenoh={"listen": [endpoint]}, **STRONG)
        if heard:
            other = Solve(CIRCLE, node=0, nodes=2, zenoh={"connect": [endpoint], "grace_period": 2.0}, **STRONG)
            assert_verified(other.plan)
    finally:
        go.set()
    if heard:
        assert_verified(failing.plan)
        assert failing.plan.history[-1].note == "node 1 failed (ArithmeticError: out of order)"
    else:
        with pytest.raises(RuntimeError, match="out of order"):
            _ = failing.plan


def nonsense(problem: Problem) -> dict[str, bytes]:
    """A message of each kind that is to be dropped; those of kind ``"stale"`` only the second time."""
    shape = (problem.horizon, problem.num_robots, problem.control_size)
    good = Message(1, 5, np.zeros(shape, np.float32), 0.5, False)
    data = encode(good, problem)

    def controls(value: float) -> bytes:
        return encode(replace(good, controls=np.full(shape, value, np.float32)), problem)

    return {
        "garbage": random.Random(0).randbytes(5000),
        "truncated": data[:-9],
        "too_large": bytes(LIMIT + 1),
        "version": data[:4] + struct.pack("<H", 9) + data[6:],
        "checksum": data[:-1] + bytes([data[-1] ^ 1]),
        "problem": encode(good, hop_problem(1, horizon=problem.horizon)),
        "node": encode(replace(good, node=7), problem),
        "shape": encode(replace(good, controls=np.zeros((1, 1, 2), np.float32)), problem),
        "not_finite": controls(np.nan),
        "limits": controls(1e20),
        "stale": data,
    }


def test_a_node_that_sends_garbage_is_counted_and_harmless(
    attacker: Callable[[str], ZenohTransport], caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(message_module, "MAX_BYTES", LIMIT)
    problem, endpoint, notes = walled_in_problem(), free_endpoint(), []
    messages = nonsense(problem)
    assert set(messages) == set(KINDS)

    def told(record: Any) -> bool:
        notes.append(record.note)
        return all(f"x {kind}" in " ".join(notes) for kind in KINDS)

    with caplog.at_level(logging.WARNING, "d4orm_planners.d_d4orm"):
        solve = Solve(problem, node=0, nodes=2, zenoh={"listen": [endpoint]}, callback=told, **WEAK)
        end = attacker(endpoint)
        while solve.running:
            for data in messages.values():
                end.publish(data)
            time.sleep(0.1)
        plan = solve.plan
    assert plan.status == "stopped", notes
    assert not plan.solved
    logged = [record.getMessage() for record in caplog.records if "with a fault" in record.getMessage()]
    for kind in KINDS:
        assert sum(f"({kind})" in text for text in logged) == 1


def test_a_plan_that_claims_a_false_reward_is_not_believed(attacker: Callable[[str], ZenohTransport]) -> None:
    endpoint, problem = free_endpoint(), walled_in_problem()
    shape = (problem.horizon, problem.num_robots, problem.control_size)
    notes: list[str] = []

    def told(record: Any) -> bool:
        notes.append(record.note)
        return sum("false claim" in note for note in notes) >= 3

    solve = Solve(problem, node=0, nodes=2, zenoh={"listen": [endpoint]}, callback=told, **WEAK)
    end = attacker(endpoint)
    claim = Message(1, 0, np.full(shape, 0.5, np.float32), 1e9, True)
    for sequence in itertools.count(1):
        end.publish(encode(replace(claim, sequence=sequence), problem))
        time.sleep(0.05)
        if not solve.running:
            break
    assert solve.plan.status == "stopped", notes
    assert not solve.plan.solved


def test_a_solution_is_found_among_liars(attacker: Callable[[str], ZenohTransport]) -> None:
    endpoint = free_endpoint()
    solve = Solve(CIRCLE, node=0, nodes=2, zenoh={"listen": [endpoint], "grace_period": 1.0}, **STRONG)
    end = attacker(endpoint)
    claim = Message(1, 1, np.zeros((CIRCLE.horizon, 4, 2), np.float32), 1e9, True)
    for sequence in range(1, 50):
        end.publish(random.Random(sequence).randbytes(300))
        end.publish(encode(replace(claim, sequence=sequence), CIRCLE))
    assert_verified(solve.plan)
    assert solve.plan.controls.any()
