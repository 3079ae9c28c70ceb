"""Bodies of robots, of some material: pucks, drives, and footprints round them.

A footprint that is no disc is a bumper without mass round a robot that moves as the largest disc within it would.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from d4orm_env.footprints import Core

if TYPE_CHECKING:
    from d4orm_env.mujoco.scene import Physics

WHEEL_RADIUS, HALF_TRACK, WHEEL_HALF_WIDTH, CASTER_RADIUS, CASTER_POSITION = 0.3, 0.65, 0.08, 0.1, 0.75
CLEARANCE, HEIGHT, FRONT_GAP = 0.25, 0.85, 0.02
"""Measures of a robot, over the radius of the largest disc about its reference point within it. The caster is behind;
one in front, off the floor, keeps the nose up."""
WHEEL_SHARE, BATTERY_SHARE, BATTERY_POSITION = 0.1, 0.5, (-0.15, 0.0, 0.2)
"""Shares of the mass: of each wheel, and of what lies low and behind the axle."""
ROLLING, SOLID = 1, 2
"""Kinds of contact: of what rolls on the floor, and of what bodies must not touch."""
_PALETTE = ((0.12, 0.47, 0.71), (1.0, 0.5, 0.05), (0.17, 0.63, 0.17), (0.84, 0.15, 0.16), (0.58, 0.4, 0.74),
            (0.55, 0.34, 0.29), (0.89, 0.47, 0.76), (0.74, 0.74, 0.13))  # fmt: skip
HEADING_DAMPING = 1e6
"""Damping of the turning of pucks that are no discs, per mass and squared radius [1/s]: their model never turns."""


def solid(physics: Physics) -> dict[str, Any]:
    """Attributes of what bodies must not touch."""
    return {"contype": SOLID, "conaffinity": SOLID, "friction": [physics.body_friction, 0.005, 0.0001]}


NOWHERE: dict[str, Any] = {"contype": 0, "conaffinity": 0}
"""Those of what has mass and touches nothing."""


def add_cylinder(
    body: mujoco.MjsBody,
    radius: float,
    low: float,
    high: float,
    physics: Physics,
    position: tuple[float, float] = (0.0, 0.0),
    **attributes: Any,
) -> None:
    """A solid upright cylinder between two heights [m]."""
    size, middle = [radius, (high - low) / 2, 0], [*position, (high + low) / 2]
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=size, pos=middle, **solid(physics) | attributes)


def colour(robot: int) -> list[float]:
    """Return the colour of a robot and its goal: red, green, blue and opacity, from 0 to 1."""
    return [*_PALETTE[robot % len(_PALETTE)], 1.0]


def add_bumper(
    spec: mujoco.MjSpec, body: mujoco.MjsBody, core: Core, low: float, high: float, physics: Physics
) -> None:
    """The outline of a footprint between two heights [m]: a prism, or a box between round ends."""
    corners, rounding = core.corners.tolist(), core.rounding
    attributes = {"mass": 0, **solid(physics)}
    if rounding == 0:
        prism = [[*corner, height] for corner in corners for height in (low, high)]
        name = f"{body.name}_bumper"
        spec.add_mesh(name=name, uservert=np.ravel(prism))
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, **attributes)
        return
    for corner in corners:
        add_cylinder(body, rounding, low, high, physics, position=tuple(corner), mass=0)
    if len(corners) > 1:
        (back, _), (front, _) = corners
        size, middle = [(front - back) / 2, rounding, (high - low) / 2], [(front + back) / 2, 0, (high + low) / 2]
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=size, pos=middle, **attributes)


def add_puck(
    spec: mujoco.MjSpec, robot: int, radius: float, top: float, physics: Physics, *, is_solid: bool
) -> mujoco.MjsBody:
    """A disc that glides over the floor against a drag, and turns when it is touched; not if it has a bumper."""
    body = spec.worldbody.add_body(name=f"robot_{robot}")
    mass = physics.surface_density * radius * radius
    slide, hinge = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
    body.add_joint(type=slide, axis=[1, 0, 0], damping=physics.drag * mass)
    body.add_joint(type=slide, axis=[0, 1, 0], damping=physics.drag * mass)
    turning = physics.drag / 2 if is_solid else HEADING_DAMPING
    body.add_joint(type=hinge, axis=[0, 0, 1], damping=turning * mass * radius * radius)
    contact: dict[str, Any] = {} if is_solid else NOWHERE
    add_cylinder(body, radius, CLEARANCE * radius, top, physics, mass=mass, rgba=colour(robot), **contact)
    return body


def add_drive(
    spec: mujoco.MjSpec, robot: int, radius: float, top: float, physics: Physics, *, is_solid: bool
) -> mujoco.MjsBody:
    """A round robot on two wheels and a caster; its frame is on the floor, under the middle of the axle."""
    body = spec.worldbody.add_body(name=f"robot_{robot}")
    body.add_freejoint()
    mass, shell = physics.surface_density * radius * radius, 1 - 2 * WHEEL_SHARE - BATTERY_SHARE
    contact: dict[str, Any] = {} if is_solid else NOWHERE
    add_cylinder(body, radius, CLEARANCE * radius, top, physics, mass=shell * mass, rgba=colour(robot), **contact)
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[0.3 * radius, 0.3 * radius, 0.05 * radius],
        pos=[radius * part for part in BATTERY_POSITION],
        mass=BATTERY_SHARE * mass,
        contype=0,
        conaffinity=0,
    )
    size = CASTER_RADIUS * radius
    for position, gap in ((-CASTER_POSITION, 0.0), (CASTER_POSITION, FRONT_GAP)):
        # Without friction: it turns and rolls as it likes. Its priority has the floor's own friction not count.
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[size, 0, 0], pos=[position * radius, 0, size + gap * radius],
            mass=0, contype=ROLLING, conaffinity=0, condim=1, priority=1,
        )  # fmt: skip
    for side in (1, -1):
        wheel = body.add_body(pos=[0, side * HALF_TRACK * radius, WHEEL_RADIUS * radius])
        wheel.add_joint(type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 1, 0])
        # Round across too, as a tyre is: it meets the floor in one point, and turning does not scrub.
        wheel.add_geom(
            type=mujoco.mjtGeom.mjGEOM_ELLIPSOID, mass=WHEEL_SHARE * mass, contype=ROLLING, conaffinity=0,
            size=[WHEEL_RADIUS * radius, WHEEL_HALF_WIDTH * radius, WHEEL_RADIUS * radius],
            friction=[physics.wheel_friction, 0.005, 0.0001], priority=1, rgba=[0.1, 0.1, 0.1, 1],
        )  # fmt: skip
    return body
