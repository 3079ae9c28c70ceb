"""Kinds of solution that a planner finds: two robots swap positions around an obstacle (the paper's appendix A).

    python -m examples.studies multimodality --seeds 500
    python -m examples.studies multimodality --team 8 --seeds 500

One solve per planner and seed. A plan's class is the signs of three winding angles: of robot 0 about the obstacle, of
robot 1 about the obstacle, and of robot 1 about robot 0. Every combination of signs can be had. Six of the eight say in
which order the two robots and the obstacle lie from top to bottom as they pass each other, of which there are 3! = 6.
The other two are cyclic (robot 0 above the obstacle, the obstacle above robot 1, robot 1 above robot 0): a robot must
weave, and pass the other on one side before it passes the obstacle on the other. The signs do not tell how often a
robot goes round.

With ``--team`` a whole team swaps positions on a circle, the appendix's harder problem: robots meet pairwise, and pass
each other on one side or the other. A plan's class is the sign of the angle that each robot sweeps around each other
one, 28 signs with eight robots. The table has how many seeds were solved, how many classes the solutions are of, and
a hundred of them drawn at random, which does not grow with the seeds (rarefaction); how many pairs of solutions are of
the same class, and how far apart two are (root mean square distance of the robots' positions over time, mean over all
pairs). Slow plans differ more, so the last two rows have plans of equal travel times only. The plot has all solutions
along the directions in which they differ most.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from itertools import combinations
from math import comb
from typing import Any

import numpy as np
from examples.common import count, mean_text, plt, require, save_figure, save_table, study_parser, study_rows
from examples.denoising import denoising_columns, denoising_of
from examples.studies import AS_IN_THE_PAPER

require("ipopt", "casadi")
from d4orm_env import Problem, World, make_problem, verify
from d4orm_planners import make_planner

Signature = tuple[int, int, int]
Row = Mapping[str, Any]

PLANNERS: dict[str, tuple[str, dict[str, Any]]] = {
    "d4orm": ("d4orm", {}),
    "d4orm, preset paper": ("d4orm", {"preset": "paper"}),
    "ipopt": ("ipopt", {}),
}

COMPARED, DRAWN = ("d4orm, preset paper", "ipopt"), 100
"""Planners that the paper compares, and how many plans are drawn of each."""

CLASSES: dict[Signature, tuple[str, str]] = {
    (-1, -1, -1): ("1 over O over 0", "#0072B2"),
    (1, 1, 1): ("0 over O over 1", "#D55E00"),
    (-1, 1, -1): ("O over 1 over 0", "#009E73"),
    (-1, 1, 1): ("O over 0 over 1", "#CC79A7"),
    (1, -1, -1): ("1 over 0 over O", "#E69F00"),
    (1, -1, 1): ("0 over 1 over O", "#56B4E9"),
    (-1, -1, 1): ("0 over 1 over O over 0", "black"),
    (1, 1, -1): ("1 over 0 over O over 1", "#7F7F7F"),
}
"""Signs of the winding angles: the order from top to bottom (O is the obstacle), and a colour."""


def crossing(radius: float) -> Problem:
    """Robot 0 goes from right to left and robot 1 from left to right, with a circle at the origin in their way."""
    return make_problem("circle", num_robots=2, **AS_IN_THE_PAPER).replace(world=World(2, circles=[[0, 0, radius]]))


def winding(path: np.ndarray) -> float:
    """The angle [rad] that ``path`` ``(T, 2)`` sweeps about the origin, positive anticlockwise.

    The path must not sweep half a turn or more in one step.
    """
    turns = np.diff(np.arctan2(path[:, 1], path[:, 0]))
    return float(((turns + np.pi) % (2 * np.pi) - np.pi).sum())


def signature(positions: np.ndarray) -> Signature:
    """The signs of the winding angles of a plan ``(T, 2, 2)`` around an obstacle at the origin."""
    first, second = positions[:, 0], positions[:, 1]
    signs = [1 if winding(path) > 0 else -1 for path in (first, second, second - first)]
    return signs[0], signs[1], signs[2]


def solve(problem: Problem, seeds: int, **limits: Any) -> list[dict[str, Any]]:
    """A row per planner and seed: whether the first solution passes, its travel time, and where the robots go."""
    rows = []
    for label, (name, settings) in PLANNERS.items():
        planner = make_planner(name, **settings)
        for seed in range(seeds):
            plan = planner.solve(problem, seed=seed, **limits)
            solved = plan.solved and verify(problem, plan.controls).ok
            # Every other one, to the centimetre, which compresses well and changes no number in the tables.
            positions = (
                np.round(plan.trajectory.positions[::2].astype(np.float64), 2).ravel().tolist() if solved else []
            )
            rows.append(
                {"planner": label, "seed": seed, "solved": solved, "robots": problem.num_robots,
                 "travel_time": plan.metrics["travel_time"] if solved else None, "positions": positions,
                 **denoising_of(plan.history)}
            )  # fmt: skip
        print(f"{label}: {sum(row['solved'] for row in rows[-seeds:])} of {seeds} seeds solved", flush=True)
    return rows


def solutions(rows: Sequence[Row], label: str) -> list[Row]:
    """Return the solutions of a planner."""
    return [row for row in rows if row["planner"] == label and row["solved"]]


def path_of(row: Row) -> np.ndarray:
    """``(T, K, 2)`` where the robots are [m]."""
    return np.array(row["positions"]).reshape(-1, row["robots"], 2)


def principal_components(paths: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Project plans ``(T, K, 2)`` to ``(S, 2)`` [m], the two directions in which they differ most.

    Also the ``(2,)`` shares of the variance.
    """
    features = np.stack([path.ravel() for path in paths]).astype(np.float64)
    u, singular, _ = np.linalg.svd(features - features.mean(axis=0), full_matrices=False)
    power = singular**2
    # Over the root of steps times robots: two plans then lie as far apart as their robots do, in root mean square.
    return u[:, :2] * singular[:2] / np.sqrt(features.shape[1] / 2), power[:2] / power.sum()


def draw(problem: Problem, found: dict[Signature, list[np.ndarray]], out: Any) -> None:
    """Left: all plans along their principal components. Right: of every class the plan nearest to its mean."""
    rows = -(-len(found) // 2)
    figure = plt.figure(figsize=(10.5, 0.8 + 1.45 * max(rows, 2)), layout="constrained")
    grid = figure.add_gridspec(rows, 4, width_ratios=[1.15, 1.15, 1, 1])
    scatter = figure.add_subplot(grid[:, :2])
    styles = [
        {"marker": "o", "color": colour, "markersize": 4.5, "alpha": 0.75, "label": name}
        for name, colour in map(CLASSES.__getitem__, found)
    ]
    parts = draw_components(scatter, list(found.values()), styles)
    for number, (part, (signs, plans)) in enumerate(zip(parts, found.items(), strict=True)):
        name, colour = CLASSES[signs]
        panel = figure.add_subplot(grid[number // 2, 2 + number % 2])
        typical = plans[int(((part - part.mean(axis=0)) ** 2).sum(axis=1).argmin())]
        draw_plan(panel, problem, typical, colour)
        panel.set_title(f"{name}: {len(plans)} plan{'s'[: len(plans) > 1]}", fontsize=9, color=colour)
    scatter.set_title(f"{sum(map(len, parts))} solutions in {len(found)} classes", fontsize=10)
    scatter.set_aspect("equal", adjustable="datalim")
    scatter.legend(title="top to bottom", loc="best", handletextpad=0.1)
    save_figure(figure, out / "multimodality.png")


def draw_plan(panel: Any, problem: Problem, positions: np.ndarray, colour: str) -> None:
    """Both paths, and where the robots are when they are nearest to each other."""
    x, y, radius = problem.world.circles[0]
    panel.add_patch(plt.Circle((x, y), radius, color="0.75"))
    panel.text(x, y, "O", ha="center", va="center", fontsize=8)
    nearest = int(np.linalg.norm(positions[:, 0] - positions[:, 1], axis=1).argmin())
    for robot, style in enumerate(("-", "--")):
        path = positions[:, robot]
        panel.plot(*path.T, style, color=colour, linewidth=1.4)
        position, radius = path[nearest], float(problem.team.radius[robot])
        panel.add_patch(plt.Circle(position, radius, facecolor="white", edgecolor=colour, zorder=3))
        panel.text(*position, str(robot), ha="center", va="center", fontsize=6.5, zorder=4)
    panel.set(xlim=(-2.8, 2.8), ylim=(-1.4, 1.4), aspect="equal")
    panel.set_axis_off()


def summary(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """A row per class: how many plans of each planner are of it, and how long they travel."""
    classes = {label: [signature(path_of(row)) for row in solutions(rows, label)] for label in PLANNERS}
    table = []
    for signs, (name, _) in CLASSES.items():
        line = {"top to bottom": name, "signs": " ".join("+" if sign > 0 else "-" for sign in signs)}
        for label, found in classes.items():
            pairs = zip(solutions(rows, label), found, strict=True)
            own = [row for row, of in pairs if of == signs]
            line[f"{label}: plans"] = str(len(own))
            line |= {f"{label}: {name}": value for name, value in denoising_columns(own).items()}
            line[f"{label}: travel time [s]"] = mean_text([row["travel_time"] for row in own], none="")
        table.append(line)
    return table


def team_signature(positions: np.ndarray) -> tuple[bool, ...]:
    """Return, for every pair of robots of a plan ``(T, K, 2)``, whether the one goes round the other anticlockwise."""
    pairs = combinations(range(positions.shape[1]), 2)
    return tuple(winding(positions[:, second] - positions[:, first]) > 0 for first, second in pairs)


def rarefied(classes: Sequence[object], size: int) -> float:
    """Expected number of classes among so many plans, drawn of those whose classes are given (Hurlbert, 1971)."""
    total = comb(len(classes), size)
    return sum(1 - comb(len(classes) - number, size) / total for number in Counter(classes).values())


def row_of(label: str, plans: Sequence[Row], trials: int) -> dict[str, Any]:
    """The table's row of a planner's solutions."""
    paths = [path_of(plan) for plan in plans]
    classes, pairs = [team_signature(path) for path in paths], list(combinations(range(len(plans)), 2))
    same = sum(classes[one] == classes[other] for one, other in pairs)
    apart = [np.sqrt(((paths[one] - paths[other]) ** 2).sum(axis=2).mean()) for one, other in pairs]
    times = [plan["travel_time"] for plan in plans]
    return {
        "planner": label,
        "solved": f"{len(plans)} of {trials}",
        **denoising_columns(plans),
        "classes": len(set(classes)),
        f"classes of {DRAWN} plans": f"{rarefied(classes, DRAWN):.1f}" if len(plans) >= DRAWN else "-",
        "pairs of one class": f"{same / len(pairs):.0%}" if pairs else "-",
        "distance [m]": mean_text(apart),
        "travel time [s]": mean_text(times),
    }


def team_table(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """A row per planner; and of the paper's two once more with the plans of travel times that both have."""
    found = {label: solutions(rows, label) for label in PLANNERS}
    table = [row_of(label, plans, sum(row["planner"] == label for row in rows)) for label, plans in found.items()]
    times = [[plan["travel_time"] for plan in found[label]] for label in COMPARED if found[label]]
    first, last = max(map(min, times), default=1.0), min(map(max, times), default=0.0)
    alike = {label: [plan for plan in found[label] if first <= plan["travel_time"] <= last] for label in COMPARED}
    if all(alike.values()):
        table += [
            row_of(f"{label}, {first:.2f} to {last:.2f} s", plans, len(found[label])) for label, plans in alike.items()
        ]
    return table


def draw_components(axes: Any, groups: Sequence[Sequence[np.ndarray]], styles: Sequence[dict[str, Any]]) -> list[Any]:
    """Groups of plans along the principal components of all of them together; the points ``(S, 2)`` of each group."""
    points, shares = principal_components([path for paths in groups for path in paths])
    parts = np.split(points, np.cumsum([len(paths) for paths in groups])[:-1])
    for part, style in zip(parts, styles, strict=True):
        axes.plot(*part.T, linestyle="none", markeredgewidth=0, **style)
    names = zip(("first", "second"), shares)
    labels = [f"{name} principal component [m], {share:.0%} of the variance" for name, share in names]
    axes.set(xlabel=labels[0], ylabel=labels[1])
    return parts


def draw_teams(rows: Sequence[Row], out: Any) -> None:
    """All planners' solutions along the principal components of all of them together."""
    groups = [[path_of(plan) for plan in solutions(rows, label)] for label in PLANNERS]
    figure, axis = plt.subplots(figsize=(5.5, 4.5), layout="constrained")
    markers = zip("o^s", PLANNERS, strict=True)
    draw_components(
        axis, groups, [{"marker": mark, "label": label, "alpha": 0.7, "markersize": 5} for mark, label in markers]
    )
    axis.legend()
    save_figure(figure, out / "multimodality_team.png")


def main() -> None:
    parser = study_parser(__doc__, seeds=100)
    parser.add_argument("--radius", type=float, default=0.5, help="of the obstacle [m]")
    parser.add_argument("--team", type=count, metavar="ROBOTS", help="so many on a circle instead, and no obstacle")
    arguments = parser.parse_args()
    if arguments.team:
        seeds, num_robots = (4, 3) if arguments.quick else (arguments.seeds, arguments.team)
        problem = make_problem("paper_circle", num_robots=num_robots)
        plans = partial(solve, problem, seeds, max_iterations=20, time_limit=120)
        rows = study_rows(arguments, "multimodality_team", plans)
        save_table(team_table(rows), arguments.out / "multimodality_team.csv")
        draw_teams(rows, arguments.out)
        return
    seeds = min(arguments.seeds, 8) if arguments.quick else arguments.seeds
    problem = crossing(arguments.radius)
    rows = study_rows(arguments, "multimodality", partial(solve, problem, seeds, max_iterations=10))
    save_table(summary(rows), arguments.out / "multimodality.csv")
    paths = [path_of(row) for row in solutions(rows, "d4orm")]
    found = {signs: [path for path in paths if signature(path) == signs] for signs in CLASSES}
    draw(problem, {signs: members for signs, members in found.items() if members}, arguments.out)
