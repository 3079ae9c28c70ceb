"""What comes out of rolling controls out: states, rewards and flags over time."""

from __future__ import annotations

from dataclasses import dataclass

from d4orm_env.core.arrays import BoolArray, FloatArray


@dataclass(frozen=True, eq=False)
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
