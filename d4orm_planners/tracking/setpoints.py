"""A smooth motion sampled at a rate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from d4orm_env.core.arrays import Floats, positive_number
from d4orm_env.core.lazy import LazyModule
from d4orm_env.verify import VerificationReport
from d4orm_planners.tracking.smoothing import SmoothMotion

if TYPE_CHECKING:
    import pandas as pd
else:
    pd = LazyModule("pandas")

MAX_RATE, MAX_SAMPLES = 1e5, 10**8


@dataclass(frozen=True, eq=False)
class Setpoints:
    """Setpoints for the controllers of ``K`` robots, at ``T`` times a constant period apart.

    Velocity, acceleration and jerk are the exact derivatives of one spline of class C4, which keeps the limits that it
    was made for and was verified to touch nothing, between the samples too.

    Attributes:
        time: ``(T,)`` from 0 until all robots are at rest [s].
        position: ``(T, K, d)`` [m].
        velocity: ``(T, K, d)`` [m/s].
        acceleration: ``(T, K, d)`` [m/s^2].
        jerk: ``(T, K, d)`` [m/s^3].
        heading: ``(T, K)`` [rad], not wrapped; zero for robots whose model has none.
        stretch: Times the plan's duration that the motion takes, at least 1.
        deviation: Largest distance from the plan at its steps [m].
        report: What the verification found: least separation and clearance.
    """

    time: Floats
    position: Floats
    velocity: Floats
    acceleration: Floats
    jerk: Floats
    heading: Floats
    stretch: float
    deviation: float
    report: VerificationReport

    def to_dataframe(self) -> pd.DataFrame:
        """A row for each time and robot: ``time``, ``robot``, ``x`` to ``jz`` (``jy`` in the plane), ``heading``.

        Raises:
            ModuleNotFoundError: Without pandas.
        """
        times, robots = self.heading.shape
        index = {"time": np.repeat(self.time, robots), "robot": np.tile(np.arange(robots), times)}
        columns = {name: values.ravel() for name, values in self.columns().items()}
        return pd.DataFrame(index | columns)

    def columns(self) -> dict[str, Floats]:
        """``(T, K)`` each: ``x``, ``y``, in space ``z``, their derivatives ``v``, ``a`` and ``j``, and ``heading``."""
        kinds = {"": self.position, "v": self.velocity, "a": self.acceleration, "j": self.jerk}
        axes = "xyz"[: self.position.shape[2]]
        found = {f"{kind}{axis}": values[..., i] for kind, values in kinds.items() for i, axis in enumerate(axes)}
        return found | {"heading": self.heading}


def sample_motion(motion: SmoothMotion, rate: float) -> Setpoints:
    """The motion at a rate [Hz], its end included.

    Raises:
        ValueError: If the rate is not positive, or so high that there would be over 10^8 numbers of a kind.
    """
    rate = positive_number(rate, "rate", most=MAX_RATE)
    count = int(np.ceil(motion.duration * rate)) + 1
    robots = motion.problem.num_robots
    if count * robots > MAX_SAMPLES:
        raise ValueError(
            f"rate is {rate:g} Hz for {motion.duration:.0f} s and {robots} robots; use at most "
            f"{MAX_SAMPLES / robots / motion.duration:.3g}"
        )
    time = np.arange(count) / rate
    return Setpoints(
        time=time,
        position=motion.position(time),
        velocity=motion.position(time, 1),
        acceleration=motion.position(time, 2),
        jerk=motion.position(time, 3),
        heading=motion.heading(time),
        stretch=motion.stretch,
        deviation=motion.deviation,
        report=motion.report,
    )
