"""D-D4orm: what is chosen and merged, what is dropped, and that no node can do harm to the others."""

from __future__ import annotations

import logging
import signal
import struct
import threading
import time
import zlib
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from network_support import TIMEOUT, wait_until
from planner_support import cheap_planner, hop_problem, walled_in_problem

from d4orm_env.core.problem import Problem
from d4orm_env.engine.threads import Threads
from d4orm_env.scenarios import make_problem
from d4orm_env.verify import verify
from d4orm_planners import Plan, make_planner
from d4orm_planners.base.candidate import evaluate_controls
from d4orm_planners.base.planner import Iteration, Planner
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.d_d4orm import inbox as inbox_module
from d4orm_planners.d_d4orm import node
from d4orm_planners.d_d4orm import transport as transport_module
from d4orm_planners.d_d4orm.inbox import Evaluator, Inbox, Stopped, choose, diverse, k_means, merge, shares, top_k
from d4orm_planners.d_d4orm.node import KINDS as KINDS_OF_EVENTS
from d4orm_planners.d_d4orm.node import Event, Node, PlanningTask, node_seed
from d4orm_planners.d_d4orm.transport import KINDS, MAGIC, WAITING, LocalNetwork, Message, MessageError, decode, encode
from d4orm_planners.engine.sampling_types import get_sampling_engine
from d4orm_planners.sampling.d4orm import D4orm, D4ormConfig

PROBLEM = hop_problem(2, horizon=4)
SHAPE = (4, 2, 2)
MODE = pytest.mark.parametrize("mode", ["sync", "async"])


def generator(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


# Selection and merging.


@dataclass(frozen=True)
class Item:
    node: int
    sequence: int


def test_samples_are_split_evenly() -> None:
    assert shares(256, 2) == (128, 128)
    assert shares(10, 4) == (3, 3, 2, 2)
    assert shares(3, 1) == (3,)


def test_merging_keeps_the_newest_of_every_node() -> None:
    held = {0: Item(0, 3), 1: Item(1, 1)}
    arrivals = [Item(1, 2), Item(0, 3), Item(2, 7), Item(1, 4), Item(1, 3), Item(0, 1)]
    merged, stale = merge(held, arrivals)
    assert merged == {0: Item(0, 3), 1: Item(1, 4), 2: Item(2, 7)}
    assert stale == (Item(0, 3), Item(0, 1))
    assert held == {0: Item(0, 3), 1: Item(1, 1)}
    assert merge({}, []) == ({}, ())


def test_top_k_are_the_k_best_and_of_equal_ones_the_first() -> None:
    assert top_k([0.1, 0.9, 0.5, 0.9, 0.2], 3) == (1, 3, 2)
    assert top_k([0.1, 0.9], 4) == (1, 0)


def test_k_means_finds_the_groups() -> None:
    points = [[0, 0], [10, 0], [0, 1], [10, 1], [0, 9]]
    for seed in range(5):
        labels = k_means(points, 3, generator(seed))
        assert labels[0] == labels[2]
        assert labels[1] == labels[3]
        assert len(set(labels)) == 3
        np.testing.assert_array_equal(labels, k_means(points, 3, generator(seed)))


@pytest.mark.parametrize("seed", range(5))
def test_k_means_puts_every_point_to_the_nearest_mean(seed: int) -> None:
    points = np.random.default_rng(seed).gamma(1, size=(40, 2))
    labels = k_means(points, 4, generator(seed))
    means = np.stack([points[labels == cluster].mean(axis=0) for cluster in range(4)])
    np.testing.assert_array_equal(labels, np.linalg.norm(points[:, None] - means, axis=2).argmin(axis=1))


def test_k_means_of_points_that_are_fewer_or_all_the_same() -> None:
    assert set(k_means([[1.0], [2.0]], 4, generator())) == {0, 1}
    assert set(k_means([[1.0], [1.0], [1.0]], 2, generator())) == {0}


def test_the_diverse_are_the_best_of_each_group() -> None:
    points = [[0, 0], [10, 0], [0, 1], [10, 1], [0, 9]]
    assert diverse([0.2, 0.3, 0.8, 0.1, 0.5], points, 3, generator()) == (2, 4, 1)


def test_each_rule_chooses_among_its_own() -> None:
    rewards, points = [0.9, 0.8, 0.1, 0.7], [[0.0], [0.1], [5.0], [0.2]]

    def chosen(rule: str, k: int) -> set[int]:
        return {choose(rule, rewards, points, k, generator(seed)) for seed in range(40)}

    assert chosen("max", 3) == {0}
    assert chosen("top-k", 1) == {0}
    assert chosen("top-k", 3) == {0, 1, 3}
    assert chosen("k-means", 2) == {0, 2}
    assert choose("top-k", rewards, points, 3, generator(8)) == choose("top-k", rewards, points, 3, generator(8))
    with pytest.raises(ValueError, match="selection 'best' is unknown; choose one of top-k, max, k-means"):
        choose("best", rewards, points, 1, generator())


# The codec.


def message(**changes: Any) -> Message:
    controls = generator(1).uniform(-0.5, 0.5, SHAPE).astype(np.float32)
    return replace(Message(1, 3, controls, 0.25, False), **changes)


def sealed(data: bytes) -> bytes:
    """Bytes, less a checksum, with the checksum that fits them."""
    return data + struct.pack("<I", zlib.crc32(data))


def fault_of(data: bytes, problem: Problem = PROBLEM) -> str:
    with pytest.raises(MessageError) as caught:
        decode(data, problem, 2)
    return caught.value.kind


@given(
    arrays(np.float32, SHAPE, elements=st.floats(-1000, 1000, width=32)),
    st.integers(0, 1),
    st.integers(0, 2**64 - 1),
    st.floats(allow_nan=False, allow_infinity=False),
    st.booleans(),
)
def test_a_message_comes_back(controls: Any, sender: int, sequence: int, reward: float, feasible: bool) -> None:
    sent = Message(sender, sequence, controls, reward, feasible)
    got = decode(encode(sent, PROBLEM), PROBLEM, 2)
    np.testing.assert_array_equal(got.controls, controls)
    assert (got.node, got.sequence, got.reward, got.feasible) == (sender, sequence, reward, feasible)


@given(st.binary(max_size=300))
def test_garbage_is_refused(data: bytes) -> None:
    assert fault_of(data) in KINDS


@given(st.binary(max_size=300))
def test_garbage_with_a_good_beginning_is_refused(data: bytes) -> None:
    assert fault_of(encode(message(), PROBLEM)[:6] + data) in KINDS


@given(st.data())
def test_every_changed_byte_is_noticed(data: st.DataObject) -> None:
    original = encode(message(), PROBLEM)
    where = data.draw(st.integers(0, len(original) - 1))
    change = data.draw(st.integers(1, 255))
    changed = bytearray(original)
    changed[where] ^= change
    kind = fault_of(bytes(changed))
    if where < 4:
        assert kind == "garbage"
    elif where < 6:
        assert kind == "version"
    else:
        assert kind in ("checksum", "truncated", "too_large")


@given(st.integers(0, 1000))
def test_a_message_cut_short_or_with_more_at_its_end_is_refused(length: int) -> None:
    data = encode(message(), PROBLEM)
    length = min(length, len(data) - 1)
    assert fault_of(data[:length]) == ("truncated" if length else "garbage")
    assert fault_of(data + bytes(length + 1)) == "too_large"


def test_every_fault_has_its_kind(monkeypatch: pytest.MonkeyPatch) -> None:
    data = encode(message(), PROBLEM)
    controls = message().controls
    assert fault_of(b"") == fault_of(b"hello, nodes") == "garbage"
    assert fault_of(MAGIC) == fault_of(data[:-1]) == "truncated"
    assert fault_of(sealed(data[:4] + struct.pack("<H", 2) + data[6:-4])) == "version"
    assert fault_of(data[:-1] + bytes([data[-1] ^ 1])) == "checksum"
    assert fault_of(encode(message(), hop_problem(2, horizon=5))) == "problem"
    assert fault_of(encode(message(node=2), PROBLEM)) == "node"
    assert fault_of(encode(message(controls=controls.reshape(2, 4, 2)), PROBLEM)) == "shape"
    assert fault_of(encode(message(controls=controls[:3]), PROBLEM)) == "shape"
    assert fault_of(encode(message(reward=float("nan")), PROBLEM)) == "not_finite"
    for value, kind in ((np.nan, "not_finite"), (-np.inf, "not_finite"), (1e30, "limits"), (-1.01e15, "limits")):
        spoilt = controls.copy()
        spoilt[2, 1, 0] = value
        assert fault_of(encode(message(controls=spoilt), PROBLEM)) == kind
    monkeypatch.setattr(transport_module, "MAX_BYTES", len(data) - 1)
    assert fault_of(data) == "too_large"
    with pytest.raises(MessageError, match=f"takes {len(data)} bytes; at most {len(data) - 1}"):
        encode(message(), PROBLEM)


def test_sizes_that_overflow_announce_no_memory() -> None:
    data = encode(message(), PROBLEM)
    huge = data[:20] + struct.pack("<III", *[2**32 - 1] * 3) + data[32:-4]
    assert fault_of(sealed(huge)) == "truncated"


# The transport.


def test_local_messages_reach_everybody_else() -> None:
    network = LocalNetwork()
    first, second, third = (network.join() for _ in range(3))
    first.publish(b"a")
    second.publish(b"b")
    assert first.collect() == [b"b"]
    assert second.collect() == [b"a"]
    assert third.collect() == [b"a", b"b"]
    assert third.collect() == []


def test_of_many_waiting_messages_the_oldest_are_lost() -> None:
    network = LocalNetwork()
    first, second = network.join(), network.join()
    for number in range(WAITING + 5):
        first.publish(bytes([number]))
    assert second.collect() == [bytes([number]) for number in range(5, WAITING + 5)]


def test_collecting_waits_for_a_message_or_the_end() -> None:
    network = LocalNetwork()
    first, second = network.join(), network.join()
    for action, expected in ((lambda: first.publish(b"a"), [b"a"]), (second.close, [])):
        collected: list[list[bytes]] = []
        waiting = threading.Thread(target=lambda kept=collected: kept.append(second.collect(timeout=3600)), daemon=True)
        waiting.start()
        action()
        waiting.join(TIMEOUT)
        assert collected == [expected]
    second.close()
    first.publish(b"b")
    second.publish(b"c")
    assert second.collect(timeout=30) == first.collect() == []


# The inbox.


def inbox() -> tuple[Inbox, Any]:
    network = LocalNetwork()
    own, other = network.join(), network.join()
    return Inbox(Evaluator(get_sampling_engine("cpu"), PROBLEM), own, 3, own=0), other


def test_what_is_no_message_is_dropped_counted_and_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    box, other = inbox()
    data = encode(message(), PROBLEM)
    for sent in (b"junk", b"more junk", data[:50], data, encode(message(sequence=2), PROBLEM)):
        other.publish(sent)
    with caplog.at_level(logging.WARNING):
        assert [report.sequence for report in box.receive()] == [3]
        for sent in (data, b"junk", encode(message(node=0), PROBLEM)):
            other.publish(sent)
        assert box.receive() == []
    assert box.dropped == Counter({"garbage": 3, "truncated": 1, "stale": 1, "node": 1})
    logged = [record.getMessage() for record in caplog.records]
    kinds = [next(kind for kind in (*KINDS, "false claim") if f"({kind})" in text) for text in logged]
    assert sorted(kinds) == ["false claim", "garbage", "node", "stale", "truncated"]


def test_a_candidate_counts_for_what_it_is_not_for_what_is_claimed() -> None:
    box, other = inbox()
    other.publish(encode(message(reward=1e9, feasible=True), PROBLEM))
    (report,) = box.receive()
    found = evaluate_controls(get_sampling_engine("cpu"), PROBLEM, message().controls)
    assert report.candidate.rank == found.rank
    assert not report.candidate.solved
    assert box.false_claims == 1
    reward = float(found.trajectory.rewards.mean())
    other.publish(encode(message(sequence=4, reward=reward), PROBLEM))
    assert len(box.receive()) == 1
    assert box.false_claims == 1


@pytest.mark.parametrize(
    ("share", "feasible", "false"), [(1, True, False), (1, False, True), (0.5, True, True), (2, True, True)]
)
def test_a_claim_is_false_where_either_of_its_parts_is(share: float, feasible: bool, false: bool) -> None:
    near = Problem(PROBLEM.team, PROBLEM.start, PROBLEM.start[:, :2] + [0.05, 0], horizon=4)
    controls = np.zeros(SHAPE, np.float32)
    found = evaluate_controls(get_sampling_engine("cpu"), near, controls)
    assert found.solved
    network = LocalNetwork()
    own, other = network.join(), network.join()
    box = Inbox(Evaluator(get_sampling_engine("cpu"), near), own, 2, own=0)
    reward = float(found.trajectory.rewards.mean())
    other.publish(encode(message(controls=controls, reward=share * reward, feasible=feasible), near))
    (report,) = box.receive()
    assert report.candidate.solved
    assert box.false_claims == false


def test_what_arrives_is_gone_on_from_as_planned_and_counts_as_executed() -> None:
    box, other = inbox()
    planned = 5 * np.sign(message().controls)
    other.publish(encode(message(controls=planned), PROBLEM))
    (report,) = box.receive()
    np.testing.assert_array_equal(report.candidate.planned, planned)
    assert np.abs(report.candidate.controls).max() <= 1


def test_what_is_told_again_is_not_judged_again(monkeypatch: pytest.MonkeyPatch) -> None:
    box, other = inbox()
    calls = []

    def evaluator(*arguments: Any) -> Any:
        calls.append(arguments)
        return evaluate_controls(*arguments)

    monkeypatch.setattr(inbox_module, "evaluate_controls", evaluator)
    other.publish(encode(message(), PROBLEM))
    (first,) = box.receive()
    told, executed = first.candidate.planned, first.candidate.controls
    for sender, sequence in ((1, 4), (1, 5), (2, 1)):
        other.publish(encode(message(node=sender, sequence=sequence, controls=told), PROBLEM))
        (again,) = box.receive()
        np.testing.assert_array_equal(again.candidate.controls, executed)
        assert again.candidate.rank == first.candidate.rank
    assert len(calls) == 1


def test_what_a_process_has_made_is_judged_once() -> None:
    evaluator = Evaluator(get_sampling_engine("cpu"), PROBLEM, remembered=2)
    made = [evaluator.own(message().controls * scale) for scale in (0.25, 0.5, 1.0)]
    assert evaluator.received(made[2].controls.copy()) is made[2]
    assert evaluator.received(made[1].controls) is made[1]
    forgotten = evaluator.received(made[0].controls)
    assert forgotten is not made[0]
    assert forgotten.rank == made[0].rank
    changed = made[2].controls.copy()
    changed[0, 0, 0] += 0.125
    assert evaluator.received(changed).rank != made[2].rank


def alone(planner: Planner, evaluator: Evaluator | None = None) -> Node:
    """A network's only node."""
    task = PlanningTask(1, 0, None, "max", 1)
    return Node(0, task, planner, LocalNetwork().join(), evaluator or Evaluator(get_sampling_engine("cpu"), PROBLEM))


def test_the_word_to_stop_ends_judging_and_denoising() -> None:
    evaluator = Evaluator(get_sampling_engine("cpu"), PROBLEM, remembered=1)
    evaluator.stop.set()
    with pytest.raises(Stopped):
        evaluator.own(message().controls)
    node = alone(cheap_planner("d4orm"), evaluator)
    with pytest.raises(Stopped):
        node.refine()
    assert node.search.planner.iterate(node.search, None)[1].denoising_steps == 0


# The planner.


def test_a_node_that_closes_lets_its_planner_finish() -> None:
    finished = []

    class Finishing(D4orm):
        def init(self, search: SolveRun) -> str:
            return "begun"

        def finish(self, search: SolveRun, state: str) -> None:
            finished.append((search, state))

    node = alone(Finishing(D4ormConfig(num_samples=2, num_steps=1)))
    node.close()
    assert not finished, "it had not begun"
    node.refine()
    for _ in range(2):
        node.close()
        assert finished == [(node.search, "begun")]


def test_a_node_whose_time_is_over_makes_no_other_round() -> None:
    for limit, again in ((3600.0, True), (1e-9, False)):
        node = alone(cheap_planner("d4orm"))
        node.search.time_limit = limit
        assert node.step(threading.Event(), timeout=0.0, improve=True) is again


def test_engines_that_share_the_cores_use_all_of_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("D4ORM_NUM_THREADS", "4")
    together = threading.Barrier(4, timeout=30)
    callers = [threading.Thread(target=Threads(2).over, args=(2, lambda part: together.wait())) for _ in range(2)]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join()
    assert not together.broken


def distributed(**config: Any) -> Any:
    return make_planner("d-d4orm", **{"engine": "cpu", "num_samples": 128, "num_steps": 20} | config)


def assert_verified(plan: Plan) -> None:
    assert plan.solved
    assert verify(plan.problem, plan.controls).ok


def spoil(monkeypatch: pytest.MonkeyPatch, seed: int, act: Callable[[SolveRun], Any]) -> None:
    """Have node 1 of solves with this seed do something before every iteration."""
    iterate = D4orm.iterate

    def spoilt(self: D4orm, search: SolveRun, state: Any) -> tuple[Any, Iteration]:
        if search.seed == node_seed(seed, 1):
            act(search)
        return iterate(self, search, state)

    monkeypatch.setattr(D4orm, "iterate", spoilt)


@pytest.mark.parametrize("selection", ["top-k", "max", "k-means"])
@pytest.mark.parametrize("nodes", [2, 3])
def test_synchronous_rounds_give_the_same_plan_every_time(selection: str, nodes: int) -> None:
    problem = make_problem("circle", num_robots=4)
    planner = cheap_planner("d-d4orm", nodes=nodes, selection=selection, k=2, improve=True)
    plans = [planner.solve(problem, seed=3, max_iterations=4) for _ in range(3)]
    for plan in plans[1:]:
        np.testing.assert_array_equal(plan.controls, plans[0].controls)
        assert [record.reward for record in plan.history] == [record.reward for record in plans[0].history]


@pytest.mark.parametrize("preset", [None, "paper"])
def test_a_single_node_is_the_planner_that_it_runs(preset: str | None) -> None:
    problem = make_problem("circle", num_robots=4)
    # The presets of D4orm and D4orm-D differ in it, and the nodes' is D4orm's.
    settings = {} if preset is None else {"clip_between_iterations": False}
    for inner in ("d4orm", "d4orm-d"):
        alone = cheap_planner("d-d4orm", preset=preset, planner=inner, nodes=1).solve(problem, seed=2, max_iterations=3)
        plain = cheap_planner(inner, preset=preset, **settings).solve(problem, seed=2, max_iterations=3)
        np.testing.assert_array_equal(alone.controls, plain.controls)


@pytest.mark.parametrize("clip", [True, False])
def test_nodes_search_by_themselves_and_then_go_on_from_a_common_base(clip: bool) -> None:
    planner = distributed(nodes=3, selection="max", clip_between_iterations=clip, final_approach=False)
    search = SolveRun(planner, walled_in_problem(), 0, None)
    search.advance()
    nodes = search.state.pool.alive
    made = [one.candidate for one in nodes]
    best = max(made, key=lambda candidate: candidate.trajectory.rewards.mean())
    assert len({candidate.controls.tobytes() for candidate in made}) == 3
    for one in nodes:
        np.testing.assert_array_equal(one.search.current.planned, best.planned)
        np.testing.assert_array_equal(one.search.current.controls, best.controls)
    assert np.abs(best.planned).max() > 1.1  # There is a difference.
    assert [one.search.planner.config.num_samples for one in nodes] == [43, 43, 42]
    search.close()


@MODE
@pytest.mark.parametrize("inner", ["d4orm", "d4orm-d"])
def test_it_solves(mode: str, inner: str) -> None:
    problem = make_problem("circle", num_robots=4)
    plan = distributed(mode=mode, planner=inner, num_samples=256, num_steps=50).solve(problem, time_limit=60)
    assert_verified(plan)
    assert plan.status == "solved"
    assert all(record.note == "" for record in plan.history)


@MODE
def test_a_node_that_fails_does_not_take_the_others_down(
    mode: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(search: SolveRun) -> None:
        raise ZeroDivisionError("the node is broken")

    spoil(monkeypatch, 5, fail)
    # Whoever waits for somebody who is gone waits until the timeout passes, once.
    planner = distributed(mode=mode, nodes=3, improve=True, timeout=0.2)
    plan = planner.solve(hop_problem(2), seed=5, max_iterations=4)
    assert_verified(plan)
    assert "node 1 failed (ZeroDivisionError" in caplog.text
    assert plan.iterations == 4
    notes = [record.note for record in plan.history if record.note]
    assert notes == ["node 1 failed (ZeroDivisionError: the node is broken)"]


@MODE
def test_when_all_nodes_have_failed_the_error_says_so(mode: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(self: D4orm, search: SolveRun, state: Any) -> Any:
        raise ZeroDivisionError("broken")

    monkeypatch.setattr(D4orm, "iterate", fail)
    with pytest.raises(RuntimeError, match=r"all 2 nodes .*node 0 failed \(ZeroDivisionError: broken\).*node 1"):
        distributed(mode=mode).solve(hop_problem(2))


@MODE
@pytest.mark.parametrize("spoilt", ["garbage", "claim"])
def test_a_node_that_sends_nonsense_is_harmless(mode: str, spoilt: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def send(sent: Message, problem: Problem) -> bytes:
        if sent.node != 1:
            return encode(sent, problem)
        if spoilt == "garbage":
            return b"nonsense"
        return encode(replace(sent, controls=np.zeros_like(sent.controls), reward=1e9, feasible=True), problem)

    monkeypatch.setattr(node, "encode", send)
    plan = distributed(mode=mode, improve=True, timeout=0.2).solve(hop_problem(2), seed=1, max_iterations=3)
    assert_verified(plan)
    notes = " ".join(record.note for record in plan.history)
    assert f"x {'false claim' if spoilt == 'claim' else 'garbage'}" in notes
    if mode == "sync":
        assert plan.history[0].note == f"received 1 x {'false claim' if spoilt == 'claim' else 'garbage'}"


@MODE
def test_a_node_that_hangs_does_not_hang_the_solve(mode: str, monkeypatch: pytest.MonkeyPatch) -> None:
    release, woken = threading.Event(), []
    spoil(monkeypatch, 5, lambda search: woken.append(release.wait(60)))
    try:
        planner = distributed(mode=mode, timeout=0.2, max_iterations=10**6)
        plan = planner.solve(walled_in_problem(), seed=5, time_limit=0.5)
        assert not woken, "the node hung to the end"
    finally:
        release.set()
    assert plan.status == "time_limit"
    # What the other node found is not lost.
    assert plan.controls.any()
    if mode == "sync":
        assert plan.history[-1].note.startswith("node 1 did not finish in time")


@MODE
def test_a_plan_tells_what_its_nodes_sent(mode: str) -> None:
    problem = walled_in_problem()
    plan = cheap_planner("d-d4orm", nodes=3, mode=mode, timeout=10).solve(problem, max_iterations=2)
    length = len(encode(Message(0, 1, plan.controls, 0.0, False), problem))
    if mode == "sync":
        assert plan.metrics["messages"] == 6
    assert plan.metrics["messages"] >= 6
    assert plan.metrics["message_bytes"] == length * plan.metrics["messages"]
    assert 0 <= plan.metrics["waiting_share"] < 1
    assert "messages" not in cheap_planner("d4orm").solve(problem, max_iterations=1).metrics


@MODE
def test_who_is_quick_waits_for_who_is_slow(mode: str, monkeypatch: pytest.MonkeyPatch) -> None:
    spoil(monkeypatch, 6, lambda search: time.sleep(0.5))
    plan = cheap_planner("d-d4orm", mode=mode, timeout=60).solve(walled_in_problem(), seed=6)
    # Half a second of waiting, and whatever a slow machine takes to plan.
    assert plan.metrics["waiting_share"] > 0.02


def press_ctrl_c() -> None:
    signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)


def node_threads() -> list[threading.Thread]:
    """Threads in which nodes plan."""
    return [one for one in threading.enumerate() if one.name.startswith("d-d4orm-") and one.is_alive()]


POSIX = pytest.mark.skipif(not hasattr(signal, "pthread_kill"), reason="needs signals to threads")


@POSIX
@MODE
def test_ctrl_c_ends_an_iteration_under_way(mode: str) -> None:
    # Which would take minutes, and the timeout as long.
    planner = distributed(mode=mode, num_steps=10**6, timeout=600)

    def interrupt() -> None:
        wait_until(lambda: len(node_threads()) == planner.config.nodes, "nodes that plan")
        time.sleep(0.2)
        press_ctrl_c()

    threading.Thread(target=interrupt, daemon=True).start()
    plan = planner.solve(walled_in_problem())
    assert plan.status == "interrupted"
    # Python may still list a thread whose end was being waited for.
    assert not node_threads()


@POSIX
@MODE
def test_ctrl_c_loses_nothing_that_a_node_has_found(mode: str, monkeypatch: pytest.MonkeyPatch) -> None:
    planned, sent, release = walled_in_problem(), threading.Event(), threading.Event()

    def send(sent_message: Message, problem: Problem) -> bytes:
        # A thread that an earlier test left may send too.
        if problem is planned:
            sent.set()
        return encode(sent_message, problem)

    def interrupt() -> None:
        sent.wait(60)
        press_ctrl_c()
        release.set()

    monkeypatch.setattr(node, "encode", send)
    spoil(monkeypatch, 5, lambda search: release.wait(60))
    threading.Thread(target=interrupt).start()
    plan = distributed(mode=mode, timeout=60).solve(planned, seed=5)
    assert plan.status == "interrupted"
    assert plan.controls.any()


@MODE
def test_ctrl_c_while_a_node_starts_leaves_no_thread(mode: str, monkeypatch: pytest.MonkeyPatch) -> None:
    start = threading.Thread.start

    def interrupted(thread: threading.Thread) -> None:
        start(thread)
        if thread.name == "d-d4orm-1":
            raise KeyboardInterrupt

    monkeypatch.setattr(threading.Thread, "start", interrupted)
    plan = distributed(mode=mode, num_steps=10**6, timeout=60).solve(walled_in_problem())
    assert plan.status == "interrupted"
    assert not node_threads()


def test_no_thread_outlives_a_solve() -> None:
    for mode in ("sync", "async"):
        distributed(mode=mode, timeout=10).solve(walled_in_problem(), max_iterations=2)
        assert not [thread for thread in threading.enumerate() if thread.name.startswith("d-d4orm-")]


def test_an_observer_is_told_what_a_node_does() -> None:
    problem, network = hop_problem(2), LocalNetwork()
    planner = D4orm(D4ormConfig(engine="cpu", num_samples=64, num_steps=5))
    events: list[Event] = []
    controls = np.zeros((problem.horizon, 2, 2), np.float32)
    task, evaluator = PlanningTask(2, 0, controls, "max", 1), Evaluator(get_sampling_engine("cpu"), problem)
    nodes = [
        Node(i, task, planner, network.join(), evaluator, observer=observer)
        for i, observer in enumerate((events.append, None))
    ]
    for one in nodes:
        one.refine()
    nodes[0].exchange()
    computed, sent, received, selected = events
    assert [event.kind for event in events] == list(KINDS_OF_EVENTS)
    assert [(event.node, event.of, event.sequence) for event in events[:3]] == [(0, 0, 0), (0, 0, 1), (0, 1, 1)]
    assert computed.begin < computed.end <= sent.begin == sent.end <= received.begin
    assert sent.candidate is computed.candidate is nodes[0].candidate
    assert received.candidate is nodes[0].inbox.newest[1].candidate
    header_and_checksum = 76
    assert sent.size == controls.nbytes + header_and_checksum
    best = max((sent, received), key=lambda event: event.candidate.trajectory.rewards.mean())
    assert (selected.of, selected.sequence, selected.candidate) == (best.of, 1, best.candidate)


def test_settling_says_whether_all_others_have_a_solution_as_good() -> None:
    problem, network = hop_problem(2), LocalNetwork()
    task = PlanningTask(2, 0, distributed().solve(problem).controls, "max", 1)
    evaluator = Evaluator(get_sampling_engine("cpu"), problem)
    first, second = (Node(i, task, cheap_planner("d4orm"), network.join(), evaluator) for i in range(2))
    assert not first.settle(0), "nobody has told it anything"
    assert second.settle(0)
    assert first.settle(0)


def test_nodes_do_not_settle_for_solutions_that_are_nearly_as_good() -> None:
    problem, network = hop_problem(2), LocalNetwork()
    good = distributed().solve(problem).controls
    evaluator = Evaluator(get_sampling_engine("cpu"), problem)
    first, second = (
        Node(i, PlanningTask(2, 0, share * good, "max", 1), cheap_planner("d4orm"), network.join(), evaluator)
        for i, share in enumerate(np.float32([1, 0.9999]))
    )
    better, worse = first.search.best, second.search.best
    assert better.solved
    assert worse.solved
    assert 1e-5 < better.reward - worse.reward < 1e-3
    assert not second.settle(0), "nobody has told it anything"
    assert not first.settle(0), "the other has told of its own"
    assert second.settle(0)
    assert first.settle(0)


@pytest.mark.slow
def test_an_asynchronous_node_waits_once_for_one_that_is_silent(monkeypatch: pytest.MonkeyPatch) -> None:
    release = threading.Event()
    spoil(monkeypatch, 5, lambda search: release.wait(60))
    timeout, enough = 3, 10
    planner = distributed(mode="async", timeout=timeout, num_steps=2)
    search = SolveRun(planner, walled_in_problem(), 5, None)
    try:
        search.advance()
        fast, silent = search.state.pool.alive
        # Waiting every time, the other node would not get so far in that time.
        while fast.search.iteration <= enough and search.watch.elapsed < enough * timeout:
            search.advance()
        assert silent.search.iteration == 0
        assert fast.search.iteration > enough
    finally:
        release.set()
        search.close()


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ({"planner": "mppi"}, "planner 'mppi' is unknown; choose one of d4orm, d4orm-d"),
        ({"selection": "best"}, "selection 'best' is unknown; choose one of top-k, max, k-means"),
        ({"mode": "later"}, "mode 'later' is unknown; choose one of sync, async"),
        ({"transport": "pigeon"}, "transport 'pigeon' is unknown; choose one of local, ray, zenoh"),
        ({"nodes": 0}, "nodes is 0; it must be at least 1"),
        ({"node": 1}, "node is 1; it is a setting of transport 'zenoh' only"),
        ({"zenoh": {}}, "zenoh is {}; it is a setting of transport 'zenoh' only"),
        ({"transport": "zenoh", "node": 0}, "mode is 'sync'; over a network it must be 'async'"),
        ({"transport": "zenoh", "mode": "async"}, "node is None; over a network it must say which"),
        ({"transport": "zenoh", "mode": "async", "node": 2}, "node is 2; of 2 nodes the last one is 1"),
        ({"transport": "zenoh", "mode": "async", "node": 0, "zenoh": {"port": 1}}, "'port' is no setting of zenoh"),
        ({"nodes": 2.0}, "nodes must be a whole number, not 2.0"),
        ({"k": 0}, "k is 0; it must be at least 1"),
        ({"timeout": -1}, "timeout is -1; it must be zero or more"),
        ({"nodes": 8, "num_samples": 15}, "num_samples is 15 for 8 nodes together; .* 16 or more"),
        ({"planner": "d4orm-d", "repair_samples": 3}, "repair_samples is 3 for 2 nodes together"),
    ],
)
def test_a_bad_setting_is_refused_by_name(settings: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        make_planner("d-d4orm", **settings)


def test_nodes_take_the_settings_of_the_planner_that_they_run() -> None:
    with pytest.raises(TypeError, match=r"'repair_steps' is no setting of planner 'd-d4orm'; it takes .*late_samples"):
        make_planner("d-d4orm", repair_steps=7)
    planner = make_planner("d-d4orm", planner="d4orm-d", repair_steps=7, nodes=3, num_samples=100, improve=True)
    config: Any = planner.config
    assert {one.config.repair_steps for one in config.node_planners(3)} == {7}
    assert [one.config.num_samples for one in config.node_planners(3)] == [34, 33, 33]
    assert make_planner("d-d4orm", **config.keywords()).config == config
    with pytest.raises(ValueError, match="refinement: "):
        replace(config, refinement={"repair_steps": 7})


def test_the_paper_preset_is_algorithm_5_with_a_node_per_robot() -> None:
    config = make_planner("d-d4orm", preset="paper").config
    inner = config.refinement
    assert (config.node_planner.name, config.nodes, config.selection, config.k, config.mode) == (
        "d4orm",
        None,
        "top-k",
        4,
        "sync",
    )
    assert (inner.num_samples, inner.num_steps, inner.credit, inner.random_start) == (2048, 100, "team", False)
    assert inner.penalty == 1.0
    assert inner.clip_between_iterations is False
    search = SolveRun(make_planner("d-d4orm", preset="paper", engine="cpu", num_steps=2), hop_problem(3), 0, None)
    search.advance()
    assert [one.search.planner.config.num_samples for one in search.state.pool.alive] == [683, 683, 682]
    with pytest.raises(ValueError, match="num_samples is 5 for 3 nodes together"):
        make_planner("d-d4orm", engine="cpu", nodes=None, num_samples=5).solve(hop_problem(3))
