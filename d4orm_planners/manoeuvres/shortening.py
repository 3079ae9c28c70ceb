"""Shorter motions of the same kind: some steps are left out, and the gap that this leaves at the goal is closed.

A search joins moves that turn, drive or stand, and a robot can do much of that at the same time. What is clear of
everything once the gap is closed is a motion like any other: as in db-CBS optimisation comes last.
"""

from __future__ import annotations

import numpy as np

from d4orm_env.core.arrays import FloatArray, Floats
from d4orm_env.dynamics.robot_model import Model
from d4orm_env.engine.caching import cached_kernel
from d4orm_env.engine.compiling import OPTIONS
from d4orm_planners.manoeuvres.closing import Ends, GapSpace, gap_closer
from d4orm_planners.manoeuvres.kinds import MAX_STEPS
from d4orm_planners.manoeuvres.nodes import Nodes, Task, arrives_after, is_sweep_free
from d4orm_planners.manoeuvres.primitives import POSE_SIZE
from d4orm_planners.manoeuvres.robots import Robot
from d4orm_planners.manoeuvres.search import Motion
from d4orm_planners.manoeuvres.traffic import NEVER, Traffic, meeting, safe_until

SHARE, TRIES, FAILURES = 1 / 8, 30, 6
"""Share of the steps that is left out at first, half as many after each failure and twice as many after a success;
and tries in all, and of single steps in a row that fail, after which a motion is short enough."""


@cached_kernel(**OPTIONS)
def steps_if_clear(task: Task, traffic: Traffic, nodes: Nodes, first: int, count: int) -> int:
    """Steps after which a robot has arrived that moves as ``nodes.swept`` says for so many; zero if it may not."""
    if task.goal.docks:
        count = min(count, arrives_after(task, nodes, count))
    if count <= first or not is_sweep_free(task.body, nodes.swept[first:], count - first, nodes.buffer):
        return 0
    if meeting(task.body, traffic, nodes.swept, first + 1, count, 0, nodes.buffer)[1] > 0:
        return 0
    stays = safe_until(task.body, traffic, count, nodes.swept[count], nodes.buffer) == NEVER
    return count if stays else 0


def shortened(
    robot: Robot, start: FloatArray, ends: Ends, motion: Motion, traffic: Traffic, nodes: Nodes,
    random: np.random.Generator,
) -> Motion:  # fmt: skip
    """A motion from a state that takes fewer steps, or the motion itself; it meets nobody if that does not."""
    controls, best, failures = motion.controls.astype(np.float64), motion, 0
    leave = int(SHARE * motion.steps)
    for _ in range(TRIES if motion.steps <= MAX_STEPS else 0):
        leave = max(1, min(leave, len(controls) - 1))
        if failures == FAILURES or len(controls) < 2:
            break
        first = int(random.integers(len(controls) - leave))
        fewer = np.concatenate([controls[:first], controls[first + leave :]])
        shorter = closed(robot, start, ends, fewer, first, traffic, nodes)
        if shorter is not None:
            controls, best = fewer[: shorter.steps], shorter
            leave, failures = 2 * leave, 0
        else:
            leave, failures = leave // 2, failures + (leave == 1)
    return best


def closed(
    robot: Robot, start: FloatArray, ends: Ends, controls: Floats, first: int, traffic: Traffic, nodes: Nodes
) -> Motion | None:
    """The motion from a state under controls ``(T, m)``, which are changed from a step on so that it ends at the goal;
    ``None`` if they cannot be, or it is not clear of everything.
    """
    model, steps = robot.model, 0
    space = GapSpace.of(len(controls), model.state_size, model.control_size)
    space.states[0] = start[: model.state_size]
    if gap_closer(model.name)(ends, controls, first, space):
        _write_poses(model, ends, space.states, nodes.swept)
        steps = steps_if_clear(robot.task, traffic, nodes, first, len(controls))
    if steps == 0:
        return None
    poses = nodes.swept[: steps + 1, :POSE_SIZE].astype(np.float32)
    return Motion(poses, controls[:steps].astype(np.float32), np.array([0, steps]))


def _write_poses(model: Model, ends: Ends, states: Floats, swept: Floats) -> None:
    """Write states ``(T + 1, n)`` as poses and speeds to the first rows of ``swept``."""
    rows, same = swept[: len(states)], 2 + (model.heading_index is not None)
    hitches = len(model.trailers)
    rows[:] = 0.0
    rows[:, :same], rows[:, 3 : 3 + hitches] = states[:, :same], states[:, 3 : 3 + hitches]
    moved = np.diff(states[:, :2], axis=0) / ends.h[0] if model.first_order else states[1:, list(model.speed_indices)]
    rows[1:, POSE_SIZE] = np.sqrt((moved**2).sum(axis=1))
