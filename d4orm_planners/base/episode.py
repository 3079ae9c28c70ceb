"""Running a policy through an environment, in the physics of a name."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Any

import gymnasium
import numpy as np
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker
from pettingzoo import ParallelEnv

from d4orm_env import navigation_v0
from d4orm_env.core.arrays import BoolArray, FloatArray, short_repr, whole_number
from d4orm_env.core.errors import no_setting
from d4orm_env.core.files import parse_yaml
from d4orm_env.core.problem import Problem
from d4orm_env.core.summary_line import count
from d4orm_env.core.trajectory import DisturbanceEvents, Trajectory, accelerations, mean_squared_jerk
from d4orm_env.disturbances.disturbance import events_of
from d4orm_env.envs.joint_env import JointNavigationEnv
from d4orm_env.envs.joint_state import JointState, split_state
from d4orm_env.envs.team_step import AgentInfos
from d4orm_planners.base.display import DisplayMixin
from d4orm_planners.base.planner_registry import PolicyLike, make_policy
from d4orm_planners.base.policy import Policy, robot_indices

PHYSICS = {"model": "", "mujoco": "Physics", "crazyflow": "DronePhysics"}
"""The equations that planners know, rigid bodies in MuJoCo, or drones in crazyflow; and the class of settings."""


def find_physics(physics: str, problem: Problem | None = None) -> tuple[Any, dict[str, Any]]:
    """The module with the environment of a physics, and further arguments for this environment.

    Args:
        physics: One of :data:`PHYSICS`; behind a colon settings of :class:`d4orm_env.mujoco.Physics` or
            :class:`d4orm_env.crazyflow.DronePhysics`, as ``"crazyflow:gust=0.02,mass_factor=1.05"``.
        problem: A problem whose robots it is to move.

    Raises:
        ValueError: For an unknown physics or setting, a setting out of range, or robots that have no bodies in it.
        ImportError: If it needs a library that is not installed.
    """
    name, colon, listed = physics.partition(":") if isinstance(physics, str) else ("", "", "")
    if name not in PHYSICS:
        raise ValueError(f"physics is {short_repr(physics)}; choose one of {', '.join(PHYSICS)}")
    if name == "model":
        if colon:
            raise ValueError(f"physics is {short_repr(physics)}, and the model has no settings; give disturbances")
        return navigation_v0, {}
    module = import_module(f"d4orm_env.{name}")
    if problem is not None:
        module.check_problem(problem)
    if not colon:
        return module, {}
    kind, settings = getattr(module, PHYSICS[name]), {}
    for part in listed.split(","):
        setting, equals, text = part.partition("=")
        if not equals or setting in settings:
            raise ValueError(f"physics is {short_repr(physics)}; give settings once each, as {name}:name=value,...")
        if setting not in kind.__dataclass_fields__:
            raise no_setting(setting, f"physics {name!r}", kind.__dataclass_fields__)
        settings[setting] = parse_yaml(text)
    return module, {"physics": kind(**settings)}


@dataclass(frozen=True, eq=False, repr=False)
class Episode(DisplayMixin):
    """Record of an episode."""

    problem: Problem  #: Problem of the environment
    trajectory: Trajectory  #: The executed motion, ``T`` steps long; ``T`` is at most the horizon
    #: The environment's own, see :func:`d4orm_env.envs.team_step.episode_metrics`, and ``mean_squared_jerk``, see
    #: :func:`d4orm_env.core.trajectory.mean_squared_jerk`
    metrics: dict[str, float]
    observations: tuple[dict[str, FloatArray], ...]  #: Observations of all agents at the reset and after every step
    infos: tuple[AgentInfos, ...]  #: Infos likewise
    goals: FloatArray  #: ``(T+1, K, d)`` where the robots were to go; it changes in lifelong mode
    events: DisturbanceEvents | None = None  #: Its disturbances, for pictures; ``None`` without disturbances

    @property
    def title(self) -> str:
        """Title: policy and problem."""
        seconds = len(self.trajectory.controls) * self.problem.dt
        return f"{self.problem.name}, {count(self.problem.num_robots, 'robot')}, {seconds:.1f} s"

    @property
    def controls(self) -> FloatArray:
        """``(H, K, m)`` executed controls within the horizon, then zeros: a planner's ``initial_controls``."""
        executed = self.trajectory.controls[: self.problem.horizon]
        controls = np.zeros((self.problem.horizon, *executed.shape[1:]), np.float32)
        controls[: len(executed)] = executed
        return controls


def open_env(problem: Problem, physics: str = "model", policy: Policy | None = None, **options: Any) -> ParallelEnv:
    """An environment of a problem, by :func:`find_physics`; ``options`` are those of the PettingZoo environment.

    Where these say nothing, robots observe what the policy that is to act in it wants them to.
    """
    module, bodies = find_physics(physics, problem)
    if isinstance(policy, Policy):  # a user's own may have no more than reset and act
        options = {**policy.observation_options(problem), **options}
    return module.parallel_env(problem=problem, **options, **bodies)


def run_episode(env: ParallelEnv, policy: PolicyLike, seed: int = 0, *, physics: str | None = None) -> Episode:
    """Reset ``env``, reset ``policy``, and step until no agent is left.

    Args:
        env: A :mod:`d4orm_env.navigation_v0` parallel environment, wrapped or not; or the joint Gymnasium environment,
            with no wrappers but those of ``gymnasium.make``: the parallel one of the same options runs in its place.
        policy: A policy, or anything else that :func:`~d4orm_planners.make_policy` takes.
        seed: Seeds both.
        physics: See :func:`~d4orm_planners.base.episode.find_physics`; in place of ``env`` one like it runs.

    Returns:
        The executed trajectory and its metrics.

    Raises:
        ValueError: If the seed is negative, the environment is none of one team, there is no such policy or physics, or
            robots have no bodies in it; or if the environment is wrapped, and the physics given.
        ImportError: If the physics needs a library that is not installed.
    """
    whole_number(seed, "seed", 0)
    if isinstance(env, gymnasium.Env):
        env = _parallel(env)
    if not isinstance(env, ParallelEnv):
        raise ValueError(
            f"env is {short_repr(env)}; give the environment of one team first, as navigation_v0.parallel_env(...) or "
            "gymnasium.make(...), then the policy"
        )
    if physics is not None:
        env = _moved_by(env, physics)
    actor = make_policy(policy)
    observations, infos = env.reset(seed=seed)
    problem = env.unwrapped.problem
    actor.reset(env, seed=seed)
    # The record has the true states, not those that the policy observes.
    joints, effects = [split_state(problem, env.unwrapped.true_state())], [env.unwrapped.effect().copy()]
    all_observations, all_infos = [observations], [infos]
    outcomes = [_outcome(env, {})]
    while env.agents:
        # A policy may change what it is given.
        acting = {agent: observations[agent].copy() for agent in env.agents}
        observations, rewards, _, _, infos = env.step(actor.act(acting, env.state()))
        joints.append(split_state(problem, env.unwrapped.true_state()))
        effects.append(env.unwrapped.effect().copy())
        all_observations.append(observations)
        all_infos.append(infos)
        outcomes.append(_outcome(env, rewards))
    trajectory = _trajectory(problem, joints, outcomes)
    jerk = mean_squared_jerk(accelerations(problem, trajectory), trajectory.arrived, problem.dt)
    metrics = {**env.unwrapped.metrics(), "mean_squared_jerk": jerk}
    events = None if all(part is None for part in effects[0]) else events_of(effects, problem)
    goals = np.stack([joint.goals for joint in joints])
    return Episode(problem, trajectory, metrics, tuple(all_observations), tuple(all_infos), goals, events)


def _parallel(env: gymnasium.Env[Any, Any]) -> ParallelEnv:
    """The parallel environment of the options of a joint one."""
    joint: Any = env.unwrapped
    layer: Any = env
    while isinstance(layer, OrderEnforcing | PassiveEnvChecker):
        layer = layer.env
    if isinstance(joint, JointNavigationEnv) and layer is joint:
        return navigation_v0.parallel_env(**joint.options.keywords())
    raise ValueError(
        f"{env} is no environment of this package, or is wrapped; give navigation_v0.parallel_env(...), or what "
        f"gymnasium.make returns"
    )


def _moved_by(env: ParallelEnv, physics: str) -> ParallelEnv:
    """An environment with the options of another, moved by some physics."""
    module, bodies = find_physics(physics, env.unwrapped.problem)
    if env is not env.unwrapped:
        raise ValueError(f"physics is {physics!r}, and the environment is wrapped; give one that is not")
    return module.parallel_env(**env.options.keywords(), **bodies)


def _outcome(env: ParallelEnv, rewards: dict[str, float]) -> tuple[FloatArray, BoolArray, BoolArray]:
    """``(K,)`` rewards, contacts and margin violations of the last step, of robots that have left the episode too."""
    step = env.unwrapped.last_step
    all_rewards = step.rewards.copy()
    all_rewards[robot_indices(rewards)] = [*rewards.values()]  # as wrappers have made them
    return all_rewards, step.collided, step.margin_violated


def _trajectory(
    problem: Problem, joints: list[JointState], outcomes: list[tuple[FloatArray, BoolArray, BoolArray]]
) -> Trajectory:
    states = np.stack([joint.states for joint in joints])
    rewards, collided, margin_violated = map(np.stack, zip(*outcomes))
    return Trajectory(
        states=states,
        positions=states[..., : problem.dimension],
        controls=np.stack([joint.controls for joint in joints[1:]]),
        rewards=rewards[1:],
        arrived=np.stack([joint.arrived for joint in joints]),
        collided=collided,
        margin_violated=margin_violated,
    )
