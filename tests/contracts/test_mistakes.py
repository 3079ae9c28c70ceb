"""Mistakes that people new to the package made, each with the remedy that its message must name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest

from d4orm_env import (
    Problem,
    Team,
    World,
    load_dynobench,
    load_map,
    load_problem,
    make_problem,
    navigation_v0,
    rollout,
    save_problem,
    verify,
)
from d4orm_env.disturbances import MovingObstacle, load_pedestrians
from d4orm_env.envs.rewards import TrainingReward
from d4orm_env.footprints import Box, Train
from d4orm_env.render import save_animation, save_picture
from d4orm_env.scenarios import load_cl_mapf
from d4orm_planners import (
    Controller,
    Episode,
    Plan,
    Policy,
    evaluate,
    load_plan,
    make_planner,
    make_policy,
    run_episode,
)
from d4orm_planners.base.adapters import SharedPolicy, from_sb3, from_torch
from d4orm_planners.evaluation.evaluate import run_shard
from d4orm_planners.evaluation.study import Study


class Module:
    """Called as a torch module is, with anything."""

    forward = None

    def __call__(self, *given: object) -> object:
        raise RuntimeError("shapes cannot be multiplied")


class Spring(Policy):
    """A policy with a setting that is a number."""

    def __init__(self, gain: float = 1.0) -> None:
        self.gain = gain

    def act(self, observations: Any, state: Any) -> Any:
        return {agent: -self.gain * seen[:2] for agent, seen in observations.items()}


def make_vec() -> Any:
    return gymnasium.make_vec("d4orm/Navigation-v0", num_envs=2, vectorization_mode="vector_entry_point")


def episode() -> Episode:
    """Two robots at rest for a step."""
    return run_episode(navigation_v0.parallel_env(problem=PROBLEM.replace(horizon=1)), "go-to-goal")


def episode_plan() -> Plan:
    """A plan of two robots."""
    return make_planner(engine="cpu").solve(PROBLEM)


def controller() -> Controller:
    """One that has a team."""
    controller = Controller("orca")
    controller.begin(PROBLEM, PROBLEM.start)
    return controller


DRIVE = Team(("differential_drive",))
PROBLEM = make_problem("circle", num_robots=2)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Problem(DRIVE, [[0, 0, 180, 0]], [[2, 0]]), "180 rad; .* convert degrees by numpy.deg2rad"),
        (lambda: Problem(DRIVE, [[0, 0]], [[2, 0]]), r"expected \(1, 4\): px, py, heading, speed"),
        (lambda: navigation_v0.parallel_env(lifelong="yes"), "lifelong is 'yes'; it must be True or False"),
        (lambda: navigation_v0.parallel_env(ray_range=3.0), "these robots have none; give observed_rays"),
        (lambda: navigation_v0.parallel_env(PROBLEM), "give environments problem=..., and planners the problem itself"),
        (lambda: navigation_v0.parallel_env(max_steps=9), "did you mean 'max_cycles'"),
        (lambda: make_problem("circle", robots=4), "did you mean 'num_robots'"),
        (lambda: make_problem("circle", model="bicycle"), "did you mean 'car'"),
        (lambda: make_policy(SimpleNamespace(act=print)), "has act and lacks reset; define it, or subclass"),
        (lambda: make_policy(SimpleNamespace(reset=print)), "has reset and lacks act; define it, or subclass"),
        (lambda: make_policy(Module()), r"give it as from_torch\(module\)"),
        (
            lambda: run_episode(navigation_v0.parallel_env(problem=PROBLEM), SharedPolicy(Module(), None)),
            r"fails on observations of shape \(2, .*cannot be multiplied",
        ),
        (lambda: make_policy(SimpleNamespace(predict=print)), r"is a model; give from_sb3\(model\), from d4orm_pl"),
        (lambda: from_sb3("joint.zip"), "give a model of Stable-Baselines3, as PPO.load"),
        (lambda: verify(PROBLEM, SimpleNamespace(controls=0)), "not SimpleNamespace; give its controls"),
        (lambda: from_torch("net.pt"), "the model is 'net.pt'; load it first"),
        (lambda: run_episode(make_vec(), "orca"), r"num_envs=2\); give the environment of one team first, as navig"),
        (lambda: run_episode(navigation_v0.env("circle"), "orca"), "give the environment of one team first"),
        (lambda: make_policy(Spring, gain="stiff"), "gain of policy 'Spring' is 'stiff'; it must be a float"),
        (lambda: load_problem("none.yaml"), r"none.yaml: cannot be read \(No such file .*\); check name and permiss"),
        (lambda: Team(("unicycle",) * 3, footprint=[0.3, 0.2]), "has 2 entries for 3 robots; give one for each, such"),
        (lambda: make_policy("orca").reset(PROBLEM), "give an environment, such as parallel_env"),
        (lambda: Controller("orca").begin("circle", PROBLEM.start), "problem is 'circle'; give a Problem"),
        (lambda: verify(None, []), "problem is None; give a Problem"),
        (lambda: rollout(5, []), "problem is 5; give a Problem"),
        (lambda: save_problem(5, "problem.yaml"), "problem is 5; give a Problem"),
        (lambda: navigation_v0.parallel_env(problem=5), "problem is 5; give a Problem"),
        (lambda: controller().step(PROBLEM.start, "now"), "time is 'now'; give the seconds of one clock"),
        (lambda: controller().step(PROBLEM.start, np.nan), "time is nan; give the seconds of one clock"),
        (lambda: controller().step("abc", 0.0), "states must be an array of numbers, not 'abc'"),
        (lambda: PROBLEM.replace(world="open"), "world is 'open'; give a World"),
        (lambda: Team(("holonomic2d",) * 2, footprint="box"), "footprint of robot_0 is 'box'; give one such as"),
        (lambda: Train(Box(0.3, 0.2), Box(0.3, 0.2)), "trailers of Train are Box.*give a list"),
        (lambda: TrainingReward(contact=-3), "contact of TrainingReward is -3; it must be zero or more"),
        (lambda: MovingObstacle([2, 1], [[0, 0], [1, 1]]), r"times are \[2.0, 1.0\]; give two or more that increase"),
        (lambda: verify(PROBLEM, np.zeros((7, 2, 2))), r"problem.replace\(horizon=7\)"),
        (
            lambda: make_problem("circle", radius=[[0.1], [0.1, 0.2]]),
            r"radius must be a number or one per robot, not \[\[0.1\]",
        ),
        (
            lambda: run_episode(navigation_v0.parallel_env(problem=PROBLEM), lambda seen: seen),
            "it must be 2 finite num",
        ),
        (lambda: make_vec().reset(options={"reset_mask": np.ones(99)}), "must be a NumPy array of bool, not array"),
        (lambda: make_vec().reset(seed=np.array(1)), r"seed must be a whole number, not array\(1\)"),
        (lambda: Team(np.zeros((9, 9))), "models must be a sequence of model names, not array"),
        (lambda: episode_plan().sample(max_acceleration=np.zeros((9, 9))), "max_acceleration must be one number or"),
        (lambda: episode_plan().export([], "out"), r"format \[\] is unknown; choose one of csv"),
        (lambda: make_planner("mapf").solve(PROBLEM, watcher=3), "watcher is 3; give a function of a DenoisingStep"),
        (lambda: make_planner().solve(PROBLEM, callback=3), "callback is 3; give a function of an IterationRecord"),
        (lambda: make_policy("d4orm-c2f", warm_start="nope"), "policy 'nope' is unknown"),
        (lambda: episode_plan().plot(3), "axes is 3; give axes of Matplotlib"),
        (lambda: World(circles=[[0, 0]]), r"circles has shape \(1, 2\); expected \(any, 3\): x, y, radius"),
        (lambda: World(boxes=[0, 0, 1]), r"expected \(any, 4\): least x, least y, greatest x, greatest y"),
        (lambda: World(3, cylinders=[[0, 0, 0, 1]]), r"expected \(any, 3\): x, y, radius"),
    ],
)
def test_what_python_says(call: Callable[[], object], message: str) -> None:
    with pytest.raises((ValueError, TypeError), match=message) as said:
        call()
    assert "\n" not in str(said.value)


@pytest.mark.parametrize("path", [5, None, ""])
@pytest.mark.parametrize(
    ("call", "what"),
    [
        (load_plan, "a plan file"),
        (load_problem, "a scenario file"),
        (load_map, "a map"),
        (load_pedestrians, "a file of pedestrians"),
        (load_dynobench, "a problem of dynobench"),
        (load_cl_mapf, "a problem of CL-CBS or CSDO"),
        (lambda path: save_problem(PROBLEM, path), "a scenario file"),
        (lambda path: episode().to_html(path), "a replay"),
        (lambda path: save_picture(PROBLEM, episode().trajectory, path), "a picture"),
        (lambda path: save_animation(PROBLEM, episode().trajectory, path), "an animation"),
        (
            lambda path: evaluate(policies=["go-to-goal"], scenarios=["circle"], seeds=[0], out=path),
            "the folder of results",
        ),
    ],
)
def test_what_is_no_path_is_named(call: Callable[[Any], object], what: str, path: object) -> None:
    with pytest.raises(ValueError, match=f"^the path of {what} must be text or a path, not {path!r}$"):
        call(path)


@pytest.mark.parametrize(
    "call",
    [
        lambda path: evaluate(policies=["go-to-goal"], scenarios=["circle"], seeds=[0], out=path),
        lambda path: run_shard(Study(policies=["go-to-goal"], seeds=[0]), path, (1, 1)),
    ],
    ids=["evaluate", "run_shard"],
)
def test_a_folder_that_cannot_be_made_is_named(call: Callable[[Any], object], tmp_path: Path) -> None:
    taken = tmp_path / "taken"
    taken.write_text("mine")
    with pytest.raises(ValueError, match=r"taken.* cannot be made \(.*\); choose another$"):
        call(taken)
    assert [path.name for path in tmp_path.iterdir()] == ["taken"]


def test_a_goal_too_far_for_the_horizon_is_told() -> None:
    problem = make_problem("circle", num_robots=2).replace(horizon=9)
    plan = make_planner("d4orm", max_iterations=1, num_samples=8).solve(problem)
    assert "needs 50 steps at full speed, where the horizon is 9; give a longer horizon" in plan.failures["robot_0"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("robots: []", "version: this field is missing; give version: 1"),
        ("version: 1\nrobots: []", r"robots: \[\] has 0 entries; give at least 1$"),
        (
            "version: 1\nrobots: [{model: car, start: [0, 0], gaol: [1, 1]}]",
            "gaol: unknown field.* did you mean 'goal'",
        ),
        (
            "version: 1\nrobots: [{model: car, start: [0, 0], goal: [3, 3]}]\nworld: {circles: [[1, 1, 0.2]]}",
            "expected the fields center, radius, not",
        ),
    ],
)
def test_what_a_scenario_file_says(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "scenario.yaml"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        load_problem(path)


def test_a_photograph_of_a_floor_is_to_be_converted(tmp_path: Path) -> None:
    path = tmp_path / "floor.jpg"
    path.write_bytes(b"\xff\xd8\xff")
    with pytest.raises(ValueError, match=r"no \.png or \.pgm image, .* or convert it"):
        load_map(path, resolution=0.1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("plan", "yard.yaml"), "a scenario or its file goes by --scenario"),
        (("run", "--planner", "d4orm"), "here it is --policy"),
        (("plan", "--policy", "d4orm"), "here it is --planner"),
        (("run", "--set", "num_samples=64"), "--policy d4orm:num_samples=64"),
        (("evaluate", "--policy", "orca,d4orm:num_samples=64"), "give --policy once for each"),
        (("evaluate", "--policy", "orca,label=x"), "settings stand behind one policy"),
    ],
)
def test_what_the_command_line_says(d4orm: Callable[..., Any], arguments: tuple[str, ...], message: str) -> None:
    outcome = d4orm(*arguments)
    assert outcome.status == 2
    assert message in outcome.err


def test_a_run_says_why_its_plan_is_no_solution(d4orm: Callable[..., Any]) -> None:
    outcome = d4orm("run", "--policy", "d4orm:max_iterations=1,num_samples=2,num_steps=1", "-k", "16")
    assert outcome.status == 1
    assert "no solution found (iteration limit after 1 iteration)" in outcome.err
