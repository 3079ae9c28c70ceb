"""Motion of robots whose model has no equations in :mod:`~d4orm_env.verify.motion`: its derivative, in float64.

Of such a model the judge takes its word for the derivative, the limits and the velocity, and integrates anew: classical
Runge-Kutta in many sub-steps of a control step, with the same bits on every processor.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from d4orm_env.core import portable
from d4orm_env.verify.geometry import Floats, norm

if TYPE_CHECKING:
    from d4orm_env.core.team import Team

SIZE = np.float32(0.15)
"""Radius of robots whose positions are judged in metres [m]; others in proportion, and speeds by their limits."""
SUB_STEPS = 20
"""To find how much the path bends within a control step."""
STATE_ERROR = 1e-7
"""Largest error of a control step's integration that one with more sub-steps reveals, in units of states."""
GAP = 1e-10
"""Error that steps may have in the end, in units of states, or as a share of the largest state."""
CORRECTIONS = 5
"""Times that it is tried to make good what they miss each other by: two suffice mostly."""
ASIDE = 1e-6
"""Differences of states by which is found out what a step makes of them, in units of states."""
BEND_MARGIN = 1.5
"""The acceleration is measured between sub-steps, and may be this much larger at one of them."""
LARGEST_CONTROL = 1e100
"""Larger controls mean the same once they are limited, and the square of this is a number."""


class Integrated:
    """The robots of one model under a plan's controls; ``R`` robots.

    Attributes:
        robots: ``(R,)`` which of the team they are.
        limits: ``(R, m)`` limits of the control components.
        sizes: ``(H, R, m)`` limit plus what is cut off of each component.
        pace: ``(H, R)`` speed after each step [m/s].
        bend: ``(H, R)`` acceleration within each step [m/s^2].
        moving: ``(H, R)`` whether the state changes within the step: at rest when it begins it stays so.
        end_headings: ``(H, R, 1 + trailers)`` headings after each step [rad]; zero for a model without one.
        step_error: ``(H, R)`` what one step of Runge-Kutta per control step is off by [m].
    """

    def __init__(
        self, model: Any, robots: NDArray[np.intp], start: Floats, controls: Floats, team: Team, dt: float
    ) -> None:
        self.robots, self._model, self._dt, self._ops = robots, model, dt, _ops()
        self._limits = tuple(team.limits.astype(np.float64)[robots].T)
        self._units = np.ones((model.state_size, 1, len(robots)))
        self._units[: model.dimension] = (team.radius[robots] / SIZE).astype(np.float64)
        self._units[list(model.speed_indices)] = team.max_speed[robots].astype(np.float64)
        asked = np.moveaxis(controls[:, robots, : model.control_size], 2, 0)
        within = np.clip(asked, -LARGEST_CONTROL, LARGEST_CONTROL)
        self._commands = self._call(model.functions.limit_control, within)
        self.limits: Floats = np.stack([self._limits[column] for column in model.control_limits], axis=1)
        self.sizes: Floats = self.limits + np.moveaxis(np.abs(asked - self._commands), 0, 2)
        states = self._states(start[robots, : model.state_size].T)
        self._begins = states[:, :-1]
        self.moving: NDArray[np.bool_] = (self._slope(self._begins, self._commands) != 0).any(axis=0)
        self._known: tuple[slice, int, list[Floats]] | None = None
        self.end_headings = self._headings(states[:, 1:])
        velocity = self._call(model.functions.velocity, states[:, 1:], self._commands)
        self.pace: Floats = norm(np.moveaxis(velocity, 0, 2))
        displacement = self.displacement(slice(None), SUB_STEPS)
        change = np.diff(displacement, n=2, axis=1) * (SUB_STEPS / dt) ** 2
        self.bend: Floats = BEND_MARGIN * norm(change).max(axis=1)
        coarse = self._advanced(self._begins, self._commands, dt, self._limits) - self._begins
        self.step_error: Floats = norm(np.moveaxis(coarse[: model.dimension], 0, 2) - displacement[:, -1])

    def _states(self, start: Floats) -> Floats:
        """``(n, H+1, R)`` at the beginning of every step and after the last, integrated as finely as it takes.

        Roughly at first (Euler), one step after another. From there all steps are integrated at once, finely, and what
        they miss each other by is made good (multiple shooting); one after another, finely, only where that finds no
        end.
        """
        states = self._one_by_one(start, lambda x, u: x + self._dt * self._slope(x, u))
        sub_steps = self._sub_steps(states[:, :-1])
        for _ in range(CORRECTIONS):
            gaps = self._stepped(states[:, :-1], sub_steps) - states[:, 1:]
            if not np.isfinite(gaps).all():
                break
            if self._largest(gaps) <= GAP * max(1.0, self._largest(states)):
                return states
            states = states.copy()
            states[:, 1:] += self._carried(states[:, :-1], gaps)
        return self._one_by_one(start, lambda x, u: self._integrated(x, u, sub_steps))

    def _one_by_one(self, start: Floats, advance: Callable[[Floats, Floats], Floats]) -> Floats:
        states, before = [start], None
        for u in np.moveaxis(self._commands, 1, 0):
            # Commands under which nothing has changed will change nothing.
            if before is None or not (np.array_equal(u, before) and np.array_equal(states[-1], states[-2])):
                states.append(self._call(self._model.functions.limit_state, advance(states[-1], u)))
            else:
                states.append(states[-1])
            before = u
        return np.stack(states, axis=1)

    def _sub_steps(self, begins: Floats) -> int:
        """Return the number of sub-steps of a step; ``begins`` ``(n, H, R)`` are about where steps begin."""
        sub_steps = 2
        while sub_steps < SUB_STEPS:
            coarse, fine = (self._integrated(begins, self._commands, times * sub_steps) for times in (1, 2))
            error = self._largest(coarse - fine)
            if error <= STATE_ERROR:
                break
            # Of order four: so many times finer, and one more.
            times_finer = (error / STATE_ERROR) ** 0.25 if np.isfinite(error) else SUB_STEPS
            sub_steps = int(min(sub_steps * times_finer + 1, SUB_STEPS))
        return sub_steps

    def _largest(self, states: Floats) -> float:
        """The largest number in ``(n, ..., R)`` states, in their units."""
        return float((np.abs(states) / self._units).max())

    def _stepped(self, begins: Floats, sub_steps: int) -> Floats:
        """``(n, H, R)`` states after every step from where it begins."""
        return self._call(self._model.functions.limit_state, self._integrated(begins, self._commands, sub_steps))

    def _carried(self, begins: Floats, gaps: Floats) -> Floats:
        """``(n, H, R)`` what ``gaps`` after every step come to when all later steps begin that much elsewhere."""
        ends, slopes = self._stepped(begins, 1), []
        for column in range(len(begins)):
            aside, difference = begins.copy(), ASIDE * self._units[column]
            aside[column] += difference
            slopes.append((self._stepped(aside, 1) - ends) / difference)
        carried, total = np.empty_like(gaps), np.zeros_like(gaps[:, 0])
        for t in range(gaps.shape[1]):
            # Sums of a fixed order, which a product of matrices is not.
            total = sum((slope[:, t] * moved for slope, moved in zip(slopes, total, strict=True)), gaps[:, t])
            carried[:, t] = total
        return carried

    def _integrated(self, x: Floats, u: Floats, sub_steps: int) -> Floats:
        for _ in range(sub_steps):
            x = self._advanced(x, u, self._dt / sub_steps, self._limits)
        return x

    def _advanced(self, x: Floats, u: Floats, h: float, limits: tuple[Floats, ...]) -> Floats:
        k1 = self._slope(x, u, limits)
        k2 = self._slope(x + h / 2 * k1, u, limits)
        k3 = self._slope(x + h / 2 * k2, u, limits)
        k4 = self._slope(x + h * k3, u, limits)
        return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)

    def _slope(self, x: Floats, u: Floats, limits: tuple[Floats, ...] | None = None) -> Floats:
        return self._call(self._model.functions.derivative, x, u, limits=limits)

    def _call(
        self, function: Callable[..., Iterable[ArrayLike]], *arguments: Floats, limits: tuple[Floats, ...] | None = None
    ) -> Floats:
        """A function of the model over arrays whose first axis is the component; it may return single numbers too."""
        parts = tuple(function(*map(tuple, arguments), self._limits if limits is None else limits, self._ops))
        result = np.empty((len(parts), *arguments[0].shape[1:]))
        for part, value in enumerate(parts):
            result[part] = value
        return result

    def displacement(self, steps: slice, sub_steps: int) -> Floats:
        """``(T, S+1, R, d)`` where the robots are at the ends of sub-steps, from where each step began [m]."""
        begin = self._begins[: self._model.dimension, steps]
        displacements = [x[: self._model.dimension] - begin for x in self._within(steps, sub_steps)]
        return np.moveaxis(np.stack(displacements), (0, 1), (1, 3))

    def headings(self, steps: slice, sub_steps: int) -> Floats:
        """``(T, S+1, R, 1 + trailers)`` headings at the ends of sub-steps [rad]; zero for a model without one."""
        return np.stack([self._headings(x) for x in self._within(steps, sub_steps)], axis=1)

    def _headings(self, states: Floats) -> Floats:
        """``(..., 1 + trailers)`` headings in states ``(n, ...)`` of the robot and of its trailers."""
        column = self._model.heading_index
        headings = [np.zeros_like(states[0]) if column is None else states[column]]
        for hitch, _ in self._model.trailers:
            headings.append(headings[-1] - states[hitch])
        return np.stack(headings, axis=-1)

    def _within(self, steps: slice, sub_steps: int) -> list[Floats]:
        """``(n, T, R)`` states at the ends of sub-steps, the beginning of each step first; those asked for last are
        known, and so are the first steps of them. Who is at rest when a step begins is so until it ends.
        """
        steps = slice(*steps.indices(self._begins.shape[1]))
        known = self._known
        if known is None or known[1] != sub_steps or known[0].start != steps.start or known[0].stop < steps.stop:
            x, moving = self._begins[:, steps], self.moving[steps]
            own, u = x[:, moving], self._commands[:, steps][:, moving]
            limits = tuple(np.broadcast_to(limit, moving.shape)[moving] for limit in self._limits)
            states = [x]
            for _ in range(sub_steps):
                own, x = self._advanced(own, u, self._dt / sub_steps, limits), x.copy()
                x[:, moving] = own
                states.append(x)
            self._known = known = (steps, sub_steps, states)
        return [x[:, : steps.stop - steps.start] for x in known[2]]


def _ops() -> Any:
    """The portable functions, which compute sine and cosine of the same numbers once: they take most of the time."""
    known: list[tuple[Floats, tuple[Floats, Floats]]] = []

    def sin_cos(x: Floats) -> tuple[Floats, Floats]:
        for asked, answer in known:
            # Runge-Kutta's second and third stage mostly have the same heading.
            if asked is x or np.array_equal(asked, x):
                return answer
        known[:] = [*known[-1:], (x, portable.sin_cos(x))]
        return known[-1][1]

    return portable.NUMPY_OPS._replace(sin=lambda x: sin_cos(x)[0], cos=lambda x: sin_cos(x)[1])
