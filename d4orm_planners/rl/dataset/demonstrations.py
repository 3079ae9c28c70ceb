"""Demonstrations that a dataset is made of: recorded episodes of a policy in an environment, seed by seed."""

from __future__ import annotations

import json
import re
import zipfile
import zlib
from collections.abc import Iterable, Mapping
from contextlib import closing, suppress
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from pettingzoo import ParallelEnv

from d4orm_env import __version__, navigation_v0
from d4orm_env.core.arrays import BoolArray, FloatArray, as_float32, check_choice, plain_number, short_repr, truth
from d4orm_env.core.files import ArrayArchive, replaced_when_done
from d4orm_env.core.problem import Problem
from d4orm_env.core.registry import source_digest
from d4orm_env.core.seeds import checked_seeds
from d4orm_env.disturbances.disturbance import Disturbance
from d4orm_env.envs.team_step import TeamStep
from d4orm_planners.base.episode import run_episode
from d4orm_planners.base.planner_registry import PolicyLike, called, fresh_policy, origin, policy_settings
from d4orm_planners.base.policy import Actions, Observations, Policy, robot_indices
from d4orm_planners.evaluation.trials import Condition

AGENTS = ("team", "robot")  #: Owner of an episode of a dataset
MAX_BYTES = 2**31  #: Largest array of an episode that is read
UNREADABLE = (ValueError, KeyError, EOFError, RecursionError, zipfile.BadZipFile, zlib.error)
"""Errors of reading arrays from a file that holds something else."""
_FLAGS = ("acting", "terminations", "arrived", "collided", "margin_violated")
_OF_STEPS = ("actions", "acting", "rewards", "terminations")  #: Arrays of ``T`` moments; the others have one more


@dataclass(frozen=True, kw_only=True)
class Demonstrations:
    """Episodes of a policy to be recorded.

    Raises:
        ValueError: For an unknown name, a setting or argument that makes no sense, or seeds that are none.
        TypeError: For an unknown setting or argument.
        ImportError: If the policy needs a library that is not installed.
    """

    policy: PolicyLike = "d4orm-c2f"  #: The policy, as for :func:`~d4orm_planners.make_policy`
    #: Of the policy, ``time_limit`` and ``preset`` of a planner among them
    settings: Mapping[str, object] = field(default_factory=dict)
    #: Arguments of :class:`~d4orm_env.navigation_v0.parallel_env`, as ``{"scenario": "random", "num_robots": 8}``
    environment: Mapping[str, Any] = field(default_factory=dict)
    #: One episode each: the environment is reset with the seed, which draws the instance where the scenario draws, and
    #: so is the policy
    seeds: Iterable[int] = range(100)
    #: Owner of an episode of the dataset: ``"team"``, with the spaces of the joint environment, or ``"robot"``, one for
    #: each robot with its own
    agents: str = "team"
    only_success: bool = False  #: Leave out episodes in which a robot touches anything or does not arrive
    _source: Any = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        check_choice(self.agents, "agents", AGENTS)
        for name in ("settings", "environment"):
            if not isinstance(given := getattr(self, name), Mapping):
                raise ValueError(f"{name} is {short_repr(given)}; give arguments by name, in a mapping")
        truth(self.only_success, "only_success")
        object.__setattr__(self, "seeds", checked_seeds(self.seeds))
        object.__setattr__(self, "_source", origin(self.policy))
        if self.environment.get("render_mode") is not None:
            raise ValueError("render_mode is for looking on; a dataset records without, so leave it out")
        if self.only_success and self.environment.get("lifelong"):
            raise ValueError("only_success and lifelong do not go together: a lifelong episode never ends in success")
        fresh_policy(self._source, **self.settings)
        with closing(self.make_env()) as env:
            env.unwrapped.options.require_physical_units()

    def make_env(self) -> ParallelEnv:
        return navigation_v0.parallel_env(**self.environment)

    def record(self, seed: int) -> RecordedEpisode:
        with closing(self.make_env()) as env:
            return record_episode(env, fresh_policy(self._source, **self.settings), seed)

    @property
    def policy_name(self) -> str:
        return called(self.policy)

    @cached_property
    def identity(self) -> dict[str, object]:
        """All that an episode depends on beside its seed, as JSON has it.

        Raises:
            ValueError: If something has no form in JSON, or a user's source cannot be read.
        """
        whole = {
            "policy": self.policy_name,
            "settings": policy_settings(self._source, **self.settings),
            "environment": dict(self.environment),
            "agents": self.agents,
            "only_success": self.only_success,
            "version": __version__,
        }
        try:
            return dict(json.loads(json.dumps(whole, default=_described)))
        except TypeError as error:
            raise ValueError(
                f"a setting of the policy or an argument of the environment cannot be written down ({error}); give "
                "numbers, text, truth values, lists and mappings of them"
            ) from None

    @property
    def dataset_id(self) -> str:
        """A name for the dataset of the form that Minari has, ``d4orm/SCENARIO-ROBOTS-POLICY-v0``."""
        problem = self.make_env().unwrapped.problem
        words = f"{problem.name}-{problem.num_robots}-{self.policy_name}" + "-robot" * (self.agents == "robot")
        return f"d4orm/{re.sub(r'[^-_a-zA-Z0-9]+', '_', words)}-v0"


def _described(thing: object) -> object:
    """Describe what JSON has no word for, so that it is told from others."""
    if isinstance(thing, Problem):
        return {"problem": thing.digest}
    if isinstance(thing, Disturbance):
        return json.loads(Condition(disturbances=(thing,)).text)
    if callable(thing):
        return {"source": source_digest(thing), "name": getattr(thing, "__qualname__", type(thing).__qualname__)}
    return plain_number(thing)


@dataclass(frozen=True, eq=False)
class RecordedEpisode:
    """One episode of a team, ``T`` steps long: every robot at every time, those that have docked included."""

    observations: FloatArray  #: ``(T+1, K, D)`` float32
    #: ``(T, K, m)`` float32 as the policy gave them, in physical units, before anything disturbed or clipped them;
    #: zero for robots that have left
    actions: FloatArray
    acting: BoolArray  #: ``(T, K)`` bool: whose action counted
    rewards: FloatArray  #: ``(T, K)`` float32 of every robot
    terminations: BoolArray  #: ``(T, K)`` bool: which robots the step ended for, because they had arrived
    arrived: BoolArray  #: ``(T+1, K)`` bool, likewise ``collided`` and ``margin_violated``
    collided: BoolArray
    margin_violated: BoolArray
    distance_to_goal: FloatArray  #: ``(T+1, K)`` float32 [m]
    state: FloatArray  #: ``(T+1, S)`` float32, ``env.state()``
    metadata: Mapping[str, Any]  #: Seed, digest of the problem, and the episode's metrics

    @property
    def success(self) -> bool:
        """True if all arrived in time and none was ever in contact; never in lifelong mode."""
        return bool(self.metadata.get("success", False))

    def save(self, path: Path) -> None:
        """Write it into an ``.npz`` file, which is whole or not there."""
        arrays = {name: getattr(self, name) for name in _ARRAYS}
        text = np.frombuffer(json.dumps(dict(self.metadata)).encode(), np.uint8)
        with replaced_when_done(path, (".npz",)) as temporary, temporary.open("wb") as stream:
            np.savez_compressed(stream, metadata=text, **arrays)

    @classmethod
    def load(cls, path: Path) -> RecordedEpisode:
        """Read what :meth:`save` has written.

        Raises:
            ValueError: If it is something else.
        """
        try:
            with path.open("rb") as stream, ArrayArchive(stream, (*_ARRAYS, "metadata")) as archive:
                arrays = {name: archive.array(name, MAX_BYTES) for name in _ARRAYS}
                metadata = json.loads(archive.array("metadata", MAX_BYTES).tobytes())
            _check(arrays, metadata)
        except UNREADABLE as error:
            raise ValueError(f"{path} is no recorded episode ({error}); remove it to record it anew") from None
        return cls(**arrays, metadata=metadata)


_ARRAYS = tuple(field.name for field in fields(RecordedEpisode) if field.name != "metadata")


def _check(arrays: Mapping[str, np.ndarray], metadata: object) -> None:
    actions = arrays["actions"]
    if actions.ndim != 3 or not isinstance(metadata, dict) or not isinstance(metadata.get("seed"), int):
        raise ValueError("it lacks a seed, or actions of every robot at every step")
    steps, robots = actions.shape[:2]
    axes = {"observations": 3, "actions": 3}
    for name, array in arrays.items():
        kind = np.dtype(np.bool_ if name in _FLAGS else np.float32)
        lengths = (steps + (name not in _OF_STEPS), *(() if name == "state" else (robots,)))
        if array.dtype != kind or array.ndim != axes.get(name, 2) or array.shape[: len(lengths)] != lengths:
            raise ValueError(f"{name} is of type {array.dtype} and shape {array.shape}")


def record_episode(env: ParallelEnv, policy: Policy, seed: int = 0) -> RecordedEpisode:
    """Run an episode of an environment that is not wrapped, and keep all that there is to learn from."""
    recorder = _Recorder(policy)
    episode = run_episode(env, recorder, seed=seed)
    world = env.unwrapped
    steps = (*recorder.steps, world.last_step)
    flags = {
        name: np.stack([getattr(step, name) for step in steps]) for name in ("arrived", "collided", "margin_violated")
    }
    acting, actions = recorder.team_actions()
    metrics = {name: (bool if name == "success" else float)(value) for name, value in episode.metrics.items()}
    arrived = flags["arrived"][1:]
    finished = arrived if world.problem.docks else arrived & arrived.all(axis=1, keepdims=True)
    return RecordedEpisode(
        observations=np.stack([step.observations for step in steps]),
        actions=actions,
        acting=acting,
        rewards=np.stack([step.rewards for step in steps[1:]]),
        terminations=acting & finished & (not world.lifelong),
        **flags,
        distance_to_goal=np.stack([step.distances for step in steps]),
        state=np.stack([*recorder.states, world.state()]),
        metadata={"seed": seed, "problem": episode.problem.digest, **metrics},
    )


def _kept(action: Any) -> Any:
    """A copy, for a policy may use the array again; or what it is, and the environment says what is wrong with it."""
    with suppress(ValueError):
        return as_float32(action)
    return action


class _Recorder(Policy):
    """A policy that notes what the team saw and did."""

    def __init__(self, policy: Policy) -> None:
        self._policy = policy
        self.steps: list[TeamStep] = []
        self.states: list[FloatArray] = []
        self._actions: list[Actions] = []

    def reset(self, env: ParallelEnv, seed: int = 0) -> None:
        super().reset(env, seed)
        self._env = env
        self._policy.reset(env, seed)

    def act(self, observations: Observations, state: FloatArray) -> Actions:
        actions = self._policy.act(observations, state)
        self.steps.append(self._env.unwrapped.last_step)
        self.states.append(state.copy())
        self._actions.append({agent: _kept(actions[agent]) for agent in observations if agent in actions})
        return actions

    def team_actions(self) -> tuple[BoolArray, FloatArray]:
        """``(T, K)`` bool: acted, and the actions ``(T, K, m)``."""
        shape = (len(self._actions), self.problem.num_robots)
        acting, controls = np.zeros(shape, np.bool_), np.zeros((*shape, self.problem.control_size), np.float32)
        for step, actions in enumerate(self._actions):
            robots = robot_indices(actions)
            acting[step, robots] = True
            controls[step, robots] = as_float32(list(actions.values()))
        return acting, controls
