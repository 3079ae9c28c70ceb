"""Samples of robots' observations and an expert's actions: recorded, kept in files, and read from a Minari dataset."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from d4orm_env import navigation_v0
from d4orm_env.core.arrays import FloatArray, as_float32
from d4orm_env.core.errors import first_line
from d4orm_env.core.files import ArrayArchive, replaced_when_done
from d4orm_env.core.lazy import LazyModule, load
from d4orm_env.core.team import Team
from d4orm_env.envs.features import Features
from d4orm_env.scenarios.problems import SCENARIOS, is_scenario_file
from d4orm_planners.base.policy import Policy, robot_indices

if TYPE_CHECKING:
    from minari import MinariDataset
    from pettingzoo import ParallelEnv

h5py: Any = LazyModule("h5py", "a dataset", "dataset")
minari: Any = LazyModule("minari", "a dataset", "dataset")

Driver = Callable[[FloatArray, FloatArray], FloatArray]

MAX_BYTES = 2**31
"""Largest array of a file that is read."""


@dataclass(frozen=True, eq=False)
class Samples:
    """``N`` moments of robots.

    Attributes:
        observations: ``(N, D)`` float32 as the environment gave them.
        controls: ``(N, m)`` float32 of the expert, in physical units.
        limits: ``(N, m)`` float32 largest controls.
    """

    observations: FloatArray
    controls: FloatArray
    limits: FloatArray

    def __len__(self) -> int:
        return len(self.observations)

    @classmethod
    def joined(cls, parts: Sequence[Samples]) -> Self:
        """All of them, in order."""
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
        """Read what :meth:`save` has written.

        Raises:
            ValueError: If it is something else.
        """
        try:
            with path.open("rb") as stream, ArrayArchive(stream, _ARRAYS) as archive:
                return cls(*(archive.array(name, MAX_BYTES) for name in _ARRAYS))
        except (ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as error:
            raise ValueError(f"{path} holds no samples ({error}); remove it to record them anew") from None


_ARRAYS = tuple(field.name for field in fields(Samples))


def record_samples(env: ParallelEnv, expert: Policy, seed: int, learner: Driver | None = None) -> Samples:
    """Run an episode and ask the expert at every step what to do.

    Args:
        env: A :mod:`d4orm_env.navigation_v0` parallel environment of a team of one model.
        expert: Policy that is asked.
        seed: Seeds both.
        learner: Policy that drives, as ``(observations (N, D), limits (N, m)) -> controls (N, m)``; by default the
            expert. With a learner the expert is asked where that has led the team.

    Returns:
        What the robots saw until they arrived, and what the expert said.
    """
    observations, _ = env.reset(seed=seed)
    expert.reset(env, seed=seed)
    limits, parts = env.unwrapped.problem.team.control_limits, []
    while env.agents:
        acting = {agent: observations[agent] for agent in env.agents}
        asked = expert.act(acting, env.state())
        seen, own = np.stack(list(acting.values())), limits[robot_indices(acting)]
        controls = as_float32([asked[agent] for agent in acting])
        parts.append(Samples(seen, controls, own))
        driven = controls if learner is None else learner(seen, own)
        observations, *_ = env.step(dict(zip(acting, driven, strict=True)))
    return Samples.joined(parts)


def dataset_samples(path: str, model: str, size: int) -> list[Samples]:
    """The episodes of a Minari dataset of ``d4orm dataset``, of a team or of robots.

    Raises:
        ValueError: If there is no such dataset, or its robots or observations are others.
        ImportError: If Minari is not installed.
    """
    dataset = _dataset(path)
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

    with h5py.File(folder / "main_data.hdf5") as file:
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


def _dataset(path: str) -> MinariDataset:
    load(minari)
    folders = [folder for folder in (Path(path), Path(path) / "data") if (folder / "main_data.hdf5").is_file()]
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
