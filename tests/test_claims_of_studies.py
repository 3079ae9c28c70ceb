"""What the pages say of the studies in ``examples/``, recomputed from their trials."""

from __future__ import annotations

import importlib
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from claims_support import ROOT, WORDS, says, trials

from d4orm_planners.evaluation.comparison import is_solved, paired, penalised_steps
from d4orm_planners.evaluation.store import Trial
from d4orm_planners.evaluation.summary import mean_interval

RESULTS, README = "docs/results.md", "README.md"
FRACTIONS = {"an eighth": 1 / 8, "a sixth": 1 / 6, "a fifth": 1 / 5, "a quarter": 1 / 4, "a third": 1 / 3,
             "two fifths": 2 / 5, "half": 1 / 2, "three fifths": 3 / 5, "two thirds": 2 / 3}  # fmt: skip

parquet = pytest.importorskip("pyarrow.parquet")

Team = Mapping[str, object]
Groups = dict[str, list[Trial]]

CIRCLE_8: Team = {"scenario": "paper_circle", "num_robots": 8}
CIRCLE_16: Team = {"scenario": "paper_circle", "num_robots": 16}
RANDOM: Team = {"scenario": "paper_random", "num_robots": 16}
HETEROGENEOUS: Team = {"scenario": "paper_heterogeneous"}
OBSTACLES: Team = {"scenario": "paper_obstacles"}
INTEGRATORS: Team = {"scenario": "paper_circle", "model": "holonomic2d"}
DRIVES: Team = {"scenario": "paper_circle", "model": "differential_drive"}


@cache
def example(name: str) -> ModuleType:
    """A program of ``examples/``, for the definitions that its table is made with."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(ROOT / "examples")
        return importlib.import_module(name)


@cache
def measured(name: str) -> list[dict[str, Any]]:
    """The rows of a study that are of its own kind, no trials."""
    return list(parquet.read_table(ROOT / "data" / f"{name}.parquet").to_pylist())


def by_label(study: str, **team: object) -> Groups:
    """The trials of a team in a study, by what the policy with its settings was called."""
    groups: Groups = {}
    for trial in trials(study):
        if all(getattr(trial, name) == value for name, value in team.items()):
            groups.setdefault(trial.label, []).append(trial)
    return groups


def config(trial: Trial) -> dict[str, Any]:
    return dict(json.loads(trial.config))


def seeds(group: Iterable[Trial]) -> list[int]:
    return sorted({trial.seed for trial in group})


def solved(group: Iterable[Trial]) -> int:
    return sum(map(is_solved, group))


def steps(group: Iterable[Trial]) -> int:
    """The mean to the first solution, twice the budget for none."""
    return round(float(np.mean([*map(penalised_steps, group)])))


def way(group: Iterable[Trial]) -> float:
    """The mean travel time of the solutions."""
    return float(np.mean([trial.travel_time for trial in group if is_solved(trial)]))


def p_solved(first: Sequence[Trial], second: Sequence[Trial]) -> float:
    return paired(first, second, penalised_steps, is_solved).success_p


def p_steps(first: Sequence[Trial], second: Sequence[Trial]) -> float:
    return paired(first, second, penalised_steps, is_solved).cost_p


def fraction(share: float) -> str:
    """The nearest one that has a name."""
    return min(FRACTIONS, key=lambda name: abs(FRACTIONS[name] - share))


def percents(shares: Iterable[float]) -> str:
    """The least and the most of them, such as "1 to 2%", or "3%" where both round to that."""
    ends = sorted(round(100 * share) for share in shares)
    return f"{' to '.join(map(str, dict.fromkeys((ends[0], ends[-1]))))}%"


def longer(groups: Iterable[Groups], label: str, other: str) -> str:
    """How much longer ways are with one label than with another, over these teams."""
    return percents(way(group[label]) / way(group[other]) - 1 for group in groups)


def shorter(groups: Iterable[Groups], label: str, other: str) -> str:
    return percents(1 - way(group[label]) / way(group[other]) for group in groups)


# Gradient dilution


def dilution(size: int, credit: str, name: str) -> float:
    """The mean over the seeds."""
    return float(np.mean(example("gradient_dilution").means(measured("gradient_dilution"), size, credit, name)))


def test_theory_of_dilution_depends_on_temperature_and_samples_alone() -> None:
    program = example("gradient_dilution")
    few, many = program.normal_limit(program.NUM_SAMPLES), program.normal_limit(8 * program.NUM_SAMPLES)
    assert few["own_reward"] < many["own_reward"] < 1.15 * few["own_reward"]
    assert few["own_reward"] < (2 * np.log(program.NUM_SAMPLES)) ** 0.5
    assert many["own_reward"] < 1 / program.TEMPERATURE
    says(
        RESULTS,
        f"whatever the team's size, **{len({row['seed'] for row in measured('gradient_dilution')})} seeds**",
        f"{few['own_reward']:.2f} and {few['effective_samples']:.1f} for "
        rf"$\lambda = {program.TEMPERATURE}$, $M = {program.NUM_SAMPLES}$",
        f"average over the same {WORDS[round(few['effective_samples'])]} samples stays",
        "and hardly the signal greater",
    )


def test_theory_of_dilution_holds_for_large_teams() -> None:
    program = example("gradient_dilution")
    theory = program.normal_limit(program.NUM_SAMPLES)
    own, effective = theory["own_reward"], theory["effective_samples"]
    off = {size: abs(dilution(size, "team", "own_reward") - own / size**0.5) for size in (8, 16, 32, 64)}
    counted = [dilution(size, "team", "effective_samples") for size in off]
    says(
        RESULTS,
        f"normalised reward is {max(off[8], off[32], off[64]):.2f} off or less with 8 and from 32 robots on, and "
        f"{off[16]:.2f} with 16; effective samples are {min(counted):.1f} to {max(counted):.1f} for {effective:.1f}.",
    )
    alone = np.mean([dilution(size, "robot", "own_reward") for size in program.SIZES])
    more = max(dilution(size, "robot", "effective_samples") for size in program.SIZES) / effective
    says(
        RESULTS,
        f"a robot's own signal is {alone:.2f} instead of {own:.2f}, of four "
        f"{dilution(4, 'team', 'own_reward'):.2f} instead of {own / 2:.2f}, with up to {WORDS[round(more)]} times",
    )


def test_theory_of_dilution_fails_for_eight_robots_with_more_samples() -> None:
    program = example("gradient_dilution")
    theory = program.normal_limit(8 * program.NUM_SAMPLES)
    assert dilution(8, program.MORE, "samples") == 8 * program.NUM_SAMPLES
    says(
        RESULTS,
        f"8 times as many samples theory fails for 8 robots too ({dilution(8, program.MORE, 'own_reward'):.2f} and "
        f"{dilution(8, program.MORE, 'effective_samples'):.1f} effective samples for "
        f"{theory['own_reward'] / 8**0.5:.2f} and {theory['effective_samples']:.1f})",
    )


def test_reward_falls_by_team_credit_only() -> None:
    sizes, group = example("gradient_dilution").SIZES, example("gradient_dilution").GROUP
    own = [dilution(size, "robot", "reward") for size in sizes]
    assert max(own) - min(own) < 0.001
    in_groups = [dilution(size, "group", "reward") for size in sizes if size > group]
    assert np.ptp([*in_groups, dilution(group, "team", "reward")]) < 0.004
    says(
        RESULTS,
        f"the reward falls from {own[0]:.3f} to {dilution(64, 'team', 'reward'):.3f}, and of 64 robots "
        f"{dilution(64, 'team', 'arrived'):.0%} arrive",
        "**Own credit**: nothing is lost at any size",
        f"**Groups of {WORDS[group]}** lose what {WORDS[group]} robots lose, at any size of the team",
    )


def test_samples_in_proportion_are_worth_no_more_than_groups() -> None:
    program, rows = example("gradient_dilution"), measured("gradient_dilution")
    intervals = [mean_interval(program.means(rows, 16, credit, "reward"))[1:] for credit in (program.MORE, "group")]
    lowest, highest = ([end for end in ends if end is not None] for ends in zip(*intervals))
    assert max(lowest) < min(highest), "the intervals overlap"
    times = dilution(16, program.MORE, "samples") / dilution(16, "group", "samples")
    says(
        RESULTS,
        f"with {times:g} times as many, 16 robots reach {dilution(16, program.MORE, 'reward'):.3f}, as with groups",
    )


# Fewer or cheaper steps

HALF, QUARTER = "100 x 256, the last 70% with 128 (default)", "100 x 256, the last 70% with 64"


def samples(group: Iterable[Trial]) -> float:
    """The median until the first solution."""
    return float(np.median([example("fewer_samples").cost(trial) for trial in group]))


def p_samples(first: Sequence[Trial], second: Sequence[Trial]) -> float:
    return paired(first, second, example("fewer_samples").cost).cost_p


def p_ways(first: Sequence[Trial], second: Sequence[Trial]) -> float:
    return paired(first, second, lambda trial: trial.travel_time or 0.0).cost_p


def both_teams() -> list[Groups]:
    """The trials with 8 and those with 16 robots, by setting."""
    return [by_label("fewer_samples", num_robots=size) for size in (8, 16)]


def test_every_setting_of_steps_and_samples_solves_all() -> None:
    eight, _ = both_teams()
    assert solved(trials("fewer_samples")) == len(trials("fewer_samples"))
    assert all(sum(trial.iterations == 1 for trial in group) >= 0.95 * len(group) for group in eight.values())
    drawn = seeds(trials("fewer_samples"))
    says(
        RESULTS,
        f"with fewer of either once the noise is small: **{len(drawn)} seeds**, from {drawn[0]} on",
        f"**All {len(trials('fewer_samples')):,} trials are solved**, by every setting, and with 8 robots nearly all "
        "in their first iteration",
    )


def test_half_of_the_late_samples_take_a_third_less() -> None:
    teams = both_teams()
    assert all(p_samples(team[HALF], team["100 x 256"]) < 1e-4 for team in teams)
    assert all(p_ways(team[HALF], team["100 x 256"]) > 0.1 for team in teams)
    (half,) = {round(samples(team[HALF]), -3) for team in teams}
    (whole,) = {round(samples(team["100 x 256"]), -3) for team in teams}
    more = [way(team[HALF]) - way(team["100 x 256"]) for team in teams]
    says(
        RESULTS,
        f"takes {fraction(1 - half / whole)} less than the same samples throughout: {half:,.0f} against {whole:,.0f} "
        f"in the median (p < 0.0001), and ways do not differ significantly ({more[0]:.2f} and {more[1]:.2f} s",
    )


def test_a_quarter_of_the_late_samples_takes_a_quarter_less_still() -> None:
    teams = both_teams()
    assert all(p_samples(team[QUARTER], team[HALF]) < 1e-4 for team in teams)
    (less,) = {fraction(1 - samples(team[QUARTER]) / samples(team[HALF])) for team in teams}
    most = percents([max(way(team[QUARTER]) / way(team[HALF]) for team in teams) - 1])
    says(RESULTS, f"takes {less} less still (p < 0.0001), on ways up to {most} longer again")


def test_few_samples_or_steps_cost_length() -> None:
    teams = both_teams()
    default, samples_128, steps_50 = (teams[1][label] for label in (HALF, "100 x 128", "50 x 256"))
    assert samples(steps_50) > samples(default) > samples(samples_128)
    (more,) = {longer(teams, label, HALF) for label in ("100 x 128", "50 x 256")}
    says(
        RESULTS,
        f"100 steps of 128 samples do not take significantly fewer samples than the default "
        f"(p = {p_samples(samples_128, default):.2f}), and 50 steps of 256 more "
        f"(p = {p_samples(steps_50, default):.2f}), and the plans of both take {more} longer",
    )


def test_many_samples_make_ways_short() -> None:
    teams = both_teams()
    (times,) = {round(samples(team["100 x 1024"]) / samples(team[HALF])) for team in teams}
    less = shorter(teams, "100 x 1024", HALF)
    says(
        RESULTS,
        f"1024 in each step take {WORDS[times]} times as many until the first solution, and travel {less} less long",
    )


# Lifelong control and scaling


def test_lifelong_control_is_near_the_bound_and_touches_nothing() -> None:
    drives = measured("lifelong")
    (minutes,) = {row["seconds"] / 60 for row in drives}
    (robots,) = {row["robots"] for row in drives}
    assert not any(row["touched"] or row["contacts"] for row in drives)
    machine = json.loads(drives[0]["machine"])
    share = np.mean([row["goals"] * row["least_time"] / (row["robots"] * row["seconds"]) for row in drives])
    loops = 1000 * np.concatenate([row["loop_seconds"] for row in drives])
    says(
        RESULTS,
        f"{robots} robots under D4orm-C2F, **{len(drives)} seeds** of {WORDS[round(minutes)]} minutes",
        f"On {WORDS[machine['cores_used']]} cores of an {machine['processor']} that did nothing",
        f"**{share:.0%} of the bound, and nobody touched anybody** in {sum(row['goals'] for row in drives):,} ways to "
        f"a goal. A control loop takes {np.median(loops):.0f} ms in the median and {loops.max():.0f} at most",
    )


def test_time_per_robot_grows_with_big_teams() -> None:
    program, rows = example("scaling"), measured("scaling")
    per_robot = {
        size: np.median([row["seconds"] for row in rows if row["robots"] == size]) / size for size in program.ROBOTS
    }
    large = [size for size in program.ROBOTS if size >= 32]
    assert [*map(per_robot.__getitem__, large)] == sorted(map(per_robot.__getitem__, large))
    assert all(row["solved"] for row in rows)
    wider = (max(program.ROBOTS) / 64) ** 0.5
    (cores,) = {json.loads(row["machine"])["cores_used"] for row in rows}
    says(
        RESULTS,
        f"at constant density, {program.AREA:.2f} m² per robot, on {WORDS[cores]} cores of a machine that did nothing",
        "From 32 robots on time per robot grows",
        f"a thousand robots take {per_robot[1000] / per_robot[64]:.1f} times as long per robot as 64, on a square "
        f"nearly {WORDS[math.ceil(wider)]} times as wide",
    )


def test_a_second_core_is_worth_more_to_big_teams() -> None:
    threads = json.loads((ROOT / "data" / "bench.json").read_text())["threads"]
    speedup = {row["num_robots"]: row["speedup"]["median"] for row in threads}
    says(RESULTS, f"{speedup[8]:.1f} times as fast with 8 robots, {speedup[64]:.1f} with 64")


# Multimodality


def classes(label: str) -> dict[tuple[int, int, int], list[dict[str, Any]]]:
    """The solutions of a planner by their class."""
    pytest.importorskip("casadi")
    program = example("multimodality")
    found: dict[tuple[int, int, int], list[dict[str, Any]]] = {}
    for row in program.solutions(measured("multimodality"), label):
        found.setdefault(program.signature(program.path_of(row)), []).append(row)
    return found


PLANNERS = ("d4orm", "d4orm, preset paper", "ipopt")


def test_all_planners_find_six_classes_of_which_robots_weave_in_none() -> None:
    (counts,) = {len(classes(label)) for label in PLANNERS}
    assert all(row["solved"] for row in measured("multimodality"))
    # A robot that weaves: orders that are cycles.
    assert not any({(-1, -1, 1), (1, 1, -1)} & {*classes(label)} for label in PLANNERS)
    says(
        RESULTS,
        f"{len({row['seed'] for row in measured('multimodality')})} seeds, first solutions, mean travel time",
        f"**{WORDS[counts].capitalize()} classes, as in the paper, by D4orm and by IPOPT**: yes, with both settings "
        "of D4orm, and every seed solved",
        f"**Why {WORDS[counts]} of {WORDS[len(example('multimodality').CLASSES)]} combinations**",
        "No seed found one.",
    )


def test_clusters_of_the_principal_components_are_the_classes() -> None:
    found = [*classes("d4orm").values()]
    program = example("multimodality")
    points, _ = program.principal_components([program.path_of(row) for rows in found for row in rows])
    number = np.repeat(np.arange(len(found)), [*map(len, found)])
    centres = np.stack([points[number == one].mean(axis=0) for one in range(len(found))])
    nearest = np.linalg.norm(points[:, None] - centres, axis=2).argmin(axis=1)
    np.testing.assert_array_equal(nearest, number)
    says(RESULTS, "The clusters of the principal components are the classes.")


def test_robots_on_different_sides_of_the_obstacle_are_sooner_and_more_often() -> None:
    different = ((-1, -1, -1), (1, 1, 1))
    for found in map(classes, PLANNERS):
        times = {signs: np.mean([row["travel_time"] for row in rows]) for signs, rows in found.items()}
        assert max(times[signs] for signs in different) < min(times[signs] for signs in {*times} - {*different})
        assert sum(len(found[signs]) for signs in different) >= sum(map(len, found.values())) / 2
    says(
        RESULTS,
        "with the robots on different sides of the obstacle a plan is shorter, and half of the plans or more are of "
        f"these {WORDS[len(different)]} classes",
    )


def test_d4orm_finds_more_different_plans_of_a_team_than_ipopt_in_distance_only() -> None:
    pytest.importorskip("casadi")
    rows = measured("multimodality_team")
    default, preset, ipopt = (example("multimodality_team").row_of(label, rows) for label in PLANNERS)
    assert preset["classes"] == ipopt["classes"]
    (robots,) = {row["robots"] for row in rows}
    number = len({row["seed"] for row in rows})
    says(
        RESULTS,
        f"{WORDS[robots].capitalize()} robots on the paper's circle, {number} seeds: a plan's class is, for all "
        f"{robots * (robots - 1) // 2} pairs of robots",
        f"lie {float(preset['distance [m]']) / float(ipopt['distance [m]']):.1f} times as far apart as two of IPOPT",
        f"the preset and IPOPT find {ipopt['classes']} with {number} seeds, our defaults {default['classes']}",
    )


# D4orm and its rivals, tuned

TUNED_ON: tuple[Team, ...] = (CIRCLE_8, RANDOM, HETEROGENEOUS, OBSTACLES)
RIVALS = {"mppi, paper": "MPPI", "cem, tuned": "CEM", "mbd, tuned": "MBD", "i-mbd, tuned": "i-MBD"}
"""As tuning left them, and what the page calls them."""
OURS = "d4orm, tuned"


def rivals(team: Team) -> Groups:
    return by_label("tuned_rivals", **team)


def test_every_method_was_tuned_with_the_same_effort() -> None:
    tried: dict[str, dict[str, list[Trial]]] = {}
    for trial in trials("tuning"):
        tried.setdefault(trial.policy, {}).setdefault(trial.config, []).append(trial)
    (lengths,) = {tuple(sorted(map(len, groups.values()))) for groups in tried.values()}
    first, *later = sorted({*lengths})
    assert later == [2 * first, 4 * first]
    took_part = [sum(length >= least for length in lengths) for least in (first, *later)]
    assert took_part[0] == 3 * took_part[1] == 9 * took_part[2]
    (budget,) = {config(trial)["num_steps"] * config(trial)["max_iterations"] for trial in trials("tuning")}
    (batch,) = {config(trial)["num_samples"] for trial in trials("tuning")}
    teams = {(trial.scenario, trial.num_robots) for trial in trials("tuning")}
    assert teams == {(trial.scenario, trial.num_robots) for team in TUNED_ON for trial in rivals(team)[OURS]}
    says(
        RESULTS,
        f"its preset and {len(lengths) - 1} settings drawn at random",
        f"on {WORDS[len(teams)]} teams (8 on the circle, 8 heterogeneous, 8 among four obstacles, 16 random) with "
        f"{WORDS[first // len(teams)]} seeds from {seeds(trials('tuning'))[0]} on; the better third goes on to twice",
        f"A trial has {budget} denoising steps of {batch} samples",
        f"a trial without one counting {2 * budget}. The best are the preset",
        f"The table has the last {WORDS[took_part[2]]} of each method and its preset",
        f"All {len(trials('tuning')):,} are in `data/tuning.parquet`",
    )


def test_the_best_settings_are_the_preset_tuned() -> None:
    program = example("tune_rivals")
    best: dict[str, str] = {}
    for row in program.rows_of(trials("tuning")):
        best.setdefault(row["method"], row["settings"])
    used = {group[0].policy: group[0] for label, group in rivals(CIRCLE_16).items() if label in (*RIVALS, OURS)}
    assert {method: program.described(method, config(trial)) for method, trial in used.items()} == best
    says(RESULTS, "The best are the preset `tuned` of `make_planner`.", "MPPI was best with its preset")


def test_tuned_methods_meet_seeds_that_no_tuning_has_seen() -> None:
    drawn = seeds(trials("tuned_rivals"))
    assert not {*drawn} & {*seeds(trials("tuning"))}
    for team in (*TUNED_ON, CIRCLE_16):
        instances = {trial.problem for trial in rivals(team)[OURS]}
        assert len(instances) == (len(drawn) if team is RANDOM else 1)
    budgets = {
        trial.policy: config(trial)["num_steps"] * config(trial)["max_iterations"] for trial in trials("tuned_rivals")
    }
    (others,) = {budget for policy, budget in budgets.items() if policy != "mbd"}
    says(
        RESULTS,
        f"**On seeds that no tuning has seen** ({drawn[0]} to {drawn[-1]})",
        "Other seeds are other instances of the random places only",
        f"at most {others} steps (MBD {budgets['mbd']})",
    )


def best_rival(groups: Groups) -> str:
    return min(RIVALS, key=lambda label: steps(groups[label]))


def ours_and_best(groups: Groups) -> str:
    """Steps of tuned D4orm and of the rival with the fewest, and how likely it is that they are alike."""
    rival = best_rival(groups)
    p = p_steps(groups[rival], groups[OURS])
    return f"{steps(groups[OURS])}; {RIVALS[rival]} {steps(groups[rival])}, p = {p:.1g}"


def test_tuned_d4orm_is_first_or_as_good_on_four_teams_of_five() -> None:
    teams = [rivals(team) for team in (*TUNED_ON, CIRCLE_16)]
    good = [
        steps(team[OURS]) < steps(team[best_rival(team)]) or p_steps(team[best_rival(team)], team[OURS]) > 0.05
        for team in teams
    ]
    circle, random, mixed, obstacles, sixteen = teams
    ours, rival = sixteen[OURS], sixteen[best_rival(sixteen)]
    assert p_steps(rival, ours) < 1e-4
    assert p_steps(mixed["i-mbd, tuned"], mixed[OURS]) < 1e-4
    says(
        RESULTS,
        "**Tuned alike, D4orm needs the fewest steps or does not differ significantly from who does, on "
        f"{WORDS[sum(good)]} teams of {WORDS[len(good)]}**: on the circle of 8 ({ours_and_best(circle)}), with 16 "
        f"random robots ({ours_and_best(random)}), among obstacles ({ours_and_best(obstacles)}), and on the circle of "
        f"16 ({steps(ours)}, {solved(ours)} of {len(ours)} solved; {RIVALS[best_rival(sixteen)]}, the next that was "
        f"tuned, {steps(rival):,} and {solved(rival)}, p < 0.0001)",
        f"On the heterogeneous team it needs {steps(mixed[OURS])}, where i-MBD needs {steps(mixed['i-mbd, tuned'])} "
        f"(p < 0.0001), its own preset {steps(mixed['d4orm, paper'])} "
        f"(p = {p_steps(mixed['d4orm, paper'], mixed[OURS]):.1g}) and CEM {steps(mixed['cem, tuned'])} "
        f"(p = {p_steps(mixed['cem, tuned'], mixed[OURS]):.2g})",
    )


def test_cem_gains_steps_by_tuning_and_loses_length() -> None:
    *easy, obstacles, sixteen = teams = [rivals(team) for team in (*TUNED_ON, CIRCLE_16)]
    less = sorted(steps(team["cem, tuned"]) / steps(team["cem, paper"]) for team in easy)
    among = steps(obstacles["cem, tuned"]) / steps(obstacles["cem, paper"])
    tuned = config(sixteen["cem, tuned"][0])
    assert tuned["adapt_variance"]
    says(
        RESULTS,
        f"with its variance adapted and {tuned['elite_fraction']:.1%} elites it "
        f"needs {fraction(less[0])} to {fraction(less[-1])} of its preset's steps on the teams that it was tuned on, "
        f"and among obstacles {fraction(among)}",
        f"tuned, its ways are {longer(teams, 'cem, tuned', 'cem, paper')} longer, and "
        f"{longer(teams, 'cem, tuned', OURS)} longer than tuned D4orm's",
    )


def test_tuning_helps_neither_i_mbd_nor_mppi() -> None:
    sixteen = rivals(CIRCLE_16)
    (counts,) = {(solved(group), len(group)) for label, group in sixteen.items() if label.startswith("i-mbd")}
    teams = [rivals(team) for team in (*TUNED_ON, CIRCLE_16)]
    times = [steps(team["mppi, paper"]) / steps(team[OURS]) for team in teams]
    says(
        RESULTS,
        f"helps i-MBD nothing on the circle of 16**: {counts[0]} of {counts[1]} with either",
        f"MPPI was best with its preset, which needs {min(times):.1f} to {max(times):.0f} times the steps of tuned",
    )


def test_credit_is_worth_more_than_tuning() -> None:
    *tuned_on, sixteen = teams = [rivals(team) for team in (*TUNED_ON, CIRCLE_16)]
    ours = [steps(team["d4orm, defaults"]) for team in tuned_on]
    more = [own - steps(team[OURS]) for own, team in zip(ours, tuned_on)]
    p = [p_steps(team["d4orm, defaults"], team[OURS]) for team in tuned_on]
    assert p_steps(sixteen["d4orm, defaults"], sixteen[OURS]) < 1e-9
    assert max(p[:2]) < 0.05 < p[2], "more on the circle and in random places, as few on the heterogeneous team"
    assert more[3] < 0
    sampled = {
        label: example("fewer_samples").samples_per_step(sixteen[label][0]) for label in ("d4orm, defaults", OURS)
    }
    says(
        RESULTS,
        f"our defaults, with {fraction(sampled['d4orm, defaults'] / sampled[OURS])} of the samples, need "
        f"{steps(sixteen['d4orm, defaults'])} steps on the circle of 16 (p < 10⁻⁹), and {min(ours)} to {max(ours)} "
        f"elsewhere, which is {min(more[:2])} to {max(more[:2])} more than tuned D4orm on two teams, as few on one and "
        f"fewer among obstacles (p = {p[3]:.1g})",
    )
    shortest = [sorted(team, key=lambda label: way(team[label])) for team in teams]
    assert shortest[3][:2] == ["mbd, tuned", "d4orm, defaults"]
    assert all(order[0] == "d4orm, defaults" for order in (*shortest[:3], shortest[4]))
    says(RESULTS, "Their ways are the shortest but for MBD's among obstacles.")


# Credit and update

CREDITS = ("team", "group", "robot", "in turn", "group, penalty 2")
BOTH_PAY = CREDITS[-1]
"""By groups, with contacts that cost both."""


def cells(team: Team) -> Groups:
    """Trials by update and credit, such as "cem, in turn"."""
    return by_label("credit_by_update", **team)


def test_d4orm_by_groups_with_contacts_that_cost_both_solves_all() -> None:
    teams = [cells(team) for team in (CIRCLE_8, CIRCLE_16, RANDOM, HETEROGENEOUS)]
    assert all(solved(team[f"d4orm, {BOTH_PAY}"]) == len(team[f"d4orm, {BOTH_PAY}"]) for team in teams)
    both, groups, common = (teams[1][f"d4orm, {credit}"] for credit in (BOTH_PAY, "group", "team"))
    assert max(p_steps(both, groups), p_steps(both, common), p_solved(both, common)) < 1e-4
    says(
        RESULTS,
        f"**{len(seeds(common))} seeds**; steps are means, a trial without a solution counting "
        f"{max(map(penalised_steps, common)):,}. The table tests updates",
        f"solves all {sum(len(team[f'd4orm, {BOTH_PAY}']) for team in teams)} teams: the circle of 16 in {steps(both)} "
        f"steps, with {steps(groups)} by groups alone and {steps(common)} by the team's reward "
        f"({solved(common)} of {len(common)}; p < 0.0001)",
    )


def test_rivals_at_their_best_take_more_on_the_circle_of_16() -> None:
    circle = cells(CIRCLE_16)
    ours = circle[f"d4orm, {BOTH_PAY}"]
    i_mbd, *others = (
        min((circle[f"{update}, {credit}"] for credit in CREDITS), key=steps)
        for update in ("i-mbd", "mppi", "cem", "mbd")
    )
    assert all(p_steps(other, ours) < 1e-4 for other in others)
    mppi, cem, mbd = map(steps, others)
    says(
        RESULTS,
        f"every rival at its own best takes more: i-MBD {steps(i_mbd)} (p = {p_steps(i_mbd, ours):.1g}), MPPI {mppi}, "
        f"CEM {cem}, MBD {mbd:,} (p < 0.0001 each)",
    )


def test_the_papers_credit_is_the_best_on_the_heterogeneous_team() -> None:
    team = cells(HETEROGENEOUS)
    for update in ("d4orm", "i-mbd", "cem"):
        assert min(CREDITS, key=lambda credit: steps(team[f"{update}, {credit}"])) == "team"
    common, groups, robots, turns, both = (team[f"d4orm, {credit}"] for credit in CREDITS)
    dear, cheap = (by_label("contact_penalty", **HETEROGENEOUS)[label] for label in ("robot, 2", "robot, 1"))
    mppi, mppi_both = team["mppi, team"], team[f"mppi, {BOTH_PAY}"]
    says(
        RESULTS,
        f"**On the heterogeneous team the paper's credit is the best** for D4orm, i-MBD and CEM: {steps(common)} steps "
        f"by the team's reward (i-MBD {steps(team['i-mbd, team'])}, CEM {steps(team['cem, team'])}; but MPPI takes "
        f"{steps(mppi)}, and {steps(mppi_both)} by groups with contacts that cost both, "
        f"p = {np.format_float_positional(p_steps(mppi_both, mppi), precision=1, fractional=False)}); "
        f"{steps(both)} by groups with contacts that cost both "
        f"(p = {p_steps(both, common):.1g}), {steps(turns)} in turn, {steps(groups)} by groups and {steps(robots)} by "
        f"robots, who leave {len(robots) - solved(robots)} of {len(robots)} unsolved",
        f"robots' own reward solves {solved(dear)} of {len(dear)} heterogeneous teams of {dear[0].num_robots} instead "
        f"of {solved(cheap)}",
    )


def test_rivals_gain_by_groups_with_contacts_that_cost_both() -> None:
    (mbd, mbd_alone), (i_mbd, i_mbd_alone), (cem, cem_alone), (mppi, mppi_alone) = (
        [cells(CIRCLE_16)[f"{update}, {credit}"] for credit in (BOTH_PAY, "group")]
        for update in ("mbd", "i-mbd", "cem", "mppi")
    )
    (mixed_mbd, mixed_mbd_alone), (mixed_cem, mixed_cem_alone) = (
        [cells(HETEROGENEOUS)[f"{update}, {credit}"] for credit in (BOTH_PAY, "group")] for update in ("mbd", "cem")
    )
    assert solved(mbd) == solved(mixed_mbd)
    assert p_steps(i_mbd, i_mbd_alone) < 1e-4
    assert max(p_steps(cem, cem_alone), p_steps(mixed_cem, mixed_cem_alone)) < 0.01
    says(
        RESULTS,
        f"by groups MBD solves {solved(mbd)} of {len(mbd)} instead of {solved(mbd_alone)} on the circle and "
        f"{solved(mixed_mbd_alone)} on the heterogeneous team, i-MBD {solved(i_mbd)} instead of {solved(i_mbd_alone)} "
        f"on the circle, in {steps(i_mbd)} steps instead of {steps(i_mbd_alone):,} (p < 0.0001), and CEM takes "
        f"{steps(cem)} steps instead of {steps(cem_alone):,} and {steps(mixed_cem)} instead of "
        f"{steps(mixed_cem_alone)} (p < 0.01). MPPI on the circle does not ({steps(mppi)} and {steps(mppi_alone)}, "
        f"p = {p_steps(mppi, mppi_alone):.1g})",
    )


def test_i_mbd_is_as_good_as_d4orm_with_that_credit() -> None:
    pairs = [
        [cells(team)[f"{update}, {BOTH_PAY}"] for update in ("i-mbd", "d4orm")]
        for team in (CIRCLE_8, RANDOM, CIRCLE_16, HETEROGENEOUS)
    ]
    assert all(steps(rival) == steps(ours) for rival, ours in pairs[:2])
    assert all(p_solved(rival, ours) > 0.1 and steps(rival) < 1.5 * steps(ours) for rival, ours in pairs[2:])
    says(RESULTS, "as good as D4orm on the circle of 8 and in random places, and nearly so on the other two")


def test_credit_decides_on_the_circle_of_16() -> None:
    circle = cells(CIRCLE_16)
    number = {label: solved(group) for label, group in circle.items()}
    total = len(circle["mppi, team"])
    assert number["mppi, group"] == number[f"mbd, {BOTH_PAY}"] == number[f"d4orm, {BOTH_PAY}"] == total
    says(
        RESULTS,
        f"MPPI solves {number['mppi, team']} of {total} by the team's reward and all by groups, MBD "
        f"{number['mbd, team']} and {number['mbd, group']}, D4orm {number['d4orm, team']} and "
        f"{number['d4orm, group']}, and all where contacts cost both; but CEM {number['cem, team']} and "
        f"{number['cem, group']}",
    )


def test_cem_is_best_by_the_teams_reward() -> None:
    circle, random, mixed = cells(CIRCLE_16), cells(RANDOM), cells(HETEROGENEOUS)
    for team in (circle, cells(CIRCLE_8), mixed):
        order = sorted(CREDITS, key=lambda credit: steps(team[f"cem, {credit}"]))
        assert {*order[:2]} == {"team", "in turn"}
    common, groups, _, _, both = (random[f"cem, {credit}"] for credit in CREDITS)
    assert max(p_steps(groups, common), p_steps(both, common)) < 1e-8
    says(
        RESULTS,
        f"by groups it solves {solved(circle['cem, group'])} of {len(circle['cem, group'])} circles of 16, with "
        f"contacts that cost both {solved(circle[f'cem, {BOTH_PAY}'])}, and by robots {solved(circle['cem, robot'])}, "
        f"and {solved(mixed['cem, robot'])} of {len(mixed['cem, robot'])} heterogeneous teams",
        f"in random places groups need {fraction(steps(groups) / steps(common))} of its steps ({steps(groups)}, with "
        f"contacts that cost both {steps(both)}, for {steps(common)}, p < 10⁻⁸)",
    )


def test_cem_and_d4orm_by_the_teams_reward() -> None:
    (cem, ours), random, mixed = (
        (cells(team)["cem, team"], cells(team)["d4orm, team"]) for team in (CIRCLE_16, RANDOM, HETEROGENEOUS)
    )
    assert max(p_steps(*random), p_steps(*mixed)) < 1e-4
    says(
        RESULTS,
        f"({solved(cem)} of {len(cem)} in {steps(cem)} steps against {solved(ours)} in {steps(ours)}, "
        f"p = {p_steps(cem, ours):.1g}), and loses to it with random places and heterogeneous teams "
        f"({steps(random[0])} and {steps(mixed[0])} steps against {steps(random[1])} and {steps(mixed[1])}, "
        "p < 0.0001)",
    )


# One difference at a time


def differences() -> list[Groups]:
    """Trials on the circle and among obstacles, by settings."""
    return [by_label("paper_differences", **team) for team in (CIRCLE_16, OBSTACLES)]


def test_differences_are_measured_by_seeds_that_chose_nothing() -> None:
    study = trials("paper_differences")
    (budget,) = {(config(trial)["max_iterations"], config(trial)["num_steps"]) for trial in study}
    says(
        RESULTS,
        f"**{len(seeds(study))} seeds** from {seeds(study)[0]} on, by which nothing was chosen, at most {budget[0]} "
        f"iterations of {budget[1]} steps. Steps are means, a trial without a solution counting "
        f"{max(map(penalised_steps, study)):,}; p is against the first row",
    )


def test_credit_makes_the_difference() -> None:
    circle, obstacles = differences()
    preset, groups = circle["preset paper"], circle["preset, by groups with contacts that cost both"]
    assert p_steps(groups, preset) < 1e-8
    assert not any(solved(team["defaults, by the team's reward"]) for team in (circle, obstacles))
    says(
        RESULTS,
        f"the preset solves the circle of 16 in {steps(groups)} steps instead of {steps(preset):,} "
        f"({solved(groups)} of {len(groups)} instead of {solved(preset)}, p < 10⁻⁸), and the defaults solve neither "
        "team by the team's reward",
    )


def test_clipping_is_good_among_obstacles_and_bad_on_the_circle() -> None:
    circle, obstacles = differences()
    preset, clipped = "preset paper", "preset, clipped between iterations"
    defaults, unclipped = "defaults", "defaults, not clipped between iterations"
    credit = obstacles["preset, by groups with contacts that cost both"]
    assert p_solved(circle[clipped], circle[preset]) < 1e-6
    assert p_steps(circle[unclipped], circle[defaults]) > 0.1
    total = len(circle[preset])
    says(
        RESULTS,
        f"the preset solves {solved(circle[clipped])} of {total} clipped and {solved(circle[preset])} as it is "
        f"(p < 10⁻⁶); among obstacles {solved(obstacles[clipped])} and {solved(obstacles[preset])} "
        f"(p = {p_solved(obstacles[clipped], obstacles[preset]):.1g})",
        f"does little for the preset among obstacles ({solved(credit)} of {total}, "
        f"p = {p_solved(credit, obstacles[preset]):.1g}); the defaults do not solve "
        f"{total - solved(obstacles[unclipped])} of {total} there without clipping, and on the circle it makes no",
    )


def test_starting_from_zero_is_better_on_the_circle() -> None:
    teams = differences()
    zero, drawn = teams[0]["preset paper"], teams[0]["preset, random start"]
    less = percents(
        1 - way(team[first]) / way(team[second])
        for team in teams
        for first, second in (("preset paper", "preset, random start"), ("defaults", "defaults, random start"))
    )
    says(
        RESULTS,
        f"is better than the draw of Algorithm 1 on the circle: {solved(zero)} of {len(zero)} and {solved(drawn)} "
        f"(p = {p_solved(zero, drawn):.1g}), and ways are {less} shorter with either",
    )


def test_samples_are_worth_more_to_the_preset() -> None:
    circle, obstacles = differences()
    preset, few = circle["preset paper"], circle["preset, 256 samples"]
    defaults, many = "defaults", "defaults, 1024 samples throughout"
    per_step = example("fewer_samples").samples_per_step
    times = per_step(circle[many][0]) / per_step(circle[defaults][0])
    says(
        RESULTS,
        f"**{fraction(per_step(few[0]) / per_step(preset[0])).capitalize()} of the samples** costs the preset much on "
        f"the circle ({solved(few)} of {len(few)}, p = {p_solved(few, preset):.1g})",
        f"throughout, {WORDS[round(times)]} times as many as 256 and fewer later, the defaults take "
        f"{steps(circle[many])} steps for {steps(circle[defaults])} on the circle "
        f"(p = {p_steps(circle[many], circle[defaults]):.2g}) and as many among obstacles ({steps(obstacles[many])} "
        f"and {steps(obstacles[defaults])}, p = {p_steps(obstacles[many], obstacles[defaults]):.2g}), for ways "
        f"{shorter((circle, obstacles), many, defaults)} shorter",
    )


def test_small_weights_may_be_dropped() -> None:
    for team in differences():
        for first, second in (
            ("preset paper", "preset, small weights dropped"),
            ("defaults", "defaults, all weights kept"),
        ):
            assert min(p_steps(team[first], team[second]), p_solved(team[first], team[second])) > 0.1
    says(RESULTS, "**Small weights** may be dropped: no row differs (p > 0.1)")


# What a contact costs


def priced(team: Team) -> Groups:
    """Trials by credit and price, such as "robot, 2"."""
    return by_label("contact_penalty", **team)


def test_price_is_measured_by_seeds_that_chose_nothing() -> None:
    study = trials("contact_penalty")
    (budget,) = {(config(trial)["max_iterations"], config(trial)["num_steps"]) for trial in study}
    (robots,) = {trial.num_robots for trial in study}
    teams = {(trial.scenario, trial.model) for trial in study}
    says(
        RESULTS,
        f"on {WORDS[len(teams)]} teams of {robots}, at most {budget[0]} iterations of {budget[1]} steps: "
        f"**{len(seeds(study))} seeds** from {seeds(study)[0]} on",
        f"a trial without a solution counting {max(map(penalised_steps, study)):,}; p is against the defaults",
    )


def test_credits_solve_nearly_all_with_a_contact_at_what_it_costs_both() -> None:
    *_, mixed, obstacles = teams = [*map(priced, (INTEGRATORS, DRIVES, HETEROGENEOUS, OBSTACLES))]
    assert all(
        solved(team[f"{credit}, 2"]) >= 0.94 * len(team[f"{credit}, 2"])
        for team in teams
        for credit in ("robot", "group", "alternate")
    )
    own, cheap = mixed["robot, 2"], mixed["robot, 1"]
    (groups,) = {solved(team["group, 2"]) for team in (mixed, obstacles)}
    says(
        RESULTS,
        f"16 heterogeneous robots are solved by their own reward in {solved(own)} of {len(own)} trials instead of "
        f"{solved(cheap)}, in {steps(own)} steps; among four obstacles in {solved(obstacles['robot, 2'])} instead of "
        f"{WORDS[solved(obstacles['robot, 1'])]}; and by groups, the default, in {groups} of {len(own)} instead of "
        f"{solved(mixed['group, 1'])} and {solved(obstacles['group, 1'])}",
    )


def test_groups_or_robots_make_a_difference_among_obstacles_only() -> None:
    *others, obstacles = map(priced, (INTEGRATORS, DRIVES, HETEROGENEOUS, OBSTACLES))
    assert all(p_steps(team["robot, 2"], team["group, 2"]) > 0.1 for team in others)
    groups, robots = obstacles["group, 2"], obstacles["robot, 2"]
    says(RESULTS, f"({steps(groups)} and {steps(robots)} steps, p = {p_steps(groups, robots):.1g})")


def test_little_was_to_be_gained_on_circles_of_one_model() -> None:
    circle, drives = priced(INTEGRATORS), priced(DRIVES)
    default, robots = drives["group, 2"], drives["robot, 1"]
    assert p_steps(circle["group, 2"], circle["group, 1"]) < 1e-4
    says(
        RESULTS,
        f"{steps(circle['group, 2'])} steps for {steps(circle['group, 1'])} by groups of double integrators "
        f"(p < 0.0001), and none for drives ({steps(default)} and {steps(drives['group, 1'])}, "
        f"p = {p_steps(drives['group, 1'], default):.2g}), of which robots' own reward with 1 is a little better "
        f"({steps(robots)}, p = {p_steps(robots, default):.2g})",
    )


def test_ways_with_dear_contacts_are_longer() -> None:
    circles, others = (
        longer(map(priced, teams), "group, 2", "group, 1")
        for teams in ((INTEGRATORS, DRIVES), (HETEROGENEOUS, OBSTACLES))
    )
    says(RESULTS, f"first plans are {circles} longer on those circles, and {others} elsewhere than those by groups")


def test_a_price_of_three_is_better_among_obstacles_and_worse_for_drives() -> None:
    obstacles, drives = priced(OBSTACLES), priced(DRIVES)
    assert p_steps(obstacles["group, 3"], obstacles["group, 2"]) < 1e-4
    says(
        RESULTS,
        f"is better among obstacles ({steps(obstacles['group, 3'])} steps, p < 0.0001), and worse for drives "
        f"({steps(drives['group, 3'])}, p = {p_steps(drives['group, 3'], drives['group, 2']):.1g})",
    )


def test_the_teams_reward_solves_none_with_the_samples_of_the_defaults() -> None:
    teams = [priced(team)["team, 1"] for team in (INTEGRATORS, DRIVES, HETEROGENEOUS, OBSTACLES)]
    assert not any(map(solved, teams))
    (own,) = {config(trial)["num_samples"] for trial in trials("contact_penalty")}
    common = cells(CIRCLE_16)["d4orm, team"]
    assert 0 < solved(common) < len(common)
    says(
        RESULTS,
        f"solves none of the {WORDS[len(teams)]} with the {own} samples of the defaults; with the paper's "
        f"{config(common[0])['num_samples']} it solves some",
    )


# The README


def test_teams_of_the_readme_are_always_solved() -> None:
    shown = [
        row for name, teams in example("solve_rates").README.items() for row in measured("solve_rates")
        if row["set"] == name and row["team"] in teams
    ]  # fmt: skip
    assert all(row["solved"] for row in shown)
    (cores,) = {json.loads(row["machine"])["cores"] for row in shown}
    (processor,) = {json.loads(row["machine"])["processor"] for row in shown}
    drawn = sorted({row["seed"] for row in shown})
    says(
        README,
        f"seeds {drawn[0]} to {drawn[-1]}, every plan verified",
        f"solve_rates.py --seeds {len(drawn)}` on {WORDS[cores]} virtual cores of an {processor}",
        "Chosen are teams that are always solved.",
    )


def left(policy: str, **team: object) -> str:
    """How many undisturbed trials of the leaderboard fail, such as "2 of 20"."""
    groups = by_label("leaderboard", policy=policy, control_noise_std=0.0, **team).values()
    return f"{sum(not trial.success for group in groups for trial in group)} of {sum(map(len, groups))}"


def test_readme_tells_which_teams_are_left_unsolved() -> None:
    walls = [
        trial
        for scenario in ("rooms", "warehouse", "doorway")
        for trial in by_label("leaderboard", policy="d4orm", scenario=scenario, model="car")["d4orm"]
    ]
    crowd = [
        row for row in measured("solve_rates")
        if (row["team"], row["planner"]) == ("random with 4 obstacles, 16", "d4orm-d")
    ]  # fmt: skip
    slowest = max(row["seconds"] for row in measured("solve_rates") if row["team"] == "map of 32 x 32 cells, 80")
    random: Team = {"scenario": "random", "model": "holonomic2d"}
    says(
        README,
        f"`d4orm` by itself leaves {left('d4orm', num_robots=8, **random)} random teams of 8 and "
        f"{left('d4orm', num_robots=16, **random)} of 16, and {sum(not trial.success for trial in walls)} of "
        f"{len(walls)} teams of cars among walls; D4orm-D {sum(not row['solved'] for row in crowd)} of {len(crowd)} "
        f"with 16 robots among four obstacles on random places, and takes up to {slowest:.0f} s for 80 on a map; "
        f"D4orm-C2F leaves {left('d4orm-c2f', num_robots=16, **random)} with 16 random robots",
    )
