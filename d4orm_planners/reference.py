"""The sampling loop in plain JAX, the way such code is usually written: slow on purpose, and the oracle of the engines.

One team is rolled out by a ``lax.scan`` over time, its robots by ``vmap``, the samples by another ``vmap`` on the first
axis, with ``jax.random`` normals stored in full and the matrix of all distances at every step. The physics is written
out here a second time, straight from the paper (sections III and IV-B), and shares no code with the core or the
engines: agreement is evidence for both, and the benchmark has a baseline.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import ArrayLike

from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.problem import Problem
from d4orm_env.dynamics.models import COMMON
from d4orm_env.dynamics.transition import docking_speed


class PlainTeam(NamedTuple):
    """A problem of one robot model, as arrays; obstacles and bounds as in :class:`~d4orm_env.core.world.World`."""

    start: Array  # (K, n)
    goal: Array  # (K, d)
    radius: Array  # (K,)
    max_speed: Array  # (K,)
    max_acceleration: Array  # (K,)
    max_turn_rate: Array  # (K,)
    max_reverse_speed: Array  # (K,) of differential drives
    balls: Array  # (., d + 1) centre and radius of circles or spheres
    cylinders: Array  # (., 3) axis and radius of vertical cylinders
    boxes: Array  # (., 2 d) lower and upper corner
    bounds: Array  # (2, d)
    dt: Array
    margin: Array
    goal_radius: Array
    docking_speed: Array  # (K,) goal speed and an allowance; infinite without a limit
    collision_penalty: Array


def plain_team(problem: Problem) -> tuple[str, PlainTeam]:
    """The model's name and the arrays of a problem; ValueError for mixed teams, and models that this does not cover."""
    models = sorted(set(problem.team.models))
    if len(models) > 1:
        raise ValueError(f"the plain formulation moves one model at a time, not {' and '.join(models)}; use an engine")
    if models[0] not in COMMON:
        raise ValueError(f"the plain formulation has {', '.join(COMMON)}, not {models[0]}; use an engine")
    team, world = problem.team, problem.world
    numbers = (
        problem.start, problem.goal, team.radius, team.max_speed, team.max_acceleration, team.max_turn_rate,
        np.minimum(team.own_limits.get("max_reverse_speed", np.inf), team.max_speed),
        world.balls, world.cylinders, world.boxes, world.bounds, problem.dt, problem.margin, problem.goal_radius,
        docking_speed(problem.goal_speed, team.max_speed), problem.collision_penalty,
    )  # fmt: skip
    return models[0], PlainTeam(*(jnp.asarray(number, jnp.float32) for number in numbers))


def _derivative(model: str, x: Array, u: Array) -> Array:
    """``dx/dt`` of one robot, from its state ``(n,)`` and control ``(m,)``."""
    if model == "velocity2d":
        return u
    if model == "differential_drive":
        return jnp.concatenate([x[3] * jnp.stack([jnp.cos(x[2]), jnp.sin(x[2])]), u])
    size = x.shape[0] // 2
    return jnp.concatenate([x[size:], u])


def _shorten(vector: Array, limit: Array) -> Array:
    """``vector`` at no more than the length ``limit``."""
    length = jnp.linalg.norm(vector)
    return jnp.where(length > limit, vector * (limit / jnp.where(length > 0, length, 1.0)), vector)


def _step_robot(model: str, dt: Array, limits: tuple[Array, ...], x: Array, u: Array) -> tuple[Array, Array]:
    """State after one step and speed of one robot: clip, RK4, speed limit."""
    speed, acceleration, turn_rate, reverse = limits
    if model == "differential_drive":
        bound = jnp.stack([turn_rate, acceleration])
        u = jnp.clip(u, -bound, bound)
    else:
        u = _shorten(u, speed if model == "velocity2d" else acceleration)
    k1 = _derivative(model, x, u)
    k2 = _derivative(model, x + dt / 2 * k1, u)
    k3 = _derivative(model, x + dt / 2 * k2, u)
    k4 = _derivative(model, x + dt * k3, u)
    x = x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    if model == "velocity2d":
        return x, jnp.linalg.norm(u)
    if model == "differential_drive":
        x = x.at[3].set(jnp.clip(x[3], -reverse, speed))
        return x, jnp.abs(x[3])
    size = x.shape[0] // 2
    x = x.at[size:].set(_shorten(x[size:], speed))
    return x, jnp.linalg.norm(x[size:])


def _at_rest(model: str, x: Array) -> Array:
    """``(K, n)`` states at rest."""
    if model == "velocity2d":
        return x
    return x.at[:, 3:].set(0.0) if model != "holonomic2d" else x.at[:, 2:].set(0.0)


def _near_robot(team: PlainTeam, position: Array) -> Array:
    """``(K,)`` bool from the full distance matrix."""
    distance = jnp.linalg.norm(position[:, None] - position[None, :], axis=-1)
    distance = jnp.where(jnp.eye(len(position), dtype=bool), jnp.inf, distance)
    return (distance <= team.radius[:, None] + team.radius[None, :] + team.margin).any(axis=1)


def _near_obstacle(team: PlainTeam, position: Array) -> Array:
    """``(K,)`` bool: within the margin of an obstacle or the bounds."""
    dimension = position.shape[1]
    safety_distance = team.radius + team.margin
    near = (
        (position - safety_distance[:, None] <= team.bounds[:1])
        | (position + safety_distance[:, None] >= team.bounds[1:])
    ).any(axis=1)
    for kind, axes in ((team.balls, dimension), (team.cylinders, 2)):
        distance = jnp.linalg.norm(position[:, None, :axes] - kind[None, :, :axes], axis=-1)
        near = near | (distance <= safety_distance[:, None] + kind[None, :, axes]).any(axis=1)
    lower, upper = team.boxes[None, :, :dimension], team.boxes[None, :, dimension:]
    outside = jnp.maximum(jnp.maximum(lower - position[:, None], position[:, None] - upper), 0.0)
    return near | (jnp.linalg.norm(outside, axis=-1) <= safety_distance[:, None]).any(axis=1)


def team_rewards(model: str, collisions: bool, team: PlainTeam, controls: Array) -> Array:
    """``(K,)`` mean reward over time of one team under ``controls`` ``(H, K, m)``."""
    dimension = team.goal.shape[1]
    limits = (team.max_speed, team.max_acceleration, team.max_turn_rate, team.max_reverse_speed)
    distance_at_start = jnp.linalg.norm(team.start[:, :dimension] - team.goal, axis=1)
    scale = jnp.maximum(distance_at_start, team.goal_radius)

    def advance(carry: tuple[Array, Array], control: Array) -> tuple[tuple[Array, Array], Array]:
        x, arrived = carry
        y, speed = jax.vmap(partial(_step_robot, model, team.dt))(limits, x, control)
        arrives = jnp.linalg.norm(y[:, :dimension] - team.goal, axis=1) <= team.goal_radius
        arrives = arrives & (speed <= team.docking_speed)
        y = jnp.where(arrives[:, None], _at_rest(model, y), y)
        x = jnp.where(arrived[:, None], x, y)
        position = x[:, :dimension]
        reward = 1 - jnp.linalg.norm(position - team.goal, axis=1) / scale
        reward = reward - team.collision_penalty * _near_obstacle(team, position)
        if collisions:
            reward = reward - team.collision_penalty * _near_robot(team, position)
        return (x, arrived | arrives), reward

    start = (team.start, jnp.zeros(len(team.start), bool))
    return jax.lax.scan(advance, start, controls)[1].mean(axis=0)


@partial(jax.jit, static_argnames=("model", "collisions"))
def score(model: str, team: PlainTeam, controls: Array, collisions: bool = True) -> Array:
    """``(M, K)`` mean rewards of ``M`` teams under ``controls`` ``(M, H, K, m)``."""
    return jax.vmap(partial(team_rewards, model, collisions, team))(controls)


def softmax_mean(rewards: Array, samples: Array, temperature: float | Array) -> Array:
    """Mean of ``samples`` ``(M, ...)``, weighted by the softmax of the normalised ``rewards`` ``(M,)`` of the teams."""
    deviation = rewards - rewards.mean()
    normalised = deviation / jnp.maximum(jnp.sqrt((deviation**2).mean()), 1e-6)
    return jnp.tensordot(jax.nn.softmax(normalised / temperature), samples, axes=1)


@partial(jax.jit, static_argnames=("model", "num_samples", "collisions"))
def denoise(
    model: str,
    team: PlainTeam,
    mean: Array,
    noise_scale: Array,
    key: Array,
    num_samples: int,
    temperature: float | Array,
    collisions: bool = True,
) -> Array:
    """One denoising run with team weights (paper, Algorithm 1).

    Args:
        model: Model name.
        team: The problem.
        mean: ``(H, K, m)`` controls to sample around at first.
        noise_scale: ``(N,)`` standard deviation at every step.
        key: A key of ``jax.random``.
        num_samples: ``M``.
        temperature: ``lambda``.
        collisions: Whether robots are penalised for coming near each other.

    Returns:
        ``(H, K, m)`` the last weighted mean.
    """

    def update(mean: Array, xs: tuple[Array, Array]) -> tuple[Array, Array]:
        sigma, step_key = xs
        samples = mean[None] + sigma * jax.random.normal(step_key, (num_samples, *mean.shape), jnp.float32)
        rewards = score(model, team, samples, collisions).mean(axis=1)
        return softmax_mean(rewards, samples, temperature), rewards.mean()

    return jax.lax.scan(update, mean, (noise_scale, jax.random.split(key, len(noise_scale))))[0]


def denoise_around_rest(
    problem: Problem, noise_scale: ArrayLike, num_samples: int, temperature: float, seed: int, collisions: bool = True
) -> FloatArray:
    """``(H, K, m)`` controls of :func:`denoise` from zero, for a problem whose robots have one model."""
    model, team = plain_team(problem)
    zero = jnp.zeros((problem.horizon, problem.num_robots, problem.control_size), jnp.float32)
    scale, key = jnp.asarray(noise_scale, jnp.float32), jax.random.key(seed)
    return np.asarray(denoise(model, team, zero, scale, key, num_samples, jnp.float32(temperature), collisions))
