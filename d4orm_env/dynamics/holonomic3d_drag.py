"""A double integrator in space that the air brakes: its acceleration is ``u - drag v``.

State and control are those of :data:`~d4orm_env.dynamics.holonomic3d.HOLONOMIC3D`.
"""

from __future__ import annotations

from dataclasses import replace

from d4orm_env.dynamics.holonomic3d import HOLONOMIC3D
from d4orm_env.dynamics.robot_model import OWN_LIMITS, Limit, Ops, TimeStep, Vector

DRAG = OWN_LIMITS


def _derivative(x: Vector, u: Vector, limits: Vector, ops: Ops) -> Vector:
    drag = limits[DRAG]
    return (x[3], x[4], x[5], u[0] - drag * x[3], u[1] - drag * x[4], u[2] - drag * x[5])


def _track(x: Vector, velocity: Vector, limits: Vector, h: TimeStep, ops: Ops) -> Vector:
    drag = limits[DRAG]
    return (
        (velocity[0] - x[3]) / h.full + drag * x[3],
        (velocity[1] - x[4]) / h.full + drag * x[4],
        (velocity[2] - x[5]) / h.full + drag * x[5],
    )


HOLONOMIC3D_DRAG = replace(
    HOLONOMIC3D,
    name="holonomic3d_drag",
    functions=HOLONOMIC3D.functions._replace(derivative=_derivative, track=_track, integrate=None),
    own_limits=(Limit("drag", 0.5),),
)
"""Its ``drag`` is in 1/s."""
