"""What a study of disturbances came to: tables, a figure for each disturbance, and a heat map of all."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from d4orm_planners.evaluation.figures import draw_disturbance, draw_map
from d4orm_planners.evaluation.pairs import PairedPolicies, compare_pairs
from d4orm_planners.evaluation.report import markdown, panels, table, target, write_csv
from d4orm_planners.evaluation.summary import SuccessRate, TrialGroup, success_rates
from d4orm_planners.evaluation.tolerance import Tolerance, tolerances


def write_disturbances(folder: str | os.PathLike[str], groups: Sequence[TrialGroup]) -> list[Path]:
    """Write ``disturbances.md``, ``tolerance.csv``, ``pairs.csv``, ``tolerance.png`` and a picture per disturbance.

    Args:
        folder: Where to.
        groups: What :func:`~d4orm_planners.evaluation.evaluate.run_study` returned for a study with disturbances.

    Returns:
        The paths; ``pairs.csv`` is not among them, and not written, where there is one policy only.

    Raises:
        OSError: If the folder does not exist or cannot be written to.
    """
    rates = success_rates(groups)
    stood, pairs = tolerances(rates), compare_pairs(groups)
    paths = [Path(folder, name) for name in ("disturbances.md", "tolerance.csv", "tolerance.png")]
    with target(paths[0]) as path:
        path.write_text(_page(rates, stood, pairs), encoding="utf-8")
    write_csv(paths[1], [vars(one) for one in stood])
    with target(paths[2]) as path:
        draw_map(path, rates)
    if pairs:
        paths.append(Path(folder, "pairs.csv"))
        write_csv(paths[-1], [vars(pair) for pair in pairs])
    for name in dict.fromkeys(one.disturbance for one in stood):
        file = re.sub(r"[^\w.-]", "_", name)
        paths.append(Path(folder, f"disturbance-{file}.png"))
        with target(paths[-1]) as path:
            draw_disturbance(path, name, [rate for rate in rates if rate.disturbance == name])
    return paths


def _page(rates: Sequence[SuccessRate], stood: Sequence[Tolerance], pairs: Sequence[PairedPolicies]) -> str:
    titles = {(rate.scenario, rate.num_robots, rate.model): title for title, group in panels(rates).items()
              for rate in group}  # fmt: skip
    blocks = [f"## Level at which success falls below {stood[0].threshold:.0%}"]
    for place, title in titles.items():
        here = [one for one in stood if (one.scenario, one.num_robots, one.model) == place]
        for noise in dict.fromkeys(one.control_noise_std for one in here):
            cells = {(one.label, one.disturbance): one.text for one in here if one.control_noise_std == noise}
            blocks.append(_matrix(f"{title}, noise {noise:g}" if noise else title, cells))
    if pairs:
        blocks += ["## Policies compared trial by trial", _PAIRS, *_pair_tables(titles, pairs)]
    return "\n\n".join([*blocks, "## Success", markdown(rates)])


_PAIRS = """\
Trials with the same problem, seed and disturbance. *Only first* and *only second* count those in which one of the two
succeeded; p is that of McNemar's exact test. Differences have 95% intervals by a paired bootstrap."""


def _matrix(title: str, cells: Mapping[tuple[str, str], str]) -> str:
    columns = list(dict.fromkeys(name for _, name in cells))
    rows = [
        (label, *(cells.get((label, name), "-") for name in columns))
        for label in dict.fromkeys(label for label, _ in cells)
    ]
    return table(title, ("policy", *columns), rows)


def _pair_tables(titles: Mapping[tuple[str, int, str], str], pairs: Sequence[PairedPolicies]) -> list[str]:
    header = ("first", "second", "noise", "disturbance", "level", "trials", "only first", "only second", "p",
              "difference in success", "first slower by, s")  # fmt: skip
    blocks = []
    for place, title in titles.items():
        rows = [_pair_cells(pair) for pair in pairs if (pair.scenario, pair.num_robots, pair.model) == place]
        if rows:
            blocks.append(table(title, header, rows))
    return blocks


def _pair_cells(pair: PairedPolicies) -> tuple[str, ...]:
    slower = "-" if pair.slower is None else f"{pair.slower:.2f}"
    if pair.slower_lower is not None:
        slower += f" ({pair.slower_lower:.2f} to {pair.slower_upper:.2f})"
    return (
        pair.first,
        pair.second,
        f"{pair.control_noise_std:g}",
        pair.disturbance or "-",
        "-" if pair.level is None else f"{pair.level:g}",
        *(str(count) for count in (pair.trials, pair.only_first, pair.only_second)),
        f"{pair.p_value:.3g}",
        f"{pair.difference:+.0%} ({pair.lower:+.0%} to {pair.upper:+.0%})",
        slower,
    )
