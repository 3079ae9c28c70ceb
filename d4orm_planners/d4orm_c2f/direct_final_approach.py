"""Final approach: robots near their goals drive straight to them, or manoeuvre."""

from __future__ import annotations

import numpy as np

from d4orm_env.core import portable
from d4orm_env.core.arrays import BoolArray, FloatArray, Floats, IntArray
from d4orm_env.core.problem import Problem
from d4orm_env.core.trajectory import Trajectory
from d4orm_env.dynamics.robot_model import ACCELERATION, SPEED
from d4orm_env.engine.types import Engine
from d4orm_planners.tracking.goal_drives import curving_room, drive_to_goal
from d4orm_planners.tracking.steering import NEAR_VIA, at_rest, drives, straight_drives

PASSING = 1 / 75_000  #: Share of the goal radius that is the arrival radius of robots that drive through their goals
NEARBY = 3.0  #: Distance from its goal within which a robot that turns only as it drives manoeuvres, in turning radii
DIRECTIONS, BEYOND = 16, (0.25, 1.0, 2.0)  #: Manoeuvres' first directions, and their distances in turning radii
LENGTH, RESERVE = 8.0, 2.0  #: Largest length of a manoeuvre, in turning radii, and its longest time beyond that [s]


def arrival_radius(problem: Problem, docks: bool) -> float:
    """The goal radius for rollouts of an episode [m]; a robot that does not stay drives on to its next goal."""
    return problem.goal_radius if docks else PASSING * problem.goal_radius


def direct_final_approach(
    window: Problem, engine: Engine, controls: FloatArray, near: BoolArray, arrived: BoolArray
) -> tuple[FloatArray, BoolArray]:
    """The controls, with straight drives for robots that arrive by these no later, or manoeuvres.

    Samples head for a goal only roughly, and a robot that misses it at full speed has to turn.

    Args:
        window: The robots from where they are to their goals, over the prediction horizon.
        engine: Engine for rollouts.
        controls: ``(H_predict, K, m)``.
        near: ``(K,)`` robots whose straight drives are tried.
        arrived: ``(K,)`` robots at rest for good.

    Returns:
        ``(H_predict, K, m)`` controls, and ``(K,)`` robots on their final approach.
    """
    offsets = window.goal - window.start[:, : window.dimension]
    away = np.linalg.norm(offsets, axis=1, keepdims=True)
    speed, acceleration = (window.team.limits[:, limit, None] for limit in (SPEED, ACCELERATION))
    circle = window.team.turning_radius
    turning = (circle > 0) & np.isfinite(circle) & (window.dimension == 2)
    close = turning & ~arrived & (away[:, 0] < curving_room(window, NEARBY))
    near = near & (away <= speed * window.dt * window.horizon)[:, 0]
    final = np.zeros_like(near)
    if not (near | close).any():
        return controls, final
    latest = np.minimum(_arrival_times(engine.rollout(window, controls)), window.horizon)
    # Past the goal at full speed where that meets it and stops them; else so that robots could stop there.
    overrun = np.where(np.isinf(window.goal_speed)[:, None], speed**2 / (2 * acceleration), 0)
    for beyond in (overrun, np.zeros_like(speed)):
        if not (near & ~final).any():
            break
        aimed = window.goal + beyond * offsets / np.maximum(away, window.goal_radius)
        passing = window.with_state(window.start, aimed, goal_radius=arrival_radius(window, docks=False))
        straight = straight_drives(passing).controls[:, :, 0]
        trajectory = engine.rollout(window, straight)
        sooner = near & ~final & (_arrival_times(trajectory) <= latest)
        if (asked := np.flatnonzero(sooner & turning)).size:
            sooner[asked] = _keeps_clear(window, trajectory.positions[:, asked, None], asked, arrived)[:, 0]
        controls = np.where(sooner[:, None], straight, controls)
        final |= sooner
    close &= ~final & (latest == window.horizon)
    headed = close & ~np.isnan(window.goal_heading)
    controls, curving = _approach_by_curves(window, engine, controls, np.flatnonzero(headed), arrived)
    controls, manoeuvring = approach_by_manoeuvres(window, controls, np.flatnonzero(close & ~headed), arrived)
    return controls, final | curving | manoeuvring


def _approach_by_curves(
    window: Problem, engine: Engine, controls: FloatArray, robots: IntArray, arrived: BoolArray
) -> tuple[FloatArray, BoolArray]:
    """The controls, with curves to their goal headings for robots ``(R,)``, as far as these keep clear of all at rest.

    The rest is as for :func:`approach_by_manoeuvres`. Curves take longer than the prediction, and the next loop goes on
    with the same ones.
    """
    curving = np.zeros_like(arrived)
    if not len(robots):
        return controls, curving
    alone = window.select(robots.tolist())
    driven = np.zeros((len(controls), len(robots), alone.control_size), np.float32)
    states, docked = alone.start, np.zeros(len(robots), bool)
    for step in range(len(driven)):
        states, driven[step], docked, *_ = engine.step(
            alone.arrays, states, docked, drive_to_goal(alone, states, alone.goal)
        )
    positions = engine.move(alone.arrays, alone.start, np.zeros(len(robots), bool), driven)[
        :, :, None, : window.dimension
    ]
    curving[robots] = _keeps_clear(window, positions, robots, arrived)[:, 0]
    controls, own = controls.copy(), curving[robots]
    controls[:, robots[own], : driven.shape[2]] = driven[:, own]
    return controls, curving


def approach_by_manoeuvres(
    window: Problem, controls: FloatArray, robots: IntArray, arrived: BoolArray
) -> tuple[FloatArray, BoolArray]:
    """The controls, with manoeuvres for robots ``(R,)`` that cannot turn in place and are close to their goals.

    A robot reaches a point within its turning circles by driving away from it first, which samples do not do, as they
    are rewarded for being near. Of drives by points all around, forwards or in reverse, the one is chosen that arrives
    first and keeps clear of all robots at rest.

    The other arguments, and what is returned, are as for :func:`direct_final_approach`.
    """
    manoeuvring = np.zeros_like(arrived)
    if not len(robots):
        return controls, manoeuvring
    circle, speed = window.team.turning_radius[robots], window.team.limits[robots, SPEED]
    steps = round(float((LENGTH * circle / speed).max() + RESERVE) / window.dt)
    alone = window.with_state(window.start, window.goal, horizon=steps).select(robots.tolist())
    angle = 2 * np.pi / DIRECTIONS * np.arange(DIRECTIONS)
    directions = np.stack([portable.cos(angle), portable.sin(angle)], axis=1)
    # A robot turns to its goal as soon as it is so near to the point before.
    away = np.float32(NEAR_VIA * alone.team.largest_radius) + circle[:, None] * np.array(BEYOND)
    vias = alone.start[:, None, None, :2] + away[:, :, None, None] * directions
    vias = vias.reshape(len(robots), -1, 1, 2).astype(np.float32)
    rollouts = drives(alone, *at_rest(alone), np.zeros(vias.shape[:2], int), vias)
    clear = _keeps_clear(window, rollouts.positions, robots, arrived)
    moves = (rollouts.states[1:] != rollouts.states[:-1]).any(axis=3)
    # The last step in which it moves.
    length = len(moves) - moves[::-1].argmax(axis=0)
    length = np.where(rollouts.arrived & clear, length, len(moves) + 1)
    best, every = length.argmin(axis=1), np.arange(len(robots))
    found = length[every, best] <= len(moves)
    chosen = rollouts.controls[: len(controls), every, best]
    controls = controls.copy()
    controls[: len(chosen), robots[found], : chosen.shape[2]] = chosen[:, found]
    controls[len(chosen) :, robots[found]] = 0  # by then they have arrived
    manoeuvring[robots[found]] = True
    return controls, manoeuvring


def _keeps_clear(window: Problem, positions: FloatArray, robots: IntArray, arrived: BoolArray) -> BoolArray:
    """``(R, V)`` bool: paths ``(T, R, V, d)`` that keep the margin to all at rest, or come no nearer than at first."""
    team = window.team
    radius, wall_radius = np.asarray(team.girth, np.float64), np.asarray(team.wall_radius, np.float64)
    room = window.world.clearance(positions) - wall_radius[robots, None]
    clear = _no_nearer(room, window)
    if arrived.any():
        positions, resting = (
            team.flattened(at, window.margin) for at in (positions, window.start[arrived, : window.dimension])
        )
        away = np.linalg.norm(positions[:, :, :, None] - resting, axis=4)
        clear &= _no_nearer(away - radius[robots, None, None] - radius[arrived], window).all(axis=2)
    return clear


def _no_nearer(gaps: Floats, window: Problem) -> BoolArray:
    """``(...)`` bool: no gap of ``(T, ...)`` is less than the margin, or than the first one if that is less [m]."""
    return (gaps >= np.minimum(gaps[0] - window.rounding, window.margin)).all(axis=0)


def _arrival_times(trajectory: Trajectory) -> IntArray:
    """``(K,)`` time steps until each robot arrives; ``H + 1`` for one that does not."""
    return (~trajectory.arrived).sum(axis=0)
