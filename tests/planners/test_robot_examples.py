"""The examples of robots' own loops, run with stand-ins for the libraries that come with robots."""

from __future__ import annotations

import math
import runpy
import sys
import time
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.distance import pdist

import d4orm_planners
from d4orm_env import make_problem
from d4orm_planners.base.controller import Controller

EXAMPLE = Path(__file__).parents[2] / "examples" / "robots" / "drive_with_rclpy.py"
FLY = EXAMPLE.with_name("fly_crazyflies.py")
LAG, SUBSTEPS = 0.15, 10


class Node:
    """A node of rclpy, as far as the example needs one."""

    def __init__(self, name: str) -> None:
        self.said: dict[str, Any] = {}
        self.told: dict[str, Any] = {}

    def create_publisher(self, kind: Any, topic: str, depth: int) -> Any:
        return SimpleNamespace(publish=lambda message: self.said.__setitem__(topic, message))

    def create_subscription(self, kind: Any, topic: str, hear: Any, depth: int) -> None:
        self.told[topic] = hear

    def create_timer(self, period: float, call: Any) -> None:
        self.period, self.call = period, call


def twist() -> Any:
    return SimpleNamespace(linear=SimpleNamespace(x=0.0), angular=SimpleNamespace(z=0.0))


@pytest.fixture
def team(monkeypatch: pytest.MonkeyPatch) -> Any:
    for name, parts in {
        "rclpy": {}, "rclpy.node": {"Node": Node}, "geometry_msgs": {}, "geometry_msgs.msg": {"Twist": twist},
        "nav_msgs": {}, "nav_msgs.msg": {"Odometry": object},
    }.items():  # fmt: skip
        module = ModuleType(name)
        vars(module).update(parts)
        monkeypatch.setitem(sys.modules, name, module)
    # Without the timeout, so that nothing depends on how quick this machine is.
    monkeypatch.setattr(
        d4orm_planners, "Controller", lambda name, timeout, **settings: Controller(name, **settings), raising=False
    )
    clock = SimpleNamespace(now=100.0)
    team = runpy.run_path(str(EXAMPLE))["Team"]()
    monkeypatch.setitem(type(team).drive.__globals__, "time", SimpleNamespace(monotonic=lambda: clock.now))
    team.clock = clock
    return team


def odometry(x: float, y: float, heading: float, speed: float) -> Any:
    turned = SimpleNamespace(z=math.sin(heading / 2), w=math.cos(heading / 2))
    pose = SimpleNamespace(pose=SimpleNamespace(position=SimpleNamespace(x=x, y=y), orientation=turned))
    return SimpleNamespace(pose=pose, twist=SimpleNamespace(twist=SimpleNamespace(linear=SimpleNamespace(x=speed))))


@pytest.mark.slow
def test_robots_that_follow_the_rclpy_example_touch_nobody(team: Any) -> None:
    problem = team.problem
    states = np.pad(problem.start.astype(float), ((0, 0), (0, 1)))  # x, y, heading, speed, turn rate
    radius, nearest, fastest = float(problem.team.radius[0]), math.inf, 0.0
    for _ in range(problem.horizon):
        for robot, (x, y, heading, speed, _) in enumerate(states):
            team.told[f"/robot_{robot}/odom"](odometry(x, y, heading, speed))
        team.call()
        told = np.array([(said.linear.x, said.angular.z) for _, said in sorted(team.said.items())])
        fastest = max(fastest, np.abs(told[:, 0]).max())
        for _ in range(SUBSTEPS):
            h = team.period / SUBSTEPS
            states[:, 3:] += (1 - math.exp(-h / LAG)) * (told - states[:, 3:])
            states[:, 0] += h * states[:, 3] * np.cos(states[:, 2])
            states[:, 1] += h * states[:, 3] * np.sin(states[:, 2])
            states[:, 2] += h * states[:, 4]
            nearest = min(nearest, pdist(states[:, :2]).min() - 2 * radius)
        team.clock.now += team.period
    assert team.controller.arrived.all()
    assert fastest <= problem.team.max_speed.max()
    assert nearest > 0


class Drones:
    """cflib as far as the example needs it: what all drones were told, in order."""

    def __init__(self, takes: bool) -> None:
        self.told: list[tuple[Any, ...]] = []
        commander = SimpleNamespace(
            **{
                name: lambda *values, name=name: self.told.append((name, *values))
                for name in ("define_trajectory", "takeoff", "go_to", "start_trajectory", "land", "stop")
            }
        )
        memory = SimpleNamespace(trajectory=[], write_data_sync=lambda: takes)
        self.link = SimpleNamespace(
            cf=SimpleNamespace(
                high_level_commander=commander,
                mem=SimpleNamespace(get_mems=lambda kind: [memory]),
                supervisor=SimpleNamespace(send_arming_request=lambda on: self.told.append(("arm", on))),
                link_uri="radio://0",
            )
        )
        self.memory = memory

    def __call__(self, uris: set[str], factory: Any) -> Drones:
        self.uris = uris
        return self

    def __enter__(self) -> Drones:
        return self

    def __exit__(self, *_: object) -> None:
        self.told.append(("close",))

    def reset_estimators(self) -> None:
        self.told.append(("reset",))

    def parallel_safe(self, do: Any, arguments: Any = None) -> None:
        for uri in sorted(self.uris):
            do(self.link, *(arguments[uri] if arguments else ()))


def poly(*values: Any) -> Any:
    return SimpleNamespace(values=values)


@pytest.fixture
def flight(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    poly.Poly = list  # type: ignore[attr-defined]
    plan = d4orm_planners.make_planner("hybrid").solve(
        make_problem("circle", 2, robot="crazyflie", height=1.0, diameter=2.0), seed=0
    )
    plan.export("crazyswarm2", tmp_path / "flight")

    def fly(takes: bool = True) -> Drones:
        drones = Drones(takes)
        modules = {
            "cflib": {}, "cflib.crazyflie": {}, "cflib.crtp": {"init_drivers": lambda: None},
            "cflib.crazyflie.mem": {"MemoryElement": SimpleNamespace(TYPE_TRAJ=0), "Poly4D": poly},
            "cflib.crazyflie.swarm": {"CachedCfFactory": lambda rw_cache: None, "Swarm": drones},
        }  # fmt: skip
        for name, parts in modules.items():
            module = ModuleType(name)
            vars(module).update(parts)
            monkeypatch.setitem(sys.modules, name, module)
        sys.modules["cflib"].crtp = sys.modules["cflib.crtp"]  # type: ignore[attr-defined]
        monkeypatch.setattr(sys, "argv", ["fly", str(tmp_path / "flight"), "radio://1", "radio://2"])
        monkeypatch.setattr(time, "sleep", lambda seconds: drones.told.append(("wait", seconds)))
        try:
            runpy.run_path(str(FLY), run_name="__main__")
        except RuntimeError as error:
            drones.told.append((str(error),))
        return drones

    fly.start = plan.problem.start  # type: ignore[attr-defined]
    return fly


def test_drones_take_off_hover_fly_and_land(flight: Any) -> None:
    drones = flight()
    told = [entry for entry in drones.told if entry[0] != "wait"]
    order = ["reset", "define_trajectory", "arm", "takeoff", "go_to", "start_trajectory", "land", "stop", "close"]
    assert list(dict.fromkeys(name for name, *_ in told)) == order
    starts = [entry[1:4] for entry in told if entry[0] == "go_to"]
    np.testing.assert_allclose(starts, flight.start[:, :3], atol=1e-5)
    duration = sum(piece.values[0] for piece in drones.memory.trajectory)
    begun = max(number for number, entry in enumerate(drones.told) if entry[0] == "start_trajectory")
    assert drones.told[begun + 1] == ("wait", pytest.approx(duration + 2.0))


def test_no_drone_takes_off_where_one_took_no_trajectory(flight: Any) -> None:
    told = [name for name, *_ in flight(takes=False).told]
    assert not {"arm", "takeoff"} & set(told)
    assert told[-1] == "radio://0 took no trajectory; nobody takes off"
