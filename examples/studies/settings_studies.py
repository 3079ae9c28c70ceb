"""Settings of the sampling planners compared on the same instances: a table each.

    python -m examples.studies head_to_head --seeds 20 --out head_to_head

Columns are those of :func:`examples.common.first_solutions`: success with its 95% interval (Wilson), the mean number
of denoising steps to the first solution, a trial without one counting twice the budget (PAR-2), the mean travel time of
the solutions, and how likely it is that a row and the reference are equally good (McNemar on solutions, Wilcoxon on
steps, paired by seed).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from examples.common import first_solutions, save_table, study_trials, trials_parser
from examples.studies import AS_IN_THE_PAPER, FIRST_SEED, settings_rows
from examples.studies.paper import variants
from examples.studies.tune_rivals import TEAMS as TUNED_ON

from d4orm_env import Problem
from d4orm_planners import make_planner
from d4orm_planners.evaluation.store import Trial
from d4orm_planners.evaluation.study import Study
from d4orm_planners.rl.perturbed_scenarios import perturbed
from d4orm_planners.sampling.settings import TUNED

Settings = Mapping[str, dict[str, Any]]
"""Settings of policies by their labels."""
PAPER, AUTHORS = {"preset": "paper"}, {"preset": "authors"}
BUDGET = 2000
"""Denoising steps of a trial of tuned rivals."""


class Block(NamedTuple):
    """Settings whose rows are shown of one team, by at most so many seeds, and the label of their reference.

    The reference may be of another block of the scenario. The model is the scenario's own by default.
    """

    scenario: str
    num_robots: int
    settings: Settings
    reference: str
    seeds: int = 50
    model: str | None = None

    def has(self, trial: Trial) -> bool:
        """Check whether a trial is of this team."""
        name = self.scenario.rpartition(":")[2]
        same = (trial.scenario.partition(" (")[0], trial.num_robots) == (name, self.num_robots)
        return same and self.model in (None, trial.model)


class Comparison(NamedTuple):
    """A comparison, and its table."""

    about: str  #: A description for ``--help``
    column: str  #: Head of the column of labels
    blocks: Callable[[], Sequence[Block]]  #: Makes the blocks, whose rows follow each other
    #: Settings of the quick version
    quick: dict[str, Any] = {"max_iterations": 1, "num_steps": 20}  # noqa: RUF012 - never changed
    quick_robots: int | None = 2  #: Its team size; ``None`` is that of the first block, which is all there is
    first_seed: int = FIRST_SEED  #: Of every row; no default was chosen by seeds from ``FIRST_SEED`` on
    team: str = "{0.scenario}, {0.num_robots} robots"  #: Format of the name of a team, of a trial's attributes
    #: Makes the rows of a block
    rows: Callable[[str, str, dict[str, list[Trial]], str], list[dict[str, Any]]] = first_solutions
    study: Mapping[str, Any] = {}  #: Further arguments of the studies
    mark: str = ""  #: What the reference is called in addition

    def blocks_of(self, quick: bool) -> list[Block]:
        """The blocks, or those of the quick version."""
        blocks = list(self.blocks())
        if not quick:
            return blocks
        small: list[Block] = []
        for block in blocks if self.quick_robots else blocks[:1]:
            settings = {label: own | self.quick for label, own in block.settings.items()}
            less = block._replace(settings=settings, num_robots=self.quick_robots or block.num_robots, seeds=1)
            if less not in small:  # teams may have differed in size
                small.append(less)
        return small


def credits_and_penalties() -> list[Block]:
    """Four teams of 16, D4orm's defaults but for ``credit`` and ``penalty``, at most 20 iterations."""
    penalties = {"team": (1.0,), "robot": (1.0, 2.0), "alternate": (1.0, 2.0), "group": (1.0, 2.0, 3.0)}
    settings = {
        f"{credit}, {penalty:g}": d4orm(credit=credit, penalty=penalty)
        for credit, each in penalties.items()
        for penalty in each
    }
    teams = (("paper_circle", "holonomic2d"), ("paper_circle", "differential_drive"), ("paper_heterogeneous", None),
             ("paper_obstacles", "holonomic2d"))  # fmt: skip
    return [Block(scenario, 16, settings, "group, 2", model=model) for scenario, model in teams]


def d4orm(policy: str = "d4orm", max_iterations: int = 20, **settings: Any) -> dict[str, Any]:
    """Settings of a planner on the CPU, at most 20 iterations unless said."""
    return {"policy": policy, "engine": "cpu", "max_iterations": max_iterations, **settings}


def differences() -> list[Block]:
    """The preset with one setting of the defaults in turn, and the defaults with one of the preset's."""
    groups = {"credit": "group", "penalty": 2.0}
    preset = {
        "preset paper": d4orm(**PAPER),
        "preset, clipped between iterations": d4orm(**PAPER, clip_between_iterations=True),
        "preset, random start": d4orm(**PAPER, random_start=True),
        "preset, 256 samples": d4orm(**PAPER, num_samples=256),
        "preset, small weights dropped": d4orm(**PAPER, weight_cutoff=1e-3),
        "preset, by groups with contacts that cost both": d4orm(**PAPER, **groups),
    }
    defaults = {
        "defaults": d4orm(),
        "defaults, not clipped between iterations": d4orm(clip_between_iterations=False),
        "defaults, random start": d4orm(random_start=True),
        "defaults, 1024 samples throughout": d4orm(num_samples=1024, late_samples=1.0),
        "defaults, all weights kept": d4orm(weight_cutoff=0.0),
        "defaults, by the team's reward": d4orm(credit="team", penalty=1.0),
    }
    return [
        Block(scenario, num_robots, settings, reference)
        for scenario, num_robots in (("paper_circle", 16), ("paper_obstacles", 12))
        for reference, settings in (("preset paper", preset), ("defaults", defaults))
    ]


def presets_head_to_head() -> list[Block]:
    """D4orm and D4orm-D by their presets and defaults; and what one difference, or a higher penalty, does."""
    by_preset = {
        name: {f"{name}, authors": d4orm(name, **AUTHORS), f"{name}, paper": d4orm(name, **PAPER),
               f"{name}, ours": d4orm(name)}
        for name in ("d4orm", "d4orm-d")
    }  # fmt: skip
    penalties = {f"d4orm, paper, penalty of {value:g}": d4orm(**PAPER, penalty=value) for value in (2.0, 4.0)}
    taken_back: dict[str, dict[str, Any]] = {
        "authors, penalty once a step": {"penalty_per_pair": False},
        "authors, penalty of 1 throughout": {"penalty_rise": 0.0},
        "authors, controls of the probe kept": {"reset_after_probe": False},
        "authors, never clipped": {"clip_after": None},
        "authors, straight start": {"start": "straight"},
        "paper, penalty per pair": {**PAPER, "penalty_per_pair": True},
    }
    one_less = {label: d4orm("d4orm-d", **AUTHORS | own) for label, own in taken_back.items()}
    return [
        Block("paper_circle", 16, by_preset["d4orm"], "d4orm, authors", 20),
        Block("paper_circle", 16, penalties, "d4orm, paper", 10),
        Block("paper_circle", 16, by_preset["d4orm-d"], "d4orm-d, authors", 20),
        Block("paper_circle", 16, one_less, "d4orm-d, authors", 10),
        Block("paper_random", 64, by_preset["d4orm-d"], "d4orm-d, authors", 5),
        Block("paper_random", 64, one_less, "d4orm-d, authors", 3),
        Block("paper_obstacles", 16, by_preset["d4orm-d"], "d4orm-d, authors", 10),
    ]


def tuned_rivals() -> list[Block]:
    """Every preset by its label, with as many iterations as the budget has room for."""
    chosen: dict[str, dict[str, Any]] = {"d4orm, defaults": {"policy": "d4orm"}}
    for method, tuned in TUNED.items():
        for preset in ("paper", "tuned") if tuned else ("paper",):
            if (method, preset) != ("mbd", "paper"):
                chosen[f"{method}, {preset}"] = {"policy": method, "preset": preset}
    for settings in chosen.values():
        name, own = settings["policy"], {key: value for key, value in settings.items() if key != "policy"}
        num_steps = min(make_planner(name, **own).config.num_steps, BUDGET)
        iterations = 1 if name == "mbd" else BUDGET // num_steps
        settings |= {"engine": "cpu", "num_steps": num_steps, "max_iterations": iterations}
    teams = (*TUNED_ON, ("paper_circle", 16))
    return [Block(scenario, num_robots, chosen, "d4orm, tuned") for scenario, num_robots in teams]


def steps_and_samples() -> list[Block]:
    """8 and 16 robots on the circle, at most 8 iterations of so many steps and samples."""
    alike = {"late_samples": 1.0}
    chosen: Settings = {
        "100 x 1024": {**alike, "num_samples": 1024},
        "100 x 256": alike,
        "100 x 128": {**alike, "num_samples": 128},
        "70 x 256": {**alike, "num_steps": 70},
        "50 x 256": {**alike, "num_steps": 50},
        "50 x 512": {**alike, "num_steps": 50, "num_samples": 512},
        "100 x 256, the last 40% with 128": {"late_steps": 0.4},
        "100 x 256, the last 40% with 64": {"late_steps": 0.4, "late_samples": 0.25},
        "100 x 256, the last 70% with 128 (default)": {},
        "100 x 256, the last 70% with 64": {"late_samples": 0.25},
    }
    settings = {label: d4orm(max_iterations=8, **own) for label, own in chosen.items()}
    return [Block("circle", robots, settings, "100 x 256, the last 70% with 128 (default)") for robots in (8, 16)]


def irregular_circle(seed: int, num_robots: int) -> Problem:
    """The paper's circle turned at random, starts and goals moved by up to 0.1 m on either axis."""
    problem = perturbed(seed, num_robots, base="paper_circle", shift=0.1, shrink=0.0)
    return problem.replace(name=irregular_circle.__name__)


def irregular_circles() -> list[Block]:
    """8, 12 and 16 robots by the paper's presets, on circles that differ from seed to seed."""
    settings = {name: d4orm(name, **PAPER) for name in ("d4orm", "mppi", "cem", "d4orm-d")}
    return [Block(f"{__name__}:{irregular_circle.__name__}", size, settings, "d4orm") for size in (8, 12, 16)]


def limited_jerk() -> list[Block]:
    """4 and 8 double integrators on the circle, and the same with limits on their jerk (paper, section VIII-C)."""
    settings = {"d4orm": d4orm(**PAPER)}
    models = ("holonomic2d", "holonomic2d_jerk")
    return [Block("paper_circle", size, settings, "d4orm", 20, model) for size in (4, 8) for model in models]


def algorithm_4() -> list[Block]:
    """Algorithm 4 as written, with one thing changed, and with fewer steps from kept or no controls."""
    written = {"policy": "d4orm-c2f", "refine": "sync", "engine": "cpu", **PAPER}
    reset = {"policy": f"{variants.__name__}:{variants.ForgetfulC2F.__name__}"}
    changes: dict[str, dict[str, Any]] = {
        "as written": {},
        "guidance not refined": {"refine": "off"},
        "controls reset": reset,
        "window of 40, subgoal 30 on": {"predict_horizon": 40, "subgoal_offset": 30},
        "window of 80, subgoal 60 on": {"predict_horizon": 80, "subgoal_offset": 60},
    }
    blocks = [(8, changes), (16, {label: changes[label] for label in ("as written", "guidance not refined")})]
    for steps in (20, 10, 5):
        fewer = {"num_steps": steps}
        blocks.append((8, {f"{steps} steps": fewer, f"{steps} steps, controls reset": fewer | reset}))
    return [
        Block("paper_circle", size, {label: written | own for label, own in block.items()}, next(iter(block)), 10)
        for size, block in blocks
    ]


def ipopt_starts() -> list[Block]:
    """One start of IPOPT from the motion without collisions, perturbed or not, on circles that differ or do not."""
    counted = f"{variants.__name__}:{variants.CountedIpopt.__name__}"
    kinds: Settings = {"ours": {}, "all pairs at once": PAPER}
    noise = {"perturbed by 0.1": 0.1, "perturbed by 0.01": 0.01, "not perturbed": 0.0}
    sets = {
        kind: {f"{kind}, {word}": {"policy": counted, "engine": "cpu", "max_iterations": 1, **own, "perturbation": size}
               for word, size in noise.items()}
        for kind, own in kinds.items()
    }  # fmt: skip
    irregular = f"{__name__}:{irregular_circle.__name__}"
    chosen = [("all pairs at once", 12), ("ours", 20)]
    blocks = [Block(irregular, 4, sets[kind], f"{kind}, not perturbed", seeds) for kind, seeds in chosen]
    # On one circle starts that are not perturbed are all the same; a trace of noise stands for them.
    pairs, trace = sets["all pairs at once"], "all pairs at once, perturbed by 0.0001"
    pairs = pairs | {trace: pairs["all pairs at once, not perturbed"] | {"perturbation": 1e-4}}
    for label, own in pairs.items():
        once = "not" in label
        blocks.append(Block("paper_circle", 4, {label: own}, label if once else trace, 1 if once else 12))
    return blocks


COMPARISONS: Mapping[str, Comparison] = {
    "algorithm_4_parts": Comparison(
        "D4orm-C2F by the paper's Algorithm 4 with one thing changed: refinement, the window, where loops begin.",
        "controller", algorithm_4, quick={"coarse_samples": 64, "coarse_steps": 15, "num_samples": 32, "num_steps": 5},
        first_seed=0, rows=settings_rows.executed,
    ),
    "ipopt_starts": Comparison(
        "IPOPT's own iterations in one start that is perturbed, as in the paper, or not.",
        "start", ipopt_starts, quick={}, first_seed=2000, rows=settings_rows.solver_iterations,
    ),
    "jerk_limits": Comparison(
        "D4orm with the paper's preset and limits on the jerk in the robots' dynamics.", "planner", limited_jerk,
        team="{0.num_robots} of {0.model}", rows=settings_rows.with_jerk,
    ),
    "irregular_circles": Comparison(
        "The paper's presets on circles turned at random, starts and goals moved by up to 0.1 m on either axis.",
        "planner", irregular_circles, team="{0.num_robots} robots",
    ),
    "contact_penalty": Comparison(
        "Whose reward samples are weighted by, and what a contact costs in it, against the defaults.",
        "credit, penalty", credits_and_penalties, team="{0.scenario}, {0.model}",
        mark=" (default)",
    ),
    "paper_differences": Comparison(
        "Each difference between the paper's D4orm and this project's defaults, one at a time.", "settings", differences
    ),
    "head_to_head": Comparison(
        "The paper as written, its authors' published code re-implemented, and this project's defaults.",
        "planner", presets_head_to_head, quick={"max_iterations": 2, "num_steps": 10, "num_samples": 64},
        first_seed=0, rows=settings_rows.with_iterations,
    ),
    "tuned_rivals": Comparison(
        "D4orm and its rivals as the paper has them and tuned with the same effort, on seeds that no tuning has seen. "
        "A trial has 2000 denoising steps, of 1024 samples but for the defaults, which draw 256 and later 128; MBD has "
        "its one run, of as many steps as it was tuned with.",
        "method", tuned_rivals, quick_robots=None, first_seed=0,
    ),
    "fewer_samples": Comparison(
        "Samples until D4orm's first solution with fewer steps, fewer samples, or fewer while the noise is small: "
        "median, quartiles, and how likely a row and the defaults need equally many (Wilcoxon, paired by seed).",
        "steps x samples", steps_and_samples, quick={"max_iterations": 1}, team="{0.num_robots}",
        rows=settings_rows.samples_needed, study={"scenario_settings": AS_IN_THE_PAPER},
    ),
}  # fmt: skip
"""Every comparison by its name."""


def main(name: str) -> None:
    compared = COMPARISONS[name]
    arguments = trials_parser(f"{compared.about}\n\n{__doc__}", seeds=50).parse_args()
    blocks = compared.blocks_of(arguments.quick)
    studies = [
        Study(
            policies=block.settings, scenarios=(block.scenario,), num_robots=(block.num_robots,), model=block.model,
            seeds=range(compared.first_seed, compared.first_seed + min(arguments.seeds, block.seeds)), **compared.study,
        )
        for block in blocks
    ]  # fmt: skip
    trials = study_trials(arguments, name, studies)
    rows = []
    for block in blocks:
        own = [trial for trial in trials if block.has(trial)]
        labels = dict.fromkeys((*block.settings, block.reference))
        groups = {label: found for label in labels if (found := [trial for trial in own if trial.label == label])}
        made = compared.rows(compared.team.format(own[0]), compared.column, groups, block.reference)
        for row in made:
            if (label := row[compared.column]) in block.settings:
                rows.append(row | {compared.column: label + compared.mark * (label == block.reference)})
    save_table(rows, arguments.out / f"{name}.csv")
