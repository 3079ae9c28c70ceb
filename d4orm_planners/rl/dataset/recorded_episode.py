"""Observations, actions and rewards of a team in one episode."""

from __future__ import annotations

import copy
import json
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray, as_float32
from d4orm_env.core.files import ArrayArchive, replaced_when_done
from d4orm_env.envs.team_step import TeamStep
from d4orm_planners.base.episode import run_episode
from d4orm_planners.base.policy import Actions, Observations, Policy, robot_indices

if TYPE_CHECKING:
    from pettingzoo import ParallelEnv

MAX_BYTES = 2**31
"""Largest array of an episode that is read."""


@dataclass(frozen=True, eq=False)
class RecordedEpisode:
    """One episode of a team, ``T`` steps long: every robot at every time, those that have docked included.

    Attributes:
        observations: ``(T+1, K, D)`` float32.
        actions: ``(T, K, m)`` float32 as the policy gave them, in physical units, before anything disturbed or clipped
            them; zero for robots that have left.
        acting: ``(T, K)`` bool: whose action counted.
        rewards: ``(T, K)`` float32 of every robot.
        terminations: ``(T, K)`` bool: which robots the step ended for, because they had arrived.
        arrived: ``(T+1, K)`` bool, likewise ``collided`` and ``margin_violated``.
        distance_to_goal: ``(T+1, K)`` float32 [m].
        state: ``(T+1, S)`` float32, ``env.state()``.
        metadata: Seed, digest of the problem, and the episode's metrics.
    """

    observations: FloatArray
    actions: FloatArray
    acting: BoolArray
    rewards: FloatArray
    terminations: BoolArray
    arrived: BoolArray
    collided: BoolArray
    margin_violated: BoolArray
    distance_to_goal: FloatArray
    state: FloatArray
    metadata: Mapping[str, Any]

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
        except (ValueError, KeyError, EOFError, RecursionError, zipfile.BadZipFile, zlib.error) as error:
            raise ValueError(f"{path} is no recorded episode ({error}); remove it to record it anew") from None
        return cls(**arrays, metadata=metadata)


_ARRAYS = tuple(field.name for field in fields(RecordedEpisode) if field.name != "metadata")
_FLAGS = ("acting", "terminations", "arrived", "collided", "margin_violated")
_OF_STEPS = ("actions", "acting", "rewards", "terminations")
"""Arrays of ``T`` moments; the others have one more."""


def _check(arrays: Mapping[str, np.ndarray], metadata: object) -> None:
    """Refuse what is no episode, in types or shapes."""
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
    """Run an episode and keep all that there is to learn from.

    Args:
        env: A :mod:`d4orm_env.navigation_v0` parallel environment, not wrapped.
        policy: The policy.
        seed: Seeds both.

    Returns:
        The episode.
    """
    recorder = _Recorder(policy)
    episode = run_episode(env, recorder, seed=seed)
    world = env.unwrapped
    steps = (*recorder.steps, world.last_step)
    flags = {
        name: np.stack([getattr(step, name) for step in steps]) for name in ("arrived", "collided", "margin_violated")
    }
    acting, actions = recorder.team_actions()
    there = flags["arrived"][1:]
    finished = there if world.problem.docks else there & there.all(axis=1, keepdims=True)
    return RecordedEpisode(
        observations=np.stack([step.observations for step in steps]),
        actions=actions,
        acting=acting,
        rewards=np.stack([step.rewards for step in steps[1:]]),
        terminations=acting & finished & (not world.lifelong),
        **flags,
        distance_to_goal=np.stack([step.distances for step in steps]),
        state=np.stack([*recorder.states, world.state()]),
        metadata={"seed": seed, "problem": episode.problem.digest, **_plain(episode.metrics)},
    )


def _plain(metrics: Mapping[str, float]) -> dict[str, float | bool]:
    numbers = {name: float(value) for name, value in metrics.items()}
    return numbers | ({"success": bool(metrics["success"])} if "success" in metrics else {})


class _Recorder(Policy):
    """A policy that notes what the team saw and did."""

    def __init__(self, policy: Policy) -> None:
        self._policy = copy.copy(policy)
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
        # The environment says what is wrong with them, if anything is.
        self._actions.append({agent: actions[agent] for agent in observations if agent in actions})
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
