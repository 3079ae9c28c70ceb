"""Cost of a message between two nodes of D-D4orm: writing, sending, reading, and judging what it claims.

    python -m examples.studies.message_overhead --repetitions 500

Two ends in one process: threads (``local``), and zenoh peers that are connected by TCP over loopback. ``send`` is from
one end to the other; ``overhead`` is writing, sending and reading together. Judging, a rollout and the verification of
what is claimed to be a solution, is the price of trust and not of the message.
"""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from examples.outputs import argument_parser, count, require, save_table
from examples.studies import AS_IN_THE_PAPER

from d4orm_env import make_problem
from d4orm_planners import make_planner
from d4orm_planners.base.candidate import evaluate_controls
from d4orm_planners.d_d4orm.messages import Message, decode, encode
from d4orm_planners.d_d4orm.transport import LocalNetwork, Transport
from d4orm_planners.d_d4orm.zenoh_transport import ZenohSettings, ZenohTransport
from d4orm_planners.engine.select import get_sampling_engine


def seconds(work: Callable[[], Any], repetitions: int) -> float:
    """The median time of one call."""
    times = []
    for _ in range(repetitions):
        begin = time.perf_counter()
        work()
        times.append(time.perf_counter() - begin)
    return float(np.median(times))


def zenoh_pair() -> tuple[ZenohTransport, ZenohTransport]:
    """Two connected peers on loopback."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    first, second = (
        ZenohTransport(ZenohSettings(listen=(endpoint,))),
        ZenohTransport(ZenohSettings(connect=(endpoint,))),
    )
    while not (first.has_listeners and second.has_listeners):
        time.sleep(0.01)
    return first, second


def measure(robots: int, ends: tuple[Transport, Transport], repetitions: int) -> dict[str, float]:
    """Bytes of a message, and the medians of what is done with it [ms]."""
    problem = make_problem("circle", num_robots=robots, **AS_IN_THE_PAPER)
    plan = make_planner("d4orm", engine="cpu").solve(problem, seed=0, max_iterations=1)
    message = Message(0, 1, plan.controls, plan.metrics["reward"], plan.solved)
    data, engine = encode(message, problem), get_sampling_engine("cpu")

    def send() -> None:
        ends[0].publish(data)
        if ends[1].collect(timeout=10) != [data]:
            raise RuntimeError("a message was lost")

    parts = {
        "write": seconds(lambda: encode(message, problem), repetitions),
        "send": seconds(send, repetitions),
        "read": seconds(lambda: decode(data, problem, 2), repetitions),
    }
    evaluation = seconds(lambda: evaluate_controls(engine, problem, plan.controls), repetitions)
    milliseconds = {
        name: 1e3 * value for name, value in {**parts, "overhead": sum(parts.values()), "judge": evaluation}.items()
    }
    return {"bytes": len(data), **milliseconds}


def main() -> None:
    """Measure several teams and write the table."""
    parser = argument_parser(__doc__)
    parser.add_argument("--repetitions", type=count, default=300)
    arguments = parser.parse_args()
    require("zenoh", "zenoh")
    repetitions, teams = (20, (4,)) if arguments.quick else (arguments.repetitions, (8, 16, 32))
    network, peers = LocalNetwork(), zenoh_pair()
    transports: dict[str, tuple[Transport, Transport]] = {"local": (network.join(), network.join()), "zenoh": peers}
    rows = []
    for robots in teams:
        for name, ends in transports.items():
            measured = measure(robots, ends, repetitions)
            rows.append(
                {"robots": robots, "transport": name} | {key: f"{value:.3g}" for key, value in measured.items()}
            )
            print(rows[-1], flush=True)
    save_table(rows, arguments.out / "message_overhead.csv")
    for end in peers:
        end.close()


if __name__ == "__main__":
    main()
