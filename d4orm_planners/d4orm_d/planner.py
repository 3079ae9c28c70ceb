"""D4orm-D: failure-aware decoupling for big teams (paper, section V, Algorithm 3).

Robots that fail are replanned as the paper or its authors' code does, or by default repaired independently
(:mod:`~d4orm_planners.d4orm_d.decoupling`).
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Annotated, ClassVar

from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.problem import Problem
from d4orm_planners.base.candidate import team_conflicts
from d4orm_planners.base.planner import Iteration
from d4orm_planners.base.settings import CheckedSettings, Count, NotNegative, Positive, Samples, Steps, one_of
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.d4orm_d.decoupling import DeformedPlan, GroupRuns, JointRun, Repairs
from d4orm_planners.engine.sampling_types import SamplingTask
from d4orm_planners.sampling.d4orm import AUTHORS_DEFORMATION, PAPER_DEFORMATION, DeformationConfig, DeformingPlanner
from d4orm_planners.sampling.settings import Credit
from d4orm_planners.tracking.steering import prepare_drives, straight_drives

Decoupling = Annotated[str, one_of(("independent", "groups", "joint"))]
Start = Annotated[str, one_of(("auto", "team", "straight"))]


@dataclass(frozen=True, kw_only=True)
class JointRunSettings(CheckedSettings):
    """Settings of ``decoupling="joint"``. The preset ``"authors"`` has what the paper's authors published as code."""

    #: What is added to a robot's ``penalty`` after every run that leaves it in contact; 0.5 in their code. One without
    #: contact falls back.
    penalty_rise: NotNegative = 0.0
    penalty_limit: Positive = 3.0  #: Most that it rises to
    #: Whether all controls go back to zero after the first iteration, if that ignores collisions, or after straight
    #: drives: only the groups stay
    reset_after_probe: bool = False
    #: Repeats of a failure, by itself or in a group of one number, after which a robot's controls are clipped to its
    #: limits; 6 in their code, ``None`` for never
    clip_after: Count | None = None


@dataclass(frozen=True, kw_only=True)
class D4ormDConfig(JointRunSettings, DeformationConfig):
    """Settings of D4orm-D. The defaults are meant for a first solution soon; the preset ``"paper"`` is Algorithm 3."""

    num_samples: Samples = 256  #: ``M`` of an iteration over the whole team or a group
    num_steps: Steps = 100  #: ``N`` of such an iteration
    credit: Credit = "group"  #: Of iterations over the whole team
    penalty: Positive = 2.0  #: Factor of the problem's collision penalty in these
    #: Teams of more robots than this are sampled half as often in iterations over all of them, whose time grows with
    #: the team while repairs make up for their errors; ``None`` for no such team
    big_team: Count | None = 32
    #: ``"groups"`` replans every group of robots that conflict, the team's reward within it (the paper; groups are the
    #: components of the conflicts and of those of the last iteration that are likely to come back). ``"independent"``
    #: replans robots that have no conflict with each other at once, each by its own reward, around all others, and
    #: takes over only what is no worse. ``"joint"`` replans all robots that fail in one run, each by the reward of its
    #: group; a first iteration without collisions is by each robot's own.
    decoupling: Decoupling = "independent"
    #: First iteration without initial controls. ``"team"`` deforms the whole team at once; ``"straight"`` sends all
    #: robots straight to their goals and leaves the rest to repairs; ``"auto"`` does the second in big teams where
    #: robots so meet less than half of the others on average.
    start: Start = "auto"
    first_collisions: bool = True  #: Whether an iteration that starts from zero controls penalises collisions
    repair_samples: Samples = 128  #: ``M`` of an independent repair. Few may be better: their error is a search
    repair_steps: Steps = 50  #: ``N`` of an independent repair
    repair_penalty: Positive = 3.0  #: The same in an independent repair. At 1 brushing past can be cheaper than waiting

    def __post_init__(self) -> None:
        super().__post_init__()
        for field in fields(JointRunSettings):
            value = getattr(self, field.name)
            if self.decoupling != "joint" and value != field.default:
                raise ValueError(f"{field.name} is {value}; it goes with decoupling 'joint', not {self.decoupling!r}")
        if self.penalty_rise and self.penalty_limit < self.penalty:
            raise ValueError(f"penalty_limit {self.penalty_limit:g} is below penalty {self.penalty:g}; raise it")
        if self.clip_after is not None and self.clip_between_iterations:
            raise ValueError(
                f"clip_after is {self.clip_after}, but every iteration is clipped; set clip_between_iterations=False"
            )
        if self.reset_after_probe and self.first_collisions and self.start != "straight":
            raise ValueError(
                "reset_after_probe is True, but the first iteration is no probe: it penalises collisions; set "
                "first_collisions=False, or start='straight'"
            )


State = GroupRuns | JointRun | Repairs  #: State between iterations, by the kind of decoupling


class D4ormD(DeformingPlanner):
    """Failure-aware decoupling: replan only the robots that fail, around all others, until none fails."""

    name: ClassVar[str] = "d4orm-d"
    config_class = D4ormDConfig
    drives_straight: ClassVar[bool] = True
    presets: ClassVar = {
        "paper": {
            **PAPER_DEFORMATION,
            # The authors' code clips the controls of robots that keep failing; the paper says nothing of it.
            "clip_between_iterations": True,
            "decoupling": "groups",
            "start": "team",
            "first_collisions": False,
            "big_team": None,
        },
        "authors": {
            **AUTHORS_DEFORMATION,
            "decoupling": "joint",
            "start": "team",
            "first_collisions": False,
            "big_team": None,
            "penalty_rise": 0.5,
            "reset_after_probe": True,
            "clip_after": 6,
        },
    }
    config: D4ormDConfig

    def init(self, search: SolveRun) -> State:
        with search.watch.paused():
            prepare_drives(search.problem)
        num_robots, config = search.problem.num_robots, self.config
        if config.decoupling == "joint":
            resets = config.reset_after_probe and not search.current.controls.any()
            return JointRun.of(num_robots, config.penalty, resets)
        return GroupRuns() if config.decoupling == "groups" else Repairs.of(num_robots)

    def iterate(self, search: SolveRun, state: State) -> tuple[State, Iteration]:
        """See :meth:`Planner.iterate`: the whole team at first and once none fails, the failed robots in between."""
        if search.iteration == 0 and not search.current.controls.any():
            drives = self.straight_start(search.problem)
            return self.whole_team(search, state) if drives is None else (state, Iteration(drives))
        if not isinstance(state, Repairs):
            return self.replan(search, state)
        if not search.current.unsolved.any():
            return self.whole_team(search, state)
        team = DeformedPlan(self, search)
        return state.repair(team), team.iteration()

    def replan(self, search: SolveRun, state: GroupRuns | JointRun) -> tuple[State, Iteration]:
        """Replan the groups that fail, in turn or in one run, or once there was a solution the whole team."""
        if search.best.solved or not search.current.unsolved.any():
            return self.whole_team(search, state)
        if isinstance(state, JointRun):
            return state.replan(self, search)
        team = DeformedPlan(self, search)
        state, iteration = state.replan(team), team.iteration()
        return state, replace(iteration, controls=self.braking(search, iteration.controls))

    def whole_team(self, search: SolveRun, state: State) -> tuple[State, Iteration]:
        """Deform all controls at once; unless in groups, then straight to the goals from wherever that is as good."""
        iteration = self.run(search)
        if not isinstance(state, Repairs):
            return state, iteration
        team = DeformedPlan(self, search, search.engine.rollout(search.problem, iteration.controls))
        return state.improve(team), replace(iteration, controls=team.controls)

    def is_big(self, problem: Problem) -> bool:
        return self.config.big_team is not None and problem.num_robots > self.config.big_team

    def num_samples(self, search: SolveRun) -> int:
        return max(self.config.num_samples // 2, 2) if self.is_big(search.problem) else self.config.num_samples

    def task(self, search: SolveRun, base: FloatArray) -> SamplingTask:
        task = super().task(search, base)
        # Only a first plan may ignore collisions, to find out which robots meet; later ones keep robots apart.
        from_zero = search.iteration == 0 and not base.any()
        if self.config.first_collisions or not from_zero:
            return task
        # Robots that do not meet are groups of their own, which joint runs weight by.
        return replace(task, collisions=False, credit="robot" if self.config.decoupling == "joint" else task.credit)

    def straight_start(self, problem: Problem) -> FloatArray | None:
        """Controls ``(H, K, m)`` that send all straight to their goals, or ``None`` to start with the whole team."""
        if self.config.start == "auto":
            return straight_if_sparse(problem) if self.is_big(problem) else None
        return straight_drives(problem).controls[:, :, 0] if self.config.start == "straight" else None


def straight_if_sparse(problem: Problem) -> FloatArray | None:
    """Controls ``(H, K, m)`` straight to the goals; ``None`` where robots would meet half of the others on average."""
    drives = straight_drives(problem)
    graph = team_conflicts(problem, drives.positions[:, :, 0])
    return None if 2 * sum(map(len, graph)) >= problem.num_robots**2 else drives.controls[:, :, 0]
