"""Imitation: what is learned from an expert, that it goes on where it stopped, and that PPO goes on from it."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

from d4orm_env import navigation_v0
from d4orm_env.core.observation_layout import ObservationLayout
from d4orm_env.envs.features import Features
from d4orm_env.scenarios import make_problem
from d4orm_planners import make_policy, run_episode
from d4orm_planners.cli import app as cli
from d4orm_planners.rl.dataset.minari_files import Samples, dataset_samples
from d4orm_planners.rl.imitation import OTHERS_DRIVE, ImitationSettings, imitate, record_samples
from d4orm_planners.rl.network import load_network
from d4orm_planners.rl.training import TrainingSettings, train

TINY = ImitationSettings(
    expert="go-to-goal", num_robots=2, episodes=20, rounds=3, epochs=40, validation_worlds=20, seed=3,
    scenario_settings={"size": 2.5},
)  # fmt: skip


@pytest.fixture(scope="module")
def imitated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("imitation")
    imitate(TINY, out, command="d4orm train imitation ...")
    return out


def curve(folder: Path) -> list[dict[str, str]]:
    with (folder / "curve.csv").open() as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize("model", ["holonomic2d", "velocity2d", "holonomic3d", "differential_drive"])
def test_actions_are_what_decode_makes_controls_of(model: str) -> None:
    env = navigation_v0.parallel_env(scenario="random", num_robots=6, model=model)
    observations, _ = env.reset(seed=2)
    seen = np.stack(list(observations.values()))
    limits = env.unwrapped.problem.team.control_limits
    features = Features.of(ObservationLayout.for_problem(env.unwrapped.problem), model)
    _, frames = features.encode(seen)
    controls = (np.random.default_rng(0).uniform(-0.5, 0.5, limits.shape) * limits).astype(np.float32)
    actions = features.actions(controls, frames, limits)
    assert np.abs(actions).max() <= 1
    np.testing.assert_allclose(features.decode(actions, frames, limits), controls, atol=1e-5)
    beyond = features.decode(features.actions(100 * controls, frames, limits), frames, limits)
    assert (np.abs(beyond) <= limits + 1e-5).all()


def test_imitation_learns_what_the_expert_does(imitated: Path, tmp_path: Path) -> None:
    rows = curve(imitated)
    assert [row["num_robots"] for row in rows] == ["2", "2", "2"]
    assert [int(row["steps"]) for row in rows] == sorted(int(row["steps"]) for row in rows)
    (untrained,) = imitate(replace(TINY, rounds=1, epochs=1, episodes=2), tmp_path).curve
    assert float(rows[-1]["imitation_error"]) < 0.5 * untrained.imitation_error
    assert float(rows[-1]["success_rate"]) > untrained.success_rate + 0.4


def test_the_policy_is_one_of_ppo(imitated: Path) -> None:
    path = imitated / "policy.safetensors"
    header = load_network(path).header
    assert header.algorithm == "ppo"
    assert header.training["expert"] == "go-to-goal"
    env = navigation_v0.parallel_env(scenario="random", num_robots=1, size=2.5)
    assert run_episode(env, make_policy("ppo", path=path), seed=1).metrics["arrived"] == 1


class Broken(Exception):
    """Stands for a kill."""


def test_an_imitation_that_was_broken_off_goes_on_to_the_same_end(tmp_path: Path) -> None:
    short, whole, broken = replace(TINY, episodes=6, epochs=3, validation_worlds=4), tmp_path / "a", tmp_path / "b"
    imitate(short, whole, command="d4orm train imitation ...")
    for share in (0.2, 0.5):

        def break_off(what: str, done: int, total: int, share: float = share) -> None:
            if done > total * share:
                raise Broken

        with pytest.raises(Broken):
            imitate(short, broken, progress=break_off, command="d4orm train imitation ...")
    kept = {path.name: path.stat().st_mtime_ns for path in (broken / "episodes").iterdir()}
    assert kept
    imitate(short, broken, command="d4orm train imitation ...")
    assert {name: (broken / "episodes" / name).stat().st_mtime_ns for name in kept} == kept
    one, two = (load_network(folder / "policy.safetensors") for folder in (whole, broken))
    for name, array in one.arrays.items():
        np.testing.assert_array_equal(array, two.arrays[name])


def test_dagger_asks_the_expert_where_the_learner_has_led(imitated: Path) -> None:
    env = navigation_v0.parallel_env(scenario="random", num_robots=2, size=2.5)
    learner = load_network(imitated / "policy.safetensors").controls
    own, led = (record_samples(env, make_policy("go-to-goal"), 7, driver) for driver in (None, learner))
    np.testing.assert_array_equal(own.observations[:2], led.observations[:2])
    np.testing.assert_array_equal(own.controls[:2], led.controls[:2])
    assert not np.array_equal(own.observations[2:4], led.observations[2:4])


@pytest.mark.parametrize("agents", ["team", "robot"])
def test_it_begins_with_a_dataset(agents: str, tmp_path: Path) -> None:
    pytest.importorskip("minari")
    from d4orm_planners.rl.dataset import Demonstrations, write_dataset

    environment: dict[str, Any] = {"scenario": "random", "num_robots": 2, "size": 2.5}
    demonstrations = Demonstrations(policy="go-to-goal", environment=environment, seeds=range(6), agents=agents)
    write_dataset(demonstrations, tmp_path / "data set", workers=1)
    settings = replace(TINY, dataset=tmp_path / "data set", rounds=2, episodes=4, epochs=2, validation_worlds=2)
    result = imitate(settings, tmp_path / "out")
    env = navigation_v0.parallel_env(**environment)
    counts = [len(record_samples(env, make_policy("go-to-goal"), seed)) for seed in range(6)]
    if agents == "team":
        assert result.curve[0].steps == sum(counts[1:])
    assert not list((tmp_path / "out" / "episodes").glob("000-*"))
    assert len(list((tmp_path / "out" / "episodes").glob("001-*"))) == 4
    with pytest.raises(ValueError, match=r"holonomic2d robots .* differential_drive .* 'd4orm dataset --model'"):
        imitate(replace(settings, model="differential_drive"), tmp_path / "other")
    assert not (tmp_path / "other").exists()


def test_a_dataset_of_others_imports_no_code(tmp_path: Path) -> None:
    pytest.importorskip("minari")
    from d4orm_planners.rl.dataset import Demonstrations, write_dataset

    code, marker = tmp_path / "theirs.py", tmp_path / "was here"
    code.write_text(f"open({str(marker)!r}, 'w').close()\n"
                    "from d4orm_env.scenarios.generators import circle as scene\n")  # fmt: skip
    environment = {"scenario": "circle", "num_robots": 2}
    write_dataset(Demonstrations(policy="go-to-goal", environment=environment, seeds=[0]), tmp_path / "data", workers=1)
    metadata = tmp_path / "data" / "data" / "metadata.json"
    content = json.loads(metadata.read_text())
    content["demonstrations"]["environment"]["scenario"] = f"{code}:scene"
    metadata.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=r"dataset .* \(scenario .* is unknown"):
        dataset_samples(str(tmp_path / "data"), "holonomic2d", 30)
    assert not marker.exists()


def test_a_dataset_that_is_none_is_one_clear_error(tmp_path: Path) -> None:
    pytest.importorskip("minari")
    with pytest.raises(ValueError, match=r"dataset 'd4orm/none-v0' cannot be read .* 'd4orm dataset'") as error:
        imitate(replace(TINY, dataset="d4orm/none-v0"), tmp_path)
    assert "\n" not in str(error.value)


def test_a_damaged_episode_is_one_clear_error(tmp_path: Path) -> None:
    (tmp_path / "episodes").mkdir()
    (tmp_path / "episodes" / "000-000003.npz").write_bytes(b"no zip")
    with pytest.raises(ValueError, match=r"000-000003.npz holds no samples .*; remove it"):
        imitate(TINY, tmp_path)


def test_samples_come_back_from_their_file(tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    samples = Samples(*(random.normal(size=(5, size)).astype(np.float32) for size in (7, 2, 2)))
    samples.save(tmp_path / "samples.npz")
    again = Samples.load(tmp_path / "samples.npz")
    for name, array in vars(samples).items():
        np.testing.assert_array_equal(getattr(again, name), array)


def test_ppo_goes_on_from_what_was_imitated(imitated: Path, tmp_path: Path) -> None:
    path = imitated / "policy.safetensors"
    settings = TrainingSettings(
        num_robots=2, steps=1, num_envs=16, stages=1, validation_worlds=2, seed=5,
        scenario_settings={"size": 2.5}, start_from=path,
    )  # fmt: skip
    learned = train(settings, tmp_path / "on").network
    nothing = train(replace(settings, start_from=None), tmp_path / "nothing").network
    start = load_network(path)

    def distance(network: Any) -> float:
        return float(np.abs(network.arrays["weight_0"] - start.arrays["weight_0"]).max())

    assert 0 < distance(learned) < 0.1 * distance(nothing)
    np.testing.assert_allclose(learned.arrays["observation_mean"], start.arrays["observation_mean"], atol=1e-2)
    with pytest.raises(ValueError, match=r"layers .* are wanted; give one that was trained with the same settings: it"):
        train(replace(settings, model="holonomic3d", scenario_settings={}), tmp_path / "space")
    with pytest.raises(ValueError, match="was trained by ppo, whose networks differ; give one that was trained by the"):
        train(replace(settings, algorithm="sac"), tmp_path / "sac")
    with pytest.raises(ValueError, match="give network='flat'"):
        train(replace(settings, network="sets"), tmp_path / "sets")
    assert not {"space", "sac", "sets"} & {folder.name for folder in tmp_path.iterdir()}
    with pytest.raises(FileNotFoundError, match="does not exist"):
        train(replace(settings, start_from=tmp_path / "none.safetensors"), tmp_path / "none")


def test_an_expert_is_told_that_another_drives() -> None:
    assert ImitationSettings(expert="go-to-goal").all_expert_settings == {}
    own = ImitationSettings(expert_settings={"delay": 2, "num_samples": 64}).all_expert_settings
    assert own == {**OTHERS_DRIVE, "delay": 2, "num_samples": 64}
    make_policy("d4orm-c2f", **own)


def test_what_is_trained_on_along_with_a_scenario_has_robots_like_its_own(tmp_path: Path) -> None:
    spatial = replace(
        TINY, scenario="sphere", scenario_settings={}, episodes=2, rounds=1, epochs=1, validation_worlds=2
    )
    assert imitate(spatial, tmp_path / "imitation").network.header.model == "holonomic3d"
    settings = TrainingSettings(scenario="sphere", num_robots=2, steps=1, num_envs=16, stages=1, validation_worlds=2)
    assert train(settings, tmp_path / "ppo").network.header.model == "holonomic3d"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"expert": "nobody"}, "policy 'nobody' is unknown"),
        ({"expert_settings": {"num_samples": 64}}, "takes no settings"),
        ({"episodes": 1}, "episodes is 1; it must be at least 2"),
        ({"rounds": 0}, "rounds is 0"),
        ({"epochs": "many"}, "epochs must be a whole number"),
        ({"scenario": "labyrinth"}, "labyrinth"),
        ({"scenario_settings": {"seed": 3}}, "give it itself, --seed"),
    ],
)
def test_bad_settings_are_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises((ValueError, TypeError), match=message):
        replace(TINY, **change)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("imitation", "--steps", "100"), "--steps is for ppo and sac; leave it out"),
        (("imitation", "--start-from", "x.safetensors"), "--start-from is for ppo and sac"),
        (("ppo", "--expert", "go-to-goal"), "--expert is for imitation; use it with 'd4orm train imitation'"),
        (("imitation", "--expert-set", "x=1", "--expert", "go-to-goal"), "takes no"),
        (("imitate",), "algorithm 'imitate' is unknown; choose one of ppo, sac, imitation"),
        (("ppo", "--start-from", "none.safetensors"), "none.safetensors does not exist"),
    ],
)
def test_bad_options_are_one_line_and_status_two(
    arguments: tuple[str, ...], message: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    with pytest.raises(SystemExit) as exit_:
        cli.main(["train", *arguments, "--out", str(tmp_path / "out")])
    assert exit_.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line


def test_the_command_imitates(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    problem = make_problem("random", num_robots=2)
    arguments = ["--num-robots", "2", "--episodes", "2", "--rounds", "2", "--epochs", "1", "--scenario", "circle"]
    with pytest.raises(SystemExit) as exit_:
        cli.main(["train", "imitation", *arguments, "--expert", "go-to-goal", "--out", str(tmp_path)])
    assert exit_.value.code == 0
    told = capsys.readouterr().out
    assert f"use it: make_policy('ppo', path='{tmp_path / 'policy.safetensors'}')" in told
    policy = make_policy("ppo", path=tmp_path / "policy.safetensors")
    assert np.isfinite(run_episode(navigation_v0.parallel_env(problem=problem), policy).trajectory.controls).all()
