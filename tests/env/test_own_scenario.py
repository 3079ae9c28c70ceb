"""Scenarios that users bring: by name, file, import path and entry point, and as callables."""

from __future__ import annotations

import importlib.metadata
import pickle
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from registry_support import forgetting

from d4orm_env import Problem, Team, World, make_problem, navigation_v0, register_scenario, save_problem
from d4orm_env.scenarios import describe_scenario, list_scenarios, load_problem
from d4orm_env.scenarios.problems import SCENARIOS
from d4orm_planners import OpenLoop, evaluate, make_planner, run_episode
from d4orm_planners.cli.app import main


def lanes(seed: int, num_robots: int, *, gap: float = 1.0) -> Problem:
    """Robots side by side that all drive ahead, for a distance that the seed draws."""
    team = Team(("velocity2d",) * num_robots)
    start = np.column_stack([np.zeros(num_robots), gap * np.arange(num_robots)])
    return Problem(team, start, start + np.array([np.random.default_rng(seed).uniform(1, 2), 0]))


def still(seed: int = 0, num_robots: int = 2, **settings: Any) -> Problem:
    return lanes(0, num_robots, **settings)


def poles(seed: int, num_robots: int) -> Problem:
    """One obstacle, where the seed puts it, or two."""
    positions = np.random.default_rng(seed).uniform(-0.5, 0.5, (1 + seed % 2, 2))
    return lanes(0, num_robots).replace(
        world=World(2, circles=np.column_stack([positions - [1, 0], positions[:, :1] * 0 + 0.1]))
    )


@pytest.fixture
def registered() -> Iterator[None]:
    with forgetting(SCENARIOS):
        yield


class Offered:
    """An installed package that offers scenarios."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, **targets: str) -> None:
        points = [
            importlib.metadata.EntryPoint(name.rstrip("_"), target, SCENARIOS.group) for name, target in targets.items()
        ]
        offered = importlib.metadata.EntryPoints(points)
        monkeypatch.setattr("d4orm_env.core.registry.installed", lambda: offered)


def test_a_callable_gets_seed_team_and_settings_and_gives_its_name() -> None:
    problem = make_problem(lanes, num_robots=3, seed=5, gap=0.8)
    assert problem == lanes(5, 3, gap=0.8)
    assert problem.name == "lanes"
    assert make_problem(lanes).num_robots == 8
    assert make_problem(still).num_robots == 2
    assert make_problem(lambda seed, num_robots, **settings: still(**settings), 2, gap=0.5) == lanes(0, 2, gap=0.5)


def test_a_setting_that_is_needed_is_asked_for() -> None:
    with pytest.raises(TypeError, match=r"scenario '<lambda>': missing a required argument: 'gap'; give it by name"):
        make_problem(lambda seed, num_robots, gap: still(gap=gap), 2)


@pytest.mark.parametrize("make", ["parallel", "joint", "batched"])
def test_every_environment_takes_a_callable_and_a_file(make: str, tmp_path: Path) -> None:
    save_problem(lanes(3, 2), tmp_path / "two.yaml")

    def problem_of(scenario: Any, **settings: Any) -> Problem:
        if make == "parallel":
            return navigation_v0.parallel_env(scenario, **settings).problem
        if make == "joint":
            return gymnasium.make("d4orm/Navigation-v0", scenario=scenario, **settings).unwrapped.problem
        kwargs = {"num_envs": 2, "vectorization_mode": "vector_entry_point", **settings}
        return gymnasium.make_vec("d4orm/Navigation-v0", scenario=scenario, **kwargs).unwrapped.problem

    assert problem_of(lanes, num_robots=3, seed=4, gap=0.9) == lanes(4, 3, gap=0.9)
    assert problem_of(tmp_path / "two.yaml", num_robots=2) == problem_of(str(tmp_path / "two.yaml")) == lanes(3, 2)
    with pytest.raises(TypeError, match=r"scenario 'lanes' takes no argument 'gab'; it takes .*did you mean 'gap'"):
        problem_of(lanes, gab=1)


@pytest.mark.parametrize(
    ("scenario", "message"),
    [
        (lambda seed, num_robots: None, "scenario '<lambda>' returned None; it must return a d4orm_env.Problem"),
        (lambda seed, num_robots: lanes(0, 3), "returned a problem of 3 robots where num_robots is 2"),
        (lambda seed: lanes(0, 2), r"must be a callable \(seed, num_robots, \*\*settings\)"),
        (
            lambda num_robots=2, seed=0: lanes(seed, num_robots),
            r"takes \(num_robots, seed\); it must be .* in that order",
        ),
        (lambda rows, seed: lanes(seed, 2), r"takes \(rows, seed\); it must be a callable \(seed, num_robots"),
        (lambda *, seed, num_robots: lanes(seed, num_robots), "the first two by position"),
        ("nothing_here:lanes", "scenario 'nothing_here:lanes' cannot be imported .*nothing_here"),
        ("json:lanes", "'json:lanes' names nothing: json has no 'lanes'"),
        ("json:", "scenario 'json:' is no import path; give package.module:Name"),
        (5, "scenario 5 is unknown; choose one of circle"),
        ("team.txt", "or give a .yaml file, package.module:Name or folder/file.py:Name"),
    ],
)
def test_what_is_no_scenario_is_named(scenario: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message) as error:
        make_problem(scenario, num_robots=2)
    assert "\n" not in str(error.value)


def test_a_file_has_its_own_team_and_imports_nothing(tmp_path: Path) -> None:
    save_problem(lanes(3, 2), tmp_path / "two.yaml")
    with pytest.raises(ValueError, match=r"two\.yaml has 2 robots, and num_robots is 3; leave num_robots out"):
        make_problem(tmp_path / "two.yaml", num_robots=3)
    with pytest.raises(TypeError, match="takes no argument 'radius'"):
        make_problem(tmp_path / "two.yaml", radius=0.1)
    for other in ("json:loads", str(tmp_path / "two.yaml")):
        (tmp_path / "one.yaml").write_text(f"version: 1\nscenario: '{other}'\n")
        with pytest.raises(ValueError, match="is unknown; choose one of circle"):
            load_problem(tmp_path / "one.yaml")


@pytest.mark.usefixtures("registered")
def test_registered_scenarios_are_scenarios_like_any(tmp_path: Path) -> None:
    register_scenario("lanes", lanes)
    assert "lanes" in list_scenarios()
    assert describe_scenario("lanes").startswith("Robots side by side")
    assert make_problem("lanes", 3, seed=2, gap=0.7) == lanes(2, 3, gap=0.7)
    (tmp_path / "short.yaml").write_text("version: 1\nscenario: lanes\nnum_robots: 3\n")
    assert load_problem(tmp_path / "short.yaml") == lanes(0, 3)
    for name in ("lanes", "circle"):
        with pytest.raises(ValueError, match=f"scenario name '{name}' is taken; register yours under another"):
            register_scenario(name, still)
    for name in ("", "a:b", "a.yaml", 3):
        with pytest.raises(ValueError, match="scenario name"):
            register_scenario(name, still)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="must be a callable"):
        register_scenario("none", None)  # type: ignore[arg-type]
    assert "none" not in list_scenarios()


@pytest.mark.usefixtures("registered")
def test_entry_points_are_loaded_when_asked_for(monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    here = __name__
    Offered(
        monkeypatch, lanes=f"{here}:lanes", broken="not_installed:lanes", twice=f"{here}:lanes", twice_=f"{here}:still"
    )
    assert {"circle", "lanes", "broken", "twice"} <= {*list_scenarios()}
    assert make_problem("lanes", 3, seed=2) == make_problem("lanes", 3, seed=2) == lanes(2, 3)
    with pytest.raises(ValueError, match=r"scenario 'broken': 'not_installed:lanes' .* \(ModuleNotFound"):
        make_problem("broken")
    with pytest.raises(ValueError, match=r"scenario name 'twice' is claimed by .* and "):
        make_problem("twice")
    with pytest.raises(SystemExit) as end:
        main(["scenarios"])
    assert end.value.code == 0
    listed = capsys.readouterr().out
    assert "Robots side by side" in listed
    assert "not_installed" in listed


def test_the_command_line_takes_an_import_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "brought.py").write_text(
        "from d4orm_env import make_problem\n\npair = lambda seed, num_robots: make_problem('circle', num_robots)\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", [*__import__("sys").path])
    with pytest.raises(SystemExit) as end:
        main(["run", "--scenario", "brought:pair", "--num-robots", "2", "--policy", "go-to-goal", "--quiet"])
    assert end.value.code in (0, 1)
    with pytest.raises(SystemExit) as end:
        main(["plan", "--scenario", "brought:trio"])
    assert end.value.code == 2
    error = capsys.readouterr().err
    assert "scenario 'brought:trio' names nothing" in error
    assert error.count("\n") == 1


def test_evaluate_takes_callables(tmp_path: Path) -> None:
    (row,) = evaluate(
        policies=["go-to-goal"], scenarios=[still], num_robots=[2], seeds=range(2), out=tmp_path / "store", workers=1
    )
    assert (row.scenario, row.num_robots, row.trials, row.errors, row.rate) == ("still", 2, 2, 0, 1.0)


def test_what_draws_draws_anew_and_the_seed_says_what() -> None:
    env = navigation_v0.parallel_env(lanes, 3, seed=7)
    assert env.problem == lanes(7, 3)
    seen = []
    for seed in (0, None, 1, 0, None, 1):
        env.reset(seed=seed)
        seen.append(env.problem)
    assert seen[:3] == seen[3:]
    assert len({problem.digest for problem in seen}) == 3
    assert lanes(7, 3) not in seen
    kept = navigation_v0.parallel_env(lanes, 3, seed=7, randomize_instance=False)
    for seed in (0, 1):
        kept.reset(seed=seed)
        assert kept.problem == lanes(7, 3)
    same = navigation_v0.parallel_env(still)
    same.reset(seed=1)
    assert same.problem == still()
    with pytest.raises(ValueError, match="scenario 'still' is the same for every seed"):
        navigation_v0.parallel_env(still, randomize_instance=True)


@pytest.mark.parametrize("scenario", ["random", "circle"])
def test_built_in_scenarios_draw_anew_where_they_draw(scenario: str) -> None:
    env = navigation_v0.parallel_env(scenario, 3)
    env.reset(seed=0)
    first = env.problem
    env.reset(seed=1)
    assert (env.problem == first) == (scenario == "circle")
    assert pickle.loads(pickle.dumps(env)).problem == env.problem


def test_an_open_loop_planner_plans_for_the_problem_of_the_episode() -> None:
    env = navigation_v0.parallel_env(lanes, 2)
    planner = make_planner("d4orm", num_samples=64, max_iterations=2)
    episode = run_episode(env, OpenLoop(planner), seed=3)
    assert env.problem != lanes(0, 2)
    np.testing.assert_array_equal(episode.trajectory.states[0], env.problem.start)
    plan = planner.solve(lanes(0, 2), max_iterations=1)
    with pytest.raises(ValueError, match="keep one with randomize_instance=False"):
        run_episode(env, OpenLoop(plan=plan), seed=4)
    run_episode(navigation_v0.parallel_env(lanes, 2, randomize_instance=False), OpenLoop(plan=plan), seed=4)


def test_worlds_of_a_batch_have_obstacles_of_their_own() -> None:
    env = gymnasium.make_vec(
        "d4orm/Navigation-v0", num_envs=5, vectorization_mode="vector_entry_point", scenario=poles, num_robots=3,
        max_cycles=6,
    )  # fmt: skip
    reference = gymnasium.make_vec(
        "d4orm/Navigation-v0", num_envs=5, vectorization_mode="sync", scenario=poles, num_robots=3, max_cycles=6,
        vector_kwargs={"autoreset_mode": env.metadata["autoreset_mode"]},
    )  # fmt: skip
    observations, _ = env.reset(seed=3)
    np.testing.assert_allclose(observations, reference.reset(seed=3)[0], atol=1e-6)
    assert len({row.tobytes() for row in observations}) == 5
    for step in range(9):
        actions = np.random.default_rng(step).uniform(-1, 1, env.action_space.shape).astype(np.float32)
        got, expected = env.step(actions), reference.step(actions)
        for one, other in zip(got[:4], expected[:4]):
            np.testing.assert_allclose(one, other, atol=1e-5)


def test_teams_of_a_batch_are_alike() -> None:
    def sizes(seed: int, num_robots: int) -> Problem:
        return Problem(Team(("velocity2d",), radius=0.1 + 0.1 / (1 + seed)), [[0, 0]], [[1, 0]])

    with pytest.raises(ValueError, match="instances of scenario 'sizes' differ in their radius, wall_radius,"):
        gymnasium.make_vec(
            "d4orm/Navigation-v0", num_envs=2, vectorization_mode="vector_entry_point", scenario=sizes, num_robots=1
        )
