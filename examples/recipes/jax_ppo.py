"""PPO in one jit: environment, policy and learning in one compiled program, in the manner of PureJaxRL.

    python -m examples.recipes.jax_ppo

All robots share a small network. What a robot does after it has arrived is left out of the learning. On a GPU the same
program runs there.
"""

from __future__ import annotations

from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from examples.common import require, save_table
from examples.recipes.task import WORLD, recipe_arguments, solved

require("jaxrl", "optax")
import optax

from d4orm_env.jax.functional_env import FunctionalEnv
from d4orm_planners.base.adapters import SharedPolicy

NUM_WORLDS, HORIZON = 256, 32
GAMMA, LAMBDA, CLIP, EPOCHS, MINIBATCHES = 0.98, 0.95, 0.2, 4, 4
ENTROPY, VALUE = 1e-3, 0.5


class Sample(NamedTuple):
    """Batch of experience, each array with the leading axes time, world and robot."""

    observation: Any
    action: Any
    log_probability: Any
    value: Any
    reward: Any
    done: Any
    acted: Any


def make_network(key: Any, inputs: int, outputs: int, width: int = 64) -> Any:
    """Weights and biases of two networks, for actions and for the value, and the spread of the actions."""
    initial = jax.nn.initializers.orthogonal(np.sqrt(2))
    sizes = {"actor": (inputs, width, width, outputs), "critic": (inputs, width, width, 1)}
    keys = iter(jax.random.split(key, 6))
    layers = {
        name: [(initial(next(keys), (a, b), jnp.float32), jnp.zeros(b, jnp.float32)) for a, b in pairwise(size)]
        for name, size in sizes.items()
    }
    layers["actor"][-1] = (0.01 * layers["actor"][-1][0], layers["actor"][-1][1])
    return {**layers, "log_std": jnp.full(outputs, -0.5, jnp.float32)}


def along(vector: Any, rows: Any) -> Any:
    """The same vector for all rows: JAX can be told to refuse to do that by itself."""
    return jnp.broadcast_to(vector, rows.shape)


def apply(layers: Any, x: Any) -> Any:
    """The output of a network."""
    for number, (weight, bias) in enumerate(layers):
        x = x @ weight
        x = x + along(bias, x)
        if number < len(layers) - 1:
            x = jnp.tanh(x)
    return x


def log_density(network: Any, observation: Any, action: Any) -> Any:
    """Logarithm of the density of an action, normal around what the network says."""
    mean = apply(network["actor"], observation)
    log_std = along(network["log_std"], mean)
    return (-0.5 * ((action - mean) / jnp.exp(log_std)) ** 2 - log_std - 0.5 * np.log(2 * np.pi)).sum(-1)


def collect(env: FunctionalEnv, network: Any, carry: Any, key: Any) -> tuple[Any, tuple[Sample, Any]]:
    """One step of all worlds."""
    state, observation = carry
    draw, move = jax.random.split(key)
    mean = apply(network["actor"], observation)
    action = mean + along(jnp.exp(network["log_std"]), mean) * jax.random.normal(draw, mean.shape, jnp.float32)
    value = apply(network["critic"], observation)[..., 0]
    state, transition = jax.vmap(env.step)(jax.random.split(move, len(observation)), state, action)
    done = transition.finished | transition.done[:, None]
    density = log_density(network, observation, action)
    sample = Sample(observation, action, density, value, transition.rewards, done, transition.acted)
    return (state, transition.observations), (sample, (transition.done, transition.success))


def advantages(samples: Sample, last_value: Any) -> Any:
    """Generalised advantage estimates (Schulman et al., 2016), ``(T, worlds, robots)``."""

    def back(carry: Any, sample: Sample) -> Any:
        advantage, following = carry
        going_on = 1.0 - sample.done
        error = sample.reward + GAMMA * following * going_on - sample.value
        advantage = error + GAMMA * LAMBDA * going_on * advantage
        return (advantage, sample.value), advantage

    return jax.lax.scan(back, (jnp.zeros_like(last_value), last_value), samples, reverse=True)[1]


def loss(network: Any, samples: Sample, advantage: Any, target: Any) -> Any:
    """The clipped objective (Schulman et al., 2017), over the robots that acted."""
    counted = samples.acted / jnp.maximum(samples.acted.sum(), 1)
    mean = (advantage * counted).sum()
    scaled = (advantage - mean) / jnp.sqrt(((advantage - mean) ** 2 * counted).sum() + 1e-8)
    ratio = jnp.exp(log_density(network, samples.observation, samples.action) - samples.log_probability)
    gain = jnp.minimum(ratio * scaled, jnp.clip(ratio, 1 - CLIP, 1 + CLIP) * scaled)
    error = (apply(network["critic"], samples.observation)[..., 0] - target) ** 2
    return ((VALUE * error - gain) * counted).sum() - ENTROPY * network["log_std"].sum()


def train(env: FunctionalEnv, num_updates: int, key: Any) -> tuple[Any, Any]:
    """The network, and for every update episodes ended and succeeded, ``(updates, 2)``; to be compiled."""
    init, worlds, updates = jax.random.split(key, 3)
    network = make_network(init, env.observation_shape[1], env.problem.control_size)
    optimizer = optax.chain(optax.clip_by_global_norm(0.5), optax.adam(1e-3))
    start = jax.vmap(env.reset)(jax.random.split(worlds, NUM_WORLDS))

    def learn(carry: Any, batch: Any) -> Any:
        network, memory = carry
        change, memory = optimizer.update(jax.grad(loss)(network, *batch), memory)
        return (optax.apply_updates(network, change), memory), None

    def update(carry: Any, key: Any) -> Any:
        learner, world = carry
        act, *shuffles = jax.random.split(key, 1 + EPOCHS)
        world, (samples, ends) = jax.lax.scan(partial(collect, env, learner[0]), world, jax.random.split(act, HORIZON))
        last = apply(learner[0]["critic"], world[1])[..., 0]
        advantage = advantages(samples, last)
        flat = jax.tree.map(
            lambda values: values.reshape(-1, *values.shape[3:]), (samples, advantage, advantage + samples.value)
        )
        for shuffle in shuffles:
            order = jax.random.permutation(shuffle, HORIZON * NUM_WORLDS * env.problem.num_robots)
            batches = jax.tree.map(lambda v, order=order: v[order].reshape(MINIBATCHES, -1, *v.shape[1:]), flat)
            learner, _ = jax.lax.scan(learn, learner, batches)
        ended, succeeded = ends
        return (learner, world), jnp.stack([ended.sum(), (ended & succeeded).sum()])

    beginning = ((network, optimizer.init(network)), start)
    (learner, _), counts = jax.lax.scan(update, beginning, jax.random.split(updates, num_updates))
    return learner[0], counts


def main() -> None:
    arguments = recipe_arguments(__doc__, "--updates", 100, "of 8192 steps of teams each")
    num_updates, rows = (42, 7) if arguments.quick else (arguments.updates, 10)
    env = FunctionalEnv("random", num_robots=arguments.num_robots, num_instances=512, **WORLD)
    network, counts = jax.jit(partial(train, env, num_updates))(jax.random.key(0))
    table = [
        {
            "robot-steps": (part[-1] + 1) * HORIZON * NUM_WORLDS * arguments.num_robots,
            "episodes": int(counts[part, 0].sum()),
            "success": f"{counts[part, 1].sum() / max(counts[part, 0].sum(), 1):.0%}",
        }
        for part in np.array_split(np.arange(num_updates), rows)
    ]
    print(solved(SharedPolicy(jax.jit(partial(apply, network["actor"])), None, egocentric=True), arguments))
    save_table(table, arguments.out / "jax_ppo.csv")


if __name__ == "__main__":
    main()
