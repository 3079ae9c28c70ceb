"""Numerical optimisation with IPOPT, through CasADi: the rival of the paper's section IV-B.

A. Waechter and L. T. Biegler, "On the Implementation of an Interior-Point Filter Line-Search Algorithm for Large-Scale
Nonlinear Programming", Mathematical Programming, 2006.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from threading import Event
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field

from d4orm_env.core.arrays import IntArray
from d4orm_env.core.lazy import load
from d4orm_env.core.seeds import Stream
from d4orm_planners.base.candidate import Candidate, evaluate_controls
from d4orm_planners.base.planner import Iteration, Planner, PlannerConfig
from d4orm_planners.base.settings import Count, NotNegative, Positive
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.baselines.collocation import CollocatedMotion, Contacts, Expression, TeamProgram, casadi
from d4orm_planners.tracking.steering import prepare_drives, straight_drives

Options = Mapping[str, object]
FOUND = ("Solve_Succeeded", "Solved_To_Acceptable_Level")  #: IPOPT's words for a solution of the program
OUT_OF_TIME = "No_Time_After_Warm_Start"  #: Our own word for an iteration that ends with the warm start
NEARLY_SOLVED = 1e-2  #: IPOPT's first barrier parameter in a round that begins where the last one ended
FEASIBILITY = 1e-5  #: Largest violation that IPOPT may leave, in the program's units; the clearance makes up for it
IPOPT = {"print_level": 0, "sb": "yes", "constr_viol_tol": FEASIBILITY}
CASADI = {"print_time": False, "show_eval_warnings": False}  #: Options of every solve
ABANDONED = "Abandoned_At_Time_Limit"  #: Status of a run that was left before IPOPT could end it
LOOK = 0.01  #: Period of asking the caller whether to stop [s]
GRACE = 0.05  #: Time that work which was asked to end is waited for [s]


@dataclass(frozen=True, kw_only=True)
class IpoptConfig(PlannerConfig):
    """Settings of :class:`Ipopt`."""

    max_iterations: Count = 20  #: Perturbed restarts after which :meth:`Planner.solve` gives up
    #: Standard deviation of the noise on the warm start's states and controls, in SI units for robots of the default
    #: size, and as many times more for larger ones
    perturbation: NotNegative = 0.1
    #: Robots are kept clear of what came nearer than this in the last solution, the margin not counted, in steps of the
    #: fastest robot at full speed; ``None`` keeps them clear of everything at every step, as in the paper
    lookout: NotNegative | None = 5.0
    #: Solves per restart. As long as the rollout does not keep the margin, the next one begins where the last one
    #: ended; what came near is avoided too, and robots stay where they arrived. The paper solves once.
    rounds: Count = 8
    clearance: NotNegative = 0.02  #: Added to every distance to keep, for rounding and tolerances, in the same steps
    tolerance: Positive = 1e-3  #: IPOPT's, on the scaled optimality error
    barrier: Positive = 1.0  #: IPOPT's first barrier parameter
    #: IPOPT's own iterations in each solve
    solver_iterations: Annotated[Count, Field(le=2**31 - 1)] = 1000  # IPOPT's own counter


@dataclass(frozen=True, eq=False)
class WarmStart:
    """The state of a solve, which stays as it is."""

    program: TeamProgram
    motion: CollocatedMotion


class Ipopt(Planner):
    """Direct collocation of the whole team, solved by IPOPT: without collisions first, then, perturbed, with them.

    Maximises the other planners' reward (paper, section III-D) under Eq. 1. Every iteration is another perturbation of
    the same warm start, or of the initial controls where there are any. ImportError without CasADi.
    """

    name: ClassVar[str] = "ipopt"
    config_class = IpoptConfig
    drives_straight: ClassVar[bool] = True
    presets: ClassVar = {"paper": {"lookout": None, "rounds": 1}}
    config: IpoptConfig

    def __init__(self, config: IpoptConfig) -> None:
        super().__init__(config)
        load(casadi)

    def init(self, search: SolveRun) -> WarmStart:
        program = TeamProgram(search.problem, self.config.clearance * search.problem.stride)
        return WarmStart(program, self._warm_start(search, program))

    def iterate(self, search: SolveRun, state: WarmStart) -> tuple[WarmStart, Iteration]:
        if search.should_stop():
            return state, Iteration(state.motion.controls.astype(np.float32), note=OUT_OF_TIME)
        return state, self._restart(search, state)

    def _restart(self, search: SolveRun, state: WarmStart) -> Iteration:
        config, problem, program = self.config, search.problem, state.program
        motion = self._perturbed(search, program, state.motion)
        lookout = None if config.lookout is None else config.lookout * problem.stride
        contacts = program.contacts(motion, lookout)
        arrivals = np.full(problem.num_robots, problem.horizon)
        best, note, options = None, "", self._options()
        for _ in range(config.rounds):
            if best is not None and search.should_stop():
                break
            motion, note = solve_program(program, motion, contacts, arrivals, options, search.should_stop)
            candidate = evaluate_controls(search.engine, problem, motion.controls.astype(np.float32))
            if best is None or candidate.rank > best.rank:
                best = candidate
            # More constraints do not mend what is infeasible as it is; another start may.
            if best.solved or note not in FOUND:
                break
            former, contacts = contacts, _union(contacts, program.contacts(motion, lookout))
            before, arrivals = arrivals, _arrivals(candidate)
            if _size(contacts) == _size(former) and (arrivals == before).all():
                break
            options["mu_init"] = min(NEARLY_SOLVED, config.barrier)
        assert best is not None
        return Iteration(best.controls, note=note)

    def _options(self) -> dict[str, object]:
        config = self.config
        return {"tol": config.tolerance, "max_iter": config.solver_iterations, "mu_init": config.barrier}

    def _warm_start(self, search: SolveRun, program: TeamProgram) -> CollocatedMotion:
        """The controls that the search was given, or else the solution of the program without collisions."""
        if search.current.controls.any():
            return _motion(search.current)
        problem = search.problem
        with search.watch.paused():
            prepare_drives(problem)
        straight = evaluate_controls(search.engine, problem, straight_drives(problem).controls[:, :, 0])
        arrivals = np.full(problem.num_robots, problem.horizon)
        return solve_program(program, _motion(straight), {}, arrivals, self._options(), search.should_stop)[0]

    def _perturbed(self, search: SolveRun, program: TeamProgram, warm_start: CollocatedMotion) -> CollocatedMotion:
        random = np.random.default_rng(search.iteration_seed(Stream.PERTURBATION))
        parts = []
        for part, units in zip(warm_start, program.units, strict=True):
            noise = self.config.perturbation * random.standard_normal(part.shape)
            for robot, unit in enumerate(units):
                noise[:, robot, : unit.size] *= unit
            parts.append(part + noise)
        return CollocatedMotion(*parts)


def _motion(candidate: Candidate) -> CollocatedMotion:
    return CollocatedMotion(candidate.trajectory.states.astype(float), candidate.controls.astype(float))


def _arrivals(candidate: Candidate) -> np.ndarray:
    """``(K,)`` steps at which the robots arrived; the horizon for those that did not."""
    arrived = candidate.trajectory.arrived
    return np.where(arrived[-1], arrived.argmax(axis=0), len(arrived) - 1)


def _union(contacts: Contacts, more: Contacts) -> Contacts:
    return {key: np.union1d(contacts.get(key, []), more.get(key, [])).astype(int) for key in contacts.keys() | more}


def _size(contacts: Contacts) -> int:
    return sum(map(len, contacts.values()))


def solve_program(
    program: TeamProgram,
    guess: CollocatedMotion,
    contacts: Contacts,
    arrivals: IntArray,
    options: Options,
    should_stop: Callable[[], bool],
) -> tuple[CollocatedMotion, str]:
    """The motion that IPOPT comes to from a guess, feasible or not, and its word for how it ended.

    Robots are at their goals by steps ``arrivals`` ``(K,)``, from which on they stay there. ``should_stop`` is asked
    every hundredth of a second; it ends within a tenth, even where writing the program or one of IPOPT's iterations
    takes longer.
    """
    start = reached = program.packed(guess)

    def keep(values: Expression) -> None:
        nonlocal reached
        reached = values

    def run(ends: Callable[[], bool]) -> str:
        functions, bounds = program.write(contacts, arrivals)
        stopper = _stopper({name: part.numel() for name, part in functions.items()}, keep, ends)
        settings = {"ipopt": {**IPOPT, **options}, **CASADI, "iteration_callback": stopper}
        solver = casadi.nlpsol("team", "ipopt", functions, settings)
        keep(solver(x0=start, **bounds)["x"])
        return str(solver.stats()["return_status"])

    ended = _run_or_abandon(run, should_stop)
    values = casadi.DM(reached).full().ravel()
    # IPOPT gives up where a function has no value; the guess is then the best there is.
    return program.unpacked(values) if np.isfinite(values).all() else guess, ended


def _run_or_abandon(work: Callable[[Callable[[], bool]], str], should_stop: Callable[[], bool]) -> str:
    """Run work that releases the interpreter's lock in a thread; :data:`ABANDONED` if it does not end in time.

    Ctrl-C reaches the caller at once. What was abandoned ends when it next asks; the process waits for that.
    """
    ending = Event()
    pool = ThreadPoolExecutor(1)
    try:
        future = pool.submit(work, ending.is_set)
        while not should_stop():
            if wait([future], LOOK).done:
                return future.result()
        ending.set()
        return future.result() if wait([future], GRACE).done else ABANDONED
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
