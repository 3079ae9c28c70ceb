"""Verdict on a team's motion that is given as curves."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from d4orm_env.core import portable
from d4orm_env.verify.contact import MAX_NUMBERS, Stretch
from d4orm_env.verify.docking import HEADING_DOUBT, heading_errors, heading_note
from d4orm_env.verify.footprints import make_watches
from d4orm_env.verify.geometry import ConvexBodies, Floats, Indices, norm
from d4orm_env.verify.report import VerificationReport, Violation

if TYPE_CHECKING:
    from d4orm_env.core.problem import Problem

CHORD_ERROR = 1 / 15_000
"""Largest distance between a curve and the chord that stands for it, as a share of the robot's radius."""
HITCH_TOLERANCE = 0.02
"""Share by which a trailer may exceed its largest hitch angle: beyond, it is not towed but pushed aside."""


def verify_curves(
    problem: Problem,
    position: Callable[[Floats], Floats],
    duration: float,
    bend: Floats,
    heading: Callable[[Floats], Floats],
) -> VerificationReport:
    """Judge curves: do all robots end at their goals, and touch nothing at any time?

    As :func:`d4orm_env.verify.verify` judges controls, known to ``CHORD_ERROR`` of the radius for each robot. Trailers
    are towed, from their hitch angles at the start. At the end positions, headings and hitch angles must be those of
    the goals, however fast a robot comes there. Of control limits it says nothing, nor when robots arrive.

    Args:
        problem: The team and its world; its dynamics do not count.
        position: ``(T,)`` times from 0 to ``duration`` [s] to ``(T, K, d)`` positions [m].
        duration: When the motion ends [s].
        bend: ``(K,)`` bound on the acceleration of any point of each robot [m/s^2].
        heading: ``(T,)`` times to ``(T, K)`` headings [rad].
    """
    team, radius = problem.team, problem.team.radius.astype(np.float64)
    steps = max(1, int(np.ceil(duration / problem.dt)))
    dt = duration / steps
    sub_steps = max(1, int(np.ceil(dt * np.sqrt(bend / (8 * CHORD_ERROR * team.girth.astype(np.float64)))).max()))
    trailers, shapes = _Trailers.of(problem), ConvexBodies.of(team) if team.shapes else None
    robots = np.concatenate([np.arange(len(radius)), trailers.robot])
    pairs, obstacles = make_watches(problem.world, robots, radius, shapes)
    watches = [pairs, *obstacles]
    grid = np.arange(steps)[:, None] * sub_steps + np.arange(sub_steps + 1)

    def poses(samples: Indices) -> tuple[Floats, Floats]:
        times = samples.ravel().astype(np.float64) * (dt / sub_steps)
        path = position(times).reshape(*samples.shape, len(radius), problem.dimension)
        return path, heading(times).reshape(*samples.shape, len(radius))

    (end,), last = (rows(np.array([duration])) for rows in (position, heading))
    violations, towed = [], None
    if len(trailers.robot):
        *towed, hitches = trailers.tow(*poses(np.arange(steps * sub_steps + 1)))
        violations, last = list(trailers.violations(hitches, dt / sub_steps)), towed[1][-1:]
    violations += _not_arrived(problem, end, heading_errors(problem, last)[0], duration)
    size = max(1, MAX_NUMBERS // ((2 * sub_steps + 1) * len(radius) * problem.dimension))
    for first in range(0, steps, size):
        samples = grid[first : first + size]
        path, turn = poses(samples) if towed is None else (part[samples] for part in towed)
        for watch in watches:
            watch.observe(Stretch(path, _travel(path, turn, shapes), first * dt, dt, turn))
    violations += [violation for watch in watches for violation in watch.violations()]
    nearest = min((watch.minimum for watch in obstacles), default=np.inf)
    unknown = np.full(len(radius), np.nan)
    return VerificationReport(
        pairs.minimum, nearest, unknown, unknown, True, sorted(violations, key=lambda violation: violation.time)
    )


def _travel(path: Floats, turn: Floats, shapes: ConvexBodies | None) -> Floats:
    """``(T, B)`` by how much gaps may change within each step [m]."""
    travel = norm(path - path[:, :1]).max(axis=1)
    if shapes is None:
        return travel
    return shapes.stretch * (travel + shapes.outer * np.abs(turn - turn[:, :1]).max(axis=1))


@dataclass(frozen=True, eq=False)
class _Trailers:
    """The trailers of a team, robot by robot: what curves say of them by towing them."""

    robot: Indices  #: ``(J,)``
    order: Indices  #: ``(J,)`` how many trailers a robot pulls before it
    initial: Floats  #: ``(J,)`` hitch angles at the start [rad]
    most: Floats  #: ``(J,)`` largest hitch angles [rad]
    length: Floats  #: ``(J,)`` of the hitches [m]

    @classmethod
    def of(cls, problem: Problem) -> _Trailers:
        rows = [
            (robot, order, problem.start[robot, state], limits[dict(model.state_limits)[state]], limits[column])
            for robot, (model, limits) in enumerate(zip(problem.team.robot_models, problem.team.limits, strict=True))
            for order, (state, column) in enumerate(model.trailers)
        ]
        robot, order, *angles = np.array(rows, np.float64).reshape(-1, 5).T
        return cls(robot.astype(np.intp), order.astype(np.intp), *angles)

    def tow(self, path: Floats, turn: Floats) -> tuple[Floats, Floats, Floats]:
        """Reference points ``(N, F, 2)``, headings ``(N, F)`` and hitch angles ``(N, J)`` where robots move like this.

        While its hitch moves straight, a trailer follows a tractrix: the tangent of half of the angle between its
        heading and the hitch's direction shrinks by ``exp(-way / length)``.
        """
        samples, first = turn.shape
        path = np.concatenate([path, np.zeros((samples, len(self.robot), 2))], axis=1)
        turn = np.concatenate([turn, np.zeros((samples, len(self.robot)))], axis=1)
        hitches = np.zeros((samples, len(self.robot)))
        for order in range(int(self.order.max(initial=-1)) + 1):
            each = np.flatnonzero(self.order == order)
            own, before = first + each, self.robot[each] if order == 0 else first + each - 1
            moves = np.diff(path[:, before], axis=0, prepend=path[:1, before])
            direction = portable.arctan2(moves[..., 1], moves[..., 0])
            shrinkage = portable.exp(-norm(moves) / self.length[each])
            angle = turn[0, before] - self.initial[each]
            for sample in range(samples):
                off = angle - direction[sample]
                off -= 2 * np.pi * np.rint(off / (2 * np.pi))
                sine, cosine = portable.sin_cos(off / 2)
                angle = angle + 2 * portable.arctan2(sine * shrinkage[sample], cosine) - off
                turn[sample, own] = angle
            hitches[:, each] = turn[:, before] - turn[:, own]
            sine, cosine = portable.sin_cos(turn[:, own])
            path[:, own] = path[:, before] - self.length[each, None] * np.stack([cosine, sine], axis=-1)
        return path, turn, hitches

    def violations(self, hitches: Floats, dt: float) -> Iterator[Violation]:
        """Yield a violation for each trailer whose hitch angles ``(N, J)``, every ``dt``, exceed its largest one."""
        over = np.abs(hitches) > self.most * (1 + HITCH_TOLERANCE)
        for each in np.flatnonzero(over.any(axis=0)):
            detail = f"hitch {self.order[each] + 1} is at {np.abs(hitches[:, each]).max():.3g} rad at most"
            detail += f", limit {self.most[each]:.3g}"
            yield Violation("hitch limit", (int(self.robot[each]),), float(over[:, each].argmax()) * dt, detail)


def _not_arrived(problem: Problem, end: Floats, missed: Floats, duration: float) -> list[Violation]:
    distance = norm(end - problem.goal.astype(np.float64))
    away = distance > problem.goal_radius * (1 + CHORD_ERROR)
    away |= missed > problem.goal_heading_tolerance + HEADING_DOUBT
    return [
        Violation(
            "not arrived", (robot,), duration,
            f"{distance[robot]:.4g} m from its goal (goal radius {problem.goal_radius:g} m) at the end"
            f"{heading_note(problem, robot, missed[robot])}",
        )
        for robot in np.flatnonzero(away).tolist()
    ]  # fmt: skip
