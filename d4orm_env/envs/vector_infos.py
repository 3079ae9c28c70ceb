"""Infos of many worlds as Gymnasium has them: arrays over the worlds, each with a mask of where it counts."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import BoolArray, FloatArray
from d4orm_env.envs.team_step import Info


def masked(values: Mapping[str, NDArray[np.generic]], mask: BoolArray) -> Info:
    """Copies of batched values, zero outside ``mask`` ``(B,)``, each with its mask."""
    infos: Info = {}
    whole = bool(mask.all())
    for key, value in values.items():
        infos[key] = value.copy()
        if not whole:
            infos[key][~mask] = 0
        infos[f"_{key}"] = mask.copy()
    return infos


def final_infos(observations: FloatArray, infos: Info, ended: BoolArray) -> Info:
    """Return what is kept of episodes that have ended, before their worlds are reset.

    Args:
        observations: ``(B, K * D)``.
        infos: As they were then; what they hold goes into the result.
        ended: ``(B,)`` bool.
    """
    final_obs = np.full(len(ended), None, dtype=object)
    for world in np.flatnonzero(ended):
        final_obs[world] = observations[world].copy()
    final_info: Info = {}
    for key in [name for name in infos if not name.startswith("_")]:
        final_info[key] = infos[key]
        if isinstance(infos[key], np.ndarray):
            final_info[key][~ended] = 0
        final_info[f"_{key}"] = ended.copy()
    return {
        "final_obs": final_obs,
        "_final_obs": ended.copy(),
        "final_info": final_info,
        "_final_info": ended.copy(),
    }
