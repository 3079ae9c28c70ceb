"""Numbers in the docs' prose on policies, disturbances, learning, planners and speed, computed from ``data/``."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from typing import Any, NamedTuple, TypeVar

import numpy as np
import pytest
from claims_support import ROOT, WORDS, listed, says, span, trials
from scipy import stats

from d4orm_planners.evaluation.comparison import in_common, is_solved, mcnemar
from d4orm_planners.evaluation.store import Trial
from d4orm_planners.evaluation.summary import wilson_interval
from d4orm_planners.sampling.schedule import alpha_bar

ROBUSTNESS, LEADERBOARD, MUJOCO, RECIPES = (
    f"docs/{page}.md" for page in ("robustness", "leaderboard", "mujoco", "recipes")
)
RL, DISTURBANCES, PERFORMANCE = "docs/rl.md", "docs/disturbances.md", "docs/performance.md"
DISTRIBUTED = "docs/distributed.md"
PLANNERS, D4ORM, D4ORM_D, D4ORM_C2F, MMD = (
    f"docs/planners/{page}.md" for page in ("index", "d4orm", "d4orm-d", "d4orm-c2f", "mmd")
)
OPEN = ("circle", "random")
NOTHING = "nothing"
PUCKS, WHEELS = "holonomic2d", "differential_drive"
ALL = "all of them"
PPO, DRIVES = "PPO, holonomic2d, crowds", "PPO, differential_drive, crowds"
INDOORS, SAC = "PPO, holonomic2d, walls", "SAC, holonomic2d, crowds"

parquet = pytest.importorskip("pyarrow.parquet")

Row = Mapping[str, Any]
Item = TypeVar("Item")
Key = TypeVar("Key")


@cache
def rows(name: str) -> tuple[Row, ...]:
    """Rows of a file in ``data/`` that is not of trials."""
    path = ROOT / "data" / name
    if path.suffix == ".csv":
        with path.open(newline="") as file:
            return tuple(csv.DictReader(file))
    return tuple(parquet.read_table(path).to_pylist())


@cache
def bench(name: str = "bench") -> dict[str, Any]:
    """What a benchmark wrote."""
    found: dict[str, Any] = json.loads((ROOT / "data" / f"{name}.json").read_text())
    return found


def grouped(items: Iterable[Item], key: Callable[[Item], Key]) -> dict[Key, list[Item]]:
    """Items by what a key says of them."""
    groups: dict[Key, list[Item]] = {}
    for item in items:
        groups.setdefault(key(item), []).append(item)
    return groups


def wins(some: Iterable[Trial]) -> int:
    """Trials that succeeded."""
    return sum(trial.success for trial in some)


def contacts(some: Iterable[Trial]) -> int:
    """Trials in which anybody touched anything."""
    return sum(trial.collided > 0 for trial in some)


def travel_time(trial: Trial) -> float:
    """Of the robots, on average [s]."""
    assert trial.travel_time is not None
    return trial.travel_time


def mean(some: Iterable[Row], name: str) -> float:
    """Of a column."""
    return float(np.mean([float(row[name]) for row in some]))


def trouble(trial: Trial) -> str:
    """What went wrong in a trial of the study of disturbances: a kind, a body in MuJoCo, or nothing."""
    if trial.physics == "mujoco":
        return trial.model
    return str(json.loads(trial.disturbances)[0][0]) if trial.disturbances != "[]" else NOTHING


@cache
def cells(policy: str) -> dict[tuple[str, str], list[Trial]]:
    """A policy's trials in the study of disturbances, by scenario and what went wrong."""
    own = (trial for trial in trials("disturbance_study") if trial.label == policy)
    return grouped(own, lambda trial: (trial.scenario, trouble(trial)))


class Effect(NamedTuple):
    """What leaving out a measure does: pairs of trials without it and with it."""

    pairs: list[tuple[Trial, Trial]]

    @property
    def without(self) -> int:
        """Successes without it."""
        return wins(one for one, _ in self.pairs)

    @property
    def kept(self) -> int:
        """Those with it."""
        return wins(other for _, other in self.pairs)

    @property
    def success_p(self) -> float:
        """That these differ by chance."""
        won = [(one.success, other.success) for one, other in self.pairs]
        return mcnemar(won.count((True, False)), won.count((False, True)))

    @property
    def differences(self) -> list[float]:
        """How much longer robots travel without it, where both succeed [s]."""
        return [travel_time(one) - travel_time(other) for one, other in self.pairs if one.success and other.success]

    @property
    def longer(self) -> float:
        """Their mean [s]."""
        return float(np.mean(self.differences))

    @property
    def longer_p(self) -> float:
        """That they are by chance."""
        return float(stats.wilcoxon([one for one in self.differences if one]).pvalue)


@cache
def effects() -> dict[tuple[str, str, str], Effect]:
    """Of the study of D4orm-C2F's measures, by scenario, what went wrong and what was left out."""
    groups = grouped(trials("ablation"), lambda trial: (trial.scenario, trouble(trial), trial.label))
    return {
        (scenario, what, label): Effect(in_common(without, groups[scenario, what, "d4orm-c2f"]))
        for (scenario, what, label), without in groups.items()
        if label != "d4orm-c2f"
    }


# Robustness


def test_study_has_fifty_new_seeds_of_one_commit() -> None:
    study = trials("disturbance_study")
    seeds = {trial.seed for trial in study}
    (commit,) = {json.loads(trial.versions)["commit"][:7] for trial in study}
    (day,) = {trial.date[:10] for trial in study}
    assert {(trial.num_robots, trial.error) for trial in study} == {(8, "")}
    assert all(
        {trial.seed for trial in cell} == seeds
        for label in {trial.label for trial in study}
        for cell in cells(label).values()
    )
    says(
        ROBUSTNESS,
        f"Eight robots, each disturbance by itself, {len(seeds)} seeds",
        f"Seeds {min(seeds)} to {max(seeds)}, which",
        f"all trials are of commit {commit}, {day}",
        f"the interval of 50 of 50 begins at {wilson_interval(50, 50)[0]:.0%}",
    )


def test_controller_does_what_it_is_to_do_in_all_cells_but_one() -> None:
    found = cells("d4orm-c2f")
    missed = [key for key, cell in found.items() if wins(cell) < 0.95 * len(cell) or contacts(cell) > 0.02 * len(cell)]
    assert missed == [("circle", "stall")]
    going = [trial for (_, what), cell in found.items() if what != "stall" for trial in cell]
    says(
        ROBUSTNESS,
        f"**It does so in {len(found) - len(missed)} of {len(found)} cells**",
        "in all but that in which a robot stalls on the circle.",
        f"Of {len(going):,} trials without a stalled robot it fails in {len(going) - wins(going)}, "
        f"with contact in {WORDS[contacts(going)]}.",
    )


def test_stalled_robots_in_the_way_are_most_failures() -> None:
    circle, random = ([trial for trial in cells("d4orm-c2f")[place, "stall"] if not trial.success] for place in OPEN)
    blocked = [sorted(trial.seed for trial in failed if not trial.collided) for failed in (circle, random)]
    says(
        ROBUSTNESS,
        f"it fails in {WORDS[len(circle)]} trials on the circle and in {WORDS[len(random)]} on random places.",
        f"In {WORDS[len(blocked[0])]} of the {WORDS[len(circle)]} (seeds {', '.join(map(str, blocked[0]))}) "
        f"and in {WORDS[len(blocked[1])]} of the {WORDS[len(random)]} ({blocked[1][0]}) the robot stalls on the place",
        f"Of the others {50 - len(circle)} of {50 - len(blocked[0])} and {50 - len(random)} of {50 - len(blocked[1])} "
        f"succeed, with contact in the {WORDS[contacts(circle + random)]} that fail.",
    )


def test_controller_was_not_fitted_to_its_seeds() -> None:
    before = ((1693, 1700), (140, 150))  # successes and trials of seeds 0 to 49, which data/ had at an earlier commit
    stalled = [trial for (_, what), cell in cells("d4orm-c2f").items() if what == "stall" for trial in cell]
    going = [trial for (_, what), cell in cells("d4orm-c2f").items() if what != "stall" for trial in cell]
    p = [
        stats.fisher_exact([[then, of - then], [wins(now), len(now) - wins(now)]]).pvalue
        for (then, of), now in zip(before, (going, stalled), strict=True)
    ]
    assert [len(going), len(stalled)] == [of for _, of in before]
    says(
        ROBUSTNESS,
        "it had succeeded in {:,} of the {:,} without a stalled robot and in {} of {} with".format(
            *before[0], *before[1]
        ),
        f"here in {wins(going):,} and {wins(stalled)} (p = {p[0]:.1g} and {p[1]:.1g}, Fisher)",
    )


def test_ppo_keeps_up_where_it_was_trained() -> None:
    found = {key: wins(cell) for key, cell in cells("ppo").items()}
    bodies = (PUCKS, WHEELS)
    assert {count for (place, what), count in found.items() if place == "circle" and what != "stall"} == {50}
    assert all(found[place, body] >= found[place, NOTHING] for place in OPEN for body in bodies)
    random = [count for (place, what), count in found.items() if place == "random" and what != "delay"]
    says(
        ROBUSTNESS,
        f"under everything (50 of 50, {found['circle', 'stall']} where one robot stalls), and on random places in "
        f"{span(random)}, but in {found['random', 'delay']} with late commands",
        "In MuJoCo, which it never saw, it does as well.",
    )


def test_ppo_and_orca_in_rooms() -> None:
    ppo, orca = (
        {what: wins(cell) for (place, what), cell in cells(policy).items() if place == "rooms"}
        for policy in ("ppo", "orca")
    )
    most = [what for what in ppo if what not in (NOTHING, "delay")]
    first = [trial.violation.partition(" contact")[0] for trial in cells("ppo")["rooms", "delay"] if trial.collided]
    assert len(first) == 50 - ppo["delay"]
    walls = first.count("obstacle") + first.count("bounds")
    says(
        ROBUSTNESS,
        f"it brings {ppo[NOTHING]} of 50 teams home undisturbed and {span(ppo[what] for what in most)} under most",
        f"end in contact ({ppo['delay']} succeed; in the other {len(first)} it is with a wall in {walls}, and "
        f"with a robot in {first.count('robot')}, that they touch first)",
        f"brings home {orca[NOTHING]} of 50 in rooms undisturbed, {span(orca[what] for what in most)} under most "
        f"disturbances, {orca['delay']} with late commands.",
    )


def test_ppo_does_the_same_where_nothing_is_drawn() -> None:
    alike = {
        what for (place, what), cell in cells("ppo").items() if place == "circle" and len({t.reward for t in cell}) == 1
    }
    assert alike == {NOTHING, "delay", "limit_mismatch", PUCKS, WHEELS}
    says(
        ROBUSTNESS, "(the circle undisturbed, with a delay, with weaker limits, in MuJoCo) its 50 trials are one trial"
    )


def test_plans_stand_what_moves_no_robot() -> None:
    found = cells("d4orm-d")
    moving = ("control_noise", "correlated_noise", "bias", "dropout", "push", "limit_mismatch")
    assert all(wins(cell) == len(cell) for (_, what), cell in found.items() if what in ("delay", "state_noise"))
    assert all(wins(cell) <= 0.06 * len(cell) for (_, what), cell in found.items() if what in moving)
    says(ROBUSTNESS, "stand delays and noisy measurements, which they do not look at, and hardly anything that moves")


def test_late_commands_cost_orca_most_of_its_successes() -> None:
    found = {key: wins(cell) for key, cell in cells("orca").items()}
    circle, random = (1 - found[place, "delay"] / found[place, NOTHING] for place in OPEN)
    assert circle > 0.95
    assert random == 0.75
    says(ROBUSTNESS, "commands that come two steps late cost ORCA nearly all of its successes or three quarters.")


def test_noise_alone_has_fifty_seeds() -> None:
    groups = grouped(trials("robustness"), lambda t: (t.label, t.scenario, t.model, t.num_robots, t.control_noise_std))
    (seeds,) = {len(group) for group in groups.values()}
    says(ROBUSTNESS, f"by `d4orm reproduce robustness`, {seeds} seeds, from `data/robustness.parquet`")


# Robustness: what each measure does


def test_measures_are_tested_on_the_first_seeds() -> None:
    seeds = {trial.seed for trial in trials("ablation")}
    assert min(seeds) == min(trial.seed for trial in trials("disturbance_study"))
    says(
        ROBUSTNESS,
        f"on the same **{len(seeds)} seeds**, the first of the study above",
        f"the {2 * len(effects())} tests, {len(effects())} of successes and {len(effects())} of travel times.",
    )


def test_it_is_walls_that_measures_are_for() -> None:
    rooms = {what: effect for (place, what, label), effect in effects().items() if (place, label) == ("rooms", ALL)}
    late, noisy, lost = rooms["delay"], rooms["state_noise"], rooms["dropout"]
    outside = [one.without for (place, _, label), one in effects().items() if place in OPEN and label == ALL]
    assert {rooms[what].kept for what in ("delay", "dropout", "limit_mismatch", "push")} == {20}
    says(
        ROBUSTNESS,
        f"{late.without} teams of 20 in rooms survive commands that come two steps late (p = {late.success_p:.1g}), "
        f"{noisy.without} noisy states (p = {noisy.success_p:.1g}) and {lost.without} lost commands "
        f"(p = {lost.success_p:.1g}), {rooms['limit_mismatch'].without} weaker limits and "
        f"{rooms['push'].without} pushes; with them 20, but for noisy states, with which {noisy.kept}.",
        f"On the circle and on random places {span(outside)} do without.",
    )


def test_knowing_the_delay_is_worth_most() -> None:
    circle, random, rooms = (effects()[place, "delay", "delay"] for place in (*OPEN, "rooms"))
    others = [one.longer for (_, _, label), one in effects().items() if label not in ("delay", ALL)]
    assert all(abs(one.longer - 0.5) < 0.1 for one in (circle, random))
    assert rooms.longer > max(others)
    lost, lost_by_all = rooms.kept - rooms.without, 20 - effects()["rooms", "delay", ALL].without
    says(
        ROBUSTNESS,
        f"half a second in the open and {rooms.longer:.1f} s in rooms, where {lost} of 20 teams fail without "
        f"(p = {rooms.success_p:.1g}).",
        f"That rooms without it lose {lost} teams and not {lost_by_all} is",
    )


def test_no_other_measure_decides_by_itself() -> None:
    single = {label: one for (place, _, label), one in effects().items() if place == "rooms" and label != ALL}
    assert all(one.success_p > 0.05 for (_, _, label), one in effects().items() if label != ALL)
    lost, resort, limits, states = (
        single[name] for name in ("expect_losses", "last_resort", "learn_limits", "filter_states")
    )
    stalls = [effects()[place, "stall", "stalls"] for place in (*OPEN, "rooms")]
    assert limits.kept == limits.without
    assert min(one.success_p for one in stalls) > 0.99
    says(
        ROBUSTNESS,
        f"`expect_losses` saves {WORDS[lost.kept - lost.without]} of 20 teams in rooms (p = {lost.success_p:.1g}), "
        f"the last resort {WORDS[resort.kept - resort.without]} (p = {resort.success_p:.2g})",
        f"**Learning limits** saves {limits.longer:.1f} s in rooms, filtered states save {states.longer:.1f} s there, "
        f"and `stalls` {stalls[2].longer:.1f} s there (p = {stalls[2].longer_p:.1g}) and no significant "
        "number of teams: on the circle, on random places and in rooms "
        f"{listed(one.without for one in stalls)} succeed without it, {listed(one.kept for one in stalls)} with it "
        "(p = 1 each).",
    )


def test_caution_costs_time() -> None:
    cautious = [-effects()[place, what, ALL].longer for place in OPEN for what in ("limit_mismatch", "dropout")]
    circle, random, rooms = (-effects()[place, "push", "last_resort"].longer for place in (*OPEN, "rooms"))
    assert f"{circle:.1f}" == f"{random:.1f}"
    says(
        ROBUSTNESS,
        f"teams on open ground travel {span(cautious, '.1f')} s longer with all measures than without",
        f"with the last resort pushed teams {circle:.1f} s longer there and {rooms:.1f} s longer in rooms.",
    )


def test_undisturbed_nothing_but_driving_home_matters() -> None:
    def outcome(label: str) -> dict[tuple[str, int], tuple[object, ...]]:
        own = (trial for trial in trials("ablation") if trouble(trial) == NOTHING and trial.label == label)
        return {(t.scenario, t.seed): (t.success, t.travel_time, t.stretch, t.reward, t.mean_squared_jerk) for t in own}

    assert outcome("drive_home") == outcome(ALL)
    rooms, random = (effects()[place, NOTHING, "drive_home"].longer for place in ("rooms", "random"))
    says(ROBUSTNESS, f"which saves {rooms:.2f} s in rooms and {random:.2f} s on random places", "to the last digit.")


# MuJoCo


def test_controller_brings_all_bodies_home() -> None:
    controlled, planned = (
        [trial for (_, what), cell in cells(policy).items() if what in (PUCKS, WHEELS) for trial in cell]
        for policy in ("d4orm-c2f", "d4orm-d")
    )
    assert (wins(controlled), contacts(controlled)) == (len(controlled), 0)
    says(
        MUJOCO,
        f"D4orm-C2F brings home all {len(controlled)} teams, and nobody touches anything.",
        f"nearly always misses its goals ({wins(planned)} of {len(planned)} succeed)",
    )


def test_pucks_take_longer_than_double_integrators() -> None:
    longer = []
    for place in OPEN:
        points = {trial.seed: travel_time(trial) for trial in cells("d4orm-c2f")[place, NOTHING]}
        pucks = cells("d4orm-c2f")[place, PUCKS]
        longer.append(np.mean([travel_time(trial) - points[trial.seed] for trial in pucks]))
    says(MUJOCO, f"pucks take it {longer[0]:.2f} s longer on the circle and {longer[1]:.2f} s on random places than")


# Leaderboard


def on_leaderboard(label: str, **wanted: object) -> list[Trial]:
    """A policy's trials on the leaderboard with these attributes."""
    own = (trial for trial in trials("leaderboard") if trial.label == label)
    return [trial for trial in own if all(getattr(trial, name) == value for name, value in wanted.items())]


def test_leaderboard_has_twenty_seeds_of_two_models() -> None:
    groups = grouped(trials("leaderboard"), lambda t: (t.label, t.scenario, t.model, t.num_robots, t.control_noise_std))
    more, fewer = (
        {len(group) for key, group in groups.items() if (key[2] in (PUCKS, WHEELS)) == wanted}
        for wanted in (True, False)
    )
    walls = {key: group for key, group in groups.items() if key[1] not in OPEN}
    assert {(key[2], key[3], len(group)) for key, group in walls.items()} == {("car", 4, 10), ("unicycle", 4, 10)}
    assert len(more) == len(fewer) == 1
    says(
        LEADERBOARD, f"{more.pop()} seeds of `holonomic2d` and `differential_drive`, {fewer.pop()} of the other models"
    )


def test_leaderboard_says_how_its_trials_were_run() -> None:
    walls = [trial for trial in trials("leaderboard") if trial.scenario not in OPEN]
    (limit,) = {json.loads(trial.config)["time_limit"] for trial in walls}
    (seeds,) = {len(group) for group in grouped(walls, lambda t: (t.label, t.scenario, t.model)).values()}
    later = [t for t in on_leaderboard("d4orm-c2f:refine=sync") if t.model in ("car", "unicycle", "velocity2d")]
    assert {json.loads(trial.machine)["cores_used"] for trial in later} == {2}
    says(
        LEADERBOARD,
        f"(rooms, warehouse, doorway) have {seeds} seeds and at most {limit:g} s for planning.",
        "D4orm-C2F's on both cores.",
    )


def test_policies_that_draw_nothing_have_one_trial_on_the_circle() -> None:
    for label in ("ppo", "sac", "goal", "cloning", "DAgger", "PPO from DAgger"):
        circle = on_leaderboard(label, scenario="circle", control_noise_std=0.0)
        assert all(len({t.reward for t in own}) == 1 for own in grouped(circle, lambda t: t.problem).values())
    says(LEADERBOARD, "(`ppo`, `sac`, `goal`, `cloning` and its like) does the same in every trial there")


def test_d4orm_solves_crowds() -> None:
    crowds = on_leaderboard("d4orm", scenario="random", num_robots=16, control_noise_std=0.0)
    says(LEADERBOARD, f"{wins(crowds)} of {len(crowds)} teams of 16 in random places, undisturbed")


def test_controller_brings_first_order_robots_home() -> None:
    homes = [
        trial
        for model in ("car", "unicycle", "velocity2d")
        for trial in on_leaderboard("d4orm-c2f:refine=sync", model=model)
    ]
    assert contacts(homes) == 0
    assert 2 * sum(trial.control_noise_std > 0 for trial in homes) == len(homes)
    says(LEADERBOARD, f"in {wins(homes)} of {len(homes)} trials, half of them under noise, and nobody touches anything")


def test_planner_teaches() -> None:
    home = {
        (label, place, noise): wins(on_leaderboard(label, scenario=place, control_noise_std=noise))
        for label in ("cloning", "DAgger", "PPO from DAgger")
        for place in OPEN
        for noise in (0.0, 0.2)
    }
    assert home["PPO from DAgger", "circle", 0.0] == 20
    assert home["DAgger", "circle", 0.0] == 0
    says(
        LEADERBOARD,
        f"`cloning` has {home['cloning', 'random', 0.0]} of 20 random teams home, "
        f"`DAgger` {home['DAgger', 'random', 0.0]}, `PPO from DAgger` {home['PPO from DAgger', 'random', 0.0]}.",
        f"crosses undisturbed, and in {home['PPO from DAgger', 'circle', 0.2]} of 20 trials under noise "
        f"(`DAgger` does not, and in {home['DAgger', 'circle', 0.2]}).",
    )


def test_d4orm_fails_among_walls() -> None:
    walls = ("rooms", "warehouse", "doorway")
    failed = {
        (label, model): [t for t in on_leaderboard(label, model=model) if t.scenario in walls and not t.success]
        for label in ("d4orm", "d4orm-d")
        for model in ("car", "unicycle")
    }
    (only,) = failed["d4orm-d", "car"] + failed["d4orm-d", "unicycle"]
    says(
        LEADERBOARD,
        f"fails for cars in {len(failed['d4orm', 'car'])} of 30 and for unicycles in "
        f"{len(failed['d4orm', 'unicycle'])} of 30 trials, D4orm-D in one, in {only.scenario}.",
    )


# Reinforcement learning


def policy_rates(file: str, case: str, observed: int = 4) -> list[Row]:
    """Episodes of a policy file."""
    wanted = {"file": file, "case": case, "observed": observed}
    return [row for row in rows("policy_rates.parquet") if wanted.items() <= row.items()]


def seconds(file: str, case: str) -> float:
    """Mean travel time of a policy file's successes."""
    return float(np.mean([row["travel_time"] for row in policy_rates(file, case) if row["success"]]))


@cache
def curves(learner: str) -> list[list[Row]]:
    """Lessons of every seed's training."""
    own = (row for row in rows("training_curves.csv") if row["learner"] == learner)
    return list(grouped(own, lambda row: row["seed"]).values())


def success_at(learner: str, millions: float) -> list[float]:
    """Each seed's success after the lesson that ends next to so many million robot-steps."""
    nearest = [min(lessons, key=lambda row: abs(int(row["steps"]) - 1e6 * millions)) for lessons in curves(learner)]
    return [float(row["success"]) for row in nearest]


def test_imitation_is_continued_by_reinforcement() -> None:
    ways = grouped(rows("imitate_expert.parquet"), lambda row: row["way"])
    steps = min(row["steps"] for row in ways["PPO from there"])
    there, nothing = ([row for row in ways[f"PPO from {way}"] if row["steps"] == steps] for way in ("there", "nothing"))
    assert mean(ways["DAgger"], "imitation_error") > mean(ways["cloning"], "imitation_error")
    assert 0.4 < 1 - mean(ways["cloning"], "success") < 0.5
    assert round(8 * (mean(there, "travel_time") / mean(ways["cloning"], "travel_time") - 1)) == 1
    assert round(steps / 1e6, 1) == 0.1
    assert mean(nothing, "success") == 0
    says(
        RL,
        "The error does not fall.",
        "fails nearly half of the time; "
        f"what PPO makes of the best round fails in {1 - mean(there, 'success'):.0%} after a tenth of a million steps "
        "and takes an eighth longer, when PPO from nothing has not brought one team home",
    )


def test_observing_more_helps_in_dense_crowds() -> None:
    four, eight = (
        np.mean([row["success"] for row in policy_rates("ppo", "random, 16, 5 m", observed)]) for observed in (4, 8)
    )
    says(RL, f"with 16 robots on 5 m and four observed it solves {four:.0%}, with eight {eight:.0%}.")


def test_policies_come_as_small_files() -> None:
    files = list((ROOT / "d4orm_planners" / "rl" / "policies").glob("*.safetensors"))
    (size,) = {round(path.stat().st_size / 1000, -1) for path in files}
    ppo = [path for path in files if path.stem.startswith("ppo")]
    says(RL, f"`ppo` has {WORDS[len(ppo)]} files", f"{size:.0f} KB each")


def test_disturbed_ppo_does_about_as_well_in_the_open() -> None:
    found = {key: wins(cell) for key, cell in cells("ppo").items()}
    excepted = (("circle", "stall"), ("random", "delay"))
    assert all(
        found[place, what] >= found[place, NOTHING] - 1
        for place, what in found
        if place in OPEN and (place, what) not in excepted
    )
    noises = ("control_noise", "correlated_noise", "state_noise")
    costs = max(1 - found["rooms", what] / found["rooms", NOTHING] for what in noises)
    assert 0.2 < costs <= 0.25
    says(
        RL,
        "about as well as undisturbed, rigid bodies in MuJoCo included, but "
        f"where a robot stalls on the circle ({found['circle', 'stall']} of 50) or commands come late on random places "
        f"({found['random', 'delay']} of 50); in rooms noise costs it up to a quarter of its successes, and late "
        f"commands leave {found['rooms', 'delay']} of {found['rooms', NOTHING]}.",
    )


def test_trainings_took_minutes_to_hours() -> None:
    def training(trial: Trial) -> tuple[str, str, bool]:
        return trial.label, trial.model, trial.scenario == "rooms"

    took = {
        training(trial): trial.training_time
        for trial in (*trials("leaderboard"), *trials("disturbance_study"))
        if trial.label in ("ppo", "sac") and trial.training_time is not None
    }
    ground = took["ppo", PUCKS, False]
    best = max(curves(SAC)[0], key=lambda row: float(row["success"]))
    lesson = curves(SAC)[0].index(best) + 1
    says(
        RL,
        f"75 million robot-steps in {ground / 3600:.0f} hours up to the lesson that was kept",
        f"9 million robot-steps in another {(took['ppo', PUCKS, True] - ground) / 60:.0f} minutes",
        f"45 million robot-steps in {took['ppo', WHEELS, False] / 60:.0f} minutes",
        f"seed 0: lesson {lesson}, **{int(best['steps']) / 1e6:.2f} million robot-steps in "
        f"{took['sac', PUCKS, False] / 60:.0f} minutes**",
    )


def test_sac_is_quicker_at_crossings_and_fails_in_crowds() -> None:
    circle, obstacles = (
        [seconds(file, f"{case}, noise") for file in ("sac", "ppo")] for case in ("circle, 16", "four_obstacles, 8")
    )
    assert all(seconds("sac", f"{case}, 8, noise") > seconds("ppo", f"{case}, 8, noise") for case in ("circle", "swap"))
    crowds = {row["case"] for row in rows("policy_rates.parquet") if row["case"].startswith("random")} - {
        "random, 4 robots, 5 m"
    }
    assert all(
        sum(row["success"] for row in policy_rates("sac", case))
        < sum(row["success"] for row in policy_rates("ppo", case))
        for case in crowds
    )
    says(
        RL,
        "On the circle of 16 and among obstacles it is quicker than `ppo` "
        f"({circle[0]:.2f} and {circle[1]:.2f} s, {obstacles[0]:.2f} and {obstacles[1]:.2f}), "
        "on the circle of 8 and in swaps slower, and in random crowds it fails more often.",
    )


def test_seeds_of_ppo_differ_little() -> None:
    (seeds,) = {len(curves(learner)) for learner in (PPO, DRIVES, INDOORS, SAC)}
    crowds, walls = (
        max(100 * np.ptp([float(lessons[-1]["success"]) for lessons in curves(learner)]) for learner in learners)
        for learners in ((PPO, DRIVES), (INDOORS,))
    )
    shares = [float(row["env_share"]) for lessons in curves(INDOORS) for row in lessons]
    says(
        RL,
        f"How much of a training is luck: {WORDS[seeds]} seeds each",
        f"in the end by {crowds:.0f} points at most, in crowds of up to 32 robots, and by {walls:.0f} among walls.",
        f"stepping environments along ways, instances included, takes {np.mean(shares):.0%} of these trainings.",
    )


def test_curves_of_ppo_still_rise() -> None:
    rises = {
        learner: [float(lessons[-1]["success"]) - float(lessons[-2]["success"]) for lessons in curves(learner)]
        for learner in (PPO, DRIVES)
    }
    assert min(rises[PPO]) > 0
    assert np.mean(rises[DRIVES]) > 0
    assert {round(int(lessons[-1]["steps"]) / 1e6) for lessons in curves(PPO) + curves(DRIVES)} == {6}
    says(RL, "PPO's curves in crowds still rise, those of double integrators with every seed")


def test_sac_learns_crowds_sooner() -> None:
    def spent(learner: str, millions: float) -> float:
        within = [row for lessons in curves(learner) for row in lessons if int(row["steps"]) < 1.01e6 * millions]
        return sum(float(row["seconds"]) for row in within)

    later = {millions: np.mean(success_at(SAC, millions)) for millions in (0.6, 0.75, 1.5)}
    assert f"{later[0.75]:.0%}" == f"{later[1.5]:.0%}"
    assert 0.9 < spent(SAC, 0.6) / spent(PPO, 6) < 1.1
    assert np.mean([float(row["env_share"]) for lessons in curves(SAC) for row in lessons]) < 0.05
    ahead = success_at(SAC, 0.15)
    says(
        RL,
        f"{min(ahead):.0%} to {max(ahead):.0%} after 0.15 million steps, {later[0.6]:.0%} after 0.6 and "
        f"{later[0.75]:.0%} after 0.75 and in the end (means), where PPO has {np.mean(success_at(PPO, 6)):.0%} after 6 "
        "million. It takes as long for 0.6 million as PPO for 6, nearly all of it updates.",
    )


def test_sac_is_not_steady() -> None:
    successes = [[float(row["success"]) for row in lessons] for lessons in curves(SAC)]
    steady, *losses = sorted(100 * max(-np.diff(own)) for own in successes)
    assert steady < 5
    says(
        RL,
        f"two of three seeds lose {losses[0]:.0f} and {losses[1]:.0f} points from one lesson to the next",
        f"the best of each have {listed(f'{max(own):.0%}' for own in successes)}.",
    )


def test_learners_were_tuned_with_one_budget() -> None:
    rounds = grouped(rows("tune_learners.parquet"), lambda row: (row["learner"], row["round"]))
    ((tried,), (kept,)) = ({len(own) for (_, turn), own in rounds.items() if turn == number} for number in (1, 2))
    for learner, budget in (("ppo", 1e6), ("sac", 1.5e5)):
        for turn in (1, 2):
            assert all(abs(row["steps"] / (turn * budget) - 1) < 0.05 for row in rounds[learner, turn])
    says(
        RL,
        f"{WORDS[tried]} each in the same crowds, the learner's own and {WORDS[tried - 1]} drawn at random",
        f"for a million robot-steps (PPO) or 150,000 (SAC), and the best {WORDS[kept]} twice as long",
    )


def test_nothing_was_changed_for_tuning() -> None:
    longest = {
        learner: max(row["success"] for row in own if row["round"] == 2)
        for learner, own in grouped(rows("tune_learners.parquet"), lambda row: row["learner"]).items()
    }
    once, twice = ([success_at(PPO, factor), success_at(SAC, 0.15 * factor)] for factor in (1, 2))
    ppo, sac = (listed(f"{share:.0%}" for share in own) for own in once)
    says(
        RL,
        f"The settings as they are have {ppo} (PPO) and {sac} (SAC) after as many steps with the seeds above",
        f"after twice as many {span(twice[0], '.0%')} and {span(twice[1], '.0%')}, where the best of these have "
        f"{longest['ppo']:.0%} and {longest['sac']:.0%}.",
    )


def test_tuned_settings_differ_little_from_ours() -> None:
    tried = [(json.loads(row["settings"]), row) for row in rows("tune_learners.parquet")]
    few = [row for settings, row in tried if row["learner"] == "sac" and settings.get("gradient_steps") == 4]
    slow = [row for settings, row in tried if row["learner"] == "ppo" and settings.get("learning_rate", 1) < 5e-4]
    first, second = ([row["success"] for row in slow if row["round"] == turn] for turn in (1, 2))
    assert len(few) == 2
    assert max(row["success"] for row in few) < 0.01
    assert min(success_at(PPO, 1)) < min(first) <= max(first) < max(success_at(PPO, 1))
    assert max(second) < min(success_at(PPO, 2))
    says(
        RL,
        "neither setting learns anything in that time",
        f"**PPO with lower learning rates** than its 5e-4 has {span(first, '.0%')} after a first look, within what its "
        "own seeds have, and is not further after two million.",
    )


# Without AVX-512


def test_iterations_without_avx512_take_longer() -> None:
    def key(row: Row) -> tuple[object, ...]:
        return row["model"], row["num_robots"], row["engine"], row["rules"]

    quick = {key(row): row["iteration"]["median"] for row in bench()["denoising"]}
    times = [row["iteration"]["median"] / quick[key(row)] for row in bench("bench_znver3")["denoising"]]
    plans = grouped(bench("bench_znver3")["plans"], lambda row: row["rules"])
    ours, preset = (listed(f"{row['seconds']['median']:.2f}" for row in plans[rules]) for rules in ("default", "paper"))
    last = plans["paper"][-1]
    says(
        PERFORMANCE,
        f"an iteration takes {span(times, '.1f')} times as long as above. First plans take {ours} s with 4, 8, 12 and "
        f"16 robots in the median, and with the preset {preset} s ({last['solved']} of {last['seeds']} with 16)",
    )


# Robots on a network


def test_the_run_of_robots_that_plan_while_they_drive() -> None:
    (run,) = rows("onboard_lifelong.csv")
    assert run["robot-steps in contact"] == run["ticks with different plans"] == "0"
    wall, simulated = float(run["wall clock [s]"]), float(run["simulated [s]"])
    says(
        DISTRIBUTED,
        f"{run['goals reached']} goals reached ({float(run['goals per robot-minute']):.1f} per robot-minute), no "
        f"contact, {run['plans taken over']} of {run['rounds ended']} rounds ended with a plan that all took over; "
        f"{run['messages']} messages, {float(run['kB sent']) / 1000:.1f} MB. The run took {wall:.0f} s, "
        f"{wall / simulated:.1f} times real time, and an iteration of a node "
        f"{float(run['iteration, median [ms]']) / 1000:.2f} s (median) with all six",
    )


def test_what_a_message_costs() -> None:
    costs = {int(row["robots"]): row for row in rows("message_overhead.csv") if row["transport"] == "zenoh"}
    says(
        DISTRIBUTED,
        f"{float(costs[16]['overhead']):.2f} ms for writing, sending and reading a candidate of 16 robots "
        f"({float(costs[16]['bytes']) / 1000:.0f} kB), and {float(costs[16]['judge']):.1f} ms for judging it",
        f"{float(costs[32]['judge']):.1f} ms for 32 robots where it does not",
    )


# Recipes


def test_recipes_succeed_as_their_table_says() -> None:
    for path in sorted((ROOT / "data" / "recipes").glob("*.csv")):
        last = rows(f"recipes/{path.name}")[-1]
        steps, power = int(last["robot-steps"]), round(np.log10(int(last["robot-steps"])))
        factor = f"{steps / 10**power:.1f}"
        ending = f"| {'' if factor == '1.0' else f'{factor}·'}10{'⁴⁵⁶'[power - 4]} | {last['success']} |"
        table = [line for line in (ROOT / RECIPES).read_text().splitlines() if line.startswith(f"| `{path.stem}.py`")]
        assert [line.endswith(ending) for line in table] == [True], ending
    (earlier,) = (row["success"] for row in rows("recipes/jax_ppo.csv") if row["robot-steps"] == "983040")
    says(RECIPES, f"after 10⁶ steps `jax_ppo.py` had {earlier}.")


# MMD


def solves(name: str) -> dict[tuple[str, str], list[Row]]:
    """Rows of a set of teams, by planner and team, in the order of their seeds."""
    own = (row for row in rows("solve_rates.parquet") if row["set"] == name)
    return grouped(sorted(own, key=lambda row: row["seed"]), lambda row: (row["planner"], row["team"]))


def teams(name: str) -> list[str]:
    """Of a set."""
    return list(dict.fromkeys(team for _, team in solves(name)))


def solved(some: Iterable[Row]) -> int:
    """How many are."""
    return sum(row["solved"] for row in some)


def slower(name: str, other: str) -> list[float]:
    """By how much MMD's mean travel times in each team exceed another planner's, where both solve."""
    found, ratios = solves(name), []
    for team in teams(name):
        both = [
            (one["travel"], two["travel"])
            for one, two in zip(found["mmd", team], found[other, team], strict=True)
            if one["solved"] and two["solved"]
        ]
        ratios.append(sum(one for one, _ in both) / sum(two for _, two in both) - 1)
    return ratios


def percent(ratios: Sequence[float]) -> str:
    """Their span, in percent."""
    return f"{span([100 * ratio for ratio in ratios], '.0f')}%"


def medians(name: str, planner: str) -> list[float]:
    """Seconds to the first plan, team by team."""
    return [float(np.median([row["seconds"] for row in solves(name)[planner, team]])) for team in teams(name)]


def test_mmd_solves_teams_that_others_do_not_and_the_reverse() -> None:
    found = {key: solved(own) for key, own in solves("few").items()}
    crowd, rooms = "random with 4 obstacles, 16", "rooms, 8"
    for team in teams("few"):
        more = {crowd: 1, rooms: -1}.get(team, 0)
        assert found["mmd", team] - found["d4orm-d", team] == found["mmd", team] - found["mapf", team] == more
    most = max(row["iterations"] for own in solves("few").values() for row in own)
    says(
        MMD,
        f"Seeds 0 to 4, at most {most} iterations",
        "one more instance of 16 at random than the others and one fewer of 8 in rooms",
        f"its ways take {percent(slower('few', 'd4orm-d'))} longer than D4orm-D's on the instances that both solve",
    )


def test_path_finding_is_faster_than_mmd_but_for_a_few() -> None:
    found = solves("few")
    pairs = {team: list(zip(found["mapf", team], found["mmd", team], strict=True)) for team in teams("few")}
    ratios = [np.median([other["seconds"] / one["seconds"] for one, other in own]) for own in pairs.values()]
    slow = [one for own in pairs.values() for one, other in own if one["seconds"] > other["seconds"]]
    assert sum(not one["solved"] for one in slow) == 1
    says(
        MMD,
        f"Path finding is {span(ratios, '.0f')} times as fast in the median; in {WORDS[len(slow)]} of "
        f"{sum(map(len, pairs.values()))} instances it is slower, and in one of them finds nothing.",
    )


def test_mmd_on_its_own_maps() -> None:
    found = {key: solved(own) for key, own in solves("mmd").items()}
    everywhere = sum(found["mmd", team] for team in teams("mmd"))
    small = {place: found["mmd", f"{place}, 6"] + found["mmd", f"{place}, 12"] for place in ("conveyor", "drop region")}
    total = sum(len(own) for (planner, _), own in solves("mmd").items() if planner == "mmd")
    highways = sum(found["mmd", f"highways, {robots}"] for robots in (6, 12, 20))
    most = max(row["iterations"] for own in solves("mmd").values() for row in own)
    says(
        MMD,
        f"20 seeds, at most {most} iterations",
        f"It solves {everywhere} of {total} instances: {highways} of 60 on the highways, with up to 12 robots "
        f"{listed(small.values())} of 40 on the other two maps, and with 20 robots {found['mmd', 'conveyor, 20']} and "
        f"{found['mmd', 'drop region, 20']} of 20 there",
    )


def test_others_solve_all_of_mmds_maps_sooner_and_shorter() -> None:
    for other in ("d4orm-d", "mapf"):
        assert sum(solved(own) for (planner, _), own in solves("mmd").items() if planner == other) == 180
        assert all(one < two for one, two in zip(medians("mmd", other), medians("mmd", "mmd"), strict=True))
    says(
        MMD,
        "D4orm-D and path finding solve all 180, sooner",
        f"its travel times are {percent(slower('mmd', 'd4orm-d'))} longer than D4orm-D's, "
        f"and {percent(slower('mmd', 'guided'))} longer than path finding's.",
    )


def test_mmds_model_is_small() -> None:
    path = ROOT / "d4orm_planners" / "mmd" / "weights.npz"
    with np.load(path, allow_pickle=False) as arrays:
        weights, (layers, width, _) = sum(array.size for array in arrays.values()), arrays["hidden"].shape
    says(
        MMD,
        f"arrays only, {path.stat().st_size / 1e6:.1f} MB",
        f"{WORDS[layers]} hidden layers of {width}, {weights // 1000} 000 weights",
    )


# Planners


def warm(planner: str, team: str) -> tuple[list[Row], list[Row]]:
    """Plans from nothing and from an episode of PPO."""
    own = [row for row in rows("warm_start.parquet") if row["planner"] == planner and row["team"] == f"{team} robots"]
    nothing, ppo = ([row for row in own if row["from"] == source] for source in ("nothing", "ppo"))
    return nothing, ppo


def median(some: Iterable[Row], name: str) -> float:
    """Of a column."""
    return float(np.median([row[name] for row in some]))


def travel(some: Iterable[Row]) -> float:
    """Mean travel time of those that are solved [s]."""
    return float(np.mean([row["travel"] for row in some if row["solved"]]))


def test_default_planner_solves_nearly_all_teams() -> None:
    own = [row for row in rows("solve_rates.parquet") if row["planner"] == "d4orm-d"]
    assert solved(own) / len(own) > 0.99
    assert {"random, 1000", "circle, 8", "warehouse, 100"} <= {row["team"] for row in own}
    says(PLANNERS, "is `d4orm-d`, which solves nearly all teams tried, of any size, in the open and among walls")


def test_first_guess_helps_where_the_policy_solves() -> None:
    for team in ("random, 8", "circle, 8", "circle, 16"):
        for planner in ("d4orm", "d4orm-d"):
            nothing, ppo = warm(planner, team)
            assert median(ppo, "iterations") == 0
            assert median(ppo, "seconds") < median(nothing, "seconds")
    for team in ("random, 8", "circle, 8"):
        assert abs(travel(warm("d4orm", team)[1]) - travel(warm("d4orm-d", team)[1])) < 0.02
    short, long = map(travel, warm("d4orm-d", "circle, 16"))
    says(
        PLANNERS,
        f"the same {len(warm('d4orm', 'circle, 16')[0])} instances with and without",
        "with eight robots, and on the circle with 16, where first plans come sooner.",
        "D4orm's ways then are as short as D4orm-D's with eight robots, "
        f"and D4orm-D's longer on the circle with 16 ({long:.2f} and {short:.2f} s).",
    )


def test_first_guess_in_crowds_helps_d4orm_alone() -> None:
    slow, slower_still = (median(some, "seconds") for some in warm("d4orm-d", "random, 16"))
    assert slower_still > slow
    nothing, ppo = warm("d4orm", "random, 16")
    assert solved(nothing) == solved(ppo)
    assert round(3 * (1 - median(ppo, "seconds") / median(nothing, "seconds"))) == 2
    says(
        PLANNERS,
        "With 16 on a square of 5 m the episode costs D4orm-D more than it saves, "
        f"and D4orm, which solves {solved(ppo)} of {len(ppo)} with and without, two thirds less time in the median.",
    )


def test_first_guess_of_the_coarse_plan() -> None:
    for team in ("circle, 8", "circle, 16"):
        nothing, ppo = warm("d4orm-c2f", team)
        assert median(ppo, "seconds") < median(nothing, "seconds")
    assert travel(ppo) < travel(nothing)
    longer = []
    for team in ("random, 8", "random, 16"):
        nothing, ppo = warm("d4orm-c2f", team)
        assert stats.wilcoxon([one["seconds"] - two["seconds"] for one, two in zip(nothing, ppo)]).pvalue > 0.05
        longer.append(f"{travel(ppo):.2f} and {travel(nothing):.2f}")
    says(
        PLANNERS,
        "D4orm-C2F's coarse plan comes sooner on the circle, and with 16 robots its ways are shorter there",
        f"in crowds it comes not significantly sooner, and ways are longer ({longer[0]} s, {longer[1]}).",
    )


def test_noise_of_a_denoising_run() -> None:
    kept = alpha_bar(100, 1e-4, 2e-2)
    sigma = np.sqrt(1 / kept - 1)
    says(
        D4ORM,
        rf"falls from {sigma[99]:.2f} at $i = 100$ over {sigma[49]:.2f} at $i = 50$ to {sigma[0]:.2f} at $i = 1$",
        rf"$1 / \sqrt{{\bar\alpha_N}} = {kept[-1] ** -0.5:.2f}$",
    )


def test_default_credit_solves_teams_among_obstacles() -> None:
    groups = grouped(trials("contact_penalty"), lambda trial: (trial.scenario, trial.label))
    found = {label: own for (place, label), own in groups.items() if place == "paper_obstacles"}
    count = {label: sum(map(is_solved, own)) for label, own in found.items()}
    assert count["team, 1"] == count["robot, 1"] == 0
    says(
        D4ORM,
        f"D4orm solves {count['group, 2']} of {len(found['group, 2'])} teams of 16 among four obstacles, of which it "
        f"solves none by the team's or each robot's own reward alone, and solved {count['alternate, 1']} with "
        '`credit="alternate"` and `penalty=1`',
    )


def test_default_credit_costs_a_little_time_on_circles() -> None:
    own = grouped(trials("contact_penalty"), lambda trial: (trial.scenario, trial.model, trial.label))
    longer = []
    for model in (PUCKS, WHEELS):
        now, before = (own["paper_circle", model, label] for label in ("group, 2", "alternate, 1"))
        longer.append(sum(map(travel_time, now)) / sum(map(travel_time, before)) - 1)
    says(D4ORM, f"First plans on circles of one model are {percent(longer)} longer for it")


def test_solve_rates_are_of_twenty_seeds() -> None:
    found = (own for name in ("big", "canonical") for own in solves(name).values())
    (seeds,) = {tuple(row["seed"] for row in own) for own in found}
    says(D4ORM_D, f"seeds {seeds[0]} to {seeds[-1]} of problem and planner")


def test_first_solutions_of_three_random_instances() -> None:
    three = solves("canonical")["d4orm-d", "random, 16"][:3]
    assert [row["seed"] for row in three] == [0, 1, 2]
    least = listed(f"{row['least']:.2f}" for row in three)
    says(
        D4ORM_D,
        f"seeds 0 to 2, ours gives {span([row['travel'] for row in three], '.2f')}, where no plan can take less than "
        f"{least}.",
    )


def test_controller_was_run_in_all_big_teams() -> None:
    own = [trial for trial in trials("big-teams") if trial.policy == "d4orm-c2f"]
    panels = grouped(own, lambda trial: (trial.scenario, trial.model))
    (seeds,) = {len({trial.seed for trial in group}) for group in panels.values()}
    says(D4ORM_C2F, f"In all {WORDS[len(panels)]} panels of the paper's big teams, {seeds} seeds of each")


# Performance


def denoising(**wanted: object) -> list[Row]:
    """Rows of the benchmark of denoising."""
    return [row for row in bench()["denoising"] if wanted.items() <= row.items()]


def steps_per_second(environment: str, obstacles: int = 0, disturbances: int = 0) -> float:
    """Of an environment with a team of eight."""
    wanted = {"environment": environment, "obstacles": obstacles, "disturbances": disturbances}
    (found,) = (row["steps_per_second"] for row in bench()["environments"] if wanted.items() <= row.items())
    return float(found)


def test_two_cores_are_worth_less_than_two() -> None:
    ratios = {row["num_robots"]: f"{row['speedup']['median']:.2f}" for row in bench()["threads"]}
    says(PERFORMANCE, f"two cores are worth {listed(ratios.values())} with {listed(ratios)} robots.")


def test_first_plans_beside_the_papers() -> None:
    preset, default = ([row for row in bench()["plans"] if row["rules"] == rules] for rules in ("paper", "default"))
    preset_takes = {row["num_robots"]: f"{row['seconds']['median']:.2f}" for row in preset}
    assert [row["solved"] for row in preset[:3]] == [20, 20, 20]
    says(
        PERFORMANCE,
        f"its preset takes {listed(preset_takes.values())} s with {listed(preset_takes)} robots in the median",
        f"here {preset[3]['solved']} of {preset[3]['seeds']} with 16), "
        f"our defaults {span([row['seconds']['median'] for row in default], '.2f')} s.",
    )


def test_denoising_steps() -> None:
    def milliseconds(robots: int, name: str, steps: int, form: str) -> str:
        own = denoising(model=PUCKS, num_robots=robots)
        return span([1e3 * row[name]["median"] / steps for row in own], form)

    says(
        PERFORMANCE,
        f"a denoising step takes {milliseconds(8, 'iteration', 100, '.2f')} ms at 8 robots in the mean of an iteration "
        f"and {milliseconds(8, 'step', 1, '.1f')} at the largest noise",
        f"{milliseconds(64, 'iteration', 100, '.1f')} and {milliseconds(64, 'step', 1, '.1f')} at 64 (about 15)",
    )


def test_drives_take_longer() -> None:
    ratios = [
        drive["iteration"]["median"] / point["iteration"]["median"]
        for drive, point in zip(denoising(model=WHEELS), denoising(model=PUCKS), strict=True)
    ]
    says(PERFORMANCE, f"a differential drive's iteration {span(ratios, '.1f')} times that (2)")


def test_kernel_beside_plain_jax() -> None:
    table = bench("bench_jax")["denoising"]
    plain = {(row["model"], row["num_robots"]): row["step"]["median"] for row in table if row["engine"] == "plain"}
    points, drives = (
        [
            plain[model, row["num_robots"]] / row["step"]["median"]
            for row in table
            if row["engine"] == "cpu" and row["model"] == model
        ]
        for model in (PUCKS, WHEELS)
    )
    says(PERFORMANCE, f"{span(points, '.0f')} times plain JAX (40), drives {span(drives, '.0f')} times")


def test_environment_steps() -> None:
    single, batch, compiled = map(steps_per_second, ("parallel_env", "make_vec", "FunctionalEnv"))
    kept = [steps_per_second(name, obstacles=200) / steps_per_second(name) for name in ("parallel_env", "make_vec")]
    says(
        PERFORMANCE,
        f"{round(single, -3):,.0f} steps of one environment, {round(batch, -5):,.0f} of a batch and "
        f"{round(compiled, -4):,.0f} of `FunctionalEnv`",
        f"`env.step` keeps {kept[0]:.2f} of its speed and `make_vec` {kept[1]:.2f}.",
    )


def test_start_of_a_process() -> None:
    (start,) = bench()["startup"]
    says(
        PERFORMANCE,
        f"takes {start['cold']:.0f} s to its first plan by D4orm-D, of which {start['compiling']:.0f} are compiling",
        f"and {start['warm']['median']:.1f} s if it finds them.",
    )


def test_obstacles_double_an_iteration() -> None:
    near = {row["obstacles"]: row["ratio"]["median"] for row in bench()["obstacles"] if row["where"] == "near"}
    many = {boxes: ratio for boxes, ratio in near.items() if boxes >= 200}
    assert {f"{ratio:.0f}" for ratio in many.values()} == {"2"}
    says(PERFORMANCE, f"an iteration among {span(many)} near boxes about twice as long as in the open.")


def test_disturbances_cost_some_speed() -> None:
    single, batch = (
        steps_per_second(name) / steps_per_second(name, disturbances=3) for name in ("parallel_env", "make_vec")
    )
    says(
        DISTURBANCES,
        f"with three of them `env.step` takes {single:.1f} times as long, and a step of 1024 worlds {batch:.1f} times.",
    )
