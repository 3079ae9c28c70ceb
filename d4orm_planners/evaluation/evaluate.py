"""Running a study: its trials are stored one by one, and those that are stored already are not run again."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence, Set
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from pathlib import Path

from d4orm_env.core.arrays import duration, whole_number
from d4orm_env.core.files import checked_path, make_folder
from d4orm_env.core.registry import check_sendable
from d4orm_env.engine.threads import available_cores
from d4orm_planners.d_d4orm.ray_planner import host_and_port, import_ray
from d4orm_planners.evaluation.pool import RAY_USE, ProcessWorker, run_here, run_jobs, run_on_ray
from d4orm_planners.evaluation.robustness import write_disturbances
from d4orm_planners.evaluation.store import STORE, Trial, TrialKey, TrialStore
from d4orm_planners.evaluation.study import DisturbanceLevels, Policies, Scenarios, Study
from d4orm_planners.evaluation.summary import SuccessRate, TrialGroup, success_rates
from d4orm_planners.evaluation.tables import PARQUET_HINT, write_results
from d4orm_planners.evaluation.trials import Job

SHARD_STORES = "trials-*.sqlite"  #: Stores of shards in a folder
Progress = Callable[[str, int, int], object]


def evaluate(
    policies: Policies,
    scenarios: Scenarios = ("circle",),
    *,
    out: str | os.PathLike[str],
    seeds: Iterable[int] = range(50),
    control_noise_std: float | Iterable[float] = 0.0,
    disturbances: DisturbanceLevels | None = None,
    num_robots: int | Iterable[int | None] | None = None,
    model: str | Iterable[str | None] | None = None,
    scenario_settings: Mapping[str, object] | None = None,
    time_limit: float | None = None,
    physics: str = "model",
    observation: Mapping[str, object] | None = None,
    trial_timeout: float | None = None,
    workers: int | None = None,
    ray: str | None = None,
    progress: Progress | None = None,
) -> list[SuccessRate]:
    """Run every policy on every scenario and team size with every seed at every level of noise, and write the results.

    Trials are stored in ``out/trials.sqlite`` as they end. Those found there are not run again, so that a call that was
    broken off, or one with more to do, goes on from there; those that ended with an error are. At the end the store is
    written as ``trials.csv`` and, if pyarrow is installed, ``trials.parquet``, and what is returned as ``table.md`` and
    ``table.csv``.

    Args:
        policies: A policy or several: names (:func:`d4orm_planners.list_policies`), ``"package.module:Name"``, or
            whatever else :func:`d4orm_planners.make_policy` takes. Or by label policies of your own and settings:
            ``{"mine": MyPolicy(), "f": my_function, "d4orm": {}, "d4orm, few": {"policy": "d4orm", "num_samples":
            128}}``. Without ``"policy"`` the label is the name. The store tells policies of your own apart by label
            or import path, settings, attributes and the digest of their source file.
        scenarios: Scenarios as for :func:`d4orm_env.make_problem`, or problems.
        out: Folder to write to; made if it does not exist.
        seeds: Each seeds the scenario, the policy and the noise of a trial.
        control_noise_std: Standard deviations of the Gaussian noise added to the controls, in their units.
        disturbances: Levels of disturbances by name, as ``{"delay": [0, 1, 2], "push.speed": [0.2, 0.5]}``, with one
            without effect, or from harmless to bad; without an attribute behind the name it is the kind's first. Or by
            any label instances of them, your own included, or lists of instances. One at a time, each with every level
            of noise. With them come the files of :func:`~d4orm_planners.evaluation.robustness.write_disturbances` too.
        num_robots: Team sizes for scenarios by name; ``None`` is the scenario's own.
        model: Robot models for scenarios by name; ``None`` is the scenario's own.
        scenario_settings: Further arguments of the scenarios by name, as ``{"corridor_width": 0.8}``; every one of them
            must take all of these. The results name them behind the scenario.
        time_limit: Seconds for planning, for planners without a ``time_limit`` of their own.
        physics: Physics of the robots: ``"model"``, the equations that planners know, ``"mujoco"`` or ``"crazyflow"``,
            with settings of their bodies as ``"crazyflow:gust=0.02"``: see
            :func:`~d4orm_planners.base.episode.find_physics`. Executed controls are not judged by
            :func:`d4orm_env.verify` then.
        observation: Arguments of the environment on what robots observe, as ``{"observed_rays": 32}``.
        trial_timeout: Seconds after which a trial is ended with an error; ``None`` waits.
        workers: Processes of one thread each, by default as many as there are cores; with 1, and without
            ``trial_timeout``, trials run in this process on all its cores. On a cluster: jobs under way at most.
        ray: Address of a Ray cluster to run on, or ``"auto"`` for the one that this machine belongs to.
        progress: Called as ``progress(what, trials done, trials in all)``.

    Returns:
        One row per scenario, model, team size, policy, level of noise and level of disturbance, in that order.

    Raises:
        ValueError: For an unknown name, a number that makes no sense, a policy of your own that worker processes cannot
            import, or a folder or store that is something else or cannot be written to. Nothing has run then.
        ImportError: If a policy, or the cluster, needs a library that is not installed.
        OSError: If workers do not start, or there is no cluster.
    """
    study = Study(
        policies=policies,
        scenarios=scenarios,
        seeds=seeds,
        control_noise_std=control_noise_std,
        disturbances=disturbances,
        num_robots=num_robots,
        model=model,
        scenario_settings=scenario_settings or {},
        time_limit=time_limit,
        physics=physics,
        observation=observation or {},
    )
    trials = run_study(study, out, trial_timeout=trial_timeout, workers=workers, ray=ray, progress=progress)
    rates = success_rates(trials)
    if Path(out) / "trials.parquet" not in write_results(out, rates):
        warnings.warn(PARQUET_HINT, stacklevel=2)
    if disturbances is not None:
        write_disturbances(out, trials)
    return rates


def run_study(
    study: Study,
    out: str | os.PathLike[str],
    *,
    trial_timeout: float | None = None,
    workers: int | None = None,
    ray: str | None = None,
    progress: Progress | None = None,
) -> list[TrialGroup]:
    """Run those trials of a study that are not stored in a folder yet. Nothing is written apart from the store.

    For the arguments and errors see :func:`evaluate`.

    Trials that shards have stored in the folder, see :func:`run_shard`, are taken into the store first.

    Returns:
        Trials, one per seed, for every scenario, model, team size, policy and condition, in that order. Where a
        scenario's seeds give teams of several sizes or models, each of these is a group.
    """
    groups = _checked_groups(study, trial_timeout, workers)
    if ray is not None:
        import_ray(RAY_USE)  # before there is a store
        host_and_port(ray)
    folder = checked_path(out, "the folder of results")
    make_folder(folder)
    store = TrialStore(folder / STORE)
    for path in sorted(folder.glob(SHARD_STORES)):
        store.add(*TrialStore(path, alone=True).trials())
    _complete(store, [job for group in groups for job in group], workers, ray, trial_timeout, progress)
    stored, results = {trial.key: trial for trial in store.trials()}, []
    for group in groups:
        for condition in group[0].conditions:
            teams: dict[tuple[int, str], list[Trial]] = {}
            for job in group:
                # The same problem may have been stored under another name.
                trial = replace(stored[job.key(condition)], scenario=job.scenario)
                teams.setdefault((trial.num_robots, trial.model), []).append(trial)
            results += [
                TrialGroup(group[0].policy.label, trials, condition.name, condition.level) for trials in teams.values()
            ]
    return results


def run_shard(
    study: Study,
    out: str | os.PathLike[str],
    shard: tuple[int, int],
    *,
    trial_timeout: float | None = None,
    workers: int | None = None,
    progress: Progress | None = None,
) -> Path:
    """Run one of several parts of a study, as a job of an array, and store its trials in a file of its own.

    Shards share nothing, so that they run at the same time on any file system; once all have ended :func:`run_study`
    of the same study and folder puts them together. A shard that was stopped goes on where it was.

    Args and errors are those of :func:`run_study`, but for ``shard``: the number of the part, from 1 on, and how many
    there are. An unknown part is a ``ValueError``.

    Returns:
        The file.
    """
    count = whole_number(shard[1], "number of shards", 1)
    index = whole_number(shard[0], "shard", 1, count)
    jobs = [job for group in _checked_groups(study, trial_timeout, workers) for job in group][index - 1 :: count]
    folder = checked_path(out, "the folder of results")
    make_folder(folder)
    path = folder / SHARD_STORES.replace("*", f"{index}-of-{count}")
    store = TrialStore(path, alone=True)
    _complete(store, jobs, workers, None, trial_timeout, progress)
    return path


def _checked_groups(study: Study, trial_timeout: float | None, workers: int | None) -> list[list[Job]]:
    if trial_timeout is not None:
        duration(trial_timeout, "trial_timeout")
    if workers is not None:
        whole_number(workers, "workers", 1)
    return study.groups()


def _missing(jobs: Sequence[Job], finished: Set[TrialKey]) -> tuple[list[Job], int, int]:
    """Return the jobs that are left, the number of trials done, and the number in all."""
    wanted: set[TrialKey] = set()
    missing = []
    for job in jobs:
        left = []
        for condition in job.conditions:
            # The same problem may be asked for under two names, and all disturbances at level zero are one condition.
            if (key := job.key(condition)) not in wanted:
                wanted.add(key)
                left += [condition] if key not in finished else []
        if left:
            missing.append(replace(job, conditions=tuple(left)))
    return missing, len(wanted) - sum(len(job.conditions) for job in missing), len(wanted)


def _run(
    jobs: Sequence[Job], workers: int | None, ray: str | None, trial_timeout: float | None
) -> Generator[list[Trial]]:
    cores = available_cores()
    size = min(workers or cores, max(len(jobs), 1))
    if ray is None and size == 1 and trial_timeout is None:
        return run_here(jobs)
    for policy in {id(job.policy): job.policy for job in jobs}.values():
        check_sendable(policy.source, f"policy {policy.label!r}")
    for condition in jobs[0].conditions if jobs else ():
        check_sendable(condition.disturbances, f"disturbance {condition.name!r}")
    if ray is not None:
        return run_on_ray(jobs, ray, workers, trial_timeout)
    threads = cores if size == 1 else 1
    return run_jobs(jobs, [ProcessWorker(threads) for _ in range(size)], trial_timeout)


def _complete(
    store: TrialStore,
    jobs: Sequence[Job],
    workers: int | None,
    ray: str | None,
    trial_timeout: float | None,
    progress: Progress | None,
) -> None:
    """Run the trials that a store lacks, and write them down as they come, while the next ones run."""
    missing, done, total = _missing(jobs, store.finished())
    progress = progress or (lambda what, done, total: None)
    written: Future[int] | None = None
    with closing(_run(missing, workers, ray, trial_timeout)) as running, ThreadPoolExecutor(1) as writer:
        progress("starting", done, total)
        for trials in running:
            if written is not None:
                written.result()
            written = writer.submit(store.add, *trials)
            done += len(trials)
            last = trials[-1]
            progress(f"{last.label}, {last.scenario}, {last.num_robots} robots", done, total)
    if written is not None:
        written.result()
