"""Optimal reciprocal collision avoidance, through the ``pyrvo`` bindings of the authors' RVO2 library.

J. van den Berg, S. J. Guy, M. Lin and D. Manocha, "Reciprocal n-Body Collision Avoidance", Robotics Research, 2011.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np
from pydantic import Field

from d4orm_env.core.arrays import FloatArray, IntArray
from d4orm_env.core.lazy import LazyModule, load
from d4orm_env.core.problem import Problem
from d4orm_env.core.seeds import Stream, generator
from d4orm_env.core.team import DEFAULT_RADIUS
from d4orm_env.engine.observing import communication_links
from d4orm_env.envs.joint_state import JointState
from d4orm_planners.base.policy import StatePolicy
from d4orm_planners.base.settings import CheckedSettings, NotNegative, Positive, Whole
from d4orm_planners.tracking.goal_drives import curving, curving_room, velocities_to_goals
from d4orm_planners.tracking.steering import (
    goals_along_paths,
    preferred_velocities,
    present_velocities,
    track_velocities,
)

if TYPE_CHECKING:
    from pettingzoo import ParallelEnv

pyrvo: Any = LazyModule("pyrvo", "policy 'orca'", "orca")
NEARBY = 4.0  #: Distance from its goal within which a robot goes by curves to its goal heading, in turning radii
UNDISTURBED = 1e-3  #: Share of its speed limit by which nobody who is near changes a robot's velocity
CORNERS = 16  #: Corners of the polygons that stand for round obstacles and robots at rest


@dataclass(frozen=True, kw_only=True)
class OrcaConfig(CheckedSettings):
    """Settings of :class:`Orca`."""

    time_horizon: Positive = 1.0  #: For this long the new velocities keep the robots apart [s]
    obstacle_time_horizon: Positive = 1.0  #: The same for obstacles, bounds and arrived robots, which do not yield [s]
    neighbor_distance: Positive = 100.0  #: Farther robots are not looked at, in steps of the fastest at full speed
    max_neighbors: Annotated[Whole, Field(ge=0, le=10**6)] = 10  #: So many of the nearest robots are looked at
    #: Added to every robot's radius [m]; by default the problem's margin. Two robots so keep twice that distance, which
    #: leaves robots with inertia some room: they cannot take a new velocity at once.
    clearance: NotNegative | None = None
    shortest_paths: bool = True  #: Whether robots prefer their shortest paths among obstacles to the straight line
    #: Standard deviation of the angle by which each robot's preferred velocity is turned, drawn once per episode [rad].
    #: Without it robots in a symmetric formation block each other, as the authors note.
    deviation: NotNegative = 0.1


class Orca(StatePolicy):
    """ORCA: every robot drives to its goal at the velocity nearest to the one it prefers that avoids all others.

    All robots give way to each other by halves; arrived robots, obstacles and bounds do not give way. ORCA speaks of
    robots that take a new velocity at once. Those of a model with inertia or a heading follow it as well as their
    limits allow, so that they may come closer than ORCA promises. It works in the plane only.

    Where an environment limits whom robots observe, by range or line of sight, each avoids only those it knows of.
    """

    name = "orca"
    config_class: ClassVar[type[CheckedSettings] | None] = OrcaConfig

    def __init__(self, config: OrcaConfig | None = None) -> None:
        self.config = config or OrcaConfig()
        load(pyrvo)

    def _begin(self, env: ParallelEnv, seed: int) -> None:
        problem = self.problem
        if problem.dimension != 2:
            raise ValueError(
                f"policy 'orca' works in the plane, and this problem has {problem.dimension} dimensions; choose "
                "another policy or a planar model"
            )
        angle = generator(seed, Stream.PREFERRED_DIRECTION).normal(0, self.config.deviation, problem.num_robots)
        self._turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]], np.float32)
        self._walls = list(_walls(problem))
        options = env.unwrapped.options
        self._known = options.communication_range, options.line_of_sight

    def _controls(self, joint: JointState) -> FloatArray:
        problem, aims = self.problem, joint.goals
        if self.config.shortest_paths:
            aims = goals_along_paths(problem, joint.states[:, : problem.dimension], aims)
        preferred = np.einsum("ijk,kj->ki", self._turn, preferred_velocities(problem, joint.states, aims))
        if (by_curves := curving(problem)).any():
            left, bend = (np.linalg.norm(joint.goals - points, axis=1) for points in (joint.states[:, :2], aims))
            by_curves &= (left < curving_room(problem, NEARBY)) & (bend <= problem.goal_radius)
            own, free = velocities_to_goals(problem, joint.states, joint.goals)
            preferred = np.where(by_curves[:, None], own, preferred)
            by_curves &= free
        velocities = self._avoid_known(joint, preferred)
        if by_curves.any():  # what the disc round a robot touches is none of its curve's business, if nobody is near
            alone = np.abs(self._avoid_known(joint, preferred, walls=False) - preferred).max(axis=1)
            alone = by_curves & (alone <= UNDISTURBED * problem.team.max_speed)
            velocities = np.where(alone[:, None], preferred, velocities)
        return track_velocities(problem, joint.states, velocities)

    def _avoid_known(self, joint: JointState, preferred: FloatArray, walls: bool = True) -> FloatArray:
        """:meth:`_avoid`, every robot by itself among those it knows of where these are not all."""
        if self._known == (None, False):
            return self._avoid(joint, preferred, np.arange(len(preferred)), walls)
        links = communication_links(self.problem, joint.states[:, :2], *self._known)
        alone = [np.flatnonzero(known | (np.arange(len(known)) == robot)) for robot, known in enumerate(links)]
        return np.stack([self._avoid(joint, preferred, team, walls)[robot] for robot, team in enumerate(alone)])

    def _avoid(self, joint: JointState, preferred: FloatArray, team: IntArray, walls: bool) -> FloatArray:
        """``(K, 2)`` velocities of these robots, nearest to the preferred ones, that avoid everything and each other.

        Those of arrived robots and of others are zero.
        """
        problem, config = self.problem, self.config
        # Made anew at every step, so that an action depends on the present state alone.
        simulator = pyrvo.RVOSimulator()
        simulator.set_time_step(problem.dt)
        clearance = problem.margin if config.clearance is None else config.clearance
        # The library has absolute constants, which are meant for robots of about the default size.
        unit = np.float32(problem.team.largest_radius / DEFAULT_RADIUS)
        radius, max_speed = np.asarray(problem.team.radius) / unit, np.asarray(problem.team.max_speed) / unit
        positions = joint.states[:, :2] / unit
        absorbed = joint.arrived & problem.docks
        moving = team[~absorbed[team]]
        velocities = present_velocities(problem, joint.states, joint.controls) / unit
        for robot in moving:
            simulator.add_agent(
                positions[robot].tolist(),
                config.neighbor_distance * problem.stride / float(unit),
                config.max_neighbors,
                config.time_horizon,
                config.obstacle_time_horizon,
                float(radius[robot]) + clearance / float(unit),
                float(max_speed[robot]),
                velocities[robot].tolist(),
            )
        arrived = [_disc(positions[k, 0], positions[k, 1], radius[k]) for k in team[absorbed[team]]]
        for corners in [*(wall / unit for wall in self._walls if walls), *arrived]:
            simulator.add_obstacle(corners.tolist())
        simulator.process_obstacles()
        for agent, robot in enumerate(moving):
            simulator.set_agent_pref_velocity(agent, (preferred[robot] / unit).tolist())
        simulator.do_step()
        avoiding = np.zeros_like(preferred)
        for agent, robot in enumerate(moving):
            avoiding[robot] = simulator.get_agent_velocity(agent).to_tuple()
        return avoiding * unit


def _walls(problem: Problem) -> Iterator[FloatArray]:
    """Obstacles and bounds as polygons: counter-clockwise around what is solid, clockwise around free space."""
    for circle in problem.world.circles:
        yield _disc(*circle)
    for box in problem.world.boxes:
        yield _rectangle(*box)
    for corners, triangles in zip(problem.world.polygons, problem.world.triangles, strict=True):
        # The triangles are counter-clockwise, and one that has an edge of the outline shows which way round it goes.
        forward = any((b - a) % len(corners) == 1 for t in triangles for a, b in zip(t, (*t[1:], t[0]), strict=True))
        yield corners if forward else corners[::-1]
    if problem.world.lower is not None:
        yield _rectangle(*problem.world.bounds.ravel())[::-1]


def _rectangle(left: float, bottom: float, right: float, top: float) -> FloatArray:
    return np.array([[left, bottom], [right, bottom], [right, top], [left, top]], np.float32)


def _disc(x: float, y: float, radius: float) -> FloatArray:
    """``(CORNERS, 2)`` polygon around a disc."""
    angle = np.arange(CORNERS) * (2 * np.pi / CORNERS)
    outer = radius / np.cos(np.pi / CORNERS)
    return np.array([x, y] + outer * np.column_stack([np.cos(angle), np.sin(angle)]), np.float32)
