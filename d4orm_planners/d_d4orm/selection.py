"""Merging what other nodes send and choosing what to go on from: pure functions (paper, Algorithm 5, lines 4 to 6)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from d4orm_env.core.arrays import IntArray
from d4orm_env.core.errors import unknown

if TYPE_CHECKING:
    from d4orm_planners.d_d4orm.inbox import Report
    from d4orm_planners.d_d4orm.messages import Message

Item: TypeAlias = "Report | Message"
"""Candidate of a node, evaluated or as it was sent."""

SELECTIONS = ("top-k", "max", "k-means")

ROUNDS = 50
"""Rounds after which k-means stops, converged or not."""


def shares(total: int, parts: int) -> tuple[int, ...]:
    """``total`` split as evenly as whole numbers can be; the first parts get what is left over."""
    return tuple(total // parts + (part < total % parts) for part in range(parts))


def merge(newest: Mapping[int, Item], arrivals: Iterable[Message]) -> tuple[dict[int, Item], tuple[Message, ...]]:
    """The newest item of every node.

    Returns:
        What is held now, and the stale arrivals: those that are no newer than what was held before.
    """
    merged, stale = dict(newest), list["Message"]()
    for item in arrivals:
        if item.node in newest and item.sequence <= newest[item.node].sequence:
            stale.append(item)
        elif item.node not in merged or item.sequence > merged[item.node].sequence:
            merged[item.node] = item
    return merged, tuple(stale)


def top_k(rewards: ArrayLike, k: int) -> tuple[int, ...]:
    """Indices of the ``k`` largest of ``(n,)`` rewards, best first; of equal ones the first."""
    return tuple(int(i) for i in np.argsort(-np.asarray(rewards), kind="stable")[:k])


def k_means(points: ArrayLike, k: int, generator: np.random.Generator) -> IntArray:
    """Cluster points by Lloyd's rounds from a k-means++ start.

    Args:
        points: ``(n, D)``.
        k: Clusters; there are fewer where there are fewer different points.
        generator: Generator that the start is drawn with.

    Returns:
        ``(n,)`` the cluster of each point, numbered from 0.
    """
    places = np.asarray(points, np.float64)
    centres = places[[generator.integers(len(places))]]
    while len(centres) < k:
        gap2 = _square_distances(places, centres).min(axis=1)
        if gap2.sum() == 0:
            break
        centres = np.vstack([centres, places[generator.choice(len(places), p=gap2 / gap2.sum())]])
    labels = _square_distances(places, centres).argmin(axis=1)
    for _ in range(ROUNDS):
        former = labels
        # A cluster that has lost all its points stays where it was.
        full = np.unique(labels)
        centres[full] = [places[labels == cluster].mean(axis=0) for cluster in full]
        labels = _square_distances(places, centres).argmin(axis=1)
        if (labels == former).all():
            break
    return labels


def diverse(rewards: ArrayLike, points: ArrayLike, k: int, generator: np.random.Generator) -> tuple[int, ...]:
    """Indices of the best of each of at most ``k`` clusters of candidates, best first.

    Args:
        rewards: ``(n,)``.
        points: ``(n, ...)`` the candidates; their distance is the l2 norm of the difference.
        k: Clusters.
        generator: See :func:`k_means`.
    """
    count = np.size(rewards)
    labels = k_means(np.reshape(points, (count, -1)), k, generator)
    first: dict[int, int] = {}
    for i in top_k(rewards, count):
        first.setdefault(int(labels[i]), i)
    return tuple(first.values())


def choose(selection: str, rewards: ArrayLike, points: ArrayLike, k: int, generator: np.random.Generator) -> int:
    """Index of the candidate to go on from.

    Args:
        selection: ``"top-k"`` draws one of the ``k`` best (Algorithm 5); ``"max"`` takes the best; ``"k-means"`` draws
            one of the best of ``k`` clusters (section VIII-D).
        rewards: ``(n,)``.
        points: ``(n, ...)`` the candidates' controls.
        k: Number to draw from.
        generator: Generator that it is drawn with.

    Raises:
        ValueError: If there is no such rule.
    """
    if selection == "max":
        return top_k(rewards, 1)[0]
    if selection == "top-k":
        among = top_k(rewards, k)
    elif selection == "k-means":
        among = diverse(rewards, points, k, generator)
    else:
        raise unknown("selection", selection, SELECTIONS)
    return among[int(generator.integers(len(among)))]


def _square_distances(points: NDArray[np.float64], centres: NDArray[np.float64]) -> NDArray[np.float64]:
    """``(n, c)``."""
    gap2: NDArray[np.float64] = ((points[:, None] - centres[None]) ** 2).sum(axis=2)
    return gap2
