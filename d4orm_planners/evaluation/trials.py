"""Running trials, in this process or in several, each stored as soon as it is done."""

from __future__ import annotations

import importlib.metadata
import json
import os
import signal
import threading
import time
from collections.abc import Generator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any

from d4orm_env import navigation_v0
from d4orm_env.core.problem import Problem
from d4orm_planners.episode import run_episode
from d4orm_planners.evaluation.store import Trial, TrialKey, TrialStore
from d4orm_planners.policy import Actions, OpenLoop, Policy
from d4orm_planners.registry import make_policy, policy_settings

LIBRARIES = ("d4orm-env", "numpy", "numba", "jax", "pyrvo", "casadi")


@dataclass(frozen=True)
class Job:
    """A policy on a problem with one seed, at several levels of noise.

    Attributes:
        policy: Registry name.
        settings: Those that differ from the defaults.
        problem: The problem.
        seed: Of the policy and of the noise.
        noise: Standard deviations of the execution noise, in the controls' units.
    """

    policy: str
    settings: Mapping[str, Any]
    problem: Problem
    seed: int
    noise: tuple[float, ...]

    @property
    def label(self) -> str:
        """For people who watch."""
        return f"{self.policy}, {self.problem.name}, {self.problem.num_robots} robots"

    @property
    def keys(self) -> list[TrialKey]:
        """Of its trials, one per level of noise."""
        config = json.dumps(policy_settings(self.policy, **self.settings), sort_keys=True)
        return [TrialKey(self.policy, config, self.problem.digest, noise, self.seed) for noise in self.noise]


def run_jobs(jobs: Sequence[Job], store: TrialStore, workers: int) -> Generator[Job]:
    """Run jobs and yield each when its trials are stored.

    With one worker they run in this process, on all its cores; else in that many processes of one thread each. When the
    iteration is broken off, or this process dies, the workers stop at once.

    Raises:
        ChildProcessError: If a worker dies.
    """
    workers = min(workers, len(jobs))
    if workers <= 1:
        for job in jobs:
            run_job(job, store)
            yield job
        return
    context = get_context("spawn")
    # Nobody else holds the sending end: when this process closes it or dies, the workers notice.
    receiver, sender = context.Pipe(duplex=False)
    pool = ProcessPoolExecutor(workers, context, _start_worker, (receiver,))
    try:
        futures = {pool.submit(run_job, job, store): job for job in jobs}
        for future in as_completed(futures):
            future.result()
            yield futures[future]
    except BrokenProcessPool as error:
        raise ChildProcessError(
            "a worker process died, perhaps for lack of memory; what was done is stored, so run again, with fewer "
            "workers"
        ) from error
    except BaseException:
        sender.close()  # so that nobody finishes what is no longer wanted
        raise
    finally:
        pool.shutdown(cancel_futures=True)
        sender.close()
        receiver.close()


def _start_worker(receiver: Connection) -> None:
    """One thread, no Ctrl-C (the parent gets it and decides), and an end together with the parent."""
    os.environ.update(D4ORM_NUM_THREADS="1", OMP_NUM_THREADS="1")
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def follow_parent() -> None:
        receiver.poll(None)
        os._exit(1)

    threading.Thread(target=follow_parent, daemon=True).start()


def run_job(job: Job, store: TrialStore) -> None:
    """Run the trials of a job one after another; a plan is made once and executed at every level of noise."""
    timed: _TimedPolicy | None = None
    for key in job.keys:
        trial = Trial(
            **key._asdict(),
            scenario=job.problem.name,
            robots=job.problem.num_robots,
            model="+".join(sorted(set(job.problem.team.models))),
            versions=_versions(),
        )
        try:
            timed = timed or _TimedPolicy(make_policy(job.policy, **job.settings))
            trial = _run_trial(trial, timed, job.problem)
        except Exception as error:  # whatever a policy raises is the result of its trial
            trial = replace(trial, error=f"{type(error).__name__}: {' '.join(str(error).split())}")
        store.add(trial)


def _run_trial(trial: Trial, policy: _TimedPolicy, problem: Problem) -> Trial:
    env = navigation_v0.parallel_env(problem=problem, control_noise_std=trial.noise)
    metrics = run_episode(env, policy, seed=trial.seed).metrics
    env.close()
    return replace(
        trial,
        success=bool(metrics["success"]),
        collided=int(metrics["collided"]),
        arrived=int(metrics["arrived"]),
        travel_time=metrics["travel_time"],
        makespan=metrics["makespan"],
        steps=int(metrics["steps"]),
        wall_time=policy.wall_time,
    )


class _TimedPolicy(Policy):
    """A policy with a stopwatch. It keeps the plan of an open-loop policy from one episode to the next."""

    name = "timed"

    def __init__(self, policy: Policy) -> None:
        self._policy = policy
        self.wall_time = 0.0

    def reset(self, env: Any, seed: int = 0) -> None:
        begin = time.perf_counter()
        self._policy.reset(env, seed)
        self.wall_time = time.perf_counter() - begin
        if isinstance(self._policy, OpenLoop) and (plan := self._policy.plan) is not None:
            if plan.status == "interrupted":
                raise KeyboardInterrupt  # half a solve says nothing about the planner
            self._policy.planner = None  # from now on it executes this plan
            self.wall_time = plan.wall_time

    def act(self, observations: dict[str, Any], state: Any) -> Actions:
        begin = time.perf_counter()
        actions = self._policy.act(observations, state)
        if not isinstance(self._policy, OpenLoop):
            self.wall_time += time.perf_counter() - begin
        return actions

    def _controls(self, joint: Any) -> Any:
        raise NotImplementedError("act() asks the policy itself")


def _versions() -> str:
    installed = {}
    for name in LIBRARIES:
        try:
            installed[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return json.dumps(installed, sort_keys=True)
