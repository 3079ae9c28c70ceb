"""Texts of others stay texts: in tables, spreadsheets, terminals and pictures."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from d4orm_env import make_problem, save_problem
from d4orm_planners import evaluate
from d4orm_planners.base.display import markdown_text, one_line, spreadsheet_cell
from d4orm_planners.cli import app as cli
from d4orm_planners.cli.outputs import print_table
from d4orm_planners.evaluation.leaderboard import leaderboard
from d4orm_planners.evaluation.robustness import write_robustness
from d4orm_planners.evaluation.store import STORE, Trial, TrialStore
from d4orm_planners.evaluation.summary import TrialGroup, success_rates
from d4orm_planners.evaluation.tables import markdown, table, write_csv, write_results

NASTY = "a|b\n| forged | row |\r\n<img src=x onerror=alert(1)> `x` [y](javascript:1) \x1b[2J\x9b1m $\\frac$ {z} \u2028"
CELL = re.compile(r"(?<!\\)((?:\\\\)*)\|")
"""A bar that ends a cell."""


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("paper_circle, 8 robots (50%) + 3", "paper_circle, 8 robots (50%) + 3"),
        ("a|b", "a\\|b"),
        ("a\nb\r\n c", "a b   c"),
        ("<b>&lt;", "\\<b\\>\\&lt;"),
        ("\x1b[31m", "\\\\x1b\\[31m"),
        ("\\|", "\\\\\\|"),
        ("![x](y)", "!\\[x\\](y)"),
    ],
)
def test_markdown_reads_text_as_itself(text: str, shown: str) -> None:
    assert markdown_text(text) == shown


@pytest.mark.parametrize("text", ["=1+1", "+1+1", "-1+1", "@SUM(A1)", "  =1", "\t=1", "\r=1", "=", "--", "-1 to 2"])
def test_a_spreadsheet_computes_no_text(text: str) -> None:
    assert spreadsheet_cell(text) == (text if len(text) == 1 else f"'{one_line(text)}")


@pytest.mark.parametrize("value", [-1.5, -3, None, True, "-1.5", "+3", "-inf", "1e-5", "-", "circle", "a=b"])
def test_numbers_stay_numbers_in_a_spreadsheet(value: object) -> None:
    assert spreadsheet_cell(value) is value or spreadsheet_cell(value) == value


@given(st.lists(st.text(max_size=20), min_size=3, max_size=3), st.text(max_size=20))
def test_a_table_has_the_rows_and_cells_that_it_was_given(cells: Sequence[str], title: str) -> None:
    lines = table(title, ("x", "y", "z"), [cells, cells]).split("\n")
    assert len(lines) == 6
    assert len(table(title, ("x", "y", "z"), [cells, cells]).splitlines()) == 6
    for line in (lines[2], *lines[4:]):
        assert len(CELL.findall(line)) == 4
        assert line.isprintable()


def trials() -> list[Trial]:
    """Trials of somebody else, of whom every text is hostile."""
    plain = Trial(policy=NASTY, config=json.dumps({NASTY: NASTY}), problem="0", control_noise_std=0.0, seed=0,
                  disturbances=json.dumps([[NASTY, {NASTY: NASTY}]]), label=NASTY, scenario=NASTY, num_robots=2,
                  model=NASTY, dt=0.1, versions=json.dumps({NASTY: NASTY}), date=NASTY, error=NASTY, violation=NASTY,
                  machine=json.dumps({"processor": NASTY, "cores_used": NASTY, "cores": 1, "python": "3"}))  # fmt: skip
    return [plain, replace(plain, seed=1, label="=cmd|x", scenario="@x", model="-x", error="+x", travel_time=-1.5)]


def check_markdown(text: str) -> None:
    """No markup of others, no row more than trials make, and no command to a terminal."""
    text = re.sub("^- `[^`]*`", "", text, flags=re.MULTILINE)  # code, where nothing is markup
    assert not re.search(r"(?<!\\)<|(?<!\\)\[y|^\| forged|\x1b|\x9b|\u2028|\r", text, re.MULTILINE)
    for block in text.split("\n\n"):
        rows = [line for line in block.split("\n") if line.startswith("|")]
        assert len({len(CELL.findall(row)) for row in rows}) <= 1


def test_reports_of_others_trials_hold_text_only(tmp_path: Path) -> None:
    given = trials()
    check_markdown(leaderboard(given, deadlines=[1.0]))
    rates = success_rates([TrialGroup(NASTY, [trial]) for trial in given])
    check_markdown(markdown(rates))
    TrialStore(tmp_path / STORE).add(*given)
    write_results(tmp_path, rates)
    check_markdown((tmp_path / "table.md").read_text(encoding="utf-8"))
    for name in ("table.csv", "trials.csv"):
        with (tmp_path / name).open(newline="", encoding="utf-8") as file:
            text = file.read()
        assert "\x1b" not in text
        assert text.count("\n") == 3, "a line for every trial"
        cells = [cell for row in csv.reader(text.splitlines()) for cell in row]
        assert not [cell for cell in cells if cell[:1] in tuple("=+@") or re.match(r"-[^0-9]", cell)]
    assert "-1.5" in (tmp_path / "trials.csv").read_text(encoding="utf-8")


def test_a_picture_has_no_formulas_of_others(tmp_path: Path) -> None:
    rates = success_rates([TrialGroup("$\\frac$", [replace(trials()[0], scenario="$\\undefined$", model="x",
                                                          disturbances="[]")])])  # fmt: skip
    *_, picture = write_robustness(tmp_path, rates)
    assert picture.stat().st_size > 1000


def test_a_scenario_file_may_have_a_bar_in_its_name(tmp_path: Path) -> None:
    path = tmp_path / "a|b.yaml"
    save_problem(make_problem("circle", num_robots=2).replace(name="custom"), path)
    rates = evaluate(policies=["go-to-goal"], scenarios=[path], seeds=[0], out=tmp_path / "out", workers=1)
    write_results(tmp_path / "out", rates)
    assert "### a\\|b, 2 robots, holonomic2d\n" in (tmp_path / "out" / "table.md").read_text(encoding="utf-8")


def test_terminals_are_told_text_only(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    print_table(NASTY, [("[/red]", NASTY)])
    with pytest.raises(SystemExit) as ended:
        cli.main(["plan", "--scenario", f"{tmp_path}/\x1b[2J.yaml"])
    assert ended.value.code == 2
    told = capsys.readouterr()
    assert "[/red]" in told.out
    assert "\\x1b[2J" in told.err
    assert "\x1b" not in told.out + told.err


def test_an_empty_table_of_numbers_is_as_before(tmp_path: Path) -> None:
    write_csv(tmp_path / "x.csv", [{"a": -1.25, "b": None, "c": "circle (size=3)"}])
    assert (tmp_path / "x.csv").read_text().splitlines() == ["a,b,c", "-1.25,,circle (size=3)"]
