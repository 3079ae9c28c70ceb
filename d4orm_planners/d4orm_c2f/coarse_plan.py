"""The coarse guidance of D4orm-C2F: a path planned for the whole team, and each robot's waypoint and subgoal on it.

Paper, section VI, Algorithm 4, lines 1 to 3 and 7.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray, IntArray
from d4orm_env.core.problem import Problem
from d4orm_env.core.seeds import Stream, derived_seed
from d4orm_env.envs.joint_state import JointState
from d4orm_planners.base.candidate import Candidate
from d4orm_planners.base.episode import open_env, run_episode
from d4orm_planners.base.planner import Planner
from d4orm_planners.base.planner_registry import make_policy
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.d4orm_c2f.settings import D4ormC2FConfig
from d4orm_planners.d4orm_d.planner import D4ormD, D4ormDConfig
from d4orm_planners.hybrid.planner import Hybrid, HybridConfig
from d4orm_planners.mapf.planner import RoadmapSolution
from d4orm_planners.tracking.tracker import follow_reference


@dataclass(frozen=True, eq=False, kw_only=True)
class CoarseWaypoints:
    """Path that a team follows."""

    path: FloatArray  #: ``(H+1, K, d)`` waypoints, one per time step of the control loop [m]
    ordered: bool  #: Whether the path was found on a roadmap, where precedence decides


@dataclass(frozen=True, eq=False, kw_only=True)
class CoarsePlan(CoarseWaypoints):
    """A coarse plan and the path made from it."""

    problem: Problem  #: The coarse problem: larger time steps from where the plan begins
    controls: FloatArray  #: ``(H_c, K, m)`` of the coarse plan
    states: FloatArray  #: ``(H_c+1, K, n)``


def coarse_problem(problem: Problem, factor: int) -> Problem:
    """The problem with steps ``factor`` times as long and as many fewer of them (paper, Algorithm 4, line 1)."""
    return problem.with_state(
        problem.start,
        problem.goal,
        horizon=max(-(-problem.horizon // factor), 1),
        dt=problem.dt * factor,
        goal_speed=problem.goal_speed * np.float32(factor),
    )


def interpolate(path: FloatArray, factor: int) -> FloatArray:
    """``(factor * H_c + 1, K, d)`` evenly spaced waypoints, of which every ``factor``-th is one of a coarse path
    ``(H_c+1, K, d)`` (paper, Algorithm 4, line 3).
    """
    share = (np.arange(factor, dtype=path.dtype) / factor)[None, :, None, None]
    between = path[:-1, None] * (1 - share) + path[1:, None] * share
    return np.concatenate([between.reshape(-1, *path.shape[1:]), path[-1:]])


def nearest_indices(path: FloatArray, positions: FloatArray, last: IntArray, window: int) -> IntArray:
    """``(K,)`` indices of the waypoints on ``path`` ``(H+1, K, d)`` nearest to robots at ``positions`` ``(K, d)``.

    As a path may cross itself, only ``window`` waypoints are searched, from those found ``last`` ``(K,)`` on.
    """
    index = np.minimum(np.asarray(last)[:, None] + np.arange(window + 1), len(path) - 1)
    ahead = path[index, np.arange(len(index))[:, None]]
    return index[:, 0] + ((ahead - positions[:, None]) ** 2).sum(axis=2).argmin(axis=1)


def after_waiting(path: FloatArray, indices: IntArray, last: IntArray, steps: int) -> IntArray:
    """``(K,)`` indices, later by up to so many ``steps`` where a path waits and its robot is where it was ``last``.

    All waypoints of a wait are as near: a robot that kept to the first would wait for ever, and so would those whose
    subgoals stay behind for it.
    """
    robots, here, passed = np.arange(len(indices)), path[indices, np.arange(len(indices))], indices
    waits = (indices == last) & ~_coincide(here, path[-1])
    for _ in range(steps):
        after = np.minimum(passed + 1, len(path) - 1)
        passed = np.where(waits & _coincide(here, path[after, robots]), after, passed)
    return passed


def _coincide(positions: FloatArray, others: FloatArray) -> BoolArray:
    """``(K,)`` bool: positions ``(K, d)`` that are the same but for rounding."""
    return (np.abs(positions - others) <= 1e-6 * np.abs(others)).all(axis=1)


def subgoal_indices(indices: IntArray, mean: int, offset: int, lag: int, last: int) -> IntArray:
    """``(K,)`` the waypoint, at most the ``last``, that every robot heads for (paper, Algorithm 4, line 7).

    The paper's is the same for all robots: the ``mean`` of their ``indices`` ``(K,)`` and an ``offset``. A robot that
    lags by more than ``lag`` waypoints would then leave its path, straight into obstacles that the path avoids; its
    subgoal stays behind with it instead.
    """
    return np.minimum(np.minimum(mean, indices + lag) + offset, last)


def rest_of(guidance: CoarsePlan, index: int, factor: int) -> tuple[Problem, FloatArray]:
    """The coarse problem that is left from a waypoint on, and the controls of the coarse plan for it."""
    step = min(-(-index // factor), len(guidance.controls) - 1)
    coarse = guidance.problem
    left = coarse.with_state(guidance.states[step], coarse.goal, horizon=coarse.horizon - step)
    return left, guidance.controls[step:]


LEAST = 5  #: Least number of waypoints that a subgoal is ahead: nearer ones hardly attract
_SHARES = np.linspace(0, 1, 9)[1:]  #: Shares of the straight line at which its clearance from obstacles is looked at


def visible_subgoals(
    problem: Problem, positions: FloatArray, path: FloatArray, indices: IntArray, targets: IntArray, arrived: BoolArray,
    walls: bool,
) -> IntArray:  # fmt: skip
    """``(K,)`` the furthest waypoint up to its subgoal that each robot can drive to straight, past all that is at rest.

    A robot would get stuck on its way to a subgoal behind a corner, or behind a robot that has arrived.

    Args:
        problem: The problem.
        positions: ``(K, d)`` of the robots [m].
        path: ``(H+1, K, d)`` waypoints [m].
        indices: ``(K,)`` the robots' own.
        targets: ``(K,)`` their subgoals.
        arrived: ``(K,)`` robots at rest.
        walls: Whether obstacles count too.
    """
    team, resting = problem.team, np.flatnonzero(arrived)
    radius, wall_radius = np.asarray(team.girth), np.asarray(team.wall_radius)
    flat, flat_path = (team.flattened(at, problem.margin) for at in (positions, path))
    result = targets.copy()
    waiting = np.flatnonzero(~arrived & (targets > indices + LEAST))
    while len(waiting):
        offset = flat_path[result[waiting], waiting] - flat[waiting]
        width = radius[waiting] + problem.margin / 2
        blocked = _meets_resting(flat[waiting], offset, width, flat[resting], radius[resting])
        if walls:
            offset = path[result[waiting], waiting] - positions[waiting]
            width = wall_radius[waiting] + problem.margin / 2
            points = positions[waiting] + _SHARES[:, None, None] * offset
            clearance = problem.world.clearance(points.reshape(-1, points.shape[-1])).reshape(points.shape[:-1])
            blocked |= (clearance <= width).any(axis=0)
        waiting = waiting[blocked]
        result[waiting] -= 1
        waiting = waiting[result[waiting] > indices[waiting] + LEAST]
    return result


def _meets_resting(
    begin: FloatArray, offset: FloatArray, width: FloatArray, others: FloatArray, radius: FloatArray
) -> BoolArray:
    """``(N,)`` whether a straight path from ``begin`` by ``offset``, so wide to either side, meets another robot."""
    gap = others - begin[:, None]
    square = (offset**2).sum(axis=1)[:, None]
    share = np.clip((gap * offset[:, None]).sum(axis=2) / np.where(square > 0, square, 1), 0, 1)
    away = ((gap - share[:, :, None] * offset[:, None]) ** 2).sum(axis=2)
    return (away <= (width[:, None] + radius) ** 2).any(axis=1)


STUCK_WITHIN, STUCK_AFTER = 3, 25  #: Waypoints that a robot must pass in so many time steps, or else is stuck
BARRED_AFTER = 8  #: The same number of steps for robots whose paths lead through others at rest for good
WAITING_WITHIN = 1.0  #: Distance from its present waypoint within which a robot waits, in radii of the largest one
CAREFUL_FOR = 30  #: Steps for which a robot that was stuck follows its path
CATCHING_UP = 2.0  #: Share of its lag that a robot makes up for in a second [1/s]


class StagnationMonitor:
    """Detects robots that make no progress along their paths, from their first state on."""

    def __init__(self, joint: JointState) -> None:
        self._indices = np.zeros(len(joint.goals), int)
        self._since = np.full(len(joint.goals), joint.steps)
        self._careful_until = np.full(len(joint.goals), joint.steps)

    def observe(self, step: int, indices: IntArray, waiting: BoolArray) -> tuple[IntArray, BoolArray]:
        """``(K,)`` steps without progress, and ``(K,)`` robots that are stuck or were so recently.

        At this ``step`` they are at waypoints ``indices`` ``(K,)``, lower ones than before being of another path;
        those ``waiting`` ``(K,)`` are on time, or ahead.
        """
        moved = (indices >= self._indices + STUCK_WITHIN) | (indices < self._indices) | waiting
        self._indices[moved], self._since[moved] = indices[moved], step
        idle = step - self._since
        self._careful_until[idle > STUCK_AFTER] = step + CAREFUL_FOR
        return idle, self._careful_until > step


def keep_time(problem: Problem, joint: JointState, path: FloatArray, indices: IntArray, horizon: int) -> FloatArray:
    """``(horizon, K, m)`` controls that take every robot along its path in the path's own time, as if it had no goal.

    Of ``path`` ``(H+1, K, d)``, which has a waypoint per time step of the problem [m], they should be at ``indices``
    ``(K,)`` now; from elsewhere they catch up.
    """
    due = path[np.minimum(indices + np.arange(horizon + 1)[:, None], len(path) - 1), np.arange(len(indices))]
    return follow_reference(problem, joint.states, due[:-1], np.diff(due, axis=0) / problem.dt, CATCHING_UP)


class CoarsePlanning:
    """Plans for the team of an episode, which ends after ``last_step`` steps, or goes on after arrivals (``None``).

    Plans that are not ``judged`` need not pass ``verify()``, which takes most of the time of cars and delays loops.
    """

    def __init__(self, config: D4ormC2FConfig, seed: int, last_step: int | None) -> None:
        self._config, self._seed, self._last_step, self.judged = config, seed, last_step, config.deadline is None
        # Fine plans cannot keep to paths between others to the centimetre. If a team is stuck there may be no others.
        self.planner, self.thorough = (_coarse_planner(config, reroute=reroute) for reroute in (False, True))

    def warm_start(self, problem: Problem, joint: JointState) -> FloatArray | None:
        """``(H_c, K, m)`` controls of a policy's episode from here, if the coarse plan is to begin with these.

        ValueError if there is no such policy, or it cannot drive there; ImportError if its library is missing.
        """
        if self._config.warm_start is None:
            return None
        coarse = coarse_problem(problem.with_state(joint.states, joint.goals), self._config.coarse_factor)
        policy = make_policy(self._config.warm_start)
        seed = derived_seed(self._seed, Stream.COARSE_PLAN, joint.steps)
        return run_episode(open_env(coarse, policy=policy), policy, seed).controls

    def plan(
        self,
        problem: Problem,
        joint: JointState,
        arrived: BoolArray,
        initial: FloatArray | None,
        iterations: int,
        thorough: bool = False,
    ) -> CoarsePlan:
        """Plan for the whole team from where it is, until a plan passes the checks."""
        # A robot that has arrived at the rim of its goal could leave it within a coarse step.
        goals = np.where(arrived[:, None], joint.states[:, : problem.dimension], joint.goals)
        coarse = coarse_problem(problem.with_state(joint.states, goals), self._config.coarse_factor)
        seed = derived_seed(self._seed, Stream.COARSE_PLAN, joint.steps)
        planner = self.thorough if thorough else self.planner
        search = partial(self._searched, planner=planner, seed=seed, initial=initial, iterations=iterations)
        chosen, guidance = _discs_first(search, coarse)
        last = joint.steps if self._last_step is None else self._last_step
        left = (last - joint.steps) // self._config.coarse_factor
        if 0 < left < coarse.horizon and not chosen.failed.any() and not chosen.trajectory.arrived[left].all():
            # It would come too late. Plans that come too late are none, if there are others.
            hurried, other = _discs_first(search, coarse.with_state(coarse.start, coarse.goal, horizon=left))
            if not hurried.failed.any():
                return other
        return guidance

    def _searched(
        self, coarse: Problem, planner: Planner, seed: int, initial: FloatArray | None, iterations: int
    ) -> tuple[Candidate, CoarsePlan]:
        """The first plan that passes the checks, or the best one."""
        start = None if initial is None else initial[: coarse.horizon]
        search = SolveRun(planner, coarse, seed, start, check_interval=self._config.check_interval, judged=self.judged)
        chosen, ordered = search.current, False
        for number in range(iterations):
            if not chosen.failed.any():
                break
            search.advance()
            if number == 0:
                ordered = isinstance(search.state, RoadmapSolution)
            accepted = not search.current.failed.any() or search.current.rank >= search.best.rank
            chosen = search.current if accepted else search.best
        plan = chosen.trajectory
        path = interpolate(plan.positions, self._config.coarse_factor)
        guidance = CoarsePlan(problem=coarse, controls=plan.controls, states=plan.states, path=path, ordered=ordered)
        return chosen, guidance


def _discs_first(
    search: Callable[[Problem], tuple[Candidate, CoarsePlan]], coarse: Problem
) -> tuple[Candidate, CoarsePlan]:
    """A plan for the discs round the robots, who then move all at once; where there is none, for them themselves.

    Footprints and goal headings are planned one after another (:mod:`d4orm_planners.manoeuvres`), and the last ones
    come late.
    """
    if (discs := as_discs(coarse)) is not None:
        chosen, plan = search(discs)
        if not chosen.failed.any():
            return chosen, plan
    return search(coarse)


def as_discs(problem: Problem) -> Problem | None:
    """The problem for the discs round footprints, without the headings of robots that can turn when they are there.

    ``None`` where that is the same problem, or leaves out more.
    """
    team, headed = problem.team, ~np.isnan(problem.goal_heading)
    turn_later = not (headed & (team.turning_radius > 0)).any()
    if team.dimension != 2 or not (team.shapes or headed.any()) or not turn_later:
        return None
    if any(model.trailers for model in team.robot_models):
        return None
    anywhere = np.full_like(problem.goal_heading, np.nan)
    return problem.with_state(problem.start, problem.goal, team=team.replace(radius=team.radius), goal_heading=anywhere)


def _coarse_planner(config: D4ormC2FConfig, reroute: bool) -> Planner:
    """The planner of coarse plans: hybrid, with or without rerouting, or D4orm-D with its preset."""
    given: dict[str, Any] = {
        "engine": config.engine,
        "num_samples": config.coarse_samples,
        "num_steps": config.coarse_steps,
        "repair_steps": config.coarse_repair_steps,
        "improve": True,
    }
    if config.coarse_preset is None:
        return Hybrid(HybridConfig(**given, reroute=reroute, improver="denoising"))
    return D4ormD(D4ormDConfig(**{**D4ormD.presets[config.coarse_preset], **given}))
