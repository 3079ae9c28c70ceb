"""Every setting of every planner and policy changes something: what it plans, what it does, or what it says of it."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import closing
from functools import cache
from importlib.util import find_spec
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from d4orm_env import navigation_v0
from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.disturbances import Dropout, LimitMismatch, Push, Stall, StateNoise
from d4orm_env.scenarios import make_problem
from d4orm_planners import SolveRun, make_planner, make_policy, run_episode
from d4orm_planners.base.names import PLANNERS, POLICIES
from d4orm_planners.engine.sampling_types import get_sampling_engine
from d4orm_planners.tracking.steering import straight_drives

TESTS = Path(__file__).parent

ELSEWHERE = {
    "timeout": ("test_distributed.py", "test_an_asynchronous_node_waits_once_for_one_that_is_silent"),
    "transport": ("test_distributed_ray.py", "test_rounds_over_ray"),
    "address": ("test_distributed_ray.py", "test_a_cluster_that_is_not_there_is_one_clear_error"),
    "node": ("test_network_faults.py", "test_of_two_nodes_with_one_number_the_second_is_refused"),
    "zenoh": ("test_network_faults.py", "test_a_partition_that_heals"),
}
"""Settings of D-D4orm that need other processes, a network or time, and the tests that show what they do."""


SMALL: dict[str, Any] = {
    "engine": "cpu",
    "num_samples": 32,
    "num_steps": 6,
    "max_iterations": 2,
    "improve": True,
    "reroute": False,
}
IPOPT: dict[str, Any] = {"engine": "cpu", "max_iterations": 1, "rounds": 1, "solver_iterations": 15, "improve": True}

REPAIRING: dict[str, Any] = {
    "start": "straight", "reroute": False, "max_iterations": 6, "repair_samples": 64, "repair_steps": 20,
}  # fmt: skip

JOINT: dict[str, Any] = {
    "decoupling": "joint", "start": "team", "first_collisions": False, "clip_between_iterations": False,
    "reroute": False, "max_iterations": 6, "num_samples": 32, "num_steps": 6, "improve": False,
}  # fmt: skip
TEAM: dict[str, Any] = {"start": "team", "num_samples": 128, "num_steps": 20}

CHANGES: dict[str, tuple[Any, dict[str, Any]]] = {
    "num_samples": (48, {}),
    "num_steps": (8, {}),
    "max_iterations": (3, {}),
    "credit": ("robot", {"credit": "team"}),
    "temperature": (0.6, {}),
    "weight_cutoff": (0.5, {}),
    "short_paths": (False, {"improve": False}),
    "final_approach": (False, {"decoupling": "groups", "improve": False}),
    "beta_start": (1e-3, {}),
    "beta_end": (5e-2, {}),
    "clip_between_iterations": (True, {"clip_between_iterations": False, "decoupling": "groups", "max_iterations": 3}),
    "late_steps": (0.2, {}),
    "late_samples": (1.0, TEAM),
    "random_start": (True, {}),
    "sigma": (0.5, {}),
    "importance": (0.5, {}),
    "elite_fraction": (0.3, {}),
    "adapt_variance": (True, {}),
    "sigma_floor": (0.9, {"adapt_variance": True}),
    "carry_variance": (True, {"adapt_variance": True}),
    "check_every": (3, {}),
    "penalty_per_pair": (True, {"max_iterations": 4, **TEAM}),
    "penalty_rise": (2.0, JOINT),
    "penalty_limit": (1.0, {**JOINT, "penalty": 1.0, "penalty_rise": 2.0}),
    "reset_after_probe": (True, JOINT),
    "clip_after": (1, {**JOINT, "improve": True, "num_samples": 8}),
    "improver": ("denoising", {"max_iterations": 12, "num_samples": 128, "num_steps": 20}),
    "big_team": (1, TEAM),
    "decoupling": ("groups", REPAIRING),
    "reroute": (True, REPAIRING),
    "start": ("straight", {"start": "team"}),
    "neighbours": (1, {"max_iterations": 4}),
    "replannings": (1, {"max_iterations": 12}),
    "first_collisions": (False, TEAM),
    "repair_samples": (16, REPAIRING),
    "repair_steps": (9, REPAIRING),
    "penalty": (0.5, {"max_iterations": 6, **TEAM}),
    "repair_penalty": (0.5, {"max_iterations": 6, "repair_samples": 64, "repair_steps": 20}),
    "planner": ("d4orm-d", {}),
    "nodes": (3, {}),
    "communication_range": (1.0, {"nodes": None, "max_iterations": 4}),
    "selection": ("max", {"nodes": 4, "k": 4, "max_iterations": 4}),
    "k": (1, {"nodes": 4, "max_iterations": 4}),
    "mode": ("async", {}),
    "perturbation": (0.2, {}),
    "lookout": (None, {}),
    "rounds": (3, {"solver_iterations": 300, "lookout": 0.0}),
    "clearance": (0.5, {}),
    "tolerance": (10.0, {"solver_iterations": 200}),
    "barrier": (1e-2, {}),
    "solver_iterations": (20, {}),
    "lookahead": (20, {}),
    "degree": (9, {}),
    "goal_steps": (10, {}),
    "goal_weight": (2.0, {}),
    "smoothness": (0.1, {}),
    "growth": (1.5, {}),
    "alternations": (5, {}),
    "guide_from": (1.0, {}),
    "guide_steps": (1, {}),
    "noise_scale": (1.0, {}),
    "reuse_steps": (2, {"max_iterations": 4}),
    "soft_pull": (0.1, {}),
    "constraint_radius": (1.5, {}),
    "quickest": (1.3, {}),
    "slowest": (2.0, {}),
}
"""By setting, another value, and the settings beside which it means something."""


INF = float("inf")


def crossing(num_robots: int = 4, num_obstacles: int = 0) -> Problem:
    """Robots that meet in the middle."""
    settings = {"diameter": 3.0, "horizon": 50, "num_obstacles": num_obstacles, "goal_speed": INF}
    return make_problem("circle", num_robots=num_robots, **settings)


def planner_settings() -> list[Any]:
    names = {name: PLANNERS[name].config_class.setting_names() for name in PLANNERS}
    names["d-d4orm"] = PLANNERS["d-d4orm"].config_class.setting_names({"planner": "d4orm-d"})
    return [pytest.param(name, setting, id=f"{name}-{setting}") for name in names for setting in names[name]]


def base_settings(name: str, setting: str) -> dict[str, Any]:
    base = {**(IPOPT if name == "ipopt" else SMALL), **CHANGES[setting][1]}
    if name == "d-d4orm" and setting not in PLANNERS[name].config_class.setting_names():
        base["planner"] = "d4orm-d"
    known = PLANNERS[name].config_class.setting_names(base)
    return {key: value for key, value in base.items() if key in known}


def outcomes(name: str, settings: dict[str, Any]) -> Generator[Any]:
    """What each iteration of a solve gives and says, but for its time, and at last who worked on it."""
    # The first plan of four robots that are guided is hard to make better, and the first batch holds one for them.
    crowd = {"mapf": (12,), "mmd": (8, 2)}.get(name, (4,))
    short = make_problem("circle", num_robots=2, diameter=0.8)  # all else are long
    search = SolveRun(make_planner(name, **settings), crossing(*crowd) if settings["improve"] else short, 1)
    try:
        for _ in range(settings["max_iterations"]):
            record = search.advance()
            yield search.current.planned.tobytes(), record.reward, record.note, record.denoising_steps, record.excluded
        pool = type(getattr(search.state, "pool", None))
    finally:
        search.close()
    yield pool, search.plan("stopped").metrics.get("messages")


@cache
def first_outcome(name: str, settings: tuple[tuple[str, Any], ...]) -> Any:
    """What the first iteration gives: most settings change that, and most of them beside the same others."""
    with closing(outcomes(name, dict(settings))) as those:
        return next(those)


def differ(name: str, settings: dict[str, Any], others: dict[str, Any]) -> bool:
    """Whether two solves differ; they end where they do."""
    one, other = (first_outcome(name, tuple(sorted(each.items()))) for each in (settings, others))
    if one != other:
        return True
    with closing(outcomes(name, settings)) as one, closing(outcomes(name, others)) as other:
        return any(first != second for first, second in zip_longest(one, other))


@pytest.mark.parametrize(("name", "setting"), planner_settings())
def test_every_setting_of_a_planner_changes_something(name: str, setting: str) -> None:
    if name == "ipopt" and find_spec("casadi") is None:
        pytest.skip("needs casadi")
    if setting in ELSEWHERE and name == "d-d4orm":
        file, test = ELSEWHERE[setting]
        assert f"def {test}(" in (TESTS / file).read_text()
    elif setting == "engine":
        engine = SolveRun(make_planner(name, engine="jax"), crossing(), 0).engine
        assert type(engine) is type(get_sampling_engine("jax"))
    elif setting == "improve":
        solution = straight_drives(lone()).controls[:, :, 0]
        for improve in (False, True):
            planner = make_planner(name, **base_settings(name, "max_iterations") | {"improve": improve})
            assert (planner.solve(lone(), initial_controls=solution).iterations > 0) == improve
    else:
        base = base_settings(name, setting)
        assert differ(name, base | {setting: CHANGES[setting][0]}, base)


def test_the_same_settings_have_the_same_outcome() -> None:
    """Or else the test above would see changes everywhere."""
    for name in PLANNERS:
        if name != "ipopt":
            base = base_settings(name, "num_samples")
            assert not differ(name, base, base)
    assert executed("d4orm-c2f", CONTROLLER) == unchanged("d4orm-c2f")


def lone() -> Problem:
    """One robot, whose straight path is a solution."""
    return make_problem("circle", num_robots=1, diameter=2.0, horizon=60)


def past_a_docked_robot(seed: int, num_robots: int, **settings: Any) -> Problem:
    """One that another stands in the way of, and others far away."""
    start = np.zeros((num_robots, 4))
    start[:, 0], start[0, :2] = np.arange(num_robots) * 3, [-1.5, 0.02]
    start[1, 0] = 0
    goal = start[:, :2].copy()
    goal[0, 0] = 1.5
    return Problem(Team(("holonomic2d",) * num_robots), start, goal, **settings)


CONTROLLER: dict[str, Any] = {
    "engine": "cpu", "refine": "off", "num_samples": 16, "num_steps": 4, "predict_horizon": 6, "coarse_samples": 16,
    "coarse_steps": 4, "coarse_repair_steps": 4, "coarse_iterations": 3, "subgoal_offset": 5,
}  # fmt: skip

POLICY_CHANGES: dict[str, dict[str, tuple[Any, dict[str, Any]]]] = {
    "d4orm-c2f": {
        "coarse_factor": (3, {}),
        "check_interval": (15, {"coarse_iterations": 10}),
        "coarse_samples": (24, {}),
        "coarse_steps": (6, {}),
        "coarse_repair_steps": (6, {}),
        "coarse_preset": ("paper", {}),
        "warm_start": ("go-to-goal", {}),
        "coarse_iterations": (1, {}),
        "max_lag": (0, {"max_cycles": 40}),
        "line_of_sight": (False, {"scenario": past_a_docked_robot, "subgoal_offset": 15}),
        "normalise_distance": (True, {}),
        "safe_mix": (False, {"scenario": "circle", "max_cycles": 60, "disturbances": [Push(3.0, 0.5)]}),
        "direct_final_approach": (False, {"scenario": "circle", "max_cycles": 80}),
        "expect_losses": (False, {"scenario": "circle", "max_cycles": 60, "disturbances": [Dropout(0.5)]}),
        "filter_states": (False, {"disturbances": [StateNoise(0.05, 0.05)], "max_cycles": 60}),
        "learn_limits": (False, {"disturbances": [LimitMismatch(0.6)]}),
        "stalls": (False, {"scenario": "circle", "max_cycles": 60, "disturbances": [Stall(1.0)]}),
        "last_resort": (False, {"disturbances": [Push(3.0, 0.5)], "max_cycles": 80}),
        "replan": (False, {"disturbances": [Push(3.0, 0.5)], "max_cycles": 80, "replan_distance": 1.0}),
        "replan_iterations": (1, {"replan_iterations": 5, "lifelong": True, "max_cycles": 80}),
        "predict_horizon": (9, {}),
        "execute_horizon": (2, {}),
        "subgoal_offset": (8, {}),
        "mean_of_all": (True, {"scenario": "random", "max_cycles": 80}),
        "num_samples": (24, {}),
        "num_steps": (6, {}),
        "temperature": (0.6, {}),
        "weight_cutoff": (0.5, {}),
        "beta_start": (1e-3, {}),
        "beta_end": (5e-2, {}),
        "credit": ("team", {}),
        "penalty": (0.5, {}),
        "extra_margin": (0.2, {}),
        "delay": (2, {}),
        "reaction_time": (1.0, {"disturbances": [Push(2.0, 0.3)]}),
        "refine": ("sync", {}),
        "refine_every": (2, {"refine": "sync"}),
        "replan_distance": (0.5, {}),
        "patience": (1, {"extra_margin": 0.8, "max_cycles": 40}),
        "deadline": (1e-6, {}),
        "control_noise_std": (0.1, {}),
    },
    "orca": {
        "time_horizon": (3.0, {}),
        "obstacle_time_horizon": (3.0, {"scenario": "four_obstacles"}),
        "neighbor_distance": (10.0, {}),
        "max_neighbors": (1, {}),
        "clearance": (0.2, {}),
        "shortest_paths": (False, {"scenario": "rooms"}),
        "deviation": (0.4, {}),
    },
    "ppo": {"detours": (False, {"scenario": past_a_docked_robot})},
    "sac": {"detours": (False, {"scenario": past_a_docked_robot})},
}


def policy_settings() -> list[Any]:
    names = {name: POLICIES[name].config_class for name in POLICIES}
    return [
        pytest.param(name, setting, id=f"{name}-{setting}")
        for name, config_class in names.items()
        if config_class is not None
        for setting in config_class.setting_names()
    ]


def executed(name: str, settings: dict[str, Any]) -> bytes:
    """What the team does by a policy."""
    own = {"lifelong": False, "max_cycles": 20, "scenario": None, "disturbances": ()}
    env = {key: settings.get(key, value) for key, value in own.items()}
    scenario = env.pop("scenario")
    problem = crossing() if scenario is None else make_problem(scenario, num_robots=4, horizon=50, goal_speed=INF)
    settings = {key: value for key, value in settings.items() if key not in own}
    return run_episode(
        navigation_v0.parallel_env(problem=problem, **env), make_policy(name, **settings), seed=0
    ).trajectory.controls.tobytes()


@cache
def unchanged(name: str) -> bytes:
    """What most settings are compared with."""
    return executed(name, CONTROLLER if name == "d4orm-c2f" else {})


@pytest.mark.parametrize(("name", "setting"), policy_settings())
@pytest.mark.slow
def test_every_setting_of_a_policy_changes_something(
    name: str, setting: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if name == "orca" and find_spec("pyrvo") is None:
        pytest.skip("needs pyrvo")
    if setting == "engine":
        asked: list[str] = []
        engine = get_sampling_engine("cpu")
        monkeypatch.setattr(
            "d4orm_planners.d4orm_c2f.receding_horizon.get_sampling_engine",
            lambda name, *_: asked.append(name) or engine,
        )
        make_policy(name, engine="jax")
        assert set(asked) == {"jax"}
    elif setting == "path":
        with pytest.raises(FileNotFoundError):
            make_policy(name, path=tmp_path / "none.safetensors")
    elif setting == "egocentric":  # tests of training have a file for it
        with pytest.raises(ValueError, match="egocentric"):
            make_policy(name, egocentric=True)
    else:
        value, beside = POLICY_CHANGES[name][setting]
        base = {**(CONTROLLER if name == "d4orm-c2f" else {}), **beside}
        assert executed(name, base | {setting: value}) != (executed(name, base) if beside else unchanged(name))
