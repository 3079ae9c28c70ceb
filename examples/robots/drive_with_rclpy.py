"""A team driven by a controller inside a ROS 2 node; never run on robots by those who wrote it.

    source /opt/ros/jazzy/setup.bash
    python examples/robots/drive_with_rclpy.py

Robots are `/robot_0`, `/robot_1`, ... with `odom` in a frame that they share, and `cmd_vel`. It needs rclpy, which
comes with ROS 2; `d4orm serve` does the same without it. A robot that is silent for half a second stops all.
"""

from __future__ import annotations

import math
import time

import numpy as np
import rclpy
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from rclpy.node import Node

from d4orm_env import make_problem
from d4orm_planners import Controller

DEADLINE = 0.5


class Team(Node):
    def __init__(self) -> None:
        super().__init__("d4orm")
        self.problem = make_problem("circle", 6, robot="turtlebot3_burger", diameter=3.0, horizon=400)
        self.controller = Controller("d4orm-c2f", mode="measured", timeout=0.9 * self.problem.dt)  # the team has a lag
        self.states, self.heard = np.full(self.problem.start.shape, np.nan), np.full(6, -np.inf)
        self.begun, self.commands = False, [self.create_publisher(Twist, f"/robot_{k}/cmd_vel", 1) for k in range(6)]
        for k in range(6):
            self.create_subscription(Odometry, f"/robot_{k}/odom", lambda said, k=k: self.hear(k, said), 1)
        self.create_timer(self.problem.dt, self.drive)

    def hear(self, robot: int, said: Odometry) -> None:
        pose, turned = said.pose.pose.position, said.pose.pose.orientation
        heading = 2 * math.atan2(turned.z, turned.w)
        self.states[robot], self.heard[robot] = (pose.x, pose.y, heading, said.twist.twist.linear.x), time.monotonic()

    def drive(self) -> None:
        now, turn_rates, speeds = time.monotonic(), np.zeros(6), np.zeros(6)
        if now - self.heard.min() > DEADLINE:
            self.begun = False
        elif not self.begun:
            self.controller.begin(self.problem, self.states, now)  # robots stand meanwhile
            self.begun = True
        else:
            turn_rates, accelerations = self.controller.step(self.states, now).control.T
            fastest = self.problem.team.max_speed
            speeds = np.clip(self.states[:, 3] + self.problem.dt * accelerations, -fastest, fastest)
        for publisher, speed, turn_rate in zip(self.commands, speeds, turn_rates, strict=True):
            command = Twist()
            command.linear.x, command.angular.z = float(speed), float(turn_rate)
            publisher.publish(command)


if __name__ == "__main__":
    rclpy.init()
    rclpy.spin(Team())
