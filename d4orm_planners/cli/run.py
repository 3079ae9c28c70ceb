"""``d4orm run``, ``play`` and ``demo``: episodes of plans and policies, live in a browser, and drawn."""

from __future__ import annotations

import os
import sys
import threading
import webbrowser
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import rich
import typer
from typer import Argument, Option

from d4orm_env import make_problem, navigation_v0, verify
from d4orm_env.core.lazy import LazyModule
from d4orm_env.core.problem import Problem
from d4orm_env.core.summary_line import count
from d4orm_env.disturbances.disturbance import AnyDisturbance
from d4orm_env.disturbances.disturbance_registry import disturbances_at
from d4orm_env.render import save_animation, save_picture
from d4orm_env.render.replay import Replay, save_denoising
from d4orm_planners.base.episode import Episode, open_env, run_episode
from d4orm_planners.base.plan import Plan
from d4orm_planners.base.planner_registry import RECOMMENDED, make_planner, make_policy
from d4orm_planners.base.policy import OpenLoop, Policy
from d4orm_planners.cli import on_signals
from d4orm_planners.cli.options import (
    Disturb,
    Engine,
    NoiseLevel,
    ObservationOptions,
    Physics,
    ProblemOptions,
    Seed,
    names,
    policies_by_label,
    refuse_options,
    single_levels,
    takes,
)
from d4orm_planners.cli.outputs import (
    PictureOptions,
    check_target,
    episode_rows,
    output_folder,
    print_plan,
    print_table,
    require_solved,
    require_success,
    tell_written,
)
from d4orm_planners.cli.plan_command import read_plan, solving
from d4orm_planners.sampling.denoising import DenoisingFilm

if TYPE_CHECKING:
    from d4orm_planners.play.playground import Playground

playgrounds: Any = LazyModule("d4orm_planners.play.playground", "d4orm play", "viz")
LAST_WAIT = 2.0  #: Seconds from Ctrl-C of ``d4orm play`` to the end of the process


@dataclass(frozen=True, kw_only=True)
class RunOptions(PictureOptions, ObservationOptions, ProblemOptions):
    """Options on the policy and the environment."""

    plan_file: Annotated[Path | None, Argument(help="Plan to execute; plans anew without one.")] = None
    policy: Annotated[
        str | None,
        Option(
            "--policy",
            "-p",
            help="Planner, policy or package.module:Name, with settings behind a colon: ppo:path=mine.zip.",
            show_default="the planner of make_planner()",
        ),
    ] = None
    preset: Annotated[str | None, Option(help="Preset of the policy, as `paper`.")] = None
    control_noise_std: NoiseLevel = 0.0
    compare: Annotated[
        list[str] | None,
        Option(help="Policies on the same problem and seed, as of `d4orm evaluate --policy`; repeatable."),
    ] = None
    out: Annotated[Path | None, Option("--out", "-o", help="Replay to write, .html.")] = None
    physics: Physics = "model"
    disturb: Disturb = None

    def disturbances(self) -> tuple[AnyDisturbance, ...]:
        return disturbances_at(single_levels(self.disturb))

    def execute(self, problem: Problem, policy: Policy, disturbances: Sequence[AnyDisturbance]) -> Episode:
        wrong = {"control_noise_std": self.control_noise_std, "disturbances": disturbances}
        env = open_env(problem, self.physics, policy, **wrong, **self.observation)
        episode = run_episode(env, policy, seed=self.seed)
        env.close()
        return episode

    def chosen(self) -> tuple[Problem, Policy]:
        if self.plan_file is None:
            named = policies_by_label([RECOMMENDED if self.policy is None else self.policy])
            if len(named) > 1:
                raise ValueError(f"--policy {self.policy!r} names several; give one, or all of them to --compare")
            ((label, settings),) = named.items()
            if self.preset is not None and settings.setdefault("preset", self.preset) != self.preset:
                raise ValueError(f"--preset {self.preset} and {label!r} name two presets; give one")
            return self.problem(), _made(label, settings)
        registering = self.scenario if ":" in self.scenario else None
        taken = {"seed"} if registering is None else {"seed", "scenario"}
        refuse_options(
            self.context,
            {"policy", "preset", "compare", *(field.name for field in fields(ProblemOptions))} - taken,
            f"does not go with a plan file; {self.plan_file} has a problem and controls of its own",
        )
        plan = read_plan(self.plan_file, registering)
        return plan.problem, OpenLoop(plan=plan)


def _made(label: str, settings: Mapping[str, object]) -> Policy:
    own = {name: value for name, value in settings.items() if name != "policy"}
    return make_policy(str(settings.get("policy", label)), **own)


@takes(RunOptions)
def run(options: RunOptions) -> None:
    """Run a plan or a policy in the environment, step by step, and judge what happened."""
    options.check_pictures()
    check_target(options.out, (".html",))
    if options.compare is not None:
        compare(options, options.compare)
        return
    disturbances = options.disturbances()
    problem, policy = options.chosen()
    episode = options.execute(problem, policy, disturbances)
    options.draw(problem, episode.trajectory, episode.events)
    if options.out is not None:
        episode.to_html(options.out)
    if not options.quiet:
        print_table("Execution", episode_rows(episode))
        tell_written(options.out, options.picture, options.animation)
    if isinstance(policy, OpenLoop) and policy.plan is not None:
        require_solved(policy.plan)
    require_success(episode, problem)


def compare(options: RunOptions, texts: list[str]) -> None:
    """Run several policies on the same problem with the same seed, and write them side by side."""
    if options.out is None:
        raise ValueError("--compare needs --out, the replay to write, as --out compare.html")
    alone = {"policy", "preset", "picture", "animation", "plan_file"}
    refuse_options(options.context, alone, f"does not go with --compare {','.join(texts)}; run that policy alone")
    problem, chosen = options.problem(), policies_by_label(texts, "--compare")
    makers = {label: _made(label, settings) for label, settings in chosen.items()}
    episodes = {}
    for name, policy in makers.items():
        episodes[name] = options.execute(problem, policy, options.disturbances())
        if not options.quiet:
            print_table(name, episode_rows(episodes[name]))
    title = f"{problem.name}, {count(problem.num_robots, 'robot')}"
    Replay(title, tuple(episode.motion(name) for name, episode in episodes.items())).save(options.out)
    tell_written(options.out, quiet=options.quiet)


@dataclass(frozen=True, kw_only=True)
class PlayOptions(ObservationOptions, ProblemOptions):
    """Options on the first scene, and on the page's address."""

    policy: Annotated[
        str, Option("--policy", "-p", help="What drives (see `d4orm planners`); several, separated by commas.")
    ] = "d4orm-c2f"
    host: Annotated[str, Option(help="Where to be found; elsewhere than here the address has a token.")] = "127.0.0.1"
    port: Annotated[int, Option(help="Port; any free one by default.")] = 0
    open_browser: Annotated[bool, Option("--open/--no-open", help="Open a browser if there is one.")] = True


@takes(PlayOptions)
def play(options: PlayOptions) -> None:
    """Look at a team live in a browser, and meddle with it; needs the extra viz."""
    # Some libraries, while they are loaded, swallow what a signal raises.
    with on_signals(lambda *_: os._exit(130)):
        playground = _playground(options)
    try:
        typer.echo(f"open {playground.address}\nCtrl-C ends it")
        if options.open_browser and has_display():
            webbrowser.open(playground.address)
        playground.run()
    except KeyboardInterrupt:
        # Python waits for threads of planners, which may be in the middle of a plan.
        watchdog = threading.Timer(LAST_WAIT, os._exit, (130,))
        watchdog.daemon = True
        watchdog.start()
        raise
    finally:
        playground.close()


def _playground(options: PlayOptions) -> Playground:
    make = playgrounds.Playground  # which says first if a library is missing
    rich.get_console().quiet = True  # or viser prints a line for every client of another version
    typer.echo("getting ready; the first time this compiles for a while ...")
    policies = names(options.policy) or ()
    return make(
        options.problem(), *policies, seed=options.seed, host=options.host, port=options.port, **options.observation
    )


def has_display() -> bool:
    """Check whether a browser would have something to draw on."""
    return sys.platform in ("darwin", "win32") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def demo(
    out: Annotated[Path, Option("--out", "-o", help="Folder to write to.")] = Path("demo"),
    num_robots: Annotated[int, Option("--num-robots", "--robots", "-k", help="Number of robots.")] = 16,
    seed: Seed = 0,
    engine: Engine = "auto",
    denoising: Annotated[bool, Option("--denoising", help="Show noise becoming a plan instead, on a circle.")] = False,
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
