"""Running trials: an episode of a policy, timed, judged and put into a row."""

from __future__ import annotations

import json
import sysconfig
import time
import traceback
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np
from pettingzoo import ParallelEnv

from d4orm_env import verify
from d4orm_env.core.arrays import FloatArray, plain_number
from d4orm_env.core.errors import describe
from d4orm_env.core.problem import Problem
from d4orm_env.core.registry import load_reference, source_digest
from d4orm_env.disturbances.disturbance import AnyDisturbance
from d4orm_env.disturbances.disturbance_registry import attributes_of, name_of
from d4orm_planners.base.episode import open_env, run_episode
from d4orm_planners.base.plan import IterationRecord, Plan
from d4orm_planners.base.planner_registry import fresh_policy, is_planned, policy_settings
from d4orm_planners.base.policy import Actions, Observations, OpenLoop, Policy
from d4orm_planners.base.provenance import commit, describe_machine, versions
from d4orm_planners.evaluation.store import Trial, TrialKey

PACKAGES = (
    *(str(Path(__file__).parents[2] / name) for name in ("d4orm_env", "d4orm_planners")),
    *(sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")),
)
"""Folders of code that is not a user's."""
LIBRARIES = ("d4orm-env", "numpy", "numba", "jax", "pyrvo", "casadi", "mujoco", "crazyflow")


@dataclass(frozen=True)
class Condition:
    """Condition of a trial."""

    control_noise_std: float = 0.0  #: Standard deviation of the execution noise, in the controls' units
    disturbances: tuple[AnyDisturbance, ...] = ()  #: Further disturbances
    name: str = ""  #: Varied quantity, such as ``"push.speed"``; empty for nothing
    level: float | None = None  #: Its level; of disturbances that differ in more than a number, their index
    physics: str = "model"  #: Physics of the robots, see :func:`~d4orm_planners.base.episode.find_physics`

    @property
    def text(self) -> str:
        """The effective disturbances as JSON, ``[name, attributes]`` each; ValueError for what has no such form."""
        listed = [[name_of(one), _attributes(one)] for one in self.disturbances if not one.negligible]
        return _stored(listed, f"disturbance {self.name!r} has an attribute")

    @property
    def replayable(self) -> bool:
        """True if the executed controls alone tell how the robots have moved."""
        return self.physics == "model" and all(one.negligible or one.replayable for one in self.disturbances)


@dataclass(frozen=True)
class Configuration:
    """A policy with its settings."""

    label: str  #: Its name in the results
    policy: str  #: Its name or import path; the label of one that a program gave itself
    settings: Mapping[str, object]  #: Those that differ from the defaults
    given: object = None  #: Argument of :func:`~d4orm_planners.make_policy` for it in any process, if not ``policy``
    #: Arguments of the environment on what robots observe, where they are others than its own
    observation: Mapping[str, object] = field(default_factory=dict)

    @property
    def source(self) -> Any:
        """Policy as :func:`~d4orm_planners.make_policy` takes it, with the settings."""
        return self.policy if self.given is None else self.given

    @cached_property
    def config(self) -> str:
        """All settings, a user's source's digest, and what is observed, as sorted JSON; ValueError likewise."""
        observed = {"observation": dict(self.observation)} if self.observation else {}
        settings = policy_settings(self.source, **self.settings)
        return _stored(settings | observed, f"policy {self.label!r} has a setting")

    @cached_property
    def planned(self) -> bool:
        """True if it is a plan executed open loop."""
        return is_planned(self.source)


@dataclass(frozen=True)
class Job:
    """A policy on a problem with one seed, under several conditions.

    ``scenario`` is a name for the results; ``imports`` are import paths, after which a process knows users' models.
    """

    policy: Configuration
    problem: Problem
    scenario: str
    seed: int
    conditions: tuple[Condition, ...]
    imports: tuple[str, ...] = ()

    def key(self, condition: Condition) -> TrialKey:
        policy, noise = self.policy, condition.control_noise_std
        key = (policy.policy, policy.config, self.problem.digest, noise, self.seed, condition.text, condition.physics)
        return TrialKey(*key)

    def failed(self, condition: Condition, error: str) -> Trial:
        """The trial under one condition, which has no outcome."""
        return Trial(
            **vars(self.key(condition)),
            label=self.policy.label,
            scenario=self.scenario,
            num_robots=self.problem.num_robots,
            model="+".join(sorted(set(self.problem.team.models))),
            dt=self.problem.dt,
            date=datetime.now(UTC).isoformat(timespec="seconds"),
            error=error,
        )

    @property
    def num_parts(self) -> int:
        return len(self.conditions)

    def run(self) -> Iterator[Trial]:
        """Run the trials one after another; a plan is made once and executed under all conditions.

        Whatever a policy raises is the result of its trial, an exit of the program too, but for Ctrl-C.
        """
        for reference in self.imports:
            load_reference(reference)
        timed: _TimedPolicy | None = None
        for condition in self.conditions:
            begin = time.perf_counter()
            error, outcome = "", {}
            try:
                if timed is None or timed.plan is None:
                    timed = _TimedPolicy(fresh_policy(self.policy.source, **self.policy.settings))
                outcome = _outcome(timed, self, condition)
            except (Exception, SystemExit, GeneratorExit) as problem:
                error = describe(problem) + _place(problem)
            libraries, machine = _origin()
            trial = replace(self.failed(condition, error), versions=libraries, machine=machine, **outcome)
            yield replace(trial, elapsed=time.perf_counter() - begin)

    def lost(self, done: int, reason: str) -> tuple[list[Trial], Job | None]:
        left = self.conditions[done:]
        # Without a plan there is nothing to execute, under any condition.
        count = len(left) if done == 0 and self.policy.planned else 1
        rest = replace(self, conditions=left[count:]) if left[count:] else None
        return [self.failed(condition, reason) for condition in left[:count]], rest


def _place(error: BaseException) -> str:
    """Last place in a user's code on the way to it, in brackets; empty without one."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if not frame.filename.startswith(("<", *PACKAGES))]
    return f" ({Path(own[-1].filename).name}, line {own[-1].lineno})" if own else ""


def _outcome(policy: _TimedPolicy, job: Job, condition: Condition) -> dict[str, Any]:
    """Columns of a trial that runs to its end."""
    problem = job.problem
    wrong = {"control_noise_std": condition.control_noise_std, "disturbances": condition.disturbances}
    env = open_env(problem, condition.physics, policy.actor, **wrong, **job.policy.observation)
    episode = run_episode(env, policy, seed=job.seed)
    env.close()
    metrics, plan = episode.metrics, policy.plan
    sent = {} if plan is None else plan.metrics
    stretch = episode.stretch if metrics["arrived"] else np.inf
    report = verify(problem, episode.controls) if condition.replayable else None
    return {
        "success": bool(metrics["success"]),
        "verified": None if report is None else report.ok,
        "violation": "" if report is None or report.ok else str(report.violations[0]),
        **{name: int(metrics[name]) for name in ("collided", "arrived", "steps")},
        **{name: float(metrics[name]) for name in ("travel_time", "makespan", "reward", "mean_squared_jerk")},
        "stretch": stretch if np.isfinite(stretch) else None,
        "iterations": None if plan is None else plan.iterations,
        "denoising_share": sent.get("denoising_share"),
        "status": "" if plan is None else plan.status,
        "history": "[]" if plan is None else compact_history(plan.history),
        **{name: sent.get(name) for name in ("messages", "message_bytes", "waiting_share")},
        "wall_time": policy.wall_time,
        "preparation": policy.preparation,
        "training_time": policy.training_time,
    }


def compact_history(history: tuple[IterationRecord, ...]) -> str:
    """The iterations of a solve after which the best plan was another, as :attr:`Trial.history` keeps them."""
    points: list[list[Any]] = []
    for record in history:
        seconds, reward = round(record.wall_time, 6), float(f"{record.best_reward:.6g}")
        point: list[Any] = [seconds, int(record.best_solved), reward, record.denoising_steps]
        if record.denoising_time is not None and record.wall_time > 0:
            point.append(round(record.denoising_time / record.wall_time, 4))
        if not points or points[-1][1:3] != point[1:3]:
            points.append(point)
    return json.dumps(points, separators=(",", ":"))


class _TimedPolicy(Policy):
    """A policy with a stopwatch. It keeps the plan of an open-loop policy from one episode to the next."""

    def __init__(self, policy: Policy) -> None:
        self.actor = policy
        self.wall_time = 0.0
        self.preparation = 0.0
        self.plan: Plan | None = None

    @property
    def training_time(self) -> float | None:
        time: float | None = getattr(self.actor, "training_time", None)
        return time

    def reset(self, env: ParallelEnv, seed: int = 0) -> None:
        begin = time.perf_counter()
        self.actor.reset(env, seed)
        self.wall_time = self.preparation = time.perf_counter() - begin
        if isinstance(self.actor, OpenLoop) and (plan := self.actor.plan) is not None:
            if plan.status == "interrupted":
                raise KeyboardInterrupt  # half a solve says nothing about the planner
            self.actor.planner = None  # from now on it executes this plan
            self.plan, self.wall_time = plan, plan.wall_time
            self.preparation = plan.wall_time

    def act(self, observations: Observations, state: FloatArray) -> Actions:
        begin = time.perf_counter()
        actions = self.actor.act(observations, state)
        if self.plan is None:
            self.wall_time += time.perf_counter() - begin
        return actions


@cache
def _origin() -> tuple[str, str]:
    """Versions of the libraries with the commit of this package, and the machine, as JSON."""
    source = {"commit": found} if (found := commit()) else {}
    return json.dumps({**versions(LIBRARIES), **source}, sort_keys=True), json.dumps(describe_machine(), sort_keys=True)


def _stored(content: object, owner: str) -> str:
    """JSON with sorted keys; the error of what has no such form begins with its owner."""
    try:
        return json.dumps(content, sort_keys=True, default=plain_number)
    except TypeError as error:
        raise ValueError(
            f"{owner} that cannot be stored ({error}); give numbers, text, truth values, lists and mappings of them"
        ) from None


def _attributes(one: AnyDisturbance) -> dict[str, object]:
    attributes = attributes_of(one)
    foreign = type(one).__module__.partition(".")[0] != "d4orm_env"
    return {**attributes, "source": source_digest(type(one))} if foreign else attributes
