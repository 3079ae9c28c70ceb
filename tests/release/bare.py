"""What the required packages alone have to do. Run by ``make wheel-test`` in a fresh environment, and by the tests."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import d4orm_env
import d4orm_planners
from d4orm_env import make_problem, navigation_v0, verify
from d4orm_planners import make_planner, make_policy

HEAVY = ("jax", "matplotlib", "PIL", "typer", "rich", "safetensors")
"""Loaded by what needs them, never by importing, stepping or planning."""


def nothing_heavy(after: str) -> None:
    loaded = [name for name in HEAVY if name in sys.modules]
    assert not loaded, f"{after} loads {', '.join(loaded)}"


def step(team: d4orm_env.Problem) -> None:
    env = navigation_v0.parallel_env(problem=team)
    policy = make_policy("go-to-goal")
    observations, _ = env.reset(seed=0)
    policy.reset(env, seed=0)
    env.step(policy.act(observations, env.state()))
    nothing_heavy("stepping")


def plan(team: d4orm_env.Problem) -> d4orm_planners.Plan:
    made = make_planner("d4orm").solve(team, seed=0)
    assert made.solved
    assert verify(team, made.controls).ok
    nothing_heavy("planning")
    return made


def draw(made: d4orm_planners.Plan, folder: Path) -> None:
    made.plot().figure.savefig(folder / "plan.png")
    made.to_html(folder / "plan.html")
    assert all((folder / name).stat().st_size > 1000 for name in ("plan.png", "plan.html"))


def missing_extra(team: d4orm_env.Problem) -> None:
    try:
        make_planner("ipopt").solve(team, seed=0)
    except ImportError as error:
        message = str(error)
    assert message.endswith("install it with: pip install 'd4orm-env[ipopt]'"), message
    assert "\n" not in message


def main() -> None:
    nothing_heavy("importing")
    team = make_problem("circle", num_robots=4, seed=0)
    step(team)
    with tempfile.TemporaryDirectory() as folder:
        draw(plan(team), Path(folder))
    missing_extra(team)
    print(f"d4orm-env {d4orm_env.__version__} imports, steps, plans and draws")


if __name__ == "__main__":
    main()
