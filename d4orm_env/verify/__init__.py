"""The independent judge of plans: float64, sub-stepped, continuous in time, in plain NumPy.

It shares no code with the engines: of the problem it reads data only, and the models, the integration, the docking and
the distances are written again here, so that a mistake in the physics of the engines does not excuse itself. Only of a
model without equations here, such as a user's, does it take the derivative and the limits from the model itself, and
integrates them anew (:mod:`d4orm_env.verify.integrated`). What it
says is a function of its input: the same on every processor, to the bit.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from d4orm_env.core import portable
from d4orm_env.verify.contact import BLOCKS, MAX_NUMBERS, Stretch
from d4orm_env.verify.curves import CHORD_ERROR
from d4orm_env.verify.docking import SPEED_ALLOWANCE, Docking, find_docking
from d4orm_env.verify.footprints import make_watches
from d4orm_env.verify.geometry import ConvexBodies, Floats, norm
from d4orm_env.verify.motion import MODELS, TeamMotion
from d4orm_env.verify.report import VerificationReport, Violation

if TYPE_CHECKING:
    from d4orm_env.core.problem import Problem
    from d4orm_env.core.team import Team

__all__ = ["VerificationReport", "Violation", "verify"]

MIN_SUB_STEPS = 10
MAX_SUB_STEPS = 1000
"""More in one step are not taken: the robot would leave the straight line by 70 of its radii within the step."""
LIMIT_TOLERANCE = 1e-5
"""Relative excess over a control limit that float32 rounding may cause."""


def verify(problem: Problem, controls: ArrayLike) -> VerificationReport:
    """Judge a plan: do all robots arrive by the horizon, within their limits, touching nothing at any time?

    Contact is judged, not the safety margin: it is a gap of zero or less at any time, also between steps, known to
    ``CHORD_ERROR`` of its radius for each moving robot, by default 0.01 mm. Controls above the limits are reported, and
    clipped before they are executed, as the robot would.

    Docking is decided at the end of each step; from then on the robot is at rest and its controls are ignored.
    The environments decide it in float32. Where a robot ends a step so close to the goal radius, or at a speed so close
    to the goal speed, that rounding decides (see :mod:`d4orm_env.verify.docking`), both readings are judged, that it
    docks there and that it drives on, and the plan is fine only if all arrive without a collision in all of them.

    Where arrival is to stay rather than to dock, goals do not absorb: a robot must be at its goal, beyond what
    rounding decides, from some step to the last.

    Controls that are not finite define no motion: they are reported, and nothing else is judged. So are robots that
    turn or accelerate so hard that ``MAX_SUB_STEPS`` sub-steps do not follow them through one step.

    Args:
        problem: The problem the plan is for.
        controls: ``(H, K, m)``, each held constant over ``problem.dt``.

    Returns:
        The report; ``report.ok`` when there are no violations.

    Raises:
        ValueError: If the controls are not numbers or their shape is another.
    """
    if not hasattr(problem, "goal_radius"):
        given = repr(problem).split("\n")[0][:100]
        raise ValueError(f"problem is {given}; give a Problem, as make_problem() returns")
    array = _checked_controls(problem, controls)
    if not np.isfinite(array).all():
        return _left_out(problem, _non_finite(array, problem.dt))
    # Once all have docked nothing moves, mostly long before the horizon: a step of that is enough.
    busy = int(np.flatnonzero(array.any(axis=(1, 2))).max(initial=0)) + 2
    docks_alone = problem.arrival != "stay" and set(problem.team.models) <= set(MODELS)
    if docks_alone and busy < len(array):
        return _judge(problem, array[:busy], array)
    return _judge(problem, array)


def _judge(problem: Problem, array: Floats, instead: Floats | None = None) -> VerificationReport:
    """Judge controls or, should not all robots dock, those ``instead``."""
    motion = TeamMotion(problem, array)
    sub_steps = np.ceil(problem.dt * np.sqrt(motion.bend / (8 * CHORD_ERROR * problem.team.girth.astype(np.float64))))
    if sub_steps.max() > MAX_SUB_STEPS:
        return _left_out(problem, list(_too_violent(sub_steps, motion, problem)))
    course = _Course(motion, max(MIN_SUB_STEPS, int(sub_steps.max())), problem)
    docking = find_docking(problem, motion, course.ends)
    if instead is not None and not np.isfinite(docking.arrival_times).all():
        del motion, sub_steps, course, docking  # both would not fit into as much memory
        return _judge(problem, instead)
    return _report(problem, array, motion, course, docking)


def _report(
    problem: Problem, controls: Floats, motion: TeamMotion, course: _Course, docking: Docking
) -> VerificationReport:
    robot, body = course.bodies(docking)
    shapes = course.shapes.take(body) if course.shapes is not None else None
    radius = problem.team.radius.astype(np.float64)[robot]
    pairs, obstacles = make_watches(problem.world, robot, radius, shapes)
    watches = [pairs, *obstacles]
    for stretch in course.stretches(docking, max(len(watch.rows) for watch in watches)):
        for watch in watches:
            watch.observe(stretch)
    contacts = (violation for watch in watches for violation in watch.violations())
    violations = [
        *_control_limits(motion, docking.last_steps, controls, problem.team),
        *(replace(one, detail=one.detail + docking.notes(one.robots, problem.dt)) for one in contacts),
        *docking.violations,
    ]
    return VerificationReport(
        pairs.minimum,
        min((watch.minimum for watch in obstacles), default=np.inf),
        docking.arrival_times,
        docking.arrival_speeds,
        not (docking.arrival_speeds > _braked_away(problem)).any(),
        sorted(violations, key=lambda violation: violation.time),
    )


class _Course:
    """Positions of all robots over the whole horizon, some steps at a time."""

    def __init__(self, motion: TeamMotion, sub_steps: int, problem: Problem) -> None:
        self._motion, self._sub_steps, start = motion, sub_steps, problem.start.astype(np.float64)
        self.shapes = ConvexBodies.of(problem.team) if problem.team.shapes else None
        horizon, num_robots = motion.pace.shape
        self._numbers = (2 * sub_steps + 1) * num_robots * motion.size  # of one step
        self._moving = int(np.flatnonzero(motion.moving).max(initial=-1)) + 1
        ends = np.zeros((horizon + 1, num_robots, motion.size))
        ends[0] = start[:, : motion.size]
        for steps in self._parts(self._moving, self._numbers):
            ends[1:][steps] = self._motion.displacement(steps, sub_steps)[:, -1]
        self.ends: Floats = np.cumsum(ends, axis=0)

    def bodies(self, docking: Docking) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Robots and numbers ``(B,)`` of the bodies of every reading, those of trailers last."""
        reading, body = self._readings(docking)
        return docking.robot[reading], body

    def _readings(self, docking: Docking) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        first = len(self._motion.max_speed)
        trailers = [
            (reading, first + number)
            for number, robot in enumerate(self._motion.trailer_robots)
            for reading in np.flatnonzero(docking.robot == robot)
        ]
        readings, bodies = np.array([*enumerate(docking.robot), *trailers], np.intp).T
        return readings, bodies

    def _turns(self, steps: slice, docking: Docking, stop: NDArray[np.intp]) -> Floats:
        """``(T, S+1, B)`` headings, a docked robot's as it docked [rad]."""
        (reading, body), ends = self._readings(docking), self._motion.end_headings
        headings = self._motion.headings(steps, self._sub_steps)
        absorbed = np.arange(len(ends))[steps, None] >= docking.steps[reading]
        return np.where(absorbed[:, None], ends[stop[reading] - 1, body], headings[:, :, body])

    def _hitched(self, docking: Docking, turn: Floats) -> Floats:
        """``(T, S+1, B, d)`` reference points of the bodies relative to those of their robots [m]."""
        reading, body = self._readings(docking)
        offset = np.zeros((*turn.shape, self._motion.size))
        last = list(range(len(docking.robot)))  # the last body of each reading so far
        for number in range(len(docking.robot), len(body)):
            sine, cosine = portable.sin_cos(turn[..., number])
            hitch = self._motion.hitches[body[number] - len(self._motion.max_speed)]
            behind = hitch * np.stack([cosine, sine], axis=-1)
            offset[..., number, :] = offset[..., last[reading[number]], :] - behind
            last[reading[number]] = number
        return offset

    def _parts(self, horizon: int, numbers: int) -> Iterator[slice]:
        size = max(1, MAX_NUMBERS // numbers)
        return (slice(first, min(first + size, horizon)) for first in range(0, horizon, size))

    def stretches(self, docking: Docking, num_pairs: int) -> Iterator[Stretch]:
        """All steps, up to the first at which all are at rest, with a body for every reading of every robot."""
        horizon, dt, robot = len(self.ends) - 1, self._motion.dt, docking.robot
        stop = np.minimum(docking.steps, horizon)
        horizon = min(horizon, int(docking.steps.max()) + 1, self._moving + 1)
        rest = self.ends[stop, robot]
        for steps in self._parts(horizon, max(self._numbers, num_pairs // BLOCKS[0])):
            displacement, position = self._motion.displacement(steps, self._sub_steps), self.ends[:-1][steps]
            if len(robot) > displacement.shape[2]:  # copying is not free, and one reading each is the rule
                # By take(), because an index leaves the robots outermost in memory.
                displacement, position = displacement.take(robot, axis=2), position.take(robot, axis=1)
            absorbed = np.arange(horizon)[steps, None] >= docking.steps
            np.copyto(displacement, 0.0, where=absorbed[:, None, :, None])
            position = np.where(absorbed[..., None], rest, position)
            path, travel, turn = position[:, None] + displacement, norm(displacement).max(axis=1), np.zeros((0, 0, 0))
            if self.shapes is not None:
                turn, (reading, body) = self._turns(steps, docking, stop), self._readings(docking)
                if len(body) > len(robot):
                    offset = self._hitched(docking, turn)
                    path, displacement = path[:, :, reading] + offset, displacement[:, :, reading] + offset
                    travel = norm(displacement - displacement[:, :1]).max(axis=1)
                turned = np.abs(turn - turn[:, :1]).max(axis=1)
                travel = self.shapes.stretch[body] * (travel + self.shapes.outer[body] * turned)
            yield Stretch(path, travel, steps.start * dt, dt, turn)


def _checked_controls(problem: Problem, controls: ArrayLike) -> Floats:
    try:
        given = np.asarray(controls)
        objects = given.flat if given.dtype.kind == "O" else ()
        if given.dtype.kind not in "fiuO" or any(isinstance(each, str | bytes | bool) for each in objects):
            raise TypeError("text and truth are no numbers, and NumPy would drop imaginary parts")
        array = given.astype(np.float64)
    except OverflowError as error:
        raise ValueError("controls hold a whole number too large for float64; keep them within the limits") from error
    except (RuntimeError, TypeError, ValueError) as error:
        remedy = "; give its controls" if hasattr(controls, "controls") else ""
        raise ValueError(f"controls must be an array of numbers, not {type(controls).__name__}{remedy}") from error
    expected = (problem.horizon, len(problem.team.models), problem.team.control_size)
    if array.shape != expected:
        remedy = ""
        if array.shape[1:] == expected[1:] and len(array):
            remedy = f"; for so many steps, verify them for problem.replace(horizon={len(array)})"
        raise ValueError(f"controls have shape {array.shape}; expected (H, K, m) = {expected}{remedy}")
    return array


def _left_out(problem: Problem, violations: list[Violation]) -> VerificationReport:
    never = np.full(len(problem.team.models), np.inf)
    return VerificationReport(np.nan, np.nan, never, np.full_like(never, np.nan), False, violations)


def _braked_away(problem: Problem) -> Floats:
    """``(K,)`` what robots brake away in a step, and the allowance [m/s]; infinite for those without inertia."""
    team, dt = problem.team, problem.dt
    braking = team.max_acceleration * dt + SPEED_ALLOWANCE * team.max_speed
    for robot, model in enumerate(team.robot_models):
        if model.first_order:
            braking[robot] = np.inf
        elif "max_acceleration" in (model.limit_names[column] for _, column in model.state_limits):
            # It must end too, at a limited rate.
            rate = team.limits[robot, model.control_limits[0]]
            braking[robot] = min(braking[robot], rate * dt * dt / 2 + SPEED_ALLOWANCE * team.max_speed[robot])
    return braking.astype(np.float64)


def _non_finite(controls: Floats, dt: float) -> list[Violation]:
    bad: NDArray[np.bool_] = np.any(~np.isfinite(controls), axis=2)
    violations = []
    for robot in np.flatnonzero(bad.any(axis=0)):
        step = int(bad[:, robot].argmax())
        detail = f"control {controls[step, robot].tolist()} at step {step}; {bad[:, robot].sum()} steps in all"
        violations.append(Violation("non-finite", (int(robot),), step * dt, detail))
    return sorted(violations, key=lambda violation: violation.time)


def _too_violent(sub_steps: Floats, motion: TeamMotion, problem: Problem) -> Iterator[Violation]:
    for robot in np.flatnonzero((sub_steps > MAX_SUB_STEPS).any(axis=0)):
        step = int(np.argmax(sub_steps[:, robot] > MAX_SUB_STEPS))
        error = CHORD_ERROR * float(problem.team.girth[robot])
        detail = (
            f"accelerates with {motion.bend[step, robot]:.4g} m/s^2 at step {step}, which {MAX_SUB_STEPS} sub-steps of "
            f"a step of {problem.dt:g} s do not follow to {error:.2g} m; use a smaller dt, or lower limits"
        )
        yield Violation("not judged", (int(robot),), step * problem.dt, detail)


def _control_limits(
    motion: TeamMotion, docked_after: NDArray[np.intp], controls: Floats, team: Team
) -> Iterator[Violation]:
    """Controls above a limit before docking, one entry for each robot and limit."""
    excess = motion.sizes - motion.limits
    before_docking = np.arange(len(excess))[:, None] < docked_after
    over = (excess > motion.limits * LIMIT_TOLERANCE) & before_docking[..., None]
    for robot, column in np.argwhere(over.any(axis=0)):
        steps = np.flatnonzero(over[:, robot, column])
        least, most = team.control_bounds[:, robot, column].astype(np.float64)
        limits = np.where(controls[steps, robot, column] < 0, -least, most)
        values = limits + excess[steps, robot, column]
        detail = (
            f"{motion.limited_quantity(robot, column)} of the control is {values[0]:.7g} at step {steps[0]}, "
            f"limit {limits[0]:.7g}; {len(steps)} steps over it, at most {values.max():.7g}"
        )
        yield Violation("control limit", (int(robot),), float(steps[0] * motion.dt), detail)
