"""Network of sets: neighbours and obstacles in any order, and any number of neighbours.

Every neighbour goes, with what the robot knows of itself, through the same two layers, and what comes out is pooled by
its maximum and its sum over the neighbours that are there (deep sets: M. Zaheer et al., NeurIPS 2017). Obstacles
likewise. The order in which they are listed, and rows for those that are not there, thus make no difference.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from d4orm_env.core.arrays import FloatArray
from d4orm_planners.rl.features import Features

KINDS = ("neighbor", "obstacle")
"""Kinds of sets, in the order in which features have them."""
SUM_SCALE = 0.25
"""Scale of sums, which keeps those of a few of order one."""


def array_shapes(features: Features, arrays: Mapping[str, FloatArray]) -> dict[str, tuple[int | None, ...]]:
    """Shapes of the arrays that the sets of a network are made of; hidden widths are those of ``arrays``.

    Args:
        features: Features of the network.
        arrays: Those of a file, which may be anything.
    """
    shapes: dict[str, tuple[int | None, ...]] = {}
    for kind, row in zip(KINDS, (features.neighbor_size, features.obstacle_size), strict=True):
        first, second = (_width(arrays.get(f"{kind}_weight_{layer}")) for layer in (0, 1))
        shapes |= {
            f"{kind}_weight_0": (first, row),
            f"{kind}_own": (first, features.own_size),
            f"{kind}_bias_0": (first,),
            f"{kind}_weight_1": (second, first),
            f"{kind}_bias_1": (second,),
        }
    return shapes


def encoded_size(features: Features, arrays: Mapping[str, FloatArray]) -> int | None:
    """Width of what :func:`encode` returns; ``None`` if the arrays do not say."""
    widths = [_width(arrays.get(f"{kind}_weight_1")) for kind in KINDS]
    return features.own_size + 2 * sum(width or 0 for width in widths) if None not in widths else None


def encode(features: Features, arrays: Mapping[str, FloatArray], seen: FloatArray) -> FloatArray:
    """``(N, E)`` inputs of the layers that follow, for ``(N, F)`` features of any number of neighbours."""
    own, *sets = features.of_size(seen.shape[1]).parts(seen)
    parts = [own]
    for kind, rows in zip(KINDS, sets, strict=True):
        hidden = rows @ arrays[f"{kind}_weight_0"].T + (own @ arrays[f"{kind}_own"].T)[:, None]
        hidden = np.maximum(hidden + arrays[f"{kind}_bias_0"], 0)
        hidden = np.maximum(hidden @ arrays[f"{kind}_weight_1"].T + arrays[f"{kind}_bias_1"], 0) * rows[..., :1]
        # None is below zero, which stands for nobody.
        parts += [hidden.max(axis=1, initial=0), SUM_SCALE * hidden.sum(axis=1)]
    joined: FloatArray = np.concatenate(parts, axis=1)
    return joined


def _width(weight: FloatArray | None) -> int | None:
    return len(weight) if weight is not None and weight.ndim == 2 else None
