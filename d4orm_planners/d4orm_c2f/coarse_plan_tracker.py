"""Tracking of the coarse plan: progress along it, replanning and refinement."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray, IntArray
from d4orm_env.core.problem import Problem
from d4orm_env.core.seeds import Stream, derived_seed
from d4orm_env.envs.joint_state import JointState
from d4orm_planners.base.policy_threads import Background
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.d4orm_c2f.coarse_plan import (
    BARRED_AFTER,
    STUCK_AFTER,
    WAITING_WITHIN,
    CoarsePlan,
    CoarsePlanning,
    CoarseWaypoints,
    StagnationMonitor,
    after_waiting,
    as_discs,
    coarse_problem,
    interpolate,
    keep_time,
    nearest_indices,
    rest_of,
    subgoal_indices,
    visible_subgoals,
)
from d4orm_planners.d4orm_c2f.settings import D4ormC2FConfig
from d4orm_planners.manoeuvres.robots import can_plan
from d4orm_planners.mapf.planner import relay_paths
from d4orm_planners.tracking.steering import straight_drives

NEARER = 1 / 3  #: Least progress towards the goals, all robots together, in radii of the largest one


class CoarsePlanTracker:
    """Leads a team through an episode of ``last_step`` steps, ``lifelong`` if robots that arrive get new goals.

    Plans are refined in the thread ``background`` and, where loops have a deadline, made anew in ``replanning``. Its
    ``problem`` has the limits that the robots are believed to have now.
    """

    guidance: CoarseWaypoints  #: Coarse plan that is followed at present
    index: int  #: Waypoint at which the team is
    rerouted: BoolArray  #: ``(K,)`` robots with a new path, until :meth:`fresh_start` has given them its controls
    stuck: BoolArray  #: ``(K,)`` robots that make no progress, or made none until recently

    def __init__(
        self,
        problem: Problem,
        config: D4ormC2FConfig,
        seed: int,
        background: Background[CoarsePlan],
        replanning: Background[CoarsePlan],
        lifelong: bool,
        last_step: int,
    ) -> None:
        self.problem, self._config, self._seed, self._lifelong = problem, config, seed, lifelong
        self._astray = config.replan_distance * problem.stride
        self._background, self._replanning = background, replanning
        self._late: tuple[JointState, BoolArray] | None = None
        self._planning = CoarsePlanning(config, seed, None if lifelong else last_step)

    def begin(self, joint: JointState, arrived: BoolArray) -> None:
        """Plan for the episode, in which those ``arrived`` ``(K,)`` stay where they are."""
        all_robots = np.ones(self.problem.num_robots, bool)
        self._stagnation, self.stuck = StagnationMonitor(joint), ~all_robots
        warm = self._planning.warm_start(self.problem, joint)
        self.guidance = self._planning.plan(self.problem, joint, arrived, warm, self._config.coarse_iterations)
        if self._config.replan and self._config.deadline is not None:
            self._prepare(joint)
        self.index = 0
        self._follow(joint, self._relayed(joint, all_robots) or self.guidance, all_robots)

    def _prepare(self, joint: JointState) -> None:
        """Load, or compile, what only thorough plans need: later that would hold up the control loops beside them."""
        coarse = coarse_problem(self.problem.with_state(joint.states, joint.goals), self._config.coarse_factor)
        thorough = self._planning.thorough
        thorough.init(SolveRun(thorough, coarse, self._seed, judged=self._planning.judged))

    def _follow(self, joint: JointState, guidance: CoarseWaypoints, rerouted: BoolArray) -> None:
        """Begin a new guidance, in which robots ``rerouted`` ``(K,)`` have new paths."""
        self.rerouted = rerouted
        self.guidance = guidance
        self.index, self._indices = 0, np.zeros(len(joint.goals), int)
        self._goals, self._began = joint.goals, joint.steps
        self._nearest, self._nearest_at = float("inf"), joint.steps

    def subgoals(self, joint: JointState, arrived: BoolArray) -> IntArray:
        """``(K,)`` waypoints that the robots head for; finds out where on the path they are (Algorithm 4, line 6)."""
        path, offset = self.guidance.path, self._config.subgoal_offset
        positions = joint.states[:, : self.problem.dimension]
        nearest = nearest_indices(path, positions, self._indices, offset)
        self._indices = after_waiting(path, nearest, self._indices, self._config.execute_horizon)
        counted = np.ones_like(arrived) if self._config.mean_of_all else ~arrived & ~self.stuck
        if counted.any():
            self.index = round(float(self._indices[counted].mean()))
        lag = len(path) if self._config.max_lag is None else self._config.max_lag
        targets = subgoal_indices(self._indices, self.index, offset, lag, len(path) - 1)
        if not self._config.line_of_sight:
            return targets
        walls = self.guidance.ordered
        return visible_subgoals(self.problem, positions, path, self._indices, targets, arrived, walls)

    def followed(self, joint: JointState, horizon: int) -> FloatArray:
        """``(horizon, K, m)`` controls that take every robot along its path, from where on it it is."""
        return keep_time(self.problem, joint, self.guidance.path, self._indices, horizon)

    def timed(self, joint: JointState, horizon: int) -> FloatArray:
        """``(horizon, K, m)`` controls that take every robot along its path in the team's time."""
        return keep_time(self.problem, joint, self.guidance.path, self._clock(), horizon)

    def _clock(self) -> IntArray:
        """``(K,)`` waypoints at which the robots should be now: the team's, or not far from where they are."""
        clock = np.full_like(self._indices, self.index)
        return clock if self._config.max_lag is None else np.minimum(clock, self._indices + self._config.max_lag)

    def fresh_start(self, base: FloatArray) -> None:
        """Begin ``base`` ``(H_predict, K, m)`` of robots with new paths with the coarse plan's controls."""
        if self.rerouted.any() and isinstance(self.guidance, CoarsePlan):
            # A coarse control is held for all its fine steps.
            held = np.repeat(self.guidance.controls, self._config.coarse_factor, axis=0)[: len(base)]
            base[:, self.rerouted] = 0
            base[: len(held), self.rerouted] = held[:, self.rerouted]
            self.rerouted = np.zeros_like(self.rerouted)

    def replan_if_needed(self, joint: JointState, arrived: BoolArray) -> bool:
        """Replan for robots with new goals or stuck, and for a team that has lost the guidance or is at its end.

        With a deadline a thread of its own does that: the team goes on with the old plan until then.
        """
        if self._late is not None:
            done, late = self._replanning.result()
            if late is not None:
                (begun, rerouted), self._late = self._late, None
                self._follow(joint._replace(goals=begun.goals), late, rerouted)
            return done
        changed = (joint.goals != self._goals).any(axis=1)
        moving = ~arrived
        held_up, lost = np.zeros_like(arrived), False
        if self._config.replan:
            held_up = moving & self._idle_for_long(joint, arrived)
            lost = bool(moving.any()) and self._is_lost(joint, moving)
        if not moving.any():
            return False
        if self._config.replan:
            changed |= moving & (self._away(joint) > self._astray)
        if not (changed | held_up).any() and not lost:
            return False
        changed |= held_up
        keep = moving & ~changed
        relayed = self._relayed(joint, ~keep | lost) or self._relayed(joint, np.ones_like(keep))
        if relayed is not None:
            self._follow(joint, relayed, changed)
            return True
        thorough = lost or bool(held_up.any())
        iterations = self._config.coarse_iterations if thorough else self._config.replan_iterations
        initial = self._beginning(joint, keep & (not lost))
        work = partial(self._planning.plan, self.problem, joint, arrived, initial, iterations, thorough)
        rerouted = ~keep | lost
        if self._config.deadline is None:
            self._follow(joint, work(), rerouted)
            return True
        self._replanning.start(work)
        self._late = joint, rerouted
        return False

    def _idle_for_long(self, joint: JointState, arrived: BoolArray) -> BoolArray:
        """``(K,)`` robots without progress for so long that they need another path; also updates :attr:`stuck`."""
        idle, self.stuck = self._stagnation.observe(joint.steps, self._indices, self._waiting(joint))
        barred = self._barred(joint, arrived, idle > BARRED_AFTER)
        return np.minimum(idle, joint.steps - self._began) > np.where(barred, BARRED_AFTER, STUCK_AFTER)

    def _relayed(self, joint: JointState, changed: BoolArray) -> CoarseWaypoints | None:
        """Paths on the roadmap for robots ``changed`` ``(K,)``, around all others, in lifelong mode; else ``None``."""
        if not (self._lifelong and self.guidance.ordered):
            return None
        factor, seed = self._config.coarse_factor, derived_seed(self._seed, Stream.COARSE_PLAN, joint.steps)
        present = coarse_problem(self.problem.with_state(joint.states, joint.goals), factor)
        paths = relay_paths(present, self.guidance.path[self.index :: factor], changed, seed)
        return None if paths is None else CoarseWaypoints(path=interpolate(paths, factor), ordered=True)

    def _beginning(self, joint: JointState, keep: BoolArray) -> FloatArray | None:
        """``(H_c, K, m)`` straight drives, and for robots that ``keep`` ``(K,)`` drives along their paths.

        ``None`` among walls, where the paths of the whole team are found anew on the roadmap, and for manoeuvres.
        """
        if self.guidance.ordered or not isinstance(self.guidance, CoarsePlan):
            return None
        factor = self._config.coarse_factor
        present = coarse_problem(self.problem.with_state(joint.states, joint.goals), factor)
        if can_plan(present) and as_discs(present) is None:
            return None
        initial = straight_drives(present).controls[:, :, 0]
        if keep.any():
            paths = self.guidance.path[::factor]
            along = keep_time(present, joint, paths, self._clock() // factor, present.horizon)
            initial[:, keep] = along[:, keep]
        return initial

    def _barred(self, joint: JointState, arrived: BoolArray, asked: BoolArray) -> BoolArray:
        """``(K,)`` those ``asked`` whose next waypoints, up to the subgoal, lie within robots at rest for good."""
        robots, barred = np.flatnonzero(asked & ~arrived), np.zeros_like(arrived)
        path, ahead = self.guidance.path, np.arange(self._config.subgoal_offset + 1)
        waypoints = path[np.minimum(self._indices[robots] + ahead[:, None], len(path) - 1), robots]
        team, resting = self.problem.team, joint.states[arrived, : self.problem.dimension]
        waypoints, resting = (team.flattened(at, 0.0) for at in (waypoints, resting))
        away, radius = np.linalg.norm(waypoints[:, :, None] - resting, axis=3), np.asarray(team.girth)
        barred[robots] = (away < radius[robots, None] + radius[arrived]).any(axis=(0, 2))
        return barred

    def _waiting(self, joint: JointState) -> BoolArray:
        """``(K,)`` robots that are on time, or ahead of the team, and so have to wait."""
        due = self.guidance.path[min(self.index, len(self.guidance.path) - 1)]
        away = np.linalg.norm(joint.states[:, : self.problem.dimension] - due, axis=1)
        return (away < WAITING_WITHIN * self.problem.team.largest_radius) | (self._indices > self.index)

    def _is_lost(self, joint: JointState, moving: BoolArray) -> bool:
        """Check whether the robots under way are far from their waypoints, at the end of the path, or get no nearer."""
        positions = joint.states[:, : self.problem.dimension]
        distance = float(np.linalg.norm((joint.goals - positions)[moving], axis=1).sum())
        if distance < self._nearest - NEARER * self.problem.team.largest_radius:
            self._nearest, self._nearest_at = distance, joint.steps
        return bool(
            self._away(joint)[moving].mean() > self._astray
            or self.index >= len(self.guidance.path) - 1
            or joint.steps - self._nearest_at > self._config.patience
        )

    def _away(self, joint: JointState) -> FloatArray:
        """``(K,)`` distances of the robots from their waypoints [m]."""
        positions = joint.states[:, : self.problem.dimension]
        return np.linalg.norm(positions - self.guidance.path[self._indices, np.arange(len(positions))], axis=1)

    def refine(self, step: int, due: bool) -> bool:
        """Accept a finished refinement, and begin another if that is ``due``; whether one was accepted."""
        index = self.index + self._config.subgoal_offset
        guidance, over = self.guidance, index >= len(self.guidance.path) - 1
        refine = self._config.refine or ("sync" if self._config.deadline is None else "background")
        if refine == "off" or over or not isinstance(guidance, CoarsePlan):
            return False
        seed = derived_seed(self._seed, Stream.REFINEMENT, step)
        if refine == "sync":
            if due:
                self.guidance = self._refined(guidance, index, seed)
            return self.guidance is not guidance
        done, refined = self._background.result()
        # What was refined may have been replanned since.
        if refined is not None and refined.problem is guidance.problem:
            self.guidance = guidance = refined
        if done and due and self._late is None:
            self._background.start(lambda: self._refined(guidance, index, seed))
        return self.guidance is refined

    def _refined(self, guidance: CoarsePlan, index: int, seed: int) -> CoarsePlan:
        """The guidance, improved from a waypoint on if that succeeds (line 4)."""
        left, controls = rest_of(guidance, index, self._config.coarse_factor)
        search = SolveRun(self._planning.planner, left, seed, controls, judged=self._planning.judged)
        search.advance()
        done = guidance.problem.horizon - left.horizon
        before, after = guidance.states[: done + 1], search.best.trajectory
        states = np.concatenate([before, after.states[1:]])
        positions = np.concatenate([before[..., : left.dimension], after.positions[1:]])
        all_controls = np.concatenate([guidance.controls[:done], after.controls])
        path = interpolate(positions, self._config.coarse_factor)
        return replace(guidance, controls=all_controls, states=states, path=path)
