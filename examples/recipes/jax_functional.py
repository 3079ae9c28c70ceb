"""The environment as pure JAX functions: ``jit`` a whole episode, ``vmap`` it over many, differentiate through it.

    python -m examples.recipes.jax_functional

Improves a feedback controller's gains by gradient ascent on the team's reward, through the dynamics, on a crossing of
robots that is drawn anew for every world.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from examples.common import argument_parser, save_table

from d4orm_env import Problem, make_problem
from d4orm_env.jax import functional


def controls_of(gains: Any, problem: Problem, state: functional.State) -> Any:
    """Accelerations ``(K, 2)`` of a spring to the goal with damping; ``gains`` are the two constants."""
    position, velocity = state.states[:, :2], state.states[:, 2:4]
    return gains[0] * (problem.goal - position) - gains[1] * velocity


def episode(gains: Any, problem: Problem, start: Any) -> tuple[Any, Any]:
    """Mean reward over one episode from ``start`` ``(K, n)``, and which robots ``(K,)`` arrive."""
    problem = replace_start(problem, start)
    first = functional.reset(problem, jax.random.key(0))

    def advance(state: functional.State, _: None) -> tuple[functional.State, Any]:
        state, step = functional.step(problem, state, controls_of(gains, problem, state))
        return state, step.rewards.mean()

    last, rewards = jax.lax.scan(advance, first, None, length=problem.horizon)
    return rewards.mean(), last.arrived


def replace_start(problem: Problem, start: Any) -> Problem:
    """The problem from other start states. A problem is a pytree: its arrays may be exchanged for traced ones."""
    leaves, structure = jax.tree.flatten(problem)
    index = next(i for i, leaf in enumerate(leaves) if leaf is problem.start)
    return jax.tree.unflatten(structure, [*leaves[:index], start, *leaves[index + 1 :]])


def main() -> None:
    parser = argument_parser(__doc__)
    arguments = parser.parse_args()
    num_worlds, num_updates = (8, 3) if arguments.quick else (256, 20)
    problem = make_problem("circle", num_robots=4)
    shifts = 0.3 * jax.random.normal(jax.random.key(1), (num_worlds, problem.num_robots, 2), jnp.float32)
    starts = jnp.tile(problem.start, (num_worlds, 1, 1)).at[:, :, :2].add(shifts)

    worlds = jax.vmap(episode, in_axes=(None, None, 0))
    reward_of = jax.jit(lambda gains: worlds(gains, problem, starts)[0].mean())
    arrived_of = jax.jit(lambda gains: worlds(gains, problem, starts)[1].mean())
    ascend = jax.jit(jax.grad(reward_of))

    gains, rows = jnp.array([0.2, 1.0], jnp.float32), []
    for update in range(num_updates + 1):
        rows.append(
            {
                "update": update,
                "stiffness": f"{gains[0]:.3f}",
                "damping": f"{gains[1]:.3f}",
                "reward": f"{reward_of(gains):.4f}",
                "arrived": f"{arrived_of(gains):.0%}",
            }
        )
        slope = ascend(gains)
        gains = gains + 0.1 * slope / jnp.linalg.norm(slope)
    save_table(rows, arguments.out / "jax_functional.csv")


if __name__ == "__main__":
    main()
