"""Gaps at the end of a motion, closed by the least change of its controls within their bounds.

Time after time as if effects were linear (Gauss and Newton), with derivatives of the model's own steps.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray, Floats
from d4orm_env.core.problem import Problem
from d4orm_env.dynamics.models import MODELS
from d4orm_env.dynamics.robot_model import Model, TimeStep
from d4orm_env.engine.caching import Kernel, cached_kernel
from d4orm_env.engine.compiling import OPTIONS, compiled, inlined, to_fixed_tuple
from d4orm_env.engine.elementary import OPS
from d4orm_env.engine.stepping import make_stepper, models_key
from d4orm_planners.manoeuvres.lattice import TURN
from d4orm_planners.manoeuvres.snapping import Goal

SWEEPS, PASSES = 4, 6
"""Rounds in which a gap is closed, and in which controls are found that the least change would bring beyond bounds."""
EXACT = 0.5  #: Share of the goal's tolerances within which a gap is closed
DIFFERENCE, RIDGE = 1e-4, 1e-9
"""Difference by which derivatives are taken, and share of the normal equations' trace added to their diagonal."""


class Ends(NamedTuple):
    """Data of a robot whose motion is shortened."""

    limits: Floats  #: ``(L,)``
    h: Floats  #: ``(4,)`` the time step and its parts
    goal: Floats  #: ``(n,)`` state
    tolerance: Floats  #: ``(n,)`` infinite for components that need not be as the goal's
    angles: BoolArray  #: ``(n,)``
    bounds: Floats  #: ``(2, m)`` of the controls


class GapSpace(NamedTuple):
    """Workspace for ``T`` steps."""

    states: Floats  #: ``(T + 1, n)``
    effects: Floats  #: ``(T, m, n)`` of controls, in their bounds, on the last state
    change: Floats  #: ``(T, m)`` of controls, in their bounds
    free: BoolArray  #: ``(T, m)`` those that are not at a bound
    onward: Floats  #: ``(n, n)`` effect of a state on the last one
    local: Floats  #: ``(n, n)`` of a state on the next one
    rows: Floats  #: ``(2, n)`` the last derivative, and a row of ``onward``
    normal: Floats  #: ``(n, n + 1)`` normal equations

    @classmethod
    def of(cls, steps: int, n: int, m: int) -> GapSpace:
        """Workspace for a motion."""
        return cls(
            np.empty((steps + 1, n)), np.empty((steps, m, n)), np.empty((steps, m)), np.empty((steps, m), np.bool_),
            np.empty((n, n)), np.empty((n, n)), np.empty((2, n)), np.empty((n, n + 1)),
        )  # fmt: skip


def ends_of(problem: Problem, number: int, goal: Goal, last: Floats | FloatArray) -> Ends:
    """Data of a robot of a team: it is to end at its goal at rest, its trailers as asked or as in the ``last`` pose."""
    model, limits = problem.team.robot_models[number], problem.team.limits[number].astype(np.float64)
    n, turned = model.state_size, [] if model.heading_index is None else [(model.heading_index, goal.heading)]
    wanted, tolerance, angles = np.zeros(n), np.full(n, np.inf), np.zeros(n, np.bool_)
    wanted[:2], tolerance[:2] = (goal.x, goal.y), EXACT * goal.radius
    asked = np.array(goal.hitches)
    hitches = np.where(np.isnan(asked), last[3:], asked).tolist()
    for angle, value in (*turned, *zip([hitch for hitch, _ in model.trailers], hitches, strict=False)):
        if not np.isnan(value):
            wanted[angle], tolerance[angle] = value, EXACT * goal.tolerance
    # What is left of its speed must not lead it away from there.
    moving = np.array(model.functions.rest((1.0,) * n, 0.0)) == 0.0
    tolerance[moving] = (1 - EXACT) / 2 * goal.radius / (problem.horizon * problem.dt)
    angles[list(model.angles)] = True
    bounds = problem.team.control_bounds[:, number, : model.control_size].astype(np.float64)
    h = problem.dt / np.array([1.0, 2.0, 3.0, 6.0])
    return Ends(limits[: len(model.limit_names)], h, wanted, tolerance, angles, bounds)


@compiled
def _wrapped(angle: bool, value: float) -> float:
    return value - TURN * np.rint(value / TURN) if angle else value


@compiled
def _gap(ends: Ends, state: Floats, gap: Floats) -> float:
    """Write what is missing to the goal; return the largest part of it, in the tolerances."""
    worst = 0.0
    for i in range(state.shape[0]):
        asked = ends.tolerance[i] < np.inf
        gap[i] = _wrapped(ends.angles[i], ends.goal[i] - state[i]) if asked else 0.0
        worst = max(worst, abs(gap[i]) / ends.tolerance[i])
    return worst


@compiled
def _solve(normal: Floats, solution: Floats) -> None:
    """Solve symmetric positive equations ``(n, n + 1)``, which are overwritten."""
    n = normal.shape[0]
    for i in range(n):
        for row in range(i + 1, n):
            factor = normal[row, i] / normal[i, i]
            for k in range(i, n + 1):
                normal[row, k] -= factor * normal[i, k]
    for i in range(n - 1, -1, -1):
        value = normal[i, n]
        for k in range(i + 1, n):
            value -= normal[i, k] * solution[k]
        solution[i] = value / normal[i, i]


@compiled
def _fill_normal(ends: Ends, gap: Floats, space: GapSpace, first: int, count: int) -> None:
    """Write the normal equations of the free controls, for what those at bounds leave of the gap."""
    normal, n, trace = space.normal, gap.shape[0], 0.0
    normal[:] = 0.0
    for i in range(n):
        normal[i, n] = gap[i]
    for t in range(first, count):
        for j in range(space.change.shape[1]):
            effect = space.effects[t, j]
            for i in range(n):
                if space.free[t, j]:
                    for k in range(n):
                        normal[i, k] += effect[i] * effect[k]
                else:
                    normal[i, n] -= effect[i] * space.change[t, j]
    for i in range(n):
        trace += normal[i, i]
    for i in range(n):
        normal[i, i] += RIDGE * trace if ends.tolerance[i] < np.inf and trace > 0.0 else 1.0


@compiled
def _least_change(ends: Ends, controls: Floats, first: int, gap: Floats, multipliers: Floats, space: GapSpace) -> None:
    """Change the controls as little as closes the gap as if effects were linear, none beyond its bounds."""
    count, change, free = controls.shape[0], space.change, space.free
    change[first:count], free[first:count] = 0.0, True
    for _ in range(PASSES):
        _fill_normal(ends, gap, space, first, count)
        _solve(space.normal, multipliers)
        bound = False
        for t in range(first, count):
            for j in range(controls.shape[1]):
                if not free[t, j]:
                    continue
                value, unit = 0.0, ends.bounds[1, j]
                for i in range(gap.shape[0]):
                    value += space.effects[t, j, i] * multipliers[i]
                least, most = (ends.bounds[0, j] - controls[t, j]) / unit, (unit - controls[t, j]) / unit
                change[t, j] = max(least, min(most, value))
                free[t, j] = change[t, j] == value
                bound = bound or not free[t, j]
        if not bound:
            break
    for t in range(first, count):
        for j in range(controls.shape[1]):
            controls[t, j] += change[t, j] * ends.bounds[1, j]


@compiled
def _chain(space: GapSpace, first: int) -> None:
    """Carry the effect of a state on the last one back by a step; the first components' local effects are their own."""
    n = space.local.shape[0]
    for i in range(n):
        row = space.rows[1]
        for k in range(n):
            row[k] = space.onward[i, k]
        for k in range(first, n):
            value = 0.0
            for other in range(n):
                value += row[other] * space.local[other, k]
            space.onward[i, k] = value


def _stepper(model: Model) -> Any:
    """Compiled ``(ends, state, control, after)``: writes the state after a step, the control within limits."""
    (move, _), limit_control = make_stepper(model), inlined(model.functions.limit_control)
    n, m, num_limits = model.state_size, model.control_size, len(model.limit_names)

    @inlined
    def step(ends: Ends, state: Floats, control: Floats, after: Floats) -> None:
        limits = to_fixed_tuple(ends.limits, num_limits)
        h = TimeStep(ends.h[0], ends.h[1], ends.h[2], ends.h[3])
        u = limit_control(to_fixed_tuple(control, m), limits, OPS)
        x = move(False, to_fixed_tuple(state, n), u, limits, h)
        for i in range(n):
            after[i] = x[i]

    return step


def _effect_finder(model: Model, step: Any) -> Any:
    """Compiled ``(ends, controls, first, space)``: writes the effects of controls from ``first`` on."""
    n, m, d = model.state_size, model.control_size, model.dimension

    @compiled
    def differ(
        ends: Ends, state: Floats, control: Floats, changed: Floats, at: int, following: Floats, space: GapSpace
    ) -> None:  # fmt: skip
        """Write the derivative of the next state by a component of ``changed``, either the state or the control."""
        value, after = changed[at], space.rows[0]
        difference = -DIFFERENCE if value > 0.0 else DIFFERENCE
        changed[at] = value + difference
        step(ends, state, control, after)
        changed[at] = value
        for i in range(n):
            after[i] = _wrapped(ends.angles[i], after[i] - following[i]) / difference

    @compiled
    def find_effects(ends: Ends, controls: Floats, first: int, space: GapSpace) -> None:
        for i in range(n):
            for k in range(n):
                space.onward[i, k] = 1.0 if i == k and ends.tolerance[i] < np.inf else 0.0
        for t in range(controls.shape[0] - 1, first - 1, -1):
            state, control, derivative = space.states[t], controls[t], space.rows[0]
            for j in range(m):
                differ(ends, state, control, control, j, space.states[t + 1], space)
                for i in range(n):
                    effect = 0.0
                    for k in range(n):
                        effect += space.onward[i, k] * derivative[k]
                    space.effects[t, j, i] = effect * ends.bounds[1, j]
            for k in range(d, n):
                differ(ends, state, control, state, k, space.states[t + 1], space)
                for i in range(n):
                    space.local[i, k] = derivative[i]
            _chain(space, d)

    return find_effects


@cache
def gap_closer(name: str) -> Kernel[[Ends, Floats, int, GapSpace], bool]:
    """The kernel of robots of a model: changes controls ``(T, m)`` from a step on, so that they lead from the first
    state of the workspace to the goal, and fills in the other states; returns whether that worked.
    """
    model = MODELS[name]
    step, n = _stepper(model), model.state_size
    find_effects = _effect_finder(model, step)

    @cached_kernel(variant=name, key=models_key((name,)), **OPTIONS)
    def close_gap(ends: Ends, controls: Floats, first: int, space: GapSpace) -> bool:
        gap, multipliers, states = np.empty(n), np.empty(n), space.states
        for sweep in range(SWEEPS + 1):
            for t in range(controls.shape[0]):
                step(ends, states[t], controls[t], states[t + 1])
            if _gap(ends, states[controls.shape[0]], gap) <= 1.0:
                return True
            if sweep < SWEEPS:
                find_effects(ends, controls, first, space)
                _least_change(ends, controls, first, gap, multipliers, space)
        return False

    return close_gap
