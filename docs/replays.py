"""The replays that the pages show, made anew when the code was changed: nothing that is shown can be out of date."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path

from d4orm_env import make_problem, navigation_v0
from d4orm_env.disturbances import Delay, Intruder, Push, StateNoise
from d4orm_env.render import Replay
from d4orm_planners import make_planner, make_policy, run_episode
from d4orm_planners.sampling.denoising import DenoisingFilm


def planned(scenario: str, planner: str = "hybrid", **arguments: object) -> Replay:
    """A plan."""
    problem = make_problem(scenario, **arguments)
    return make_planner(planner).solve(problem, seed=0).animate()


def denoised() -> Replay:
    """Noise that turns into trajectories."""
    problem = make_problem("circle", num_robots=16)
    film = DenoisingFilm(problem)
    plan = make_planner("d4orm").solve(problem, watcher=film)
    return Replay("From noise to sixteen trajectories", (plan.motion("d4orm", film.developed(60)),))


def compared(title: str, policies: dict[str, str], **options: object) -> Replay:
    """Policies side by side, on the same seed."""
    return episodes(title, {label: {"policy": policy} for label, policy in policies.items()}, **options)


def episodes(title: str, cases: dict[str, dict[str, object]], **options: object) -> Replay:
    """Episodes side by side, on the same seed, each with a policy or further arguments of the environment."""
    motions = []
    for label, case in cases.items():
        arguments = {"policy": "d4orm-c2f", **options, **case}
        policy = make_policy(arguments.pop("policy"))
        motions.append(run_episode(navigation_v0.parallel_env(**arguments), policy, seed=0).motion(label))
    return Replay(title, tuple(motions))


def planned_by(title: str, planners: dict[str, dict[str, object]], scenario: str, **arguments: object) -> Replay:
    """The same problem by several planners, each with its settings."""
    problem, motions = make_problem(scenario, **arguments), []
    for name, settings in planners.items():
        label = ", ".join([name, *(f"{key}={value}" for key, value in settings.items())])
        motions.append(make_planner(name, **settings).solve(problem, seed=0).motion(label))
    return Replay(title, tuple(motions))


REPLAYS: dict[str, Callable[[], Replay]] = {
    "denoising": denoised,
    "warehouse": lambda: planned("warehouse", num_robots=16),
    "rooms": lambda: planned("rooms", num_robots=12),
    "maze": lambda: planned("maze", num_robots=8, planner="mapf"),
    "forest": lambda: planned("forest", num_robots=12),
    "doorway": lambda: planned("doorway", num_robots=6),
    "sphere": lambda: planned("sphere", num_robots=12),
    "heterogeneous": lambda: planned("heterogeneous", num_robots=8),
    "hundred": lambda: planned("circle", num_robots=100, diameter=18),
    "policies": lambda: compared(
        "Four policies",
        {"d4orm-c2f": "d4orm-c2f", "orca": "orca", "d4orm, open loop": "d4orm", "straight ahead": "go-to-goal"},
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
    "disturbances": lambda: compared(
        "Pushes, intruders, delays and noise in what is seen",
        {"d4orm, open loop": "d4orm", "d4orm-c2f": "d4orm-c2f", "orca": "orca"},
        scenario="circle",
        num_robots=8,
        disturbances=[Delay(1), Push(0.2, 0.3), Intruder(2), StateNoise(0.02, 0.02)],
    ),
    "rivals": lambda: planned_by(
        "The same eight robots by the rivals",
        {"d4orm": {}, "mppi": {}, "cem": {}, "mbd": {"num_steps": 1000}, "i-mbd": {}},
        scenario="circle",
        num_robots=8,
    ),
    "nodes": lambda: planned_by("Nodes that exchange candidates", {"d-d4orm": {}}, "circle", num_robots=16),
    "amswarm": lambda: planned_by("AMSwarm", {"amswarm": {}, "hybrid": {}}, "amswarm_3"),
    "ipopt": lambda: planned_by("Direct collocation", {"ipopt": {}}, "circle", num_robots=4),
    "instances": lambda: episodes(
        "Other instances of one scenario",
        {"seed 1": {"seed": 1}, "seed 2": {"seed": 2}, "seed 3": {"seed": 3}},
        scenario="random",
        num_robots=8,
        randomize_instance=False,
    ),
    "models": lambda: episodes(
        "Other robots in one scenario",
        {name: {"model": name} for name in ("holonomic2d", "differential_drive")},
        scenario="circle",
        num_robots=6,
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


ROOT = Path(__file__).resolve().parents[1]


def code_digest() -> str:
    """SHA-256 of all that a replay is made by: both packages and this file."""
    files = [path for package in ("d4orm_env", "d4orm_planners") for path in (ROOT / package).rglob("*")]
    digest = hashlib.sha256()
    for path in sorted([Path(__file__).resolve(), *files]):
        if path.is_file() and "__pycache__" not in path.parts:
            digest.update(str(path.relative_to(ROOT)).encode() + path.read_bytes())
    return digest.hexdigest()


def write_replays(folder: Path) -> None:
    """Make all of them, unless they are those of this code."""
    mark, digest = folder.parent / "replays.sha256", code_digest()
    if mark.is_file() and mark.read_text() == digest:
        return
    mark.unlink(missing_ok=True)
    folder.mkdir(parents=True, exist_ok=True)
    for name, make in REPLAYS.items():
        make().save(folder / f"{name}.html")
    mark.write_text(digest)
