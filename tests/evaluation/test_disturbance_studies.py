"""Studies of disturbances: what runs, what is stored, and what comes out."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from io import BytesIO
from itertools import combinations
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from disturbance_support import Wind
from env_support import line_problem
from test_robustness import trial

from d4orm_env import mujoco, navigation_v0
from d4orm_env.disturbances import Delay, Intruder, LimitMismatch, Push, Stall
from d4orm_planners import evaluate, run_episode
from d4orm_planners.evaluation.comparison import compare_pairs, newcombe_interval
from d4orm_planners.evaluation.disturbance_figures import draw_lines, draw_map
from d4orm_planners.evaluation.evaluate import run_shard, run_study
from d4orm_planners.evaluation.leaderboard import leaderboard
from d4orm_planners.evaluation.robustness import tolerances, write_disturbances, write_robustness
from d4orm_planners.evaluation.store import STORE, TrialStore
from d4orm_planners.evaluation.study import Study, conditions
from d4orm_planners.evaluation.summary import SuccessRate, TrialGroup, success_rates
from d4orm_planners.evaluation.tables import markdown
from d4orm_planners.evaluation.trials import Condition

TINY: dict[str, Any] = {"num_robots": 2, "seeds": range(2), "workers": 1}
Call = Callable[..., tuple[int, str, str]]


def test_conditions_are_one_disturbance_at_a_time() -> None:
    found = conditions([0.0, 0.1], {"delay": [0, 2], "push.speed": [0.3]})
    assert [(one.control_noise_std, one.name, one.level, one.disturbances) for one in found] == [
        (noise, name, level, (disturbance,))
        for noise in (0.0, 0.1)
        for name, level, disturbance in (
            ("delay", 0, Delay(0)),
            ("delay", 2, Delay(2)),
            ("push.speed", 0.3, Push(speed=0.3)),
        )
    ]
    assert found[0].text == "[]"
    assert (
        Condition(disturbances=(Stall(0.5),)).text
        == '[["stall", {"duration": "inf", "probability": 0.5, "robots": null}]]'
    )
    assert json.loads(found[2].text) == [["push", {"rate": 0.2, "speed": 0.3}]]


def test_instances_are_levels_too() -> None:
    given = {"wind": [Wind(0.1), Wind(0.3)], "both": [[], [Delay(1), Wind()]], "late": [Delay(1), Delay((1, 3))]}
    found = conditions(0.0, given)
    assert [(one.name, one.level) for one in found] == [
        ("wind", 0.1), ("wind", 0.3), ("both", 0), ("both", 1), ("late", 0), ("late", 1)
    ]  # fmt: skip
    ((name, attributes),) = json.loads(found[0].text)
    assert name == "disturbance_support:Wind"
    assert len(attributes["source"]) == 64
    assert [Condition(disturbances=(one,)).replayable for one in (Delay(1), Wind(), Push(), Stall(0.1))] == [
        True, False, False, True
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("disturbances", "complaint"),
    [
        ({}, "disturbances is empty"),
        ({"delay": []}, r"disturbances\['delay'\] is empty"),
        (["delay"], r"disturbances is \['delay'\]; give levels by name"),
        ({"dely": [1]}, "disturbance 'dely' is unknown"),
        ({"delay": [-1]}, "Delay steps is -1"),
        ({"delay": ["much"]}, "Delay steps must be a whole number"),
        ({"push.force": [1]}, "disturbance 'push' has no 'force'"),
        ({"drag": [0.5]}, "Drag slows what has inertia, and robot_0, a velocity2d"),
    ],
)
def test_what_makes_no_sense_is_refused_before_anything_runs(tmp_path: Path, disturbances: Any, complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        evaluate("go-to-goal", line_problem([1.0]), out=tmp_path / "out", disturbances=disturbances)
    assert not (tmp_path / "out").exists()


def test_every_trial_is_stored_with_its_disturbance_and_run_once(tmp_path: Path) -> None:
    counts: list[tuple[int, int]] = []
    study: dict[str, Any] = {
        **TINY,
        "out": tmp_path,
        "progress": lambda what, done, total: counts.append((done, total)),
    }
    rows = evaluate("go-to-goal", disturbances={"delay": [0, 1], "push.speed": [0.0, 0.4]}, **study)
    assert [(row.disturbance, row.level, row.trials) for row in rows] == [
        ("delay", 0, 2), ("delay", 1, 2), ("push.speed", 0, 2), ("push.speed", 0.4, 2)
    ]  # fmt: skip
    # Both at level zero are the undisturbed trials, which run once.
    assert counts[-1] == (6, 6)
    assert [row.verified for row in rows] == [0, 0, 0, None]
    stored = TrialStore.existing(tmp_path).trials()
    assert sorted({row.disturbances for row in stored}) == [
        '[["delay", {"steps": 1}]]', '[["push", {"rate": 0.2, "speed": 0.4}]]', "[]"
    ]  # fmt: skip
    assert {row.disturbances: row.verified is None for row in stored}['[["push", {"rate": 0.2, "speed": 0.4}]]']
    counts.clear()
    more = evaluate("go-to-goal", disturbances={"delay": [0, 1, 2]}, **study)
    assert counts[0] == (4, 6)
    assert more[:2] == rows[:2]
    assert all(row.disturbance == "" and row.trials == 2 for row in evaluate("go-to-goal", **study))
    assert "delay steps=1" in leaderboard(TrialStore.existing(tmp_path).trials())


def test_trials_are_those_of_the_environment(tmp_path: Path) -> None:
    problem, disturbances = line_problem([1.0, 1.5], "holonomic2d"), [Delay(2), Intruder(2)]
    ((group,), _) = (run_study(Study(policies="go-to-goal", scenarios=problem, seeds=[4], disturbances={"x": [one]}),
                     tmp_path, workers=1) for one in (disturbances, disturbances))  # fmt: skip
    episode = run_episode(navigation_v0.parallel_env(problem=problem, disturbances=disturbances), "go-to-goal", seed=4)
    (row,) = group.trials
    assert (row.travel_time, row.collided) == (episode.metrics["travel_time"], episode.metrics["collided"])


def test_the_same_trial_in_another_physics_is_another_one(tmp_path: Path) -> None:
    problem = line_problem([1.0, 1.5], "differential_drive")
    for physics in ("model", "mujoco", "mujoco"):
        evaluate("go-to-goal", problem, seeds=[4], workers=1, out=tmp_path, physics=physics)
    ours, theirs = TrialStore.existing(tmp_path).trials()
    assert (ours.physics, theirs.physics) == ("model", "mujoco")
    assert ours.key == replace(theirs.key, physics="model")
    assert ours.verified
    assert theirs.verified is None
    episode = run_episode(mujoco.parallel_env(problem=problem), "go-to-goal", seed=4)
    assert (theirs.travel_time, theirs.reward) == (episode.metrics["travel_time"], episode.metrics["reward"])
    assert theirs.reward != ours.reward
    assert "custom, 2 robots, differential_drive, in mujoco" in leaderboard([ours, theirs], [1.0])


@pytest.mark.parametrize(("physics", "complaint"), [("bullet", "physics is 'bullet'"), ("mujoco", "robot_0 is a car")])
def test_a_physics_that_cannot_be_is_refused_before_anything_runs(tmp_path: Path, physics: str, complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        evaluate("go-to-goal", line_problem([1.0], "car"), out=tmp_path / "out", physics=physics)
    assert not (tmp_path / "out").exists()


def test_the_physics_on_the_command_line(tmp_path: Path, d4orm: Call) -> None:
    options = ["-k", "2", "--physics", "mujoco", "--policy", "go-to-goal"]
    assert d4orm("run", *options, "--model", "differential_drive")[0] in (0, 1)
    assert d4orm("evaluate", *options, "-n", "1", "-j", "1", "-o", str(tmp_path))[0] == 0
    assert [trial.physics for trial in TrialStore.existing(tmp_path).trials()] == ["mujoco"]
    for command in (["run"], ["evaluate", "-o", str(tmp_path)]):
        status, _, complaint = d4orm(*command, *options[:2], "--policy", "go-to-goal", "--physics", "bullet")
        assert (status, complaint) == (2, "d4orm: physics is 'bullet'; choose one of model, mujoco, crazyflow\n")


def test_a_stalled_robot_does_not_spoil_the_trial(tmp_path: Path) -> None:
    problem = line_problem([2.0] * 3, horizon=60)
    (rate,) = evaluate("go-to-goal", problem, out=tmp_path, seeds=range(4), workers=1,
                       disturbances={"one stalls": [Stall(1.0, robots=1)]})  # fmt: skip
    assert rate.successes == 4
    assert rate.late > 0


def group(label: str, level: float | None, wins: str, disturbance: str = "delay", **changes: Any) -> TrialGroup:
    """A group with a trial for every character, ``+`` for a success; without effect at level 0."""
    changes.setdefault("disturbances", '[["delay", {}]]' if level else "[]")
    rows = [trial(seed, label=label, success=mark == "+", **changes) for seed, mark in enumerate(wins)]
    return TrialGroup(label, rows, disturbance, level)


def test_the_level_at_which_success_falls_below_90_percent_of_the_undisturbed() -> None:
    good, bad = "+" * 10, "+" * 8 + "--"
    rates = success_rates(
        [group("a", 0, good), group("a", 1, good), group("a", 2, bad), group("a", 4, good), group("b", 0, good),
         group("b", 1, good), group("c", 0, bad), group("c", 1, bad), group("c", None, bad, ""),
         group("d", 0, "-" * 10), group("d", 1, "-" * 10), group("e", 0, bad), group("e", 1, "+" * 7 + "-" * 3)]
    )  # fmt: skip
    assert [(one.label, one.passes, one.fails, one.text) for one in tolerances(rates)] == [
        ("a", 1, 2, "2"), ("b", 1, None, "beyond 1"), ("c", 1, None, "beyond 1"), ("d", None, None, "-"),
        ("e", 0, 1, "1"),
    ]  # fmt: skip


def test_the_undisturbed_success_is_that_without_effect_in_any_order() -> None:
    good, bad = "+" * 10, "+" * 8 + "--"
    groups = [group("a", 2, bad), group("a", 1, good), group("a", 0, good), group("a", 3, good, "push.speed"),
              group("a", 5, bad, "push.speed")]  # fmt: skip
    for order in (groups, groups[::-1]):
        found = {one.disturbance: one for one in tolerances(success_rates(order))}
        assert (found["delay"].text, found["delay"].passes, found["delay"].undisturbed) == ("2", 1, 1.0)
        assert found["push.speed"].undisturbed == 1.0
    ranges = [group("a", level, wins, "occlusion.range", disturbances="[]" if level == inf else "[[1]]")
              for level, wins in ((1.0, bad), (2.0, good), (inf, good))]  # fmt: skip
    assert [(one.passes, one.fails) for one in tolerances(success_rates(ranges))] == [(2.0, 1.0)]


def test_without_a_level_without_effect_no_tolerance_is_named(tmp_path: Path) -> None:
    groups = [group("a", level, "+++", control_noise_std=0.0) for level in (1, 2)]
    (one,) = tolerances(success_rates(groups))
    assert (one.undisturbed, one.threshold, one.passes, one.fails, one.text) == (None, None, None, None, "-")
    write_disturbances(tmp_path, groups)
    text = (tmp_path / "disturbances.md").read_text()
    assert "| undisturbed success | not run |" in text
    assert "give one a level without effect" in text
    with (tmp_path / "tolerance.csv").open(newline="") as file:
        (row,) = csv.DictReader(file)
    assert row["undisturbed"] == row["threshold"] == row["passes"] == row["fails"] == ""


def test_policies_that_failed_are_told_first(tmp_path: Path) -> None:
    groups = [group("a", level, wins, error=error) for level, wins, error in ((0, "+++", ""), (1, "---", "it broke"))]
    write_disturbances(tmp_path, groups)
    assert (tmp_path / "disturbances.md").read_text().startswith("### Errors\n\n- `a`: it broke\n")


def test_pairs_are_compared_by_seed() -> None:
    (pair,) = compare_pairs(
        [group("a", 1, "+++++++++---", travel_time=5.0), group("b", 1, "++----------", travel_time=6.0)]
    )
    assert (pair.first, pair.second, pair.trials) == ("a", "b", 12)
    assert (pair.only_first, pair.only_second) == (7, 0)
    assert pair.p_value == pytest.approx(2 * 0.5**7)  # the exact binomial test of 7 out of 7
    assert pair.difference == pytest.approx(7 / 12)
    assert (pair.lower, pair.upper) == newcombe_interval(2, 7, 0, 3)
    assert (pair.slower, pair.slower_lower, pair.slower_upper) == (-1, -1, -1)
    # Other problems, conditions and single policies have no pairs.
    assert compare_pairs([group("a", 1, "+"), group("b", 2, "+"), group("c", 1, "+", problem="other")]) == []


def test_the_files_of_a_study(tmp_path: Path) -> None:
    groups = [
        group(label, level, wins, name, disturbances=kinds)
        for label in ("a", "b")
        for name in ("delay", "push.speed", "own thing")
        for level, wins, kinds in ((0, "+++", "[]"), (1, "++-", f'[["{name}", {{}}]]'))
    ]
    written = write_disturbances(tmp_path, groups)
    assert [path.name for path in written] == [
        "disturbances.md", "tolerance.csv", "pairs.csv", "disturbances.pdf", "disturbances.svg", "disturbances.png",
        "disturbance_map.pdf", "disturbance_map.svg", "disturbance_map.png",
    ]  # fmt: skip
    begins = {".png": b"\x89PNG", ".pdf": b"%PDF", ".svg": b"<?xml"}
    assert all(path.read_bytes().startswith(begins.get(path.suffix, b"")) for path in written)
    with (tmp_path / "tolerance.csv").open(newline="") as file:
        assert [(row["label"], row["disturbance"], row["fails"]) for row in csv.DictReader(file)][:2] == [
            ("a", "delay", "1"), ("a", "push.speed", "1")
        ]  # fmt: skip
    text = (tmp_path / "disturbances.md").read_text()
    assert "| success with noise 0.1 alone | 100% | 100% |" in text
    assert "- `disturbances`, `disturbance_map`: circle, 2 robots, holonomic2d, noise 0.1" in text
    assert "| speed of pushes \\[m/s\\] | 1 | 1 |" in text
    assert "| own thing | 1 | 1 |" in text
    # The undisturbed trials have one row for each policy.
    assert markdown(success_rates(groups)).count("| - | 3 of 3 (100%)") == 2
    assert len(write_disturbances(tmp_path, [one for one in groups[:2] if one.label == "a"])) == 8
    again = [replace(trial, scenario="swap") for trial in groups[0].trials]
    names = {path.name for path in write_disturbances(tmp_path, [*groups[:2], groups[0]._replace(trials=again)])}
    assert {"disturbances-1.pdf", "disturbances-2.pdf"} < names


@pytest.mark.parametrize("write", [write_disturbances, write_robustness])
@pytest.mark.parametrize("given", [[], [1, 2], 3, [group("a", 1, "+", "")]], ids=["none", "numbers", "one", "group"])
def test_what_cannot_be_written_is_refused_before_anything_is(tmp_path: Path, write: Any, given: Any) -> None:
    with pytest.raises(ValueError, match=r"give the result of|run a study with disturbances"):
        write(tmp_path, given)
    assert not list(tmp_path.iterdir())


def rates_of(labels: Sequence[str], levels: Mapping[str, Sequence[float]], noise: float = 0.0) -> list[SuccessRate]:
    return success_rates(
        group(label, level, "++-", name, control_noise_std=noise)
        for label in labels for name, steps in levels.items() for level in steps
    )  # fmt: skip


@pytest.mark.parametrize("labels", [["d4orm"], ["d4orm", "hybrid", "d4orm-c2f:refine=sync", "orca", "go-to-goal"]])
@pytest.mark.parametrize("levels", [(0, 2), (0, 1, 2)])
def test_labels_of_the_map_do_not_overlap_and_fit(labels: list[str], levels: tuple[int, ...]) -> None:
    figure = draw_map(rates_of(labels, {"delay": levels, "push.speed": levels, "state_noise": levels}))
    figure.savefig(BytesIO())
    (ax,) = figure.axes
    names = [text for text in ax.texts if not text.get_text().isdecimal()]
    assert [name.get_text() for name in names] == [
        "success [%]", "undisturbed", "control delay\n[time steps]", "speed of pushes\n[m/s]",
        "position noise\n[std, m]",
    ]  # fmt: skip
    for listed in (names, ax.get_xticklabels()):
        boxes = [text.get_window_extent() for text in listed]
        assert not any(one.overlaps(other) for one, other in combinations(boxes, 2))
        assert all(figure.bbox.containsx(box.x0) and figure.bbox.containsx(box.x1) for box in boxes)
        assert all(figure.bbox.containsy(box.y0) and figure.bbox.containsy(box.y1) for box in boxes)


def test_figures_for_a_paper_have_no_title_and_fit_its_columns() -> None:
    names = ("delay", "push.speed", "state_noise", "stall")
    figures = [draw_lines(rates_of(["a", "b"], dict.fromkeys(names[:count], (0, 1)))) for count in range(1, 5)]
    assert [figure.get_figwidth() for figure in figures] == pytest.approx([3.5, 3.5, 7.16, 7.16])
    assert not any(figure.get_suptitle() for figure in figures)
    noisy = draw_map(rates_of(["a"], {"delay": (0, 1)}, noise=0.1))
    assert "noise 0.1 alone" in [text.get_text() for text in noisy.axes[0].texts]


def test_the_command_line(d4orm: Call, tmp_path: Path) -> None:
    options = ("--policy", "go-to-goal,random", "-k", "2", "--seeds", "2", "--workers", "1", "-q")
    status, _, error = d4orm("evaluate", *options, "--disturb", "delay=0,2", "--disturb", "push.speed=0.3")
    assert (status, error) == (0, "")
    assert len(TrialStore.existing(tmp_path / "evaluation").trials()) == 2 * 2 * 3
    assert (tmp_path / "evaluation" / "disturbances.pdf").exists()
    status, out, _ = d4orm("robustness", *options[:-1], "--out", "evaluation", "--disturb", "delay=0,2,[1, 3]")
    assert status == 0
    assert "control delay" in out
    assert "delay 2" in (tmp_path / "evaluation" / "robustness.md").read_text()
    assert (tmp_path / "evaluation" / "robustness.csv").exists()
    assert len(TrialStore.existing(tmp_path / "evaluation").trials()) == 2 * 2 * 4


@pytest.mark.slow
def test_robustness_is_a_study_of_all(d4orm: Call, tmp_path: Path) -> None:
    status, out, _ = d4orm("robustness", "--policy", "go-to-goal", "-k", "2", "--seeds", "1", "--workers", "1")
    assert status == 0
    assert "true over assumed limits" in out
    assert len(out.splitlines()) < 40
    stored = TrialStore.existing(tmp_path / "robustness" / STORE).trials()
    assert len({row.disturbances for row in stored}) == len(stored) > 30
    assert (tmp_path / "robustness" / "disturbance_map.pdf").exists()


def test_an_episode_with_disturbances(d4orm: Call) -> None:
    quiet = ("run", "--policy", "go-to-goal", "-k", "1", "--seed", "3")
    outputs = {d4orm(*quiet, *more)[1] for more in ((), ("--disturb", "delay=0"), ("--disturb", "limit_mismatch=0.5"))}
    assert len(outputs) == 2


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("evaluate", "--disturb", "delay"), "--disturb 'delay' is not of the form name=levels"),
        (("evaluate", "--disturb", "delay="), "--disturb 'delay=' is not of the form"),
        (("evaluate", "--disturb", "dely=1"), "disturbance 'dely' is unknown; choose one of"),
        (("evaluate", "--disturb", "delay=1.5"), "Delay steps must be a whole number, not 1.5"),
        (("evaluate", "--disturb", "delay=1", "--disturb", "delay=2"), "gives 'delay' twice"),
        (("robustness", "--disturb", "dropout=2"), "Dropout probability is 2"),
        (("run", "--disturb", "delay=1,2"), "an episode has one level, not 2"),
        (("run", "--disturb", "drag=0.5", "--model", "velocity2d"), "Drag slows what has inertia"),
        (("run", "--disturb", "state_noise.velocity_std=1"), "needs position_std too"),
    ],
)
def test_bad_input_is_one_line(d4orm: Call, arguments: tuple[str, ...], complaint: str) -> None:
    status, _, error = d4orm(*arguments)
    assert status == 2
    assert re.search(re.escape(complaint), error)
    assert error.count("\n") == 1


def test_limits_fall_from_left_to_right() -> None:
    found = conditions(0.0, {"limit_mismatch": [1, 0.8]})
    assert [one.level for one in found] == [1, 0.8]
    assert found[0].text == "[]"
    assert found[1].disturbances == (LimitMismatch(0.8),)


def test_shards_of_a_job_array_come_to_the_same(tmp_path: Path) -> None:
    study = Study(policies=["go-to-goal", "random"], num_robots=2, seeds=range(3), disturbances={"delay": [0, 1]})
    for index in (1, 2):
        path = run_shard(study, tmp_path / "parts", (index, 2), workers=1)
        assert path.name == f"trials-{index}-of-2.sqlite"
    assert sorted(path.name for path in (tmp_path / "parts").iterdir()) == [
        "trials-1-of-2.sqlite", "trials-2-of-2.sqlite"
    ]  # fmt: skip
    with pytest.raises(ValueError, match="workers is 0"):
        run_shard(study, tmp_path / "none", (1, 2), workers=0)
    assert not (tmp_path / "none").exists()
    ran: list[int] = []
    together = run_study(study, tmp_path / "parts", workers=1, progress=lambda what, done, total: ran.append(done))
    assert ran == [12], "nothing was left to run"
    alone = run_study(study, tmp_path / "alone", workers=1)
    assert [[one.success for one in group.trials] for group in together] == [
        [one.success for one in group.trials] for group in alone
    ]
    assert [[one.key for one in group.trials] for group in together] == [
        [one.key for one in group.trials] for group in alone
    ]


def test_shards_on_the_command_line(d4orm: Call, tmp_path: Path) -> None:
    options = ("evaluate", "--policy", "go-to-goal", "-k", "2", "--seeds", "3", "--workers", "1")
    status, out, _ = d4orm(*options, "--shard", "2/2")
    assert (status, "trials-2-of-2.sqlite" in out) == (0, True)
    assert not (tmp_path / "evaluation" / STORE).exists()
    assert d4orm(*options)[0] == 0
    assert len(TrialStore.existing(tmp_path / "evaluation").trials()) == 3
    for wrong, message in (("3", "is no part"), ("3/2", "shard is 3; it must be at most 2"), ("0/2", "shard is 0")):
        status, _, error = d4orm(*options, "--shard", wrong)
        assert status != 0
        assert message in error
    assert "give one of them" in d4orm(*options, "--shard", "1/2", "--ray", "auto")[2]


@pytest.mark.parametrize(
    ("levels", "expected"),
    [
        (np.array([10, 5, 0]), [10, 5, 0]),
        ([np.int32(3), 1], [3, 1]),
        ([[3, 6], 0, 2], [0, 1, 2]),
        ([0, [1, 3], 1], [0, 1, 2]),
    ],
)
def test_levels_are_numbers_or_else_all_of_them_indices(levels: Any, expected: list[float]) -> None:
    assert [one.level for one in conditions(0.0, {"delay": levels})] == expected
    assert [one.level for one in conditions(0.0, {"lag": np.float32([0.5, 0])})] == [0.5, 0]
