"""Rows of the benchmark that got slower since another commit, both measured in turn on this machine.

python tests/release/bench_compare.py BASE [arguments of d4orm bench, by default --quick]
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from statistics import median
from typing import Any

ROUNDS = 3
SLOWER = 1.1
"""Ratio of medians from which a row is told."""
NO_TIMES = {"iterations", "travel_time", "makespan", "load_average"}
ROOT = Path(__file__).parents[2]
RUN = "import sys; from d4orm_planners.cli import main; sys.argv[0] = 'd4orm'; main()"


def times(report: dict[str, Any]) -> Iterator[tuple[str, float]]:
    """Every time of a ``bench.json`` [s] by section, what was measured and the column."""
    for section, rows in report.items():
        for row in rows if isinstance(rows, list) else ():
            what = " ".join(str(row[name]) for name in row if isinstance(row[name], str | int) and name != "solved")
            for name, spread in row.items():
                if isinstance(spread, dict) and "median" in spread and name not in NO_TIMES:
                    yield f"{section}: {what}, {name}", spread["median"]


def slower(base: list[dict[str, Any]], here: list[dict[str, Any]]) -> list[str]:
    """One line for each row whose median over the rounds went up by more than :data:`SLOWER`, the worst first."""
    before, after = medians(base), medians(here)
    both = [(key, before[key], after[key]) for key in before if key in after]
    found = sorted(((new / old, key, old, new) for key, old, new in both if new > SLOWER * old), reverse=True)
    return [f"{ratio:5.2f} times  {key}: {old:.4g} -> {new:.4g} s" for ratio, key, old, new in found]


def medians(reports: list[dict[str, Any]]) -> dict[str, float]:
    """The median over the rounds of every time [s]."""
    rows: dict[str, list[float]] = {}
    for report in reports:
        for key, seconds in times(report):
            rows.setdefault(key, []).append(seconds)
    return {key: median(seconds) for key, seconds in rows.items()}


def bench(tree: Path, folder: Path, arguments: list[str], variables: Mapping[str, str] = os.environ) -> dict[str, Any]:
    """The report of a tree's benchmark, run with these variables."""
    command = [sys.executable, "-c", RUN, "bench", *arguments, "--quiet", "--out", str(folder)]
    subprocess.run(command, cwd=tree, env={**variables, "PYTHONPATH": str(tree)}, check=True)
    report: dict[str, Any] = json.loads((folder / "bench.json").read_text())
    return report


def main(base: str, arguments: list[str]) -> None:
    """Measure both trees in turn, once more before that to compile, and print what got slower."""
    with tempfile.TemporaryDirectory() as folder:
        tree, out = Path(folder, "base"), Path(folder, "out")
        subprocess.run(["git", "worktree", "add", "--quiet", "--detach", tree, base], cwd=ROOT, check=True)
        try:
            reports: dict[Path, list[dict[str, Any]]] = {tree: [], ROOT: []}
            for _ in range(ROUNDS + 1):
                for each in (*reports,):
                    reports[each].append(bench(each, out, arguments))
                reports = dict(reversed(reports.items()))  # neither is always the second
        finally:
            subprocess.run(["git", "worktree", "remove", "--force", tree], cwd=ROOT, check=True)
    lines = slower(reports[tree][1:], reports[ROOT][1:])
    print("\n".join(lines) or f"no row is slower than {base} by more than {SLOWER - 1:.0%}")


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit("usage: bench_compare.py BASE [arguments of d4orm bench]; BASE is a commit")
    main(sys.argv[1], sys.argv[2:] or ["--quick"])
