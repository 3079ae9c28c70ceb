"""Models of reinforcement-learning libraries, asked as those libraries ask them."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from d4orm_env import make_problem, navigation_v0
from d4orm_planners import Controller, evaluate, make_policy, run_episode
from d4orm_planners.base.adapters import SharedPolicy, from_rllib, from_sb3, from_torch, from_torchrl
from d4orm_planners.tracking.steering import limit_controls

torch = pytest.importorskip("torch")
PROBLEM = make_problem("circle", num_robots=3, horizon=10, model="differential_drive")


def first_actions(policy: Any) -> tuple[np.ndarray, np.ndarray, Any]:
    """What the robots observe first, what the policy has them do, and the space of that."""
    env, policy = navigation_v0.parallel_env(problem=PROBLEM), make_policy(policy)
    episode = run_episode(env, policy)
    assert len(episode.trajectory.controls) == PROBLEM.horizon
    observed = np.stack(list(episode.observations[0].values()))
    actions = policy.act(episode.observations[0], None)
    assert list(actions) == env.possible_agents
    assert policy.act({}, None) == {}
    return observed, np.stack(list(actions.values())), env.action_space("robot_0")


def test_stable_baselines3() -> None:
    sb3 = pytest.importorskip("stable_baselines3")
    env = navigation_v0.parallel_env(problem=PROBLEM)

    class One(gymnasium.Env):
        observation_space, action_space = env.observation_space("robot_0"), env.action_space("robot_0")

    model, other = (sb3.PPO("MlpPolicy", One(), seed=seed, device="cpu") for seed in (0, 1))
    observed, actions, _ = first_actions(from_sb3(model))
    for observation, action in zip(observed, actions):
        np.testing.assert_allclose(action, model.predict(observation, deterministic=True)[0], rtol=1e-5, atol=1e-6)
    assert from_sb3(model).identity() == from_sb3(model).identity() != from_sb3(other).identity()
    assert from_sb3(model, deterministic=False).identity() != from_sb3(model).identity()
    with pytest.raises(ValueError, match="deterministic is 1; it must be True or False"):
        from_sb3(model, deterministic=1)
    other_robots = make_problem("circle", num_robots=3, model="differential_drive", max_turn_rate=2.0)
    with pytest.raises(ValueError, match="make the environment of robots as in training"):
        run_episode(navigation_v0.parallel_env(problem=other_robots), from_sb3(model))
    controller = Controller(from_sb3(model))  # which holds back some of the limits
    controller.begin(PROBLEM, PROBLEM.start)
    assert np.isfinite(controller.step(PROBLEM.start, 0.1).control).all()


def test_bounds_of_actions_are_compared_as_robots_or_the_team_have_them() -> None:
    team = make_problem("circle", num_robots=2, max_speed=[1, 2], model="velocity2d")
    env = navigation_v0.parallel_env(problem=team)
    joint = gymnasium.make("d4orm/Navigation-v0", problem=team)
    spaces = {False: env.action_space("robot_0"), True: joint.action_space}
    for of_team, space in spaces.items():
        shape = (1, 4) if of_team else (2, 2)
        policy, other = (
            SharedPolicy(lambda seen, shape=shape: np.zeros(shape), None, joint=of_team, actions=actions)
            for actions in (space, spaces[not of_team])
        )
        run_episode(env, policy)
        with pytest.raises(ValueError, match="was trained for actions from"):
            run_episode(env, other)
    egocentric = SharedPolicy(lambda seen: np.zeros((len(seen), 2)), None, egocentric=True, actions=spaces[False])
    with pytest.raises(ValueError, match="say whether that was egocentric"):
        run_episode(env, egocentric)


@pytest.mark.parametrize("make", [from_torch, from_torchrl, from_rllib])
def test_what_is_no_loaded_model_is_refused_at_once(make: Any) -> None:
    for bad in (None, "model.pt", torch.nn.Identity):
        with pytest.raises(ValueError, match="load it first, and give what acts"):
            make(bad)


@pytest.mark.parametrize("name", ["normalized", "egocentric", "joint"])
@pytest.mark.parametrize("value", ["no", 1, None])
def test_what_is_neither_true_nor_false_is_refused(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"{name} is .*; it must be True or False"):
        from_torch(torch.nn.Identity(), **{name: value})
    with pytest.raises(ValueError, match="predict is None"):
        SharedPolicy(None, None)  # type: ignore[arg-type]


def test_a_module_of_torch() -> None:
    module = torch.nn.Linear(navigation_v0.parallel_env(problem=PROBLEM).observation_space("robot_0").shape[0], 2)
    observed, actions, _ = first_actions(from_torch(module))
    wanted = module(torch.as_tensor(observed)).detach().numpy()
    np.testing.assert_allclose(actions, limit_controls(PROBLEM, wanted), rtol=1e-5, atol=1e-6)
    assert from_torch(module).identity() != from_torch(module, normalized=True).identity()


SIZE = navigation_v0.parallel_env(problem=PROBLEM).observation_space("robot_0").shape[0]


def joint_module() -> torch.nn.Module:
    return torch.nn.Linear(PROBLEM.num_robots * SIZE, PROBLEM.num_robots * 2)


def joint_torchrl(module: torch.nn.Module) -> SharedPolicy:
    pytest.importorskip("torchrl")
    from tensordict.nn import TensorDictModule

    return from_torchrl(TensorDictModule(module, in_keys=["observation"], out_keys=["action"]), joint=True)


@pytest.mark.parametrize("adapted", [lambda module: from_torch(module, joint=True), joint_torchrl])
def test_a_module_of_the_whole_team(adapted: Any) -> None:
    module = joint_module()
    observed, actions, _ = first_actions(adapted(module))
    wanted = module(torch.as_tensor(observed.reshape(1, -1))).detach().numpy().reshape(-1, 2)
    np.testing.assert_allclose(actions, limit_controls(PROBLEM, wanted), rtol=1e-5, atol=1e-6)
    with pytest.raises(ValueError, match="give joint=True for one that steers the whole team at once"):
        first_actions(from_torch(module))
    assert from_torch(module, joint=True).identity() != from_torch(module).identity()


class Also(torch.nn.Linear):
    """A module that returns more than actions, as a recurrent one does."""

    def __init__(self, answer: Any) -> None:
        super().__init__(SIZE, 2)
        self.answer = answer

    def forward(self, seen: Any) -> Any:
        return self.answer(super().forward(seen))


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (lambda actions: (actions, None), "answers with a tuple for 3 observations; it must be actions alone, \\(3, m"),
        (lambda actions: (actions, actions), "answers with a tuple"),
        (lambda actions: torch.distributions.Normal(actions, 1.0), "answers with a Normal"),
        (lambda actions: actions.ravel(), "answers with a Tensor of shape \\(6,\\) for 3 observations"),
        (lambda actions: actions[:1], "answers with a Tensor of shape \\(1, 2\\) for 3 observations"),
    ],
)
def test_a_module_that_returns_no_actions_is_told(answer: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        first_actions(from_torch(Also(answer)))


def test_functions_may_return_tensors_of_any_kind() -> None:
    module = Also(lambda actions: actions.bfloat16())
    observed, actions, _ = first_actions(lambda observation: module(torch.as_tensor(observation)))
    wanted = module(torch.as_tensor(observed)).detach().float().numpy()
    np.testing.assert_allclose(actions, limit_controls(PROBLEM, wanted), rtol=1e-2, atol=1e-2)
    np.testing.assert_allclose(first_actions(from_torch(module))[1], actions, rtol=1e-2, atol=1e-2)
    team = run_episode(
        navigation_v0.parallel_env(problem=PROBLEM),
        lambda observations, state: {agent: module(torch.as_tensor(seen)) for agent, seen in observations.items()},
    )
    np.testing.assert_allclose(team.trajectory.controls[0], actions, rtol=1e-2, atol=1e-2)


def linear(weights: Any, observations: Any) -> Any:
    return jnp.tanh(observations @ weights)


def weights_of(seed: int) -> Any:
    return jax.random.normal(jax.random.key(seed), (SIZE, 2)) / 10


def test_a_pure_function_of_jax(tmp_path: Path) -> None:
    weights = weights_of(0)
    observed, actions, _ = first_actions(SharedPolicy(jax.jit(partial(linear, weights)), None))
    np.testing.assert_allclose(actions, limit_controls(PROBLEM, np.asarray(linear(weights, observed))), rtol=1e-5)
    for one in (jax.jit(partial(linear, weights)), partial(jax.jit(linear), weights), partial(linear, weights)):
        np.testing.assert_allclose(first_actions(one)[1], actions, rtol=1e-5, atol=1e-6)
    # A store of trials tells networks by their weights.
    mine = {f"{seed} {kind.__name__}": kind(seed) for seed in (0, 1) for kind in (shared, jitted)}
    rows = evaluate(mine, [PROBLEM], seeds=[0], out=tmp_path, workers=1)
    assert [(row.label, row.errors) for row in rows] == [(label, 0) for label in mine]


def shared(seed: int) -> SharedPolicy:
    return SharedPolicy(jax.jit(partial(linear, weights_of(seed))), None)


def jitted(seed: int) -> Any:
    return jax.jit(partial(linear, weights_of(seed)))


def test_torchrl() -> None:
    pytest.importorskip("torchrl")
    from tensordict.nn import NormalParamExtractor, TensorDictModule
    from torchrl.modules import ProbabilisticActor, TanhNormal

    size = navigation_v0.parallel_env(problem=PROBLEM).observation_space("robot_0").shape[0]
    layers = torch.nn.Sequential(torch.nn.Linear(size, 4), NormalParamExtractor())
    parameters = TensorDictModule(layers, in_keys=["seen"], out_keys=["loc", "scale"])
    actor = ProbabilisticActor(
        parameters, in_keys=["loc", "scale"], out_keys=["done"], distribution_class=TanhNormal,
        distribution_kwargs={"low": torch.tensor([-1.0, -0.5]), "high": torch.tensor([1.0, 0.5])},
    )  # fmt: skip
    observed, actions, _ = first_actions(from_torchrl(actor, "seen", "done"))
    with torch.no_grad():
        mean = layers(torch.as_tensor(observed))[0]
    np.testing.assert_allclose(actions, torch.tanh(mean) * torch.tensor([1.0, 0.5]), rtol=1e-4, atol=1e-5)


class Module(torch.nn.Linear):
    """What an ``RLModule`` of RLlib has that is called here."""

    def forward_inference(self, batch: dict[str, Any]) -> dict[str, Any]:
        return {"action_dist_inputs": self(batch["obs"])}

    def get_inference_action_dist_cls(self) -> Any:
        class Distribution:
            def __init__(self, logits: Any) -> None:
                self.logits = logits

            from_logits = classmethod(lambda cls, logits: cls(logits))

            def to_deterministic(self) -> Any:
                return Distribution(self.logits.chunk(2, dim=-1)[0])

            def sample(self) -> Any:
                return self.logits

        return Distribution


def test_rllib() -> None:
    size = navigation_v0.parallel_env(problem=PROBLEM).observation_space("robot_0").shape[0]
    module = Module(size, 4)
    observed, actions, space = first_actions(from_rllib(module, normalized=False))
    with torch.no_grad():
        mean = module(torch.as_tensor(observed))[:, :2].numpy()
    np.testing.assert_allclose(actions, limit_controls(PROBLEM, mean), rtol=1e-4, atol=1e-5)
    _, scaled, space = first_actions(from_rllib(module))
    within = limit_controls(PROBLEM, space.high * np.clip(mean, -1, 1))
    np.testing.assert_allclose(scaled, within, rtol=1e-4, atol=1e-5)
