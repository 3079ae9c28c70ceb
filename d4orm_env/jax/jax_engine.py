"""The JAX engine: the same physics as pure array functions, for GPUs and TPUs, and for those who jit, vmap and grad.

Arrays keep the samples on the last axis, ``(K, component, S)``, as on the CPU engine. A whole denoising run is one
compiled loop; nothing returns to the host before it ends, or before the next look at whether it is to be stopped.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from d4orm_env.core.arrays import BoolArray, FloatArray
from d4orm_env.core.bodies import FootprintArrays
from d4orm_env.core.problem import Problem
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.core.trajectory import Trajectory
from d4orm_env.dynamics import collision, transition
from d4orm_env.dynamics.models import names_of_codes
from d4orm_env.engine import noise
from d4orm_env.engine.types import StepResult, checked_controls
from d4orm_env.jax import jax_footprints as footprints
from d4orm_env.jax.gpu_kernels import LANES, count_near, on_gpu
from d4orm_env.jax.jax_footprints import MovingBodies, PlacedBodies
from d4orm_env.jax.jax_motion import OPS, Given, Worlds, advance_worlds, roll_out

BIT_OPS = noise.BitOps(
    uint32=lambda x: x.astype(jnp.uint32),
    int32=lambda x: x.astype(jnp.int32),
    to_float=lambda x: x.astype(jnp.float32),
    float_bits=lambda x: jax.lax.bitcast_convert_type(x, jnp.int32),
    bits_float=lambda x: jax.lax.bitcast_convert_type(x, jnp.float32),
    sqrt=jnp.sqrt,
)

FEW = 8
"""Most obstacles that are tested one and all; more are looked up in their index."""

Contacts: TypeAlias = tuple[Array, Array, Array]
"""Flags of collision and of margin violation, and rewards, each ``(K, S)``."""


def robot_contacts(arrays: ProblemArrays, state: Array, extra: Array | np.float32) -> Array:
    """``(K, S)`` how many others a robot in ``state`` ``(K, n, S)`` is within ``extra`` of."""
    dimension, f = arrays.goal.shape[1], arrays.footprints
    distance = arrays.radius[:, None] + arrays.radius[None, :] + extra
    squared_distance = jnp.where(jnp.eye(len(arrays.radius), dtype=bool), -1, distance * distance)

    def count(state: Array, squared_distance: Array) -> Array:
        bodies = None if f is None else footprints.place_robots(f, state, dimension)
        robots = _Placed(state[:, :dimension], f, bodies)
        return _count_near(robots, robots, squared_distance, extra)

    if f is not None or state.shape[-1] < LANES:
        return count(state, squared_distance)
    return on_gpu(partial(count_near, dimension), count, jax.lax.stop_gradient(state), squared_distance)


def moving_contacts(arrays: ProblemArrays, state: Array, others: MovingBodies, extra: Array | np.float32) -> Array:
    """``(K, S)`` of how many other bodies a robot is within ``extra``."""
    d, f, g = arrays.goal.shape[1], arrays.footprints, others.footprints
    distance = arrays.radius[:, None] + others.radius[None, :] + extra
    discs = f is None and g is None
    robots = _Placed(state[:, :d], f, None if discs else footprints.place_robots(f, state, d, arrays.radius))
    moving = _Placed(jnp.asarray(others.positions)[..., None], g, None if discs else footprints.place_bodies(others))
    return _count_near(robots, moving, jnp.asarray(distance * distance), extra)


class _Placed(NamedTuple):
    """``R`` robots, or what moves as they do."""

    position: Array  #: ``(R, d, S)``
    footprints: FootprintArrays | None  #: Which bodies are whose; ``None`` for one each
    placed: PlacedBodies | None  #: Their bodies, or ``None`` where all are discs


def _count_near(robots: _Placed, others: _Placed, squared_distance: Array, extra: Array | np.float32) -> Array:
    """``(R, S)`` how many others a robot is within ``extra`` of, being nearer than the root of ``(R, O)``.

    Others are taken one by one where there are many samples: all pairs at once would be gigabytes.
    """
    num_robots, _, num_samples = robots.position.shape
    if num_samples < LANES:
        gaps = robots.position[:, None] - others.position[None]
        near = (gaps**2).sum(axis=2) <= squared_distance[..., None]
        if robots.placed is not None and others.placed is not None:
            touch = footprints.pairs_within(robots.placed, others.placed, extra)
            touch = jnp.moveaxis(footprints.of_robots(robots.footprints, touch, num_robots), 1, 0)
            near &= jnp.moveaxis(footprints.of_robots(others.footprints, touch, len(others.position)), 0, 1)
        return near.sum(axis=1, dtype=jnp.int32)

    def compare(other: Array, count: Array) -> Array:
        gaps = robots.position - others.position[other][None]
        near = (gaps**2).sum(axis=1) <= squared_distance[:, other, None]
        if robots.placed is not None and others.placed is not None:
            rows = footprints.bodies_of(others.footprints, other, len(others.position))
            its = PlacedBodies(*(jnp.take(part, rows, axis=part.ndim - 2) for part in others.placed))
            touch = footprints.pairs_within(robots.placed, its, extra).any(axis=1)
            near &= footprints.of_robots(robots.footprints, touch, num_robots)
        return count + near.astype(jnp.int32)

    return jax.lax.fori_loop(0, len(others.position), compare, jnp.zeros((num_robots, num_samples), jnp.int32))


def obstacle_contacts(arrays: ProblemArrays, state: Array, extra: Array | np.float32) -> Array:
    """``(K, S)`` bool: whether a robot is within ``extra`` of a static obstacle or a bound."""
    position = state[:, : arrays.goal.shape[1]]
    if arrays.footprints is not None:
        return footprints.static_contacts(arrays, state, extra)
    radius = (arrays.radius + extra)[:, None]
    hit = jnp.zeros((position.shape[0], position.shape[2]), bool)
    for axis in range(position.shape[1]):
        hit |= collision.leaves(position[:, axis], radius, arrays.bounds[0, axis], arrays.bounds[1, axis])
    if len(arrays.boxes) + len(arrays.triangles) > FEW and arrays.grid is not None:
        return hit | _indexed_contacts(arrays, position, radius)
    if len(arrays.boxes):
        box = jnp.moveaxis(arrays.boxes, 1, 0)[..., None, :, None]
        hit |= _touches_box(box, radius[:, None], position[:, None]).any(axis=1)
    if len(arrays.triangles):
        corners = jnp.moveaxis(arrays.triangles, 1, 0)[..., None, :, None]
        hit |= _touches_triangle(corners, radius[:, None], position[:, None]).any(axis=1)
    return hit


def _touches_box(box: Given, radius: Given, position: Array) -> Array:
    """Flags of bodies at ``(K, ., d, S)`` that touch rounded boxes, given as ``2 d + 1`` columns."""
    d, gap2 = position.shape[-2], jnp.float32(0)
    for axis in range(d):
        gap = collision.axis_gap(position[..., axis, :], box[axis], box[d + axis], jnp.float32(0), OPS)
        gap2 = gap2 + gap * gap
    total = radius + box[2 * d]
    return gap2 <= total * total


def _touches_triangle(corners: Given, radius: Given, position: Array) -> Array:
    """The same for triangles, ``corners`` being their six columns."""
    return collision.meets_triangle(
        tuple(corners), position[..., 0, :], position[..., 1, :], radius, jnp.float32(0), OPS
    )


def _indexed_contacts(arrays: ProblemArrays, position: Array, radius: Given) -> Array:
    """``(K, S)`` bool: contacts with obstacles, see :mod:`d4orm_env.engine.obstacles`."""
    index, cell = arrays.grid, jnp.int32(0)
    for axis in range(position.shape[1]):
        step = (position[:, axis] - index.low[axis]) * index.scale
        # Asked this way round, what is not a number counts as zero.
        step = jnp.minimum(jnp.where(step > 0, step, 0), (index.size[axis] - 1).astype(jnp.float32))
        cell = cell * index.size[axis] + step.astype(jnp.int32)
    clearance, begin, end = index.clearance[cell], index.first[cell], index.first[cell + 1]
    sure, near = clearance <= radius - index.slack, clearance <= radius + index.slack
    num_boxes = len(arrays.boxes)

    def test(number: Array, hit: Array) -> Array:
        item = index.items[jnp.minimum(begin + number, end - 1)]
        here = jnp.zeros_like(hit)
        if num_boxes:
            box = jnp.moveaxis(arrays.boxes[jnp.minimum(item, num_boxes - 1)], -1, 0)
            here |= _touches_box(box, radius, position) & (item < num_boxes)
        if len(arrays.triangles):
            corners = jnp.moveaxis(arrays.triangles[jnp.maximum(item - num_boxes, 0)], -1, 0)
            here |= _touches_triangle(corners, radius, position) & (item >= num_boxes)
        return hit | (near & here)

    return jax.lax.fori_loop(jnp.int32(0), index.longest, test, sure)


def goal_distance(arrays: ProblemArrays, position: Array) -> Array:
    """``(K, S)`` distance of every robot to its goal; its gradient at the goal itself is zero."""
    gap2 = ((position - arrays.goal[..., None]) ** 2).sum(axis=1)
    tiny = arrays.squared_goal_radius * jnp.float32(2.0**-32)
    # Asked this way round, a position that is not a number stays one: it must not pass for the goal.
    return jnp.where(gap2 <= tiny, jnp.float32(0), jnp.sqrt(jnp.maximum(gap2, tiny)))


def rewards_of(
    arrays: ProblemArrays,
    position: Array,
    pair_violation: Array,
    obstacle_violation: Array,
    penalty: Array | np.float32,
) -> Array:
    """``(K, S)`` reward of one step."""
    distance, one = goal_distance(arrays, position), jnp.float32(1)
    violations = pair_violation.astype(jnp.float32), obstacle_violation.astype(jnp.float32), jnp.float32(0)
    return transition.step_reward(distance, arrays.inverse_initial_distance[:, None], violations, penalty, one)


def check_contacts(arrays: ProblemArrays, state: Array) -> Contacts:
    """``(collided, margin violated, reward)`` of teams in ``state`` ``(K, n, S)``, each ``(K, S)``."""
    zero = jnp.float32(0)
    contact = (robot_contacts(arrays, state, zero) > 0) | obstacle_contacts(arrays, state, zero)
    pair, obstacle = robot_contacts(arrays, state, arrays.margin) > 0, obstacle_contacts(arrays, state, arrays.margin)
    position = state[:, : arrays.goal.shape[1]]
    return contact, pair | obstacle, rewards_of(arrays, position, pair, obstacle, arrays.collision_penalty)


@partial(jax.jit, static_argnums=0)
def _step(models: tuple[str, ...], arrays: ProblemArrays, worlds: Worlds, control: Array) -> tuple[Worlds, Contacts]:
    worlds = advance_worlds(models, arrays, worlds, control)
    return worlds, check_contacts(arrays, worlds.state)


@partial(jax.jit, static_argnums=0)
def _rollout(
    models: tuple[str, ...], arrays: ProblemArrays, worlds: Worlds, controls: Array
) -> tuple[Contacts, tuple[Worlds, Contacts]]:
    after = roll_out(models, arrays, worlds, controls)
    contacts = jax.vmap(partial(check_contacts, arrays))(after.state)
    return check_contacts(arrays, worlds.state), (after, contacts)


def _rolled_out(problem: Problem, controls: FloatArray) -> tuple[Contacts, tuple[Worlds, Contacts]]:
    """:func:`_rollout` of ``(M, H, K, m)`` samples from the problem's start."""
    robots, samples = problem.num_robots, len(controls)
    start = Worlds(
        jnp.broadcast_to(problem.start[..., None], (*problem.start.shape, samples)),
        jnp.zeros((robots, samples), bool),
        jnp.zeros((robots, problem.control_size, samples), jnp.float32),
    )
    return _rollout(problem.team.models, problem.arrays, start, jnp.moveaxis(jnp.asarray(controls), 0, -1))


@partial(jax.jit, static_argnums=0)
def _move(models: tuple[str, ...], arrays: ProblemArrays, worlds: Worlds, controls: Array) -> Array:
    return roll_out(models, arrays, worlds, controls).state


class JaxEngine:
    """The physics in JAX, on whatever device JAX has chosen. Stateless: all instances are alike."""

    name = "jax"

    def step(self, arrays: ProblemArrays, states: FloatArray, arrived: BoolArray, controls: FloatArray) -> StepResult:
        """See :meth:`d4orm_env.engine.types.Engine.step`."""
        models = names_of_codes(arrays.model_codes)
        before = states[..., None], np.asarray(arrived)[..., None], np.zeros_like(controls)[..., None]
        worlds, contacts = _step(models, arrays, Worlds(*map(jnp.asarray, before)), jnp.asarray(controls)[..., None])
        collided, margin_violated, rewards = (np.asarray(value)[..., 0] for value in contacts)
        state, arrived, control = (np.asarray(value)[..., 0] for value in worlds)
        return StepResult(state, control, arrived, collided, margin_violated, rewards)

    def move(self, arrays: ProblemArrays, states: FloatArray, arrived: BoolArray, controls: FloatArray) -> FloatArray:
        """See :meth:`d4orm_env.engine.types.Engine.move`."""
        before = states[..., None], np.asarray(arrived)[..., None], np.zeros_like(controls[0])[..., None]
        worlds = Worlds(*map(jnp.asarray, before))
        after = _move(names_of_codes(arrays.model_codes), arrays, worlds, jnp.asarray(controls)[..., None])
        return np.concatenate([states[None], np.asarray(after)[..., 0]])

    def rollout(self, problem: Problem, controls: ArrayLike) -> Trajectory:
        """See :meth:`d4orm_env.engine.types.Engine.rollout`."""
        num_robots = problem.num_robots
        first, (worlds, contacts) = _rolled_out(problem, checked_controls(problem, controls)[None])
        states = np.concatenate([problem.start[None], np.asarray(worlds.state)[..., 0]])
        collided, margin_violated = (
            np.concatenate([np.asarray(first[i])[None, :, 0], np.asarray(contacts[i])[..., 0]]) for i in range(2)
        )
        return Trajectory(
            states=states,
            positions=np.ascontiguousarray(states[..., : problem.dimension]),
            controls=np.asarray(worlds.control)[..., 0],
            rewards=np.asarray(contacts[2])[..., 0],
            arrived=np.concatenate([np.zeros((1, num_robots), bool), np.asarray(worlds.arrived)[..., 0]]),
            collided=collided,
            margin_violated=margin_violated,
        )

    def score(self, problem: Problem, controls: ArrayLike) -> FloatArray:
        """See :meth:`d4orm_env.engine.types.Engine.score`."""
        _, (_, contacts) = _rolled_out(problem, checked_controls(problem, controls, batch=True))
        return np.asarray(contacts[2].mean(axis=0).T)
