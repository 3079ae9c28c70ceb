"""Checks of users' input to environments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import ArrayLike

from d4orm_env.core.arrays import (
    LARGEST,
    MAX_ACTION,
    BoolArray,
    FloatArray,
    as_float32,
    frozen_array,
    short_repr,
    usable,
    whole_number,
)
from d4orm_env.core.problem import Problem
from d4orm_env.core.problem_checks import MAX_HEADING, check_states
from d4orm_env.core.winding import unwound_states
from d4orm_env.disturbances.disturbance import check_components, per_component

MAX_CYCLES = 10**9


def checked_cycles(value: object) -> int:
    """``max_cycles`` as an int."""
    return whole_number(value, "max_cycles", 1, MAX_CYCLES)


def checked_states(
    problem: Problem,
    states: ArrayLike,
    arrived: BoolArray,
    bounds: tuple[FloatArray, FloatArray],
) -> FloatArray:
    """``states`` as an array ``(..., K, n)``, as robots may be put into; those ``arrived`` ``(..., K)`` are at rest.

    The bounds are the lowest and highest joint state; see :func:`d4orm_env.envs.joint_state.state_bounds`.
    """
    array = frozen_array(states, "states", (*arrived.shape, problem.state_size), largest=LARGEST)
    low, high = (bound[: problem.start.size].reshape(problem.start.shape) for bound in bounds)
    for team in array.reshape(-1, *problem.start.shape):
        check_states(problem.team, team, "state", MAX_HEADING)
    array = unwound_states(problem.team, array)
    for team, parked in zip(array.reshape(-1, *problem.start.shape), arrived.reshape(-1, problem.num_robots)):
        outside = ((team < low) | (team > high)).any(axis=1)
        if outside.any():
            robot = int(np.argmax(outside))
            raise ValueError(
                f"state of robot_{robot} is {team[robot].tolist()}, outside the state space; move it inside"
            )
        for robot in np.flatnonzero(parked).tolist():
            if team[robot, list(problem.team.robot_models[robot].speed_indices)].any():
                raise ValueError(f"state of robot_{robot} is moving, but the robot has docked; set its speed to zero")
    return array


def check_options(options: object, known: tuple[str, ...] = (), ignored: tuple[str, ...] = ()) -> None:
    """Refuse what ``reset`` would otherwise ignore: an option that is neither in ``known`` nor in ``ignored``."""
    if options is None:
        return
    if not isinstance(options, dict):
        raise TypeError(f"options must be a dictionary or None, not {short_repr(options)}")
    for name in options:
        if name not in known + ignored:
            raise ValueError(
                f"reset takes no option {name!r}; it takes {', '.join(known) or 'none'}, and what is to differ between "
                "environments goes to their constructors"
            )


def noise_std(value: ArrayLike, control_size: int) -> FloatArray | None:
    """``(m,)`` standard deviations from one number or one per component; ``None`` where all are zero."""
    std = per_component(value, "control_noise_std")
    check_components(std, "control_noise_std", control_size)
    return np.full(control_size, std, np.float32) if np.any(std) else None


def joint_controls(actions: ArrayLike, shape: tuple[int, ...], num_robots: int) -> FloatArray:
    """``(..., K, m)`` controls from joint actions of that shape, ``(..., K * m)``, as a checked copy."""
    noun, axes = ("action has", "(K * m,)") if len(shape) == 1 else ("actions have", "(B, K * m)")
    try:
        controls = as_float32(actions)
    except ValueError as error:
        wanted = f"{noun.split()[0]} must be an array of {shape} numbers"
        raise ValueError(f"{wanted}, not {short_repr(actions)}: {error}") from None
    if controls.shape != shape:
        raise ValueError(f"{noun} shape {controls.shape}; expected {axes} = {shape}")
    controls = controls.reshape(*shape[:-1], num_robots, -1)
    if not usable(controls).all():
        *world, robot = np.argwhere(~usable(controls).all(axis=-1))[0].tolist()
        raise ValueError(
            f"action of robot_{robot}{f' in world {world[0]}' if world else ''} is "
            f"{controls[*world, robot].tolist()}; every value must be finite and at most {MAX_ACTION:g} in magnitude"
        )
    return controls


def reset_mask(options: Mapping[str, object] | None, running: BoolArray) -> BoolArray:
    """``(B,)`` bool: which worlds ``reset(options=...)`` resets, of which these are ``running`` ``(B,)``."""
    check_options(options, ("reset_mask",))
    if options is None or "reset_mask" not in options:
        return np.ones_like(running)
    mask = options["reset_mask"]
    if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_:
        raise TypeError(f"options['reset_mask'] must be a NumPy array of bool, not {short_repr(mask)}")
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
    if not isinstance(seed, (Sequence, np.ndarray)) or isinstance(seed, str) or getattr(seed, "ndim", 1) == 0:
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
