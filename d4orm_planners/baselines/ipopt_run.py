"""Running IPOPT through CasADi, in a thread that is abandoned if it does not end in time.

A. Waechter and L. T. Biegler, "On the Implementation of an Interior-Point Filter Line-Search Algorithm for Large-Scale
Nonlinear Programming", Mathematical Programming, 2006.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor, wait
from threading import Event
from typing import Any, NamedTuple, TypeAlias, TypeVar

import numpy as np

from d4orm_env.core.arrays import Floats
from d4orm_env.core.lazy import LazyModule

casadi: Any = LazyModule("casadi", "planner 'ipopt'", "ipopt")

Result = TypeVar("Result")
Options = Mapping[str, object]
Expression: TypeAlias = Any
"""CasADi's matrices, symbolic or of numbers; the library carries no types."""

FEASIBILITY = 1e-5
"""Largest violation of a constraint that IPOPT may leave, in the program's units; the clearance makes up for it."""
IPOPT = {"print_level": 0, "sb": "yes", "constr_viol_tol": FEASIBILITY}
CASADI = {"print_time": False, "show_eval_warnings": False}
"""Options of every solve."""
ABANDONED = "Abandoned_At_Time_Limit"
"""Status of a run that was left before IPOPT could end it."""
LOOK = 0.01
"""Period of asking the caller whether to stop [s]."""
GRACE = 0.05
"""Time that work which was asked to end is waited for [s]."""


class NonlinearProgram(NamedTuple):
    """A program as CasADi takes it."""

    functions: Mapping[str, Expression]  #: Variables ``x``, cost ``f`` and constraints ``g``, each one column
    bounds: Mapping[str, Floats]  #: ``lbx``, ``ubx``, ``lbg`` and ``ubg`` of these


def run_ipopt(
    write: Callable[[], NonlinearProgram], guess: Floats, options: Options, should_stop: Callable[[], bool]
) -> tuple[Floats, str]:
    """Solve a program, which is written first, from a guess; return the variables at the end, and how it ended."""
    reached = guess

    def keep(values: Expression) -> None:
        nonlocal reached
        reached = values

    def run(ends: Callable[[], bool]) -> str:
        functions, bounds = write()
        stopper = _stopper({name: part.numel() for name, part in functions.items()}, keep, ends)
        settings = {"ipopt": {**IPOPT, **options}, **CASADI, "iteration_callback": stopper}
        solver = casadi.nlpsol("team", "ipopt", functions, settings)
        keep(solver(x0=guess, **bounds)["x"])
        return str(solver.stats()["return_status"])

    ended = run_or_abandon(run, should_stop)
    return np.asarray(reached).ravel(), ABANDONED if ended is None else ended


def run_or_abandon(work: Callable[[Callable[[], bool]], Result], should_stop: Callable[[], bool]) -> Result | None:
    """Run work that releases the interpreter's lock in a thread, and abandon it if it does not end in time.

    Ctrl-C reaches the caller at once. What was abandoned ends when it next asks; the process waits for that.

    Returns:
        What the work returned, or ``None`` if it was abandoned.
    """
    ending = Event()
    pool = ThreadPoolExecutor(1)
    try:
        future = pool.submit(work, ending.is_set)
        while not should_stop():
            if wait([future], LOOK).done:
                return future.result()
        ending.set()
        return future.result() if wait([future], GRACE).done else None
    finally:
        ending.set()
        pool.shutdown(wait=False)


def _stopper(sizes: dict[str, int], keep: Callable[[Expression], None], ends: Callable[[], bool]) -> Expression:
    """Return a callback for IPOPT, after every iteration of a program of these sizes, to end it at ``ends()``."""

    class Stopper(casadi.Callback):
        def __init__(self) -> None:
            casadi.Callback.__init__(self)
            self.construct("stopper", {})

        def get_n_in(self) -> int:
            return casadi.nlpsol_n_out()

        def get_sparsity_in(self, index: int) -> Expression:
            size = sizes.get(casadi.nlpsol_out(index).removeprefix("lam_"), 0)
            return casadi.Sparsity.dense(size, min(size, 1))

        def eval(self, arguments: Expression) -> list[int]:
            keep(arguments[0])
            return [int(ends())]

    return Stopper()
