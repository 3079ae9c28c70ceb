"""Teams as rigid bodies in MuJoCo: the same interface, and motion as mechanics has it."""

from __future__ import annotations

import copy
import math
import pickle
from functools import partial
from typing import Any

import numpy as np
import pytest
from disturbance_support import CASES
from env_support import act, line_problem, mixed_problem, sampled_actions, straight_drive
from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test, render_test, seed_test
from pettingzoo.test.state_test import state_test

from d4orm_env import mujoco, navigation_v0
from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.core.world import World
from d4orm_env.disturbances import Delay, Drag, Intruder, Push, Stall, StateNoise
from d4orm_env.envs.joint_state import split_state
from d4orm_env.footprints import Box, Capsule, Footprint, Polygon
from d4orm_env.mujoco import Physics, environment
from d4orm_env.mujoco.bodies import TeamBodies
from d4orm_planners import run_episode
from d4orm_planners.base.episode import open_env

MODELS = ("holonomic2d", "velocity2d", "differential_drive", "unicycle", "unicycle1", "unicycle2")
CLUTTER = World(
    circles=[[2, 3, 0.4]],
    boxes=[[2, -3, 3, -2]],
    polygons=[[[1.5, 4], [3, 4], [3, 5], [2.6, 4.4]]],
    lower=[-2, -4],
    upper=[6, 6],
)
VARIANTS: dict[str, dict[str, Any]] = {
    **{model: {"scenario": "circle", "num_robots": 2, "model": model} for model in MODELS},
    "early-arrivals": {"problem": line_problem([0.3, 0.5, 0.8], "holonomic2d", goal_radius=0.25)},
    "mixed-team": {"problem": mixed_problem().replace(world=CLUTTER)},
    "stay": {"problem": line_problem([0.3, 0.5], goal_radius=0.25, arrival="stay")},
    "lifelong": {"problem": line_problem([0.3, 0.5], goal_radius=0.25), "lifelong": True},
    "new-instances": {"scenario": "random", "num_robots": 2, "randomize_instance": True},
    "disturbed": {"scenario": "circle", "num_robots": 2, "model": "differential_drive", "control_noise_std": 0.2,
                  "disturbances": [Delay(1), Push(2.0, 0.4), Intruder(2, 0.5), StateNoise(0.02), Stall(0.5, 1.0)]},
}  # fmt: skip
VARIANT = pytest.mark.parametrize("case", [pytest.param(case, id=name) for name, case in VARIANTS.items()])


@VARIANT
def test_pettingzoos_suite(case: dict[str, Any]) -> None:
    parallel_api_test(mujoco.parallel_env(**case), num_cycles=40)
    parallel_seed_test(partial(mujoco.parallel_env, **case), num_cycles=12)
    api_test(mujoco.env(**case), num_cycles=24)
    seed_test(partial(mujoco.env, **case), num_cycles=24)
    state_test(mujoco.env(**case), mujoco.parallel_env(**case), num_cycles=24)


def test_pettingzoo_renders_it() -> None:
    render_test(partial(mujoco.env, scenario="circle", num_robots=2))


@VARIANT
def test_its_interface_is_that_of_the_other_environment(case: dict[str, Any]) -> None:
    ours, theirs = navigation_v0.parallel_env(**case), mujoco.parallel_env(**case)
    first, second = ours.reset(seed=3), theirs.reset(seed=3)
    assert first[1] == second[1]
    for agent in ours.possible_agents:
        assert ours.action_space(agent) == theirs.action_space(agent)
        assert first[0][agent].shape == second[0][agent].shape
    assert np.array_equal(ours.true_state(), theirs.true_state())
    actions = sampled_actions(ours)
    for one, other in zip(ours.step(actions), theirs.step(actions), strict=True):
        assert one.keys() == other.keys()


@VARIANT
def test_what_it_reports_is_inside_its_spaces(case: dict[str, Any]) -> None:
    env = mujoco.parallel_env(**case)
    env.reset(seed=1)
    for agent in env.possible_agents:
        env.action_space(agent).seed(1)
    while env.agents and env.metrics()["steps"] < 50:
        observations = env.step(sampled_actions(env))[0]
        assert env.state_space.contains(env.state())
        assert all(env.observation_space(agent).contains(seen) for agent, seen in observations.items())


@VARIANT
def test_a_seed_decides_everything(case: dict[str, Any]) -> None:
    env = mujoco.parallel_env(**case)
    env.reset(seed=4)
    controls = 0.7 * straight_drive(env.problem)[0]

    def run(other: Any) -> list[bytes]:
        return [other.step(act(other, controls)) and other.state().tobytes() for _ in range(15) if other.agents]

    first = run(env)
    env.reset(seed=4)
    twins = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
    assert all(run(other) == first for other in (env, *twins))


def alone(model: str, state: list[float], **world: Any) -> Any:
    """An environment of one robot whose goal is far away, begun."""
    problem = Problem(Team((model,)), [state], [[5.0, 5.0]], World(**world))
    env = mujoco.parallel_env(problem=problem, physics=Physics(drag=0.5))
    env.reset(seed=0)
    return env


def driven(env: Any, control: list[float], steps: int) -> np.ndarray:
    """``(n,)`` the state of its robot after so many steps under one control."""
    for _ in range(steps):
        env.step({"robot_0": np.array(control, np.float32)})
    state: np.ndarray = split_state(env.problem, env.state()).states[0]
    return state


def test_a_puck_under_constant_force_moves_as_a_body_with_drag_does() -> None:
    x, y, speed, across = driven(alone("holonomic2d", [0, 0, 0, 0]), [0.5, 0], 15)
    # dv/dt = 0.5 - 0.5 v from rest, after 1.5 s
    assert speed == pytest.approx(1 - math.exp(-0.75), abs=3e-3)
    assert x == pytest.approx(1.5 - (1 - math.exp(-0.75)) / 0.5, abs=5e-3)
    assert (y, across) == pytest.approx((0, 0), abs=1e-6)


def test_a_puck_is_pushed_no_faster_than_it_may_be() -> None:
    assert 0.9 < driven(alone("holonomic2d", [0, 0, 0, 0]), [1.0, 0], 40)[2] <= 1.0


def test_a_drive_turns_on_the_spot() -> None:
    x, y, heading, speed = driven(alone("differential_drive", [0, 0, 0.3, 0]), [1.0, 0], 20)
    assert heading - 0.3 == pytest.approx(2.0, abs=0.08)
    assert (x, y, speed) == pytest.approx((0, 0, 0), abs=5e-3)


def test_a_second_order_unicycle_turns_faster_up_to_its_limits() -> None:
    problem = Problem(Team(("unicycle2",), own_limits={"max_right_turn_rate": 0.8}), [[0] * 5], [[5, 5]])
    env = mujoco.parallel_env(problem=problem)
    env.reset(seed=0)
    x, y, heading, speed, turn_rate = driven(env, [0.0, 0.5], 10)
    assert (heading, turn_rate) == pytest.approx((0.25, 0.5), abs=0.03)
    assert (x, y, speed) == pytest.approx((0, 0, 0), abs=5e-3)
    assert driven(env, [0.0, -1.0], 20)[4] == pytest.approx(-0.8, abs=0.03)


def test_headings_wind_up() -> None:
    assert driven(alone("unicycle", [0, 0, 0]), [0.0, -1.5], 80)[2] == pytest.approx(-12.0, abs=0.2)


@pytest.mark.parametrize(("own", "speed"), [({}, -1.0), ({"max_reverse_speed": 0.3}, -0.3)])
def test_a_drive_reverses_no_faster_than_it_may(own: dict[str, float], speed: float) -> None:
    env = mujoco.parallel_env(problem=Problem(Team(("differential_drive",), own_limits=own), [[0] * 4], [[5, 5]]))
    env.reset(seed=0)
    assert driven(env, [0.0, -1.0], 25)[3] == pytest.approx(speed, abs=0.01)


def test_a_drive_keeps_to_its_circle() -> None:
    # At 0.5 m/s and 1 rad/s it is one of half a metre; after a whole turn the drive is back.
    x, y, heading, speed = driven(alone("differential_drive", [0, 0, 0, 0.5]), [1.0, 0], 63)
    assert heading == pytest.approx(6.3, abs=0.1)
    assert speed == pytest.approx(0.5, abs=0.01)
    assert math.hypot(x, y) < 0.05


def test_a_drive_does_not_slide_sideways_and_slips_on_ice() -> None:
    problem = Problem(Team(("differential_drive",), max_acceleration=4.0), [[0, 0, 0, 0]], [[5.0, 5.0]])
    positions = []
    for friction in (0.8, 0.1):
        env = mujoco.parallel_env(problem=problem, physics=Physics(wheel_friction=friction))
        env.reset(seed=0)
        x, y, _, _ = driven(env, [0.0, 4.0], 5)
        assert y == pytest.approx(0, abs=1e-3)
        positions.append(x)
    assert positions[1] < 0.5 * positions[0]


@pytest.mark.parametrize(
    ("world", "reach"),
    [
        ({"circles": [[2, 0, 0.5]]}, 1.5),
        ({"boxes": [[1.4, -1, 2, 1]]}, 1.4),
        ({"polygons": [[[1.6, -1], [2, 0], [1.6, 1], [1.2, 1], [1.2, -1]]]}, 1.2),
        ({"lower": [-1, -1], "upper": [1.3, 6]}, 1.3),
    ],
    ids=["circle", "box", "polygon", "bound"],
)
@pytest.mark.parametrize("model", ["holonomic2d", "differential_drive"])
def test_obstacles_stop_whoever_drives_at_them(model: str, world: dict[str, Any], reach: float) -> None:
    start = [0.0] * 4
    problem = Problem(Team((model,)), [start], [[0.0, 5.0]], World(**world))
    env = mujoco.parallel_env(problem=problem)
    env.reset(seed=0)
    forward = [1.0, 0.0] if model == "holonomic2d" else [0.0, 1.0]
    x = driven(env, forward, 40)[0]
    assert x == pytest.approx(reach - 0.15, abs=0.03)
    assert env.metrics()["collided"] == 1
    assert env.last_step.margin_violated[0]


def test_robots_bump_into_each_other_and_it_counts_whenever_it_was() -> None:
    problem = Problem(Team(("holonomic2d",) * 2), [[0, 0, 1, 0], [0.5, 0, 0, 0]], [[3, 0], [3, 1]])
    env = mujoco.parallel_env(problem=problem)
    env.reset(seed=0)
    collided = []
    for _ in range(8):
        *_, infos = env.step(act(env, np.zeros((2, 2), np.float32)))
        collided.append(infos["robot_0"]["collided"])
        assert infos["robot_0"]["collided"] == infos["robot_1"]["collided"]
        assert infos["robot_0"]["margin_violated"] or not collided[-1]
    assert any(collided)
    states = split_state(problem, env.state()).states
    # What one loses the other gets, but for the drag.
    assert states[1, 2] > 0.3
    assert states[:, 2].sum() == pytest.approx(math.exp(-0.2 * 0.8), abs=0.02)


@pytest.mark.parametrize("model", MODELS)
def test_who_has_docked_is_at_rest_and_cannot_be_pushed_away(model: str) -> None:
    start = np.zeros((2, Team((model,)).state_size))
    start[1, 0] = -1.0
    problem = Problem(Team((model,) * 2), start, [[0.05, 0], [3, 3]], horizon=60)
    env = mujoco.parallel_env(problem=problem)
    env.reset(seed=0)
    ahead = np.zeros((2, 2), np.float32)
    ahead[1, 1 if model == "differential_drive" else 0] = 1.0
    _, _, terminations, _, _ = env.step(act(env, ahead))
    assert terminations["robot_0"]
    for _ in range(30):
        env.step(act(env, ahead))
    arrived, other = split_state(problem, env.state()).states
    assert arrived == pytest.approx(start[0], abs=1e-4)
    assert other[0] == pytest.approx(-0.3, abs=0.03)
    assert env.metrics()["collided"] == 2
    bodies = env._simulation.bodies
    assert bodies.data.qpos[bodies.scene.joints[0]] == pytest.approx(0, abs=1e-4)


@pytest.mark.parametrize("model", MODELS)
def test_bodies_are_where_they_are_put(model: str) -> None:
    env = alone(model, [0.0] * Team((model,)).state_size)
    env.step({"robot_0": np.ones(2, np.float32)})
    state = np.array([[1.0, -2.0, 0.5, 0.25, 0.5]], np.float32)[:, : env.problem.state_size]
    env.set_state(state)
    assert env.problem.state_size == state.shape[1]
    assert np.allclose(env._simulation.bodies.states(), state, atol=1e-6)
    env.step({"robot_0": np.zeros(2, np.float32)})
    assert np.allclose(split_state(env.problem, env.state()).states[0, :2], state[0, :2], atol=0.06)


def test_intruders_push_whoever_is_in_their_way() -> None:
    problem = line_problem([9.0] * 3, "holonomic2d", horizon=100)
    env = mujoco.parallel_env(problem=problem, disturbances=[Intruder(20, 1.0)])
    env.reset(seed=0)
    # They keep away from starts and goals only.
    states = problem.start.copy()
    states[:, 0] = 4.5
    env.set_state(states)
    still = np.zeros((3, 2), np.float32)
    while env.agents and not env.metrics()["collided"]:
        env.step(act(env, still))
    for _ in range(2):
        env.step(act(env, still))
    assert np.abs(split_state(problem, env.true_state()).states[:, 2:]).max() > 0.05


@pytest.mark.parametrize("name", CASES)
def test_every_disturbance_works_there(name: str) -> None:
    env = mujoco.parallel_env(
        problem=line_problem([2.0] * 2, "holonomic2d"), observed_rays=3, disturbances=[CASES[name]]
    )
    episode = run_episode(env, "go-to-goal", seed=0)
    assert np.isfinite(episode.trajectory.states).all()


def test_a_disturbance_slows_the_bodies_themselves() -> None:
    problem = Problem(Team(("differential_drive",)), [[0, 0, 0, 1.0]], [[5.0, 0]])
    positions = []
    for disturbances in ([], [Drag(2.0)]):
        env = mujoco.parallel_env(problem=problem, disturbances=disturbances)
        env.reset(seed=0)
        positions.append(driven(env, [0.0, 0.0], 10)[0])
    assert positions[0] == pytest.approx(1.0, abs=0.03)
    assert positions[1] < 0.6


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ({"scenario": "sphere"}, "robot_0 is a holonomic3d, which has no body in MuJoCo; use one of holonomic2d"),
        ({"model": "car"}, "robot_0 is a car, which has no body in MuJoCo"),
        ({"problem": Problem(Team(("velocity2d",), radius=1e-5), [[0, 0]], [[1, 1]])}, "radius of robot_0 is 1e-05"),
        ({"physics": {"drag": 1}}, r"physics is \{'drag': 1\}; give d4orm_env.mujoco.Physics"),
        ({"renderer": "opengl"}, "renderer is 'opengl'; choose one of auto, mujoco, pictures"),
    ],
)
def test_what_it_cannot_have_is_one_clear_line(arguments: dict[str, Any], complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        mujoco.parallel_env(**arguments)


@pytest.mark.parametrize("setting", ["time_step", "drag", "wheel_friction", "body_friction", "settling_time",
                                     "surface_density"])  # fmt: skip
def test_physics_is_checked(setting: str) -> None:
    with pytest.raises(ValueError, match=f"Physics {setting} is -1"):
        Physics(**{setting: -1.0})
    with pytest.raises(ValueError, match=f"Physics {setting} must be a number"):
        Physics(**{setting: "much"})


def test_pictures_where_opengl_cannot_draw(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(name: str) -> Any:
        raise OSError("no such library")

    monkeypatch.setattr(environment, "importlib", type("Broken", (), {"import_module": staticmethod(broken)}))
    frames = []
    for renderer in ("auto", "pictures"):
        env = mujoco.parallel_env("circle", 2, render_mode="rgb_array", renderer=renderer)
        env.reset(seed=0)
        frames.append(env.render())
        env.close()
    assert np.array_equal(*frames)
    env = mujoco.parallel_env("circle", 2, render_mode="rgb_array", renderer="mujoco")
    env.reset(seed=0)
    with pytest.raises(RuntimeError, match=r"OpenGL cannot draw without a screen here \(egl: no such library"):
        env.render()


def has_opengl() -> bool:
    try:
        environment.open_context(environment.SIZE).free()
    except environment.NoCameraError:
        return False
    return True


@pytest.mark.skipif(not has_opengl(), reason="OpenGL cannot draw without a screen here")
def test_mujoco_draws_what_moves() -> None:
    env = mujoco.parallel_env("circle", 2, render_mode="rgb_array", renderer="mujoco")
    env.reset(seed=0)
    first = env.render()
    for _ in range(10):
        env.step(act(env, np.ones((2, 2), np.float32)))
    second = env.render()
    assert first.shape == second.shape == (environment.SIZE, environment.SIZE, 3)
    assert (first != second).any()
    env.close()


def test_an_environment_is_opened_by_its_physics() -> None:
    problem = line_problem([1.0])
    assert type(open_env(problem)) is navigation_v0.parallel_env
    assert type(open_env(problem, "mujoco")) is mujoco.parallel_env
    assert open_env(problem, "mujoco:drag=0.5,time_step=0.01")._physics == mujoco.Physics(drag=0.5, time_step=0.01)


@pytest.mark.parametrize(
    ("physics", "complaint"),
    [
        ("bullet", "physics is 'bullet'; choose one of model, mujoco, crazyflow"),
        (3, "physics is 3; choose one of model, mujoco, crazyflow"),
        ("model:drag=1", "physics is 'model:drag=1', and the model has no settings; give disturbances"),
        ("mujoco:", "physics is 'mujoco:'; give settings once each, as mujoco:name=value,..."),
        ("mujoco:drag", "physics is 'mujoco:drag'; give settings once each, as mujoco:name=value,..."),
        ("mujoco:drag=1,drag=2", "give settings once each, as mujoco:name=value,..."),
        ("mujoco:drags=1", "'drags' is no setting of physics 'mujoco'; it takes .*; did you mean 'drag'?"),
        ("mujoco:drag=-1", "drag is -1"),
        ("mujoco:drag=]", "is not YAML"),
    ],
)
def test_an_unknown_physics_is_named(physics: Any, complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        open_env(line_problem([1.0]), physics)


@pytest.mark.parametrize(
    "footprint", [Box(1.0, 0.3), Capsule(0.7, 0.15), Polygon([[0.5, 0.0], [-0.5, 0.15], [-0.5, -0.15]])]
)
@pytest.mark.parametrize(("gap", "touches"), [(1.06, False), (0.94, True)])
def test_footprints_touch_where_they_end(footprint: Footprint, gap: float, touches: bool) -> None:
    """Two face each other: discs within them are far apart."""
    team = Team(("differential_drive",) * 2, footprint=footprint)
    problem = Problem(team, [[-2, 0, 0, 0], [2, 0, np.pi, 0]], [[2, 3], [-2, 3]])
    env = mujoco.parallel_env(problem=problem)
    env.reset(seed=0)
    states = problem.start.copy()
    states[:, 0] = [-gap / 2, gap / 2]
    env.unwrapped.set_state(states)
    _, _, _, _, infos = env.step({agent: np.zeros(2, np.float32) for agent in env.agents})
    assert [info["collided"] for info in infos.values()] == [touches, touches]


def test_a_puck_that_is_no_disc_keeps_its_heading() -> None:
    """Its model has none: one that is hit at its end does not turn."""
    team = Team(("velocity2d",) * 2, footprint=Box(1.0, 0.2))
    problem = Problem(team, [[0, 0], [0.9, -1]], [[3, 3], [0.9, 3]], horizon=60)
    bodies = TeamBodies(problem, np.zeros(0, np.float32), Physics())
    bodies.begin(0)
    controls = np.zeros((2, 2), np.float32)
    controls[1] = [0, 1]
    touched = np.zeros(2, bool)
    for _ in range(20):
        touched |= bodies.advance(controls, problem.arrays, np.zeros((0, 4))).touched
    assert touched.all()
    assert abs(bodies.data.qpos[bodies.scene.joints[0] + 2]) < 1e-3


def test_a_footprint_that_its_reference_point_is_outside_of_has_no_body() -> None:
    team = Team(("unicycle",), footprint=Box(0.3, 0.2, offset=0.5))
    with pytest.raises(ValueError, match=r"distance to the edge of Box\(.*\) of robot_0 is 0; bodies in MuJoCo need"):
        mujoco.parallel_env(problem=Problem(team, [[0, 0, 0]], [[2, 0]]))
