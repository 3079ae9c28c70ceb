"""Settings of D4orm-C2F."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from d4orm_planners.sampling.settings import DiffusionSettings, SoftmaxSettings
from d4orm_planners.settings import Count, EngineName, NotNegative, Positive, Samples, Steps, Whole, one_of

Credit = Annotated[str, one_of(("robot", "team"))]
Refinement = Annotated[str, one_of(("background", "sync", "off"))]


@dataclass(frozen=True, kw_only=True)
class D4ormC2FConfig(SoftmaxSettings, DiffusionSettings):
    """Settings of D4orm-C2F; those of the softmax and of the diffusion schedule are a control loop's.

    Attributes:
        engine: ``"auto"``, ``"cpu"`` or ``"jax"``.
        coarse_factor: ``f``, fine time steps per coarse one.
        check_interval: ``o``: the coarse plan must keep the margin at every so-manyth coarse step.
        coarse_samples: ``M`` of the coarse plan.
        coarse_steps: ``N`` of the coarse plan.
        coarse_repair_steps: The same of repairs of the coarse plan.
        coarse_iterations: Iterations after which the coarse plan is taken as it is.
        replan_iterations: The same when only some robots have new goals.
        predict_horizon: ``H_predict``, steps that a control loop looks ahead.
        execute_horizon: ``H_execute``, steps executed before the next control loop.
        subgoal_offset: ``m``, waypoints from where the team is to its subgoal.
        num_samples: ``M`` of a control loop.
        num_steps: ``N`` of a control loop.
        credit: ``"robot"`` or ``"team"``: whose reward weights the samples of a control loop.
        penalty: What a violation costs per step in a control loop, against the paper's one.
        extra_margin: Added to the problem's margin in control loops, as room for disturbances [m].
        reaction_time: The margin in control loops grows by how far robots come within so many seconds from where they
            were expected, by the largest deviation of late: nothing while they do as they are told [s].
        delay: Steps late that commands are executed: control loops begin where those under way lead.
        refine: Whether the guidance is refined while it is followed: in a ``"background"`` thread, ``"sync"`` between
            control loops, which gives the same controls every time, or ``"off"``.
        refine_every: At most every so-manyth control loop a refinement begins: it takes time from control loops.
        replan_distance: The guidance is planned anew when the robots are this far from it on average [m].
        patience: Or when they have come no nearer to their goals for so many steps.
        deadline: Seconds that a control loop may take; one that takes longer is left behind, and the last plan goes on.
            ``None`` waits for every loop.
        control_noise_std: Gaussian noise that the controller adds to its controls, in their units.

    Raises:
        ValueError: If a value makes no sense; the message names it.
    """

    engine: EngineName = "auto"
    coarse_factor: Steps = 2
    check_interval: Steps = 1
    coarse_samples: Samples = 256
    coarse_steps: Steps = 50
    coarse_repair_steps: Steps = 20
    coarse_iterations: Count = 20
    replan_iterations: Count = 2
    predict_horizon: Steps = 20
    execute_horizon: Steps = 1
    subgoal_offset: Steps = 15
    num_samples: Samples = 128
    num_steps: Steps = 20
    credit: Credit = "robot"
    penalty: Positive = 10.0
    extra_margin: NotNegative = 0.0
    reaction_time: NotNegative = 0.4
    delay: Annotated[Whole, Field(ge=0, le=100)] = 0
    refine: Refinement = "background"
    refine_every: Count = 5
    replan_distance: Positive = 1.0
    patience: Count = 15
    deadline: Positive | None = None
    control_noise_std: NotNegative = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.execute_horizon > self.predict_horizon:
            raise ValueError(
                f"execute_horizon is {self.execute_horizon}, more than the {self.predict_horizon} steps predicted; "
                "raise predict_horizon"
            )
