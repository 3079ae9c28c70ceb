"""A network of sets: neighbours in any order and number, the same in NumPy as in torch, and mixtures to train it on."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from env_support import slow
from hypothesis import given
from hypothesis import strategies as st

from d4orm_env import make_problem, navigation_v0
from d4orm_env.core.observation_layout import ObservationSlices
from d4orm_env.envs.features import Features
from d4orm_planners import make_policy, run_episode
from d4orm_planners.cli import app as cli
from d4orm_planners.rl.network import Header, Network, load_network
from d4orm_planners.rl.perturbed_scenarios import clutter, perturbed

OWN, NEIGHBOR, OBSTACLE = 11, 9, 5


def a_network(neighbors: int = 4, obstacles: int = 2) -> Network:
    random = np.random.default_rng(0)
    shapes = {"reward_variance": (), "weight_0": (6, OWN + 2 * 7 + 2 * 3), "bias_0": (6,)}
    shapes |= {"weight_1": (2, 6), "bias_1": (2,)}
    for kind, row, width in (("neighbor", NEIGHBOR, 7), ("obstacle", OBSTACLE, 3)):
        shapes |= {f"{kind}_weight_0": (width, row), f"{kind}_own": (width, OWN), f"{kind}_bias_0": (width,)}
        shapes |= {f"{kind}_weight_1": (width, width), f"{kind}_bias_1": (width,)}
    header = Header(
        format=1, algorithm="ppo", model="holonomic2d", dimension=2, num_neighbors=neighbors, num_obstacles=obstacles,
        activation="relu", squashed=False, layers=2, encoder="sets", training={},
    )  # fmt: skip
    arrays = {name: random.normal(0, 0.3, shape).astype(np.float32) for name, shape in shapes.items()}
    return Network(header, arrays)


def some_features(network: Network, rows: int, seed: int = 0) -> np.ndarray:
    """Of ``rows`` robots, some of whose neighbours and obstacles are not there."""
    random = np.random.default_rng(seed)
    slices = network.features.slices
    features = random.normal(size=(rows, network.features.size)).astype(np.float32)
    _, neighbors, obstacles = network.features.parts(features)
    for listed, count in ((neighbors, slices.num_neighbors), (obstacles, slices.num_obstacles)):
        present = random.random((rows, count)) < 0.6
        listed[..., 0] = 1
        listed[~present] = 0
    return features


@given(seed=st.integers(0, 50))
def test_the_order_of_neighbors_and_obstacles_makes_no_difference(seed: int) -> None:
    network, random = a_network(), np.random.default_rng(seed)
    features = some_features(network, 5, seed)
    shuffled = features.copy()
    for listed in network.features.parts(shuffled)[1:]:
        listed[:] = listed[:, random.permutation(listed.shape[1])]
    np.testing.assert_allclose(network(features), network(shuffled), atol=1e-6)


@pytest.mark.parametrize("fewer", [0, 1, 3])
def test_rows_for_nobody_make_no_difference(fewer: int) -> None:
    """One who sees two of four places taken acts as one who has two places, and none at all will do."""
    network = a_network()
    few = replace(network.features, slices=ObservationSlices(2, fewer, 2))
    features = some_features(network, 5)
    own, neighbors, obstacles = network.features.parts(features)
    neighbors[:, fewer:] = 0
    seen = np.concatenate([own, neighbors[:, :fewer].reshape(5, -1), obstacles.reshape(5, -1)], axis=1)
    assert seen.shape[1] == few.size
    np.testing.assert_allclose(network(seen), network(features), atol=1e-6)


def test_literal_answer_of_a_network_of_sets() -> None:
    # One hidden unit per neighbour: twice its second feature less the robot's first, not below zero; then plus one.
    network = a_network(neighbors=3, obstacles=0)
    arrays = {name: np.zeros_like(array) for name, array in network.arrays.items()}
    arrays["neighbor_weight_0"][0, 1], arrays["neighbor_own"][0, 0] = 2, -1
    arrays["neighbor_weight_1"][0, 0], arrays["neighbor_bias_1"][0] = 1, 1
    # The first action is a tenth of the maximum, the second that of the sum.
    arrays["weight_0"][0, OWN], arrays["weight_0"][1, OWN + 7] = 1, 1
    arrays["weight_1"][0, 0], arrays["weight_1"][1, 1] = 0.1, 0.1
    features = np.zeros((1, OWN + 3 * NEIGHBOR), np.float32)
    features[0, 0] = 0.5
    features[0, OWN : OWN + 2] = 1, 1  # 2 - 0.5 + 1 = 2.5
    features[0, OWN + NEIGHBOR : OWN + NEIGHBOR + 2] = 1, -1  # 0 + 1 = 1; the third is not there
    np.testing.assert_allclose(Network(network.header, arrays)(features), [[0.25, 0.25 * 0.35]], atol=1e-6)


def test_a_policy_of_sets_acts_whatever_number_of_robots_is_observed(tmp_path: Path) -> None:
    path = tmp_path / "sets.safetensors"
    a_network(obstacles=4).save(path)
    for observed in (0, 2, 9):
        env = navigation_v0.parallel_env(scenario="circle", num_robots=3, max_cycles=3, observed_robots=observed)
        assert np.abs(run_episode(env, make_policy("ppo", path=path)).trajectory.controls).max() > 0
    env = navigation_v0.parallel_env(scenario="circle", num_robots=3, observed_obstacles=3)
    with pytest.raises(ValueError, match=r"make it with any observed_robots, observed_obstacles=4"):
        run_episode(env, make_policy("ppo", path=path))


def test_a_file_of_sets_says_so_and_one_without_is_as_it_was(tmp_path: Path) -> None:
    network = a_network()
    network.save(tmp_path / "sets.safetensors")
    again = load_network(tmp_path / "sets.safetensors")
    assert again.header == network.header
    assert {name: array.tolist() for name, array in again.arrays.items()} == {
        name: array.tolist() for name, array in network.arrays.items()
    }
    flat = network.header.model_copy(update={"encoder": None})
    assert "encoder" not in json.loads(flat.text())
    assert Header.model_validate_json(flat.text()) == flat


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda arrays, header: arrays.pop("neighbor_own"), "expected .*neighbor_own"),
        (lambda arrays, header: arrays.update(observation_mean=np.zeros(57, np.float32)), "holds .*observation_mean"),
        (lambda arrays, header: arrays.update(obstacle_weight_1=np.zeros((3, 4), np.float32)), "obstacle_weight_1 is"),
        (lambda arrays, header: arrays.update(neighbor_bias_0=np.zeros(9, np.float32)), "neighbor_bias_0 is"),
        (lambda arrays, header: arrays.update(neighbor_weight_1=np.float32(1)), "neighbor_weight_1 is"),
        (lambda arrays, header: arrays["neighbor_own"].fill(np.inf), "finite float32"),
        (lambda arrays, header: arrays.update(weight_0=np.zeros((6, 30), np.float32)), "weight_0 is"),
        (lambda arrays, header: header.update(encoder="attention"), "encoder: Input should be 'sets'"),
        (lambda arrays, header: header.update(encoder=None), "expected .*observation_mean"),
    ],
)
def test_malformed_files_of_sets_are_refused(tmp_path: Path, change, message: str) -> None:
    from safetensors.numpy import save_file

    network = a_network()
    arrays, header = dict(network.arrays), network.header.model_dump()
    change(arrays, header)
    save_file({name: np.asarray(array) for name, array in arrays.items()}, tmp_path / "bad.safetensors",
              metadata={"d4orm": json.dumps(header)})  # fmt: skip
    with pytest.raises(ValueError, match=message):
        load_network(tmp_path / "bad.safetensors")


@pytest.mark.parametrize("base", ["circle", "four_obstacles", "swap"])
def test_perturbed_scenarios_differ_from_seed_to_seed_in_positions_only(base: str) -> None:
    one, same, other = (make_problem(perturbed, num_robots=8, seed=seed, base=base) for seed in (0, 0, 1))
    assert one == same
    assert np.abs(one.start - other.start).max() > 0.05
    assert np.abs(one.goal - other.goal).max() > 0.05
    assert one.horizon == other.horizon
    np.testing.assert_array_equal(one.world.circles, other.world.circles)
    given = make_problem(base, num_robots=8)
    moved = make_problem(perturbed, num_robots=8, base=base, shrink=0, shift=0)
    np.testing.assert_allclose(np.linalg.norm(moved.start, axis=1), np.linalg.norm(given.start, axis=1), atol=1e-6)


def test_clutter_keeps_its_obstacles_and_leaves_room_at_starts_and_goals() -> None:
    problems = [make_problem(clutter, num_robots=8, seed=seed, positions=3, obstacles=5) for seed in range(4)]
    assert len({problem.world.circles.tobytes() for problem in problems}) == 1
    assert len(set(problems)) == 4
    for problem in problems:
        for points in (problem.start[:, :2], problem.goal):
            gaps = np.linalg.norm(points[:, None] - problem.world.circles[:, :2], axis=2) - problem.world.circles[:, 2]
            assert gaps.min() > problem.team.radius[0] + problem.margin
    with pytest.raises(ValueError, match="num_robots is 40; so many do not fit on a size of 5 m among the"):
        make_problem(clutter, num_robots=40, obstacles=300)


pytest.importorskip("stable_baselines3")
from d4orm_planners.rl.algorithms import ALGORITHMS  # noqa: E402
from d4orm_planners.rl.checkpoints import evaluate_network  # noqa: E402
from d4orm_planners.rl.robot_vec_env import RobotVecEnv  # noqa: E402
from d4orm_planners.rl.task_mixture import MIXTURES, MixedVecEnv, TrainTask, parse_mixture  # noqa: E402
from d4orm_planners.rl.train_config import Stage  # noqa: E402
from d4orm_planners.rl.training import TrainingSettings, train  # noqa: E402

TINY = TrainingSettings(
    steps=2 * 32 * 20, num_envs=20, stages=2, validation_worlds=4, seed=5, network="sets", observed_robots=3,
    mixture=("random 2 size=4", "circle 4 max_observed=1"),
)  # fmt: skip


def test_robots_learn_to_reach_goals_at_any_speed_unless_something_says_otherwise() -> None:
    """Whoever explores comes to rest at a goal too seldom to learn from it."""
    for scenario in ("random", "circle", f"{perturbed.__module__}:perturbed"):
        (task,) = parse_mixture([f"{scenario} 2"])
        assert np.isinf(task.validation(1, 0).problem.goal_speed).all()
        (slow,) = parse_mixture([f"{scenario} 2 goal_speed=0.1"])
        np.testing.assert_array_equal(slow.validation(1, 0).problem.goal_speed, np.float32([0.1, 0.1]))
    given = make_problem("random", num_robots=2, goal_speed=0.3)
    assert TrainTask(lambda seed, num_robots: given, 2, {}).problem(0).goal_speed.tolist() == given.goal_speed.tolist()


@pytest.fixture(scope="module", params=["ppo", slow("sac")])
def practised(request: pytest.FixtureRequest) -> TrainingSettings:
    return replace(TINY, algorithm=request.param)


@pytest.fixture(scope="module")
def trained(practised: TrainingSettings, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("sets")
    train(practised, out, command="d4orm train ...")
    return out


def test_the_network_of_a_training_answers_in_numpy_as_in_torch(trained: Path) -> None:
    import stable_baselines3
    from stable_baselines3.common.vec_env import VecNormalize

    from d4orm_planners.rl.algorithms import network_of, set_network

    network = load_network(trained / "policy.safetensors")
    assert network.header.encoder == "sets"
    assert network.header.training["mixture"] == list(TINY.mixture)
    last = sorted((trained / "checkpoints").iterdir())[-1]
    learner = getattr(stable_baselines3, network.header.algorithm.upper())
    model = learner.load(last / "model.zip", device="cpu")
    normalization = VecNormalize(RobotVecEnv(1, 2, "circle", observed_robots=3))
    features = some_features(network, 9)
    set_network(model, normalization, network)
    np.testing.assert_allclose(network(features), model.predict(features, deterministic=True)[0], atol=1e-5)
    header = network.header.model_dump(
        include={"algorithm", "model", "dimension", "num_neighbors", "num_obstacles", "brakes", "training"}
    )
    back = network_of(header, model, normalization)
    assert back.header == network.header
    np.testing.assert_array_equal(back(features), network(features))


def test_a_training_on_a_mixture_tells_how_each_part_goes(
    practised: TrainingSettings, trained: Path, tmp_path: Path
) -> None:
    result = train(practised, trained)
    assert [evaluation.scenario for evaluation in result.curve] == ["mixture"] * 2
    for evaluation in result.curve:
        assert evaluation.parts is not None
        assert len(evaluation.parts) == 2
        assert evaluation.success_rate == pytest.approx(np.mean(evaluation.parts))
    stages = result.network.header.training["stage"]
    spent = sum(evaluation.seconds for evaluation in result.curve[:stages])
    assert result.network.training_time == pytest.approx(spent, abs=0.1), "up to the stage that was best"
    again = train(practised, tmp_path, command="d4orm train ...").network
    for name, array in load_network(trained / "policy.safetensors").arrays.items():
        np.testing.assert_array_equal(array, again.arrays[name])


def test_a_policy_of_sets_learns_on_and_a_flat_one_is_refused(
    practised: TrainingSettings, trained: Path, tmp_path: Path
) -> None:
    path = str(trained / "policy.safetensors")
    further = replace(practised, start_from=path, learning_rate=1e-9, stages=1, steps=32, observed_robots=4)
    result = train(further, tmp_path / "further")
    learned = result.network
    for name, array in load_network(path).arrays.items():
        if name != "reward_variance":
            np.testing.assert_allclose(array, learned.arrays[name], atol=1e-6)
    before = load_network(path).training_time
    assert before is not None
    assert learned.training_time is not None
    spent = before + sum(evaluation.seconds for evaluation in result.curve)
    assert learned.training_time == pytest.approx(spent, abs=0.11), "what it began with counts"
    with pytest.raises(ValueError, match="is a sets network, and a flat one is wanted; give network='sets'"):
        train(replace(further, network="flat"), tmp_path / "flat")


def test_a_policy_of_robots_that_turn_says_along_what_it_sees_and_learns_on_from_none_that_sees_otherwise(
    practised: TrainingSettings, trained: Path, tmp_path: Path
) -> None:
    turning = replace(practised, model="differential_drive", stages=1, steps=32)
    network = train(turning, tmp_path / "first").network
    assert load_network(tmp_path / "first" / "policy.safetensors").features.frame == network.header.frame == "heading"
    assert load_network(trained / "policy.safetensors").features.frame == "goal"
    earlier = replace(network, header=network.header.model_copy(update={"frame": None}))
    earlier.save(tmp_path / "earlier.safetensors")
    assert "frame" not in json.loads(earlier.header.text())
    assert load_network(tmp_path / "earlier.safetensors").features.frame == "goal", "as it was trained"
    with pytest.raises(ValueError, match=r"another frame \(goal\) than is trained for \(heading\); give a policy"):
        train(replace(turning, start_from=str(tmp_path / "earlier.safetensors")), tmp_path / "second")
    assert not (tmp_path / "second").exists()


def test_every_part_of_a_mixture_has_its_worlds_robots_and_observed_robots() -> None:
    parts = TINY.tasks
    assert parts == (TrainTask("random", 2, {"size": 4}), TrainTask("circle", 4, {}, max_observed=1))
    assert TINY.worlds_per_task == (5, 2)
    assert TINY.batch == 18
    env = TINY.worlds(None)  # type: ignore[arg-type] # a mixture is the same in every stage
    assert isinstance(env, MixedVecEnv)
    assert [part.problem.name for part in env.parts] == ["random", "circle"]
    assert env.num_envs == 18
    assert env.num_worlds == 7
    assert np.abs(env.parts[0].problem.start[:, :2]).max() <= 2
    _, neighbors, _ = env.features.parts(env.reset())
    shown = neighbors[..., 0].sum(axis=1)
    np.testing.assert_array_equal(shown, [1] * 18)
    wide = replace(TINY, mixture=("random 2 size=4", "circle 4")).worlds(None)  # type: ignore[arg-type]
    _, neighbors, _ = wide.features.parts(wide.reset())
    np.testing.assert_array_equal(neighbors[..., 0].sum(axis=1), [1] * 10 + [3] * 8)
    for both in (env, wide):
        both.close()


def test_parts_that_differ_in_max_observed_only_are_stepped_together() -> None:
    mixture = ("circle 3", "circle 2", "circle 3 max_observed=1", "circle 3 disturb.delay=1", "circle 3 max_observed=0")
    settings = replace(TINY, mixture=mixture, num_envs=30)
    assert settings.worlds_per_task == (2, 3, 2, 2, 2)
    env = settings.worlds(None)  # type: ignore[arg-type]
    assert [(part.num_worlds, part.problem.num_robots) for part in env.parts] == [(6, 3), (3, 2), (2, 3)]
    seen = [2] * 6 + [1] * 6 + [0] * 6 + [1] * 6 + [2] * 6
    shown = env.features.parts(env.reset())[1][..., 0].sum(axis=1)
    np.testing.assert_array_equal(shown, seen)
    ended = 0
    while not ended:
        features, _, dones, infos = env.step(np.zeros((env.num_envs, 2), np.float32))
        np.testing.assert_array_equal(env.features.parts(features)[1][..., 0].sum(axis=1), seen)
        for robot in np.flatnonzero(dones):
            last = infos[robot]["terminal_observation"][None]
            assert env.features.parts(last)[1][..., 0].sum() == seen[robot], "also what it saw last"
            ended += 1
    assert ended == env.num_envs
    env.close()
    one_by_one = settings.validation()
    assert [part.problem.num_robots for part in one_by_one.parts] == [3, 2, 3, 3, 3], "each is judged by itself"
    one_by_one.close()


@pytest.mark.parametrize(("shortest_paths", "kept"), [(True, 6), (False, 0)])
def test_instances_with_paths_last_for_some_time(shortest_paths: bool, kept: int) -> None:
    """Whether those of earlier stages are at hand or have to be drawn again, as when a killed training goes on."""
    settings = replace(TINY, mixture=("random 2 size=4",), num_envs=8, shortest_paths=shortest_paths)
    drawn: dict = {}

    def begun(number: int, drawn: dict) -> list[set[tuple[float, ...]]]:
        env = settings.worlds(None, number, 50_000 * number, drawn)  # type: ignore[arg-type]
        starts = [set(map(tuple, env.reset().reshape(4, -1).tolist())) for _ in range(30)]
        env.close()
        return starts

    instances = []
    for number in range(3):
        starts = begun(number, drawn)
        assert starts == begun(number, {})
        assert len(set.union(*starts)) == 8 == len(*drawn.values())
        instances.append(set(*drawn.values()))
    assert len(instances[0] & instances[1]) == len(instances[1] & instances[2]) == kept
    assert len(instances[0] & instances[2]) == (4 if shortest_paths else 0)


def test_a_part_of_a_mixture_may_be_disturbed() -> None:
    part = TrainTask.parse("circle 2 disturb.delay=2 disturb.push.speed=0.5 max_observed=1")
    assert part == TrainTask("circle", 2, {}, max_observed=1, disturbances={"delay": 2, "push.speed": 0.5})
    env = part.validation(3, 1)
    assert env.num_worlds == 3, "what goes wrong differs, though places do not"
    assert TrainTask.parse("circle 2").validation(3, 1).num_worlds == 1
    env.reset()
    features = [env.step(np.full((6, 2), 1, np.float32))[0] for _ in range(2)]
    # Nothing has been obeyed yet, but somebody may have been pushed.
    speeds = np.linalg.norm(features[1][:, :2], axis=1)
    assert set(np.round(speeds * env.problem.team.max_speed[0], 3)) <= {0.0, 0.5, 1.0}
    for text, complaint in (
        ("circle 2 disturb.nothing=1", "mixture has .*nothing"),
        ("circle 2 disturb.delay=-1", "mixture has .*delay"),
        ("circle 2 disturb.delay=soon", "mixture has .*delay"),
    ):
        with pytest.raises(ValueError, match=complaint):
            TrainTask.parse(text)


def test_a_mixture_steps_its_parts_as_each_alone() -> None:
    kinds = (("random", 3, 2, 7), ("circle", 2, 4, 9))
    alone, together = ([RobotVecEnv(n, k, s, seed=seed, max_cycles=6) for s, n, k, seed in kinds] for _ in range(2))
    mixed = MixedVecEnv(together)
    np.testing.assert_array_equal(mixed.reset(), np.concatenate([part.reset() for part in alone]))
    random = np.random.default_rng(0)
    for _ in range(7):
        actions = random.uniform(-1, 1, (14, 2)).astype(np.float32)
        mixed.step_async(actions)
        features, rewards, dones, infos = mixed.step_wait()
        for part, own in zip(alone, (actions[:6], actions[6:])):
            part.step_async(own)
        steps = [part.step_wait() for part in alone]
        for value, parts in zip((features, rewards, dones), zip(*(step[:3] for step in steps))):
            np.testing.assert_array_equal(value, np.concatenate(parts))
        assert [info.keys() for info in infos] == [info.keys() for step in steps for info in step[3]]
        np.testing.assert_array_equal(mixed.acted, np.concatenate([part.acted for part in alone]))
        first, second = (part.finished for part in alone)
        assert mixed.finished == [*first, *((world + 3, *how) for world, *how in second)]
    mixed.close()


def test_a_mixture_is_judged_by_the_mean_of_its_parts_however_many_worlds_they_have() -> None:
    network = a_network(obstacles=4)
    parts = [RobotVecEnv(3, 1, "random", max_cycles=5), RobotVecEnv(1, 2, "circle", max_cycles=5)]
    _, travel_time, of_parts = evaluate_network(network, MixedVecEnv(parts), 0)
    assert of_parts == [0, 0]
    assert travel_time == pytest.approx(0.5)


def test_parts_of_different_models_are_refused() -> None:
    parts = [RobotVecEnv(1, 2, "circle", model=model) for model in ("holonomic2d", "velocity2d")]
    with pytest.raises(ValueError, match="robots of holonomic2d, velocity2d; one policy is learned for one model"):
        MixedVecEnv(parts)


def test_named_mixtures_are_what_they_stand_for() -> None:
    for name, texts in MIXTURES.items():
        assert parse_mixture((name, "circle 3")) == (*map(TrainTask.parse, texts), TrainTask("circle", 3, {}))
        for task in parse_mixture((name,)):
            make_problem(task.scenario, num_robots=task.num_robots, **task.settings)


def test_a_network_of_sets_learns_where_nobody_is_seen(tmp_path: Path) -> None:
    train(replace(TINY, observed_robots=0, steps=32, stages=1, mixture=("random 2",)), tmp_path)
    assert load_network(tmp_path / "policy.safetensors").header.num_neighbors == 0


@pytest.mark.parametrize(
    ("algorithm", "settings"), [("ppo", {"n_epochs": 7, "clip_range": 0.1}), ("sac", {"gradient_steps": 3, "tau": 1})]
)
def test_a_learner_has_the_settings_asked_for(algorithm: str, settings: dict, tmp_path: Path) -> None:
    from stable_baselines3.common.vec_env import VecNormalize

    asked = replace(TINY, algorithm=algorithm, learner_settings=settings)
    env = VecNormalize(asked.worlds(None))  # type: ignore[arg-type]
    model = ALGORITHMS[algorithm].make(env, None, asked.learner_settings)
    for name, value in {**ALGORITHMS[algorithm].tunable, **asked.learner_settings}.items():
        had = getattr(model, name)
        assert (had(1.0) if callable(had) else had) == value
    env.close()


def test_rewards_are_those_asked_for() -> None:
    settings = replace(TINY, reward_settings={"arrival": 7.5, "contact": 4})
    assert (settings.reward.arrival, settings.reward.contact, settings.reward.time) == (7.5, 4, 0.05)
    flat = TrainingSettings(scenario="circle", num_robots=2, num_envs=2, reward_settings={"time": 1})
    for env in (settings.worlds(None), flat.worlds(Stage(2, "circle", 1))):  # type: ignore[arg-type]
        env.reset()
        env.step_async(np.zeros((env.num_envs, 2), np.float32))
        _, rewards, *_ = env.step_wait()
        np.testing.assert_allclose(rewards, -1 if env.num_envs == 2 else -0.05, atol=1e-6)
        env.close()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"reward_settings": {"speed": 1}}, "reward_settings has 'speed'; the reward takes progress, arrival, margin"),
        ({"reward_settings": {"arrival": "much"}}, "reward_settings"),
        ({"mixture": ("random",)}, "mixture has 'random'; it must be a scenario and a team size, as 'random 8 size=4'"),
        ({"mixture": ("",)}, "mixture has ''; it must be"),
        ({"mixture": ("random 0",)}, "mixture has 'random 0'; it must be"),
        ({"mixture": ("random 2 size",)}, "'size' is no new setting of the form name=value"),
        ({"mixture": ("random 2 size=3 size=4",)}, "'size=4' is no new setting"),
        ({"mixture": ("random 2 max_observed=many",)}, "max_observed must be a whole number"),
        ({"mixture": ("random 2 seed=3",)}, "'seed' has no place"),
        ({"mixture": ("random 2 width=3",)}, "takes no argument 'width'"),
        ({"mixture": ("labyrinth 2",)}, "labyrinth"),
        ({"mixture": 3}, "mixture"),
        ({"scenario": "circle"}, "scenario is 'circle' beside a mixture"),
        ({"num_robots": 8}, "num_robots is 8 beside a mixture"),
        ({"curriculum": True}, "curriculum is True beside a mixture"),
        ({"learner_settings": {"n_steps": 3}}, "learner_settings has 'n_steps'; choose of n_epochs, gae_lambda"),
        ({"learner_settings": {"n_epochs": 2.5}}, "learner_settings has n_epochs=2.5; it must be a whole number of at"),
        ({"learner_settings": {"n_epochs": 0}}, "n_epochs=0; it must be a whole number of at least 1"),
        ({"learner_settings": {"gae_lambda": 5}}, "learner_settings has gae_lambda=5; it must be at most 1"),
        ({"learner_settings": {"ent_coef": -1}}, "learner_settings has ent_coef=-1; it must be at least 0"),
        ({"learner_settings": {"ent_coef": "much"}}, "learner_settings"),
        ({"algorithm": "sac", "learner_settings": {"n_epochs": 2}}, "has 'n_epochs'; choose of batch_size, gradient"),
        ({"network": "deep"}, "network 'deep' is unknown; choose one of flat, sets"),
        ({"learning_rate": 0.0}, "learning_rate is 0; it must be positive"),
        ({"observed_robots": -1}, "observed_robots is -1"),
    ],
)
def test_bad_settings_are_refused(change: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(TINY, **change)


def test_the_command_line_trains_on_a_mixture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--network", "sets", "--mixture", "random 2", "--mixture", "circle 2", "--num-envs", "8"]
    options += ["--steps", "512", "--stages", "1", "--validation-worlds", "2", "--learning-rate", "1e-3"]
    with pytest.raises(SystemExit) as exit_:
        cli.main(["train", "ppo", *options, "--out", str(tmp_path)])
    assert exit_.value.code == 0
    assert "best validation" in capsys.readouterr().out
    told = json.loads((tmp_path / "settings.json").read_text())
    assert (told["mixture"], told["network"], told["learning_rate"]) == (["random 2", "circle 2"], "sets", 1e-3)


def test_features_of_another_size_are_refused() -> None:
    features = Features(ObservationSlices(2, 2, 1), turned=True)
    assert features.of_size(features.size + 9).slices.num_neighbors == 3
    assert features.of_observation_size(features.slices.size - 12) == replace(
        features, slices=ObservationSlices(2, 0, 1)
    )
    for size in (features.size + 1, features.size - 3 * 9):
        with pytest.raises(ValueError, match=f"{size} features are not those of any number of neighbours"):
            features.of_size(size)
    assert features.of_observation_size(features.slices.size + 1) is None
