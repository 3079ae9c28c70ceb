"""Report of :func:`d4orm_env.verify.verify`."""

from __future__ import annotations

from dataclasses import dataclass

from d4orm_env.verify.geometry import Floats


@dataclass(frozen=True)
class Violation:
    """One thing wrong with a plan."""

    #: ``"robot contact"``, ``"obstacle contact"``, ``"bounds contact"``, ``"control limit"``, ``"not arrived"``,
    #: ``"non-finite"``, ``"not judged"`` or, of curves, ``"hitch limit"``
    kind: str
    robots: tuple[int, ...]  #: Indices of the robots concerned
    time: float  #: Time at which it first happens, contacts to within a sub-step [s]
    detail: str  #: Description, with values and units

    def __str__(self) -> str:
        names = " and ".join(f"robot_{robot}" for robot in self.robots)
        return f"{self.kind} at {self.time:.3f} s, {names}: {self.detail}"


@dataclass(frozen=True, eq=False)
class VerificationReport:
    """Findings of :func:`~d4orm_env.verify.verify`."""

    #: Smallest gap between the surfaces of two robots over continuous time, negative where they overlap [m]; infinite
    #: for one robot, NaN for a plan whose motion is not judged. Of ellipsoids it is the gap along the line of their
    #: centres.
    min_separation: float
    #: Smallest gap from a robot's surface to an obstacle or the bounds, negative inside [m]; infinite in an empty open
    #: world, NaN for a plan whose motion is not judged
    min_clearance: float
    #: ``(K,)`` when each robot docked, in the first reading of its docking [s]; infinite for one that does not dock in
    #: every reading
    arrival_times: Floats
    #: ``(K,)`` speed at which each robot then docked [m/s]; NaN where it does not dock, or is not stopped
    arrival_speeds: Floats
    #: Whether each robot that docked can brake away that speed in the step after: if so the plan obeys the model to its
    #: end. It does not where goals stop robots dead (an infinite goal speed, as in the paper). Trajectories leave that
    #: step out: velocities are zero as robots dock, in which they change by up to twice what robots brake away in a
    #: step, and real ones roll on by up to ``max_acceleration * dt**2 / 2``.
    dynamics_ok: bool
    #: Everything wrong, by time; one entry for each pair, robot and obstacle, robot and side of the bounds, or robot
    #: and limit
    violations: list[Violation]

    @property
    def ok(self) -> bool:
        """True if nothing is wrong."""
        return not self.violations
