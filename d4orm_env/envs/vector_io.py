"""Input and infos of the batched environment: arrays over the worlds, each with a mask of where it counts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from d4orm_env.core.arrays import BoolArray, FloatArray, whole_number
from d4orm_env.envs.inputs import check_options
from d4orm_env.envs.team_step import Info


def reset_mask(options: Mapping[str, object] | None, running: BoolArray) -> BoolArray:
    """``(B,)`` bool: which worlds ``reset(options=...)`` resets, of which these are ``running`` ``(B,)``."""
    check_options(options, ("reset_mask",))
    if options is None or "reset_mask" not in options:
        return np.ones_like(running)
    mask = options["reset_mask"]
    if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_:
        raise TypeError(f"options['reset_mask'] must be a NumPy array of bool, not {mask!r}")
    if mask.shape != running.shape or not mask.any():
        raise ValueError(
            f"options['reset_mask'] has shape {mask.shape} and {int(mask.sum())} worlds; it must have shape "
            f"{running.shape} and at least one world"
        )
    if not (mask | running).all():
        raise RuntimeError("the first reset must not leave worlds out; call reset() without a mask")
    return mask


def world_seeds(seed: int | Sequence[int | None] | None, num_worlds: int) -> list[int | None]:
    """One seed for each world, from the argument of ``reset``."""
    if seed is None:
        return [None] * num_worlds
    if not isinstance(seed, (Sequence, np.ndarray)) or isinstance(seed, str):
        first = whole_number(seed, "seed", 0)
        return [first + world for world in range(num_worlds)]
    if len(seed) != num_worlds:
        raise ValueError(f"seed has {len(seed)} entries for {num_worlds} worlds; give one per world")
    return [None if one is None else whole_number(one, f"seed[{world}]", 0) for world, one in enumerate(seed)]


def checked_autoreset_mode(value: str | AutoresetMode) -> AutoresetMode:
    """The mode itself, or by its value."""
    try:
        return AutoresetMode(value)
    except ValueError:
        names = ", ".join(repr(mode.value) for mode in AutoresetMode)
        raise ValueError(f"autoreset_mode {value!r} is unknown; choose one of {names}") from None


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
