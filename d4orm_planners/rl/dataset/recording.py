"""Episodes recorded one by one into a folder, by several processes; what is there already is not recorded again."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Generator, Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from d4orm_env.core.errors import describe
from d4orm_env.core.files import replaced_when_done
from d4orm_env.core.registry import check_sendable
from d4orm_env.engine.threads import available_cores
from d4orm_planners.evaluation.pool import JobEvent, WorkerLost
from d4orm_planners.evaluation.process_pool import ProcessPool
from d4orm_planners.rl.dataset.demonstrations import Demonstrations
from d4orm_planners.rl.dataset.recorded_episode import RecordedEpisode

IDENTITY = "demonstrations.json"


@dataclass(frozen=True)
class Recording:
    """Episodes in a folder, a file each, from when they end until they are in a dataset.

    Attributes:
        folder: Their folder.
    """

    folder: Path

    def claim(self, demonstrations: Demonstrations) -> None:
        """Make the folder, or find out whether it is one for the same demonstrations.

        Raises:
            ValueError: If it is not.
            OSError: If it cannot be made.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        path, identity = self.folder / IDENTITY, demonstrations.identity
        if not path.exists():
            with replaced_when_done(path) as temporary:
                temporary.write_text(json.dumps(identity, indent=1) + "\n", encoding="utf-8")
            return
        try:
            before = dict(json.loads(path.read_text(encoding="utf-8")))
        except (ValueError, TypeError, RecursionError):
            raise ValueError(f"{path} cannot be read; remove the folder, or choose another") from None
        for name, value in identity.items():
            if before.get(name) != value:
                raise ValueError(
                    f"folder {self.folder.parent} holds a dataset with {name} {before.get(name)!r}, not {value!r}; go "
                    "on with the same, or choose another folder"
                )

    def seeds(self) -> set[int]:
        """Seeds of the episodes that are there."""
        return self._numbers("npz")

    def dropped(self) -> set[int]:
        """Seeds of the episodes that have been left out."""
        return self._numbers("dropped")

    def load(self, seed: int) -> RecordedEpisode:
        """The episode of a seed.

        Raises:
            ValueError: If the file is damaged.
        """
        return RecordedEpisode.load(self._path(seed, "npz"))

    def forget(self, seed: int) -> None:
        """Remove the episode of a seed."""
        self._path(seed, "npz").unlink(missing_ok=True)

    def keep(self, seed: int, episode: RecordedEpisode | None) -> None:
        """Write down an episode, or that it is left out."""
        if episode is None:
            self._path(seed, "dropped").touch()
        else:
            episode.save(self._path(seed, "npz"))

    def _path(self, seed: int, kind: str) -> Path:
        return self.folder / f"{seed}.{kind}"

    def _numbers(self, kind: str) -> set[int]:
        return {int(path.stem) for path in self.folder.glob(f"*.{kind}") if path.stem.isdecimal()}


@dataclass(frozen=True)
class _Task:
    """An episode to be recorded."""

    demonstrations: Demonstrations
    recording: Recording
    seed: int


def record_all(
    demonstrations: Demonstrations, recording: Recording, seeds: list[int], workers: int | None
) -> Generator[int]:
    """Record episodes of these seeds, and yield each seed when its episode is on disk.

    Args:
        demonstrations: Demonstrations to record.
        recording: Folder of the recording.
        seeds: Seeds of the episodes.
        workers: Processes of one thread each; by default as many as there are cores; with 1 this process on all cores.

    Raises:
        ValueError: At the end if episodes have failed, or if the policy cannot be handed to worker processes.
        ChildProcessError: If processes do not start.
    """
    tasks = [_Task(demonstrations, recording, seed) for seed in seeds]
    size = min(workers or available_cores(), len(tasks))
    if size > 1:
        check_sendable(demonstrations, f"policy {demonstrations.policy_name!r}")
    failures: dict[int, str] = {}
    with closing(_in_processes(tasks, size) if size > 1 else _here(tasks)) as outcomes:
        for seed, failure in outcomes:
            if failure:
                failures[seed] = failure
            else:
                yield seed
    if failures:
        seed, failure = min(failures.items())
        raise ValueError(
            f"the episode of seed {seed} failed ({failure}), {len(failures)} of {len(tasks)} in all; leave such seeds "
            "out, or change the policy; the others are kept"
        )


def _here(tasks: Iterable[_Task]) -> Generator[tuple[int, str]]:
    """Each seed when it is done, and what went wrong, if anything did."""
    for task in tasks:
        yield task.seed, next(_record(task))


def _in_processes(tasks: Iterable[_Task], size: int) -> Generator[tuple[int, str]]:
    """The same, in so many processes."""
    waiting, running = deque(tasks), dict[int, _Task]()
    with closing(ProcessPool(size, run=_record)) as pool:
        while waiting or running:
            while waiting and pool.free():
                task = waiting.popleft()
                running[pool.start(task)] = task
            for ticket, content in pool.wait(None):
                if isinstance(content, WorkerLost):
                    yield running.pop(ticket).seed, content.reason
                elif isinstance(content, str):
                    yield running[ticket].seed, content
                elif content is JobEvent.ENDED:
                    del running[ticket]


def _record(task: _Task) -> Iterator[str]:
    """Record an episode; yields what went wrong, or an empty text."""
    try:
        episode = task.demonstrations.record(task.seed)
    except Exception as error:  # whatever a policy raises
        yield describe(error)
        return
    dropped = task.demonstrations.only_success and not episode.success
    task.recording.keep(task.seed, None if dropped else episode)
    yield ""
