"""The replays that the pages show, made anew for every build: nothing that is shown can be out of date."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from d4orm_env import make_problem, navigation_v0
from d4orm_env.render import Replay
from d4orm_planners import make_planner, make_policy, run_episode
from d4orm_planners.denoising import DenoisingFilm


def planned(scenario: str, planner: str = "d4orm-d", **arguments: object) -> Replay:
    """A plan."""
    problem = make_problem(scenario, **arguments)
    return make_planner(planner).solve(problem, seed=0).animate()


def denoised() -> Replay:
    """Noise that turns into ways."""
    problem = make_problem("circle", num_robots=16)
    film = DenoisingFilm(problem)
    plan = make_planner("d4orm").solve(problem, watcher=film)
    return Replay("From noise to sixteen ways", (plan.motion("d4orm", film.developed(60)),))


def compared(title: str, policies: dict[str, str], **options: object) -> Replay:
    """Policies side by side, on the same seed."""
    motions = []
    for label, policy in policies.items():
        env = navigation_v0.parallel_env(**options)
        motions.append(run_episode(env, make_policy(policy), seed=0).motion(label))
    return Replay(title, tuple(motions))


REPLAYS: dict[str, Callable[[], Replay]] = {
    "denoising": denoised,
    "warehouse": lambda: planned("warehouse", num_robots=16),
    "rooms": lambda: planned("rooms", num_robots=12),
    "maze": lambda: planned("maze", num_robots=8, planner="guided"),
    "forest": lambda: planned("forest", num_robots=12),
    "doorway": lambda: planned("doorway", num_robots=6),
    "sphere": lambda: planned("sphere", num_robots=12),
    "heterogeneous": lambda: planned("heterogeneous", num_robots=8),
    "hundred": lambda: planned("circle", num_robots=100, diameter=18),
    "policies": lambda: compared(
        "Four policies",
        {"d4orm-c2f": "d4orm-c2f", "orca": "orca", "d4orm, open loop": "d4orm", "straight ahead": "goal"},
        scenario="circle",
        num_robots=8,
    ),
    "noise": lambda: compared(
        "Execution noise: the plan and the controller",
        {"d4orm, open loop": "d4orm", "d4orm-c2f": "d4orm-c2f"},
        scenario="circle",
        num_robots=8,
        control_noise_std=0.4,
    ),
    "lifelong": lambda: compared(
        "Lifelong goals",
        {"d4orm-c2f": "d4orm-c2f"},
        scenario="circle",
        num_robots=8,
        lifelong=True,
        max_cycles=300,
    ),
}
"""By name."""


def write_replays(folder: Path) -> None:
    """Make all of them."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, make in REPLAYS.items():
        make().save(folder / f"{name}.html")
