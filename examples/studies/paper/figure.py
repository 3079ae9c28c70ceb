"""A figure or table of the paper: what it compares, as studies, and running them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, field, replace
from types import MappingProxyType
from typing import Literal, NamedTuple

from d4orm_planners.base.planner_registry import list_planners
from d4orm_planners.evaluation.store import Trial, TrialKey
from d4orm_planners.evaluation.study import Study

PaperNumbers = Mapping[tuple[str, str, str], Mapping[str, str]]
"""The paper's numbers by section, label and metric, and in these by column."""
Cost = Literal["runtime", "travel_time", "first_steps", "iterations"]
Across = Literal["num_robots", "nodes", "scenario", "control_noise_std", "policy"]

_FEW: dict[str, object] = {"num_samples": 64, "num_steps": 10, "max_iterations": 3}
QUICK_SETTINGS: Mapping[str, Mapping[str, object]] = MappingProxyType({
    "d4orm": _FEW,
    "d4orm-d": {**_FEW, "repair_samples": 64, "repair_steps": 10},
    "d4orm-c2f": {"coarse_samples": 64, "coarse_steps": 15, "coarse_repair_steps": 5, "coarse_iterations": 3,
                  "num_samples": 32, "num_steps": 5},
    "mppi": _FEW,
    "cem": _FEW,
    "d-d4orm": _FEW,
    "i-mbd": _FEW,
    "mbd": {"num_samples": 64, "num_steps": 30, "max_iterations": 1},
})  # fmt: skip
"""Settings of the quick version by policy: enough to go through every step, not to solve much."""
QUICK_TIME_LIMIT = 5.0
TIMES = frozenset({"runtime", "runtime_restricted", "mean_runtime", "step_time", "waiting_share"})
"""Metrics and plots of seconds, which depend on what else a machine does."""
EFFORTS = frozenset({"survival", "anytime"})
"""Plots over denoising steps where these are compared, else over seconds."""


@dataclass(frozen=True, kw_only=True)
class Section(Study):
    """A study whose policies meet the same problems: a panel of a figure, or a table."""

    title: str  #: The paper's name of it
    policies: Mapping[str, Mapping[str, object]]
    scenarios: tuple[str, ...]
    num_robots: tuple[int | None, ...] = (None,)
    control_noise_std: tuple[float, ...] = (0.0,)
    quick_robots: tuple[int | None, ...] = (2,)  #: Team sizes of the quick version
    #: Numbers of nodes that every policy is run with; none leaves it to their other settings
    nodes: tuple[int, ...] = ()

    def studies(self, seeds: int) -> list[Study]:
        """One study with the policies, or one for every number of nodes."""
        variants = [{"nodes": number} for number in self.nodes] or [{}]
        return [
            replace(
                self, seeds=range(seeds), policies={label: {**own, **nodes} for label, own in self.policies.items()}
            )
            for nodes in variants
        ]

    def quick(self) -> Section:
        """The same in a few seconds: tiny teams, few samples; of scenarios, nodes and levels of noise two at most."""
        policies = {
            label: {**settings, **QUICK_SETTINGS.get(str(settings.get("policy", label)), {})}
            for label, settings in self.policies.items()
        }
        return replace(
            self,
            policies=policies,
            scenarios=self.scenarios[:2],
            num_robots=self.quick_robots,
            nodes=self.nodes[:2],
            control_noise_std=tuple(dict.fromkeys((self.control_noise_std[0], self.control_noise_std[-1]))),
            time_limit=None if self.time_limit is None else min(self.time_limit, QUICK_TIME_LIMIT),
        )


@dataclass(frozen=True, kw_only=True)
class Figure:
    """A figure or table of the paper."""

    name: str  #: Its name on the command line
    title: str  #: Its title
    source: str  #: Section of the paper that has it
    sections: tuple[Section, ...]  #: Its panels
    across: Across  #: Attribute that varies from left to right
    metrics: tuple[str, ...]  #: Metrics in the tables, see :data:`~examples.studies.paper.numbers.METRICS`
    plots: tuple[str, ...]  #: Plots, see :data:`~examples.studies.paper.plots.PLOTS`
    seeds: int = 50  #: Trials per policy, problem and level of noise; the paper's number
    deadlines: tuple[float, ...] = ()  #: Seconds for planning, for tables of success within them
    paper: PaperNumbers = field(default_factory=dict)  #: The numbers that the paper gives
    #: Label of the policy that the others are compared with, trial by trial; ``None`` for no comparison
    reference: str | None = None
    compared_by: Cost = "runtime"  #: Cost in that, beside success
    timed: bool = True  #: Whether seconds of planning are told at all
    remarks: tuple[str, ...] = ()  #: Differences from the paper's set-up, one sentence or two each

    def quick(self) -> Figure:
        """The version that takes seconds and shows that everything works."""
        remarks = ("Quick version: tiny teams and few samples, whose numbers say nothing.", *self.remarks)
        return replace(self, sections=tuple(section.quick() for section in self.sections), seeds=1, remarks=remarks)

    def limited(self, seconds: float) -> Figure:
        """The figure with another limit where planners have one."""
        sections = (section if section.time_limit is None else replace(section, time_limit=seconds)
                    for section in self.sections)  # fmt: skip
        return replace(self, sections=tuple(sections))

    def without_times(self) -> Figure:
        """The version that says nothing of seconds, for trials of a machine that did other work too."""
        dropped = TIMES if self.compared_by == "first_steps" else TIMES | EFFORTS
        return replace(
            self,
            metrics=tuple(name for name in self.metrics if name not in dropped),
            plots=tuple(name for name in self.plots if name not in dropped) or ("success",),
            deadlines=(),
            compared_by="travel_time" if self.compared_by == "runtime" else self.compared_by,
            timed=False,
            remarks=(*self.remarks, "The machine did other work too, so seconds are left out."),
        )

    def studies(self, seeds: int) -> list[tuple[str, Study]]:
        """Title of the section and study of everything in the figure."""
        return [(section.title, study) for section in self.sections for study in section.studies(seeds)]

    def only(self, titles: Sequence[str] = (), labels: Sequence[str] = ()) -> Figure:
        """A part of the figure: sections of these titles, and policies of these labels, or all where none are given.

        Raises:
            ValueError: For a title or label that it does not have.
        """
        known = [section.title for section in self.sections]
        policies = list(dict.fromkeys(label for section in self.sections for label in section.policies))
        for what, wanted, offered in (("section", titles, known), ("policy", labels, policies)):
            for name in wanted:
                if name not in offered:
                    raise ValueError(f"{self.name} has no {what} {name!r}; choose of {'; '.join(offered)}")
        kept = []
        for section in self.sections:
            chosen = {label: section.policies[label] for label in section.policies if label in labels or not labels}
            if chosen and (section.title in titles or not titles):
                plans = any(settings.get("policy", label) in list_planners() for label, settings in chosen.items())
                kept.append(replace(section, policies=chosen, time_limit=section.time_limit if plans else None))
        return replace(self, sections=tuple(kept))


class Group(NamedTuple):
    """Trials, one per seed, of one policy on one scenario, team size and level of noise; its section and its label."""

    section: str
    label: str
    trials: Sequence[Trial]


def grouped(figure: Figure, trials: Sequence[Trial]) -> list[Group]:
    """The groups of a figure, as far as there are trials of them, whatever the policies' other settings were then.

    Raises:
        ValueError: If none of the trials is one of the figure's.
        ImportError: If a policy needs a library that is not installed.
    """
    by_cell = {_cell(trial.label, trial.key): trial for trial in trials}
    groups = []
    for title, study in figure.studies(1 + max((trial.seed for trial in trials), default=0)):
        for jobs in study.groups():
            label = jobs[0].policy.label
            for condition in jobs[0].conditions:
                cells = [_cell(label, job.key(condition)) for job in jobs]
                if found := [by_cell[cell] for cell in cells if cell in by_cell]:
                    groups.append(Group(title, label, found))
    if not groups:
        raise ValueError(f"none of the {len(trials)} trials is one of the figure {figure.name!r}; give it its own")
    return groups


def _cell(label: str, key: TrialKey) -> tuple[object, ...]:
    """Return what tells a trial from all others of a figure."""
    return label, json.loads(key.config).get("nodes"), *astuple(key)[2:]
