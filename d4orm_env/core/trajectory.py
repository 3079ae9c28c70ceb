"""Rollout of controls: states, rewards and flags over time, and the disturbances of an execution."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray
from d4orm_env.core.lazy import LazyModule
from d4orm_env.core.summary_line import KeyFigure, count, joined

if TYPE_CHECKING:
    from d4orm_env.render import pictures
else:
    pictures = LazyModule("d4orm_env.render.pictures")


@dataclass(frozen=True, eq=False, repr=False)
class Trajectory:
    """The motion of a team. Index 0 along time is the start, index ``t`` the state after ``t`` steps.

    Attributes:
        states: ``(H+1, K, n)`` states, padded with zeros.
        positions: ``(H+1, K, d)`` positions [m].
        controls: ``(H, K, m)`` controls as executed: within the limits, zero once docked.
        rewards: ``(H, K)`` reward of each robot at each step.
        arrived: ``(H+1, K)`` whether the robot has docked at its goal.
        collided: ``(H+1, K)`` hard contact with a robot, an obstacle or the bounds.
        margin_violated: ``(H+1, K)`` the same with the safety margin added.
    """

    states: FloatArray
    positions: FloatArray
    controls: FloatArray
    rewards: FloatArray
    arrived: BoolArray
    collided: BoolArray
    margin_violated: BoolArray

    @property
    def key_figures(self) -> list[KeyFigure]:
        """Robots at their goals at the end, and those that were ever too near anything."""
        robots = self.arrived.shape[1]
        return [
            ("arrived", f"{self.arrived[-1].sum()} of {robots}"),
            ("in contact", f"{self.collided.any(axis=0).sum()}"),
            ("within the margin", f"{self.margin_violated.any(axis=0).sum()}"),
        ]

    @property
    def title(self) -> str:
        """Title: how many robots, and for how long."""
        steps, robots = self.controls.shape[:2]
        return f"{count(robots, 'robot')}, {count(steps, 'step')}"

    def __repr__(self) -> str:
        return f"Trajectory: {self.title}\n  {joined(self.key_figures)}"

    def _repr_html_(self) -> str:
        return pictures.paths_html(self, f"Trajectory: {self.title}", self.key_figures)


@dataclass(frozen=True, eq=False)
class DisturbanceEvents:
    """Disturbances that a team met in ``T`` steps."""

    pushed: FloatArray  #: ``(T + 1, K, d)`` velocity that the step before gave to each robot [m/s]; zero for none
    stalled: BoolArray  #: ``(T + 1, K)`` bool: does not obey
    #: ``(T + 1, N, 2 d + 1)`` position [m], velocity [m/s] and radius [m] of what moves among the robots
    bodies: FloatArray

    def until(self, step: int) -> DisturbanceEvents:
        """The same up to that step."""
        return DisturbanceEvents(self.pushed[: step + 1], self.stalled[: step + 1], self.bodies[: step + 1])

    @property
    def stall_starts(self) -> BoolArray:
        """``(T + 1, K)`` bool: where a robot stops obeying."""
        before = np.concatenate([np.zeros_like(self.stalled[:1]), self.stalled[:-1]])
        return self.stalled & ~before
