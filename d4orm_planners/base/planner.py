"""The planner protocol, ``init`` and ``iterate``, and the loop that every planner runs in: budget, callback, Ctrl-C."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, TypeAlias

from numpy.typing import ArrayLike

from d4orm_env.core.arrays import FloatArray, duration, short_repr, whole_number
from d4orm_env.core.infeasibility import prepare_proofs, prove_infeasible
from d4orm_env.core.problem import Problem
from d4orm_env.core.problem_checks import check_is_problem
from d4orm_planners.base.candidate import Candidate
from d4orm_planners.base.plan import IterationRecord, Plan, Status
from d4orm_planners.base.settings import CheckedSettings, Count, EngineName
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.engine.sampling_types import StepWatcher

Callback = Callable[[IterationRecord], object]
State: TypeAlias = Any  #: A planner's state from one iteration to the next: a type of its own


@dataclass(frozen=True, kw_only=True)
class PlannerConfig(CheckedSettings):
    """Settings that every planner takes."""

    engine: EngineName = "auto"  #: ``"auto"``, ``"cpu"`` or ``"jax"``
    max_iterations: Count = 50  #: Iterations after which :meth:`Planner.solve` gives up, unless the call says otherwise
    #: Go on improving after the first solution, until the time or iteration budget is used up. By default the first
    #: solution ends the search.
    improve: bool = False


@dataclass(frozen=True)
class Iteration:
    """Result of a planner's iteration."""

    controls: FloatArray  #: ``(H, K, m)`` the new candidate
    denoising_steps: int = 0  #: Sample-score-update steps spent
    excluded: int = 0  #: Samples left out because their reward was not finite
    note: str = ""  #: Remark of the method on how the iteration ended, where it has a word for it
    #: Result of :func:`~d4orm_planners.base.candidate.evaluate_controls` for these controls, if the iteration asked;
    #: else the loop does
    evaluated: Candidate | None = None
    unreachable: tuple[int, ...] = ()  #: Robots for which path finding found no path to their goals


class Planner(ABC):
    """A method that turns a problem into a plan. Instances hold settings only.

    What a planner keeps from one iteration to the next is its *state*, of whatever type it likes: :meth:`init` makes
    the first one and every :meth:`iterate` the next. A planner that keeps nothing has ``None``, and no ``init``.
    """

    name: ClassVar[str]  #: Planner's name in its plans; that of the class unless it gives another
    config_class: ClassVar[type[PlannerConfig]] = PlannerConfig
    drives_straight: ClassVar[bool] = False  #: It begins with straight drives: the command line compiles these ahead
    #: By name, settings for :func:`~d4orm_planners.make_planner`, which leaves out those that do not apply
    presets: ClassVar[Mapping[str, Mapping[str, object]]] = {}
    preset: str | None = None  #: Preset that it was made with, if any

    def __init_subclass__(cls) -> None:
        cls.name = cls.__dict__.get("name", cls.__name__)

    def __init__(self, config: PlannerConfig) -> None:
        self.config = config  #: The settings

    def init(self, search: SolveRun) -> State:
        """The state that the first iteration begins with."""
        del search

    @abstractmethod
    def iterate(self, search: SolveRun, state: State) -> tuple[State, Iteration]:
        """One iteration from the search's current candidate: the new state, and the next candidate."""

    def finish(self, search: SolveRun, state: State) -> None:  # noqa: B027 - a hook that most planners need not fill
        """Release the resources of the state; called once after :meth:`init`, however the solve ends."""

    def within(self, communication_range: float) -> Planner:
        """This planner where robots know of others within this range [m] only; itself if it is a central one."""
        del communication_range
        return self

    def solve(
        self,
        problem: Problem,
        seed: int = 0,
        time_limit: float | None = None,
        max_iterations: int | None = None,
        callback: Callback | None = None,
        initial_controls: ArrayLike | None = None,
        watcher: StepWatcher | None = None,
    ) -> Plan:
        """Plan until a solution is found (or on, with ``improve``), the budget is used up, or Ctrl-C is pressed.

        A problem that :func:`~d4orm_env.core.infeasibility.prove_infeasible` proves to have no solution ends at
        once.

        Args:
            problem: Problem to solve.
            seed: Non-negative seed; the same seed gives the same plan.
            time_limit: Seconds, compilation not counted; looked at before every iteration, and within one between its
                denoising steps, repairs or IPOPT's iterations. An iteration that it cuts short ends with what it has
                by then, a candidate like any other. A limit that is not reached changes nothing.
            max_iterations: Iterations; the configured number by default.
            callback: Called with an :class:`IterationRecord` after every iteration, with the candidate that came of it;
                returning ``True`` stops.
            initial_controls: ``(H, K, m)`` to start from, zeros by default.
            watcher: Called with a :class:`~d4orm_planners.engine.sampling_types.DenoisingStep` after every denoising
                step, by the CPU engine only. It changes nothing, and its time is not counted.

        Returns:
            The best plan found: a solved one with the most reward, else the one with the fewest robots failing.

        Raises:
            ValueError: If an argument makes no sense, or there is a watcher and another engine; the message names it.
        """
        check_is_problem(problem)
        for name, function, told in (
            ("callback", callback, "an IterationRecord"),
            ("watcher", watcher, "a DenoisingStep"),
        ):
            if function is not None and not callable(function):
                raise ValueError(f"{name} is {short_repr(function)}; give a function of {told}")
        limit = None if time_limit is None else duration(time_limit, "time_limit")
        most = (
            self.config.max_iterations if max_iterations is None else whole_number(max_iterations, "max_iterations", 1)
        )
        search = SolveRun(self, problem, seed, initial_controls)
        search.time_limit = limit
        search.watcher = watcher
        try:
            with search.watch.paused():
                prepare_proofs(problem)
            proved = not search.best.solved and prove_infeasible(problem)
            status = "infeasible" if proved else _run(search, most, callback)
        except KeyboardInterrupt:
            status = "interrupted"
        finally:
            search.close()
        return search.plan(status)


def _run(search: SolveRun, most: int, callback: Callback | None) -> Status:
    """Iterate until something ends the search; returns the reason."""
    while not search.is_over:
        if search.iteration >= most:
            return "iteration_limit"
        if search.time_left == 0:
            return "time_limit"
        record = search.advance()
        if callback is not None:
            with search.watch.paused():
                stop = callback(record)
            if stop is True:
                return "stopped"
    return "solved"
