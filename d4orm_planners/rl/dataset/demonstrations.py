"""Demonstrations that a dataset is made of: a policy in an environment, seed by seed."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from contextlib import closing
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

from d4orm_env import __version__, navigation_v0
from d4orm_env.core.arrays import shown, whole_number
from d4orm_env.core.problem import Problem
from d4orm_env.core.registry import source_digest
from d4orm_env.disturbances.disturbance import Disturbance
from d4orm_planners.base.planner_registry import PolicyLike, make_policy, origin, policy_settings
from d4orm_planners.evaluation.trials import Condition
from d4orm_planners.rl.dataset.recorded_episode import RecordedEpisode, record_episode

if TYPE_CHECKING:
    from pettingzoo import ParallelEnv

LARGEST_SEED = 2**63 - 1
AGENTS = ("team", "robot")
"""Owner of an episode of a dataset."""


@dataclass(frozen=True, kw_only=True)
class Demonstrations:
    """Episodes of a policy to be recorded.

    Attributes:
        policy: The policy, as for :func:`~d4orm_planners.make_policy`.
        settings: Of the policy, ``time_limit`` and ``preset`` of a planner among them.
        environment: Arguments of :class:`~d4orm_env.navigation_v0.parallel_env`, as ``{"scenario": "random",
            "num_robots": 8}``.
        seeds: One episode each: the environment is reset with the seed, which draws the instance where the scenario
            draws, and so is the policy.
        agents: Owner of an episode of the dataset: ``"team"``, with the spaces of the joint environment, or
            ``"robot"``, one for each robot with its own.
        only_success: Leave out episodes in which a robot touches anything or does not arrive.

    Raises:
        ValueError: For an unknown name, a setting or argument that makes no sense, or seeds that are none.
        TypeError: For an unknown setting or argument.
        ImportError: If the policy needs a library that is not installed.
    """

    policy: PolicyLike = "d4orm-c2f"
    settings: Mapping[str, object] = field(default_factory=dict)
    environment: Mapping[str, Any] = field(default_factory=dict)
    seeds: Iterable[int] = range(100)
    agents: str = "team"
    only_success: bool = False
    _source: Any = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.agents not in AGENTS:
            raise ValueError(f"agents is {shown(self.agents)}; choose 'team' or 'robot'")
        if not isinstance(self.seeds, Iterable):
            raise ValueError(f"seeds is {shown(self.seeds)}; give the seeds themselves, as range(100)")
        seeds = tuple(dict.fromkeys(whole_number(seed, "seed", 0, LARGEST_SEED) for seed in self.seeds))
        if not seeds:
            raise ValueError("seeds is empty; give at least one")
        object.__setattr__(self, "seeds", seeds)
        object.__setattr__(self, "_source", origin(self.policy))
        if self.environment.get("render_mode") is not None:
            raise ValueError("render_mode is for looking on; a dataset records without, so leave it out")
        if self.only_success and self.environment.get("lifelong"):
            raise ValueError("only_success and lifelong do not go together: a lifelong episode never ends in success")
        make_policy(self._source, **self.settings)
        self.make_env().close()

    def make_env(self) -> ParallelEnv:
        """A new environment to record in."""
        return navigation_v0.parallel_env(**self.environment)

    def record(self, seed: int) -> RecordedEpisode:
        """The episode of a seed."""
        with closing(self.make_env()) as env:
            return record_episode(env, make_policy(self._source, **self.settings), seed)

    @property
    def policy_name(self) -> str:
        """Name of the policy."""
        policy = self.policy
        return policy if isinstance(policy, str) else getattr(policy, "__name__", type(policy).__name__)

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
    raise TypeError(f"{type(thing).__name__} is none of these")
