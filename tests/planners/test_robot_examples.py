"""The examples of robots' own loops, run with stand-ins for the libraries that come with robots."""

from __future__ import annotations

import math
import runpy
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.distance import pdist

import d4orm_planners
from d4orm_planners.base.controller import Controller

EXAMPLE = Path(__file__).parents[2] / "examples" / "robots" / "drive_with_rclpy.py"
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
