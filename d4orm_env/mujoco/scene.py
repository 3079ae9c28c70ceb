"""A problem as a scene of MuJoCo: a floor, static obstacles, and a body for every robot, of some material.

Robots are pucks or drives. A footprint that is no disc is a bumper without mass round a robot that moves as the largest
disc within it would.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import FloatArray, positive_number
from d4orm_env.core.problem import Problem
from d4orm_env.core.world import World
from d4orm_env.footprints import Core, Disc, Planar

_ALLOWED_ZERO = ("drag", "wheel_friction", "body_friction")
_MOST = {"time_step": 0.02, "wheel_friction": 10.0, "body_friction": 10.0, "settling_time": 1.0, "surface_density": 1e6}


@dataclass(frozen=True, kw_only=True)
class Physics:
    """The bodies of a team in MuJoCo. The defaults are those of small laboratory robots.

    Raises:
        ValueError: For a number out of range.
    """

    time_step: float = 0.005  #: Longest step of MuJoCo [s]; a time step of the problem is divided evenly. At most 0.02.
    drag: float = 0.2  #: Of pucks, linear in their velocity, per mass [1/s]; what a planner does not know of
    wheel_friction: float = 0.8  #: Coulomb friction coefficient between wheels and floor
    body_friction: float = 0.3  #: The same between robots, and between robots and obstacles
    #: Time constant of the low-level speed controllers [s]; see :class:`~d4orm_env.mujoco.bodies.WheelControl`
    settling_time: float = 0.03
    #: Mass of a robot over the square of its radius [kg/m^2]; 100 is 2.25 kg for a radius of 0.15 m
    surface_density: float = 100.0

    def __post_init__(self) -> None:
        for name in [attribute.name for attribute in fields(self)]:
            zero, most = name in _ALLOWED_ZERO, _MOST.get(name, 1e3)
            value = positive_number(getattr(self, name), f"Physics {name}", zero_allowed=zero, least=1e-4, most=most)
            object.__setattr__(self, name, value)


GRAVITY = 9.81
"""[m/s^2]."""
PUCKS, DRIVES = ("holonomic2d", "velocity2d"), ("differential_drive", "unicycle", "unicycle1", "unicycle2")
"""Models of robots that are pushed, and of those on two wheels."""

WHEEL_RADIUS, HALF_TRACK, WHEEL_HALF_WIDTH, CASTER_RADIUS, CASTER_POSITION = 0.3, 0.65, 0.08, 0.1, 0.75
CLEARANCE, HEIGHT, FRONT_GAP = 0.25, 0.85, 0.02
"""Measures of a robot, over the radius of the largest disc about its reference point within it. The caster is behind;
one in front, off the floor, keeps the nose up."""
WHEEL_SHARE, BATTERY_SHARE, BATTERY_POSITION = 0.1, 0.5, (-0.15, 0.0, 0.2)
SHELL_SHARE = 1 - 2 * WHEEL_SHARE - BATTERY_SHARE
"""Shares of a drive's mass: of each wheel, of what lies low and behind the axle, and of its shell."""
ROLLING, SOLID = 1, 2
"""Kinds of contact: of what rolls on the floor, and of what bodies must not touch."""
_PALETTE = ((0.12, 0.47, 0.71), (1.0, 0.5, 0.05), (0.17, 0.63, 0.17), (0.84, 0.15, 0.16), (0.58, 0.4, 0.74),
            (0.55, 0.34, 0.29), (0.89, 0.47, 0.76), (0.74, 0.74, 0.13))  # fmt: skip
NOWHERE: dict[str, Any] = {"contype": 0, "conaffinity": 0}
"""Attributes of what has mass and touches nothing."""
HEADING_DAMPING = 1e6
"""Damping of the turning of pucks that are no discs, per mass and squared radius [1/s]: their model never turns."""
_WALL = 0.2
"""Thickness of the walls round a bounded world [m]."""


class MujocoScene(NamedTuple):
    """A compiled scene and where things are in it."""

    model: mujoco.MjModel  #: The scene
    #: ``(K,)`` first address of a robot's positions; a puck has ``x, y, angle`` there, a drive position and quaternion,
    #: and then two wheels
    joints: NDArray[np.int64]
    dofs: NDArray[np.int64]  #: ``(K,)`` first address of its velocities
    #: ``(geoms,)`` the robot that a solid geom belongs to, :data:`OBSTACLE`, or :data:`NOT_SOLID`
    owner: NDArray[np.int64]
    radius: NDArray[np.float64]  #: ``(K,)`` of the largest discs within footprints, or of the discs [m]
    mass: NDArray[np.float64]  #: ``(K,)`` [kg]


OBSTACLE, NOT_SOLID = -1, -2
LEAST_RADIUS = 1e-3
"""Least radius of a robot [m]: MuJoCo divides by masses."""


def check_problem(problem: Problem) -> None:
    """Refuse what has no bodies here.

    Raises:
        ValueError: For a robot whose model has none, as in space, or which is too small for one.
    """
    for robot, name in enumerate(problem.team.models):
        if name not in PUCKS + DRIVES:
            raise ValueError(
                f"robot_{robot} is a {name}, which has no body in MuJoCo; use one of {', '.join(PUCKS + DRIVES)}"
            )
        if (radius := _core_radius(problem, robot)) < LEAST_RADIUS:
            what = "radius" if not problem.team.shapes else f"distance to the edge of {problem.team.footprint[robot]}"
            raise ValueError(f"{what} of robot_{robot} is {radius:g}; bodies in MuJoCo need {LEAST_RADIUS:g} m")


def _core_radius(problem: Problem, robot: int) -> float:
    """Radius of the largest disc about a robot's reference point within its footprint [m]."""
    team = problem.team
    return float(team.footprint[robot].inner_radius if team.shapes else team.radius[robot])


def build_scene(problem: Problem, physics: Physics, body_radius: FloatArray, step: float) -> MujocoScene:
    """The scene of a problem, all robots at their starts, and bodies of radii ``(N,)`` [m] that are no robots."""
    spec = mujoco.MjSpec()
    spec.option.timestep = step
    spec.option.gravity = [0, 0, -GRAVITY]
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    # Wheels creep sideways on the default, pyramidal friction cones.
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10
    spec.visual.global_.offwidth = spec.visual.global_.offheight = 640
    # The only light comes from where one looks from, as far as one is.
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.5] * 3, [0.5] * 3
    spec.visual.headlight.specular = [0.0] * 3
    radius = np.array([_core_radius(problem, robot) for robot in range(problem.num_robots)])
    top = HEIGHT * float(radius.max())
    _add_surroundings(spec, problem.world, top, physics)
    for number, size in enumerate(body_radius.tolist()):
        body = spec.worldbody.add_body(name=f"intruder_{number}", mocap=True)
        add_cylinder(body, size, 0.0, top, physics, rgba=[0.2, 0.2, 0.2, 1])
    for robot, name in enumerate(problem.team.models):
        body, size, shapes = spec.worldbody.add_body(name=f"robot_{robot}"), float(radius[robot]), problem.team.shapes
        mass, share = physics.surface_density * size * size, 1.0 if name in PUCKS else SHELL_SHARE
        contact, low = NOWHERE if shapes else {}, CLEARANCE * size
        add_cylinder(body, size, low, top, physics, mass=share * mass, rgba=colour(robot), **contact)
        if name in PUCKS:
            add_puck(body, size, mass, physics, turns=not shapes)
        else:
            add_drive(body, size, mass, physics)
        footprint = problem.team.footprint[robot]
        if shapes and isinstance(footprint, Disc | Planar):
            add_bumper(spec, body, footprint.core, low, top, physics)
    try:
        model = spec.compile()
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"MuJoCo makes no bodies of problem {problem.name!r}: {reason}") from error
    return _addresses(model, radius, physics)


def _addresses(model: mujoco.MjModel, radius: NDArray[np.float64], physics: Physics) -> MujocoScene:
    names = [f"robot_{robot}" for robot in range(len(radius))]
    first = [int(model.body(name).jntadr[0]) for name in names]
    owner = np.full(model.ngeom, NOT_SOLID)
    solid = model.geom_contype == SOLID
    owner[solid] = OBSTACLE
    for robot, name in enumerate(names):
        owner[solid & (model.geom_bodyid == model.body(name).id)] = robot
    return MujocoScene(
        model,
        np.array(model.jnt_qposadr[first], np.int64),
        np.array(model.jnt_dofadr[first], np.int64),
        owner,
        radius,
        physics.surface_density * radius * radius,
    )


def _add_surroundings(spec: mujoco.MjSpec, world: World, top: float, physics: Physics) -> None:
    """Floor, obstacles and the walls round a bounded world, all of them ``top`` high [m]."""
    ground, grey = spec.worldbody, [0.45, 0.47, 0.5, 1]
    # It has a side of the contact only, so that nothing but what rolls meets it.
    ground.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE, size=[100, 100, 1], contype=0, conaffinity=ROLLING, rgba=[0.8, 0.8, 0.8, 1]
    )  # fmt: skip
    for x, y, radius in world.circles.tolist():
        add_cylinder(ground, radius, 0.0, top, physics, position=(x, y), rgba=grey)
    boxes = world.boxes.tolist()
    if world.lower is not None and world.upper is not None:
        boxes += _walls(world.lower.tolist(), world.upper.tolist())
    for left, low, right, high in boxes:
        ground.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[(right - left) / 2, (high - low) / 2, top / 2],
            pos=[(right + left) / 2, (high + low) / 2, top / 2],
            rgba=grey,
            **solid(physics),
        )
    for number, corners in enumerate(world.shapes.triangles.reshape(-1, 3, 2).astype(np.float64)):
        prism = np.ravel([[*corner, height] for corner in corners.tolist() for height in (0.0, top)])
        # A shell, because a sliver has no volume to speak of; what never moves needs no inertia.
        spec.add_mesh(name=f"prism_{number}", uservert=prism, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
        ground.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"prism_{number}", rgba=grey, **solid(physics))


def _walls(lower: list[float], upper: list[float]) -> list[list[float]]:
    (left, low), (right, high) = lower, upper
    return [
        [left - _WALL, low - _WALL, left, high + _WALL],
        [right, low - _WALL, right + _WALL, high + _WALL],
        [left, low - _WALL, right, low],
        [left, high, right, high + _WALL],
    ]


def solid(physics: Physics) -> dict[str, Any]:
    """Attributes of what bodies must not touch."""
    return {"contype": SOLID, "conaffinity": SOLID, "friction": [physics.body_friction, 0.005, 0.0001]}


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


def add_puck(body: mujoco.MjsBody, radius: float, mass: float, physics: Physics, *, turns: bool) -> None:
    """Have a robot glide over the floor against a drag, and turn when it is touched; not if it has a bumper."""
    slide, hinge = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
    body.add_joint(type=slide, axis=[1, 0, 0], damping=physics.drag * mass)
    body.add_joint(type=slide, axis=[0, 1, 0], damping=physics.drag * mass)
    turning = physics.drag / 2 if turns else HEADING_DAMPING
    body.add_joint(type=hinge, axis=[0, 0, 1], damping=turning * mass * radius * radius)


def add_drive(body: mujoco.MjsBody, radius: float, mass: float, physics: Physics) -> None:
    """Put a robot on two wheels and a caster; its frame is on the floor, under the middle of the axle."""
    body.add_freejoint()
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[0.3 * radius, 0.3 * radius, 0.05 * radius],
        pos=[radius * part for part in BATTERY_POSITION],
        mass=BATTERY_SHARE * mass,
        **NOWHERE,
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
