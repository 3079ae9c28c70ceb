"""Scenario files: every problem comes back to the bit, and nothing but a clear ValueError comes out of a bad file."""

from __future__ import annotations

import re
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from env_support import WALLED, needed
from hypothesis import example, given
from hypothesis import strategies as st

from d4orm_env.core.files import parse_yaml
from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.core.world import World
from d4orm_env.dynamics.models import MODELS
from d4orm_env.scenarios import list_scenarios, load_problem, make_problem, save_problem

EXAMPLE = Path(__file__).parents[2] / "examples" / "scenarios" / "mixed_team.yaml"
CASES: list[tuple[str, str | None]] = [
    (name, model) for name in ("circle", "random", "four_obstacles", "swap") for model in MODELS
]
CASES += [("sphere", None), ("heterogeneous", None)]
CASES += [(f"paper_{name}", None) for name in ("circle", "sphere", "random", "heterogeneous", "obstacles")]
CASES += [*((f"amswarm_{index}", None) for index in range(1, 6))]
CASES += [(name, model) for name, models in WALLED.items() for model in models]

ROBOT = "{model: holonomic2d, start: [0, 0], goal: [1, 0]}"
MINIMAL = f"version: 1\nrobots: [{ROBOT}]\n"


def loaded(text: str | bytes) -> Problem:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "problem.yaml"
        path.write_bytes(text if isinstance(text, bytes) else text.encode("utf-8", "surrogatepass"))
        return load_problem(path)


def saved_and_loaded(problem: Problem) -> Problem:
    with tempfile.TemporaryDirectory() as folder:
        save_problem(problem, Path(folder) / "problem.yaml")
        assert [entry.name for entry in Path(folder).iterdir()] == ["problem.yaml"]
        return load_problem(Path(folder) / "problem.yaml")


def test_the_cases_cover_every_scenario() -> None:
    assert {name for name, _ in CASES} == set(list_scenarios())


@pytest.mark.parametrize(("name", "model"), CASES)
def test_scenarios_come_back_to_the_bit(name: str, model: str | None) -> None:
    wide = {"random": {"size": 40}, "circle": {"diameter": 40}, "four_obstacles": {"diameter": 40}}
    room = wide.get(name, {}) if model and MODELS[model].trailers else {}
    settings = {"num_obstacles": 2, "margin": 0.07, "goal_speed": 1 / 3} | needed(name) | room
    problem = make_problem(name, model=model, seed=3, **settings)
    again = saved_and_loaded(problem)
    assert again == problem
    assert again.name == name


float32s = st.floats(-1e6, 1e6, width=32)
positive = st.floats(np.float32(1e-3).item(), np.float32(1e3).item(), width=32)
offsets = st.floats(-0.25, 0.25, width=32)


@st.composite
def worlds(draw: st.DrawFn, dimension: int, width: float) -> World:
    """Obstacles of every kind at y beyond +-2, out of the way of robots at y = 0."""
    corner = [0.1] + [3.0] * (dimension - 1)
    boxes = [[*corner, *(value + extent for value in corner)] for extent in draw(st.lists(positive, max_size=3))]
    rows = draw(st.lists(st.tuples(float32s, st.floats(-9, -4, width=32), st.floats(2**-20, 1, width=32)), max_size=3))
    bounds = draw(st.none() | st.floats(3, 9, width=32))
    kinds: dict[str, Any] = {"circles": rows}
    if dimension == 3:
        kinds = {"cylinders": rows, "spheres": [(x, y, z, radius) for (x, y, radius), z in zip(rows, (0.0, -0.0, 1e6))]}
    if bounds is not None:
        kinds |= {"lower": [-bounds] * dimension, "upper": [bounds + width] * dimension}
    origin = draw(st.none() | st.tuples(*[st.floats(-1e9, 1e9)] * dimension))
    return World(dimension, boxes=boxes, origin=origin, **kinds)


@st.composite
def problems(draw: st.DrawFn) -> Problem:
    """Any team that mixes models, in any world; robots stand every 2 m along x, so that nothing touches.

    Trailers are longer than that.
    """
    dimension = draw(st.sampled_from([2, 3]))
    names = [model.name for model in MODELS.values() if model.dimension == dimension and not model.trailers]
    models = tuple(draw(st.lists(st.sampled_from(names), min_size=1, max_size=6)))
    count = len(models)

    def array(numbers: st.SearchStrategy[float], *shape: int) -> Any:
        size = int(np.prod(shape))
        return np.array(draw(st.lists(numbers, min_size=size, max_size=size)), np.float32).reshape(shape)

    limits = (array(numbers, count) for numbers in (positive, positive, st.floats(2**-10, 2, width=32)))
    speed, *others = limits
    # A car as long as it drives in a second turns no faster than the others.
    own = {"wheelbase": speed} if {"car", "car_first_order"} & set(models) else {}
    team = Team(models, array(st.floats(2**-20, 0.5, width=32), count), speed, *others, own_limits=own)
    positions = array(offsets, 2, count, dimension)
    positions[:, :, 0] += 2 * np.arange(count)
    start = np.zeros((count, team.state_size), np.float32)
    start[:, :dimension] = positions[0]
    speeds = st.floats(0, 1e6)
    for robot, model in enumerate(team.robot_models):
        if model.heading_index is not None:
            start[robot, model.heading_index] = draw(st.floats(-50, 50, width=32))
        slowest = 0.0 if model.lower_limits else -0.5
        share = array(st.floats(slowest, 0.5, width=32), len(model.speed_indices))
        start[robot, list(model.speed_indices)] = share * np.asarray(team.max_speed)[robot]
    return Problem(
        team=team,
        start=start,
        goal=positions[1],
        world=draw(worlds(dimension, 2.0 * count)),
        dt=draw(st.floats(0.05, 0.1)),
        horizon=draw(st.integers(1, 10**6)),
        margin=draw(st.floats(0, 10)),
        goal_radius=draw(st.floats(1e-3, 10)),
        goal_speed=draw(st.none() | speeds | st.just(np.inf) | st.lists(speeds, min_size=count, max_size=count)),
        collision_penalty=draw(st.floats(1e-3, 1e3)),
        name=draw(st.text(st.characters(exclude_categories=["Cs"]))),
    )


def test_a_disc_beside_a_trailer_comes_back_to_the_bit() -> None:
    team = Team(("velocity2d", "car_with_2_trailers"), radius=[0.15, 0.3])
    problem = Problem(team, [[0] * team.state_size, [0, 5] + [0] * (team.state_size - 2)], [[1, 0], [2, 5]])
    assert saved_and_loaded(problem) == problem


@given(problems())
def test_any_problem_comes_back_to_the_bit(problem: Problem) -> None:
    again = saved_and_loaded(problem)
    assert again == problem
    assert again.name == problem.name
    for name in ("start", "goal", "goal_speed", "origin"):
        assert getattr(again, name).tobytes() == getattr(problem, name).tobytes()


@pytest.mark.parametrize("path", [3, None, [EXAMPLE]])
def test_a_path_that_is_none_is_refused(path: Any) -> None:
    with pytest.raises(ValueError, match="path of a scenario file must be text or a path"):
        load_problem(path)


@pytest.mark.parametrize("name", ["123", "1e-3", "null", "on", "a: b # c", "two\nlines", "Überholen 🤖", "\ud800", ""])
def test_any_name_can_be_saved(name: str) -> None:
    again = saved_and_loaded(make_problem("circle", 1).replace(name=name))
    assert again.name == name.replace("\ud800", "?")


@pytest.mark.parametrize("heading", [50, np.finfo(np.float32).smallest_subnormal, -0.0, 100 / 3])
def test_extreme_numbers_come_back_to_the_bit(heading: float) -> None:
    problem = make_problem("circle", 1, model="differential_drive")
    start = problem.start.copy()
    start[0, 2:] = [heading, -0.0]
    problem = problem.replace(start=start, dt=0.1 + 0.2, goal_radius=1 / 3)
    assert saved_and_loaded(problem).start.tobytes() == problem.start.tobytes()
    assert saved_and_loaded(problem) == problem


def test_saved_file_is_readable_and_needs_no_own_parser(tmp_path: Path) -> None:
    path = tmp_path / "problem.yaml"
    save_problem(make_problem("amswarm_2"), path)
    lines = path.read_text(encoding="utf-8").splitlines()
    assert len(lines) < 30
    content = yaml.safe_load("\n".join(lines))
    assert content["version"] == 1
    assert content["robots"][0]["start"] == [2.5, 0.0, 0.0]
    assert content["robots"][0]["radius"] == 0.29
    assert content["world"]["cylinders"][1] == {"center": [0.5, 0.0], "radius": 0.2}


def test_saving_replaces_and_leaves_nothing_behind(tmp_path: Path) -> None:
    path = tmp_path / "problem.yaml"
    path.write_text("old")
    save_problem(make_problem("circle"), path)
    assert load_problem(path) == make_problem("circle")
    folder = tmp_path / "folder"
    folder.mkdir()
    for target in (folder, tmp_path / "nowhere" / "problem.yaml", path / "below"):
        with pytest.raises(ValueError, match=r"is a folder; give|does not exist; create it"):
            save_problem(make_problem("circle"), target)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["folder", "problem.yaml"]


def test_a_write_that_fails_keeps_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(file: Path, text: str, **options: str) -> None:
        file.write_bytes(text.encode()[:10])
        raise OSError(28, "No space left on device")

    path = tmp_path / "problem.yaml"
    path.write_text("old")
    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(ValueError, match=r"problem\.yaml cannot be written: No space left on device; free"):
        save_problem(make_problem("circle"), path)
    assert [(entry.name, entry.read_text()) for entry in tmp_path.iterdir()] == [("problem.yaml", "old")]


def test_the_example_is_what_it_says() -> None:
    problem = load_problem(str(EXAMPLE))
    assert problem.name == "mixed_team"
    assert problem.team.models == (*["differential_drive"] * 3, "holonomic2d", "velocity2d")
    assert problem.horizon == 120
    np.testing.assert_allclose(problem.team.radius, [0.15, 0.15, 0.2, 0.15, 0.1])
    np.testing.assert_allclose(problem.start[:4, 2], [0, 0, np.arctan2(-4, -5), -0.5], rtol=1e-6)
    assert (len(problem.world.circles), len(problem.world.boxes)) == (2, 1)
    assert problem.world.bounds.tolist() == [[-3.5, -3.5], [3.5, 3.5]]


def test_the_short_form_of_the_example_is_true() -> None:
    text = EXAMPLE.read_text(encoding="utf-8").partition("# The short form")[2].partition("\n")[2]
    problem = loaded(text.replace("#   ", ""))
    assert problem == make_problem("circle", 12, 7, model="differential_drive", num_obstacles=3)


def test_the_short_form_takes_every_argument_and_a_name() -> None:
    text = "version: 1\nname: mine\nscenario: swap\nnum_robots: 2\nradius: [0.1, 0.2]\nhorizon: null\ndistance: 1e1\n"
    problem = loaded(text)
    assert problem == make_problem("swap", 2, radius=[0.1, 0.2], distance=10.0)
    assert problem.name == "mine"


def test_defaults_of_a_file_are_those_of_problem_and_team() -> None:
    expected = Problem(Team(("holonomic2d",)), [[0, 0, 0, 0]], [[1, 0]])
    problem = loaded(MINIMAL)
    assert problem == expected
    assert problem.name == expected.name


@pytest.mark.parametrize(
    ("number", "value"), [("1e-3", 1e-3), ("+.5", 0.5), ("2", 2.0), ("007", 7.0), ("5.E-1", 0.5), ("1.5e0", 1.5)]
)
def test_numbers_as_people_write_them(number: str, value: float) -> None:
    assert loaded(f"dt: {number}\n{MINIMAL}").dt == value


BAD_FILES = [
    ("", "holds 0 YAML documents"),
    ("# nothing", "holds 0 YAML documents"),
    ("just text", "expected fields such as"),
    ("[1, 2]", "expected fields such as"),
    (f"---\n{MINIMAL}---\n{MINIMAL}", "holds 2 YAML documents"),
    ("version: 1\n robots: ]", "is not YAML: .* in line 2; correct that"),
    ("\tversion: 1", "is not YAML"),
    (b"\xff\xfe\x00", r"is not UTF-8 text \(byte 0\)"),
    (b"name: \x00", "is not YAML"),
    ("version: 1\nname: a\nname: b\n", "gives 'name' twice in line 3"),
    ("? [1]\n: 2", "a field name that is not plain text in line 1"),
    ("a: &x [1]\nb: *x", r"uses the alias \*x in line 2; write the value out"),
    ("!!python/object/apply:os.system ['true']", "uses the tag tag:yaml.org,2002:python.* in line 1"),
    ("dt: !!float 1", "uses the tag"),
    ("a: " + "[" * 100_000, "is nested more than 16 deep in line 1"),
    ("#" * 10_000_001, "is larger than 10 MB"),
    (MINIMAL.replace("version: 1\n", ""), "version: this field is missing"),
    (MINIMAL.replace("1", "2", 1), "version: input should be 1, not 2"),
    ("version: 1", "robots: this field is missing"),
    ("version: 1\nrobots: 5", "robots: input should be a valid list, not 5"),
    ("version: 1\nrobots: [5]", r"robots\[0\]: .* not 5"),
    (MINIMAL + "roberts: 2", "roberts: unknown field; known are version, name, dt, horizon"),
    (MINIMAL.replace("goal", "gaol"), r"robots\[0\].gaol: unknown field; .*; did you mean .goal.\?"),
    (
        MINIMAL.replace("start", "colour: red, start"),
        r"robots\[0\].colour: unknown field; known are model, start, goal",
    ),
    (MINIMAL + "world: {discs: []}", "world.discs: unknown field; known are bounds, circles"),
    (MINIMAL + "world: {circles: [{centre: [0, 1]}]}", r"world.circles\[0\].centre: unknown field; .* mean .center."),
    (MINIMAL + "world: {circles: [{center: [0, 1, 2], radius: 1}]}", r"world.circles\[0\].center: .* at most 2 items"),
    (MINIMAL.replace("[0, 0]", "[.nan, 0]"), r"robots\[0\].start\[0\]: input should be a finite number, not nan"),
    (MINIMAL.replace("[0, 0]", "[0, -.inf]"), r"robots\[0\].start\[1\]: input should be a finite number, not -inf"),
    (MINIMAL.replace("[0, 0]", "[0, 1e999]"), r"robots\[0\].start\[1\]: .* not inf"),
    (MINIMAL.replace("[0, 0]", "[0, 1e300]"), r"robots\[0\].start\[1\]: .* not 1e\+300"),
    (MINIMAL.replace("[0, 0]", "[0, zero]"), r"robots\[0\].start\[1\]: input should be a valid number, not 'zero'"),
    (MINIMAL.replace("[0, 0]", "[0, true]"), r"robots\[0\].start\[1\]: input should be a valid number, not True"),
    (MINIMAL.replace("[0, 0]", "[0]"), r"robots\[0\].start: \[0\] has 1 entries; give at least 2"),
    (MINIMAL.replace("[0, 0]", "[0, 0, 0]"), r"robots\[0\]: start .* has 3 components; a holonomic2d needs 2"),
    (MINIMAL.replace("holonomic2d", "boat"), r"robots\[0\]: model 'boat' is unknown; choose one of"),
    (
        MINIMAL.replace("goal", "heading: 1, goal"),
        r"robots\[0\]: a holonomic2d starts without heading; it has start, vel",
    ),
    (MINIMAL.replace("goal", "velocity: [2, 0], goal"), "start speed of robot_0 is 2 m/s, above its limit"),
    (MINIMAL.replace("goal", "radius: 0, goal"), "radius of robot_0 is 0; it must be positive"),
    (MINIMAL.replace(f"[{ROBOT}]", f"[{ROBOT}, {ROBOT}]"), "starts of robot_0 .* overlap"),
    (MINIMAL + "world: {spheres: [{center: [0, 5, 0], radius: 1}]}", "spheres need a world of dimension 3"),
    (MINIMAL + "world: {circles: [{center: [0, 0], radius: 1}]}", "start of robot_0 .* inside an obstacle"),
    (
        MINIMAL + "world: {boxes: [{lower: [0, 5], upper: [1]}]}",
        r"world.boxes\[0\].upper: \[1\] has 1 entries; give at least 2",
    ),
    (
        MINIMAL + "world: {boxes: [{lower: [0, 5], upper: [1, 6, 7]}]}",
        r"world.boxes\[0\]: lower has 2 components and up",
    ),
    (MINIMAL + "world: {bounds: {lower: [0, 5, 1], upper: [1, 6, 7]}}", "bounds lower has shape"),
    (MINIMAL + "dt: 0", "dt is 0; it must be positive"),
    (MINIMAL + "goal_radius: 1e200", "goal_radius: input should be less than or equal to 10+, not 1e\\+200"),
    (MINIMAL + "dt: 1:30", "dt: input should be a valid number, not '1:30'"),
    (MINIMAL + "horizon: 10.5", "horizon: input should be a valid integer, not 10.5"),
    (MINIMAL + "scenario: circle", "give either a scenario and its arguments, or robots and world"),
    ("version: 1\nscenario: labyrinth", "scenario 'labyrinth' is unknown"),
    ("version: 1\nscenario: [circle]", "scenario: input should be a valid string"),
    ("version: 1\nscenario: circle\ndiametre: 5", "takes no argument 'diametre'"),
    ("version: 1\nscenario: circle\ndiameter: .nan", "diameter is nan"),
    ("version: 1\nscenario: circle\nnum_robots: 60", "use diameter=6.69"),
]


@pytest.mark.parametrize(("text", "message"), BAD_FILES)
def test_bad_files_are_explained_in_one_line(text: str | bytes, message: str) -> None:
    with pytest.raises(ValueError, match=rf"problem\.yaml: .*{message}") as error:
        loaded(text)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 500


def test_what_is_no_file_is_refused(tmp_path: Path) -> None:
    for kind in (ValueError, FileNotFoundError):
        with pytest.raises(kind, match=r"absent\.yaml: cannot be read \(No such file or directory\)"):
            load_problem(tmp_path / "absent.yaml")
    with pytest.raises(ValueError, match="is not a file"):
        load_problem(tmp_path)
    with pytest.raises(ValueError, match="null"):
        load_problem("a\0b")


def valid_or_explained(text: str | bytes) -> None:
    problem, message = None, ""
    try:
        problem = loaded(text)
    except ValueError as error:
        message = str(error)
    assert "\n" not in message
    assert problem is None or saved_and_loaded(problem) == problem


@given(st.text() | st.binary())
@example("\ud800")
@example("a: 1" + "0" * 5000)
@example("- " * 1000)
def test_any_text_gives_a_value_error_or_a_problem(text: str | bytes) -> None:
    valid_or_explained(text)


WORDS = [
    *("version", "name", "dt", "horizon", "margin", "goal_radius", "goal_speed", "collision_penalty"),
    *("robots", "world", "scenario"),
    *("model", "start", "goal", "velocity", "heading", "speed", "radius", "max_speed", "max_acceleration"),
    *("bounds", "lower", "upper", "circles", "spheres", "cylinders", "boxes", "center"),
    *("num_robots", "seed", "num_obstacles", "diameter", "size", "jitter"),
]
SCALARS = (
    st.sampled_from(
        ["circle", "random", "sphere", "amswarm_1", *MODELS, 1, 1.0, 0, -0.0, "", None, True, 1e38, 1e-45, 1e200]
    )
    | st.floats()
    | st.integers(-3, 12)
)
VALUES = st.recursive(
    SCALARS,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(WORDS), inner, max_size=4),
    max_leaves=12,
)


@given(st.dictionaries(st.sampled_from(WORDS), VALUES, max_size=6), st.sampled_from([{}, {"scenario": "random"}]))
def test_any_content_gives_a_value_error_or_a_problem(content: dict[str, Any], form: dict[str, Any]) -> None:
    valid_or_explained(yaml.safe_dump({"version": 1, **form, **content}))


@given(st.sampled_from(WORDS), SCALARS, st.sampled_from(["robot", "world", "top"]))
def test_any_value_in_an_otherwise_good_file(field: str, value: Any, where: str) -> None:
    content = yaml.safe_load(EXAMPLE.read_text(encoding="utf-8"))
    part = {"robot": content["robots"][3], "world": content["world"]["circles"][0], "top": content}[where]
    part[field] = value
    valid_or_explained(yaml.safe_dump(content))


# Files that ask for too much.


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (MINIMAL + "horizon: 100000000", "horizon is 100000000; it must be at most 1000000"),
        (
            "version: 1\nscenario: random\nnum_robots: 51\nhorizon: 1000000",
            "horizon is 1000000 steps for 51 robots; it must be at most 980392",
        ),
        (MINIMAL + "horizon: 999999999999", "horizon is 999999999999"),
        ("version: 1\nscenario: circle\nhorizon: 100000000", "horizon is 100000000"),
        ("version: 1\nrobots: [" + "1," * 4_400_000 + "1]", "has a list of more than 10000 entries in line 2"),
        ("version: 1\nrobots: [" + "[1,1,1]," * 900_000 + "1]", "has a list of more than 10000 entries in line 2"),
        ("a: [" + ("[" + "1," * 9_999 + "1],") * 60 + "1]", "holds more than 500000 values"),
    ],
    ids=["horizon", "robots and steps", "endless", "short form", "flat", "nested", "many lists"],
)
def test_more_than_memory_holds_is_refused_before_it_is_read(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "huge.yaml"
    path.write_text(text)
    with pytest.raises(ValueError, match=message) as caught:
        load_problem(path)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 300


def test_the_largest_teams_of_the_scenarios_fit_into_a_file() -> None:
    row = "{model: differential_drive, start: [%d, 0], goal: [%d, 5], heading: 0, speed: 0, radius: 0.1, "
    limits = "max_speed: 1, max_acceleration: 1, max_turn_rate: 1}"
    robots = "\n".join(f"  - {row % (k, k)}{limits}" for k in range(10_000))
    assert len(parse_yaml(f"version: 1\nrobots:\n{robots}\n")["robots"]) == 10_000


def test_numbers_are_those_of_yaml_1_2() -> None:
    text = "[1e-4, -1E5, .5, 5., 1e21, 12, 0x1F, 0o17, 1:30, on, yes, true, ~, '1e-4', 1_000]"
    assert parse_yaml(text) == [
        1e-4, -1e5, 0.5, 5.0, 1e21, 12, "0x1F", "0o17", "1:30", "on", "yes", True, None, "1e-4", "1_000",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("footprint", "message"),
    [
        ("{shape: polygon, corners: [[0, 0], [1, 0], [0.2, 0.2], [0, 1]]}", "Polygon is not convex at corner 2"),
        ("{shape: box, length: 0.3}", "footprint box lacks width"),
        ("{shape: disc, radius: -1}", "radius of Disc is -1; it must be positive"),
        ("3", "footprint must be a mapping such as"),
    ],
)
def test_a_bad_footprint_names_its_robot(tmp_path: Path, footprint: str, message: str) -> None:
    robots = "".join(
        f"  - {{model: unicycle, start: [0, {y}], goal: [2, {y}], footprint: {shape}}}\n"
        for y, shape in ((0, "{shape: disc, radius: 0.2}"), (3, "null"), (6, footprint))
    )
    (tmp_path / "scene.yaml").write_text(f"version: 1\nrobots:\n{robots}")
    with pytest.raises(ValueError, match=re.escape(f"scene.yaml: robots[2].footprint: {message}")):
        load_problem(tmp_path / "scene.yaml")


def test_an_empty_footprint_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "one.yaml"
    path.write_text("version: 1\nrobots:\n  - {model: unicycle, start: [0, 0], goal: [2, 0], footprint: {}}\n")
    with pytest.raises(ValueError, match="footprint"):
        load_problem(path)


def test_tolerances_of_robots_without_goal_headings_are_kept(tmp_path: Path) -> None:
    headings = {"goal_heading": [0, np.nan, np.nan], "goal_heading_tolerance": [0.2, 0.3, 0.1]}
    problem = Problem(Team(("unicycle",) * 3), [[0, k, 0] for k in range(3)], [[2, k] for k in range(3)], **headings)
    save_problem(problem, tmp_path / "one.yaml")
    loaded = load_problem(tmp_path / "one.yaml")
    np.testing.assert_array_equal(loaded.goal_heading_tolerance, np.float32([0.2, 0.3, 0.1]))
