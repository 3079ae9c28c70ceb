"""Disturbances of an execution: of the controls on their way, of what is seen, and of the world.

``parallel_env(..., disturbances=[Delay(2), Push(0.1, 0.3)])``, and the same in the joint and the batched environment.
Disturbances act in the order given. Everything random in them follows from the environment's seed: the same in all
environments to the bit, and one disturbance draws the same whatever others there are. Your own is a subclass of
:class:`Disturbance`.
"""

from d4orm_env.disturbances.controls import Bias, ControlNoise, CorrelatedNoise, Delay, Dropout, Gain, Lag, Quantisation
from d4orm_env.disturbances.disturbance import Disturbance, DisturbanceEffect, Observed, Scene
from d4orm_env.disturbances.draws import Draws
from d4orm_env.disturbances.moving_obstacle import Intruder, MovingObstacle, load_pedestrians
from d4orm_env.disturbances.perception import Occlusion, RayNoise, StateDelay, StateNoise
from d4orm_env.disturbances.robot_faults import Drag, LimitMismatch, Push, Stall

__all__ = [
    "Bias", "ControlNoise", "CorrelatedNoise", "Delay", "Disturbance", "DisturbanceEffect", "Drag", "Draws", "Dropout",
    "Gain", "Intruder", "Lag", "LimitMismatch", "MovingObstacle", "Observed", "Occlusion", "Push", "Quantisation",
    "RayNoise", "Scene", "Stall", "StateDelay", "StateNoise", "load_pedestrians",
]  # fmt: skip
