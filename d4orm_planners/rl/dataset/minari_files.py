"""Files of a Minari dataset: shards that Minari writes, and a main file that links to them; and samples read from one.

Minari (https://minari.farama.org) keeps a dataset in one HDF5 file, with a group ``episode_i`` for each. Here this file
holds external links into shards, each of which is a whole Minari storage of its own. Minari's reader follows them.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec

from d4orm_env import navigation_v0
from d4orm_env.core.arrays import BoolArray, FloatArray
from d4orm_env.core.errors import first_line
from d4orm_env.core.files import ArrayArchive, replaced_when_done
from d4orm_env.core.lazy import LazyModule, load
from d4orm_env.core.team import Team
from d4orm_env.envs.features import Features
from d4orm_env.scenarios.problems import SCENARIOS, is_scenario_file
from d4orm_planners.rl.dataset.demonstrations import MAX_BYTES, UNREADABLE, RecordedEpisode

if TYPE_CHECKING:
    from minari import MinariDataset
    from minari.data_collector import EpisodeBuffer
    from minari.dataset.minari_storage import MinariStorage
    from pettingzoo import ParallelEnv

h5py: Any = LazyModule("h5py", "a dataset", "dataset")
minari: Any = LazyModule("minari", "a dataset", "dataset")
data_collector: Any = LazyModule("minari.data_collector", "a dataset", "dataset")
minari_storage: Any = LazyModule("minari.dataset.minari_storage", "a dataset", "dataset")

MAIN, METADATA = "main_data.hdf5", "metadata.json"


@dataclass(frozen=True)
class DatasetFiles:
    """The files of a dataset."""

    folder: Path  #: Folder that Minari opens, ``.../data``
    observation_space: gymnasium.Space[object]
    action_space: gymnasium.Space[object]
    env_spec: EnvSpec | None  #: From which Minari makes the environment again, if it can
    agents: str  #: Owner of an episode, ``"team"`` or ``"robot"``

    @property
    def shards(self) -> list[Path]:
        """Whole shards, in order."""
        return sorted(path for path in (self.folder / "shards").glob("*") if path.name.isdecimal())

    def seeds(self) -> set[int]:
        return {int(seed) for shard in self.shards for seed in _metadata(shard)["recorded_seeds"]}

    def add_shard(self, episodes: Sequence[RecordedEpisode]) -> None:
        """Write the next shard; it is whole or not there."""
        before = [_metadata(shard)["total_episodes"] for shard in self.shards]
        final = self.folder / "shards" / f"{len(before):06d}"
        partial = final.with_name(f".{final.name}.partial")
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
        storage = self._storage(partial)
        parts = [(episode, *part) for episode in episodes for part in _parts(episode, self.agents)]
        storage.update_episodes(_buffer(episode, steps, who) for episode, steps, who, _ in parts)
        storage.update_episode_metadata(
            {**episode.metadata, **extra, "id": sum(before) + index}
            for index, (episode, _, _, extra) in enumerate(parts)
        )
        storage.update_metadata({"recorded_seeds": [int(episode.metadata["seed"]) for episode in episodes]})
        partial.rename(final)

    def write_main(self, metadata: Mapping[str, object]) -> None:
        """Write the main file and the metadata anew, for the shards that are there."""
        partial = self.folder / ".main"
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
        storage = self._storage(partial)
        steps, count = 0, 0
        with h5py.File(partial / MAIN, "a", track_order=True) as main:
            for shard in self.shards:
                own = _metadata(shard)
                for index in range(own["total_episodes"]):
                    link = h5py.ExternalLink(f"shards/{shard.name}/{MAIN}", f"/episode_{index}")
                    main[f"episode_{count + index}"] = link
                steps, count = steps + own["total_steps"], count + own["total_episodes"]
        size = sum(path.stat().st_size for shard in self.shards for path in shard.iterdir()) / 1e6
        totals = {"total_steps": steps, "total_episodes": count, "dataset_size": round(size, 1)}
        storage.update_metadata({**metadata, **totals})
        # In this order: a main file with more episodes than the metadata counts is a dataset as well.
        for name in (MAIN, METADATA):
            (partial / name).replace(self.folder / name)
        partial.rmdir()

    def _storage(self, folder: Path) -> MinariStorage:
        return minari_storage.MinariStorage.new(
            folder, self.observation_space, self.action_space, self.env_spec, "hdf5"
        )


def _metadata(folder: Path) -> dict[str, Any]:
    """Return the metadata of a storage. Raises ValueError if it cannot be read."""
    path = folder / METADATA
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        counts, seeds = [content[name] for name in ("total_episodes", "total_steps")], content["recorded_seeds"]
        if not all(isinstance(number, int) and number >= 0 for number in (*counts, *seeds)):
            raise ValueError("its counts and seeds must be whole numbers")
        return dict(content)
    except KeyError as error:
        raise ValueError(f"{path} lacks {error}; remove {folder} to record its episodes anew") from None
    except (OSError, ValueError, TypeError, RecursionError) as error:
        raise ValueError(f"{path} cannot be read ({error}); remove {folder} to record its episodes anew") from None


def _parts(episode: RecordedEpisode, agents: str) -> Iterator[tuple[int, slice | int, Mapping[str, object]]]:
    """The episodes of a dataset that one makes, the team's or each robot's: steps, robots, and further metadata."""
    if agents == "team":
        yield len(episode.actions), slice(None), {}
        return
    for robot, steps in enumerate(episode.acting.sum(axis=0).tolist()):
        yield steps, robot, {"robot": robot}


def _buffer(episode: RecordedEpisode, steps: int, who: slice | int) -> EpisodeBuffer:
    """The first steps of an episode, of the team or of one robot, as Minari takes it."""
    names = ("arrived", "collided", "margin_violated", "distance_to_goal")
    infos = {name: getattr(episode, name)[: steps + 1, who] for name in names}
    ended: BoolArray = episode.terminations[:steps, who]
    rewards = episode.rewards[:steps, who]
    if isinstance(who, slice):
        at_reset = np.zeros_like(rewards[:1])
        infos |= {"robot_rewards": np.concatenate([at_reset, rewards]), "state": episode.state}
        ended, rewards = np.all(np.maximum.accumulate(ended), axis=1), rewards.mean(axis=1, dtype=np.float64)
    last = np.arange(steps) == steps - 1
    return data_collector.EpisodeBuffer(
        seed=int(episode.metadata["seed"]),
        observations=_flat(episode.observations[: steps + 1, who]),
        actions=_flat(episode.actions[:steps, who]),
        rewards=rewards.astype(np.float64),
        terminations=ended,
        truncations=last & ~ended,
        infos=infos,
    )


def _flat(values: np.ndarray) -> np.ndarray:
    """``(T, .)``."""
    return values.reshape(len(values), -1)


@dataclass(frozen=True, eq=False)
class Samples:
    """``N`` moments of robots to learn from."""

    observations: FloatArray  #: ``(N, D)`` float32 as the environment gave them
    controls: FloatArray  #: ``(N, m)`` float32 of the expert, in physical units
    limits: FloatArray  #: ``(N, m)`` float32 largest controls

    def __len__(self) -> int:
        return len(self.observations)

    @classmethod
    def joined(cls, parts: Sequence[Samples]) -> Self:
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in _ARRAYS))

    def learnable(self, features: Features) -> tuple[FloatArray, FloatArray]:
        """A network's inputs ``(N, F)`` and the actions ``(N, m)`` that it should answer with."""
        inputs, frames = features.encode(self.observations)
        return inputs, features.actions(self.controls, frames, self.limits).astype(np.float32)

    def save(self, path: Path) -> None:
        """Write them into an ``.npz`` file, which is whole or not there."""
        with replaced_when_done(path, (".npz",)) as temporary, temporary.open("wb") as stream:
            np.savez(stream, **vars(self))

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read what :meth:`save` has written. Raises ValueError if it is something else."""
        try:
            with path.open("rb") as stream, ArrayArchive(stream, _ARRAYS) as archive:
                return cls(*(archive.array(name, MAX_BYTES) for name in _ARRAYS))
        except UNREADABLE as error:
            raise ValueError(f"{path} holds no samples ({error}); remove it to record them anew") from None


_ARRAYS = tuple(field.name for field in fields(Samples))


def dataset_samples(path: str, model: str, size: int) -> list[Samples]:
    """The episodes of a Minari dataset of ``d4orm dataset``, of a team or of robots; ValueError if these are others."""
    dataset = _open_dataset(path)
    env, metadata = _environment(dataset, path)
    team = env.unwrapped.problem.team
    if set(team.models) != {model} or env.observation_space(env.possible_agents[0]).shape != (size,):
        raise ValueError(
            f"dataset {path!r} is of {', '.join(sorted(set(team.models)))} robots with observations of "
            f"{env.observation_space(env.possible_agents[0]).shape[0]} numbers, and {model} with {size} are to learn; "
            "record one for them with 'd4orm dataset --model'"
        )
    env.close()
    try:
        _check_arrays(Path(dataset.storage.data_path))
        return list(_episodes(dataset, team, size, metadata["agents"] == "team"))
    except Exception as error:  # HDF5, Minari and NumPy have a dozen kinds for a damaged file
        raise ValueError(
            f"dataset {path!r} is damaged ({first_line(error)}); record it anew with 'd4orm dataset'"
        ) from None


def _check_arrays(folder: Path) -> None:
    """Refuse a dataset that does not hold plain numbers of a size that makes sense, before any is read."""

    def look(name: str, thing: object) -> None:
        if isinstance(thing, h5py.Dataset) and (thing.dtype.kind not in "biuf" or thing.nbytes > MAX_BYTES):
            raise ValueError(
                f"{name} is {thing.nbytes} bytes of {thing.dtype}; numbers in at most {MAX_BYTES} bytes are read"
            )

    with h5py.File(folder / MAIN) as file:
        for number in file:
            file[number].visititems(look)


def _episodes(dataset: MinariDataset, team: Team, size: int, together: bool) -> Iterator[Samples]:
    for episode, own in zip(dataset, dataset.storage.get_episode_metadata(dataset.episode_indices), strict=True):
        limits = team.control_limits[:] if together else team.control_limits[[int(own["robot"])]]
        moments = (len(episode.actions), len(limits))
        # A team's robots that have arrived send zeros.
        acting = ~np.asarray(episode.infos["arrived"])[:-1].reshape(moments)
        seen = np.asarray(episode.observations[:-1], np.float32).reshape(*moments, size)
        controls = np.asarray(episode.actions, np.float32).reshape(*moments, limits.shape[1])
        yield Samples(seen[acting], controls[acting], np.broadcast_to(limits, controls.shape)[acting])


def _open_dataset(path: str) -> MinariDataset:
    load(minari)
    folders = [folder for folder in (Path(path), Path(path) / "data") if (folder / MAIN).is_file()]
    try:
        return minari.MinariDataset(folders[0]) if folders else minari.load_dataset(path)
    except Exception as error:  # a name that is none, a folder that is none, or files that Minari cannot read
        raise ValueError(
            f"dataset {path!r} cannot be read ({first_line(error)}); give the folder or the name of one of "
            "'d4orm dataset'"
        ) from None


def _environment(dataset: MinariDataset, path: str) -> tuple[ParallelEnv, Mapping[str, object]]:
    """An environment with the dataset's teams, and what it says about itself."""
    metadata = dataset.storage.metadata.get("demonstrations")
    try:
        arguments = {name: value for name, value in metadata["environment"].items() if name != "disturbances"}
        scenario = arguments.get("scenario", "circle")
        if not is_scenario_file(scenario):
            SCENARIOS.look_up(scenario)  # by name only: a dataset may be from anybody, and imports no code
        return navigation_v0.parallel_env(**arguments), metadata
    except (TypeError, KeyError, AttributeError, ValueError) as error:
        raise ValueError(
            f"dataset {path!r} does not say in a form that can be read of which team it is ({error}); record one with "
            "'d4orm dataset'"
        ) from None
