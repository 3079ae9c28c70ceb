"""Edits of a scene, functions from a problem, whose start is where the robots are now, to another; and their queue.

All edits raise a ``ValueError`` of one line where the scene would make no sense; it then stays as it is.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial, wraps
from typing import Any, Concatenate, ParamSpec

import numpy as np
from numpy.typing import ArrayLike

from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.gaps import gaps_at
from d4orm_env.core.goal_poses import states_at_goals
from d4orm_env.core.problem import Problem
from d4orm_env.core.problem_checks import check_resolution
from d4orm_env.envs.lifelong import goal_region

Edit = Callable[[Problem], Problem]
MOST_ROBOTS, MOST_OBSTACLES = 200, 500  #: A slip of the finger must not fill the page
_ATTEMPTS = 500
KINDS = ("circles", "spheres", "cylinders", "boxes", "polygons")


def move_goal(problem: Problem, robot: int, position: ArrayLike) -> Problem:
    """Send a robot elsewhere: ``position`` ``(d,)`` [m]."""
    check_robot(problem, robot)
    goal = np.array(problem.goal)
    goal[robot] = position
    return _checked(problem.with_state(problem.start, goal), "the goal", robot)


def move_robot(problem: Problem, robot: int, position: ArrayLike) -> Problem:
    """Put a robot elsewhere, at rest: ``position`` ``(d,)`` [m]."""
    check_robot(problem, robot)
    start = np.array(problem.start)
    start[robot, : problem.dimension] = position
    _stop(problem, start, robot)
    return _checked(problem.with_state(start, problem.goal), "the robot", robot)


def check_robot(problem: Problem, robot: int) -> None:
    """Refuse a robot that was taken away while it was dragged."""
    if not 0 <= robot < problem.num_robots:
        raise ValueError(f"robot_{robot} is not there any more; take another")


def at_rest(problem: Problem) -> Problem:
    """The scene with all robots at rest, as files have it."""
    start = np.array(problem.start)
    for robot in range(problem.num_robots):
        _stop(problem, start, robot)
    return problem.with_state(start, problem.goal)


def _stop(problem: Problem, states: FloatArray, robot: int) -> None:
    """Bring a robot to rest in ``states`` ``(K, n)``."""
    model = problem.team.robot_models[robot]
    own = tuple(float(value) for value in states[robot, : model.state_size])
    states[robot, : model.state_size] = model.functions.rest(own, 0.0)


def add_robot(problem: Problem, random: np.random.Generator) -> Problem:
    """One more robot, like the first, with a random start and goal."""
    count = problem.num_robots
    if count >= MOST_ROBOTS:
        raise ValueError(f"there are {count} robots, which is the most here; remove one first")
    positions = np.vstack([problem.start[:, : problem.dimension], _free_position(problem, problem.start, random)])
    goals = np.vstack([problem.goal, _free_position(problem, problem.goal, random)])
    start = np.zeros((count + 1, problem.start.shape[1]), np.float32)
    start[:count] = problem.start
    start[count, : problem.dimension] = positions[count]
    changed = problem.select([*range(count), 0])
    return changed.with_state(start, goals)


def remove_robot(problem: Problem) -> Problem:
    """One robot fewer: the last one leaves."""
    if problem.num_robots == 1:
        raise ValueError("the last robot stays; load another scene to begin anew")
    return problem.select(range(problem.num_robots - 1))


def add_obstacle(problem: Problem, kind: str, random: np.random.Generator) -> Problem:
    """One more obstacle, a ``"disc"`` or a ``"box"`` of 0.4 m, where there is room."""
    world, clearance = problem.world, 0.3
    if world.num_obstacles >= MOST_OBSTACLES:
        raise ValueError(f"there are {world.num_obstacles} obstacles, which is the most here; remove one first")
    taken = np.vstack([problem.start[:, : problem.dimension], problem.goal])
    position = _free_position(problem, taken, random, clearance + float(np.max(problem.team.radius)))
    if kind == "box":
        return _with_world(problem, boxes=[*world.boxes, [*(position - 0.2), *(position + 0.2)]])
    name = "circles" if problem.dimension == 2 else "spheres"
    return _with_world(problem, **{name: [*getattr(world, name), [*position, 0.2]]})


def remove_obstacle(problem: Problem) -> Problem:
    """One obstacle fewer: the last one of its kind."""
    for kind in reversed(KINDS):
        shapes = getattr(problem.world, kind)
        if len(shapes):
            return _with_world(problem, **{kind: shapes[:-1]})
    raise ValueError("there is no obstacle to remove")


def move_obstacle(problem: Problem, kind: str, index: int, shift: ArrayLike) -> Problem:
    """Move an obstacle by ``shift`` ``(d,)`` [m]."""
    by, d = np.asarray(shift, np.float32), problem.dimension
    shapes = [np.array(shape) for shape in getattr(problem.world, kind)]
    if not 0 <= index < len(shapes):
        raise ValueError("the obstacle is not there any more; take another")
    if kind == "boxes":
        shapes[index] = shapes[index] + np.tile(by, 2)
    elif kind == "polygons":
        shapes[index] = shapes[index] + by
    else:
        axes = 2 if kind == "cylinders" else d
        shapes[index][:axes] += by[:axes]
    return _with_world(problem, **{kind: shapes})


def followed(before: Problem, after: Problem, other: Problem, who: str) -> Problem:
    """Another team's scene changed as this one was: what was moved, added or removed is, all else stays."""
    kept = min(before.num_robots, after.num_robots)
    positions, moved = [], []
    for former, new, others in zip(_positions(before), _positions(after), _positions(other)):
        same = (new[:kept] == former[:kept]).all(axis=1)
        new[:kept][same] = others[:kept][same]
        positions.append(new)
        moved.append([*np.flatnonzero(~same), *range(kept, len(new))])
    changed = after.with_state(*positions)
    try:
        for what, robots in zip(("the robot", "the goal"), moved):
            for robot in robots:
                _checked(changed, what, int(robot))
        if after.world is not before.world:
            _check_world(changed)
    except ValueError as error:
        raise ValueError(f"{who}: {error}") from None
    return changed


def _positions(problem: Problem) -> tuple[FloatArray, FloatArray]:
    return np.array(problem.start), np.array(problem.goal)


def _with_world(problem: Problem, **changes: object) -> Problem:
    changed = problem.with_state(problem.start, problem.goal, world=problem.world.replace(**changes))
    _check_world(changed)
    return changed


def _check_world(problem: Problem) -> None:
    team, world, d = problem.team, problem.world, problem.dimension
    for what, states in (("robot", problem.start), ("goal of robot", states_at_goals(problem))):
        gap = gaps_at(team, team.body_poses(states), world)
        for robot in np.flatnonzero(world.clearance(states[:, :d]) <= team.radius).tolist():
            if gap(robot, robot) <= 0:
                raise ValueError(f"the obstacle would touch the {what}_{robot}; put it elsewhere")


def _checked(problem: Problem, what: str, robot: int) -> Problem:
    """The problem, refused if ``"the robot"``, or ``"the goal"``, of a robot touches something."""
    states = problem.start if what == "the robot" else states_at_goals(problem)
    team, positions = problem.team, states[:, : problem.dimension]
    check_resolution(team, positions, problem.dt, problem.goal_radius)
    gap = gaps_at(team, team.body_poses(states), problem.world)
    if problem.world.clearance(positions[robot]) <= team.radius[robot] and gap(robot, robot) <= 0:
        raise ValueError(f"{what} of robot_{robot} would touch an obstacle or the bounds; it stays where it was")
    outer = np.linalg.norm(positions - positions[robot], axis=1) - team.radius - team.radius[robot]
    outer[robot] = np.inf
    for other in np.flatnonzero(outer <= 0).tolist():
        if gap(robot, other) <= 0:
            raise ValueError(f"{what} of robot_{robot} would touch that of robot_{other}; it stays where it was")
    return problem


def _free_position(
    problem: Problem, taken: ArrayLike, random: np.random.Generator, clearance: float | None = None
) -> FloatArray:
    """``(d,)`` a random position with room for a robot of the first one's size among ``taken`` ``(N, d or more)``."""
    others = np.asarray(taken, np.float32)[:, : problem.dimension]
    room = float(problem.team.wall_radius[0]) + problem.margin if clearance is None else clearance
    clearance = float(problem.team.radius[0]) + problem.margin if clearance is None else clearance
    distance = clearance + float(np.max(problem.team.radius))
    low, high = goal_region(problem)
    for _ in range(_ATTEMPTS):
        position = random.uniform(low, high).astype(np.float32)
        if problem.world.clearance(position) > room and (np.linalg.norm(others - position, axis=1) > distance).all():
            return position
    raise ValueError("there is no room for one more; remove something first")


P = ParamSpec("P")
Command = Callable[[], None]
MOST_WAITING = 100  #: Commands; more than that come from no hand


class CommandQueue:
    """Commands from any threads for one that executes them, until it is ``closed``."""

    def __init__(self) -> None:
        self._waiting: dict[object, Command] = {}
        self._changed = threading.Condition()
        self.closed, self._dropped = False, 0

    def put(self, command: Command, setting: str | None = None) -> None:
        """Add a command; it takes the place of one for the same setting that waits. Beyond so many it is dropped."""
        with self._changed:
            self._waiting.pop(setting, None)
            if len(self._waiting) < MOST_WAITING:
                self._waiting[setting or object()] = command
            else:
                self._dropped += 1
            self._changed.notify_all()

    def take(self) -> Command | None:
        """The command that has waited longest; ``None`` where there is none, or the queue is closed."""
        with self._changed:
            if self.closed or not self._waiting:
                return None
            return self._waiting.pop(next(iter(self._waiting)))

    def dropped(self) -> int:
        """Return the number dropped since this was last asked."""
        with self._changed:
            dropped, self._dropped = self._dropped, 0
        return dropped

    def wait(self, timeout: float) -> None:
        """Until there is a command, the queue is closed, or so many seconds have passed."""
        with self._changed:
            self._changed.wait_for(lambda: self.closed or self._waiting, timeout)

    def close(self) -> None:
        """Wake waiting calls; there is nothing to take any more."""
        with self._changed:
            self.closed = True
            self._changed.notify_all()

    @property
    def empty(self) -> bool:
        """True if no command waits."""
        return not self._waiting


def queued(
    setting: str | None = None,
) -> Callable[[Callable[Concatenate[Any, P], None]], Callable[Concatenate[Any, P], None]]:
    """Have calls of a method wait among its object's ``commands``; of one setting the last call counts."""

    def decorate(method: Callable[Concatenate[Any, P], None]) -> Callable[Concatenate[Any, P], None]:
        @wraps(method)
        def put(owner: Any, /, *arguments: P.args, **keywords: P.kwargs) -> None:
            owner.commands.put(partial(method, owner, *arguments, **keywords), setting)

        return put

    return decorate
