"""Actions of every kind of array act alike, in every form of the environment, from policies and functions too."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium
import jax.numpy as jnp
import numpy as np
import pytest
from env_support import mixed_problem

from d4orm_env import navigation_v0, verify
from d4orm_env.core.arrays import as_float32
from d4orm_env.envs.vector_env import NavigationVectorEnv
from d4orm_env.envs.wrappers import GaussianControlNoise
from d4orm_planners import make_policy
from d4orm_planners.base.adapters import SharedPolicy
from d4orm_planners.base.episode import run_episode
from d4orm_planners.rl.dataset.demonstrations import record_episode

torch = pytest.importorskip("torch")

CONTROLS = np.float32([[0.3, -0.2], [0.5, 0.25], [-1.0, 0.75]])
KINDS: dict[str, Callable[[Any], Any]] = {
    "list": lambda action: action.tolist(),
    "list of tensors": lambda action: [torch.tensor(float(value), requires_grad=True) for value in action],
    "float64": np.float64,
    "not contiguous": lambda action: np.repeat(action, 2)[::2],
    "not contiguous, backwards": lambda action: action[::-1].copy()[::-1],
    "read-only": lambda action: np.frombuffer(action.tobytes(), np.float32),
    "jax": jnp.asarray,
    "tensor": torch.tensor,
    "tensor with gradient": lambda action: torch.tensor(action, requires_grad=True),
    "result of a network": lambda action: torch.tensor(action, requires_grad=True) * 1,
    "tensor in double precision": lambda action: torch.tensor(action, dtype=torch.float64, requires_grad=True),
    "tensor not contiguous": lambda action: torch.tensor(np.repeat(action, 2), requires_grad=True)[::2],
    "parameter": lambda action: torch.nn.Parameter(torch.tensor(action)),
}


def parallel(convert: Callable[[Any], Any]) -> Any:
    env = navigation_v0.parallel_env(problem=mixed_problem())
    env.reset(seed=0)
    env.step({agent: convert(control) for agent, control in zip(env.agents, CONTROLS)})
    return env.state()


def in_turn(convert: Callable[[Any], Any]) -> Any:
    env = navigation_v0.env(problem=mixed_problem())
    env.reset(seed=0)
    for control in CONTROLS:
        env.step(convert(control))
    return env.state()


def wrapped(convert: Callable[[Any], Any]) -> Any:
    env = GaussianControlNoise(navigation_v0.parallel_env(problem=mixed_problem()), 0.1)
    env.reset(seed=0)
    env.step({agent: convert(control) for agent, control in zip(env.agents, CONTROLS)})
    return env.state()


def joint(convert: Callable[[Any], Any]) -> Any:
    env: Any = gymnasium.make("d4orm/Navigation-v0", problem=mixed_problem())
    env.reset(seed=0)
    env.step(convert(CONTROLS.ravel()))
    return env.unwrapped.state()


def batched(convert: Callable[[Any], Any]) -> Any:
    env = NavigationVectorEnv(2, problem=mixed_problem())
    env.reset(seed=0)
    rows = CONTROLS.ravel()
    env.step([convert(rows), convert(-rows)])  # type: ignore[arg-type]
    return env.state()


def team_function(convert: Callable[[Any], Any]) -> Any:
    def act(observations: Any, state: Any) -> Any:
        return {agent: convert(CONTROLS[int(agent[-1])]) for agent in observations}

    env = navigation_v0.parallel_env(problem=mixed_problem(), max_cycles=3)
    return run_episode(env, act).trajectory.states


def recorded(convert: Callable[[Any], Any]) -> Any:
    policy = make_policy(lambda observation: convert(CONTROLS[0]))
    return record_episode(navigation_v0.parallel_env(problem=mixed_problem(), max_cycles=3), policy, 0).actions


def shared(convert: Callable[[Any], Any]) -> Any:
    policy = SharedPolicy(lambda stacked: [convert(CONTROLS[0])] * len(stacked), torch.nn.Linear(1, 1))
    return run_episode(navigation_v0.parallel_env(problem=mixed_problem(), max_cycles=3), policy).trajectory.states


FORMS = (parallel, in_turn, wrapped, joint, batched, team_function, recorded, shared)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("form", FORMS, ids=lambda form: form.__name__)
def test_they_act_alike(form: Callable[..., Any], kind: str) -> None:
    np.testing.assert_array_equal(form(KINDS[kind]), form(lambda action: action))


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (torch.tensor([0.5, -2.0], dtype=torch.bfloat16, requires_grad=True), [0.5, -2.0]),
        (torch.tensor([1, 2]), [1.0, 2.0]),
        ([np.float32([1, 2]), torch.tensor([3.0, 4.0], requires_grad=True)], [[1, 2], [3, 4]]),
        (torch.tensor([1e300], dtype=torch.float64), [np.inf]),
    ],
    ids=str,
)
def test_tensors_of_every_type_are_read(value: Any, expected: Any) -> None:
    array = as_float32(value)
    assert array.dtype == np.float32
    np.testing.assert_array_equal(array, np.float32(expected))


@pytest.mark.parametrize("value", [torch.zeros(2, device="meta"), torch.zeros(2, device="meta", requires_grad=True)])
def test_tensors_without_numbers_are_refused_by_name(value: Any) -> None:
    env = navigation_v0.parallel_env(problem=mixed_problem())
    env.reset(seed=0)
    actions = {agent: np.zeros(2, np.float32) for agent in env.agents} | {"robot_1": value}
    with pytest.raises(ValueError, match="action of robot_1 is tensor"):
        env.step(actions)


@pytest.mark.parametrize(
    "action", [np.array([1j, 0]), np.array(["1", "2"]), ["1", "2"], np.array([1, 2], "m8[s]"), np.array([b"1", b"2"])]
)
def test_what_numpy_would_make_numbers_of_is_refused(action: Any) -> None:
    env = navigation_v0.parallel_env("circle", num_robots=1)
    env.reset(seed=0)
    with pytest.raises(ValueError, match="robot_0"):
        env.step({"robot_0": action})
    joint = NavigationVectorEnv(1, "circle", 1)
    joint.reset(seed=0)
    with pytest.raises(ValueError, match="actions"):
        joint.step([action])
    if isinstance(action, np.ndarray) and action.dtype.kind == "c":
        with pytest.raises(ValueError, match="controls must be an array of numbers"):
            verify(env.problem, np.zeros((env.problem.horizon, 1, 2)) + 1j)
