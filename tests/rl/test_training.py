"""Training: stages, checkpoints that survive a kill, policy files, and the policies that act by them."""

from __future__ import annotations

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from d4orm_env import make_problem, navigation_v0
from d4orm_env.envs.joint_state import split_state
from d4orm_planners import make_policy, run_episode
from d4orm_planners.base.adapters import from_sb3
from d4orm_planners.cli import app as cli
from d4orm_planners.rl.network import MAX_BYTES, load_network
from d4orm_planners.rl.train_config import Stage, common_batch, make_stages, team_sizes


def test_team_sizes_double_up_to_the_full_team() -> None:
    assert [team_sizes(robots) for robots in (1, 2, 4, 6, 8)] == [
        (1,), (1, 2), (1, 2, 4), (1, 2, 4, 6), (1, 2, 4, 8)
    ]  # fmt: skip


def test_a_batch_makes_whole_worlds_of_every_size() -> None:
    assert common_batch((1, 2, 4, 8), 1024) == 1024
    assert common_batch((1, 2, 4, 6), 1024) == 1020
    assert common_batch((1, 2, 4, 8), 3) == 8


def test_stages_grow_and_mix_scenarios() -> None:
    stages = make_stages(4, "circle", steps=800, unit=100, count=8, gradual=True)
    assert stages == tuple(
        Stage(robots, scenario, 100)
        for robots, scenario in [
            (1, "random"), (2, "random"), (2, "random"), (4, "random"),
            (4, "circle"), (4, "random"), (4, "circle"), (4, "random"),
        ]
    )  # fmt: skip


def test_stages_take_whole_updates_and_all_of_them() -> None:
    stages = make_stages(2, "random", steps=1001, unit=100, count=4, gradual=False)
    assert [stage.steps for stage in stages] == [200, 300, 300, 300]
    assert {stage.num_robots for stage in stages} == {2}
    assert len(make_stages(2, "random", steps=1, unit=100, count=4, gradual=True)) == 1


pytest.importorskip("stable_baselines3")
from d4orm_planners.evaluation.pool import only_writer  # noqa: E402
from d4orm_planners.rl.training import TrainingSettings, train  # noqa: E402

TINY = TrainingSettings(
    num_robots=2, steps=4 * 16 * 32, num_envs=16, stages=4, validation_worlds=3, seed=5, curriculum=True
)
TINY_SAC = replace(TINY, algorithm="sac", steps=4 * 256)


@pytest.fixture(scope="module", params=["ppo", "sac"])
def trained(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[TrainingSettings, Path]:
    settings = TINY if request.param == "ppo" else TINY_SAC
    out = tmp_path_factory.mktemp(request.param)
    train(settings, out, command="d4orm train ...")
    return settings, out


def curve(folder: Path) -> list[dict[str, str]]:
    with (folder / "curve.csv").open() as file:
        return list(csv.DictReader(file))


class Broken(Exception):
    """Stands for a kill."""


@pytest.mark.slow
def test_a_training_that_was_broken_off_goes_on_to_the_same_end(
    trained: tuple[TrainingSettings, Path], tmp_path: Path
) -> None:
    settings, straight = trained
    calls = 0

    def break_off(what: str, done: int, total: int) -> None:
        nonlocal calls
        calls += 1
        if done > total * 0.6:
            raise Broken

    with pytest.raises(Broken):
        train(settings, tmp_path, progress=break_off, command="d4orm train ...")
    assert sorted(path.name for path in (tmp_path / "checkpoints").iterdir()) == ["000001", "000002"]
    result = train(settings, tmp_path, command="d4orm train ...")
    assert [evaluation.steps for evaluation in result.curve] == [settings.steps * i // 4 for i in (1, 2, 3, 4)]
    one, two = load_network(straight / "policy.safetensors"), result.network
    headers = [network.header.model_dump() for network in (one, two)]
    assert all(header["training"].pop("training_time") > 0 for header in headers)
    assert headers[0] == headers[1]
    for name, array in one.arrays.items():
        np.testing.assert_array_equal(array, two.arrays[name])
    rows = [curve(folder) for folder in (straight, tmp_path)]
    for row in (*rows[0], *rows[1]):
        assert 0 < float(row.pop("env_share")) < 1
        del row["seconds"]
    assert rows[0] == rows[1]


@pytest.mark.slow
def test_a_training_that_is_killed_goes_on(tmp_path: Path) -> None:
    arguments = ["train", "ppo", "--num-robots", "2", "--steps", "2560", "--num-envs", "16", "--stages", "5"]
    command = [sys.executable, "-m", "d4orm_planners.cli.app", *arguments, "--out", str(tmp_path)]
    process = subprocess.Popen(command, env={**os.environ, "OMP_NUM_THREADS": "1"})
    deadline = time.monotonic() + 120
    while not (tmp_path / "checkpoints" / "000002").exists() and time.monotonic() < deadline:
        assert process.poll() is None
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    before = sorted(path.name for path in (tmp_path / "checkpoints").iterdir() if path.name.isdigit())
    assert before
    subprocess.run(command, check=True, capture_output=True)
    assert [int(row["steps"]) for row in curve(tmp_path)] == [512 * (i + 1) for i in range(5)]
    assert (tmp_path / "curve.png").stat().st_size > 0
    assert list((tmp_path / "tensorboard").glob("events*"))


@pytest.mark.parametrize("damage", ["extra", "large", "cut", "state", "none", "null"])
def test_a_damaged_checkpoint_is_one_clear_error(
    trained: tuple[TrainingSettings, Path], tmp_path: Path, damage: str
) -> None:
    settings, straight = trained
    shutil.copytree(straight, tmp_path / "out")
    first, last = sorted((tmp_path / "out" / "checkpoints").iterdir())
    shutil.rmtree(last)
    with np.load(first / "state.npz", allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    if damage in ("extra", "large"):
        name = "extra" if damage == "extra" else "observation_mean"
        np.savez(first / "state.npz", **(arrays | {name: np.zeros(10**5)}))
    elif damage == "cut":
        (first / "state.npz").write_bytes((first / "state.npz").read_bytes()[:200])
    else:
        state = json.loads((first / "state.json").read_text())
        state["evaluations"][0]["success_rate"] = None
        told = {"state": {}, "none": {"evaluations": []}, "null": state}[damage]
        (first / "state.json").write_text(json.dumps(told))
    text = {"extra": "it holds", "large": "observation_mean does not fit", "cut": "zip file", "state": "evaluations",
            "none": "it has 0 evaluations", "null": "1 validation error"}  # fmt: skip
    with pytest.raises(ValueError, match=rf"checkpoint .*{first.name} cannot be read \(.*{text[damage]}.*; remove it"):
        train(settings, tmp_path / "out", command="d4orm train ...")


def test_a_trained_policy_acts_as_its_model_does(trained: tuple[TrainingSettings, Path]) -> None:
    import stable_baselines3

    settings, out = trained
    network = load_network(out / "policy.safetensors")
    assert network.header.training["seed"] == 5
    last = sorted((out / "checkpoints").iterdir())[-1]
    model = getattr(stable_baselines3, settings.algorithm.upper()).load(last / "model.zip", device="cpu")
    from d4orm_planners.rl.algorithms import network_of

    class Same:
        mean = network.arrays["observation_mean"]
        var = network.arrays["observation_variance"]

    class Normalization:
        obs_rms = ret_rms = Same

    header = network.header.model_dump(
        include={"algorithm", "model", "dimension", "num_neighbors", "num_obstacles", "training"}
    )
    mine = network_of(header, model, Normalization)
    features = np.random.default_rng(0).normal(size=(7, network.features.size)).astype(np.float32)
    normalized = np.clip((features - Same.mean) / np.sqrt(Same.var + 0.1), -10, 10)
    np.testing.assert_allclose(mine(features), model.predict(normalized, deterministic=True)[0], atol=1e-5)


def test_the_last_two_checkpoints_are_kept(trained: tuple[TrainingSettings, Path]) -> None:
    _, out = trained
    assert sorted(path.name for path in (out / "checkpoints").iterdir()) == ["000003", "000004"]


def test_a_trained_policy_runs_in_the_environment(trained: tuple[TrainingSettings, Path]) -> None:
    settings, out = trained
    policy = make_policy(settings.algorithm, path=str(out / "policy.safetensors"))
    env = navigation_v0.parallel_env(scenario="random", num_robots=3)
    episode = run_episode(env, policy, seed=1)
    assert np.abs(episode.trajectory.controls).max() > 0
    again = run_episode(env, policy, seed=1)
    np.testing.assert_array_equal(episode.trajectory.controls, again.trajectory.controls)


def test_what_cannot_be_learned_is_refused_and_nothing_is_written(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="mixes"):
        train(replace(TINY, scenario="heterogeneous"), tmp_path)
    assert not list(tmp_path.iterdir())
    (tmp_path / "taken").touch()
    with pytest.raises(ValueError, match=r"taken.* cannot be made .*; choose another"):
        train(TINY, tmp_path / "taken")


def test_two_trainings_into_one_folder_take_turns(trained: tuple[TrainingSettings, Path]) -> None:
    with only_writer(trained[1]), pytest.raises(OSError, match="is being written to by another process; wait until"):
        train(*trained)
    assert train(*trained).curve


def test_other_settings_in_the_same_folder_are_refused(trained: tuple[TrainingSettings, Path]) -> None:
    settings, out = trained
    with pytest.raises(ValueError, match=r"holds a training with seed 5, not 6; .* with --start-from .*policy\."):
        train(replace(settings, seed=6), out)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"algorithm": "dqn"}, "algorithm 'dqn' is unknown; choose one of ppo, sac"),
        ({"num_robots": 0}, "num_robots"),
        ({"steps": 0}, "steps"),
        ({"scenario": "labyrinth"}, "labyrinth"),
        ({"num_envs": -1}, "num_envs"),
        ({"num_envs": 99_999_999_999}, "num_envs is 99999999999; it must be at most 100000"),
        ({"steps": 10**400}, "steps is about 1e400; it must be at most"),
        ({"steps": 1e6}, "steps must be a whole number, not 1000000.0"),
        ({"seed": 2**64}, "seed is about 1e19"),
        ({"scenario_settings": {"num_robots": 3}}, "scenario_settings has 'num_robots'; give it itself, --num-robots"),
        ({"scenario_settings": {"seed": 3}}, "scenario_settings has 'seed'; give it itself, --seed"),
        ({"scenario_settings": [3]}, "scenario_settings"),
    ],
)
def test_bad_settings_are_refused(change: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(TINY, **change)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--steps", "inf"), "--steps is inf; it must be a whole number of at least 1"),
        (("--steps", "nan"), "--steps is nan; it must be"),
        (("--steps", "1e300"), "steps is about 1e300; it must be at most"),
        (("--steps", "0.5"), "--steps is 0.5"),
        (("--scenario-set", "num_robots=3"), "give it itself, --num-robots"),
        (("--num-envs", "99999999999"), "num_envs is 99999999999; it must be at most 100000"),
    ],
)
def test_bad_options_are_one_line_and_status_two(
    arguments: tuple[str, ...], message: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    with pytest.raises(SystemExit) as exit_:
        cli.main(["train", "ppo", "--out", str(tmp_path / "out"), *arguments])
    assert exit_.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line
    assert not list(tmp_path.iterdir())


def test_a_policy_refuses_what_it_was_not_trained_for(trained: tuple[TrainingSettings, Path]) -> None:
    settings, out = trained
    path = str(out / "policy.safetensors")
    policy = make_policy(settings.algorithm, path=path)
    for kwargs, message in (
        ({"observed_robots": 2}, "observed_robots=4"),
        ({"model": "differential_drive"}, "trained for holonomic2d robots"),
    ):
        env = navigation_v0.parallel_env(scenario="random", num_robots=3, **kwargs)
        env.reset(seed=0)
        with pytest.raises(ValueError, match=message):
            policy.reset(env)
    other = "sac" if settings.algorithm == "ppo" else "ppo"
    with pytest.raises(ValueError, match=f"trained by {settings.algorithm}"):
        make_policy(other, path=path)


def rewritten(source: Path, target: Path, change) -> str:
    from safetensors.numpy import save_file

    network = load_network(source)
    arrays, header = dict(network.arrays), network.header.model_dump()
    metadata = {"d4orm": json.dumps(header)}
    change(arrays, header, metadata)
    if "d4orm" in metadata:
        metadata["d4orm"] = metadata["d4orm"] if header == network.header.model_dump() else json.dumps(header)
    save_file(arrays, target, metadata=metadata)
    return str(target)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda arrays, header, metadata: arrays.pop("bias_0"), "expected bias_0"),
        (lambda arrays, header, metadata: arrays.update(weight_0=np.zeros((3, 3), np.float32)), "weight_0 is float32"),
        (lambda arrays, header, metadata: arrays["weight_1"].fill(np.nan), "finite float32"),
        (lambda arrays, header, metadata: arrays.update(bias_0=arrays["bias_0"].astype(np.float64)), "float64"),
        (lambda arrays, header, metadata: arrays["observation_variance"].fill(-1), "observation_variance is negative"),
        (lambda arrays, header, metadata: header.update(model="holonomic3d"), "weight_2 is float32"),
        (lambda arrays, header, metadata: header.update(model="boat"), "boat"),
        (lambda arrays, header, metadata: header.update(format=9), "has format 9, and .* format 1; write one with"),
        (
            lambda arrays, header, metadata: header.update(layers="3"),
            "layers: Input should be a valid integer.*; write one with",
        ),
        (lambda arrays, header, metadata: header.update(layers=10**9), "layers: Input should be less"),
        (lambda arrays, header, metadata: header.update(activation="exec"), "activation 'exec' is unknown"),
        (lambda arrays, header, metadata: header.update(extra=1), "extra: Extra inputs are not permitted"),
        (lambda arrays, header, metadata: metadata.clear(), "holds no policy of this program"),
        (lambda arrays, header, metadata: metadata.update(d4orm="{"), "Invalid JSON"),
    ],
)
def test_malformed_policy_files_are_refused(
    trained: tuple[TrainingSettings, Path], tmp_path: Path, change, message: str
) -> None:
    settings, out = trained
    path = rewritten(out / "policy.safetensors", tmp_path / "bad.safetensors", change)
    with pytest.raises(ValueError, match=message):
        make_policy(settings.algorithm, path=path)


def test_files_that_are_no_policies_are_refused(tmp_path: Path) -> None:
    garbage = tmp_path / "garbage.safetensors"
    garbage.write_bytes(b"\xff" * 100)
    with pytest.raises(ValueError, match="is no safetensors file"):
        make_policy("ppo", path=str(garbage))
    with garbage.open("wb") as file:
        file.truncate(MAX_BYTES + 1)
    with pytest.raises(ValueError, match=f"has {MAX_BYTES + 1} bytes"):
        make_policy("ppo", path=str(garbage))
    with pytest.raises(FileNotFoundError, match="does not exist"):
        make_policy("ppo", path=str(tmp_path / "none.safetensors"))
    (tmp_path / "000001").mkdir()
    (tmp_path / "000001" / "model.zip").touch()
    with pytest.raises(FileNotFoundError, match=r"does not exist; .*, as .*000001.model\.zip"):
        make_policy("ppo", path=str(tmp_path / "model.zip"))
    with pytest.raises(ValueError, match=r"must end in \.safetensors"):
        make_policy("ppo", path="policy.pkl")
    garbage.with_suffix(".zip").write_bytes(b"no zip")
    with pytest.raises(ValueError, match=r"is no PPO model of SB3 .*; give what model.save\(\) wrote"):
        make_policy("ppo", path=str(garbage.with_suffix(".zip")))


def test_a_zip_of_sb3_trained_on_the_environment_itself(tmp_path: Path) -> None:
    import stable_baselines3
    from gymnasium import Env, spaces

    problem = make_problem("circle", num_robots=2)
    source = navigation_v0.parallel_env(problem=problem)

    class One(Env):
        observation_space = source.observation_space("robot_0")
        action_space = spaces.Box(-np.ones(2, np.float32), np.ones(2, np.float32))

    stable_baselines3.PPO("MlpPolicy", One(), device="cpu", n_steps=8, batch_size=8).save(tmp_path / "mine.zip")
    policy = make_policy("ppo", path=str(tmp_path / "mine.zip"))
    episode = run_episode(source, policy, seed=0)
    assert np.abs(episode.trajectory.controls).max() > 0
    other = navigation_v0.parallel_env(problem=problem, observed_robots=1)
    other.reset(seed=0)
    with pytest.raises(ValueError, match="trained for observations and actions of shapes"):
        policy.reset(other)


def test_a_zip_of_sb3_trained_on_the_joint_environment(tmp_path: Path) -> None:
    import gymnasium
    import stable_baselines3

    joint = gymnasium.make("d4orm/Navigation-v0", scenario="circle", num_robots=3)
    model = stable_baselines3.PPO("MlpPolicy", joint, device="cpu", n_steps=8, batch_size=8)
    model.save(tmp_path / "joint.zip")
    other = navigation_v0.parallel_env("circle", num_robots=4)
    other.reset(seed=0)
    for policy in (make_policy("ppo", path=str(tmp_path / "joint.zip")), from_sb3(model)):
        episode = run_episode(joint, policy, seed=0)
        observation, _ = joint.reset(seed=0)
        action = model.predict(observation, deterministic=True)[0].reshape(3, 2)
        action /= np.maximum(np.linalg.norm(action, axis=1, keepdims=True), 1)
        np.testing.assert_allclose(episode.trajectory.controls[0], action, atol=1e-5)
        with pytest.raises(ValueError, match=r"a robot's here have \(52,\) .* with as many robots"):
            policy.reset(other)


def test_a_model_that_saw_normalised_observations_is_asked_for_such(tmp_path: Path) -> None:
    import gymnasium
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    joint = gymnasium.make("d4orm/Navigation-v0", scenario="circle", num_robots=3)
    rewards_only = VecNormalize(DummyVecEnv([lambda: joint]), norm_obs=False)
    run_episode(joint, from_sb3(PPO("MlpPolicy", rewards_only, device="cpu", n_steps=8, batch_size=8)), 0)
    norm = VecNormalize(DummyVecEnv([lambda: joint]))
    model = PPO("MlpPolicy", norm, device="cpu", n_steps=8, batch_size=8).learn(8)
    model.save(tmp_path / "joint.zip")
    norm.save(tmp_path / "norm.pkl")
    loaded = VecNormalize.load(tmp_path / "norm.pkl", DummyVecEnv([lambda: joint]))
    again, bare = (PPO.load(tmp_path / "joint.zip", env=env, device="cpu") for env in (loaded, None))
    observation, _ = joint.reset(seed=0)
    wanted = model.predict(norm.normalize_obs(observation), deterministic=True)[0].reshape(3, 2)
    wanted /= np.maximum(np.linalg.norm(wanted, axis=1, keepdims=True), 1)
    for one in (model, again):
        np.testing.assert_allclose(run_episode(joint, from_sb3(one), 0).trajectory.controls[0], wanted, atol=1e-5)
    assert np.abs(run_episode(joint, from_sb3(bare), 0).trajectory.controls[0] - wanted).max() > 1e-3
    assert from_sb3(model).identity() == from_sb3(again).identity() != from_sb3(bare).identity()


def test_a_zip_trained_in_egocentric_environments(tmp_path: Path) -> None:
    import gymnasium
    import stable_baselines3

    joint = gymnasium.make("d4orm/Navigation-v0", scenario="circle", num_robots=3, egocentric=True)
    model = stable_baselines3.PPO("MlpPolicy", joint, device="cpu", n_steps=8, batch_size=8)
    model.save(tmp_path / "joint.zip")
    plain = navigation_v0.parallel_env("circle", num_robots=3)
    policy = make_policy("ppo", path=str(tmp_path / "joint.zip"), egocentric=True)
    episode = run_episode(plain, policy, seed=0)
    np.testing.assert_array_equal(
        episode.trajectory.controls, run_episode(plain, from_sb3(model, egocentric=True), seed=0).trajectory.controls
    )
    joint.step(model.predict(joint.reset(seed=0)[0], deterministic=True)[0])
    after = split_state(joint.unwrapped.problem, joint.unwrapped.state()).states
    np.testing.assert_allclose(episode.trajectory.states[1], after, atol=1e-6)
    with pytest.raises(ValueError, match="the model was trained for"):
        run_episode(plain, make_policy("ppo", path=str(tmp_path / "joint.zip")), seed=0)
    with pytest.raises(ValueError, match=r"egocentric is of a \.zip of SB3"):
        make_policy("ppo", egocentric=True)


def test_wrapped_joint_environments_are_refused() -> None:
    import gymnasium

    joint = gymnasium.make("d4orm/Navigation-v0", scenario="circle", num_robots=2, max_episode_steps=5)
    with pytest.raises(ValueError, match="is no environment of this package, or is wrapped"):
        run_episode(joint, "go-to-goal", seed=0)
