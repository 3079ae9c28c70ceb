"""Kinds of bad input that every public entry refuses alike: what is no number, and files that cannot be written."""

from __future__ import annotations

import errno
import re
from collections.abc import Callable, Iterator
from functools import cache
from inspect import signature
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from d4orm_env import (
    Problem,
    Team,
    World,
    disturbances,
    make_problem,
    make_team,
    navigation_v0,
    rollout,
    save_problem,
    verify,
)
from d4orm_env.disturbances import Disturbance
from d4orm_env.footprints import Box, Capsule, Disc, Ellipsoid, Polygon
from d4orm_env.render import save_animation, save_picture
from d4orm_planners import Controller, Plan, evaluate, make_planner, make_policy, register_planner, register_policy
from d4orm_planners.evaluation import TrialStore

PROBLEM = Problem(Team(("holonomic2d",) * 2), [[-1, 0, 0, 0], [1, 1, 0, 0]], [[1, 0], [-1, 1]], World(), horizon=60)
CONTROLS = (PROBLEM.horizon, PROBLEM.num_robots, PROBLEM.control_size)

TEXT = ("0.1", b"1", np.array("0.1"), np.array(["1", "1"]), np.array(["1", "1"], object), ["1", "1"])
TRUTH = (True, np.True_, np.array([True, True]), [True, True], torch.ones(2, dtype=torch.bool))


@cache
def plan() -> Plan:
    return make_planner(engine="cpu").solve(PROBLEM)


def environment() -> Any:
    env = navigation_v0.parallel_env(problem=PROBLEM)
    env.reset(seed=0)
    return env


def filled(value: Any, shape: tuple[int, ...]) -> Any:
    """An array of a shape with the first of what is given."""
    if isinstance(value, torch.Tensor):
        return value[:1].expand(shape)
    return np.broadcast_to(np.ravel(value)[:1], shape)


def act(value: Any) -> None:
    env = environment()
    env.step({agent: filled(value, (2,)) for agent in env.agents})


SETTINGS = (
    "dt", "margin", "radius", "horizon", "goal_radius", "goal_speed", "bounds", "max_speed", "max_acceleration", "lag",
    "collision_penalty", "seed", "num_robots", "num_obstacles", "diameter",
)  # fmt: skip
ENTRIES: dict[str, Callable[[Any], object]] = {
    **{name: lambda value, name=name: make_problem("circle", **{name: value}) for name in SETTINGS},
    "size": lambda value: make_problem("random", size=value),
    "start": lambda value: PROBLEM.replace(start=filled(value, (2, 4))),
    "goal": lambda value: PROBLEM.with_state(PROBLEM.start, filled(value, (2, 2))),
    "circles": lambda value: World(circles=filled(value, (1, 3)) if np.ndim(value) else [[value, 0, 0.1]]),
    "positions": lambda value: World().clearance(filled(value, (2,))),
    "Disc": Disc,
    "Box": lambda value: Box(0.5, 0.2, value),
    "Capsule": lambda value: Capsule(value, 0.2),
    "Ellipsoid": lambda value: Ellipsoid(0.1, value, 0.1),
    "corners": lambda value: Polygon([(0, 0), (1, 0), (value, 1)]),
    "control_noise_std": lambda value: navigation_v0.parallel_env(control_noise_std=value),
    "observed_rays": lambda value: navigation_v0.parallel_env(observed_rays=value),
    "states": lambda value: environment().unwrapped.set_state(filled(value, (2, 4))),
    "robot_0": act,
    "controls of rollout": lambda value: rollout(PROBLEM, filled(value, CONTROLS)),
    "controls of verify": lambda value: verify(PROBLEM, filled(value, CONTROLS)),
    "initial_controls": lambda value: make_planner().solve(PROBLEM, initial_controls=filled(value, CONTROLS)),
    "num_samples": lambda value: make_planner("d4orm", num_samples=value),
    "temperature": lambda value: make_policy("d4orm-c2f", temperature=value),
    "time_limit": lambda value: make_planner().solve(PROBLEM, time_limit=value),
    "reserve": lambda value: Controller("orca", reserve=value),
    "rate": lambda value: plan().sample(rate=value),
    "max_jerk": lambda value: plan().sample(max_jerk=value),
    "height": lambda value: plan().export("csv", "out", height=value),
}


def disturbance_classes() -> Iterator[type[Disturbance]]:
    for name in disturbances.__all__:
        kind = getattr(disturbances, name)
        if isinstance(kind, type) and issubclass(kind, Disturbance) and kind is not Disturbance:
            yield kind


ENTRIES |= {
    kind.__name__: lambda value, kind=kind: kind(**dict.fromkeys([*signature(kind).parameters][:1], value))
    for kind in disturbance_classes()
    if kind is not disturbances.MovingObstacle
}


@pytest.mark.parametrize("value", [*TEXT, *TRUTH], ids=repr)
@pytest.mark.parametrize("name", ENTRIES)
def test_text_and_truth_are_no_numbers(name: str, value: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=name.split()[0]) as said:
        ENTRIES[name](value)
    assert "\n" not in str(said.value)
    assert not list(tmp_path.iterdir())


NAMES: dict[str, Callable[[Any], object]] = {
    "arrival": lambda value: make_problem("circle", arrival=value),
    "engine": lambda value: rollout(PROBLEM, np.zeros(CONTROLS), engine=value),
    "render_mode": lambda value: navigation_v0.parallel_env(render_mode=value),
    "progress": lambda value: navigation_v0.parallel_env(progress=value),
    "mode": lambda value: Controller("orca", mode=value),
    "path": lambda value: plan().save(value),
    "planner name": lambda value: register_planner(value, "package:Name"),
    "policy name": lambda value: register_policy(value, "package:Name"),
    "dimension": World,
}


@pytest.mark.parametrize("value", [np.zeros((2, 2)), np.array(["cpu", "dock"]), [1], {}, 9, list(range(99))], ids=repr)
@pytest.mark.parametrize("name", NAMES)
def test_what_is_no_name_is_refused_in_a_line(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"{name} .*(is|not) ") as said:
        NAMES[name](value)
    assert "\n" not in str(said.value)
    assert "ambiguous" not in str(said.value)
    assert len(str(said.value)) < 250


@pytest.mark.parametrize("name", ["seeds", "control_noise_std"])
def test_bytes_are_no_list_of_numbers(name: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=f"{name} .*b'x'"):
        evaluate(["go-to-goal"], "circle", **{"seeds": [0], name: b"x"}, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_team_too_large_is_refused_before_it_is_made() -> None:
    for number in (10**400, 10**9):
        with pytest.raises(ValueError, match=r"num_robots is .* at most 10000"):
            make_team("crazyflie", number)


def test_a_reward_may_be_a_truth_value() -> None:
    env = navigation_v0.parallel_env(problem=PROBLEM, reward=lambda step: step.arrived)
    env.reset(seed=0)
    assert env.step({agent: np.zeros(2) for agent in env.agents})[1] == {"robot_0": 0.0, "robot_1": 0.0}


WRITERS: dict[str, Callable[[Path], object]] = {
    "plan.npz": lambda path: plan().save(path),
    "plan.html": lambda path: plan().to_html(path),
    "result.yaml": lambda path: plan().to_dynobench(path),
    "problem.yaml": lambda path: save_problem(PROBLEM, path),
    "picture.png": lambda path: save_picture(PROBLEM, plan().trajectory, path),
    "film.gif": lambda path: save_animation(PROBLEM, plan().trajectory, path, max_frames=2),
}
FOLDER_WRITERS: dict[str, Callable[[Path], object]] = {
    form: lambda path, form=form: plan().export(form, path, height=1.0) for form in ("csv", "crazyswarm2")
}


@pytest.mark.parametrize("name", WRITERS)
def test_the_folder_of_a_file_is_not_made(name: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / name).mkdir()
    for folder, message in (("missing", "does not exist; create it"), ("file", "does not"), ("taken", "is a folder")):
        with pytest.raises(ValueError, match=message):
            WRITERS[name](tmp_path / folder / name)
    assert sorted(path.name for path in tmp_path.rglob("*")) == sorted(["file", "taken", name])


@pytest.mark.parametrize("name", FOLDER_WRITERS)
def test_a_folder_for_files_is_made_with_those_it_is_in(name: str, tmp_path: Path) -> None:
    FOLDER_WRITERS[name](tmp_path / "missing" / "out")
    assert list((tmp_path / "missing" / "out").iterdir())
    (tmp_path / "file").write_text("mine")
    with pytest.raises(ValueError, match=r"cannot be made .*; choose another|is a file; give a folder"):
        FOLDER_WRITERS[name](tmp_path / "file" / "out")


@pytest.mark.parametrize("name", [*WRITERS, *FOLDER_WRITERS])
def test_a_system_that_does_not_write_is_bad_input(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plan()

    def refuse(*given: object, **named: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "replace", refuse)
    message = rf"{re.escape(str(tmp_path / name))} cannot be written: No space left on device; free some space"
    for kind in (ValueError, OSError):
        with pytest.raises(kind, match=message):
            (WRITERS | FOLDER_WRITERS)[name](tmp_path / name)
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


def test_an_unknown_agent_has_no_space() -> None:
    env, turns = environment(), navigation_v0.env("circle", num_robots=2)
    turns.reset(seed=0)
    for ask in (env.observation_space, env.action_space, turns.observation_space, turns.action_space, turns.observe):
        for agent in ("robot_7", 0, None, ["robot_0"]):
            with pytest.raises(ValueError, match="is unknown; the agents are robot_0 to robot_1"):
                ask(agent)


def test_the_rate_that_is_asked_for_does() -> None:
    with pytest.raises(ValueError, match="give at least") as said:
        plan().sample(rate=0.01)
    assert len(plan().sample(rate=float(str(said.value).split()[-1])).time) == 3


@pytest.mark.parametrize("name", ["nope", "empty"])
def test_a_store_that_is_not_there_is_named_as_it_was_given(name: str, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    for kind in (ValueError, FileNotFoundError):
        with pytest.raises(kind, match=rf"there is no store of trials at {tmp_path / name}; `d4orm evaluate` makes"):
            TrialStore.existing(tmp_path / name)
