"""The tree that MMD searches: motions of a team, their conflicts, and the constraints that these put on robots.

A robot that is in conflict with another plans again, clear of where they met: conflict-based search.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray, Floats, IntArray
from d4orm_env.paths.spaces import Space
from d4orm_planners.baselines.mmd.path_frame import PathFrame


def count_conflicts(positions: Floats, others: Floats, distances: Floats) -> IntArray:
    """``(B, 2)`` numbers of other robots that each of some paths conflicts with, and of steps at which it does.

    Paths are ``(B, T, 3)``, the others' ``(S, T, 3)``, and ``distances`` to keep from each ``(S,)`` [m].
    """
    steps = _too_near(positions[:, None] - others, distances[:, None]).sum(axis=2)
    return np.stack([(steps > 0).sum(axis=1), steps.sum(axis=1)], axis=1)


def first_conflict(positions: Floats, distances: Floats) -> tuple[int, int, tuple[int, int]]:
    """Number of pairs in conflict, and the step and the robots of the earliest conflict; robots are -1 for none.

    Paths are ``(K, T, 3)``, and ``distances`` to keep ``(K, K)`` [m].
    """
    one, other = np.tril_indices(len(positions), -1)
    near = _too_near(positions[one] - positions[other], distances[one, other, None])
    if not near.any():
        return 0, positions.shape[1], (-1, -1)
    step = int(near.any(axis=0).argmax())
    pair = int(near[:, step].argmax())
    return int(near.any(axis=1).sum()), step, (int(one[pair]), int(other[pair]))


def _too_near(gaps: Floats, distances: Floats) -> BoolArray:
    """Check which gaps ``(..., 3)`` are no longer than the distances to keep [m]."""
    return gaps[..., 0] ** 2 + gaps[..., 1] ** 2 + gaps[..., 2] ** 2 <= distances**2


class Constraint(NamedTuple):
    """A sphere that one robot's centre has to be out of for some steps."""

    sphere: tuple[float, float, float, float]  #: Centre and radius [m]
    span: tuple[int, int]  #: First and last step


@dataclass(frozen=True, eq=False)
class RobotMotion:
    """Motion of one robot in a node of the tree."""

    motions: FloatArray  #: ``(B, SIZE)`` all that were denoised with it, which the next ones begin with
    controls: FloatArray  #: ``(H, m)``
    positions: Floats  #: ``(H+1, 3)`` [m]
    cost: int  #: Steps until it arrives
    fails: bool  #: Whether it comes too near to an obstacle or does not arrive


@dataclass(frozen=True, order=True)
class TreeNode:
    """A node of the tree; the one to be expanded next is the least."""

    conflicts: int  #: Pairs in conflict, and robots that fail by themselves
    cost: int  #: Sum of the robots' steps until arrival
    number: int  #: Of the node, counted as they are made
    motions: tuple[RobotMotion, ...] = field(compare=False)  #: Of the robots
    constraints: tuple[tuple[Constraint, ...], ...] = field(compare=False)  #: Of each robot
    pair: tuple[int, int] = field(compare=False)  #: Two robots in conflict, or -1
    step: int = field(compare=False)  #: Of their conflict

    @property
    def controls(self) -> FloatArray:
        """``(H, K, m)``."""
        return np.stack([motion.controls for motion in self.motions], axis=1)


@dataclass(frozen=True, eq=False)
class Tree:
    """The state of the search: nodes that are not expanded yet, best first, and how many were made."""

    frames: tuple[PathFrame, ...]
    space: Space
    nodes: tuple[TreeNode, ...]
    made: int

    def with_nodes(self, added: list[TreeNode]) -> Tree:
        """The tree with its best node expanded to these."""
        return replace(self, nodes=tuple(sorted([*self.nodes[1:], *added])), made=self.made + len(added))
