"""Samples of an expert from a Minari dataset."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from d4orm_env import navigation_v0
from d4orm_env.core.errors import first_line
from d4orm_env.core.lazy import LazyModule, load
from d4orm_env.core.team import Team
from d4orm_env.scenarios.problems import SCENARIOS, is_scenario_file
from d4orm_planners.rl.samples import MAX_BYTES, Samples

if TYPE_CHECKING:
    from minari import MinariDataset
    from pettingzoo import ParallelEnv

h5py: Any = LazyModule("h5py", "a dataset", "dataset")
minari: Any = LazyModule("minari", "a dataset", "dataset")


def dataset_samples(path: str, model: str, size: int) -> list[Samples]:
    """The episodes of a Minari dataset of ``d4orm dataset``, of a team or of robots.

    Args:
        path: Its folder, or its name where Minari finds it.
        model: Robot model that is to learn.
        size: Numbers in an observation of one robot.

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
