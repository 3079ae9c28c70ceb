"""The figures and tables of the paper that can be run again, with the numbers that the paper gives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any

from examples.studies import AS_IN_THE_PAPER
from examples.studies.paper.figure import Figure, Section

from d4orm_planners.d_d4orm.inbox import SELECTIONS

PAPER: Mapping[str, object] = {"preset": "paper"}
C2F: dict[str, object] = {"policy": "d4orm-c2f", "refine": "sync"}
"""Refinement in the background would make the result depend on how busy the machine is."""
BOTH_C2F: Mapping[str, Mapping[str, object]] = {"d4orm-c2f": {**C2F, **PAPER}, "d4orm-c2f, ours": C2F}
"""Algorithm 4, and our controller. What is not the paper's method has a label that says ``ours``."""
CONTROLLERS_TIME = "The share of the time that D4orm-C2F denoises is in the table of the study `controller_denoising`."
DENOISERS: Mapping[str, Mapping[str, object]] = MappingProxyType({
    "d4orm": PAPER, "d4orm, ours": {"policy": "d4orm"}, "d4orm-d": PAPER, "hybrid, ours": {"policy": "hybrid"}
})  # fmt: skip
SIZES = (4, 8, 12, 16)
Environment = tuple[str, str, str | None]
"""Title, scenario, model."""
DRIVES: Environment = ("Differential Drive", "paper_circle", "differential_drive")
PLANE: Environment = ("2D Holonomic", "paper_circle", None)
MIXED: Environment = ("Heterogeneous", "paper_heterogeneous", None)
SPACE: Environment = ("3D Holonomic", "paper_sphere", None)
OBSTACLES: Environment = ("2D Holo 4 Obs", "paper_obstacles", None)
ENVIRONMENTS = (DRIVES, PLANE, MIXED, SPACE, OBSTACLES)
"""The paper's, in its order."""


def _sections(
    policies: Mapping[str, Mapping[str, object]], *environments: Environment, **settings: Any
) -> tuple[Section, ...]:
    """The same policies in environments, of which the settings say more."""
    return tuple(
        Section(title=title, policies=policies, scenarios=(scenario,), model=model, **settings)
        for title, scenario, model in environments
    )


D4ORM_SECONDS = {"4": "0.12", "8": "0.13", "12": "0.30", "16": "1.25"}
"""The paper's Table II, means."""


def _team_size() -> Figure:
    """Every method spends the same number of samples, and all but ours go on after their first solution."""
    longer = {**PAPER, "improve": True, "max_iterations": 20}
    policies = {
        "d4orm": longer,
        "d4orm, ours": {"policy": "d4orm", "max_iterations": 80},
        "mppi": longer,
        "i-mbd": longer,
        "cem": longer,
        "cem, authors": {**longer, "policy": "cem", "preset": "authors"},
        "mbd": PAPER,
        "mbd, judged once": {"policy": "mbd", **PAPER, "check_every": None, "max_iterations": 1},
    }
    return Figure(
        name="team-size",
        title="D4orm, MPPI, i-MBD, CEM and MBD against team size",
        source="section IV-B, figure of the baselines, and appendix B, figure of CEM and MBD",
        sections=_sections(policies, *ENVIRONMENTS, num_robots=SIZES, quick_robots=(2, 3)),
        across="num_robots",
        metrics=("success", "first_steps", "first_steps_restricted", "denoising_time_share", "runtime", "reward"),
        plots=("first_steps", "success", "survival", "anytime"),
        deadlines=(0.5, 1, 3, 10),
        reference="d4orm",
        compared_by="first_steps",
        paper={
            ("2D Holonomic", "d4orm", "runtime"): D4ORM_SECONDS,
            ("2D Holonomic", "d4orm", "success"): {"16": "100% within 3 s"},
            ("2D Holonomic", "mppi", "runtime"): {"16": "nearly twice that of d4orm"},
        },
        remarks=(
            "Methods have a budget of samples, 20 iterations of 100 steps of 1024 (`d4orm, ours`: 80, of 256 "
            "and later 128), instead of a deadline; MBD has one run of 10,000 steps, judged every 100 of them, as in "
            "the paper, or once.",
            "`cem, authors` adapts its variance and penalises every pair, as the authors' published code does.",
            "`d4orm, ours` ends with its first solution: what it would improve it by is no sampling.",
        ),
    )


def _ipopt() -> Figure:
    policies = {
        "ipopt": PAPER,
        "ipopt, ours": {"policy": "ipopt"},
        "d4orm": PAPER,
        "d4orm, ours": {"policy": "d4orm"},
    }
    return Figure(
        name="ipopt",
        title="D4orm and direct collocation with IPOPT",
        source="section IV-B, Table II",
        sections=_sections(policies, PLANE, num_robots=SIZES, time_limit=120.0),
        across="num_robots",
        metrics=("mean_runtime", "runtime_restricted", "success", "first_steps", "denoising_time_share"),
        plots=("runtime", "success"),
        reference="d4orm",
        paper={
            ("2D Holonomic", "ipopt", "mean_runtime"): {
                "4": "1.12 ± 0.526",
                "8": "6.33 ± 2.284",
                "12": "35.32 ± 11.53",
                "16": "failed",
            },
            ("2D Holonomic", "d4orm", "mean_runtime"): {
                "4": "0.12 ± 0.002",
                "8": "0.13 ± 0.002",
                "12": "0.30 ± 0.217",
                "16": "1.25 ± 1.016",
            },
        },
    )


BIG_TEAMS_METRICS = (
    "success", "runtime", "runtime_restricted", "first_steps", "first_steps_restricted", "denoising_time_share",
    "travel_time", "step_time",
)  # fmt: skip


def _big_teams() -> Figure:
    policies = {**DENOISERS, **BOTH_C2F}
    random: Environment = ("2D Holo Random", "paper_random", None)
    hundred: Environment = ("2D Holo Random, 100", "random", None)
    few = {"quick_robots": (3,), "time_limit": 60.0}
    return Figure(
        name="big-teams",
        title="D4orm, D4orm-D and D4orm-C2F",
        source="section VIII-A, figure of the variants",
        sections=(
            *_sections(policies, *ENVIRONMENTS, num_robots=SIZES, time_limit=30.0),
            *_sections(policies, random, num_robots=(16, 32, 64), **few),
            *_sections(policies, hundred, num_robots=(100,), scenario_settings=AS_IN_THE_PAPER, **few),
        ),
        across="num_robots",
        metrics=BIG_TEAMS_METRICS,
        plots=("runtime", "travel_time", "success", "survival"),
        deadlines=(1, 2, 10, 30),
        reference="d4orm",
        paper={
            ("2D Holonomic", "d4orm", "runtime"): D4ORM_SECONDS,
            ("2D Holonomic", "d4orm-c2f", "runtime"): {"16": "about 0.2"},
            ("2D Holonomic", "d4orm-c2f", "step_time"): {"16": "30"},
            ("2D Holo Random", "d4orm-d", "runtime"): {"64": "within 2"},
            ("2D Holo Random, 100", "d4orm-d", "runtime"): {"100": "within 30"},
            ("2D Holo Random", "d4orm-c2f", "runtime"): {"64": "within 2"},
        },
        remarks=(
            "Runtime is that of the first solution, or of the coarse plan of d4orm-c2f. Within deadlines d4orm-c2f "
            "counts with all its control loops. `d4orm-c2f` is Algorithm 4 (preset `paper`), with 20 seeds or fewer.",
            CONTROLLERS_TIME,
            "The paper shows 100 random robots; its authors' scenario has no room for them, and ours, with a square of "
            "12.5 m, takes its place.",
        ),
    )


def _noise() -> Figure:
    policies = {**BOTH_C2F, "d4orm-d": PAPER, "hybrid, ours": {"policy": "hybrid"}}
    levels = (0.0, 0.05, 0.1, 0.2, 0.3, 0.5, 1.0)
    return Figure(
        name="noise",
        title="Success under noise on the controls",
        source="section VIII-B, figure of perturbations",
        sections=_sections(policies, PLANE, DRIVES, num_robots=(8,), control_noise_std=levels, time_limit=30.0),
        across="control_noise_std",
        metrics=("success", "travel_time", "first_steps", "denoising_time_share"),
        plots=("success", "travel_time"),
        reference="d4orm-c2f, ours",
        compared_by="travel_time",
        remarks=("The paper gives no numbers in its text; its plots compare the same two methods.", CONTROLLERS_TIME),
    )


OURS = "ours, "
"""Before the labels of our controller's rows."""


COARSENESS = {
    (1, 1): ("0.75", "6.23", "7.23"),
    (2, 1): ("0.37", "6.27", "7.31"),
    (3, 1): ("0.32", "6.35", "7.52"),
    (4, 1): ("0.23", "6.42", "7.62"),
    (1, 5): ("0.57", "6.31", "7.49"),
    (1, 10): ("0.43", "6.36", "7.58"),
}
"""The paper's Table III: runtime, travel time and makespan, by coarseness and checks."""


def _coarseness() -> Figure:
    metrics = ("runtime", "travel_time", "makespan")
    labels = {(f, o): f"f={f}, o={o}" for f, o in COARSENESS}
    policies = {
        prefix + label: {**C2F, **preset, "coarse_factor": f, "check_interval": o}
        for prefix, preset in (("", PAPER), (OURS, {}))
        for (f, o), label in labels.items()
    }
    return Figure(
        name="coarseness",
        title="D4orm-C2F and the coarseness of its guidance",
        source="appendix C-B, Table III",
        sections=_sections(policies, OBSTACLES, num_robots=(16,)),
        across="policy",
        metrics=(*metrics, "success", "first_steps"),
        plots=metrics,
        reference=OURS + labels[1, 1],
        compared_by="travel_time",
        paper={
            (OBSTACLES[0], labels[key], metric): {labels[key]: value}
            for key, values in COARSENESS.items()
            for metric, value in zip(metrics, values)
        },
        remarks=(
            "f: how many times longer the coarse steps are; o: checked for violations at every o-th of them.",
            "Rows without `ours` are Algorithm 4 (preset `paper`).",
            CONTROLLERS_TIME,
        ),
    )


def _noise_schedule() -> Figure:
    policies = {
        f"beta_1={first:g}, beta_T={last:g}": {"policy": "d4orm", **PAPER, "beta_start": first, "beta_end": last}
        for first in (1e-5, 1e-4, 1e-3)
        for last in (1e-2, 2e-2, 5e-2)
    }
    return Figure(
        name="noise-schedule",
        title="D4orm and its noise schedule",
        source="appendix C-A, figure of the schedule",
        sections=_sections(policies, DRIVES, PLANE, SPACE, num_robots=(8,), time_limit=20.0),
        across="policy",
        metrics=(
            "success",
            "runtime",
            "first_steps",
            "denoising_time_share",
            "iterations",
            "iterations_restricted",
            "travel_time",
        ),
        plots=("runtime", "success"),
        reference="beta_1=0.0001, beta_T=0.01",
        remarks=("The paper gives no numbers in its text: it finds little variation, most in differential drive.",),
    )


AMSWARM: Mapping[str, Sequence[Sequence[str]]] = {
    "amswarm": (("0.83", "failed", "0.88", "0.81", "failed"), ("9.60", "failed", "9.10", "8.70", "failed"),
                ("10.43", "failed", "11.05", "10.08", "failed")),
    "d4orm": (("0.17", "0.33", "0.76", "1.17", "1.31"), ("7.00", "7.25", "8.10", "8.36", "7.13"),
              ("46.62", "43.29", "44.62", "43.11", "43.08")),
    "d4orm-d": (("0.19", "0.29", "0.33", "0.40", "0.35"), ("7.02", "7.11", "7.77", "8.04", "7.38"),
                ("46.58", "44.01", "43.57", "42.62", "42.33")),
}  # fmt: skip
"""The paper's runtimes, makespans and jerk, by environment."""


def _amswarm() -> Figure:
    scenarios = tuple(f"amswarm_{number}" for number in range(1, 6))
    metrics, title = ("runtime", "makespan", "jerk"), "Ten 3D holonomic robots"
    once: dict[str, object] = {"policy": "amswarm", **PAPER, "max_iterations": 1}
    policies = {**DENOISERS, "amswarm by its settings, ours": once, "amswarm, ours": {"policy": "amswarm"}}
    return Figure(
        name="amswarm",
        title="D4orm, D4orm-D and AMSwarm in the environments of AMSwarm",
        source="section VIII-C, figure of AMSwarm",
        sections=(
            Section(title=title, policies=policies, scenarios=scenarios, quick_robots=(None,), time_limit=60.0),
        ),
        across="scenario",
        metrics=(*metrics, "success", "first_steps", "first_steps_restricted", "denoising_time_share"),
        plots=metrics,
        reference="d4orm-d",
        paper={
            (title, label, metric): dict(zip(scenarios, row))
            for label, rows in AMSWARM.items()
            for metric, row in zip(metrics, rows)
        },
        remarks=("The paper shows one run each; ours are medians of runtime and means of the rest over seeds of the "
                 "planner. AMSwarm is not its authors' code, which the paper ran, but ours: `amswarm by its settings, "
                 "ours` runs once with theirs, `amswarm, ours` begins anew where a run fails.",),
    )  # fmt: skip


def _distributed() -> tuple[Figure, Figure]:
    """D-D4orm: its selections with a node per robot, and more and more nodes that share the same samples."""
    samples = 2048  # of all nodes together
    # A budget of iterations, not of seconds, so that what is solved does not depend on how busy the machine is.
    paper = {**PAPER, "max_iterations": 20}
    kinds: dict[str, dict[str, object]] = {"": paper, ", ours": {"num_samples": samples, "nodes": None}}
    nodes: dict[str, dict[str, object]] = {
        f"{selection}{kind}": {"policy": "d-d4orm", **settings, "selection": selection}
        for kind, settings in kinds.items()
        for selection in SELECTIONS
    }
    alone = {"d4orm": {**paper, "num_samples": samples}, "d4orm, ours": {"policy": "d4orm", "num_samples": samples}}
    environments = (DRIVES, PLANE, ("2D Heterogeneous", *MIXED[1:]), SPACE)
    selections = Figure(
        name="selections",
        title="D-D4orm with a node per robot",
        source="section VIII-D, figure of D-D4orm, upper row",
        sections=_sections({**alone, **nodes}, *environments, num_robots=SIZES, quick_robots=(2, 3)),
        across="num_robots",
        metrics=DISTRIBUTED_METRICS,
        plots=("iterations", "runtime", "success", "waiting_share"),
        reference="top-k",
        compared_by="iterations",
        remarks=DISTRIBUTED_REMARKS,
    )
    shown = {label: settings for label, settings in nodes.items() if label != "k-means"}
    numbers = replace(
        selections,
        name="nodes",
        title="D-D4orm and the number of its nodes, 16 robots",
        source="section VIII-D, figure of D-D4orm, lower row",
        sections=_sections(shown, *environments, num_robots=(16,), nodes=(1, 2, 4, 8, 16)),
        across="nodes",
        remarks=(
            *DISTRIBUTED_REMARKS,
            "With one node there is nothing to select: all are the planner without nodes.",
            "As in the paper there is no k-means with its parameters; it is in the figure with a node per robot.",
        ),
    )
    return selections, numbers


DISTRIBUTED_METRICS = (
    "success", "iterations", "iterations_restricted", "first_steps", "runtime", "waiting_share", "messages",
    "message_bytes",
)  # fmt: skip
DISTRIBUTED_REMARKS = (
    "The paper shows iterations to the first solution, in a plot without numbers in its text. The policies without "
    "`ours` have its parameters, and 20 iterations.",
    "Iterations are a mean over the successes, in restricted means over all trials.",
    "All nodes are threads of one machine, and share its cores. On machines of their own they would be quicker. What "
    "share of the time they denoise would say as little.",
    "Messages are those that nodes send; each goes to all others.",
)


FIGURES: Mapping[str, Figure] = MappingProxyType({
    figure.name: figure
    for figure in (
        _team_size(), _ipopt(), _big_teams(), _noise(), _coarseness(), _noise_schedule(), _amswarm(),
        *_distributed(),
    )
})  # fmt: skip
"""Every figure by its name."""
