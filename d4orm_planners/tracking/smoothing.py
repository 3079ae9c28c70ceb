"""Smooth motions through a plan: splines of class C4 within limits on speed, acceleration and jerk, verified again.

A plan's accelerations jump at every step, which no robot follows. Its positions are fitted by quintic P-splines (P. H.
C. Eilers and B. D. Marx, Statistical Science, 1996), which begin and end without acceleration; those of robots on
wheels by curves along which they roll (:mod:`~d4orm_planners.tracking.rolling_curves`). Where they exceed a limit the
whole team drives more slowly, which changes no path and no encounter. Smoother curves may be driven faster, but deviate
more from the plan: of several, the quickest is taken that is free of collisions.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import BSpline

from d4orm_env.core.arrays import Floats, numbers_of, short_repr
from d4orm_env.core.problem import Problem
from d4orm_env.core.trajectory import Trajectory
from d4orm_env.dynamics.robot_model import ACCELERATION, SPEED, TURN_RATE
from d4orm_env.verify import VerificationReport
from d4orm_env.verify.curves import verify_curves
from d4orm_planners.tracking.rolling_curves import finer, groups_on_wheels, on_wheels, roll
from d4orm_planners.tracking.splines import fit_spline
from d4orm_planners.tracking.steering import present_velocities

SMOOTHNESS = (1e-2, 1e-1, 1.0, 1e1, 1e2)
"""Weights of the squared third differences of a curve's coefficients, against the squared distances from the plan."""
GATHERING, SETTLING = 2, 5  #: Steps before a plan from rest to start in, and after the last arrival to come to rest in
PER_STEP = 32  #: Samples per step at which a motion's speeds, accelerations and jerks are checked
RESERVE = 1e-3  #: Share of the limits that is left for peaks between these samples
SLOWEST = 4.0  #: Longest duration of a motion, in durations of the plan


@dataclass(frozen=True, eq=False)
class MotionLimits:
    """Limits of what a robot's controller is asked for, each ``(K,)``; infinite for none."""

    speed: Floats  #: [m/s]
    reverse_speed: Floats  #: [m/s]; of robots with a heading
    turn_rate: Floats  #: [rad/s]; to the left
    right_turn_rate: Floats  #: [rad/s]
    acceleration: Floats  #: [m/s^2]; of robots with a heading along it, of others with what makes good their drag
    turn_acceleration: Floats  #: [rad/s^2]
    steering_rate: Floats  #: [rad/s]; of robots with a wheelbase
    jerk: Floats  #: [m/s^3]

    @classmethod
    def of(cls, problem: Problem, acceleration: ArrayLike | None = None, jerk: ArrayLike | None = None) -> MotionLimits:
        """The team's own limits, but for those given; ValueError unless one positive number, or one per robot."""
        team, rows = problem.team, []
        for model, limits in zip(team.robot_models, team.limits.astype(np.float64), strict=True):
            own, lower = dict(zip(model.limit_names, limits.tolist(), strict=False)), model.lower_bounds(limits)
            if TURN_RATE in dict(model.lower_limits):
                left, right = limits[TURN_RATE], lower[TURN_RATE]
            else:
                left = right = model.turn_rate(limits) or np.inf
            rows.append([
                limits[SPEED], np.inf if model.heading_index is None else lower[SPEED], left, right,
                np.inf if model.first_order else limits[ACCELERATION],
                own.get("max_turn_acceleration", np.inf), own.get("max_steering_rate", np.inf),
                own.get("max_jerk", np.inf),
            ])  # fmt: skip
        columns = dict(zip(LIMITS, np.array(rows, np.float64).T, strict=True))
        for name, given in (("acceleration", acceleration), ("jerk", jerk)):
            columns[name] = _each(f"max_{name}", given, columns[name])
        return cls(**columns)


LIMITS = {
    "speed": ("m/s", 1), "reverse_speed": ("m/s", 1), "turn_rate": ("rad/s", 1), "right_turn_rate": ("rad/s", 1),
    "acceleration": ("m/s^2", 2), "turn_acceleration": ("rad/s^2", 2), "steering_rate": ("rad/s", 1),
    "jerk": ("m/s^3", 3),
}  # fmt: skip
"""Units of the limits, and by which power of its duration a slower motion has less of each."""


def _each(name: str, value: ArrayLike | None, otherwise: Floats) -> Floats:
    if value is None:
        return otherwise
    try:
        each: Floats = np.broadcast_to(numbers_of(value, name, np.float64), otherwise.shape)
    except ValueError:
        raise ValueError(
            f"{name} must be one number or one per robot ({len(otherwise)}), not {short_repr(value)}"
        ) from None
    if not (each > 0).all():
        raise ValueError(f"{name} is {short_repr(value)}; it must be positive")
    return each


@dataclass(frozen=True, eq=False)
class SmoothMotion:
    """A team's motion as splines over the plan's own time, driven ``stretch`` times as slowly."""

    problem: Problem  #: The team and its world
    limits: MotionLimits  #: Not to be exceeded
    curves: BSpline  #: Of :meth:`position`, ``(K, d)`` by the plan's time [m]
    headings: BSpline  #: ``(K,)`` by the plan's time [rad]; zero for robots without one
    curvatures: BSpline  #: ``(K,)`` by the plan's time [1/m], steered at rest too; zero for robots that do not steer
    deviation: float  #: Largest distance from the plan at its steps [m]
    stretch: float = 1.0  #: Times the plan's duration that it takes, at least 1

    @property
    def duration(self) -> float:
        """Time at which all robots are at rest [s]."""
        return float(self.curves.t[-1]) * self.stretch

    def position(self, times: Floats, derivative: int = 0) -> Floats:
        """``(T, K, d)`` positions [m], or derivatives of them, from 0 s to the duration and at rest from then on."""
        return self._values(self.curves, times, derivative)

    def heading(self, times: Floats, derivative: int = 0) -> Floats:
        """``(T, K)`` headings [rad], or derivatives of them."""
        return self._values(self.headings, times, derivative)

    def _values(self, spline: BSpline, times: Floats, derivative: int) -> Floats:
        own = np.clip(np.asarray(times, np.float64) / self.stretch, 0, spline.t[-1])
        values: Floats = spline(own, nu=derivative) / self.stretch**derivative
        return values

    @cached_property
    def peaks(self) -> MotionLimits:
        """Peaks of what is limited, of each robot."""
        times = np.linspace(0, self.duration, self._num_samples)
        velocity, acceleration, jerk = (self.position(times, order) for order in (1, 2, 3))
        heading, rate = self.heading(times), self.heading(times, 1)
        ahead, faster = (
            part[..., 0] * np.cos(heading) + part[..., 1] * np.sin(heading) for part in (velocity, acceleration)
        )
        curvature, change = (self._values(self.curvatures, times, order) for order in (0, 1))
        wheelbase = self.problem.team.own_limits.get("wheelbase", 0.0)
        pushed = np.linalg.norm(acceleration + self._drag[:, None] * velocity, axis=2)
        has_heading = np.array([model.heading_index is not None for model in self.problem.team.robot_models])
        return MotionLimits(
            speed=np.linalg.norm(velocity, axis=2).max(axis=0),
            reverse_speed=(-ahead).max(axis=0),
            turn_rate=rate.max(axis=0),
            right_turn_rate=(-rate).max(axis=0),
            acceleration=np.where(has_heading, np.abs(faster), pushed).max(axis=0),
            turn_acceleration=np.abs(self.heading(times, 2)).max(axis=0),
            steering_rate=np.abs(change * wheelbase / (1 + (curvature * wheelbase) ** 2)).max(axis=0),
            jerk=np.linalg.norm(jerk, axis=2).max(axis=0),
        )

    @cached_property
    def report(self) -> VerificationReport:
        """Verdict of :func:`d4orm_env.verify.curves.verify_curves`, by the sharpest bends at some samples."""
        times = np.linspace(0, self.duration, self._num_samples)
        turned = self.problem.team.radius * (np.abs(self.heading(times, 2)) + self.heading(times, 1) ** 2)
        bend = (np.linalg.norm(self.position(times, 2), axis=2) + turned).max(axis=0)
        return verify_curves(self.problem, self.position, self.duration, bend, self.heading)

    @property
    def _drag(self) -> Floats:
        """``(K,)`` drag of robots that the air brakes [1/s]."""
        drag: Floats = np.broadcast_to(self.problem.team.own_limits.get("drag", 0.0), self.problem.num_robots)
        return drag

    @property
    def _num_samples(self) -> int:
        return round(self.curves.t[-1] / self.problem.dt) * PER_STEP + 1

    def within(self) -> SmoothMotion:
        """The same motion, as slow as its limits need."""
        return replace(self, stretch=self.stretch * max(1.0, *(needed for needed, _ in self.needed().values())))

    def needed(self) -> dict[str, tuple[float, int]]:
        """Factors by which each of :data:`LIMITS` needs the motion slower, and the robots that they are for."""
        needed = {}
        for name, (_, power) in LIMITS.items():
            share = (1 + RESERVE) * getattr(self.peaks, name) / getattr(self.limits, name)
            # Drag falls less than accelerations do.
            powers = np.where((name == "acceleration") & (self._drag > 0), 1, power)
            slower = np.maximum(share, 0.0) ** (1 / powers)
            needed[name] = float(slower.max()), int(np.argmax(slower))
        return needed


def least_overhead(problem: Problem, positions: Floats) -> float:
    """Least height of a robot above another, of positions ``(T, K, d)``, where both overlap seen from above [m];
    infinite where none do, or the team moves in the plane. Who passes beside another is not above it.
    """
    least, radius = np.inf, problem.team.girth.astype(np.float64)
    if problem.dimension == 2:
        return least
    for robot in range(1, problem.num_robots):
        gaps = np.abs(positions[:, :robot] - positions[:, robot, None])
        overlaps = np.hypot(gaps[..., 0], gaps[..., 1]) <= radius[:robot] + radius[robot]
        least = min(least, float(gaps[..., 2][overlaps].min(initial=np.inf)))
    return least


def smooth_motion(problem: Problem, trajectory: Trajectory, limits: MotionLimits) -> SmoothMotion:
    """The quickest smooth motion along a trajectory that is free of collisions.

    Args:
        problem: What the trajectory solves.
        trajectory: Of a plan that is solved.
        limits: Not to be exceeded.

    Raises:
        ValueError: If there is none, with what is in its way; or if robots that drive at the start would have to drive
            more slowly than they do.
    """
    fitted = (_fitted(problem, trajectory, limits, smoothness) for smoothness in SMOOTHNESS)
    motions = sorted((motion.within() for motion in fitted), key=lambda motion: motion.stretch)
    best = motions[0]
    if drive_at_start(problem):
        if best.stretch > 1 + RESERVE:
            raise ValueError(_too_fast(best, "its robots drive at the start, so they cannot take longer"))
        motions = [replace(motion, stretch=1.0) for motion in motions if motion.stretch <= 1 + RESERVE]
    if best.stretch > SLOWEST:
        raise ValueError(_too_fast(best, f"it would take {best.stretch:.1f} times as long"))
    for motion in motions:
        if motion.report.ok and motion.stretch <= SLOWEST:
            return motion
    violation = best.report.violations[0]
    remedy = "plan with a larger margin, or allow more acceleration with max_acceleration"
    if any(problem.team.robot_models[robot].trailers for robot in violation.robots):
        remedy = "trailers that are backed up swing out; plan with another seed, or a larger margin"
    raise ValueError(f"smoothed, the plan fails: {violation}; {remedy}")


def _too_fast(motion: SmoothMotion, why: str) -> str:
    usual = replace(motion, stretch=1.0)
    needed = usual.needed()
    name = max(needed, key=lambda name: needed[name][0])
    robot = needed[name][1]
    most, limit = getattr(usual.peaks, name)[robot], getattr(motion.limits, name)[robot]
    values = f"{most:.3g} {LIMITS[name][0]} of {name.replace('_', ' ')}, limit {limit:.3g}"
    demand, stops = f"robot_{robot} needs {values}, and {why}", usual.problem.goal_speed[robot] == np.inf
    stops &= not usual.problem.team.robot_models[robot].first_order
    remedies = ["plan with goal_speed, for robots stop in one step without it"] * bool(stops)
    may_be_given = name in ("acceleration", "jerk")
    remedies.append(f"allow more with max_{name}" if may_be_given else "plan for a team with lower limits than it has")
    return f"smoothed, the plan asks for too much: {demand}; {', or '.join(remedies)}"


def drive_at_start(problem: Problem) -> bool:
    """Check whether a robot does, so that the team cannot drive more slowly."""
    return bool(_initial_velocity(problem).any())


def _initial_velocity(problem: Problem) -> Floats:
    """``(K, d)`` velocities at the start [m/s]."""
    no_controls = np.zeros((problem.num_robots, problem.control_size), np.float32)
    return present_velocities(problem, problem.start, no_controls).astype(np.float64)


def _fitted(problem: Problem, trajectory: Trajectory, limits: MotionLimits, smoothness: float) -> SmoothMotion:
    """The plan's positions and headings by splines, as they are timed."""
    poses = np.concatenate([trajectory.positions, problem.team.headings(trajectory.states)[..., None]], axis=2)
    moving = np.any(poses[1:] != poses[:-1], axis=(1, 2))
    last = int(np.flatnonzero(moving).max(initial=0)) + 1 + SETTLING
    velocity = _initial_velocity(problem)
    first = 0 if velocity.any() else -GATHERING
    rows = np.clip(np.arange(first, last + 1), 0, len(trajectory.positions) - 1)
    headings = np.zeros((len(rows), problem.num_robots))
    for robot, model in enumerate(problem.team.robot_models):
        if model.heading_index is not None:
            headings[:, robot] = np.unwrap(trajectory.states[rows, robot, model.heading_index].astype(np.float64))
    positions = trajectory.positions[rows].astype(np.float64)
    curves = fit_spline(positions, velocity, problem.dt, smoothness)
    turns = fit_spline(headings, np.zeros(problem.num_robots), problem.dt, smoothness)
    curvatures = BSpline(turns.t, 0 * turns.c, turns.k)
    if groups := groups_on_wheels(problem):
        poses = np.concatenate([positions, headings[..., None]], axis=2)
        curves, turns = (finer(spline, len(rows) - 1) for spline in (curves, turns))
        for group in groups:
            rolled, steered = roll(on_wheels(problem, group, poses, velocity), problem.dt, smoothness)
            curves.c[:, group], turns.c[:, group] = rolled.c[..., :2], rolled.c[..., 2]
            curvatures.c[:, group] = steered.c
    offset = curves(np.linspace(0, (last - first) * problem.dt, len(rows))) - positions
    deviation = float(np.linalg.norm(offset, axis=2).max())
    return SmoothMotion(problem, limits, curves, turns, curvatures, deviation)
