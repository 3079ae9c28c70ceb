"""Recorded episodes as the files of a Minari dataset: shards that Minari writes, and a main file that links to them.

Minari (https://minari.farama.org) keeps a dataset in one HDF5 file, with a group ``episode_i`` for each. Here this file
holds external links into shards, each of which is a whole Minari storage of its own. Minari's reader follows them.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec

from d4orm_env.core.arrays import BoolArray
from d4orm_env.core.lazy import LazyModule
from d4orm_planners.rl.dataset.demonstrations import RecordedEpisode

if TYPE_CHECKING:
    from minari.data_collector import EpisodeBuffer
    from minari.dataset.minari_storage import MinariStorage

h5py: Any = LazyModule("h5py", "a dataset", "dataset")
data_collector: Any = LazyModule("minari.data_collector", "a dataset", "dataset")
minari_storage: Any = LazyModule("minari.dataset.minari_storage", "a dataset", "dataset")

MAIN, METADATA = "main_data.hdf5", "metadata.json"


@dataclass(frozen=True)
class DatasetFiles:
    """The files of a dataset.

    Attributes:
        folder: Folder that Minari opens, ``.../data``.
        observation_space: Of the dataset.
        action_space: Likewise.
        env_spec: From which Minari makes the environment again, if it can.
        agents: Owner of an episode, ``"team"`` or ``"robot"``.
    """

    folder: Path
    observation_space: gymnasium.Space[object]
    action_space: gymnasium.Space[object]
    env_spec: EnvSpec | None
    agents: str

    @property
    def shards(self) -> list[Path]:
        """Whole shards, in order."""
        return sorted(path for path in (self.folder / "shards").glob("*") if path.name.isdecimal())

    def seeds(self) -> set[int]:
        """Return the seeds of the episodes that are in shards."""
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
    """Return the metadata of a storage.

    Raises:
        ValueError: If it cannot be read.
    """
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
        ended, rewards = np.all(np.maximum.accumulate(ended), axis=1), rewards.mean(axis=1)
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
