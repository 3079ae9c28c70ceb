"""Settings of D4orm-D."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Annotated

from d4orm_planners.base.settings import CheckedSettings, Count, NotNegative, Positive, Samples, Steps, one_of
from d4orm_planners.sampling.d4orm import DeformationConfig

Decoupling = Annotated[str, one_of(("independent", "groups", "joint"))]
Start = Annotated[str, one_of(("auto", "team", "straight"))]


@dataclass(frozen=True, kw_only=True)
class JointRunSettings(CheckedSettings):
    """Settings of ``decoupling="joint"``. The preset ``"authors"`` has what the paper's authors published as code.

    Attributes:
        penalty_rise: What is added to a robot's ``penalty`` after every run that leaves it in contact; 0.5 in their
            code. One without contact falls back.
        penalty_limit: Most that it rises to.
        reset_after_probe: Whether all controls go back to zero after the first iteration, if that ignores collisions,
            or after straight drives: only the groups stay.
        clip_after: Repeats of a failure, by itself or in a group of one number, after which a robot's controls are
            clipped to its limits; 6 in their code, ``None`` for never.
    """

    penalty_rise: NotNegative = 0.0
    penalty_limit: Positive = 3.0
    reset_after_probe: bool = False
    clip_after: Count | None = None


@dataclass(frozen=True, kw_only=True)
class D4ormDConfig(JointRunSettings, DeformationConfig):
    """Settings of D4orm-D. The defaults are meant for a first solution soon; the preset ``"paper"`` is Algorithm 3.

    Attributes:
        num_samples: ``M`` of an iteration over the whole team or a group.
        num_steps: ``N`` of such an iteration.
        big_team: Teams of more robots than this are sampled half as often in iterations over all of them, whose time
            grows with the team while repairs make up for their errors; ``None`` for no such team.
        decoupling: ``"groups"`` replans every group of robots that conflict, the team's reward within it (the paper;
            groups are the components of the conflicts and of those of the last iteration that are likely to come back).
            ``"independent"`` replans robots that have no conflict with each other at once, each by its own reward,
            around all others, and takes over only what is no worse. ``"joint"`` replans all robots that fail in one
            run, each by the reward of its group; a first iteration without collisions is by each robot's own.
        start: First iteration without initial controls. ``"team"`` deforms the whole team at once;
            ``"straight"`` sends all robots straight to their goals and leaves the rest to repairs; ``"auto"`` does the
            second in big teams where robots so meet less than half of the others on average.
        first_collisions: Whether an iteration that starts from zero controls penalises collisions.
        repair_samples: ``M`` of an independent repair. A few may be better than many: their error is a search of
            its own.
        repair_steps: ``N`` of an independent repair.
        credit: Of iterations over the whole team.
        penalty: Factor of the problem's collision penalty in these.
        repair_penalty: The same in an independent repair. At 1 it can be cheaper to brush past a robot than to wait.
    """

    big_team: Count | None = 32
    decoupling: Decoupling = "independent"
    start: Start = "auto"
    first_collisions: bool = True
    repair_samples: Samples = 128
    repair_steps: Steps = 50
    repair_penalty: Positive = 3.0

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
