"""Measurements that need a process of their own: compiling from nothing, starting up, memory."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time

from d4orm_planners.benchmark.timing import Measurement, Spread

_FIRST_PLAN = """
import json, sys, time
begin = time.perf_counter()
from d4orm_env import make_problem
from d4orm_planners import make_planner
from d4orm_planners.cli.warmup import compile_for_planning
imported = time.perf_counter()
problem = make_problem("circle", num_robots=int(sys.argv[1]))
planner = make_planner(engine="cpu")
compile_for_planning(problem.team.models, driver=planner.name)  # as the command line does
plan = planner.solve(problem, seed=0)
done = time.perf_counter()
print(json.dumps({"import": imported - begin, "solve": done - imported, "planning": plan.wall_time,
                  "solved": plan.solved}))
"""

_MEMORY = """
import json, resource, sys
from pathlib import Path
from d4orm_env import make_problem
from d4orm_planners import make_planner
def peak():
    # Linux carries the peak of the parent over into ru_maxrss when a process is started; VmHWM begins anew.
    status = Path("/proc/self/status")
    if status.is_file():
        line = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM"))
        return int(line.split()[1]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
num_robots, num_samples, horizon, diameter = int(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), float(sys.argv[4])
problem = make_problem("circle", num_robots=num_robots, diameter=diameter, horizon=horizon)
imported = peak()
planner = make_planner("d4orm", engine="cpu", num_samples=num_samples, num_steps=3, credit="robot")
planner.solve(problem, seed=0, max_iterations=2)
print(json.dumps({"imported": imported, "peak": peak()}))
"""


def _run(code: str, *arguments: object, cache: str | None = None) -> tuple[float, Measurement]:
    """Seconds from start to exit of a fresh interpreter, and what it printed.

    Raises:
        RuntimeError: If it fails; the message is its last line of error output.
    """
    environment = dict(os.environ) if cache is None else {**os.environ, "NUMBA_CACHE_DIR": cache}
    begin = time.perf_counter()
    process = subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)], capture_output=True, text=True, env=environment
    )
    seconds = time.perf_counter() - begin
    if process.returncode != 0:
        raise RuntimeError(f"a measurement in a process of its own failed: {process.stderr.strip().splitlines()[-1:]}")
    result: Measurement = json.loads(process.stdout.splitlines()[-1])
    return seconds, result


def measure_startup(num_robots: int, repetitions: int) -> Measurement:
    """First plan of a process: once with an empty kernel cache, then with a full one.

    Returns:
        ``cold`` seconds from start to exit of the first process and ``compiling``, the part that was neither importing
        nor planning; ``warm`` the :class:`Spread` of the processes after it, start to exit.
    """
    with tempfile.TemporaryDirectory() as cache:
        cold, first = _run(_FIRST_PLAN, num_robots, cache=cache)
        warm = [_run(_FIRST_PLAN, num_robots, cache=cache)[0] for _ in range(repetitions)]
    compiling = first["solve"] - first["planning"]
    return {"num_robots": num_robots, "cold": cold, "compiling": compiling, "warm": Spread.of(warm)}


def measure_memory(num_robots: int, num_samples: int, horizon: int, diameter: float) -> Measurement:
    """Peak resident memory of a process that plans, in bytes: after importing, and in all."""
    _, result = _run(_MEMORY, num_robots, num_samples, horizon, diameter)
    return {"num_robots": num_robots, "num_samples": num_samples, "horizon": horizon, **result}
