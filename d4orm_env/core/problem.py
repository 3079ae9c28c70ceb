"""A planning problem: a team, its starts and goals, and the world it moves in."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import ArrayLike

from d4orm_env.core import problem_checks as checks
from d4orm_env.core.arrays import LARGEST, FloatArray, Floats, Frozen, frozen_array
from d4orm_env.core.goal_poses import DEFAULT_TOLERANCE, checked_goal_poses, goal_speeds
from d4orm_env.core.lazy import LazyModule
from d4orm_env.core.problem_arrays import ProblemArrays, as_arrays, digest_of
from d4orm_env.core.problem_checks import Arrival
from d4orm_env.core.summary_line import KeyFigure, count, joined, team_text
from d4orm_env.core.team import Team
from d4orm_env.core.world import World, world_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from d4orm_env.core import infeasibility
    from d4orm_env.paths import shortest_paths as paths
    from d4orm_env.paths.shortest_paths import ShortestPaths
    from d4orm_env.render import pictures
else:
    infeasibility = LazyModule("d4orm_env.core.infeasibility")
    paths = LazyModule("d4orm_env.paths.shortest_paths")
    pictures = LazyModule("d4orm_env.render.pictures")

ROUNDING, GRAINS = 1 / 15_000, 4
"""Allowance for rounding, in radii of the largest robot, and in what float32 resolves at the farthest start or goal."""


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
        margin: Safety margin epsilon [m] that plans keep to everything, by default the team's.
        goal_radius: A robot within it has arrived [m].
        goal_speed: ``(K,)`` speed at which each robot may still dock [m/s]; one number is for all. By default what it
            brakes away in a time step: ``max_acceleration * dt``, ``max_jerk * dt**2 / 2`` where brakes act late, and
            infinite for first-order models. Infinite is the paper's convention: robots stop dead at their goals.
        goal_heading: ``(K,)`` heading with which each robot must arrive [rad], NaN for any; one number is for all.
        goal_heading_tolerance: ``(K,)`` by how much it may be missed [rad], from 0.001 to pi.
        goal_hitches: ``(K, 3)`` hitch angles with which trailers must arrive, as exactly [rad]; NaN for any.
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
    goal_hitches: FloatArray
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
        margin: float | None = None,
        goal_radius: float = 0.075,
        goal_speed: ArrayLike | None = None,
        name: str = "custom",
        arrival: Arrival = "dock",
        collision_penalty: float = 1.0,
        goal_heading: ArrayLike | None = None,
        goal_heading_tolerance: ArrayLike = DEFAULT_TOLERANCE,
        goal_hitches: ArrayLike | None = None,
    ) -> None:
        checks.check_is_team(team)
        world, size = world_of(world, team.dimension), team.num_robots
        margin = team.margin if margin is None else margin
        numbers = checks.checked_numbers(dt, horizon, margin, goal_radius, collision_penalty, size)
        checks.check_arrival(arrival)
        self._set(
            **numbers,
            team=team,
            start=frozen_array(start, "start", (size, team.state_size), largest=LARGEST, columns=team.state_names),
            goal=frozen_array(goal, "goal", (size, team.dimension), largest=LARGEST),
            world=world,
            goal_speed=goal_speeds(team, numbers["dt"], goal_speed),
            **checked_goal_poses(team, goal_heading, goal_heading_tolerance, goal_hitches),
            name=str(name),  # a path is a name too
            arrival=arrival,
        )
        # Asked for first, so that all clearances are found by the index of the engines.
        self.world.index(self._safety_distance)
        checks.check_states(team, self.start)
        for fault in checks.check_physics(self):
            warnings.warn(f"problem {name!r}: {fault}; move it, or use a smaller radius or margin", stacklevel=2)

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
    def _safety_distance(self) -> float:
        """Distance from obstacles that the largest robot keeps: its radius and the margin [m]."""
        return float(np.max(self.team.radius)) + self.margin

    @property
    def _within(self) -> float:
        """The distance within which all obstacles count [m]: of a disc none but the nearest does."""
        return self._safety_distance if self.team.shapes else 0.0

    @property
    def stride(self) -> float:
        """Distance that the fastest robot drives in a step at full speed [m], the unit of planners' settings."""
        return self.dt * float(self.team.max_speed.max())

    @cached_property
    def rounding(self) -> float:
        """Allowance for what float32 makes of distances, a little of a radius, more where coordinates are large [m]."""
        farthest = max(np.abs(self.start[:, : self.dimension]).max(), np.abs(self.goal).max())
        return max(ROUNDING * self.team.largest_radius, GRAINS * float(np.spacing(farthest)))

    @cached_property
    def arrays(self) -> ProblemArrays:
        """The problem as the engines read it."""
        return as_arrays(self, self.world.index(self._safety_distance, within=self._within))

    def arrays_to_observe(self, num_obstacles: int) -> ProblemArrays:
        """:attr:`arrays` with an index that finds so many of the nearest obstacles of any position."""
        positions = np.concatenate([self.start[:, : self.dimension], self.goal])
        grid = self.world.index(self._safety_distance, max(num_obstacles, 1), positions, self._within)
        return self.arrays._replace(grid=grid)

    @cached_property
    def shortest_paths(self) -> ShortestPaths:
        """The shortest path of every robot; see :func:`d4orm_env.paths.shortest_paths.shortest_paths`."""
        return paths.shortest_paths(self)

    def check_reachable(self) -> None:
        """Check that every robot has a path to its goal that keeps its radius and the margin from obstacles and bounds.

        Other robots do not count, of footprints the discs within. Construction does not ask, as it takes a while.

        Raises:
            ValueError: If one has none, for teams with footprints where that is proved; the message names them.
        """
        infeasibility.check_connected(self) if self.team.shapes else self.shortest_paths.check_reachable()

    @cached_property
    def digest(self) -> str:
        """SHA-256 over everything that defines the problem, the name left out."""
        return digest_of(self)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Problem) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)

    @property
    def key_figures(self) -> list[KeyFigure]:
        """Key figures, in a few words each."""
        world, sides = self.world, np.ptp(self.world.bounds, axis=0)
        extent = "open" if world.lower is None else f"{' x '.join(f'{side:g}' for side in sides)} m"
        return [
            ("robots", team_text(self.team.models)),
            ("world", f"{extent}, {count(world.num_obstacles, 'obstacle')}"),
            ("time", f"{count(self.horizon, 'step')} of {self.dt:g} s"),
            ("margin", f"{self.margin:g} m"),
            ("arrival", self.arrival),
        ]

    def __repr__(self) -> str:
        return f"Problem: {self.name}\n  {joined(self.key_figures)}"

    def _repr_html_(self) -> str:
        return pictures.problem_html(self, f"Problem: {self.name}", self.key_figures)

    def plot(self, axes: Axes | None = None) -> Axes:
        """Draw starts, goals and world on axes, by default new ones; see :func:`d4orm_env.render.pictures.plot`."""
        return pictures.plot(self, None, axes)

    def replace(self, **changes: object) -> Self:
        """A copy with some attributes changed, checked again.

        What the robots' goals have by default, or in common, another team has too.
        """
        if np.array_equal(self.goal_speed, goal_speeds(self.team, self.dt, None)):
            changes = {"goal_speed": None} | changes
        for name in ("goal_heading", "goal_hitches"):
            if np.isnan(getattr(self, name)).all():
                changes = {name: None} | changes
        if (self.goal_heading_tolerance == self.goal_heading_tolerance[0]).all():
            changes = {"goal_heading_tolerance": self.goal_heading_tolerance[0]} | changes
        return super().replace(**changes)

    def with_state(self, start: ArrayLike, goal: ArrayLike, **changes: object) -> Problem:
        """The same team in the same world in other states, for planning on from there.

        Unlike :meth:`replace` it does not check what is changed: under way robots may touch, be faster than they
        should, or head for goals that they cannot all be at.

        Args:
            start: ``(K, n)`` states.
            goal: ``(K, d)`` goals [m].
            **changes: Other attributes that differ, of the right type.
        """
        return self._unchecked(
            start=frozen_array(start, "start", self.start.shape, columns=self.team.state_names),
            goal=frozen_array(goal, "goal", self.goal.shape),
            **changes,
        )

    def select(self, robots: Sequence[int]) -> Problem:
        """The problem of these robots only, in the order given; a number that is no robot's is a ValueError."""
        index = list(robots)
        team = self.team.select(index)
        names = ("goal", "goal_speed", "goal_heading", "goal_heading_tolerance", "goal_hitches")
        goals = {name: getattr(self, name)[index] for name in names}
        return self._unchecked(team=team, start=self.start[index, : team.state_size], **goals)

    def _unchecked(self, **changes: object) -> Problem:
        copy: Problem = object.__new__(Problem)
        copy._set(**{**self.__getstate__(), **changes})
        return copy
