"""A planning problem: a team, its starts and goals, and the world it moves in."""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Literal, Self, get_args

import numpy as np
from numpy.typing import ArrayLike

from d4orm_env.core.arrays import (
    LARGEST,
    SMALLEST,
    FloatArray,
    Floats,
    Frozen,
    frozen_array,
    frozen_per_robot,
    positive_number,
    shown,
    whole_number,
)
from d4orm_env.core.lazy import LazyModule
from d4orm_env.core.problem_arrays import ProblemArrays, goal_directions, inverse_initial_distance, squared_chords
from d4orm_env.core.problem_checks import (
    check_places,
    check_resolution,
    check_states,
    check_tolerances,
    check_turning,
    goal_headings,
    goal_speeds,
    unwound_states,
)
from d4orm_env.core.summary_line import KeyFigure, count, joined, team_text
from d4orm_env.core.team import Team
from d4orm_env.core.world import World
from d4orm_env.dynamics.models import MODEL_CODES, NUM_BUILT_IN, model_digest
from d4orm_env.dynamics.transition import docking_speed

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from d4orm_env.paths import shortest_paths as paths
    from d4orm_env.paths.shortest_paths import ShortestPaths
    from d4orm_env.render import notebook, pictures
else:
    paths = LazyModule("d4orm_env.paths.shortest_paths")
    notebook = LazyModule("d4orm_env.render.notebook")
    pictures = LazyModule("d4orm_env.render.pictures")

Arrival = Literal["dock", "stay"]
"""Effect of arriving: the robot stays at its goal for good, or drives on."""

MAX_HORIZON, MAX_ROBOT_STEPS = 1_000_000, 50_000_000
"""Most steps of a problem, and most robots times steps: a slip of the finger must not fill the memory."""
MIN_TIME_STEP, MAX_TIME_STEP = 1e-6, 1e3
"""Bounds of ``dt`` [s]."""
ROUNDING, GRAINS = 1 / 15_000, 4
"""Allowance for rounding, in radii of the largest robot, and in what float32 resolves at the farthest start or goal."""


def check_arrival(value: object) -> None:
    """Refuse what is no :data:`Arrival`.

    Raises:
        ValueError: If it is none.
    """
    if value not in get_args(Arrival):
        raise ValueError(f"arrival is {shown(value)}; choose one of {', '.join(get_args(Arrival))}")


@dataclass(frozen=True, eq=False, init=False, repr=False)
class Problem(Frozen):
    """A multi-robot trajectory planning problem (paper, section III-A), checked on construction.

    Two problems are equal when everything but their names is equal to the bit; they hash accordingly.

    The physics is float32 and takes one RK4 step per ``dt``, so a problem that these do not hold is refused: where
    float32 resolves a start or goal to more than a hundredth of the goal radius (with the default of 0.075 m, beyond
    8192 m from the origin) or to more than a tenth of what a robot moves in a step, and where a robot at its
    limits turns too far. At constant turn rate ``w`` and speed ``v`` RK4 is Simpson's rule, which is off by at
    most ``v dt (w dt)^4 / 2880`` per step; that must not exceed 2/15 of the goal radius (with the default, 1 cm).

    Attributes:
        team: The robots.
        start: ``(K, n)`` initial states.
        goal: ``(K, d)`` goal positions [m].
        world: Obstacles and bounds; an empty open world of the team's dimension by default.
        dt: Time step [s], from 1e-6 to 1000.
        horizon: Number of steps ``H``, at most a million.
        margin: Safety margin epsilon [m] that plans keep to everything.
        goal_radius: A robot within it has arrived [m].
        goal_speed: ``(K,)`` speed at which each robot may still dock [m/s]; one number is for all. By default what it
            brakes away in a time step, ``max_acceleration * dt``, and infinite for first-order models. Infinite is the
            paper's convention: robots stop dead at their goals, as no real one can.
        goal_heading: ``(K,)`` heading with which each robot must arrive [rad], NaN for any; one number is for all.
        goal_heading_tolerance: ``(K,)`` by how much it may be missed [rad], from 0.001 to pi.
        name: Origin of the problem, for tables and pictures.
        collision_penalty: Taken off a robot's reward per step within the margin of another robot, and of an obstacle
            or a bound; 1 in the paper.
        arrival: ``"dock"``: a robot that arrives stays there for good, as in the paper. ``"stay"``: it may be moved
            again, to yield; all must be at their goals at the end.

    Raises:
        ValueError: If a value is not finite or out of range, a shape is wrong, a number is not positive, a start or
            goal is out of bounds or in contact with another robot or an obstacle, or float32 or RK4 does not hold the
            problem. The message names the robot, the value and the remedy.

    Warns:
        UserWarning: If a start or goal is within the margin of something, where plans cannot keep it. Scenarios refuse
            that.
    """

    team: Team
    start: FloatArray
    goal: FloatArray
    world: World
    dt: float
    horizon: int
    margin: float
    goal_radius: float
    goal_speed: FloatArray
    goal_heading: FloatArray
    goal_heading_tolerance: FloatArray
    name: str
    arrival: Arrival
    collision_penalty: float

    def __init__(
        self,
        team: Team,
        start: ArrayLike,
        goal: ArrayLike,
        world: World | None = None,
        dt: float = 0.1,
        horizon: int = 100,
        margin: float = 0.05,
        goal_radius: float = 0.075,
        goal_speed: ArrayLike | None = None,
        name: str = "custom",
        arrival: Arrival = "dock",
        collision_penalty: float = 1.0,
        goal_heading: ArrayLike | None = None,
        goal_heading_tolerance: ArrayLike = 0.1,
    ) -> None:
        world = World(dimension=team.dimension) if world is None else world
        if world.dimension != team.dimension:
            raise ValueError(f"the world has dimension {world.dimension} and the team {team.dimension}; match them")
        dt = positive_number(dt, "dt", least=MIN_TIME_STEP, most=MAX_TIME_STEP)
        check_arrival(arrival)
        self._set(
            team=team,
            start=frozen_array(start, "start", (team.num_robots, team.state_size), largest=LARGEST),
            goal=frozen_array(goal, "goal", (team.num_robots, team.dimension), largest=LARGEST),
            world=world,
            dt=dt,
            horizon=whole_number(horizon, "horizon", 1, MAX_HORIZON),
            margin=positive_number(margin, "margin", zero_allowed=True, most=LARGEST),
            goal_radius=positive_number(goal_radius, "goal_radius", least=SMALLEST, most=LARGEST),
            goal_speed=goal_speeds(team, dt, goal_speed),
            goal_heading=goal_headings(team, goal_heading),
            goal_heading_tolerance=frozen_per_robot(goal_heading_tolerance, "goal_heading_tolerance", team.num_robots),
            name=name,
            arrival=arrival,
            collision_penalty=positive_number(collision_penalty, "collision_penalty", most=LARGEST),
        )
        self._check()

    def _check(self) -> None:
        team, places = self.team, self.start[:, : self.dimension]
        # Asked for first, so that all clearances are found by the index of the engines.
        self.world.index(self._reach)
        if self.horizon * team.num_robots > MAX_ROBOT_STEPS:
            most = MAX_ROBOT_STEPS // team.num_robots
            raise ValueError(
                f"horizon is {self.horizon} steps for {team.num_robots} robots; it must be at most {most} for so many"
            )
        check_states(team, self.start)
        self._set(start=unwound_states(team, self.start))
        check_resolution(team, np.concatenate([places, self.goal], axis=1), self.dt, self.goal_radius)
        check_turning(team, self.dt, self.goal_radius)
        check_tolerances(self.goal_heading_tolerance)
        at_goals = np.where([model.heading_index is None for model in team.robot_models], 0, self.goal_heading)
        goals = np.column_stack([self.goal, at_goals]).astype(np.float64)
        for what, positions, poses in (("start", places, team.body_poses(self.start)), ("goal", self.goal, goals)):
            fault = check_places(team, self.world, what, positions, self.margin, poses)
            if fault:
                warnings.warn(
                    f"problem {self.name!r}: {fault}; move it, or use a smaller radius or margin", stacklevel=3
                )

    @property
    def num_robots(self) -> int:
        """``K``."""
        return self.team.num_robots

    @property
    def dimension(self) -> int:
        """Position dimensions ``d``."""
        return self.team.dimension

    @property
    def origin(self) -> Floats:
        """``(d,)`` float64, where the zero of all positions lies in the coordinates that the world comes from [m]."""
        return self.world.origin

    @property
    def state_size(self) -> int:
        """``n``."""
        return self.team.state_size

    @property
    def control_size(self) -> int:
        """``m``."""
        return self.team.control_size

    @property
    def duration(self) -> float:
        """Time from start to horizon [s]."""
        return self.dt * self.horizon

    @property
    def docks(self) -> bool:
        """True if a robot that has arrived stays there for good."""
        return self.arrival == "dock"

    @property
    def _reach(self) -> float:
        """The largest distance from an obstacle at which it counts [m]."""
        return float(np.max(self.team.radius)) + self.margin

    @property
    def _within(self) -> float:
        """The distance within which all obstacles count [m]: of a disc none but the nearest does."""
        return self._reach if self.team.shapes else 0.0

    @property
    def stride(self) -> float:
        """Distance that the fastest robot drives in a step at full speed [m], the unit of planners' settings."""
        return self.dt * float(self.team.max_speed.max())

    @cached_property
    def rounding(self) -> float:
        """Allowance for what float32 makes of distances [m]: a little of a radius, more where coordinates are large."""
        farthest = max(np.abs(self.start[:, : self.dimension]).max(), np.abs(self.goal).max())
        return max(ROUNDING * self.team.largest_radius, GRAINS * float(np.spacing(farthest)))

    @cached_property
    def arrays(self) -> ProblemArrays:
        """The problem as the engines read it."""
        turns = not np.isnan(self.goal_heading).all()
        arrays = ProblemArrays(
            model_codes=np.array([MODEL_CODES[name] for name in self.team.models], np.int32),
            limits=self.team.limits.copy(),
            radius=self.team.radius,
            start=self.start,
            goal=self.goal,
            inverse_initial_distance=inverse_initial_distance(
                self.start[:, : self.dimension], self.goal, self.goal_radius
            ),
            boxes=self.world.shapes.boxes,
            triangles=self.world.shapes.triangles,
            grid=self.world.index(self._reach, within=self._within),
            bounds=self.world.bounds,
            time_step=np.array([self.dt, self.dt / 2, self.dt / 3, self.dt / 6], np.float32),
            margin=np.float32(self.margin),
            squared_goal_radius=np.float32(self.goal_radius * self.goal_radius),
            squared_goal_speed=np.square(docking_speed(self.goal_speed, self.team.max_speed)),
            docks=np.bool_(self.docks),
            collision_penalty=np.float32(self.collision_penalty),
            turns_at_goals=np.bool_(True) if turns else None,
            goal_direction=goal_directions(self.goal_heading) if turns else None,
            squared_goal_chord=squared_chords(self.goal_heading, self.goal_heading_tolerance) if turns else None,
            footprints=self.team.footprint_arrays,
        )
        for array in arrays:
            if isinstance(array, np.ndarray):
                array.setflags(write=False)
        return arrays

    def arrays_to_observe(self, num_obstacles: int) -> ProblemArrays:
        """:attr:`arrays` with an index that finds so many of the nearest obstacles of any place."""
        places = np.concatenate([self.start[:, : self.dimension], self.goal])
        grid = self.world.index(self._reach, max(num_obstacles, 1), places, self._within)
        return self.arrays._replace(grid=grid)

    @cached_property
    def shortest_paths(self) -> ShortestPaths:
        """The shortest path of every robot; see :func:`d4orm_env.paths.shortest_paths.shortest_paths`."""
        return paths.shortest_paths(self)

    def check_reachable(self) -> None:
        """Check that every robot has a path to its goal that keeps its radius and the margin from obstacles and bounds.

        Other robots do not count. It takes a wavefront for every robot, which is why construction does not ask.

        Raises:
            ValueError: If one has none; the message names all of those.
        """
        robots = np.flatnonzero(np.isinf(self.shortest_paths.length))
        if len(robots):
            names = ", ".join(f"robot_{robot}" for robot in robots)
            reach = sorted({f"{radius + self.margin:.4g}" for radius in np.asarray(self.team.radius)[robots]})
            raise ValueError(
                f"{names} {'has' if len(robots) == 1 else 'have'} no path from start to goal that is "
                f"{' or '.join(reach)} m clear of obstacles; move the start or the goal, open the world there, or use "
                f"a smaller radius or margin"
            )

    @cached_property
    def digest(self) -> str:
        """SHA-256 over everything that defines the problem, the name left out."""
        sha = hashlib.sha256(repr(self.team.models).encode())
        arrays = self.arrays
        if arrays.model_codes.max() >= NUM_BUILT_IN:  # such codes depend on the order of registration
            sha.update(repr([model_digest(model) for model in self.team.robot_models]).encode())
            arrays = arrays._replace(model_codes=np.minimum(arrays.model_codes, NUM_BUILT_IN))
        # As before robots had goal speeds of their own: stored results refer to problems by this.
        goal_speed = None if np.isinf(self.goal_speed).all() else self.goal_speed.tolist()
        if goal_speed is None:
            arrays = arrays._replace(squared_goal_speed=np.array(np.inf, np.float32))
        world = self.world
        obstacles = (world.balls, world.cylinders, world.boxes, *world.polygons)
        for value in (*arrays[:6], *obstacles, *arrays[9:14]):
            array: np.ndarray = np.ascontiguousarray(value)
            sha.update(f"{array.shape}{array.dtype}".encode())
            sha.update(array.tobytes())
        if world.origin.any():
            sha.update(b"origin" + world.origin.tobytes())
        sha.update(f"{self.dt!r} {self.horizon} {self.margin!r} {self.goal_radius!r} {goal_speed!r}".encode())
        if not self.docks:
            sha.update(self.arrival.encode())
        if arrays.goal_direction is not None and arrays.squared_goal_chord is not None:
            sha.update(arrays.goal_direction.tobytes() + arrays.squared_goal_chord.tobytes())
        if self.team.shapes:
            sha.update(repr(self.team.shapes).encode())
        if self.collision_penalty != 1:
            sha.update(f"collision_penalty {self.collision_penalty!r}".encode())
        return sha.hexdigest()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Problem) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)

    @property
    def key_figures(self) -> list[KeyFigure]:
        """Return its key figures, in a few words each."""
        world = self.world
        bounds = (
            "open" if world.lower is None else " x ".join(f"{side:g}" for side in np.ptp(world.bounds, axis=0)) + " m"
        )
        return [
            ("robots", team_text(self.team.models)),
            ("world", f"{bounds}, {count(world.num_obstacles, 'obstacle')}"),
            ("time", f"{count(self.horizon, 'step')} of {self.dt:g} s"),
            ("margin", f"{self.margin:g} m"),
            ("arrival", self.arrival),
        ]

    def __repr__(self) -> str:
        return f"Problem: {self.name}\n  {joined(self.key_figures)}"

    def _repr_html_(self) -> str:
        return notebook.problem_html(self, f"Problem: {self.name}", self.key_figures)

    def plot(self, axes: Axes | None = None) -> Axes:
        """Draw starts, goals and world with matplotlib; see :func:`d4orm_env.render.pictures.plot`.

        Args:
            axes: Axes to draw on; by default those of a new figure of ``matplotlib.pyplot``.

        Returns:
            The axes, spatial for a spatial problem.

        Raises:
            ValueError: If the axes are spatial and the problem is not.
        """
        return pictures.plot(self, None, axes)

    def replace(self, **changes: object) -> Self:
        """A copy with some attributes changed, checked again.

        What the robots' goals have by default, or in common, another team has too.
        """
        if np.array_equal(self.goal_speed, goal_speeds(self.team, self.dt, None)):
            changes = {"goal_speed": None} | changes
        if np.isnan(self.goal_heading).all():
            changes = {"goal_heading": None} | changes
        if (self.goal_heading_tolerance == self.goal_heading_tolerance[0]).all():
            changes = {"goal_heading_tolerance": self.goal_heading_tolerance[0]} | changes
        return super().replace(**changes)

    def with_state(self, start: ArrayLike, goal: ArrayLike, **changes: object) -> Problem:
        """The same team in the same world in other states, for planning on from there.

        Unlike :meth:`replace` it does not check what is changed: under way robots may touch, be faster than they
        should, or head for places that they cannot all be at.

        Args:
            start: ``(K, n)`` states.
            goal: ``(K, d)`` places to go to [m].
            **changes: Other attributes that differ, of the right type.
        """
        return self._unchecked(
            start=frozen_array(start, "start", self.start.shape),
            goal=frozen_array(goal, "goal", self.goal.shape),
            **changes,
        )

    def select(self, robots: Sequence[int]) -> Problem:
        """The problem of these robots only, in the order given."""
        index = list(robots)
        team = self.team.select(index)
        return self._unchecked(
            team=team,
            start=self.start[index, : team.state_size],
            goal=self.goal[index],
            goal_speed=self.goal_speed[index],
            goal_heading=self.goal_heading[index],
            goal_heading_tolerance=self.goal_heading_tolerance[index],
        )

    def _unchecked(self, **changes: object) -> Problem:
        copy: Problem = object.__new__(Problem)
        copy._set(**{**self.__getstate__(), **changes})
        return copy
