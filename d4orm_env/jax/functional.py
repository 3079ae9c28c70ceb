"""The environment as pure JAX functions, which jit, vmap and grad.

>>> import jax
>>> from d4orm_env import functional, make_problem
>>> problem = make_problem("circle", num_robots=8)
>>> state = functional.reset(problem, jax.random.key(0))
>>> state, step = jax.jit(functional.step)(problem, state, controls)
>>> observations = functional.observe(problem, state, ObservationLayout.for_problem(problem))

Importing this module registers :class:`~d4orm_env.core.problem.Problem` as a JAX pytree: a problem is an ordinary
traced argument, whose starts, goals, limits and obstacles may be mapped over or differentiated. Models, shapes and the
horizon are static.
"""

from __future__ import annotations

from dataclasses import fields
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from d4orm_env.core.observation_layout import ObservationLayout
from d4orm_env.core.problem import Problem
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.core.team import Team
from d4orm_env.core.world import World, shape_tables
from d4orm_env.dynamics import transition
from d4orm_env.dynamics.robot_model import STANDARD_LIMITS
from d4orm_env.envs.rewards import RewardFunction, RewardInput, find_reward, term_names, turns_left
from d4orm_env.jax.jax_engine import check_contacts, goal_distance
from d4orm_env.jax.jax_motion import Worlds, advance_worlds
from d4orm_env.jax.jax_observation import observe_team

__all__ = ["State", "Step", "observe", "reset", "step"]


class State(NamedTuple):
    """State of a team."""

    states: jax.Array  #: ``(K, n)``
    arrived: jax.Array  #: ``(K,)`` bool, docked
    steps: jax.Array  #: ``()`` int32, steps taken
    #: ``(K, m)`` executed last, zero after a reset: what the speed of first-order robots is read from
    controls: jax.Array


class Step(NamedTuple):
    """Result of one step."""

    rewards: jax.Array  #: ``(K,)``
    arrived: jax.Array  #: ``(K,)`` bool
    collided: jax.Array  #: ``(K,)`` bool, hard contact
    margin_violated: jax.Array  #: ``(K,)`` bool
    truncated: jax.Array  #: ``()`` bool, the horizon is reached
    controls: jax.Array  #: ``(K, m)`` as executed
    distances: jax.Array  #: ``(K,)`` to the goals [m]


def reset(problem: Problem, key: jax.Array) -> State:
    """The team at its start.

    Args:
        problem: The problem.
        key: A JAX random key; problems start where they say, so it has no effect, but APIs that vmap resets need it.

    Returns:
        The state at time zero.
    """
    del key
    num_robots = len(problem.team.models)
    idle = jnp.zeros((num_robots, problem.control_size), jnp.float32)
    return State(jnp.asarray(problem.start, jnp.float32), jnp.zeros(num_robots, bool), jnp.int32(0), idle)


def checked_controls(problem: Problem, controls: ArrayLike) -> jax.Array:
    """``(K, m)`` controls of a team, or actions, as float32; another shape would be broadcast."""
    array, expected = jnp.asarray(controls, jnp.float32), (problem.num_robots, problem.control_size)
    if array.shape != expected:
        raise ValueError(f"actions have shape {array.shape}; expected (K, m) = {expected}")
    return array


def step(
    problem: Problem, state: State, controls: ArrayLike, reward: str | RewardFunction = "paper"
) -> tuple[State, Step]:
    """One time step, as every engine takes it.

    Args:
        problem: The problem.
        state: State of the team.
        controls: ``(K, m)``, clipped here.
        reward: ``"paper"``, ``"training"``, or a function of a :class:`~d4orm_env.envs.rewards.RewardInput` that JAX
            can trace; static.

    Returns:
        The next state and what happened.

    Raises:
        ValueError: If there is no such reward, or the controls have another shape.
    """
    function = find_reward(reward)
    arrays, controls = _arrays(problem), checked_controls(problem, controls)
    d = arrays.goal.shape[1]
    worlds = Worlds(state.states[..., None], state.arrived[..., None], jnp.zeros_like(controls)[..., None])
    worlds = advance_worlds(problem.team.models, arrays, worlds, controls[..., None])
    collided, margin_violated, rewards = check_contacts(arrays, worlds.state)
    before, after = (goal_distance(arrays, states[:, :d])[:, 0] for states in (state.states[..., None], worlds.state))
    steps = state.steps + 1
    happened = Step(
        rewards[:, 0],
        worlds.arrived[:, 0],
        collided[:, 0],
        margin_violated[:, 0],
        steps >= problem.horizon,
        worlds.control[..., 0],
        after,
    )
    following = State(worlds.state[..., 0], worlds.arrived[..., 0], steps, happened.controls)
    if function is None:
        return following, happened
    given = _reward_input(problem, state, following, happened, before)
    # Flags times Python's numbers have JAX's default precision, so terms are rounded before they are summed.
    parts = function.terms(given).values() if term_names(function) else [function(given)]  # type: ignore[attr-defined]
    nothing = jnp.zeros_like(after)
    return following, happened._replace(rewards=sum((jnp.asarray(part, jnp.float32) for part in parts), nothing))


def _reward_input(problem: Problem, state: State, after: State, happened: Step, distances: jax.Array) -> RewardInput:
    """Return a reward's input for a step that began in ``state``, at these distances ``(K,)`` from the goals."""
    arrays = _arrays(problem)
    traced: dict[str, Any] = {
        "previous_states": state.states,
        "states": after.states,
        "controls": happened.controls,
        "goals": arrays.goal,
        "previous_distances": distances,
        "distances": happened.distances,
        "initial_distances": 1 / arrays.inverse_initial_distance,
        "previous_turns": turns_left(problem, state.states, arrays.goal),
        "turns": turns_left(problem, after.states, arrays.goal),
        "previously_arrived": state.arrived,
        "arrived": after.arrived,
        "collided": happened.collided,
        "margin_violated": happened.margin_violated,
        "paper": happened.rewards,
    }
    return RewardInput(**traced, team=problem.team, dt=problem.dt)


def observe(problem: Problem, state: State, layout: ObservationLayout, max_cycles: int | None = None) -> jax.Array:
    """Return every robot's observation, as in the environments.

    Args:
        problem: The problem.
        state: State of the team.
        layout: Contents of observations, as ``ObservationLayout.for_problem(problem)``; static.
        max_cycles: Steps until truncation; the problem's horizon unless given.

    Returns:
        ``(K, D)``.

    Raises:
        ValueError: If the layout has the shortest path, which is not known here.
    """
    if layout.observed_path:
        raise ValueError("the functional API does not know the shortest paths; leave observed_path out")
    cycles = problem.horizon if max_cycles is None else max_cycles
    time_left = jnp.maximum(0, 1 - state.steps.astype(jnp.float32) / np.float32(cycles))
    world = Worlds(state.states, state.arrived, state.controls)
    arrays = _arrays(problem)
    if problem.world.lower is None:
        arrays = arrays._replace(bounds=None)  # type: ignore[arg-type] # there is nothing to see of them
    return observe_team(problem.team.models, arrays, world, layout, time_left)


def _arrays(problem: Problem) -> ProblemArrays:
    """:attr:`Problem.arrays` for a problem whose numbers may be traced."""
    team, world = problem.team, problem.world
    # Rounded before they are computed with, whatever precision JAX has by default.
    numbers = (problem.dt, problem.margin, problem.goal_radius, problem.goal_speed, problem.collision_penalty)
    start, goal, dt, margin, goal_radius, goal_speed, penalty = (
        jnp.asarray(value, jnp.float32) for value in (problem.start, problem.goal, *numbers)
    )
    heading, tolerance = jnp.asarray(problem.goal_heading), jnp.asarray(problem.goal_heading_tolerance)
    angles = jnp.column_stack([heading, jnp.asarray(problem.goal_hitches)])
    directions = jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=2)
    distance = jnp.sqrt(jnp.maximum(((start[:, : team.dimension] - goal) ** 2).sum(axis=-1), goal_radius**2))
    if world.lower is None:
        bounds = jnp.array([[-jnp.inf] * team.dimension, [jnp.inf] * team.dimension], jnp.float32)
    else:
        bounds = jnp.stack([jnp.asarray(world.lower), jnp.asarray(world.upper)])
    boxes, triangles = shape_tables(world, jnp)
    arrays: dict[str, Any] = {  # traced, which the engine does not mind
        "model_codes": None,
        "limits": _limits(team),
        "radius": jnp.asarray(team.radius),
        "start": start,
        "goal": goal,
        "inverse_initial_distance": 1 / distance,
        "boxes": boxes,
        "triangles": triangles,
        "grid": None,
        "bounds": bounds,
        "time_step": jnp.stack([dt / part for part in (1, 2, 3, 6)]),
        "margin": margin,
        "squared_goal_radius": goal_radius**2,
        "squared_goal_speed": transition.docking_speed(goal_speed, jnp.asarray(team.max_speed)) ** 2,
        "docks": problem.arrival == "dock",
        "collision_penalty": penalty,
        "turns_at_goals": True,
        "goal_direction": jnp.nan_to_num(directions).reshape(len(angles), -1),
        "squared_goal_chord": jnp.where(jnp.isnan(heading), jnp.inf, 4 * jnp.sin(tolerance / 2) ** 2),
        "footprints": team.footprint_arrays,
        "wall_radius": jnp.asarray(team.wall_radius),
    }
    return ProblemArrays(**arrays)


def _limits(team: Team) -> jax.Array:
    """:attr:`Team.limits` of a team whose numbers may be traced."""
    columns = [jnp.asarray(getattr(team, name)) for name in STANDARD_LIMITS]
    models = team.robot_models
    for column in range(max(len(model.own_limits) for model in models)):
        values = [
            team.own_limits[model.own_limits[column].name][robot] if column < len(model.own_limits) else 1.0
            for robot, model in enumerate(models)
        ]
        columns.append(jnp.stack([jnp.asarray(value, jnp.float32) for value in values]))
    return jnp.stack(columns, axis=1)


_STATIC = {
    Problem: ("horizon", "arrival", "name"),
    Team: ("models", "shapes", "hitches"),
    World: ("dimension", "triangles"),
}


def _register(kind: type) -> None:
    static = _STATIC[kind]
    names = tuple(field.name for field in fields(kind) if field.name not in static)

    def flatten(value: object) -> tuple[tuple[object, ...], tuple[object, ...]]:
        return tuple(getattr(value, name) for name in names), tuple(getattr(value, name) for name in static)

    def unflatten(metadata: tuple[object, ...], children: tuple[object, ...]) -> object:
        # Not through __init__: tracers cannot be validated, and the problem they stand for has been.
        value: object = object.__new__(kind)
        for name, part in zip((*names, *static), (*children, *metadata), strict=True):
            object.__setattr__(value, name, part)
        return value

    jax.tree_util.register_pytree_node(kind, flatten, unflatten)


for _kind in _STATIC:
    _register(_kind)
