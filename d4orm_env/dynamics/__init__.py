"""Robot models, and what a model of one's own is made of: see ``docs/how_to/own_robot.md``."""

from d4orm_env.dynamics.formulas import (
    between,
    clip,
    control_scale,
    first_order_approach,
    norm_scale,
    planar_approach,
    share,
    stopping_speed,
    turn_towards,
)
from d4orm_env.dynamics.robot_model import (
    ACCELERATION,
    OWN_LIMITS,
    SPEED,
    TURN_RATE,
    UNLIMITED,
    Limit,
    Model,
    ModelFunctions,
    Ops,
)

__all__ = [
    "ACCELERATION", "OWN_LIMITS", "SPEED", "TURN_RATE", "UNLIMITED", "Limit", "Model", "ModelFunctions", "Ops",
    "between", "clip", "control_scale", "first_order_approach", "norm_scale", "planar_approach", "share",
    "stopping_speed", "turn_towards",
]  # fmt: skip
