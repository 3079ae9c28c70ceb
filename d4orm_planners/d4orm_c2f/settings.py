"""Settings of D4orm-C2F."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from d4orm_planners.base.settings import Count, EngineName, NotNegative, Positive, Samples, Steps, Whole, one_of
from d4orm_planners.sampling.settings import PAPER, DiffusionSettings, SoftmaxSettings

PAPER_CONTROL = {
    "coarse_samples": PAPER["num_samples"],
    "coarse_steps": PAPER["num_steps"],
    "coarse_preset": "paper",
    "num_samples": PAPER["num_samples"],
    "num_steps": PAPER["num_steps"],
    "weight_cutoff": PAPER["weight_cutoff"],
    "max_lag": None,
    "line_of_sight": False,
    "mean_of_all": True,
    "credit": "team",
    "penalty": 1.0,
    "normalise_distance": True,
    "safe_mix": False,
    "direct_final_approach": False,
    "reaction_time": 0.0,
    "delay": 0,
    "filter_states": False,
    "learn_limits": False,
    "expect_losses": False,
    "stalls": False,
    "last_resort": False,
    "replan": False,
}
"""Algorithm 4 (paper, section VI), with the samples and steps of the paper's experiments (section IV-B)."""


@dataclass(frozen=True, kw_only=True)
class D4ormC2FConfig(SoftmaxSettings, DiffusionSettings):
    """Settings of D4orm-C2F; those of the softmax and of the diffusion schedule are a control loop's."""

    engine: EngineName = "auto"  #: ``"auto"``, ``"cpu"`` or ``"jax"``
    coarse_factor: Steps = 2  #: ``f``, fine time steps per coarse one
    check_interval: Steps = 1  #: ``o``: coarse steps from one check of the coarse plan's margin to the next
    coarse_samples: Samples = 256  #: ``M`` of the coarse plan
    coarse_steps: Steps = 50  #: ``N`` of the coarse plan
    coarse_repair_steps: Steps = 20  #: The same of repairs of the coarse plan
    #: Preset of D4orm-D that plans coarsely: ``"paper"`` or, by default, ``None``.
    coarse_preset: Annotated[str, one_of(("paper",))] | None = None
    #: Name of a policy whose episode, in coarse steps, the first coarse plan begins with; ``None`` begins as D4orm-D
    #: does
    warm_start: str | None = None
    coarse_iterations: Count = 20  #: Iterations after which the coarse plan is taken as it is
    replan_iterations: Count = 2  #: The same when only some robots have new goals
    predict_horizon: Steps = 20  #: ``H_predict``, steps that a control loop looks ahead
    execute_horizon: Steps = 1  #: ``H_execute``, steps executed before the next control loop
    subgoal_offset: Steps = 15  #: ``m``, waypoints from where the team is to its subgoal
    #: Waypoints that a robot may be behind the others without its subgoal staying behind too. ``None`` for any number:
    #: the subgoals of all are always those of one moment, as in the paper.
    max_lag: Annotated[Whole, Field(ge=0)] | None = 5
    #: Whether the team is where all robots are on average, as in the paper, not those under way: robots that have
    #: arrived then hold the subgoals of others back
    mean_of_all: bool = False
    line_of_sight: bool = True  #: A subgoal behind robots at rest is replaced by the furthest visible one before it
    num_samples: Samples = 128  #: ``M`` of a control loop
    num_steps: Steps = 20  #: ``N`` of a control loop
    #: ``"robot"`` or ``"team"``: whose reward weights the samples of a control loop
    credit: Annotated[str, one_of(("robot", "team"))] = "robot"
    penalty: Positive = 10.0  #: Factor of the problem's collision penalty in a control loop, 1 in the paper
    #: Whether distances to subgoals count relative to the initial one, as in the paper, not to how far robots get in
    #: ``m`` steps: then a robot next to its subgoal has no more to lose than others
    normalise_distance: bool = False
    safe_mix: bool = True  #: Whether robots follow a fine plan only as far as it keeps the margin
    direct_final_approach: bool = True  #: Whether robots that dock no later if they drive straight to their goals do so
    extra_margin: NotNegative = 0.0  #: Added to the problem's margin in control loops, as room for disturbances [m]
    #: Time over which the largest recent deviation of robots from the model is added to the margin in control loops;
    #: nothing while they do as they are told [s]
    reaction_time: NotNegative = 0.4
    #: Steps late that commands are executed: control loops begin where those under way lead. ``None`` finds out from
    #: what the robots report to have executed.
    delay: Annotated[Whole, Field(ge=0, le=100)] | None = None
    filter_states: bool = True  #: Whether states that are seen to be noisy are filtered
    #: Whether robots that never do as much as they are asked to are taken to be that much weaker, and commands make up
    #: for what is added to them for some time
    learn_limits: bool = True
    #: Whether a robot that goes on with its last command is taken to have lost the new one: it is not weak, and others
    #: may do so too, as often in a row as must be reckoned with
    expect_losses: bool = True
    #: Whether a robot that brakes or stays at rest whatever it is told is taken for an obstacle, which the others drive
    #: around
    stalls: bool = True
    last_resort: bool = True  #: Whether robots whose plan would end in contact are told to brake or to evade instead
    #: Whether the guidance is refined while it is followed: in a ``"background"`` thread, ``"sync"`` between control
    #: loops, which gives the same controls every time, or ``"off"``. ``None`` is ``"background"`` with a ``deadline``
    #: and ``"sync"`` without.
    refine: Annotated[str, one_of(("background", "sync", "off"))] | None = None
    refine_every: Count = 5  #: Least number of control loops between refinements, which take time from the loops
    #: Whether the guidance is planned anew for robots that are stuck or astray, and for a team that has lost it or has
    #: come to its end; for robots with new goals it always is
    replan: bool = True
    #: The guidance is planned anew for robots this far from it, and for all if they are so on average, in steps of the
    #: fastest at full speed
    replan_distance: Positive = 10.0
    patience: Count = 15  #: Steps without progress towards the goals after which the guidance is planned anew too
    #: Seconds that a control loop may take. Loops that would take longer make a half or a quarter of ``num_steps``; one
    #: that does all the same is left behind, and the last plan goes on. What is planned anew is beside the loops, on
    #: one core. ``None`` waits for every loop, and for plans.
    deadline: Positive | None = None
    control_noise_std: NotNegative = 0.0  #: Gaussian noise that the controller adds to its controls, in their units

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.execute_horizon > self.predict_horizon:
            raise ValueError(
                f"execute_horizon is {self.execute_horizon}, more than the {self.predict_horizon} steps predicted; "
                "raise predict_horizon"
            )
