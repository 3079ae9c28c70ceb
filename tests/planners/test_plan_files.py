"""Plan files: what is saved comes back to the bit, and what is not a plan is refused in one line."""

from __future__ import annotations

import io
import json
import os
import pickle
import shutil
import stat
import zipfile
from collections.abc import Callable
from dataclasses import FrozenInstanceError, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from planner_support import cheap_planner, hop_problem
from registry_support import forgetting

import d4orm_env
from d4orm_env.core.trajectory import Trajectory
from d4orm_env.dynamics.models import MODELS
from d4orm_env.scenarios import make_problem
from d4orm_planners import Plan, load_plan, make_planner


@pytest.fixture(scope="module")
def plan() -> Plan:
    return cheap_planner("d4orm").solve(hop_problem(), seed=2**40)


@pytest.fixture
def saved(plan: Plan, tmp_path: Path) -> Path:
    path = tmp_path / "plan.npz"
    plan.save(path)
    return path


def assert_equal(a: Plan, b: Plan) -> None:
    for field in fields(Plan):
        left, right = getattr(a, field.name), getattr(b, field.name)
        if field.name == "trajectory":
            for part in fields(Trajectory):
                one, other = getattr(left, part.name), getattr(right, part.name)
                assert one.dtype == other.dtype
                np.testing.assert_array_equal(one, other)
        elif field.name == "controls":
            assert left.dtype == right.dtype
            np.testing.assert_array_equal(left, right)
        else:
            assert left == right
            assert type(left) is type(right)


@pytest.mark.parametrize(
    "case",
    [
        {"scenario": "circle", "num_robots": 3},
        {"scenario": "heterogeneous", "num_robots": 4},
        {"scenario": "four_obstacles", "num_robots": 4, "model": "differential_drive", "goal_speed": 0.3},
        {"scenario": "random", "num_robots": 3, "model": "velocity2d", "num_obstacles": 2, "seed": 5, "dt": 0.07},
        {"scenario": "amswarm_4"},
    ],
    ids=lambda case: case["scenario"],
)
def test_a_plan_comes_back_to_the_bit(case: dict[str, Any], tmp_path: Path) -> None:
    plan = cheap_planner("d4orm").solve(make_problem(**case), seed=1)
    plan.save(tmp_path / "plan.npz")
    loaded = load_plan(str(tmp_path / "plan.npz"))
    assert_equal(plan, loaded)
    assert loaded.problem.name == plan.problem.name


def test_plans_and_trajectories_stay_what_they_are_and_equal_only_themselves(plan: Plan) -> None:
    for thing in (plan, plan.trajectory):
        assert len({thing, thing, replace(thing)}) == 2  # type: ignore[type-var]
        with pytest.raises(FrozenInstanceError):
            setattr(thing, fields(thing)[0].name, None)


@pytest.mark.parametrize("planner", ["mppi", "cem", "i-mbd"])
def test_plans_of_other_planners_do_too(planner: str, tmp_path: Path) -> None:
    plan = cheap_planner(planner).solve(hop_problem(), seed=1)
    plan.save(tmp_path / "plan.npz")
    assert_equal(plan, Plan.load(tmp_path / "plan.npz"))


def test_a_plan_without_iterations_does_too(tmp_path: Path) -> None:
    problem = hop_problem(1)
    ahead = np.broadcast_to(np.array([1, 0], np.float32), (problem.horizon, 1, 2))
    plan = cheap_planner("d4orm").solve(problem, initial_controls=ahead)
    assert plan.history == ()
    plan.save(tmp_path / "plan.npz")
    assert_equal(plan, Plan.load(tmp_path / "plan.npz"))


def test_a_plan_says_how_it_was_made(tmp_path: Path) -> None:
    plan = cheap_planner("d4orm", preset="paper", temperature=0.25).solve(hop_problem(), seed=3)
    plan.save(tmp_path / "plan.npz")
    made = Plan.load(tmp_path / "plan.npz").provenance
    assert made is not None
    assert made == plan.provenance
    assert (made.preset, made.settings["temperature"], made.version) == ("paper", 0.25, d4orm_env.__version__)
    assert made.machine["cores"] == os.cpu_count()
    again = make_planner(plan.planner, **made.settings)
    assert again.config == cheap_planner("d4orm", preset="paper", temperature=0.25).config


def test_a_plan_of_an_older_file_does_not_say(saved: Path) -> None:
    header, arrays = contents(saved)
    del header["provenance"]
    rewrite(saved, header, arrays)
    assert Plan.load(saved).provenance is None


def test_saving_replaces_the_file_and_leaves_no_other(plan: Plan, saved: Path) -> None:
    other = cheap_planner("cem").solve(hop_problem(2))
    other.save(saved)
    assert_equal(other, Plan.load(saved))
    assert list(saved.parent.iterdir()) == [saved]


@pytest.mark.skipif(os.name != "posix", reason="file modes of POSIX")
def test_the_file_may_be_read_by_those_who_may_read_new_files(saved: Path) -> None:
    reference = saved.with_name("reference")
    reference.touch()
    assert stat.S_IMODE(saved.stat().st_mode) == stat.S_IMODE(reference.stat().st_mode)


def refuse(path: Path, message: str = "is not a readable plan") -> str:
    with pytest.raises(ValueError, match=message) as caught:
        Plan.load(path)
    text = str(caught.value)
    assert "\n" not in text
    assert path.name in text
    return text


@pytest.mark.parametrize("name", ["plan", "plan.yaml", "plan.npz.bak", "plan.npy"])
def test_another_suffix_is_refused(plan: Plan, tmp_path: Path, name: str) -> None:
    with pytest.raises(ValueError, match=r"must end in \.npz"):
        plan.save(tmp_path / name)
    with pytest.raises(ValueError, match=r"must end in \.npz"):
        Plan.load(tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_a_missing_file_is_not_found(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"there is no plan at .*nowhere\.npz; write one with"):
        Plan.load(tmp_path / "nowhere.npz")
    for kind in (ValueError, FileNotFoundError):
        with pytest.raises(kind, match="there is no plan at"):
            Plan.load(tmp_path / "no" / "folder.npz")


def test_a_folder_is_no_plan(tmp_path: Path) -> None:
    folder = tmp_path / "folder.npz"
    folder.mkdir()
    refuse(folder)


def test_a_missing_folder_is_reported_and_not_made(plan: Plan, tmp_path: Path) -> None:
    with pytest.raises(OSError, match="missing"):
        plan.save(tmp_path / "missing" / "plan.npz")
    assert not list(tmp_path.iterdir())


def test_a_file_in_place_of_the_folder_is_reported_and_left_alone(plan: Plan, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(OSError, match="file"):
        plan.save(tmp_path / "file" / "plan.npz")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
    assert (tmp_path / "file").read_text() == "mine"


def test_an_unwritable_folder_is_left_alone(plan: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def forbidden(path: Path, **_: Any) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    # Root, who may run this, can write anywhere.
    monkeypatch.setattr(Path, "touch", forbidden)
    with pytest.raises(ValueError, match=r"plan\.npz cannot be written: Permission denied; free some"):
        plan.save(tmp_path / "plan.npz")
    assert not list(tmp_path.iterdir())


def test_a_full_disk_is_reported_with_the_name_of_the_file(
    plan: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any, **__: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez_compressed", full)
    with pytest.raises(ValueError, match=r"plan\.npz cannot be written: No space left on device; free some"):
        plan.save(tmp_path / "plan.npz")


@pytest.mark.parametrize("error", [OSError("disk full"), KeyboardInterrupt()], ids=["full", "ctrl-c"])
def test_a_write_that_fails_half_way_leaves_the_old_file_and_nothing_else(
    plan: Plan, saved: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException
) -> None:
    before = saved.read_bytes()

    def half_written(file: Any, **_: Any) -> None:
        file.write(b"PK half")
        raise error

    monkeypatch.setattr(np, "savez_compressed", half_written)
    with pytest.raises(type(error)):
        plan.save(saved)
    with pytest.raises(type(error)):
        plan.save(saved.with_name("new.npz"))
    assert saved.read_bytes() == before
    assert list(saved.parent.iterdir()) == [saved]


@pytest.mark.parametrize("share", [0.0, 0.01, 0.3, 0.7, 0.99])
def test_a_truncated_file_is_refused(saved: Path, share: float) -> None:
    content = saved.read_bytes()
    saved.write_bytes(content[: int(share * len(content))])
    refuse(saved)


def test_a_file_with_one_wrong_byte_is_refused_or_is_the_same_plan(plan: Plan, saved: Path) -> None:
    content = saved.read_bytes()
    random = np.random.default_rng(0)
    refused: list[str] = []
    for position in random.choice(len(content), 400, replace=False):
        damaged = bytearray(content)
        damaged[position] ^= int(random.integers(1, 256))
        saved.write_bytes(damaged)
        try:
            loaded = Plan.load(saved)
        except ValueError as error:
            refused.append(str(error))
        else:
            # Time stamps and the like may change.
            assert_equal(plan, loaded)
    assert len(refused) > 200
    assert not any("\n" in message for message in refused)


@pytest.mark.parametrize("garbage", [b"", b"not a plan at all", b"PK\x03\x04 not really", bytes(range(256)) * 40])
def test_garbage_is_refused(tmp_path: Path, garbage: bytes) -> None:
    path = tmp_path / "garbage.npz"
    path.write_bytes(garbage)
    refuse(path)


class Bomb:
    """Says so when it is unpickled."""

    def __init__(self, witness: Path) -> None:
        self.witness = witness

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return Path.touch, (self.witness,)


def test_a_pickle_is_refused_and_not_run(tmp_path: Path) -> None:
    path, witness = tmp_path / "pickle.npz", tmp_path / "witness"
    path.write_bytes(pickle.dumps(Bomb(witness)))
    refuse(path)
    assert not witness.exists()
    pickle.loads(path.read_bytes())
    assert witness.exists()  # so the pickle would have run


def contents(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    with np.load(path, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    return json.loads(str(arrays.pop("header"))), arrays


def rewrite(path: Path, header: Any, arrays: dict[str, Any]) -> None:
    np.savez_compressed(path, header=np.array(json.dumps(header)), **arrays)


@pytest.mark.parametrize("name", ["header", "controls"])
def test_an_array_of_objects_is_refused_and_not_unpickled(saved: Path, name: str) -> None:
    header, arrays = contents(saved)
    witness = saved.with_name("witness")
    members = {"header": np.array(json.dumps(header)), **arrays, name: np.array([Bomb(witness)], object)}
    np.savez_compressed(saved, **members)
    refuse(saved, "allow_pickle=False")
    assert not witness.exists()


def test_what_does_not_belong_there_is_not_unpacked(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    header, arrays = contents(saved)
    unpacked: list[str] = []
    open_member = zipfile.ZipFile.open

    def recorded(archive: zipfile.ZipFile, member: Any, *rest: Any, **options: Any) -> Any:
        unpacked.append(getattr(member, "filename", member))
        return open_member(archive, member, *rest, **options)

    monkeypatch.setattr("d4orm_planners.base.plan_file.HEADER_BYTES", 10**6)
    large = {"extra": np.zeros(10**7), "controls": np.zeros(10**7), "header": np.array("0" * 10**6)}
    for name, content in large.items():
        np.savez_compressed(saved, **({"header": np.array(json.dumps(header)), **arrays} | {name: content}))
        unpacked.clear()
        with monkeypatch.context() as patch:
            patch.setattr(zipfile.ZipFile, "open", recorded)
            text = refuse(saved)
        assert f"{name}.npy" not in unpacked
        assert ("it holds" if name == "extra" else f"{name} does not fit") in text


def test_what_is_there_twice_is_refused(saved: Path) -> None:
    with zipfile.ZipFile(saved, "a") as archive, pytest.warns(UserWarning, match="Duplicate name"):
        archive.writestr("controls.npy", archive.read("controls.npy"))
    refuse(saved, "it holds")


# What a file claims.


@pytest.fixture
def solved(tmp_path: Path) -> tuple[Plan, Path]:
    problem = hop_problem()
    given = np.zeros((problem.horizon, 3, 2))
    given[..., 0] = 1
    plan = cheap_planner("d4orm").solve(problem, initial_controls=given)
    assert plan.solved
    assert plan.verified
    path = tmp_path / "solved.npz"
    plan.save(path)
    return plan, path


def test_a_solution_is_still_one_when_loaded(solved: tuple[Plan, Path]) -> None:
    plan, path = solved
    loaded = Plan.load(path)
    assert_equal(plan, loaded)
    assert loaded.verified


@pytest.mark.parametrize(
    ("status", "is_solved"), [("solved", False), ("refuted", True), ("abandoned", True), ("abandoned", False)]
)
def test_status_and_solved_cannot_contradict(solved: tuple[Plan, Path], status: Any, is_solved: bool) -> None:
    with pytest.raises(ValueError, match=f"status (is )?'{status}'"):
        replace(solved[0], status=status, solved=is_solved)


def test_a_file_that_was_refuted_in_vain_is_solved_again(solved: tuple[Plan, Path]) -> None:
    _, path = solved
    header, arrays = contents(path)
    rewrite(path, {**header, "status": "refuted", "solved": False}, arrays)
    loaded = Plan.load(path)
    assert (loaded.solved, loaded.status) == (True, "solved")


@pytest.mark.parametrize("forged", ["beyond limits", "none", "one robot fewer"])
def test_what_a_file_claims_of_its_controls_is_judged_anew(solved: tuple[Plan, Path], forged: str) -> None:
    plan, path = solved
    header, arrays = contents(path)
    if forged == "beyond limits":
        arrays["controls"][:] = -1e6
    elif forged == "none":
        arrays["controls"][:] = 0
    else:
        arrays["controls"][:, 1] = 0
    rewrite(path, header, arrays)
    loaded = Plan.load(path)
    assert (loaded.solved, loaded.status) == (False, "refuted")
    assert not loaded.verified
    assert np.abs(loaded.controls).max() <= plan.problem.team.control_limits.max()
    assert loaded.metrics["success"] == 0
    assert len(loaded.failures) == (1 if forged == "one robot fewer" else 3)


def test_a_trajectory_that_is_none_of_the_controls_does_not_count(solved: tuple[Plan, Path]) -> None:
    plan, path = solved
    header, arrays = contents(path)
    arrays["arrived"][:] = False
    arrays["states"][:] += 1
    rewrite(path, header | {"metrics": header["metrics"] | {"travel_time": 0.1}}, arrays)
    loaded = Plan.load(path)
    assert loaded.solved
    np.testing.assert_array_equal(loaded.trajectory.arrived, plan.trajectory.arrived)
    np.testing.assert_allclose(loaded.trajectory.states, plan.trajectory.states, atol=1e-4)
    assert loaded.metrics["travel_time"] == pytest.approx(plan.metrics["travel_time"])


def test_a_plain_array_is_no_plan(tmp_path: Path) -> None:
    path = tmp_path / "array.npz"
    buffer = io.BytesIO()
    np.save(buffer, np.zeros(3))
    path.write_bytes(buffer.getvalue())
    refuse(path)


def test_another_archive_is_no_plan(tmp_path: Path) -> None:
    path = tmp_path / "other.npz"
    np.savez(path, weights=np.zeros(3))
    refuse(path, "header")
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("readme.txt", "hello")
    refuse(path)


def test_another_version_is_refused(saved: Path) -> None:
    header, arrays = contents(saved)
    rewrite(saved, header | {"format": "d4orm-plan-2"}, arrays)
    refuse(saved, "another version")


@pytest.mark.parametrize(
    "change",
    [
        lambda header: header.pop("problem"),
        lambda header: header.pop("seed"),
        lambda header: header.update(problem=4),
        lambda header: header["problem"].update(dt=-1),
        lambda header: header["problem"].update(surprise=1),
        lambda header: header.update(seed="0"),
        lambda header: header.update(solved="yes"),
        lambda header: header.update(metrics=[1, 2]),
        lambda header: header["metrics"].update(reward="much"),
        lambda header: header.update(history=[{"iteration": 1}]),
        lambda header: header.update(history=4),
        lambda header: header["history"][0].update(surprise=1),
        lambda header: header.update(provenance=4),
        lambda header: header["provenance"].update(settings="all"),
        lambda header: header["provenance"].pop("version"),
    ],
)
def test_a_header_that_makes_no_sense_is_refused(saved: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    header, arrays = contents(saved)
    change(header)
    rewrite(saved, header, arrays)
    refuse(saved)


@pytest.mark.parametrize("header", [None, 4, "plan", [1, 2], {}])
def test_a_header_of_another_kind_is_refused(saved: Path, header: Any) -> None:
    _, arrays = contents(saved)
    rewrite(saved, header, arrays)
    refuse(saved)


NAMES = tuple(field.name for field in fields(Trajectory))


@pytest.mark.parametrize("name", NAMES)
def test_an_array_that_does_not_fit_the_problem_is_refused(saved: Path, name: str) -> None:
    header, arrays = contents(saved)
    for wrong in (arrays[name][:-1], arrays[name][:, :-1], arrays[name][None], arrays[name].astype(np.int32)):
        rewrite(saved, header, arrays | {name: wrong})
        refuse(saved, f"{name} does not fit")
    rewrite(saved, header, {key: value for key, value in arrays.items() if key != name})
    refuse(saved, name)


@pytest.mark.parametrize("name", ["states", "positions", "controls", "rewards"])
def test_a_number_that_is_not_finite_is_refused(saved: Path, name: str) -> None:
    header, arrays = contents(saved)
    for bad in (np.nan, np.inf):
        arrays[name].flat[3] = bad
        rewrite(saved, header, arrays)
        refuse(saved, name)


DRIFTER = """
import dataclasses

from d4orm_env import make_problem, register_model
from d4orm_env.dynamics.models import get_model

register_model(dataclasses.replace(get_model("velocity2d"), name="drifter"))


def arena(seed, num_robots=2):
    return make_problem("circle", num_robots=num_robots, seed=seed, model="drifter")
"""


@pytest.mark.parametrize("command", [("run",), ("export", "--out", "out")])
def test_the_command_line_knows_the_robots_of_a_scenarios_module(command: Any, tmp_path: Path, d4orm: Any) -> None:
    (tmp_path / "own.py").write_text(DRIFTER)
    arguments = (*command, "plan.npz")
    with forgetting(MODELS):
        problem = make_problem("own.py:arena")
        make_planner("d4orm").solve(problem, seed=0).save("plan.npz")
        shutil.copy("own.py", "again.py")
    outcome = d4orm(*arguments)
    assert outcome.status == 2
    assert "model 'drifter' is unknown" in outcome.err
    assert "as --scenario FILE.py:FUNCTION does" in outcome.err
    with forgetting(MODELS):
        outcome = d4orm(*arguments, "--scenario", "again.py:arena")
        assert outcome.status == 0, outcome.err
