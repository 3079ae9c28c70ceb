"""``d4orm demo``: a team planned, executed, verified and drawn."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from d4orm_planners.commands.inputs import make_folder
from d4orm_planners.commands.options import Engine, Seed
from d4orm_planners.commands.outputs import episode_rows, print_plan, print_table, require_solved
from d4orm_planners.commands.plan import solving

if TYPE_CHECKING:
    from d4orm_planners.episode import Episode
    from d4orm_planners.plan import Plan


def demo(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder to write to.")] = Path("demo"),
    num_robots: Annotated[int, typer.Option("--num-robots", "--robots", "-k", help="Number of robots.")] = 16,
    seed: Seed = 0,
    engine: Engine = "auto",
) -> None:
    """Plan robots across a circle, execute the plan in the environment, verify it, and write pictures."""
    from d4orm_env import make_problem
    from d4orm_env.render import save_animation, save_picture
    from d4orm_planners.registry import make_planner

    make_folder(out)
    problem = make_problem("circle", num_robots=num_robots, seed=seed)
    planner = make_planner("d4orm", engine=engine)
    with solving(planner, problem) as callback:
        plan = planner.solve(problem, seed, callback=callback)
    print_plan(plan)
    require_solved(plan)
    episode = _execute(plan, seed)
    files = {"plan": out / "plan.npz", "picture": out / "plan.png", "animation": out / "execution.gif"}
    plan.save(files["plan"])
    title = f"{problem.num_robots} robots, planned by D4orm in {plan.wall_time:.2f} s"
    save_picture(problem, episode.trajectory, files["picture"], title=title)
    save_animation(problem, episode.trajectory, files["animation"])
    for name, path in files.items():
        typer.echo(f"{name:<10} {path}")
    if not episode.metrics["success"]:
        raise typer.Exit(1)


def _execute(plan: Plan, seed: int) -> Episode:
    from d4orm_env import navigation_v0, verify
    from d4orm_planners.episode import run_episode
    from d4orm_planners.policy import OpenLoop

    env = navigation_v0.parallel_env(problem=plan.problem)
    episode = run_episode(env, OpenLoop(plan=plan), seed=seed)
    env.close()
    report = verify(plan.problem, plan.controls)
    rows = [
        *episode_rows(episode.metrics),
        ("verified", "yes" if report.ok else "no: " + "; ".join(str(violation) for violation in report.violations[:3])),
        ("closest approach", f"{report.min_separation * 100:.1f} cm between surfaces"),
    ]
    print_table("Executed in the environment", rows)
    return episode
