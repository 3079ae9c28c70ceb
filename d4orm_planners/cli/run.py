"""``d4orm run``: an episode of a plan or a policy in the environment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from d4orm_env.core.summary_line import count
from d4orm_env.disturbances.disturbance_registry import disturbances_at
from d4orm_env.render.replay import Replay
from d4orm_planners.base.episode import open_env, run_episode
from d4orm_planners.base.plan import Plan
from d4orm_planners.base.planner_registry import RECOMMENDED, make_policy
from d4orm_planners.base.policy import OpenLoop
from d4orm_planners.cli.arguments import check_target, names, refuse_options, single_levels
from d4orm_planners.cli.common_options import (
    Disturb,
    NoiseLevel,
    ObservationOptions,
    Physics,
    PictureOptions,
    ProblemOptions,
    takes,
)
from d4orm_planners.cli.outputs import episode_rows, print_table, require_success

if TYPE_CHECKING:
    from d4orm_env.core.problem import Problem
    from d4orm_env.disturbances.disturbance import AnyDisturbance
    from d4orm_planners.base.episode import Episode
    from d4orm_planners.base.policy import Policy


@dataclass(frozen=True, kw_only=True)
class RunOptions(PictureOptions, ObservationOptions, ProblemOptions):
    """Options on the policy and the environment."""

    plan_file: Annotated[Path | None, typer.Argument(help="Plan to execute; plans anew without one.")] = None
    policy: Annotated[
        str | None,
        typer.Option(
            "--policy",
            "-p",
            help="Planner, policy or package.module:Name.",
            show_default="the planner of make_planner()",
        ),
    ] = None
    preset: Annotated[str | None, typer.Option(help="Preset of the policy, as `paper`.")] = None
    control_noise_std: NoiseLevel = 0.0
    compare: Annotated[
        str | None,
        typer.Option(help="Several policies, separated by commas, on the same problem and seed."),
    ] = None
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Replay to write, .html.")] = None
    physics: Physics = "model"
    disturb: Disturb = None

    def disturbances(self) -> tuple[AnyDisturbance, ...]:
        """Return the disturbances."""
        return disturbances_at(single_levels(self.disturb))

    def execute(self, problem: Problem, policy: Policy, disturbances: Sequence[AnyDisturbance]) -> Episode:
        """An episode of a policy on a problem."""
        wrong = {"control_noise_std": self.control_noise_std, "disturbances": disturbances}
        env = open_env(problem, self.physics, policy, **wrong, **self.observation)
        episode = run_episode(env, policy, seed=self.seed)
        env.close()
        return episode

    def chosen(self) -> tuple[Problem, Policy]:
        """The problem, and what acts in it."""
        if self.plan_file is None:
            chosen = {} if self.preset is None else {"preset": self.preset}
            return self.problem(), make_policy(RECOMMENDED if self.policy is None else self.policy, **chosen)
        refuse_options(
            self.context,
            {"policy", "preset", "compare", *(field.name for field in fields(ProblemOptions) if field.name != "seed")},
            f"does not go with a plan file; {self.plan_file} has a problem and controls of its own",
        )
        plan = Plan.load(self.plan_file)
        return plan.problem, OpenLoop(plan=plan)


@takes(RunOptions)
def run(options: RunOptions) -> None:
    """Run a plan or a policy in the environment, step by step, and judge what happened."""
    options.check_pictures()
    check_target(options.out, (".html",))
    if options.compare is not None:
        compare(options, names(options.compare) or ())
        return
    disturbances = options.disturbances()
    problem, policy = options.chosen()
    episode = options.execute(problem, policy, disturbances)
    options.draw(problem, episode.trajectory, episode.marks)
    if options.out is not None:
        episode.to_html(options.out)
    if not options.quiet:
        print_table("Execution", episode_rows(episode))
        if options.out is not None:
            typer.echo(f"wrote {options.out}")
    require_success(episode, problem)


def compare(options: RunOptions, policies: Sequence[str]) -> None:
    """Run several policies on the same problem with the same seed, and write them side by side."""
    if options.out is None:
        raise ValueError("--compare needs --out, the replay to write, as --out compare.html")
    alone = {"policy", "preset", "picture", "animation", "plan_file"}
    refuse_options(options.context, alone, f"does not go with --compare {','.join(policies)}; run that policy alone")
    problem, makers = options.problem(), {name: make_policy(name) for name in policies}
    episodes = {}
    for name, policy in makers.items():
        episodes[name] = options.execute(problem, policy, options.disturbances())
        if not options.quiet:
            print_table(name, episode_rows(episodes[name]))
    title = f"{problem.name}, {count(problem.num_robots, 'robot')}"
    Replay(title, tuple(episode.motion(name) for name, episode in episodes.items())).save(options.out)
    if not options.quiet:
        typer.echo(f"wrote {options.out}")
