"""Common parts of the study scripts: arguments, and writing tables and plots so that no file is ever half-written."""

from __future__ import annotations

import argparse
import csv
import json
import sys
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from typing import Any, TypeVar

import matplotlib
import numpy as np
from PIL import Image

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from examples.denoising import denoising_columns, penalised_steps, step_columns

from d4orm_env import Problem
from d4orm_env.core.files import replaced_when_done
from d4orm_env.envs.joint_state import JointState
from d4orm_env.render import FrameRenderer
from d4orm_planners.base.provenance import commit, describe_machine
from d4orm_planners.evaluation.comparison import paired
from d4orm_planners.evaluation.evaluate import run_study
from d4orm_planners.evaluation.store import STORE, Trial, TrialStore
from d4orm_planners.evaluation.study import Study
from d4orm_planners.evaluation.summary import mean_interval, wilson_interval
from d4orm_planners.evaluation.tables import read_parquet, write_parquet

Row = TypeVar("Row", bound=Mapping[str, Any])
Key = TypeVar("Key", bound=Hashable)

COLOURS = {"d4orm": "#0072B2", "default": "#56B4E9", "mppi": "#D55E00", "cem": "#009E73", "i-mbd": "#CC79A7"}
"""One colour per method in every plot, told apart by the colour-blind too."""

plt.rcParams.update({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True})
plt.rcParams.update({"grid.alpha": 0.25, "legend.frameon": False, "figure.dpi": 110})


def require(extra: str, *modules: str) -> None:
    """End with one line that names the extra to install, unless these modules are there."""
    for module in modules:
        if find_spec(module) is None:
            print(f"this example needs {module}; install it with: pip install 'd4orm-env[{extra}]'", file=sys.stderr)
            raise SystemExit(2)


def argument_parser(description: str | None) -> argparse.ArgumentParser:
    """A parser with the arguments that every script has."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("examples/output"), help="folder for the results")
    parser.add_argument("--quick", action="store_true", help="a small version, for a first look and for the tests")
    return parser


def study_parser(description: str | None, seeds: int | None = None) -> argparse.ArgumentParser:
    """A parser for a study: what every script has, where rows or trials come from, and seeds where it has a default."""
    parser = argument_parser(description)
    parser.add_argument("--trials", type=existing_file, help="run nothing; a Parquet file that the study wrote")
    if seeds is not None:
        parser.add_argument("--seeds", type=count, default=seeds, help="of every row")
    return parser


def trials_parser(description: str | None, seeds: int | None = None) -> argparse.ArgumentParser:
    """:func:`study_parser` of a study that is run by :func:`study_trials`."""
    parser = study_parser(description, seeds)
    parser.add_argument("--go-on-from", type=existing_file, help="a Parquet file of trials that need not be run again")
    parser.add_argument(
        "--workers", type=count, default=1, help="processes of one thread each; 1 is one trial at a time on all cores"
    )
    return parser


def study_trials(arguments: argparse.Namespace, name: str, studies: Iterable[Study]) -> list[Trial]:
    """Trials of the file ``--trials``, or of studies, run one after the other and written to ``NAME.parquet``.

    Trials are kept in the folder ``--out`` one by one, so that a call that was broken off goes on from there.
    """
    if arguments.trials is not None:
        return read_parquet(arguments.trials)
    chosen = list(studies)
    for study in chosen:  # before the first of them runs for hours
        study.configurations()
    keep_known(arguments)
    out: Path = arguments.out
    trials = [
        trial
        for study in chosen
        for group in run_study(study, out, workers=arguments.workers, progress=tell)
        for trial in group.trials
    ]
    if write_parquet(path := out / f"{name}.parquet", trials):
        print(f"wrote {path}")
    return trials


def keep_known(arguments: argparse.Namespace) -> None:
    """Put the trials of ``--go-on-from`` into the store of a study that runs in ``--out``."""
    if arguments.go_on_from is not None:
        known = read_parquet(arguments.go_on_from)
        arguments.out.mkdir(parents=True, exist_ok=True)
        TrialStore(arguments.out / STORE).add(*known)


def tell(what: str, done: int, total: int) -> None:
    """Say how far a study is."""
    print(f"{done} of {total}: {what}", flush=True)


def is_solved(trial: Trial) -> bool:
    """Check whether a sampling planner found a solution: all arrive, the margin is kept and ``verify()`` agrees."""
    return trial.status == "solved" or any(best.solved for best in trial.progress)


def holm(p_values: Sequence[float]) -> list[float]:
    """P values corrected for how many there are by Holm's method, in their order."""
    order = np.argsort(p_values, kind="stable")
    left = len(p_values) - np.arange(len(p_values))
    corrected = np.empty(len(p_values))
    corrected[order] = np.minimum(np.maximum.accumulate(np.asarray(p_values, float)[order] * left), 1)
    return [float(value) for value in corrected]


def is_ours(label: str) -> bool:
    """Check whether a label says that the row is of no method of the paper's."""
    return "ours" in label.replace(",", " ").split()


def holm_by_family(tests: Mapping[Key, tuple[str, float]]) -> dict[Key, float]:
    """P values by what has them, of labels and p values, corrected among the rows that are ours, and among the others.

    So further rows of ours do not weaken the tests of the paper's methods.
    """
    found: dict[Key, float] = {}
    for ours in (False, True):
        family = [key for key, (label, _) in tests.items() if is_ours(label) == ours]
        found |= zip(family, holm([tests[key][1] for key in family]), strict=True)
    return found


def _with_corrected_tests(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows whose p values, numbers or ``None`` in columns that "p" begins, are corrected for how many there are."""
    tests = [(number, name) for number, row in enumerate(rows) for name in row if name.partition(" ")[0] == "p"]
    values = {(number, name): rows[number][name] for number, name in tests}
    labels = [next((text for text in map(str, row.values()) if is_ours(text)), "") for row in rows]
    corrected = holm_by_family(
        {(number, name): (labels[number], value) for (number, name), value in values.items() if value is not None}
    )
    found = {place: f"{corrected[place]:.2g}" if place in corrected else "-" for place in values}
    return [{name: found.get((number, name), value) for name, value in row.items()} for number, row in enumerate(rows)]


def solved_columns(trials: Sequence[Any], counts: Callable[[Any], bool] = is_solved) -> dict[str, str]:
    """Number of trials or rows that are solved, or count otherwise, with the 95% interval of their share (Wilson)."""
    solved = sum(map(counts, trials))
    lower, upper = wilson_interval(solved, len(trials))
    return {"solved": f"{solved} of {len(trials)}", "interval": f"{lower:.0%} to {upper:.0%}"}


def success_of_seeds(successes: Sequence[float], column: str = "success") -> dict[str, str]:
    """Mean success of several seeds [%], its 95% interval (Student's t), and the least and the most."""
    mean, lower, upper = mean_interval(successes)
    interval = "" if lower is None or upper is None else f"{max(lower, 0):.0f}% to {min(upper, 100):.0f}%"
    ends = f"{min(successes):.0f}%, {max(successes):.0f}%"
    return {column: f"{mean:.0f}%", "95% interval": interval, "least, most": ends}


def grouped(rows: Iterable[Row], *columns: str) -> dict[tuple[Any, ...], list[Row]]:
    """Rows by what they have in some columns, in order of appearance."""
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row[column] for column in columns), []).append(row)
    return groups


def mean_text(values: Sequence[float], form: str = ".2f", none: str = "-") -> str:
    """The mean of some values as text, or what stands for it where there are none."""
    return f"{np.mean(values):{form}}" if values else none


def first_solutions(team: str, column: str, groups: dict[str, list[Trial]], reference: str) -> list[dict[str, Any]]:
    """A row for each label of ``groups``, in ``column``: success, denoising steps, travel time, and tests.

    Tests are against the label ``reference``: McNemar on solutions, Wilcoxon on steps (PAR-2), paired by seed.
    """
    rows = []
    for label, trials in groups.items():
        travel = [trial.travel_time for trial in trials if is_solved(trial) and trial.travel_time is not None]
        test = None if label == reference else paired(trials, groups[reference], penalised_steps, is_solved)
        rows.append(
            {"team": team, column: label, **solved_columns(trials), **step_columns(trials),
             "travel time [s]": mean_text(travel),
             "p (solved)": test and test.success_p, "p (steps)": test and test.cost_p}
        )  # fmt: skip
    return rows


def existing_file(text: str) -> Path:
    """A command-line path of a file of trials."""
    if not Path(text).is_file():
        raise argparse.ArgumentTypeError(
            f"{text} is no file; give a Parquet file of trials, such as those in examples/studies/data/"
        )
    return Path(text)


def study_rows(
    arguments: argparse.Namespace, name: str, measure: Callable[[], list[dict[str, Any]]]
) -> list[dict[str, Any]]:
    """The rows of the file ``--trials``, or those of ``measure()``, written to ``NAME.parquet``.

    Each row is written with the commit and the machine that it was measured with.
    """
    require("evaluate", "pyarrow")
    from pyarrow import Table, parquet

    if arguments.trials is not None:
        return list(parquet.read_table(arguments.trials).to_pylist())
    source = {"commit": commit(), "machine": json.dumps(describe_machine(), sort_keys=True)}
    rows = measure()
    path: Path = arguments.out / f"{name}.parquet"
    path.parent.mkdir(parents=True, exist_ok=True)
    with replaced_when_done(path) as temporary:
        parquet.write_table(Table.from_pylist([{**row, **source} for row in rows]), temporary, compression="zstd")
    print(f"wrote {path}")
    return rows


def each_row(row_of: Callable[..., dict[str, Any]], *choices: Iterable[Any]) -> list[dict[str, Any]]:
    """The row of every combination of choices, printed as soon as it is there."""
    rows = []
    for chosen in product(*choices):
        rows.append(row_of(*chosen))
        print(rows[-1], flush=True)
    return rows


def count(text: str) -> int:
    """A command-line number of at least one."""
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"{number} is too few; give at least 1")
    return number


def save_figure(figure: Any, path: Path) -> None:
    """Write a matplotlib figure and close it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with replaced_when_done(path) as temporary:
        figure.savefig(temporary)
    plt.close(figure)
    print(f"wrote {path}")


def film(
    problem: Problem, joints: Sequence[JointState], faded: Sequence[Any], collided: Sequence[Any],
    captions: Sequence[str], view: Any = (),
) -> list[Any]:  # fmt: skip
    """Images of joint states with trails; of each ``(K,)`` robots that are pale and those in contact."""
    renderer, frames = FrameRenderer(problem, (520, 540), view), []
    for step, (joint, pale, touching, caption) in enumerate(zip(joints, faded, collided, captions, strict=True)):
        trail = np.stack([past.states[:, :2] for past in joints[max(step - 30, 0) : step + 1]])
        frames.append(renderer.draw(joint.states, pale, touching, joint.goals, trail, caption=caption))
    renderer.close()
    return frames


def save_gif(frames: Sequence[Any], path: Path, interval: float) -> None:
    """Write ``(height, width, 3)`` images as an animation that plays without end, ``interval`` seconds a frame."""
    path.parent.mkdir(parents=True, exist_ok=True)
    # One palette for all, from several of them, so that what stands still keeps its colours.
    chosen = frames[:: max(len(frames) // 8, 1)]
    palette = Image.fromarray(np.concatenate(chosen)).quantize(256)
    images = [Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    with replaced_when_done(path) as temporary:
        images[0].save(
            temporary, format="GIF", save_all=True, append_images=images[1:], duration=round(1000 * interval), loop=0
        )
    print(f"wrote {path}")


def save_table(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Write rows of equal keys to ``path`` (``.csv``) and beside it as Markdown, and print the latter.

    P values are corrected for the number of tests in the table (Holm), those of rows of ours among themselves. Columns
    of denoising are left out where no row tells them.
    """
    rows = _with_corrected_tests(rows)
    untold = {name for name in denoising_columns([]) if all(row.get(name) == "-" for row in rows)}
    rows = [{name: value for name, value in row.items() if name not in untold} for row in rows]
    path.parent.mkdir(parents=True, exist_ok=True)
    names = list(rows[0])
    markdown = [f"| {' | '.join(names)} |", f"|{'---|' * len(names)}"]
    markdown += [f"| {' | '.join(str(row[name]) for name in names)} |" for row in rows]
    with replaced_when_done(path) as temporary, temporary.open("w", newline="") as file:
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        writer.writerows(rows)
    with replaced_when_done(path.with_suffix(".md")) as temporary:
        temporary.write_text("\n".join(markdown) + "\n")
    print("\n".join(markdown))
    print(f"wrote {path} and {path.with_suffix('.md').name}")
