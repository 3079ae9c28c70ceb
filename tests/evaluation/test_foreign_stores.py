"""Stores that others have written: what is damaged, huge, of other types or meant to harm is one line that names it."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from trial_support import trial

from d4orm_planners.evaluation import tables as report
from d4orm_planners.evaluation.store import checked_trial
from d4orm_planners.evaluation.tables import read_parquet, write_parquet

NESTED = "[" * 100_000
TRIAL = trial()


def one_line(error: BaseException) -> str:
    assert "\n" not in str(error)
    return str(error)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("seed", "1"), ("success", "yes"), ("config", "{"), ("config", "[]"), ("config", NESTED), ("history", NESTED),
        ("history", "[[1, 2]]"), ("disturbances", "{}"), ("wall_time", b"1"), ("label", None),
    ],
)  # fmt: skip
def test_a_trial_of_other_types_is_refused(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"as {name}$") as error:
        checked_trial({**vars(TRIAL), name: value})
    assert len(one_line(error.value)) < 120


def table(path: Path, **columns: Any) -> None:
    import pyarrow
    from pyarrow import parquet

    content = {name: [value] for name, value in vars(TRIAL).items()} | columns
    parquet.write_table(pyarrow.table({name: values for name, values in content.items() if values is not None}), path)


def halved(path: Path) -> None:
    write_parquet(path, [TRIAL] * 50)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def garbled(path: Path) -> None:
    write_parquet(path, [TRIAL] * 50)
    content = bytearray(path.read_bytes())
    content[-200:-60] = bytes(140)
    path.write_bytes(content)


FILES: dict[str, Callable[[Path], None]] = {
    "empty": lambda path: path.write_bytes(b"") and None,
    "text": lambda path: path.write_text("policy,config\n") and None,
    "halved": halved,
    "garbled": garbled,
    "other columns": lambda path: table(path, surprise=[1]),
    "missing columns": lambda path: table(path, config=None),
    "no verdicts": lambda path: table(path, success=None),
    "text for truth": lambda path: table(path, success=["yes"]),
    "lists for text": lambda path: table(path, label=[["a"]]),
    "no JSON": lambda path: table(path, config=["{"]),
    "nested JSON": lambda path: table(path, config=[NESTED]),
    "bytes for text": lambda path: table(path, label=[b"\x80\x04\x95"]),
}


@pytest.mark.parametrize("name", FILES)
def test_parquet_that_holds_no_trials_is_refused(name: str, tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    FILES[name](path := tmp_path / "trials.parquet")
    with pytest.raises(
        ValueError, match=r"trials\.parquet is no Parquet file of trials \(.*\); give one that d4orm eval"
    ) as error:
        read_parquet(path)
    assert len(one_line(error.value)) < 500


def test_parquet_says_how_much_it_holds_before_it_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pyarrow")
    write_parquet(path := tmp_path / "trials.parquet", [TRIAL] * 3)
    assert read_parquet(path) == [TRIAL] * 3
    monkeypatch.setattr(report, "MAX_TRIALS", 2)
    with pytest.raises(ValueError, match=r"it has 3 rows of \d+ bytes; at most 2 of"):
        read_parquet(path)
    with pytest.raises(FileNotFoundError):
        read_parquet(tmp_path / "none.parquet")


@pytest.mark.parametrize(
    "content",
    ["[]", "[1]", "{}", NESTED, "null", '{"total_episodes": 1, "total_steps": 1, "recorded_seeds": 3}', b"\xff",
     '{"total_episodes": "1", "total_steps": 1, "recorded_seeds": []}',
     '{"total_episodes": -1, "total_steps": 1, "recorded_seeds": []}'],
    ids=lambda content: str(content[:40]),
)  # fmt: skip
def test_metadata_of_a_shard_is_refused(content: Any, tmp_path: Path) -> None:
    from d4orm_planners.rl.dataset.minari_files import METADATA, _metadata

    (tmp_path / METADATA).write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(ValueError, match=r"metadata\.json .*; remove .* to record its episodes anew") as error:
        _metadata(tmp_path)
    one_line(error.value)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("minari")
    from d4orm_planners.rl.dataset import Demonstrations, write_dataset

    folder = tmp_path_factory.mktemp("dataset")
    environment = {"scenario": "circle", "num_robots": 2, "max_cycles": 5}
    write_dataset(Demonstrations(policy="go-to-goal", environment=environment, seeds=[0]), folder, workers=1)
    return folder


def shard(folder: Path) -> Path:
    return folder / "data" / "shards" / "000000" / "main_data.hdf5"


def replaced(folder: Path, name: str, **how: Any) -> None:
    import h5py

    with h5py.File(shard(folder), "a") as file:
        del file["episode_0"][name]
        if how:
            file["episode_0"].create_dataset(name, **how)


def truncated(folder: Path) -> None:
    path = shard(folder)
    path.write_bytes(path.read_bytes()[:1000])


def pickled(folder: Path) -> None:
    import h5py

    replaced(folder, "actions", data=np.array([b"\x80\x04\x95"] * 5, object), dtype=h5py.special_dtype(vlen=bytes))


DAMAGES: dict[str, Callable[[Path], None]] = {
    "truncated": truncated,
    "no shard": lambda folder: shard(folder).unlink(),
    "pickled": pickled,
    "text": lambda folder: replaced(folder, "actions", data=np.array([b"a"] * 5)),
    "huge": lambda folder: replaced(folder, "actions", shape=(10**12, 4), dtype="f4", chunks=(1024, 4)),
    "other shape": lambda folder: replaced(folder, "observations", data=np.zeros((6, 3), np.float32)),
    "missing": lambda folder: replaced(folder, "actions"),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_a_damaged_dataset_is_refused(name: str, recorded: Path, tmp_path: Path) -> None:
    from d4orm_planners.rl.dataset.minari_files import dataset_samples

    shutil.copytree(recorded, tmp_path / "copy")
    size = observation_size()
    assert dataset_samples(str(tmp_path / "copy"), "holonomic2d", size)
    DAMAGES[name](tmp_path / "copy")
    with pytest.raises(ValueError, match=r"dataset .* is damaged .*; record it anew with 'd4orm dataset'") as error:
        dataset_samples(str(tmp_path / "copy"), "holonomic2d", size)
    one_line(error.value)


def observation_size() -> int:
    from d4orm_env import navigation_v0

    env = navigation_v0.parallel_env("circle", num_robots=2)
    return int(env.observation_space("robot_0").shape[0])


def test_no_code_that_a_dataset_names_is_run(recorded: Path, tmp_path: Path) -> None:
    from d4orm_planners.rl.dataset.minari_files import dataset_samples

    shutil.copytree(recorded, tmp_path / "copy")
    (tmp_path / "harm.py").write_text(f"open({str(tmp_path / 'harmed')!r}, 'w')\ndef scene(): pass\n")
    path = tmp_path / "copy" / "data" / "metadata.json"
    metadata = json.loads(path.read_text())
    metadata["demonstrations"]["environment"]["scenario"] = f"{tmp_path / 'harm.py'}:scene"
    path.write_text(json.dumps(metadata))
    with pytest.raises(ValueError, match=r"does not say in a form that can be read of which team it is .*is unknown"):
        dataset_samples(str(tmp_path / "copy"), "holonomic2d", observation_size())
    assert not (tmp_path / "harmed").exists()
