"""Filter of noisy measurements of robots' states: a steady-state Kalman filter that finds out how noisy they are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import BoolArray, FloatArray
from d4orm_env.core.problem import Problem
from d4orm_planners.tracking.steering import by_model

DECAY = 0.98
"""Share of what was seen that is left after a time step."""

ENOUGH = 40
"""Differences that it takes to say how noisy a component is."""

LEAST_SHARE = 0.1
"""Share of the variance of differences that has to come from measurements for these to be filtered."""

LEAST_GAIN = 0.1
"""No measurement counts less than this."""


class StateFilter:
    """A filter of the team's states, component by component, in the models' own motion.

    A state moves as its model says, but for a random walk of variance ``Q`` per step, and is measured with white noise
    of variance ``R``. Differences of a measurement from what the one before it leads to then have the variance ``Q + 2
    R`` and the covariance ``-R`` with the ones before them, which is how the two are told apart (Mehra, On the
    identification of variances and adaptive Kalman filtering, IEEE Trans. Automatic Control 15, 1970). The gain is that
    of the steady state, ``K = P / (P + R)`` with ``P = (Q + sqrt(Q^2 + 4 Q R)) / 2`` (Bar-Shalom, Li, Kirubarajan,
    Estimation with Applications to Tracking and Navigation, section 5.2.5). Robots of one model share it. As long as
    nothing tells of noise in what is measured it is one: measurements are taken as they are.

    Args:
        problem: The robots.
    """

    def __init__(self, problem: Problem) -> None:
        self._models = list(by_model(problem))
        shape = len(self._models), problem.state_size
        self._variance, self._covariance = np.zeros((2, *shape))
        self._count = np.zeros(len(self._models))
        self._before: NDArray[np.float64] | None = None

    def gains(self) -> NDArray[np.float64]:
        """``(models, n)`` how much of a difference is believed."""
        count = np.maximum(self._count, 1)[:, None]
        total = self._variance / count
        noise = np.maximum(-self._covariance / count, 0)
        walk = np.maximum(total - 2 * noise, 0)
        ahead = (walk + np.sqrt(walk**2 + 4 * walk * noise)) / 2
        believed = np.maximum(ahead / np.maximum(ahead + noise, np.finfo(np.float64).tiny), LEAST_GAIN)
        known = (count >= ENOUGH) & (noise > LEAST_SHARE * total)
        gains: NDArray[np.float64] = np.where(known, believed, 1.0)
        return gains

    def update(self, measured: FloatArray, led_to: FloatArray, expected: FloatArray, going: BoolArray) -> FloatArray:
        """``(K, n)`` the states; ``measured`` itself as long as nothing tells of noise.

        Args:
            measured: ``(K, n)`` the states as seen.
            led_to: ``(K, n)`` what those seen a time step ago lead to.
            expected: ``(K, n)`` what those estimated a time step ago lead to.
            going: ``(K,)`` robots that have not docked.
        """
        difference = self._turned(np.asarray(measured, np.float64) - led_to)
        before, self._before = self._before, difference
        innovation, states = self._turned(np.asarray(measured, np.float64) - expected), measured.copy()
        for number, (_, robots) in enumerate(self._models):
            moving = np.array(robots)[going[robots]]
            self._variance[number] = DECAY * self._variance[number] + (difference[moving] ** 2).sum(axis=0)
            if before is not None:
                products = difference[moving] * before[moving]
                self._covariance[number] = DECAY * self._covariance[number] + products.sum(axis=0)
            self._count[number] = DECAY * self._count[number] + len(moving)
        gains = self.gains()
        if (gains == 1).all():
            return measured
        for gain, (_, robots) in zip(gains, self._models):
            filtered = gain < 1
            columns = np.ix_(robots, filtered)
            states[columns] = expected[columns] + gain[filtered] * innovation[columns]
        return states

    def _turned(self, difference: NDArray[np.float64]) -> NDArray[np.float64]:
        """Differences ``(K, n)``, those of headings the short way round."""
        for model, robots in self._models:
            if model.heading_index is not None:
                angle = difference[robots, model.heading_index]
                difference[robots, model.heading_index] = (angle + np.pi) % (2 * np.pi) - np.pi
        return difference
