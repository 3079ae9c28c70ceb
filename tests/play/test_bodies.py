"""The bodies of a team as the playground draws them: their shapes, where they lie, and the poses that goals ask for."""

from __future__ import annotations

import numpy as np
import pytest

from d4orm_env import Problem, Team, make_problem
from d4orm_env.footprints import Box, Capsule, Train

pytest.importorskip("trimesh")
from d4orm_planners.play.meshes import body_groups, body_positions, goal_poses, heading_lines, in_space

TRAIN = Train(Box(0.5, 0.25, 0.1), [Box(0.4, 0.2)])
TEAM = Team(("car_with_1_trailer", "unicycle", "unicycle"), footprint=[TRAIN, Capsule(0.4, 0.1), Capsule(0.4, 0.1)])
START = [[0, 0, np.pi / 2, np.pi / 4], [2, 0, 0, 0], [2, 2, np.pi, 0]]
PROBLEM = Problem(TEAM, START, [[0, 4], [4, 0], [-2, 2]], goal_heading=[np.pi / 2, np.nan, np.nan])


def test_bodies_of_one_shape_are_one_group() -> None:
    groups = body_groups(PROBLEM)
    assert [(group.bodies.tolist(), group.robots.tolist()) for group in groups] == [
        ([0], [0]),
        ([1, 2], [1, 2]),
        ([3], [0]),
    ]
    sizes = [np.ptp(group.mesh.vertices, axis=0)[:2] for group in groups]
    np.testing.assert_allclose(sizes, [[0.5, 0.25], [0.6, 0.2], [0.4, 0.2]], atol=1e-6)
    wider = [np.ptp(group.margin[0].vertices, axis=0)[:2] for group in groups]
    np.testing.assert_allclose(np.subtract(wider, sizes), 2 * PROBLEM.margin, atol=1e-3)
    (discs,) = body_groups(make_problem("circle", num_robots=3))
    np.testing.assert_allclose(discs.scales[:, 0], 0.15)


def test_bodies_lie_as_the_states_say() -> None:
    positions = in_space(PROBLEM.start[:, :2]) + np.float32(0.5)
    shown, turns = body_positions(PROBLEM, PROBLEM.start, positions)
    np.testing.assert_allclose(shown[:3], positions)
    # The trailer lags by 45 degrees, half a metre behind.
    np.testing.assert_allclose(shown[3, :2], 0.5 - 0.5 * np.sqrt(0.5) * np.ones(2), atol=1e-5)
    np.testing.assert_allclose(2 * np.arctan2(turns[:, 3], turns[:, 0]), [np.pi / 2, 0, np.pi, np.pi / 4], atol=1e-5)


def test_goals_show_the_pose_that_they_ask_for() -> None:
    lines, owners = goal_poses(PROBLEM, in_space(PROBLEM.goal))
    assert set(owners.tolist()) == {0}
    np.testing.assert_allclose(lines[..., 0].min(), -0.125, atol=1e-6)
    np.testing.assert_allclose([lines[..., 1].min(), lines[..., 1].max()], [4 - 0.15, 4 + 0.35], atol=1e-6)
    assert not len(goal_poses(make_problem("circle", num_robots=2), np.zeros((2, 3), np.float32))[0])
    ahead = heading_lines(PROBLEM, PROBLEM.start, in_space(PROBLEM.start[:, :2]))
    np.testing.assert_allclose(np.linalg.norm(np.diff(ahead, axis=1), axis=2)[:, 0], [0.35, 0.3, 0.3], atol=1e-6)
