"""Training set of the diffusion model: plans of single robots among things that it is not told of."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import islice
from typing import NamedTuple

import numpy as np

from d4orm_env.core.arrays import FloatArray, Floats
from d4orm_env.core.problem import Problem
from d4orm_env.scenarios import make_problem
from d4orm_planners.base.planner_registry import make_planner
from d4orm_planners.baselines.mmd.path_frame import POINTS, PathFrame, make_frame, sine_table, world_space

KINDS: tuple[tuple[str, dict[str, object]], ...] = (
    ("random", {"size": 5.0}),
    ("random", {"size": 8.0, "num_obstacles": 6}),
    ("rooms", {}),
    ("warehouse", {}),
    ("forest", {}),
    ("corridor", {}),
)
"""Scenarios and their settings that maps are drawn from, in turn."""
PLANNERS = ("mapf", "hybrid")
"""Planners whose plans are learned from, in turn."""
_PHANTOMS = 3
"""Most circles near the path that a plan has to go round and the model is not told of."""
_SIZES, _ASIDE = (0.1, 0.45), 0.5
"""Radius of these, and distance from the path at most [m]."""
_LONGEST = 1.4
"""Times the length of the path that a plan may be; a longer one leads elsewhere."""
_PER_MAP = 4
_FINENESS = 16
"""Places per point at which the path is compared with a plan."""


class Examples(NamedTuple):
    """Motions and what the model is told of them.

    Attributes:
        features: ``(E, FEATURES)`` float32.
        modes: ``(E, 2, MODES)`` float32 differences from the path, ahead and aside, in lengths of the path.
    """

    features: FloatArray
    modes: FloatArray


def draw_examples(count: int, seed: int, progress: Callable[[int], object] = lambda done: None) -> Examples:
    """Plan for single robots until there are so many examples; every plan gives two, one the mirror image of the other.

    Args:
        count: Examples, at least.
        seed: Non-negative; maps are drawn from it on.
        progress: Called with the examples that there are.
    """
    features: list[FloatArray] = []
    modes: list[FloatArray] = []
    for frame, places in islice(_motions(seed), -(-count // 2)):
        ahead, aside = modes_of(frame, places).astype(np.float32)
        features.extend(frame.features)
        modes += [np.stack([ahead, aside]), np.stack([ahead, -aside])]
        progress(len(modes))
    return Examples(np.stack(features), np.stack(modes))


def modes_of(frame: PathFrame, places: Floats) -> Floats:
    """``(2, MODES)`` of planar places ``(POINTS + 1, 3)``: how far ahead on the way they are, and to its left."""
    fine = np.linspace(0, POINTS, _FINENESS * POINTS + 1)
    path, tangents = (
        np.column_stack([np.interp(fine, np.arange(POINTS + 1), rows[:, axis]) for axis in range(2)])
        for rows in (frame.reference, frame.tangents)
    )
    nearest, at = np.zeros(POINTS + 1, int), 0
    for i, place in enumerate(places[:, :2]):
        # Paths may come near to themselves: only what lies next on them counts.
        ahead = path[at : at + _FINENESS * POINTS // 8]
        at += int(((ahead - place) ** 2).sum(axis=1).argmin())
        nearest[i] = at
    offset = places[:, :2] - path[nearest]
    aside = (offset[:, 1] * tangents[nearest, 0] - offset[:, 0] * tangents[nearest, 1]) / frame.length
    differences = np.stack([fine[nearest] / POINTS - np.arange(POINTS + 1) / POINTS, aside])
    # A plan ends within the goal's radius, and a motion at the goal.
    differences -= differences[:, -1:] * (np.arange(POINTS + 1) / POINTS)
    return 2 / POINTS * differences @ sine_table()


def _motions(seed: int) -> Iterator[tuple[PathFrame, Floats]]:
    """Frames and ``(POINTS + 1, 3)`` places at equal times from start to arrival."""
    random, number = np.random.default_rng(seed), seed
    while True:
        kind, settings = KINDS[number % len(KINDS)]
        problem = make_problem(kind, num_robots=1, seed=number, **settings)
        number += 1
        frame = make_frame(problem, 0, world_space(problem), np.zeros(3))
        if frame is None or frame.length < 2 * problem.goal_radius:
            continue
        for attempt in range(_PER_MAP):
            hindered = _with_phantoms(problem, frame, random, attempt)
            if hindered is None:
                continue
            planner = make_planner(PLANNERS[(number + attempt) % len(PLANNERS)], engine="cpu")
            plan = planner.solve(hindered, seed=number, max_iterations=8)
            places = _evenly(plan.trajectory.positions[:, 0], int(plan.trajectory.arrived[:, 0].argmax()))
            if plan.solved and np.linalg.norm(np.diff(places, axis=0), axis=1).sum() < _LONGEST * frame.length:
                yield frame, places


def _with_phantoms(problem: Problem, frame: PathFrame, random: np.random.Generator, number: int) -> Problem | None:
    """The problem with so many circles near its path; ``None`` if they leave no path."""
    number = min(number, _PHANTOMS)
    at = frame.reference[random.integers(0, POINTS + 1, number), :2]
    circles = np.column_stack(
        [at + random.uniform(-_ASIDE, _ASIDE, (number, 2)), random.uniform(*_SIZES, number)]
    ).astype(np.float32)
    ends = np.stack([problem.start[0, :2], problem.goal[0]])
    gaps = np.linalg.norm(circles[:, None, :2] - ends, axis=2) - circles[:, 2:]
    circles = circles[(gaps > frame.reach + problem.goal_radius).all(axis=1)]
    if len(circles) == 0 < number:
        return None
    world = problem.world
    hindered = problem.replace(world=world.replace(circles=np.concatenate([world.circles, circles])))
    return hindered if np.isfinite(hindered.shortest_paths.length).all() else None


def _evenly(positions: FloatArray, arrival: int) -> Floats:
    """``(POINTS + 1, 3)`` where a robot was at equal times, interpolated."""
    times = np.linspace(0, arrival, POINTS + 1)
    places = np.zeros((POINTS + 1, 3))
    for axis in range(2):
        places[:, axis] = np.interp(times, np.arange(arrival + 1), positions[: arrival + 1, axis])
    return places
