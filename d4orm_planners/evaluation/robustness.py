"""Robustness of policies, as tables and pictures: to noise on the controls, and to every disturbance."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import isfinite
from pathlib import Path

from d4orm_env.core.arrays import short_repr
from d4orm_env.core.files import replaced_when_done
from d4orm_planners.base.display import markdown_text
from d4orm_planners.evaluation.comparison import PairedPolicies, compare_pairs
from d4orm_planners.evaluation.disturbance_figures import draw_lines, draw_map, draw_noise, quantity_of, write_figure
from d4orm_planners.evaluation.summary import SuccessRate, TrialGroup, success_rates
from d4orm_planners.evaluation.tables import errors, interval, markdown, panels, table, write_csv, write_rates

THRESHOLD = 0.9  #: Share of the undisturbed success rate below which a policy no longer tolerates a disturbance

_PAIRS = """\
Trials with the same problem, seed and disturbance. *Only first* and *only second* count those in which one of the two
succeeded; p is that of McNemar's exact test. Differences have 95% intervals: Newcombe's, of times Student's."""
_NOT_RUN = "Success without a disturbance was *not run*: give one a level without effect, as in `push.speed=0,0.5`."
_FIGURES = "Success against level, not to scale, with 95% intervals, and success in percent."


def _check_given(given: object, kind: type, source: str) -> None:
    """Refuse what is no list of so many results, at least one."""
    listed = given if isinstance(given, Sequence) else ()
    if not listed or not all(isinstance(one, kind) for one in listed):
        raise ValueError(f"{short_repr(given)} is no list of {kind.__name__}; give the result of {source}")


def write_robustness(folder: str | os.PathLike[str], rates: Sequence[SuccessRate]) -> list[Path]:
    """Write ``robustness.csv``, ``robustness.md`` and, where nothing but noise went wrong, the figure ``robustness`` as
    PDF, SVG and PNG, success against it.

    Args:
        folder: Output folder.
        rates: Result of :func:`~d4orm_planners.evaluation.evaluate.evaluate`.

    Returns:
        The paths.

    Raises:
        ValueError: If there is nothing to write, what is given is something else, or the folder does not exist or
            cannot be written to.
    """
    _check_given(rates, SuccessRate, "evaluate()")
    paths = [Path(folder, f"robustness.{kind}") for kind in ("csv", "md")]
    write_rates(paths[0], rates)
    with replaced_when_done(paths[1]) as path:
        path.write_text(markdown(rates), encoding="utf-8")
    if any(rate.disturbance for rate in rates):
        return paths
    return paths + write_figure(Path(folder), "robustness", draw_noise(panels(rates)))


def write_disturbances(folder: str | os.PathLike[str], groups: Sequence[TrialGroup]) -> list[Path]:
    """Write ``disturbances.md``, ``tolerance.csv``, ``pairs.csv``, and two figures as PDF, SVG and PNG:
    ``disturbances``, success against levels, and ``disturbance_map``, a heat map; numbered, where there are several
    scenarios, teams or levels of noise.

    Args:
        folder: Output folder.
        groups: Result of :func:`~d4orm_planners.evaluation.evaluate.run_study` for a study with disturbances.

    Returns:
        The paths; ``pairs.csv`` is not among them, and not written, where there is one policy only.

    Raises:
        ValueError: If there is nothing to write, what is given is something else, or the folder does not exist or
            cannot be written to.
    """
    _check_given(groups, TrialGroup, "run_study() of a study with disturbances")
    rates = success_rates(groups)
    groups_by_title = _panels([rate for rate in rates if rate.disturbance])
    if not groups_by_title:
        raise ValueError("no group of trials has a disturbance; run a study with disturbances")
    pairs, count = compare_pairs(groups), len(groups_by_title)
    # One for each scenario, team and level of noise.
    suffixes = [f"-{number}" for number in range(1, count + 1)] if count > 1 else [""]
    captions = [
        f"- `disturbances{suffix}`, `disturbance_map{suffix}`: {markdown_text(title)}"
        for suffix, title in zip(suffixes, groups_by_title)
    ]
    blocks = errors((rate.label, rate.error) for rate in rates)  # first, as below they look like bad policies
    blocks += [tolerance_tables(rates), "## Figures", _FIGURES, "\n".join(captions), *_pair_tables(rates, pairs)]
    paths = [Path(folder, name) for name in ("disturbances.md", "tolerance.csv")]
    with replaced_when_done(paths[0]) as path:
        path.write_text("\n\n".join(blocks) + "\n", encoding="utf-8")
    write_csv(paths[1], [vars(one) for one in tolerances(rates)])
    if pairs:
        paths.append(Path(folder, "pairs.csv"))
        write_csv(paths[-1], [vars(pair) for pair in pairs])
    for suffix, group in zip(suffixes, groups_by_title.values()):
        paths += write_figure(Path(folder), f"disturbances{suffix}", draw_lines(group))
        paths += write_figure(Path(folder), f"disturbance_map{suffix}", draw_map(group))
    return paths


def tolerance_tables(rates: Sequence[SuccessRate]) -> str:
    """A table per scenario, team and level of noise: for every policy its undisturbed success and what it tolerates."""
    blocks = [f"## Level at which success falls below {THRESHOLD:.0%} of the undisturbed"]
    for title, group in _panels([rate for rate in rates if rate.disturbance]).items():
        tolerated = tolerances(group)
        names = list(dict.fromkeys(one.disturbance for one in tolerated))
        cells = {(one.label, one.disturbance): one.text for one in tolerated}
        undisturbed = {one.label: one.undisturbed for one in tolerated}
        if None in undisturbed.values():
            blocks.append(_NOT_RUN)
        # Policies are few and disturbances many.
        labels, noise = list(undisturbed), tolerated[0].control_noise_std
        first = f"success with noise {noise:g} alone" if noise else "undisturbed success"
        rows = [(first, *("not run" if rate is None else f"{rate:.0%}" for rate in undisturbed.values()))]
        rows += [(quantity_of(name).text, *(cells.get((label, name), "-") for label in labels)) for name in names]
        blocks.append(table(title, ("disturbance", *labels), rows))
    return "\n\n".join(blocks)


def _pair_tables(rates: Sequence[SuccessRate], pairs: Sequence[PairedPolicies]) -> list[str]:
    header = ("first", "second", "noise", "disturbance", "level", "trials", "only first", "only second", "p",
              "difference in success", "first slower by, s")  # fmt: skip
    blocks = ["## Policies compared trial by trial", _PAIRS] if pairs else []
    titles = {
        (one.scenario, one.num_robots, one.model): title for title, group in panels(rates).items() for one in group
    }
    for team, title in titles.items():
        rows = [_pair_cells(pair) for pair in pairs if (pair.scenario, pair.num_robots, pair.model) == team]
        if rows:
            blocks.append(table(title, header, rows))
    return blocks


def _pair_cells(pair: PairedPolicies) -> tuple[str, ...]:
    return (
        pair.first,
        pair.second,
        f"{pair.control_noise_std:g}",
        pair.disturbance or "-",
        "-" if pair.level is None else f"{pair.level:g}",
        *(str(count) for count in (pair.trials, pair.only_first, pair.only_second)),
        f"{pair.p_value:.3g}",
        f"{pair.difference:+.0%} ({pair.lower:+.0%} to {pair.upper:+.0%})",
        interval(pair.slower, pair.slower_lower, pair.slower_upper, 2),
    )


def _panels(rates: Sequence[SuccessRate]) -> dict[str, list[SuccessRate]]:
    """Group rates as in the tables, but for levels of noise too."""
    groups: dict[str, list[SuccessRate]] = {}
    for title, group in panels(rates).items():
        for rate in group:
            noise = rate.control_noise_std
            groups.setdefault(f"{title}, noise {noise:g}" if noise else title, []).append(rate)
    return groups


@dataclass(frozen=True, kw_only=True)
class Tolerance:
    """Level of a disturbance at which the success of a policy falls below a share of what it is undisturbed.

    The first six fields are those of :class:`~d4orm_planners.evaluation.summary.Compared`.
    """

    label: str
    scenario: str
    num_robots: int
    model: str
    control_noise_std: float
    disturbance: str
    passes: float | None  #: The last level before that, from harmless to bad; ``None`` if it fails at the first
    #: The first level with a success rate below the threshold; ``None`` if it tolerates all. Both are ``None`` where no
    #: level can be named: without an undisturbed success rate, or with one of 0.
    fails: float | None
    undisturbed: float | None  #: Success rate with nothing but the noise; ``None`` if no level without effect was run
    threshold: float | None  #: That share of it

    @property
    def text(self) -> str:
        """The level as text: ``"4"``, ``"beyond 4"`` where it tolerates the last level, 4, or ``"-"`` for none."""
        if self.fails is not None:
            return f"{self.fails:g}"
        return "-" if self.passes is None else f"beyond {self.passes:g}"


_LINE = ("label", "scenario", "num_robots", "model", "control_noise_std", "disturbance")
"""Attributes that the rates of a line have in common."""


def tolerances(rates: Iterable[SuccessRate]) -> list[Tolerance]:
    """One for every policy, scenario, team size, level of noise and disturbance, in order of appearance.

    Rates may be in any order, if a disturbance has a level without effect; else its levels are from harmless to bad.
    Those without a disturbance only tell the undisturbed success.
    """
    lines: dict[tuple[object, ...], list[SuccessRate]] = {}
    undisturbed: dict[tuple[object, ...], float] = {}
    for rate in rates:
        where = tuple(getattr(rate, name) for name in _LINE[:-1])
        if rate.undisturbed:
            undisturbed[where] = rate.rate
        if rate.disturbance:
            lines.setdefault((*where, rate.disturbance), []).append(rate)
    return [_tolerance(_from_harmless(line), undisturbed.get(where[:-1])) for where, line in lines.items()]


def _from_harmless(line: Sequence[SuccessRate]) -> Sequence[SuccessRate]:
    """Rates by distance from the level without effect; as they are, where there is none."""
    harmless = next((rate.level for rate in line if rate.undisturbed), None)
    if harmless is None:
        return line
    # A range without limit is infinitely far from all others.
    zero = harmless if isfinite(harmless) else 0.0
    return sorted(line, key=lambda rate: abs((rate.level or 0.0) - zero), reverse=zero != harmless)


def _tolerance(line: Sequence[SuccessRate], undisturbed: float | None) -> Tolerance:
    threshold = None if undisturbed is None else THRESHOLD * undisturbed
    passes = fails = None
    if threshold:
        levels = [rate.level for rate in line]
        failing = next((index for index, rate in enumerate(line) if rate.rate < threshold), len(line))
        passes, fails = ([None, *levels][failing], [*levels, None][failing])
    return Tolerance(
        **{name: getattr(line[0], name) for name in _LINE},
        passes=passes,
        fails=fails,
        undisturbed=undisturbed,
        threshold=threshold,
    )
