"""``d4orm demo``: a team planned, executed, verified and drawn."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from d4orm_env import make_problem, navigation_v0, verify
from d4orm_env.render import save_animation, save_picture
from d4orm_env.render.denoising_frames import save_denoising
from d4orm_env.render.replay import Replay
from d4orm_planners.base.episode import run_episode
from d4orm_planners.base.planner_registry import make_planner
from d4orm_planners.base.policy import OpenLoop
from d4orm_planners.cli.arguments import output_folder
from d4orm_planners.cli.common_options import Engine, Seed
from d4orm_planners.cli.outputs import episode_rows, print_plan, print_table, require_solved
from d4orm_planners.cli.plan_command import solving
from d4orm_planners.sampling.denoising import DenoisingFilm

if TYPE_CHECKING:
    from d4orm_planners.base.episode import Episode
    from d4orm_planners.base.plan import Plan


def demo(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder to write to.")] = Path("demo"),
    num_robots: Annotated[int, typer.Option("--num-robots", "--robots", "-k", help="Number of robots.")] = 16,
    seed: Seed = 0,
    engine: Engine = "auto",
    denoising: Annotated[
        bool, typer.Option("--denoising", help="Show how noise turns into a plan instead, on a circle.")
    ] = False,
) -> None:
    """Plan robots across a warehouse, execute the plan in the environment, verify it, and write pictures."""
    with output_folder(out):
        (show_denoising if denoising else show_warehouse)(out, num_robots, seed, engine)


def show_warehouse(out: Path, num_robots: int, seed: int, engine: str) -> None:
    """Plan for a team in a warehouse, execute the plan, verify it, and write the plan, pictures and a replay."""
    problem = make_problem("warehouse", num_robots=num_robots, seed=seed)
    planner = make_planner(engine=engine)
    with solving(planner, problem) as callback:
        plan = planner.solve(problem, seed, callback=callback)
    print_plan(plan)
    require_solved(plan)
    episode = run_episode(navigation_v0.parallel_env(problem=problem), OpenLoop(plan=plan), seed)
    report = verify(problem, plan.controls)
    outcome = "yes" if report.ok else "no: " + "; ".join(map(str, report.violations[:3]))
    rows = [("verified", outcome), ("closest approach", f"{report.min_separation * 100:.1f} cm between surfaces")]
    print_table("Executed in the environment", [*episode_rows(episode), *rows])
    _tell(_write(plan, episode, out))
    if not episode.metrics["success"]:
        raise typer.Exit(1)


def _write(plan: Plan, episode: Episode, out: Path) -> dict[str, Path]:
    """The plan, and its execution as picture, animation and replay."""
    problem, trajectory = plan.problem, episode.trajectory
    files = {
        "plan": out / "plan.npz",
        "picture": out / "plan.png",
        "animation": out / "execution.gif",
        "replay": out / "execution.html",
    }
    plan.save(files["plan"])
    title = f"{problem.num_robots} robots in a warehouse, planned in {plan.wall_time:.2f} s"
    save_picture(problem, trajectory, files["picture"], title=title)
    save_animation(problem, trajectory, files["animation"])
    episode.to_html(files["replay"])
    return files


def show_denoising(out: Path, num_robots: int, seed: int, engine: str) -> None:
    """Watch D4orm plan for a team on a circle, and write a picture and a replay of it."""
    problem = make_problem("circle", num_robots=num_robots, seed=seed)
    planner, film = make_planner("d4orm", engine=engine), DenoisingFilm(problem)
    with solving(planner, problem) as callback:
        plan = planner.solve(problem, seed, callback=callback, watcher=film)
    print_plan(plan)
    require_solved(plan)
    seen = film.developed()
    files = {"picture": out / "denoising.png", "replay": out / "denoising.html"}
    save_denoising(problem, seen, files["picture"])
    Replay(plan.title, (plan.motion(denoising=seen),)).save(files["replay"])
    _tell(files)


def _tell(files: dict[str, Path]) -> None:
    for name, path in files.items():
        typer.echo(f"{name:<10} {path}")
