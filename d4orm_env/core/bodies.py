"""The rigid bodies that a team consists of: robots and their trailers."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from d4orm_env.core import portable
from d4orm_env.core.arrays import FloatArray, Floats
from d4orm_env.dynamics.robot_model import Model
from d4orm_env.footprints import Footprint, Train


class Body(NamedTuple):
    """A rigid body of a robot: its own one, or a trailer.

    Attributes:
        robot: Number of the robot.
        footprint: What it covers.
        heading: Number of the state component that turns it, or ``None`` for none.
        hitch: Distance of a trailer's reference point behind that of the body before it [m]; zero for the robot itself.
    """

    robot: int
    footprint: Footprint
    heading: int | None
    hitch: float


def find_bodies(footprints: Sequence[Footprint], models: Sequence[Model], hitches: Iterable[float]) -> tuple[Body, ...]:
    """The robots' bodies, and then those of their trailers, robot by robot."""
    robots, trailers, lengths = [], [], iter(hitches)
    for robot, (shape, model) in enumerate(zip(footprints, models, strict=True)):
        front, others = (shape.front, shape.trailers) if isinstance(shape, Train) else (shape, ())
        robots.append(Body(robot, front, model.heading_index, 0.0))
        for footprint, (component, _) in zip(others, model.trailers, strict=True):
            trailers.append(Body(robot, footprint, component, next(lengths)))
    return (*robots, *trailers)


def numbers_by_robot(bodies: Sequence[Body], num_robots: int) -> list[list[int]]:
    """Each robot's bodies by their numbers, the robot itself first."""
    numbers: list[list[int]] = [[] for _ in range(num_robots)]
    for i, body in enumerate(bodies):
        numbers[body.robot].append(i)
    return numbers


def body_poses(bodies: Sequence[Body], states: FloatArray, d: int) -> Floats:
    """``(..., F, d + 1)`` reference points and headings of the bodies in states ``(..., K, n)``."""
    last = dict[int, int]()
    poses = np.zeros((*states.shape[:-2], len(bodies), d + 1))
    for i, body in enumerate(bodies):
        column = body.heading
        turn: Floats = (
            np.zeros(states.shape[:-2]) if column is None else states[..., body.robot, column].astype(np.float64)
        )
        if body.robot in last:
            before = poses[..., last[body.robot], :]
            turn = before[..., d] - turn
            sine, cosine = portable.sin_cos(turn)
            poses[..., i, 0] = before[..., 0] - body.hitch * cosine
            poses[..., i, 1] = before[..., 1] - body.hitch * sine
        else:
            poses[..., i, :d] = states[..., body.robot, :d]
        poses[..., i, d] = turn
        last[body.robot] = i
    return poses
