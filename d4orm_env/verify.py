"""The independent judge of plans: float64, sub-stepped, continuous in time, in plain NumPy.

It shares no code with the engines: of the problem it reads data only, and the models, the integration, the docking and
the distances are written again here, so that a mistake in the physics of the engines does not excuse itself.

Within a control step holonomic robots move on parabolas, integrated in closed form; the heading and speed of a
differential drive are linear in time and its position is their Simpson quadrature. The motion is then cut into
sub-steps so short that each curve departs from its chord by at most ``CHORD_ERROR``, and on the chords the closest
approach is solved exactly. Models, limits and docking: paper, sections III and IV-B; contact: paper, Eq. 1.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from d4orm_env.core.problem import Problem
    from d4orm_env.core.world import World

MIN_SUB_STEPS = 10
CHORD_ERROR = 1e-5
"""Largest distance between a robot's curve and the chord that stands for it [m]."""
LIMIT_TOLERANCE = 1e-5
"""Relative excess over a control limit that float32 rounding may cause."""
DOCKING_TOLERANCE = 1e-5
"""Added to the goal radius [m] and the goal speed [m/s], since the engines decide docking in float32."""

Floats = NDArray[np.float64]

_MODELS = ("holonomic2d", "holonomic3d", "velocity2d", "differential_drive")
_BLOCK = 16  # sub-steps judged at once: bounds the memory, and keeps what can be ruled out by distance large
_SECTIONS = np.linspace(0.0, 1.0, 9)
_SECTION_ROUNDS = 14  # each narrows the bracket to a quarter: 4e-9 of the chord in the end


@dataclass(frozen=True)
class Violation:
    """One thing wrong with a plan.

    Attributes:
        kind: ``"robot contact"``, ``"obstacle contact"``, ``"bounds contact"``, ``"control limit"``, ``"not arrived"``
            or ``"non-finite"``.
        robots: Indices of the robots concerned.
        time: When it first happens, contacts to within a sub-step [s].
        detail: What happened, with values and units.
    """

    kind: str
    robots: tuple[int, ...]
    time: float
    detail: str

    def __str__(self) -> str:
        names = " and ".join(f"robot_{robot}" for robot in self.robots)
        return f"{self.kind} at {self.time:.3f} s, {names}: {self.detail}"


@dataclass(frozen=True, eq=False)
class VerificationReport:
    """What :func:`verify` found.

    Attributes:
        min_separation: Smallest gap between the surfaces of two robots over continuous time, negative where they
            overlap [m]; infinite for one robot, NaN when controls are not finite.
        min_clearance: Smallest gap from a robot's surface to an obstacle or the bounds, negative inside [m]; infinite
            in an empty open world, NaN when controls are not finite.
        arrival_times: ``(K,)`` when each robot docked [s]; infinite for one that never did.
        violations: Everything wrong, by time; one entry for each pair, robot and obstacle, robot and side of the
            bounds, or robot and limit.
    """

    min_separation: float
    min_clearance: float
    arrival_times: Floats
    violations: list[Violation]

    @property
    def ok(self) -> bool:
        """Whether nothing is wrong."""
        return not self.violations


def verify(problem: Problem, controls: Any) -> VerificationReport:
    """Judge a plan: do all robots arrive by the horizon, within their limits, touching nothing at any time?

    Contact is judged, not the safety margin: it is a gap of zero or less at any moment, also between steps, known to
    ``CHORD_ERROR`` for each moving robot. Controls above the limits are reported, and clipped before they are executed,
    as the robot would. Docking is decided at the end of each step; from then on the robot stands where it is and its
    controls are ignored. Controls that are not finite define no motion: they are reported, and nothing else is judged.

    Args:
        problem: The problem the plan is for.
        controls: ``(H, K, m)``, each held constant over ``problem.dt``.

    Returns:
        The report; ``report.ok`` when there are no violations.

    Raises:
        ValueError: If the controls are not numbers or their shape is another, or a model is unknown here.
    """
    array = _checked_controls(problem, controls)
    num_robots = len(problem.team.models)
    if not np.isfinite(array).all():
        return VerificationReport(np.nan, np.nan, np.full(num_robots, np.inf), _non_finite(array, problem.dt))
    team = _Team(problem)
    commands, sizes = team.clip(array)
    pairs, surroundings = _Round(team.radius), _surroundings(problem.world, team.radius)
    arrival_times = np.full(num_robots, np.inf)
    for step, command in enumerate(commands):
        path, sub_step = team.advance(command)
        for first in range(0, len(path) - 1, _BLOCK):
            clock = _Clock(step * problem.dt + first * sub_step, sub_step)
            for watch in (pairs, *surroundings):
                watch.observe(path[first : first + _BLOCK + 1], clock)
        arrival_times[team.dock()] = (step + 1) * problem.dt
    violations = [
        *_control_limits(team, sizes, arrival_times),
        *(violation for watch in (pairs, *surroundings) for violation in watch.violations()),
        *_not_arrived(team, arrival_times),
    ]
    return VerificationReport(
        pairs.minimum,
        min((watch.minimum for watch in surroundings), default=np.inf),
        arrival_times,
        sorted(violations, key=lambda violation: violation.time),
    )


def _checked_controls(problem: Problem, controls: Any) -> Floats:
    for robot, name in enumerate(problem.team.models):
        if name not in _MODELS:
            raise ValueError(f"verify cannot judge model {name!r} of robot_{robot}; it knows {', '.join(_MODELS)}")
    try:
        array = np.asarray(controls, np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"controls must be an array of numbers, not {type(controls).__name__}") from error
    # Every model has as many controls as position dimensions.
    expected = (problem.horizon, *np.shape(problem.goal))
    if array.shape != expected:
        raise ValueError(f"controls have shape {array.shape}; expected (H, K, m) = {expected}")
    return array


def _non_finite(controls: Floats, dt: float) -> list[Violation]:
    bad: NDArray[np.bool_] = np.any(~np.isfinite(controls), axis=2)
    violations = []
    for robot in np.flatnonzero(bad.any(axis=0)):
        step = int(bad[:, robot].argmax())
        detail = f"control {controls[step, robot].tolist()} at step {step}; {bad[:, robot].sum()} steps in all"
        violations.append(Violation("non-finite", (int(robot),), step * dt, detail))
    return sorted(violations, key=lambda violation: violation.time)


@dataclass(frozen=True)
class _Clock:
    """When a block of sub-steps begins, and how long each is [s]."""

    start: float
    sub_step: float


class _Team:
    """The robots in float64, integrated one control step at a time.

    ``position`` and ``velocity`` are ``(K, d)``, ``heading`` and ``speed`` ``(K,)``. A differential drive moves by its
    heading and speed and has no velocity of its own here; a first-order robot's velocity is its last control.
    """

    def __init__(self, problem: Problem) -> None:
        team, start = problem.team, np.asarray(problem.start, np.float64)
        self.problem, self.models = problem, team.models
        self.wheeled = np.array([name == "differential_drive" for name in team.models])
        self.first_order = np.array([name == "velocity2d" for name in team.models])
        self.radius, self.max_speed, self.max_acceleration, self.max_turn_rate = (
            np.asarray(values, np.float64)
            for values in (team.radius, team.max_speed, team.max_acceleration, team.max_turn_rate)
        )
        self.goal = np.asarray(problem.goal, np.float64)
        size = self.goal.shape[1]
        self.position = start[:, :size].copy()
        self.velocity = np.zeros_like(self.position)
        self.heading, self.speed = np.zeros((2, len(start)))
        for robot, state in enumerate(start):
            if self.wheeled[robot]:
                self.heading[robot], self.speed[robot] = state[2:4]
            elif not self.first_order[robot]:
                self.velocity[robot] = state[size : 2 * size]
        self.docked = np.zeros(len(start), bool)

    def limited_quantities(self) -> tuple[Floats, list[tuple[str, ...]]]:
        """``(K, d)`` limits, and what each limits, by robot: one norm, or turn rate and acceleration on wheels."""
        limits = np.ones(self.goal.shape)  # a column that limits nothing meets sizes of zero
        limits[:, 0] = np.where(self.first_order, self.max_speed, self.max_acceleration)
        for robot in np.flatnonzero(self.wheeled):
            limits[robot] = self.max_turn_rate[robot], self.max_acceleration[robot]
        names = {"velocity2d": ("speed [m/s]",), "differential_drive": ("turn rate [rad/s]", "acceleration [m/s^2]")}
        return limits, [names.get(name, ("acceleration [m/s^2]",)) for name in self.models]

    def clip(self, controls: Floats) -> tuple[Floats, Floats]:
        """``(H, K, d)`` controls within the limits, and the size of each limited quantity before."""
        limits, _ = self.limited_quantities()
        sizes = np.abs(controls)
        # Scaled by the largest component, so that the square of a huge control does not overflow.
        largest = np.maximum(sizes.max(axis=2), np.finfo(float).tiny)
        norms = largest * _norm(controls / largest[..., None])
        sizes[:, ~self.wheeled] = 0.0
        sizes[..., 0] = np.where(self.wheeled, sizes[..., 0], norms)
        scale = limits / np.maximum(sizes, limits)
        return controls * np.where(self.wheeled[:, None], scale, scale[..., :1]), sizes

    def advance(self, command: Floats) -> tuple[Floats, float]:
        """Move one control step under ``(K, d)`` clipped controls; ``(S+1, K, d)`` positions, and the sub-step [s]."""
        dt = self.problem.dt
        command = np.where(self.docked[:, None], 0.0, command)
        turn_rate, thrust = (np.where(self.wheeled, command[:, column], 0.0) for column in (0, 1))
        acceleration = np.where((self.wheeled | self.first_order)[:, None], 0.0, command)
        self.velocity = np.where(self.first_order[:, None], command, self.velocity)
        sideways = (np.abs(self.speed) + np.abs(thrust) * dt) * np.abs(turn_rate)
        bend = (_norm(acceleration) + np.hypot(thrust, sideways)).max()
        num = max(MIN_SUB_STEPS, int(np.ceil(dt * np.sqrt(bend / (8 * CHORD_ERROR)))))
        half = np.linspace(0.0, dt, 2 * num + 1)[:, None]  # the ends and the middles of the sub-steps
        time = half[::2, :, None]
        path = self.position + self.velocity * time + acceleration * time**2 / 2
        if self.wheeled.any():
            heading, speed = self.heading + turn_rate * half, self.speed + thrust * half
            rate = np.stack([speed * np.cos(heading), speed * np.sin(heading)], axis=2)
            path[1:] += np.cumsum(rate[:-1:2] + 4 * rate[1::2] + rate[2::2], axis=0) * (dt / num / 6)
            self.heading, self.speed = heading[-1], np.clip(speed[-1], -self.max_speed, self.max_speed)
        self.position = path[-1]
        self.velocity = self.velocity + acceleration * dt
        pace = _norm(self.velocity)
        self.velocity *= (self.max_speed / np.maximum(pace, self.max_speed))[:, None]
        return path, dt / num

    def dock(self) -> NDArray[np.bool_]:
        """Bring to rest the robots that arrive at the end of this step; ``(K,)`` which ones."""
        goal_speed = np.inf if self.problem.goal_speed is None else self.problem.goal_speed
        near = self.distance() <= self.problem.goal_radius + DOCKING_TOLERANCE
        arriving = ~self.docked & near & (self.pace() <= goal_speed + DOCKING_TOLERANCE)
        self.docked = self.docked | arriving
        self.velocity[arriving], self.speed[arriving] = 0.0, 0.0
        return arriving

    def distance(self) -> Floats:
        """``(K,)`` distance to the goal [m]."""
        return _norm(self.position - self.goal)

    def pace(self) -> Floats:
        """``(K,)`` magnitude of the velocity [m/s]."""
        pace: Floats = np.where(self.wheeled, np.abs(self.speed), _norm(self.velocity))
        return pace


def _control_limits(team: _Team, sizes: Floats, arrival_times: Floats) -> Iterator[Violation]:
    """Controls above a limit before docking, one entry for each robot and limit."""
    limits, names = team.limited_quantities()
    dt = team.problem.dt
    before_docking = np.arange(len(sizes))[:, None] * dt < arrival_times - dt / 2
    over = (sizes > limits * (1 + LIMIT_TOLERANCE)) & before_docking[..., None]
    for robot, column in np.argwhere(over.any(axis=0)):
        steps = np.flatnonzero(over[:, robot, column])
        values = sizes[steps, robot, column]
        detail = (
            f"{names[robot][column]} of the control is {values[0]:.7g} at step {steps[0]}, "
            f"limit {limits[robot, column]:.7g}; {len(steps)} steps over it, at most {values.max():.7g}"
        )
        yield Violation("control limit", (int(robot),), float(steps[0] * dt), detail)


def _not_arrived(team: _Team, arrival_times: Floats) -> Iterator[Violation]:
    problem, distance, pace = team.problem, team.distance(), team.pace()
    for robot in np.flatnonzero(np.isinf(arrival_times)):
        detail = f"{distance[robot]:.4g} m from its goal (goal radius {problem.goal_radius:g} m) at the horizon"
        if problem.goal_speed is not None:
            detail += f", at {pace[robot]:.4g} m/s (goal speed {problem.goal_speed:g} m/s)"
        yield Violation("not arrived", (int(robot),), problem.dt * problem.horizon, detail)


class _Watch(ABC):
    """Closest approach and first contact of every robot (rows) with every body or bound (columns)."""

    def __init__(self, kind: str, radius: Floats, names: Sequence[str]) -> None:
        self.kind, self.radius, self.names = kind, radius, names
        self.minimum = np.inf
        self.smallest, self.smallest_time, self.first = (np.full((len(radius), len(names)), np.inf) for _ in range(3))

    @abstractmethod
    def observe(self, path: Floats, clock: _Clock) -> None:
        """Judge the ``(S+1, K, d)`` positions of a block, and the chords between them."""

    def nearby(self, gap: Floats, reach: Floats) -> tuple[Any, ...]:
        """Rows and columns that may touch, or come closer than any so far, starting ``gap`` apart and moving ``reach``.

        A chord cannot leave the ball around the block's start that holds its vertices, so nothing is missed.
        """
        self.minimum = min(self.minimum, float(gap.min(initial=np.inf)))
        return np.nonzero(gap - reach < max(self.minimum, 0.0) + 1e-9)

    def record(self, rows: Any, columns: Any, gap: Floats, fraction: Floats, clock: _Clock) -> None:
        """Take note of ``(S, C)`` smallest gaps of the sub-steps, reached at that fraction of them."""
        time = clock.start + (np.arange(len(gap))[:, None] + fraction) * clock.sub_step
        self.minimum = min(self.minimum, float(gap.min()))
        each = np.arange(gap.shape[1])
        lowest = gap.argmin(axis=0)
        closer = gap[lowest, each] < self.smallest[rows, columns]
        self.smallest[rows[closer], columns[closer]] = gap[lowest, each][closer]
        self.smallest_time[rows[closer], columns[closer]] = time[lowest, each][closer]
        touching = gap <= 0
        hit = touching.any(axis=0)
        moment = time[touching.argmax(axis=0), each][hit]
        self.first[rows[hit], columns[hit]] = np.minimum(self.first[rows[hit], columns[hit]], moment)

    def violations(self) -> Iterator[Violation]:
        for row, column in np.argwhere(np.isfinite(self.first)):
            robots = (int(row), int(column)) if self.kind == "robot contact" else (int(row),)
            gap, time = self.smallest[row, column], self.smallest_time[row, column]
            detail = f"touches {self.names[column]}, smallest gap {gap:.4g} m at {time:.3f} s"
            yield Violation(self.kind, robots, float(self.first[row, column]), detail)


class _Round(_Watch):
    """Robots against each other, or against circles, spheres and vertical cylinders."""

    def __init__(self, radius: Floats, obstacles: Floats | None = None, shape: str = "") -> None:
        if obstacles is None:
            super().__init__("robot contact", radius, [f"robot_{robot}" for robot in range(len(radius))])
            # Each pair once, and no robot with itself.
            self.size, self.centres = np.where(np.tri(len(radius), dtype=bool), -np.inf, radius), None
        else:
            super().__init__("obstacle contact", radius, [f"{shape}[{index}]" for index in range(len(obstacles))])
            self.size = np.tile(obstacles[:, -1], (len(radius), 1))
            self.centres = obstacles[:, :-1]

    def observe(self, path: Floats, clock: _Clock) -> None:
        if self.centres is None:
            bodies = path
        else:
            path = path[..., : self.centres.shape[1]]  # a cylinder is a circle seen from above
            bodies = np.broadcast_to(self.centres, (len(path), *self.centres.shape))
        reach = _reach(path)[:, None] + _reach(bodies)
        size = self.radius[:, None] + self.size
        gap = _norm(path[0][:, None] - bodies[0]) - size
        rows, columns = self.nearby(gap, reach)
        if len(rows) == 0:
            return
        relative = path[:, rows] - bodies[:, columns]
        distance, fraction = _closest_approach(relative[:-1], relative[1:])
        self.record(rows, columns, distance - size[rows, columns], fraction, clock)


class _Boxes(_Watch):
    """Robots against axis-aligned boxes."""

    def __init__(self, radius: Floats, boxes: Floats) -> None:
        super().__init__("obstacle contact", radius, [f"boxes[{index}]" for index in range(len(boxes))])
        self.boxes = boxes

    def observe(self, path: Floats, clock: _Clock) -> None:
        gap = _box_distance(path[0][:, None], self.boxes) - self.radius[:, None]
        rows, columns = self.nearby(gap, _reach(path)[:, None])
        if len(rows) == 0:
            return
        start, end = path[:-1, rows], path[1:, rows]
        distance, fraction = _box_approach(start, end, self.boxes[columns])
        self.record(rows, columns, distance - self.radius[rows], fraction, clock)


class _Bounds(_Watch):
    """Robots against the sides of the world."""

    def __init__(self, radius: Floats, lower: Floats, upper: Floats) -> None:
        axes = "xyz"[: len(lower)]
        names = [f"the {side} bound of {axis}" for side in ("lower", "upper") for axis in axes]
        super().__init__("bounds contact", radius, names)
        self.lower, self.upper = lower, upper

    def observe(self, path: Floats, clock: _Clock) -> None:
        gap = np.concatenate([path - self.lower, self.upper - path], axis=2) - self.radius[:, None]
        gap = gap.reshape(len(path), -1)  # linear on a chord, so the ends suffice
        rows, columns = (index.ravel() for index in np.indices((len(self.radius), len(self.names))))
        fraction = (gap[1:] < gap[:-1]).astype(np.float64)
        self.record(rows, columns, np.minimum(gap[:-1], gap[1:]), fraction, clock)


def _surroundings(world: World, radius: Floats) -> list[_Watch]:
    """What watches for each kind of obstacle there is, and for the bounds."""
    watches: list[_Watch] = []
    for shape in ("circles", "spheres", "cylinders"):
        obstacles = np.asarray(getattr(world, shape), np.float64)
        if len(obstacles):
            watches.append(_Round(radius, obstacles, shape))
    if len(world.boxes):
        watches.append(_Boxes(radius, np.asarray(world.boxes, np.float64)))
    if world.lower is not None:
        watches.append(_Bounds(radius, np.asarray(world.lower, np.float64), np.asarray(world.upper, np.float64)))
    return watches


def _reach(path: Floats) -> Floats:
    """How far from its start a body gets at the vertices of its path."""
    reach: Floats = _norm(path - path[0]).max(axis=0)
    return reach


def _closest_approach(start: Floats, end: Floats) -> tuple[Floats, Floats]:
    """Smallest distance to the origin of points moving from ``start`` to ``end``, and at what fraction of the way."""
    move = end - start
    square = _dot(move, move)
    fraction = np.clip(-_dot(start, move) / np.where(square > 0, square, 1.0), 0.0, 1.0)
    return _norm(start + fraction[..., None] * move), fraction


def _dot(a: Floats, b: Floats) -> Floats:
    product: Floats = np.einsum("...i,...i->...", a, b)
    return product


def _norm(a: Floats) -> Floats:
    norm: Floats = np.sqrt(_dot(a, a))
    return norm


def _box_distance(points: Floats, boxes: Floats) -> Floats:
    """Distance from points to the surface of boxes, negative inside; the last axes broadcast, coordinates last."""
    size = points.shape[-1]
    square, deepest = np.zeros(()), np.full((), -np.inf)
    for axis in range(size):  # far quicker than reductions over an axis of two or three
        x = points[..., axis]
        outside = np.maximum(boxes[..., axis] - x, x - boxes[..., size + axis])
        square = square + np.maximum(outside, 0.0) ** 2
        deepest = np.maximum(deepest, outside)
    distance: Floats = np.sqrt(square) + np.minimum(deepest, 0.0)
    return distance


def _box_approach(start: Floats, end: Floats, boxes: Floats) -> tuple[Floats, Floats]:
    """As :func:`_closest_approach`, for the signed distance to boxes.

    That distance is convex along a chord, so its minimum lies next to the best of any grid of points: a search in ever
    finer grids brackets it without fail.
    """
    lower, width = np.zeros(start.shape[:-1]), 1.0
    for _ in range(_SECTION_ROUNDS):
        fraction = np.minimum(lower + width * _SECTIONS.reshape(-1, *[1] * lower.ndim), 1.0)
        distance = _box_distance(start + fraction[..., None] * (end - start), boxes)
        best = np.take_along_axis(fraction, distance.argmin(axis=0)[None], axis=0)[0]
        width /= (len(_SECTIONS) - 1) / 2
        lower = np.maximum(best - width / 2, 0.0)
    return distance.min(axis=0), best
