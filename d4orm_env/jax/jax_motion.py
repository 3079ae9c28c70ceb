"""Robots' motion in JAX: a step of all worlds, and rollouts, which are one kernel on a GPU.

Nobody's motion depends on the others: a rollout needs no more than a robot's own numbers. A loop over time steps would
start small kernels in every one.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.dynamics import transition
from d4orm_env.dynamics.models import MODELS
from d4orm_env.dynamics.robot_model import Model, Ops
from d4orm_env.jax.gpu_kernels import Components, move_robots, on_gpu

OPS = Ops(jnp.cos, jnp.sin, jnp.sqrt, jnp.minimum, jnp.maximum, jnp.arctan2, jnp.where)

Given: TypeAlias = Array | FloatArray
"""An array of the problem: inside a compiled function it is traced."""


class Worlds(NamedTuple):
    """A block of worlds on the way."""

    state: Array  #: ``(K, n, S)``
    arrived: Array  #: ``(K, S)`` bool
    control: Array  #: ``(K, m, S)`` executed last


class Numbers(NamedTuple):
    """Numbers that a robot's motion depends on, each a number or an array that fits its state's components."""

    time_step: tuple[Given, ...]  #: Four, see :class:`~d4orm_env.dynamics.transition.TimeStep`
    limits: tuple[Given, ...]  #: The model's
    goal: tuple[Given, ...]  #: ``d``
    squared_goal_radius: Given  #: Arriving within its root
    squared_goal_speed: Given  #: And no faster than its root
    docks: Given  #: Positive if a robot that has arrived stays
    #: Squared chord by which the goal heading may be missed, its cosine and sine, and those of three hitch angles, zero
    #: for any; empty without
    facing: tuple[Given, ...]


def numbers_of(model: Model, robots: np.ndarray[Any, Any], arrays: ProblemArrays) -> Numbers:
    """Numbers of robots ``(R,)`` of one model, each of shape ``(R, 1)``."""

    def column(values: Given | np.generic) -> Array:
        return jnp.broadcast_to(jnp.asarray(values), (len(robots),))[:, None]

    facing: tuple[Given, ...] = ()
    if model.heading_index is not None and arrays.goal_direction is not None:
        aim = jnp.asarray(arrays.goal_direction)[robots]
        facing = (column(jnp.asarray(arrays.squared_goal_chord)[robots]), *map(column, aim.T))
    return Numbers(
        tuple(map(column, arrays.time_step)),
        tuple(column(arrays.limits[robots, i]) for i in range(len(model.limit_names))),
        tuple(column(arrays.goal[robots, i]) for i in range(model.dimension)),
        column(arrays.squared_goal_radius),
        column(arrays.squared_goal_speed[robots]),
        column(arrays.docks).astype(jnp.float32),
        facing,
    )


def advance_robots(
    model: Model, numbers: Numbers, x: Components, control: Components, arrived: Array
) -> tuple[Components, Components, Array]:
    """One step of robots of one model, docking included: states, executed controls, and flags of arrival."""
    functions, limits = model.functions, numbers.limits
    u = functions.limit_control(control, limits, OPS)
    y = transition.advance(functions, x, u, limits, transition.TimeStep(*numbers.time_step), OPS)
    gap2 = sum((y[i] - aim) ** 2 for i, aim in enumerate(numbers.goal))
    speed2 = sum(v * v for v in functions.velocity(y, u, limits, OPS))
    arrives = transition.arrives(gap2, speed2, numbers.squared_goal_radius, numbers.squared_goal_speed)
    if numbers.facing and model.heading_index is not None:
        heading = y[model.heading_index]
        chord2, aim_x, aim_y, *hitches = numbers.facing
        arrives &= transition.faces(jnp.cos(heading), jnp.sin(heading), aim_x, aim_y, chord2)
        for (hitch, _), c, s in zip(model.trailers, hitches[::2], hitches[1::2], strict=False):
            bent = transition.faces(jnp.cos(y[hitch]), jnp.sin(y[hitch]), c, s, chord2)
            arrives &= bent | ((c == 0) & (s == 0))
    at_rest = transition.absorbed(arrived, numbers.docks > 0)
    docks, zero = transition.absorbed(arrives, numbers.docks > 0), jnp.zeros_like(gap2)
    after = tuple(
        jnp.where(at_rest, old, jnp.where(docks, rest, new))
        for old, rest, new in zip(x, functions.rest(y, zero), y, strict=True)
    )
    return after, tuple(jnp.where(at_rest, zero, component) for component in u), at_rest | arrives


def by_model(models: tuple[str, ...]) -> Iterator[tuple[Model, np.ndarray[Any, Any]]]:
    """Models of a team, and which robots ``(R,)`` are of each."""
    for name in dict.fromkeys(models):
        yield MODELS[name], np.flatnonzero(np.array(models) == name)


def advance_worlds(models: tuple[str, ...], arrays: ProblemArrays, worlds: Worlds, control: Array) -> Worlds:
    """One step of every robot in every world, docking included, under ``control`` ``(K, m, S)``, not yet clipped."""
    state, executed, arrived = worlds.state, jnp.zeros_like(control), worlds.arrived
    for model, robots in by_model(models):
        x = tuple(worlds.state[robots, i] for i in range(model.state_size))
        u = tuple(control[robots, i] for i in range(model.control_size))
        numbers = numbers_of(model, robots, arrays)
        after, done, absorbed = advance_robots(model, numbers, x, u, worlds.arrived[robots])
        for i, component in enumerate(after):
            state = state.at[robots, i].set(component)
        for i, component in enumerate(done):
            executed = executed.at[robots, i].set(component)
        arrived = arrived.at[robots].set(absorbed)
    return Worlds(state, arrived, executed)


def roll_out(models: tuple[str, ...], arrays: ProblemArrays, begin: Worlds, controls: Array) -> Worlds:
    """Worlds after each of the controls ``(H, K, m, S)``, as arrays with the time first."""
    kernel, elsewhere = partial(_roll_out_by_kernel, models, arrays), partial(_roll_out_in_steps, models, arrays)
    return on_gpu(kernel, elsewhere, begin, controls)


def _roll_out_in_steps(models: tuple[str, ...], arrays: ProblemArrays, begin: Worlds, controls: Array) -> Worlds:
    def advance(worlds: Worlds, control: Array) -> tuple[Worlds, Worlds]:
        worlds = advance_worlds(models, arrays, worlds, control)
        return worlds, worlds

    return jax.lax.scan(advance, begin, controls)[1]


def _roll_out_by_kernel(models: tuple[str, ...], arrays: ProblemArrays, begin: Worlds, controls: Array) -> Worlds:
    def move(model: Model, robots: np.ndarray[Any, Any], begin: Worlds, controls: Array) -> Worlds:
        numbers = numbers_of(model, robots, arrays)
        return Worlds(*move_robots(partial(advance_robots, model), numbers, begin.state, begin.arrived, controls))

    groups = list(by_model(models))
    if len(groups) == 1:
        return move(*groups[0], begin, controls)
    horizon, (num_robots, num_samples) = len(controls), begin.arrived.shape
    state = jnp.zeros((horizon, *begin.state.shape), jnp.float32)
    arrived = jnp.zeros((horizon, num_robots, num_samples), bool)
    after = Worlds(state, arrived, jnp.zeros_like(controls))
    for model, robots in groups:
        n, m = model.state_size, model.control_size
        before = Worlds(begin.state[robots, :n], begin.arrived[robots], begin.control)
        moved = move(model, robots, before, controls[:, robots, :m])
        after = Worlds(
            after.state.at[:, robots, :n].set(moved.state),
            after.arrived.at[:, robots].set(moved.arrived),
            after.control.at[:, robots, :m].set(moved.control),
        )
    return after
