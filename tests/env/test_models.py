"""Models beyond the common four: those that users register, the unicycle and the car, and limits of a model's own."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from engine_support import ENGINE_NAMES, PYTHON_OPS, observe_team, random_controls
from env_support import slow
from numpy import tanh
from registry_support import forgetting

from d4orm_env import Problem, Team, load_problem, make_problem, register_model, rollout, save_problem, verify
from d4orm_env.core.observation_layout import ObservationLayout
from d4orm_env.dynamics import OWN_LIMITS, SPEED, UNLIMITED, Limit, Model, ModelFunctions, clip
from d4orm_env.dynamics.holonomic2d import HOLONOMIC2D
from d4orm_env.dynamics.models import MODEL_CODES, MODELS, get_model, model_digest
from d4orm_env.dynamics.transition import TimeStep, advance
from d4orm_env.engine.choice import get_engine
from d4orm_env.engine.cpu import _UNITS, roll_out_of, roll_out_of_codes
from d4orm_env.jax import functional
from d4orm_env.verify import integrated
from d4orm_env.verify.integrated import Integrated
from d4orm_env.verify.motion import TeamMotion
from d4orm_planners import make_planner

STEP = TimeStep(0.1, 0.1 / 2, 0.1 / 3, 0.1 / 6)


def _derivative(x: Any, u: Any, limits: Any, ops: Any) -> Any:
    return (u[0] + limits[OWN_LIMITS], u[1])


def _limit_control(u: Any, limits: Any, ops: Any) -> Any:
    return (clip(u[0], limits[SPEED], ops), clip(u[1], limits[SPEED], ops))


def _limit_state(x: Any, limits: Any, ops: Any) -> Any:
    return x


def _rest(x: Any, zero: Any) -> Any:
    return x


def _approach(x: Any, goal: Any, limits: Any, h: Any, ops: Any) -> Any:
    return ((goal[0] - x[0]) / h.full, (goal[1] - x[1]) / h.full)


def _track(x: Any, velocity: Any, limits: Any, h: Any, ops: Any) -> Any:
    return (velocity[0] - limits[OWN_LIMITS], velocity[1])


FUNCTIONS = ModelFunctions(_derivative, _limit_control, _limit_state, _derivative, _rest, _approach, _track)
BOAT = Model(
    name="boat",
    dimension=2,
    state_names=("px", "py"),
    control_names=("vx", "vy"),
    control_limits=(SPEED, SPEED),
    heading_index=None,
    speed_indices=(),
    functions=FUNCTIONS,
    own_limits=(Limit("current", 0.25),),
)
"""It drifts along x with the current."""


@pytest.fixture
def boat() -> Iterator[Model]:
    with forgetting(MODELS):
        register_model(BOAT)
        yield BOAT
    roll_out_of_codes.cache_clear()
    _UNITS.clear()


ONE = 1


def doubled(x: Any) -> Any:
    return x + x


def with_function(**functions: Any) -> Model:
    return replace(BOAT, functions=FUNCTIONS._replace(**functions))


def unbounded(u: Any, limits: Any, ops: Any) -> Any:
    return u


def boxed(x: Any, limits: Any, ops: Any) -> Any:
    return (x[0], x[1], clip(x[2], limits[SPEED], ops), clip(x[3], limits[SPEED], ops))


def with_inertia(**functions: Any) -> Model:
    model = get_model("unicycle2")
    return replace(model, name="boat", functions=model.functions._replace(**functions))


@pytest.mark.parametrize(
    ("model", "message"),
    [
        (replace(BOAT, name="car"), "model name 'car' is taken; register yours under another"),
        (replace(BOAT, name="a-boat"), "must be an identifier"),
        (replace(BOAT, dimension=4), "dimension is 4; it must be 2 or 3"),
        (replace(BOAT, control_names=("vx",), control_limits=(0,)), "control_names has 1 names; it must have 2 or 3"),
        (replace(BOAT, control_limits=(0,)), "control_limits has 1 columns; expected 2"),
        (replace(BOAT, control_limits=(0, 4)), "column of limits is not from 0 to 3"),
        (replace(BOAT, heading_index=2), "index of a state component is not from 0 to 1"),
        (replace(BOAT, own_limits=(Limit("max_speed", 1),)), "two limits have the same name"),
        (replace(BOAT, own_limits=(Limit("current", 0),)), "default of own_limits is not positive"),
        (with_function(track=lambda x, v, limits, h, ops: (*v, v[0])), "track returns .* a tuple of 2 finite numbers"),
        (with_function(rest=lambda x, zero: [*x]), r"rest returns \[0.5, 0.5\]; expected a tuple of 2 finite numbers"),
        (with_function(rest=lambda x: x), "rest fails on Python's numbers: TypeError"),
        (with_function(rest=lambda x, zero: (x[0] * 0.5, x[1])), "rest uses the float 0.5, .* one of own_limits"),
        (with_function(rest=lambda x, zero: (x[0] and zero, x[1])), "rest branches, .*: use ops.where"),
        (with_function(rest=lambda x, zero: tuple([part for part in x])), "rest has a loop .* write its terms out"),  # noqa: C416
        (with_function(rest=lambda x, zero: (np.abs(x[0]), x[1])), "rest names the module np; take .* from ops"),
        (with_function(rest=lambda x, zero: (doubled(x[0]), x[1])), "rest names doubled, which engines cannot compile"),
        (with_function(rest=lambda x, zero: (tanh(x[0]), x[1])), "rest names tanh, which engines cannot compile"),
        (with_function(rest=lambda x, zero: (ONE * x[0], x[1])), "rest computes with a whole number that it names"),
        (with_function(rest=lambda x, zero, one=1: (one * x[0], x[1])), "rest computes with a whole number"),
        (replace(BOAT, own_limits=Limit("drag", 0.3)), r"own_limits is Limit\(.*; give a tuple of Limit"),
        (replace(BOAT, state_names=["px", "py"]), r"state_names is \['px', 'py'\]; give tuples, not lists"),
        (replace(BOAT, state_limits=([0, 0],)), r"state_limits is \(\[0, 0\],\); give tuples"),
        (replace(BOAT, speed_indices=3), "speed_indices is 3; give tuples"),
        (replace(BOAT, state_names=("px", "px")), "two components of state_names have the same name"),
        (replace(BOAT, control_names=("v", "v")), "two components of control_names have the same name"),
        ("boat", "register_model takes a Model, not 'boat'"),
        (with_function(limit_control=unbounded), "limit_control makes .*, where max_speed, 1, bounds component 0"),
        (with_inertia(limit_control=unbounded), "where max_acceleration, 2, bounds component 0; bring them within"),
        (with_inertia(limit_state=unbounded), "limit_state makes .*, where max_speed, 1, bounds component 3"),
        (
            with_inertia(limit_state=lambda x, limits, ops: (*x[:3], clip(x[3], limits[SPEED], ops), x[4])),
            r"limit_state makes \(0.5, 0.5, 0.5, -1.0, .*where max_speed",
        ),
        (
            replace(HOLONOMIC2D, name="boat", functions=HOLONOMIC2D.functions._replace(limit_state=boxed)),
            "where max_speed, 1, bounds component 2 and 3",
        ),
        (with_function(rest=lambda x, zero: (zero, zero)), "rest makes .* it must keep the position"),
        (with_inertia(rest=lambda x, zero: x), "rest makes .* and make speeds zero"),
    ],
)
def test_a_model_that_does_not_fit_is_refused(model: Any, message: str) -> None:
    before = dict(MODELS)
    with pytest.raises(ValueError, match=message):
        register_model(model)
    assert before == MODELS


@pytest.mark.parametrize("name", MODELS)
def test_every_model_may_be_another_of_the_users(name: str) -> None:
    with forgetting(MODELS):
        register_model(replace(get_model(name), name="mine"))


def test_a_model_may_be_registered_twice_but_not_two(boat: Model) -> None:
    register_model(replace(boat))
    with pytest.raises(ValueError, match="is taken"):
        register_model(with_function(rest=lambda x, zero: (x[0] + zero, x[1])))


def test_an_installed_package_offers_a_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    info = tmp_path / "theirs-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: theirs\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[d4orm.models]\nboat = test_models:BOAT\nship = test_models:BOAT\n")
    monkeypatch.syspath_prepend(tmp_path)
    with forgetting(MODELS):
        assert {"boat", "ship"} < set(MODELS)
        problem = make_problem("circle", num_robots=2, model="boat")
        assert problem.team.robot_models == (BOAT, BOAT)
        assert problem.arrays.model_codes.tolist() == [len(MODEL_CODES) - 1] * 2
        register_model(BOAT)  # as its module may do too
        assert get_model("boat") == BOAT
        with pytest.raises(ValueError, match="model 'ship' calls itself 'boat'"):
            make_problem("circle", num_robots=2, model="ship")


def test_the_digest_of_a_model_knows_the_numbers_that_its_functions_hold() -> None:
    def with_factor(factor: int) -> Model:
        return with_function(rest=lambda x, zero: (x[0] * factor, x[1]))

    digests = {model_digest(model) for model in (BOAT, with_factor(1), with_factor(2), replace(BOAT, name="raft"))}
    assert len(digests) == 4
    assert model_digest(with_factor(2)) in digests


@pytest.mark.parametrize("engine", ENGINE_NAMES)
def test_a_registered_model_moves_in_a_mixed_team(engine: str, boat: Model) -> None:
    team = Team(("boat", "holonomic2d"), own_limits={"current": [0.5, 7.0]})
    assert team.limits.tolist() == pytest.approx(np.array([[1, 1, math.pi / 2, 0.5], [1, 1, math.pi / 2, 1]]))
    problem = Problem(team, [[0, 0, 0, 0], [0, 2, 0, 0]], [[5, 0], [5, 2]], horizon=10)
    controls = np.zeros((10, 2, 2))
    controls[:, 0, 1], controls[:, 1, 0] = -2.0, 1.0
    states = rollout(problem, controls, engine=engine).states
    np.testing.assert_allclose(states[-1], [[0.5, -1, 0, 0], [0.5, 2, 1, 0]], atol=1e-6)
    layout = ObservationLayout.for_problem(problem)
    seen = observe_team(problem.arrays, layout, states[-1], controls[-1], np.zeros(2, bool), 1.0)
    np.testing.assert_allclose(seen[:, :2], [[0.5, -1], [1, 0]], atol=1e-6)


def test_a_registered_model_is_planned_and_verified(boat: Model) -> None:
    problem = make_problem("circle", num_robots=3, model="boat")
    plan = make_planner("d4orm").solve(problem, seed=0, max_iterations=50)
    assert plan.solved
    assert verify(problem, plan.controls).ok
    # What its controls alone would do is not where it goes.
    assert not verify(problem.replace(team=Team(("boat",) * 3, own_limits={"current": 0.01})), plan.controls).ok


def test_the_digest_of_a_problem_does_not_know_the_order_of_registration(boat: Model) -> None:
    problem = make_problem("circle", num_robots=2, model="boat")
    codes = problem.arrays.model_codes.tolist()
    with forgetting(MODELS):
        MODELS._registered.pop("boat")
        MODEL_CODES.pop("boat")
        register_model(replace(boat, name="raft"))
        register_model(boat)
        again = make_problem("circle", num_robots=2, model="boat")
        assert codes != again.arrays.model_codes.tolist()
        assert problem == again


@pytest.mark.parametrize("engine", ENGINE_NAMES)
def test_a_code_that_is_no_models_is_refused(engine: str) -> None:
    problem = make_problem("circle", num_robots=2)
    arrays = problem.arrays._replace(model_codes=np.array([0, 77], np.int32))
    with pytest.raises(ValueError, match="model code 77 is unknown"):
        get_engine(engine).step(arrays, problem.start, np.zeros(2, bool), np.zeros((2, 2), np.float32))


def test_teams_of_common_models_share_kernels_that_know_no_other(boat: Model) -> None:
    mixed = roll_out_of(("velocity2d", "differential_drive"))
    assert mixed is roll_out_of(("holonomic2d", "velocity2d"))
    # A plan waits for no more models than it must.
    assert roll_out_of(("holonomic2d",)).py_func.__qualname__.endswith("roll_out_holonomic2d")
    with_boat = roll_out_of(("holonomic2d", "boat"))
    assert with_boat.py_func.__qualname__.endswith("_holonomic2d_boat")


# The unicycle and the car.


def car_limits(**own: float) -> tuple[float, ...]:
    return tuple(Team(("car",), own_limits=own).limits[0].tolist())


def test_a_unicycle_moves_on_a_circle() -> None:
    # A quarter turn at 0.5 m/s and pi/2 rad/s in a second: to the left on a circle of radius 1 / pi.
    x: Any = (1.0, 2.0, 0.0)
    for _ in range(10):
        x = advance(get_model("unicycle").functions, x, (0.5, math.pi / 2), (1.0, 1.0, 2.0), STEP, PYTHON_OPS)
    assert x == pytest.approx((1 + 1 / math.pi, 2 + 1 / math.pi, math.pi / 2), abs=1e-6)


@pytest.mark.parametrize("wheelbase", [0.3, 0.5])
def test_a_car_moves_on_the_circle_of_its_steering(wheelbase: float) -> None:
    # At steering angle arctan(1/2) the radius is twice the wheelbase.
    radius, limits = 2 * wheelbase, car_limits(wheelbase=wheelbase)
    x: Any = (0.0, 0.0, 0.0, 0.5, math.atan(0.5))
    for _ in range(10):
        x = advance(get_model("car").functions, x, (0.0, 0.0), limits, STEP, PYTHON_OPS)
    angle = 0.5 / radius
    expected = (radius * math.sin(angle), radius * (1 - math.cos(angle)), angle, 0.5, math.atan(0.5))
    assert x == pytest.approx(expected, abs=1e-5)


def test_only_a_car_does_not_turn_in_place() -> None:
    models = ("car", "car", "unicycle", "differential_drive", "holonomic2d")
    team = Team(models, own_limits={"wheelbase": [0.3, 0.5, 1, 1, 1], "max_steering": [math.atan(0.5), 0.6, 1, 1, 1]})
    assert team.turning_radius == pytest.approx([0.6, 0.5 / math.tan(0.6), 0, 0, 0])
    assert [model.turns_in_place for model in team.robot_models] == [False, False, True, True, True]


@pytest.mark.parametrize("name", ["unicycle", "car"])
@pytest.mark.parametrize("distance", [0.3, 1.0, 4.0])
def test_the_law_of_a_robot_with_wheels_reaches_its_goal_from_every_heading(name: str, distance: float) -> None:
    model = get_model(name)
    functions, limits = model.functions, tuple(Team((name,)).limits[0].tolist())
    for heading in np.linspace(-3, 3, 13):
        x: Any = (0.0, 0.0, heading, *(0.0,) * (model.state_size - 3))
        for _ in range(250):
            wanted = functions.approach(x, (distance, 0.0), limits, STEP, PYTHON_OPS)
            u = functions.limit_control(functions.track(x, wanted, limits, STEP, PYTHON_OPS), limits, PYTHON_OPS)
            x = advance(functions, x, u, limits, STEP, PYTHON_OPS)
            if math.hypot(x[0] - distance, x[1]) < 0.075:
                break
        else:
            pytest.fail(f"from heading {heading} it ends at {x}")


@pytest.mark.parametrize(("planner", "num_robots"), [("d4orm", 4), ("d4orm-d", 8)])
@pytest.mark.parametrize("name", ["unicycle", "car"])
def test_wheeled_teams_cross_the_circle(name: str, planner: str, num_robots: int) -> None:
    problem = make_problem("circle", num_robots=num_robots, model=name)
    plan = make_planner(planner).solve(problem, seed=0, max_iterations=100)
    assert plan.solved
    assert verify(problem, plan.controls).ok


@pytest.mark.parametrize("name", ["unicycle", "car"])
def test_the_engines_roll_wheeled_teams_out_alike(name: str) -> None:
    problem = make_problem("circle", num_robots=3, model=(name, "holonomic2d", name))
    controls = random_controls(problem, 1)
    cpu, jax = (rollout(problem, controls, engine=engine) for engine in ENGINE_NAMES)
    np.testing.assert_allclose(cpu.states, jax.states, atol=1e-4)
    np.testing.assert_allclose(cpu.controls, jax.controls, atol=1e-6)


@pytest.mark.parametrize("name", ["differential_drive", "unicycle"])
def test_the_judge_integrates_what_it_has_equations_for_to_the_same_motion(name: str) -> None:
    problem = make_problem("circle", num_robots=3, model=name)
    controls = random_controls(problem, 2).astype(np.float64)
    start = np.asarray(problem.start, np.float64)
    exact = TeamMotion(problem, controls)
    found = Integrated(get_model(name), np.arange(3), start, controls, problem.team, problem.dt)
    steps = slice(None)
    np.testing.assert_allclose(found.displacement(steps, 12), exact.displacement(steps, 12), atol=1e-6)
    np.testing.assert_allclose(found.pace, exact.pace, atol=1e-9)
    np.testing.assert_allclose(found.headings(steps, 12)[..., 0], exact.headings(steps, 12), atol=1e-6)
    np.testing.assert_allclose(found.limits, exact.limits, atol=0)
    np.testing.assert_allclose(np.maximum(found.sizes, found.limits), np.maximum(exact.sizes, exact.limits), atol=1e-9)
    # Its bound on the acceleration holds, and is not far off.
    inner = np.diff(exact.displacement(steps, 40), n=2, axis=1) * (40 / problem.dt) ** 2
    acceleration = np.sqrt((inner**2).sum(axis=-1)).max(axis=1)
    assert (found.bend >= acceleration).all()
    assert (found.bend <= 2 * acceleration + 0.1).all()


@pytest.mark.parametrize("scale", [slow(0.3), 30.0])
@pytest.mark.parametrize("name", MODELS)
def test_the_judge_integrates_all_steps_at_once_as_one_after_another(
    name: str, scale: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem = make_problem("circle" if MODELS[name].dimension == 2 else "sphere", num_robots=3, model=name, horizon=60)
    controls = np.cumsum(scale * random_controls(problem, 2).astype(np.float64), axis=0)
    arguments = np.arange(3), np.asarray(problem.start, np.float64), controls, problem.team, problem.dt
    at_once = Integrated(MODELS[name], *arguments)
    monkeypatch.setattr(integrated, "CORRECTIONS", 0)
    one_by_one = Integrated(MODELS[name], *arguments)
    np.testing.assert_allclose(
        at_once.displacement(slice(None), 5), one_by_one.displacement(slice(None), 5), rtol=0, atol=1e-9
    )
    np.testing.assert_allclose(at_once.pace, one_by_one.pace, rtol=0, atol=1e-9)


def test_the_judge_names_the_control_of_a_car_that_exceeds_its_limit() -> None:
    problem = make_problem("circle", num_robots=2, model="car")
    controls = np.zeros((problem.horizon, 2, 2))
    controls[5, 1] = 0.5, -1.25
    report = verify(problem, controls)
    (violation,) = (violation for violation in report.violations if violation.kind == "control limit")
    assert violation.robots == (1,)
    assert "steering_rate of the control is 1.25 at step 5, limit 1;" in violation.detail


@pytest.mark.parametrize(("speed", "beyond"), [(-0.5, "0.5 at step 0, limit 0.3"), (1.25, "1.25 at step 0, limit 1")])
def test_the_judge_names_the_limit_of_each_direction(speed: float, beyond: str) -> None:
    team = Team(("unicycle1",), own_limits={"max_reverse_speed": 0.3})
    problem = Problem(team, [[0, 0, 0]], [[9, 0]], horizon=3)
    report = verify(problem, np.array([[[speed, 0]], [[0, 0]], [[speed, 0]]]))
    (violation,) = (violation for violation in report.violations if violation.kind == "control limit")
    assert f"speed of the control is {beyond}; 2 steps over it" in violation.detail


# Limits of a model's own.


def car_problem(**own: Any) -> Problem:
    return make_problem("circle", num_robots=3, model=("car", "holonomic2d", "car"), own_limits=own)


def test_own_limits_have_defaults_and_belong_to_the_robots_that_have_them() -> None:
    team = car_problem(wheelbase=[0.4, 9.0, 0.5]).team
    assert list(team.own_limits) == ["max_steering", "max_steering_rate", "wheelbase", "max_reverse_speed"]
    expected = [[0.6, 1, 0.4, UNLIMITED], [1, 1, 1, 1], [0.6, 1, 0.5, UNLIMITED]]
    assert team.limits[:, OWN_LIMITS:].tolist() == np.float32(expected).tolist()
    assert team.control_limits.tolist() == [[1, 1]] * 3
    assert team.select([2]).own_limits["wheelbase"].tolist() == [0.5]
    assert team.select([1]).own_limits == {}
    assert car_problem(wheelbase=0.4) != car_problem(wheelbase=0.5)


def test_the_functional_step_reads_own_limits() -> None:
    problem = car_problem(wheelbase=[0.4, 1.0, 0.5])
    problem = problem.replace(start=problem.start + np.float32([[0, 0, 0, 0.5, 0.25], [0] * 5, [0, 0, 0, 0.5, 0.25]]))
    controls = random_controls(problem, 3)
    state, _ = functional.step(problem, functional.reset(problem, None), controls[0])
    after = rollout(problem, controls, engine="cpu").states[1]
    np.testing.assert_allclose(state.states, after, atol=1e-6)
    assert abs(after[0, 2] - problem.start[0, 2]) > 0.02


def test_a_team_of_other_models_has_their_limits_not_the_defaults_of_the_former() -> None:
    team = Team(("car", "differential_drive"), own_limits={"wheelbase": [0.4, 1.0]})
    changed = team.replace(models=("car", "unicycle1"))
    assert (changed.own_limits["wheelbase"][0], changed.own_limits["max_reverse_speed"][1]) == (np.float32(0.4), 0.5)
    assert Team(("car",)).replace(models=("holonomic2d",)).own_limits == {}
    with pytest.raises(ValueError, match="own_limits holds 'wheelbase', which no model of the team has"):
        team.replace(models=("holonomic2d",) * 2)


def test_own_limits_survive_a_file(tmp_path: Path) -> None:
    problem = car_problem(wheelbase=[0.4, 1.0, 0.5])
    start = problem.start.copy()
    start[0, 3:] = 0.5, -0.25
    problem = problem.replace(start=start)
    save_problem(problem, tmp_path / "cars.yaml")
    assert load_problem(tmp_path / "cars.yaml") == problem


@pytest.mark.parametrize("engine", ["cpu", "jax"])
@pytest.mark.parametrize("model", ["car", "differential_drive"])
def test_a_robot_reverses_as_fast_as_forwards_unless_told_otherwise(tmp_path: Path, model: str, engine: str) -> None:
    state = np.zeros((1, Team((model,)).state_size))
    state[0, 3] = -0.9
    fast = Problem(Team((model,)), state, [[-9.0, 0.0]])
    slow = fast.replace(team=Team((model,), own_limits={"max_reverse_speed": 0.25}), start=0 * state)
    assert fast.replace(team=Team((model,), own_limits={"max_reverse_speed": 1.5})).digest != fast.digest
    with pytest.raises(ValueError, match=r"start speed of robot_0 is 0\.9 m/s, above its max_reverse_speed of 0\.25"):
        slow.replace(start=state)
    backwards = np.full((100, 1, 2), [-1.0, 0.0] if model == "car" else [0.0, -1.0], np.float32)
    for problem, speed in ((fast, -1.0), (slow, -0.25)):
        assert rollout(problem, backwards, engine=engine).states[-1, 0, 3] == speed
        save_problem(problem, path := tmp_path / "robot.yaml")
        assert load_problem(path) == problem
        assert ("max_reverse_speed" in path.read_text()) == (problem is slow)


@pytest.mark.parametrize(
    ("robot", "message"),
    [
        ("own_limits: {wheels: 4}", "a car has no 'wheels'; it has max_steering, max_steering_rate, wheelbase"),
        ("state: [0, 0]", r"state \[0.0, 0.0\] has 2 components; it holds heading, speed, steering"),
        ("heading: 0", "a car starts without heading; it has start, state"),
    ],
)
def test_a_file_that_does_not_fit_a_car_is_refused(tmp_path: Path, robot: str, message: str) -> None:
    path = tmp_path / "car.yaml"
    path.write_text(f"version: 1\nrobots: [{{model: car, start: [0, 0], goal: [1, 0], {robot}}}]\n")
    with pytest.raises(ValueError, match=message):
        load_problem(path)


@pytest.mark.parametrize(
    ("own", "message"),
    [
        ({"wheels": 4}, "own_limits holds 'wheels', which no model of the team has; it has max_steering, .*wheelbase"),
        ({"wheelbase": 0}, "wheelbase of robot_0 is 0; it must be positive"),
        ({"max_steering": 1.6}, "max_steering of robot_0 is 1.6; it must be at most 1.5"),
        ({"wheelbase": [1, 2]}, r"wheelbase has shape \(2,\); expected one number, or \(3,\)"),
        (["wheelbase"], "own_limits must be a mapping"),
    ],
)
def test_own_limits_that_do_not_fit_are_refused(own: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_problem("circle", num_robots=3, model=("car", "holonomic2d", "car"), own_limits=own)


def test_a_car_cannot_start_with_its_wheels_turned_too_far() -> None:
    with pytest.raises(ValueError, match=r"start steering of robot_0 is 0\.7, above its max_steering of 0\.6"):
        Problem(Team(("car",)), [[0, 0, 0, 0, 0.7]], [[2, 0]])


def test_a_car_that_turns_too_fast_for_its_time_step_is_refused() -> None:
    with pytest.raises(ValueError, match="use a smaller dt, max_steering or max_speed"):
        Problem(Team(("car",), own_limits={"wheelbase": 0.2}), [[0, 0, 0, 0, 0]], [[2, 0]], dt=1.0)


def test_a_robot_that_swings_and_ends_as_it_began_moves() -> None:
    start = np.zeros((2, 5), np.float32)
    start[1, :2] = 3.0
    problem = Problem(Team(("unicycle2", "holonomic2d")), start=start, goal=start[:, :2] + 1, dt=0.5, horizon=8)
    controls = np.zeros((8, 2, 2))
    # Its turn rate is -0.25, 0.25, -0.25 and 0 after these steps: from the second on it is turned as far after each.
    controls[1:5, 0, 1] = -0.5, 1.0, -1.0, 0.5
    motion = TeamMotion(problem, controls)
    assert motion.end_headings[1, 0] == pytest.approx(motion.end_headings[2, 0], abs=1e-9)
    assert motion.moving.tolist() == [False, True, True, True, True, False, False, False]
