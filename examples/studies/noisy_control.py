"""Closed loop against open loop: D4orm-C2F and a plan of D4orm-D, in the same world, under noise on the controls.

    python -m examples.studies.noisy_control --control-noise-std 0.5

The loop is written by hand: what a controller of your own has to do is ``reset(env)`` once and ``act`` at every step.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from examples.outputs import COLOURS, argument_parser, count, plt, save_figure, save_table

from d4orm_env import Problem, navigation_v0
from d4orm_env.envs.joint_state import split_state
from d4orm_planners import make_policy

POLICIES = {"hybrid": "open loop: the plan of the hybrid planner", "d4orm-c2f": "closed loop: D4orm-C2F"}


@dataclass(frozen=True)
class Execution:
    """Record of one episode of ``T`` steps."""

    positions: np.ndarray
    """``(T+1, K, d)`` [m]."""
    collided: np.ndarray
    """``(T+1, K)`` who touches something."""
    arrived: np.ndarray
    """``(K,)`` who has arrived at the end."""
    planning: float
    """Seconds before the first step."""
    loops: np.ndarray
    """``(T,)`` seconds to choose the controls of a step."""
    metrics: dict[str, float]
    """The environment's own."""


def execute(name: str, num_robots: int, noise: float, seed: int) -> Execution:
    """One episode on the circle."""
    env = navigation_v0.parallel_env(scenario="circle", num_robots=num_robots, control_noise_std=noise)
    policy = make_policy(name)
    observations, _ = env.reset(seed=seed)
    begin = time.perf_counter()
    policy.reset(env, seed=seed)
    planning, loops = time.perf_counter() - begin, []
    joints = [split_state(env.problem, env.state())]
    collided = [np.zeros(num_robots, bool)]
    while env.agents:
        begin = time.perf_counter()
        actions = policy.act({agent: observations[agent] for agent in env.agents}, env.state())
        loops.append(time.perf_counter() - begin)
        observations, _, _, _, infos = env.step(actions)
        joints.append(split_state(env.problem, env.state()))
        collided.append(np.array([infos.get(agent, {}).get("collided", False) for agent in env.possible_agents]))
    env.close()
    positions = np.stack([joint.states[:, : env.problem.dimension] for joint in joints])
    metrics = env.unwrapped.metrics()
    return Execution(positions, np.stack(collided), joints[-1].arrived, planning, np.array(loops), metrics)


def draw(problem: Problem, executions: dict[str, Execution], noise: float, out: Any) -> None:
    """The executions side by side: paths, where each robot is at the end, its goal, and where contacts begin."""
    figure, axes = plt.subplots(
        1, len(executions), figsize=(4.6 * len(executions), 5), sharey=True, layout="constrained"
    )
    colours = plt.get_cmap("turbo")(np.linspace(0.05, 0.95, problem.num_robots))
    points = np.concatenate([problem.goal, *(run.positions.reshape(-1, 2) for run in executions.values())])
    reach = min(float(np.abs(points).max()), 6.0) + 0.4
    for ax, (name, run) in zip(axes, executions.items()):
        for robot, colour in enumerate(colours):
            radius = float(problem.team.radius[robot])
            ax.plot(*run.positions[:, robot].T, color=colour, linewidth=1.2)
            ax.plot(*problem.goal[robot], "D", color=colour, fillstyle="none", markersize=9)
            face = colour if run.arrived[robot] else "white"
            ax.add_patch(plt.Circle(run.positions[-1, robot], radius, facecolor=face, edgecolor=colour, zorder=3))
        touching = run.positions[1:][run.collided[1:] & ~run.collided[:-1]]
        ax.plot(*touching.T, "*", color=COLOURS["mppi"], markersize=10, markeredgecolor="black", zorder=4)
        arrived, contacts = int(run.arrived.sum()), int(run.collided.any(axis=0).sum())
        ax.set_title(f"{POLICIES[name]}\n{arrived} of {problem.num_robots} arrive, {contacts} touch something")
        ax.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal", xlabel="x [m]")
    axes[0].set_ylabel("y [m]")
    marks: list[tuple[str, dict[str, Any]]] = [
        ("go-to-goal", {"marker": "D", "mfc": "none", "mec": "0.3", "ms": 8}),
        ("end, arrived", {"marker": "o", "mfc": "0.5", "mec": "0.3", "ms": 9}),
        ("end, not arrived", {"marker": "o", "mfc": "white", "mec": "0.3", "ms": 9}),
        ("contact begins", {"marker": "*", "mfc": COLOURS["mppi"], "mec": "black", "ms": 10}),
    ]
    handles = [plt.Line2D([], [], linestyle="none", label=label, **style) for label, style in marks]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
    figure.suptitle(f"{problem.num_robots} robots, noise of {noise:g} m/s² on accelerations up to 1 m/s²")
    save_figure(figure, out / "noisy_control.png")


def main() -> None:
    """Execute both, print what came of it, and draw them."""
    parser = argument_parser(__doc__)
    parser.add_argument("--num-robots", "--robots", type=count, default=8)
    parser.add_argument("--control-noise-std", "--noise", type=float, default=0.5, help="standard deviation [m/s^2]")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    num_robots = min(arguments.num_robots, 4) if arguments.quick else arguments.num_robots
    executions = {name: execute(name, num_robots, arguments.control_noise_std, arguments.seed) for name in POLICIES}
    rows = [
        {
            "policy": name,
            "arrived": f"{int(run.arrived.sum())} of {num_robots}",
            "touched something": int(run.metrics["collided"]),
            "success": bool(run.metrics["success"]),
            "travel time [s]": f"{run.metrics['travel_time']:.2f}",
            "before the first step [s]": f"{run.planning:.2f}",
            "loop, median [ms]": f"{1000 * np.median(run.loops):.1f}",
            "loop, 95th percentile [ms]": f"{1000 * np.percentile(run.loops, 95):.1f}",
        }
        for name, run in executions.items()
    ]
    save_table(rows, arguments.out / "noisy_control.csv")
    problem = navigation_v0.parallel_env(scenario="circle", num_robots=num_robots).problem
    draw(problem, executions, arguments.control_noise_std, arguments.out)


if __name__ == "__main__":
    main()
