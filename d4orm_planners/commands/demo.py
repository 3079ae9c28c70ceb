"""``d4orm demo``: a team planned, executed, verified and drawn."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from d4orm_planners.commands.inputs import make_folder
from d4orm_planners.commands.options import Engine, Seed
from d4orm_planners.commands.outputs import episode_rows, print_plan, print_table, require_solved
from d4orm_planners.commands.plan import solving
from d4orm_planners.commands.run import execute


def demo(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder to write to.")] = Path("demo"),
    num_robots: Annotated[int, typer.Option("--num-robots", "--robots", "-k", help="Number of robots.")] = 16,
    seed: Seed = 0,
    engine: Engine = "auto",
) -> None:
    """Plan robots across a circle, execute the plan in the environment, verify it, and write pictures."""
    from d4orm_env import make_problem, verify
    from d4orm_env.render import save_animation, save_picture
    from d4orm_planners.policy import OpenLoop
    from d4orm_planners.registry import make_planner

    make_folder(out)
    problem = make_problem("circle", num_robots=num_robots, seed=seed)
    planner = make_planner("d4orm", engine=engine)
    with solving(planner, problem) as callback:
        plan = planner.solve(problem, seed, callback=callback)
    print_plan(plan)
    require_solved(plan)
    episode = execute(problem, OpenLoop(plan=plan), seed)
    report = verify(problem, plan.controls)
    verdict = "yes" if report.ok else "no: " + "; ".join(map(str, report.violations[:3]))
    rows = [("verified", verdict), ("closest approach", f"{report.min_separation * 100:.1f} cm between surfaces")]
    print_table("Executed in the environment", [*episode_rows(episode), *rows])
    files = {"plan": out / "plan.npz", "picture": out / "plan.png", "animation": out / "execution.gif"}
    plan.save(files["plan"])
    title = f"{problem.num_robots} robots, planned by D4orm in {plan.wall_time:.2f} s"
    save_picture(problem, episode.trajectory, files["picture"], title=title)
    save_animation(problem, episode.trajectory, files["animation"])
    for name, path in files.items():
        typer.echo(f"{name:<10} {path}")
    if not episode.metrics["success"]:
        raise typer.Exit(1)
