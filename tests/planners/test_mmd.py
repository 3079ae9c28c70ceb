"""MMD: its network, its guidance, its search over constraints, and what it plans."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from examples.studies.mmd_prior import draw_examples, modes_of
from hypothesis import given
from hypothesis import strategies as st
from planner_support import assert_solves, hop_problem, walled_in_problem

from d4orm_env.core.problem import Problem
from d4orm_env.core.team import Team
from d4orm_env.core.world import World
from d4orm_env.scenarios import make_problem
from d4orm_planners import make_planner
from d4orm_planners.baselines.mmd.motions import PathSurroundings, guide
from d4orm_planners.baselines.mmd.path_frame import (
    FEATURES,
    MODES,
    POINTS,
    PathFrame,
    make_frame,
    sine_table,
    world_space,
)
from d4orm_planners.baselines.mmd.planner import Constraint, MMDConfig, Planning, count_conflicts, first_conflict
from d4orm_planners.baselines.mmd.prior import (
    CLIP,
    LEVELS,
    SIZE,
    Denoiser,
    condition,
    drive_motions,
    kept_signal,
    level_features,
    load_prior,
    posterior,
    predict,
)

# The network.


def test_the_network_is_a_residual_perceptron() -> None:
    prior, random = load_prior(), np.random.default_rng(0)
    features = random.normal(size=(2, FEATURES)).astype(np.float32)
    noisy = random.normal(size=(6, SIZE)).astype(np.float32)
    level = random.uniform(size=LEVELS).astype(np.float32)
    context, clean = np.empty((2, len(prior.into_bias)), np.float32), np.empty((6, SIZE), np.float32)
    condition(prior, features, context)
    predict(prior, context, level, np.array([0.6, 0.8], np.float32), noisy, clean)
    whitened = ((features - prior.features_mean) / prior.features_deviation)[np.arange(6) % 2]
    given_ = np.hstack([noisy, np.tile(level, (6, 1))])
    layer = np.maximum(given_ @ prior.into + whitened @ prior.context + prior.into_bias, 0)
    for weights, bias in zip(prior.hidden, prior.hidden_bias, strict=True):
        layer = layer + np.maximum(layer @ weights + bias, 0)
    expected = 0.6 * noisy + 0.8 * (layer @ prior.out + prior.out_bias)
    np.testing.assert_allclose(clean, np.clip(expected, -CLIP, CLIP), atol=1e-4)


@pytest.mark.slow
def test_training_writes_what_the_planner_reads(tmp_path: Path) -> None:
    pytest.importorskip("torch")
    from examples.studies.mmd_prior import Examples, save_prior, train

    random = np.random.default_rng(0)
    # Motions that follow from what the network is told: only one that has learned comes near to them.
    features = random.normal(size=(300, FEATURES)).astype(np.float32)
    modes = np.tile(0.1 * np.sign(features[:, :1]), (1, SIZE)).reshape(-1, 2, MODES).astype(np.float32)
    losses: list[float] = []
    prior = train(
        Examples(features, modes), 201, seed=0, width=16, layers=1, progress=lambda _, loss: losses.append(loss)
    )
    assert losses[-1] < 0.8 * losses[0]
    save_prior(prior, tmp_path / "weights.npz")
    for kept, loaded in zip(prior, load_prior(tmp_path / "weights.npz"), strict=True):
        np.testing.assert_array_equal(kept, loaded)


def test_a_model_of_another_kind_is_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "empty.npz", deviation=np.ones(SIZE))
    with pytest.raises(ValueError, match=r"empty.npz has no features_mean; train it anew"):
        load_prior(tmp_path / "empty.npz")
    other = load_prior()._replace(context=np.ones((3, 4), np.float32))
    np.savez(tmp_path / "other.npz", **other._asdict())
    with pytest.raises(
        ValueError, match=rf"a model of {SIZE} modes and 3 features; it must be of {SIZE} and {FEATURES}"
    ):
        load_prior(tmp_path / "other.npz")


def test_what_comes_with_the_package_is_small() -> None:
    assert (
        Path(make_planner.__code__.co_filename).parents[1] / "baselines" / "mmd" / "weights.npz"
    ).stat().st_size < 5e6


@given(st.integers(1, 200))
def test_the_schedule_leads_from_noise_to_what_is_clean(steps: int) -> None:
    signal = kept_signal(steps)
    assert signal[0] == 1
    assert (np.diff(signal) < 0).all()
    assert 0 < signal[-1] < 0.01
    levels = level_features(signal)
    assert levels.shape == (steps + 1, LEVELS)
    # Between two hats both count.
    np.testing.assert_allclose(levels.sum(axis=1), 1, atol=1e-6)


@given(st.integers(2, 100), st.data())
def test_the_posterior_keeps_the_marginals(steps: int, data: st.DataObject) -> None:
    signal = kept_signal(steps)
    step = data.draw(st.integers(2, steps))
    now, then = signal[step], signal[step - 1]
    of_clean, of_noisy, deviation = posterior(now, then)
    assert of_clean + of_noisy * np.sqrt(now) == pytest.approx(np.sqrt(then))
    assert of_noisy**2 * (1 - now) + deviation**2 == pytest.approx(1 - then)


# The frame, and what is learned.


def frame_of(problem: Problem, robot: int = 0) -> PathFrame:
    frame = make_frame(problem, robot, world_space(problem), np.array([0.3, -0.5, 0.8]))
    assert frame is not None
    return frame


def lone_problem(model: str = "holonomic2d", world: World | None = None, **changes: Any) -> Problem:
    """One robot 4 m from its goal."""
    team = Team((model,))
    start, goal = np.zeros((1, team.state_size)), np.zeros((1, team.dimension))
    goal[0, 0] = 4.0
    return Problem(team, start, goal, world, **({"horizon": 100, "goal_speed": np.inf} | changes))


@pytest.mark.parametrize("model", ["holonomic2d", "holonomic3d"])
def test_the_frame_turns_with_the_problem(model: str) -> None:
    frame = frame_of(lone_problem(model))
    assert frame.length == pytest.approx(4)
    np.testing.assert_allclose(np.diff(frame.reference[:, 0]), 4 / POINTS)
    np.testing.assert_allclose(frame.tangents, np.tile([1, 0, 0], (POINTS + 1, 1)), atol=1e-12)
    np.testing.assert_allclose(frame.axes @ frame.tangents[0], 0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(frame.axes, axis=1), 1)
    np.testing.assert_allclose(frame.axes.sum(axis=0), 0, atol=1e-12)
    assert frame.quickest == pytest.approx(4.5)


def test_who_has_no_way_has_no_frame() -> None:
    problem = walled_in_problem()
    assert make_frame(problem, 0, world_space(problem), np.ones(3)) is None


def still(problem: Problem, count: int = 1) -> dict[str, Any]:
    """Arguments of a drive along motions that are the path itself."""
    return {
        "frame": frame_of(problem),
        "sines": sine_table(),
        "deviation": load_prior().deviation.astype(np.float64),
        "space": world_space(problem),
        "durations": np.full(count, 5.0),
        "motions": np.zeros((count, SIZE), np.float32),
    }


@pytest.mark.parametrize("model", ["holonomic2d", "holonomic3d", "velocity2d", "differential_drive"])
def test_a_drive_is_what_its_controls_lead_to(model: str) -> None:
    from d4orm_env import rollout

    problem = lone_problem(model, horizon=150)
    arguments = still(problem, 4)
    arguments["motions"] = np.random.default_rng(0).normal(size=(4, SIZE)).astype(np.float32)
    driven = drive_motions(problem, 0, **arguments)
    for b in range(4):
        trajectory = rollout(problem, driven.controls[b][:, None], engine="cpu")
        expected = trajectory.positions[:, 0]
        np.testing.assert_allclose(driven.positions[b, :, : problem.dimension], expected, atol=1e-4)
        assert trajectory.arrived[driven.arrivals[b], 0]
        assert not trajectory.arrived[driven.arrivals[b] - 1, 0]


def test_a_drive_takes_as_long_as_its_motion_and_no_less_than_its_dynamics() -> None:
    problem = lone_problem()
    arrivals = []
    for duration in (1.0, 5.0, 8.0):
        driven = drive_motions(problem, 0, **still(problem) | {"durations": np.full(1, duration)})
        arrivals.append(problem.dt * driven.arrivals[0])
    assert 4.3 < arrivals[0] < 5.0
    assert arrivals[1:] == pytest.approx([5.0, 8.0], abs=0.5)


def test_plans_are_learned_as_they_are_driven() -> None:
    features, modes = draw_examples(2, seed=3)
    assert features.shape == (2, FEATURES)
    # One is the mirror image of the other.
    np.testing.assert_array_equal(modes[0, 0], modes[1, 0])
    np.testing.assert_array_equal(modes[0, 1], -modes[1, 1])
    problem = lone_problem()
    frame, sines = frame_of(problem), sine_table()
    shape = np.zeros((2, MODES))
    shape[0, 0], shape[1, 1] = 0.03, 0.05
    positions = np.array(frame.reference)
    positions[:, 0] += 4 * (sines @ shape[0])
    positions[:, 1] += 4 * (sines @ shape[1])
    np.testing.assert_allclose(modes_of(frame, positions), shape, atol=2e-3)


# Guidance.


def surroundings(problem: Problem, **changes: Any) -> PathSurroundings:
    nothing = PathSurroundings(
        world_space(problem),
        0.2,
        problem.team.largest_radius,
        problem.dt,
        np.empty((0, 4)),
        np.empty((0, 2), np.int64),
        np.empty((0, 1, 3)),
        np.empty(0),
        0.5,
    )
    return nothing._replace(**changes)


def guided_positions(problem: Problem, steps: int = 10, **changes: Any) -> np.ndarray:
    arguments = still(problem)
    motions = arguments["motions"]
    guide(
        arguments["frame"],
        arguments["sines"],
        arguments["deviation"],
        surroundings(problem, **changes),
        arguments["durations"],
        steps,
        motions,
    )
    positions: np.ndarray = drive_motions(problem, 0, **arguments).positions[0]
    return positions


def test_constraints_are_kept_clear_of_at_their_time() -> None:
    problem = lone_problem()
    at = guided_positions(problem)[25]
    sphere, span = np.array([[at[0], 0.05, 0, 0.4]]), np.array([[20, 30]])
    assert abs(at[1]) < 1e-6
    gap = np.linalg.norm(guided_positions(problem, spheres=sphere, spans=span)[23:28] - sphere[0, :3], axis=1)
    assert gap.min() > 0.35
    untouched = guided_positions(problem, spheres=sphere, spans=np.array([[80, 90]]))
    np.testing.assert_array_equal(untouched, guided_positions(problem))


def test_other_robots_pull_as_much_as_they_are_told_to() -> None:
    problem = lone_problem()
    other = np.tile(guided_positions(problem)[None] + np.array([0, 0.05, 0]), (1, 1, 1))
    radii = np.array([0.4])
    np.testing.assert_array_equal(
        guided_positions(problem, others=other, radii=radii, pull=0.0), guided_positions(problem)
    )
    gaps = [
        np.linalg.norm(guided_positions(problem, 3, others=other, radii=radii, pull=pull)[25] - other[0, 25])
        for pull in (0.0, 0.1, 1.0)
    ]
    assert gaps[0] < gaps[1] < gaps[2]


def test_obstacles_are_left_on_the_side_of_the_way() -> None:
    # The path touches the box's corner; the motion is moved far into it.
    problem = lone_problem(world=World(boxes=[[1.5, 0.21, 2.5, 1.5]]))
    arguments = still(problem)
    arguments["motions"][0, MODES] = 0.5 / 4 / arguments["deviation"][MODES]
    inside = drive_motions(problem, 0, **arguments).clearances[0]
    rules = surroundings(problem, clearance=0.22)
    guide(
        *(arguments[name] for name in ("frame", "sines", "deviation")),
        rules,
        arguments["durations"],
        20,
        arguments["motions"],
    )
    assert inside < 0 < 0.18 < drive_motions(problem, 0, **arguments).clearances[0]


# The search.


def test_conflicts_are_counted_and_the_first_is_found() -> None:
    time = np.linspace(-1, 1, 21)
    right, left = (np.column_stack([sign * time, np.zeros(21), np.zeros(21)]) for sign in (1, -1))
    far = right + np.array([0, 5, 0])
    pairs, step, robots = first_conflict(np.stack([right, far, left]), np.full((3, 3), 0.45))
    assert (pairs, step, set(robots)) == (1, 8, {0, 2})
    assert first_conflict(np.stack([right, far]), np.full((2, 2), 0.45))[2] == (-1, -1)
    counts = count_conflicts(np.stack([right, far]), np.stack([left, far, far]), np.full(3, 0.45))
    np.testing.assert_array_equal(counts, [[1, 5], [2, 42]])


def planning_of(problem: Problem, **config: Any) -> Planning:
    settings = MMDConfig(**{"num_samples": 8, "num_steps": 5} | config)
    frames = tuple(frame_of(problem, robot) for robot in range(problem.num_robots))
    return Planning(problem, settings, Denoiser(problem, settings, lambda: False), frames, world_space(problem))


def test_a_conflict_has_two_children_with_a_constraint_each() -> None:
    problem = make_problem("circle", num_robots=2, horizon=100)
    planning = planning_of(problem)
    root = planning.root([1, 2])
    assert root.constraints == ((), ())
    crossing = replace(root, pair=(0, 1), step=30)
    children = planning.children(crossing, 1, [3, 4], 0)
    assert [child.number for child in children] == [1, 2]
    for robot, child in enumerate(children):
        (constraint,) = child.constraints[robot]
        assert isinstance(constraint, Constraint)
        middle = (root.motions[0].positions[30] + root.motions[1].positions[30]) / 2
        assert constraint.sphere == pytest.approx((*middle, 1.2 * 0.35), abs=5e-3)
        assert constraint.span[0] < 30 < constraint.span[1]
        assert child.constraints[1 - robot] == ()
        assert child.motions[1 - robot] is root.motions[1 - robot]
        assert child.motions[robot] is not root.motions[robot]


def test_without_a_conflict_who_fails_plans_anew() -> None:
    planning = planning_of(hop_problem(3))
    root = planning.root([1, 2, 3])
    assert root.pair == (-1, -1)
    assert root.conflicts == 0
    failing = replace(root, motions=(*root.motions[:2], replace(root.motions[2], fails=True)))
    for node, robot in ((root, 1), (failing, 2)):
        (child,) = planning.children(node, 5, [7, 8], 1)
        assert [a is b for a, b in zip(node.motions, child.motions, strict=True)].index(False) == robot


def test_planning_again_begins_with_what_was_planned() -> None:
    problem, frame = lone_problem(), frame_of(lone_problem())
    before = np.zeros((8, SIZE), np.float32)
    before[:, MODES] = 2.0  # far to the left
    found = {}
    for reuse in (3, None):
        denoiser = Denoiser(problem, MMDConfig(num_samples=8, reuse_steps=reuse), lambda: False)
        _, driven, steps = denoiser.denoise(0, frame, surroundings(problem), 2, before if reuse else None)
        found[steps] = driven.positions[:, 25, 1]
    # Every second motion is its neighbour's mirror image.
    assert abs(found[3][::2]).min() > 3 * abs(found[25]).mean()


# What it plans.


@pytest.mark.parametrize("model", ["holonomic2d", "velocity2d", "differential_drive"])
def test_a_circle_is_crossed(model: str) -> None:
    assert_solves("mmd", make_problem("circle", num_robots=4, model=model))


def test_in_space_there_is_room_on_all_sides() -> None:
    plan = assert_solves("mmd", make_problem("sphere", num_robots=6))
    assert np.abs(plan.trajectory.positions[:, :, 2]).max() > 0.1


@pytest.mark.parametrize("scenario", ["rooms", "warehouse", "forest"])
def test_paths_lead_round_obstacles(scenario: str) -> None:
    assert_solves("mmd", make_problem(scenario, num_robots=3, seed=0))


def test_who_may_not_dock_comes_to_its_goal_too() -> None:
    assert_solves("mmd", make_problem("circle", num_robots=2, arrival="stay", horizon=150))


def test_a_goal_out_of_reach_is_named() -> None:
    plan = make_planner("mmd", engine="cpu").solve(walled_in_problem(), max_iterations=2)
    assert plan.status == "iteration_limit"
    assert "robot_0 has no path" in plan.history[0].note
    assert not plan.trajectory.collided.any()


@pytest.mark.parametrize(
    ("setting", "value", "message"),
    [
        ("num_samples", 1, "num_samples is 1.*at least 2"),
        ("num_steps", 0, "num_steps is 0"),
        ("guide_from", 1.5, "guide_from is 1.5.*at most 1"),
        ("guide_steps", 0, "guide_steps is 0"),
        ("noise_scale", -1, "noise_scale is -1"),
        ("reuse_steps", 0, "reuse_steps is 0"),
        ("soft_pull", 2, "soft_pull is 2"),
        ("constraint_radius", 0.5, "constraint_radius is 0.5.*at least 1"),
        ("quickest", 0.5, "quickest is 0.5.*at least 1"),
        ("slowest", 1.05, "slowest is 1.05; it must be at least quickest, which is 1.1"),
        ("temperature", 0.3, "'temperature' is no setting of planner 'mmd'"),
    ],
)
def test_a_bad_setting_is_refused_by_name(setting: str, value: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_planner("mmd", **{setting: value})
