"""Denoising of D4orm-C2F as written and ours: steps, and their share of the time, of the coarse plan and of loops.

    python -m examples.studies controller_denoising --seeds 1

The trials of a controller tell its steps in a loop, but not how long they took. Here the teams of the paper's figure of
variants are driven again, in one thread. What a coarse plan or a loop does beside denoising is rollouts, checks and
path finding.
"""

from __future__ import annotations

import time
from functools import partial
from typing import Any
from unittest.mock import patch

import numpy as np
from examples.common import each_row, grouped, mean_text, save_table, study_parser, study_rows
from examples.studies.paper.paper_figures import BOTH_C2F, FIGURES

from d4orm_env import Problem, make_problem
from d4orm_planners import make_policy, run_episode
from d4orm_planners.base.episode import open_env
from d4orm_planners.d4orm_c2f.receding_horizon import D4ormC2F
from d4orm_planners.engine.sampling_types import get_sampling_engine

Rows = list[dict[str, Any]]
Team = tuple[str, str, str | None, int]
"""Title, scenario, model, number of robots."""

CONTROLLERS = {
    label: {name: value for name, value in settings.items() if name != "policy"} for label, settings in BOTH_C2F.items()
}
SECTIONS = FIGURES["big-teams"].sections[:-1]
TEAMS: tuple[Team, ...] = tuple(
    (section.title, *section.scenarios, section.model, size)  # type: ignore[misc]
    for section in SECTIONS for size in section.num_robots
)  # fmt: skip


def drive(problem: Problem, policy: D4ormC2F, seed: int) -> dict[str, Any]:
    """What a controller denoised, before its first action and in its loops, and how the drive ended."""
    engine = type(get_sampling_engine(policy.config.engine))
    denoise, prepare, spent, steps, preparing = engine.denoise, engine.prepare, {"coarse": 0.0, "loops": 0.0}, 0, False

    def prepared(*arguments: Any, **named: Any) -> None:  # which takes a step for nothing
        nonlocal preparing
        preparing = True
        prepare(*arguments, **named)
        preparing = False

    def timed(*arguments: Any, **named: Any) -> Any:
        nonlocal steps
        under_way, begin = hasattr(policy, "coarse_time"), time.perf_counter()
        result = denoise(*arguments, **named)
        if not preparing:
            spent["loops" if under_way else "coarse"] += time.perf_counter() - begin
            steps += 0 if under_way else len(result.rewards)
        return result

    with patch.object(engine, "denoise", timed), patch.object(engine, "prepare", prepared):
        metrics = run_episode(open_env(problem, policy=policy), policy, seed).metrics
    return {
        "coarse_steps": steps, "coarse_share": spent["coarse"] / policy.coarse_time,
        "loop_steps": policy.loops[0].num_steps,
        "loop_share": spent["loops"] / sum(loop.wall_time for loop in policy.loops),
        "success": bool(metrics["success"]), "travel_time": float(metrics["travel_time"]),
    }  # fmt: skip


def row_of(policies: dict[str, dict[str, object]], team: Team, label: str, seed: int) -> dict[str, Any]:
    """The row of a team, a controller and a seed."""
    title, scenario, model, size = team
    policy = make_policy("d4orm-c2f", **policies[label])
    assert isinstance(policy, D4ormC2F)
    problem = make_problem(scenario, size, seed, model=model)
    return {"team": title, "robots": size, "controller": label, "seed": seed, **drive(problem, policy, seed)}


def summary(rows: Rows) -> Rows:
    """A row per team and controller."""
    return [
        {
            "team": team, "robots": robots, "controller": label, "drives": len(own),
            "coarse plan, denoising steps": f"{np.median([row['coarse_steps'] for row in own]):g}",
            "denoising, time of it": mean_text([row["coarse_share"] for row in own], ".0%"),
            "loop, denoising steps": own[0]["loop_steps"],
            "denoising, time of loops": mean_text([row["loop_share"] for row in own], ".0%"),
        }
        for (team, robots, label), own in grouped(rows, "team", "robots", "controller").items()
    ]  # fmt: skip


def main() -> None:
    """Drive all teams and write the table."""
    arguments = study_parser(__doc__, seeds=1).parse_args()
    few = {"coarse_samples": 64, "coarse_steps": 15, "num_samples": 32, "num_steps": 5} if arguments.quick else {}
    policies = {label: {**settings, **few} for label, settings in CONTROLLERS.items()}
    teams = (("2D Holonomic", "paper_circle", None, 2),) if arguments.quick else TEAMS
    drives = partial(each_row, partial(row_of, policies), teams, policies, range(arguments.seeds))
    save_table(
        summary(study_rows(arguments, "controller_denoising", drives)), arguments.out / "controller_denoising.csv"
    )
