"""A planning problem: a team, its starts and goals, and the world it moves in."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import (
    LARGEST,
    SMALLEST,
    FloatArray,
    frozen_array,
    positive_number,
    restore_frozen,
    whole_number,
)
from d4orm_env.core.dynamics import MODEL_CODES, NUM_BUILT_IN, model_digest
from d4orm_env.core.robot_model import SPEED, STANDARD_LIMITS, TURN_RATE, Model
from d4orm_env.core.team import Team
from d4orm_env.core.world import World

if TYPE_CHECKING:
    from d4orm_env.ways import Ways

MAX_HORIZON, MAX_ROBOT_STEPS = 1_000_000, 50_000_000
"""Most steps of a problem, and most robots times steps: a slip of the finger must not fill the memory."""
MIN_TIME_STEP, MAX_TIME_STEP = 1e-6, 1e3
"""Bounds of ``dt`` [s]."""
MAX_HEADING = 1000.0
"""Largest heading of a start [rad]; float32 resolves it to 6e-5 rad."""
RESOLUTION = 100
"""The goal radius is at least so many times what float32 resolves at the farthest start or goal."""
STEP_RESOLUTION = 10
"""A robot at its speed limit moves at least so many times that in one step."""
INTEGRATION_ERROR = 0.01
"""Most that one step of RK4 may be off where a robot turns at its limits [m]."""


class ProblemArrays(NamedTuple):
    """A problem as the engines read it: plain arrays, float32 unless said, one struct for numba and JAX alike.

    Attributes:
        model_codes: ``(K,)`` int32.
        limits: ``(K, 3)`` speed, acceleration and turn rate limits.
        radius: ``(K,)``.
        start: ``(K, n)``.
        goal: ``(K, d)``.
        inverse_initial_distance: ``(K,)`` one over the distance from start to goal (at least the goal radius).
        boxes: ``(., 2 d + 1)`` obstacles, see :class:`~d4orm_env.core.shapes.Shapes`.
        triangles: ``(., 6)`` more of them.
        index: Where they are.
        bounds: ``(2, d)``, infinite where open.
        time_step: ``(4,)`` dt, dt/2, dt/3, dt/6.
        margin: ``()``.
        squared_goal_radius: ``()``.
        squared_goal_speed: ``()``, infinite without a limit.
    """

    model_codes: Any
    limits: Any
    radius: Any
    start: Any
    goal: Any
    inverse_initial_distance: Any
    boxes: Any
    triangles: Any
    index: Any
    bounds: Any
    time_step: Any
    margin: Any
    squared_goal_radius: Any
    squared_goal_speed: Any


@dataclass(frozen=True, eq=False)
class Problem:
    """A multi-robot trajectory planning problem (paper, section III-A), checked on construction.

    Two problems are equal when everything but their names is equal to the bit; they hash accordingly.

    The physics is float32 and takes one RK4 step per ``dt``, so a problem that these do not hold is refused: where
    float32 resolves a start or goal to more than a hundredth of the goal radius (with the default of 0.075 m, beyond
    8192 m from the origin) or to more than a tenth of what a robot moves in a step, and where a robot at its
    limits turns too far. At constant turn rate ``w`` and speed ``v`` RK4 is Simpson's rule, which is off by at
    most ``v dt (w dt)^4 / 2880`` per step; that must not exceed 1 cm.

    Attributes:
        team: The robots.
        start: ``(K, n)`` initial states.
        goal: ``(K, d)`` goal positions [m].
        world: Obstacles and bounds; an empty open world of the team's dimension by default.
        dt: Time step [s], from 1e-6 to 1000.
        horizon: Number of steps ``H``, at most a million.
        margin: Safety margin epsilon [m] that plans keep to everything.
        goal_radius: A robot within it has arrived [m].
        goal_speed: Speed at which a robot may still dock [m/s]; ``None`` is no limit, as in the paper.
        name: Where the problem comes from, for tables and pictures.

    Raises:
        ValueError: If a value is not finite or out of range, a shape is wrong, a number is not positive, a start or
            goal is out of bounds or in contact with another robot or an obstacle, or float32 or RK4 does not hold the
            problem. The message names the robot, the value and the remedy.
    """

    team: Team
    start: Any
    goal: Any
    world: World = field(default=None)  # type: ignore[assignment]
    dt: float = 0.1
    horizon: int = 100
    margin: float = 0.05
    goal_radius: float = 0.075
    goal_speed: float | None = None
    name: str = "custom"

    def __post_init__(self) -> None:
        team = self.team
        if self.world is None:
            object.__setattr__(self, "world", World(dimension=team.dimension))
        if self.world.dimension != team.dimension:
            raise ValueError(
                f"the world has dimension {self.world.dimension} and the team {team.dimension}; match them"
            )
        converted = {
            "start": frozen_array(self.start, "start", (team.num_robots, team.state_size), largest=LARGEST),
            "goal": frozen_array(self.goal, "goal", (team.num_robots, team.dimension), largest=LARGEST),
            "dt": positive_number(self.dt, "dt", least=MIN_TIME_STEP, most=MAX_TIME_STEP),
            "horizon": whole_number(self.horizon, "horizon", 1, MAX_HORIZON),
            "margin": positive_number(self.margin, "margin", zero_allowed=True, most=LARGEST),
            "goal_radius": positive_number(self.goal_radius, "goal_radius", least=SMALLEST, most=LARGEST),
        }
        if self.goal_speed is not None:
            converted["goal_speed"] = positive_number(self.goal_speed, "goal_speed", zero_allowed=True, most=LARGEST)
        for name, value in converted.items():
            object.__setattr__(self, name, value)
        if self.horizon * team.num_robots > MAX_ROBOT_STEPS:
            most = MAX_ROBOT_STEPS // team.num_robots
            raise ValueError(
                f"horizon is {self.horizon} steps for {team.num_robots} robots; it must be at most {most} for so many"
            )
        self.check_states(self.start)
        self._check_resolution()
        self._check_turning()
        self._check_places("start", self.start[:, : team.dimension])
        self._check_places("goal", self.goal)

    def check_states(self, states: FloatArray, what: str = "start") -> None:
        """Whether robots may be in these states, wherever that is.

        Args:
            states: ``(K, n)``.
            what: What to call them in an error.

        Raises:
            ValueError: If padding is not zero, or a speed or heading too large; the message names the robot.
        """
        limits = self.team.limits
        for robot, model in enumerate(self.team.robot_models):
            state = states[robot]
            if state[model.state_size :].any():
                raise ValueError(
                    f"{what} of robot_{robot} is {state.tolist()}; a {model.name} has {model.state_size} components, "
                    f"so set the padding after them to zero"
                )
            speed = float(np.linalg.norm(state[list(model.speed_indices)])) if model.speed_indices else 0.0
            limit = float(np.asarray(self.team.max_speed)[robot])
            if speed > limit * (1 + 1e-5):
                raise ValueError(f"{what} speed of robot_{robot} is {speed:g} m/s, above its limit of {limit:g} m/s")
            for index, column in model.state_limits:
                value, limit = float(state[index]), float(limits[robot, column])
                if abs(value) > limit * (1 + 1e-5):
                    raise ValueError(
                        f"{what} {model.state_names[index]} of robot_{robot} is {value:g}, "
                        f"above its {model.limit_names[column]} of {limit:g}"
                    )
            heading = 0.0 if model.heading_index is None else float(state[model.heading_index])
            if abs(heading) > MAX_HEADING:
                raise ValueError(
                    f"{what} heading of robot_{robot} is {heading:g} rad; it must be at most {MAX_HEADING:g} in "
                    f"magnitude, so take whole turns off"
                )

    def _check_resolution(self) -> None:
        """float32 tells places apart that the goal radius, and a step of a robot, tell apart."""
        places = np.concatenate([self.start[:, : self.dimension], self.goal], axis=1)
        farthest = np.abs(places).max(axis=1)
        grain = np.spacing(farthest).astype(np.float64)
        stride = np.asarray(self.team.max_speed, np.float64) * self.dt
        for robot in range(self.num_robots):
            where = f"robot_{robot} starts or ends at a coordinate of {farthest[robot]:g} m, where float32 resolves "
            if RESOLUTION * grain[robot] > self.goal_radius:
                raise ValueError(
                    f"{where}{grain[robot]:.2g} m, more than 1/{RESOLUTION} of the goal radius of {self.goal_radius:g} "
                    f"m; move the problem nearer to the origin, or use a larger goal_radius"
                )
            if STEP_RESOLUTION * grain[robot] > stride[robot]:
                raise ValueError(
                    f"{where}{grain[robot]:.2g} m, and moves at most {stride[robot]:.2g} m in a step of {self.dt:g} s; "
                    f"move the problem nearer to the origin, or use a larger dt or max_speed"
                )

    def _check_turning(self) -> None:
        """One step of RK4 follows every robot that turns as fast as it may."""
        team_limits = self.team.limits
        for robot, model in enumerate(self.team.robot_models):
            if model.heading_index is None:
                continue
            speed = float(team_limits[robot, SPEED])
            angle = model.turn_rate(team_limits[robot]) * self.dt
            error = speed * self.dt * angle**4 / 2880
            if error > INTEGRATION_ERROR:
                raise ValueError(
                    f"robot_{robot} may turn by {angle:.3g} rad in a step of {self.dt:g} s, and at {speed:g} m/s one "
                    f"step of RK4 may then be {error:.2g} m off (most: {INTEGRATION_ERROR:g} m); use a smaller dt, "
                    f"{_turning_limits(model)} or max_speed"
                )

    def _check_places(self, what: str, places: FloatArray) -> None:
        """Every start, or every goal, lies inside the world and touches nothing."""
        radius = np.asarray(self.team.radius, np.float64)
        clearance = self.world.clearance(places) - radius
        for robot in np.flatnonzero(clearance <= 0):
            raise ValueError(
                f"{what} of robot_{robot} at {_point(places[robot])} is {0 - clearance[robot]:.3g} m inside an "
                f"obstacle or outside the bounds (robot radius {radius[robot]:g} m); move it, or change the world"
            )
        points = places.astype(np.float64)
        for later in range(1, len(points)):
            gaps = np.linalg.norm(points[:later] - points[later], axis=1) - radius[:later] - radius[later]
            other = int(np.argmin(gaps))
            if gaps[other] <= 0:
                raise ValueError(
                    f"{what}s of robot_{other} at {_point(points[other])} and robot_{later} at {_point(points[later])} "
                    f"overlap by {0 - gaps[other]:.3g} m; move them more than {radius[later] + radius[other]:g} m apart"
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

    @cached_property
    def arrays(self) -> ProblemArrays:
        """The problem as the engines read it."""
        goal_speed = np.inf if self.goal_speed is None else self.goal_speed
        arrays = ProblemArrays(
            model_codes=np.array([MODEL_CODES[name] for name in self.team.models], np.int32),
            limits=self.team.limits,
            radius=np.asarray(self.team.radius),
            start=self.start,
            goal=self.goal,
            inverse_initial_distance=inverse_initial_distance(
                self.start[:, : self.dimension], self.goal, self.goal_radius
            ),
            boxes=self.world.shapes.boxes,
            triangles=self.world.shapes.triangles,
            index=self.world.index(float(self.team.radius.max()) + self.margin),
            bounds=self.world.bounds,
            time_step=np.array([self.dt, self.dt / 2, self.dt / 3, self.dt / 6], np.float32),
            margin=np.float32(self.margin),
            squared_goal_radius=np.float32(self.goal_radius * self.goal_radius),
            squared_goal_speed=np.float32(goal_speed * goal_speed),
        )
        for array in arrays:
            if isinstance(array, np.ndarray):
                array.setflags(write=False)
        return arrays

    def arrays_to_observe(self, num_obstacles: int) -> ProblemArrays:
        """:attr:`arrays` with an index that finds so many of the nearest obstacles of any place."""
        index = self.world.index(float(self.team.radius.max()) + self.margin, max(num_obstacles, 1))
        return self.arrays._replace(index=index)

    @cached_property
    def ways(self) -> Ways:
        """The shortest free way of every robot; see :func:`d4orm_env.ways.shortest_ways`."""
        # The one road up from here: it is compiled.
        from d4orm_env.ways import shortest_ways

        return shortest_ways(self)

    def check_reachable(self) -> None:
        """Whether every robot has a way to its goal that keeps its radius and the margin from obstacles and bounds.

        Other robots do not count. It takes a wavefront for every robot, which is why construction does not ask.

        Raises:
            ValueError: If one has none; the message names all of those.
        """
        robots = np.flatnonzero(np.isinf(self.ways.length))
        if len(robots):
            names = ", ".join(f"robot_{robot}" for robot in robots)
            reach = sorted({f"{radius + self.margin:.4g}" for radius in np.asarray(self.team.radius)[robots]})
            raise ValueError(
                f"{names} {'has' if len(robots) == 1 else 'have'} no way from start to goal that is "
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
        world = self.world
        obstacles = (world.balls, world.cylinders, world.boxes, *world.polygons)
        for value in (*arrays[:6], *obstacles, *arrays[9:]):
            array: NDArray[Any] = np.ascontiguousarray(value)
            sha.update(f"{array.shape}{array.dtype}".encode())
            sha.update(array.tobytes())
        sha.update(f"{self.dt!r} {self.horizon} {self.margin!r} {self.goal_radius!r} {self.goal_speed!r}".encode())
        return sha.hexdigest()

    def __getstate__(self) -> dict[str, Any]:
        # What is cached is made anew in a copy.
        return {attribute.name: getattr(self, attribute.name) for attribute in fields(self)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        restore_frozen(self, state)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Problem) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)

    def replace(self, **changes: Any) -> Problem:
        """A copy with some attributes changed, checked again."""
        return Problem(**{attribute.name: getattr(self, attribute.name) for attribute in fields(self)} | changes)

    def moment(self, start: Any, goal: Any, **changes: Any) -> Problem:
        """The same team in the same world at another moment, for planning on from there.

        Unlike :meth:`replace` it does not check what is changed: under way robots may touch, be faster than they
        should, or head for places that they cannot all be at.

        Args:
            start: ``(K, n)`` states.
            goal: ``(K, d)`` places to go to [m].
            **changes: Other attributes that differ, of the right type.
        """
        start = frozen_array(start, "start", self.start.shape)
        return self._unchecked(start=start, goal=frozen_array(goal, "goal", self.goal.shape), **changes)

    def select(self, robots: Sequence[int]) -> Problem:
        """The problem of these robots only, in the order given."""
        index = list(robots)
        team = self.team.select(index)
        return self._unchecked(team=team, start=self.start[index, : team.state_size], goal=self.goal[index])

    def _unchecked(self, **changes: Any) -> Problem:
        copy: Problem = object.__new__(Problem)
        restore_frozen(copy, self.__getstate__() | changes)
        return copy


def inverse_initial_distance(positions: Any, goal: Any, goal_radius: float) -> FloatArray:
    """``(K,)`` one over the start distance; a robot that starts at its goal counts from the goal radius."""
    distance = np.linalg.norm(np.asarray(goal) - np.asarray(positions), axis=-1)
    return (1.0 / np.maximum(distance, goal_radius)).astype(np.float32)


def _turning_limits(model: Model) -> str:
    """The limits to lower where a robot turns too fast."""
    if TURN_RATE in model.control_limits:
        return STANDARD_LIMITS[TURN_RATE]
    return ", ".join(model.limit_names[column] for _, column in model.state_limits) or "limits"


def _point(place: Any) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in place) + ")"
