"""Kernels for GPUs, written in Pallas for Triton: what XLA would make many small kernels of, or read too often.

Arrays come whole, samples last; a thread has one sample.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, TypeAlias

import jax
import jax.numpy as jnp
from jax import Array
from jax.experimental import pallas as pl

from d4orm_env.core.lazy import LazyModule

if TYPE_CHECKING:
    from jax.experimental.pallas import triton
else:
    triton = LazyModule("jax.experimental.pallas.triton")

Components: TypeAlias = tuple[Array, ...]
Advance: TypeAlias = Callable[[Any, Components, Components, Array], tuple[Components, Components, Array]]
"""``(numbers, x, u, arrived)`` of one robot to what they are after a step, and the executed control."""

LANES = 128
"""Samples of a program."""
ROWS = 8
"""Robots that a program compares with all others, so that it reads those once for all of them."""


def on_gpu(kernel: Callable[..., Any], elsewhere: Callable[..., Any], *arguments: Any) -> Any:
    """The result of a kernel on a GPU; of another function elsewhere, and where JAX has no Pallas for Triton."""
    if find_spec("jax.experimental.pallas.triton") is None:
        return elsewhere(*arguments)
    return jax.lax.platform_dependent(*arguments, cuda=kernel, rocm=kernel, default=elsewhere)


def _samples(num_samples: int) -> tuple[Array, Array]:
    """Samples of this program, and which of them there are."""
    samples = pl.program_id(1) * LANES + jnp.arange(LANES, dtype=jnp.int32)
    return samples, samples < num_samples


def _params() -> triton.CompilerParams:
    return triton.CompilerParams(num_warps=LANES // 32, num_stages=1)


def move_robots(
    advance: Advance, numbers: Any, state: Array, arrived: Array, controls: Array
) -> tuple[Array, Array, Array]:
    """Roll robots of one model out, each on its own, by ``advance`` and a tree of numbers ``(R, 1)`` for it.

    From ``state`` ``(R, n, S)`` and ``arrived`` ``(R, S)`` on under ``controls`` ``(H, R, m, S)``. Returned is the same
    after each step ``(H, ...)``, the controls as executed.
    """
    horizon, num_robots, _, num_samples = controls.shape
    columns, structure = jax.tree.flatten(numbers)
    kernel = pl.pallas_call(
        partial(_move, advance, structure),
        out_shape=(
            jax.ShapeDtypeStruct((horizon, *state.shape), jnp.float32),
            jax.ShapeDtypeStruct((horizon, num_robots, num_samples), jnp.int32),
            jax.ShapeDtypeStruct(controls.shape, jnp.float32),
        ),
        grid=(num_robots, pl.cdiv(num_samples, LANES)),
        compiler_params=_params(),
    )
    table = jnp.concatenate([column.astype(jnp.float32) for column in columns], axis=1)
    after, arrived, executed = kernel(table, state, arrived.astype(jnp.int32), controls)
    return after, arrived > 0, executed


def _move(
    advance: Advance, structure: jax.tree_util.PyTreeDef, table: Any, state: Any, arrived: Any, controls: Any, *out: Any
) -> None:
    robot = pl.program_id(0)
    samples, inside = _samples(state.shape[-1])
    numbers = jax.tree.unflatten(structure, [table[robot, i] for i in range(structure.num_leaves)])

    def lanes(array: Any, *index: Any) -> Any:
        return array.at[(*map(jnp.int32, index), samples)]

    def load(array: Any, *index: Any) -> Array:
        return triton.load(lanes(array, *index), mask=inside, other=0)

    def control_at(time: Array | int) -> Components:
        return tuple(load(controls, time, robot, i) for i in range(controls.shape[2]))

    def step(time: Array, carry: tuple[Components, Array, Components]) -> tuple[Components, Array, Components]:
        x, arrived, control = carry
        # Read while this step is computed.
        following = control_at(jnp.minimum(time + 1, controls.shape[0] - 1))
        x, executed, arrived = advance(numbers, x, control, arrived)
        for array, components in ((out[0], x), (out[2], executed)):
            for i, component in enumerate(components):
                triton.store(lanes(array, time, robot, i), component, mask=inside)
        triton.store(lanes(out[1], time, robot), arrived.astype(jnp.int32), mask=inside)
        return x, arrived, following

    x = tuple(load(state, robot, i) for i in range(state.shape[1]))
    jax.lax.fori_loop(0, controls.shape[0], step, (x, load(arrived, robot) > 0, control_at(0)))


def count_near(dimension: int, state: Array, squared_distance: Array) -> Array:
    """``(K, S)`` how many others each robot in ``state`` ``(K, n, S)`` is near.

    ``squared_distance`` ``(K, K)`` is that up to which two are near [m^2]; negative for a robot and itself.
    """
    num_robots, _, num_samples = state.shape
    kernel = pl.pallas_call(
        partial(_count_near, dimension),
        out_shape=jax.ShapeDtypeStruct((num_robots, num_samples), jnp.int32),
        grid=(pl.cdiv(num_robots, ROWS), pl.cdiv(num_samples, LANES)),
        compiler_params=_params(),
    )
    return kernel(state, squared_distance)


def _count_near(dimension: int, state: Any, squared_distance: Any, out: Any) -> None:
    rows = pl.program_id(0) * ROWS + jnp.arange(ROWS, dtype=jnp.int32)
    samples, inside = _samples(state.shape[-1])
    valid = rows < state.shape[0]
    mask = valid[:, None] & inside[None]

    def load(robot: Array, axis: int, mask: Array) -> Array:
        return triton.load(state.at[robot, jnp.int32(axis), samples], mask=mask, other=0)

    position = [
        triton.load(state.at[rows[:, None], jnp.int32(axis), samples[None]], mask=mask, other=0)
        for axis in range(dimension)
    ]

    def compare(other: Array, count: Array) -> Array:
        gaps = [position[axis] - load(other, axis, inside)[None] for axis in range(dimension)]
        most = triton.load(squared_distance.at[rows, other], mask=valid, other=-1)
        return count + (sum(gap * gap for gap in gaps) <= most[:, None]).astype(jnp.int32)

    count = jax.lax.fori_loop(0, state.shape[0], compare, jnp.zeros((ROWS, LANES), jnp.int32))
    triton.store(out.at[rows[:, None], samples[None]], count, mask=mask)
