"""Coarse plans for a whole team from wherever it is (Algorithm 4, lines 1 to 3)."""

from __future__ import annotations

from typing import Any

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray
from d4orm_env.core.problem import Problem
from d4orm_env.core.seeds import Stream, derived_seed
from d4orm_env.envs.joint_state import JointState
from d4orm_planners.base.candidate import Candidate
from d4orm_planners.base.episode import open_env, run_episode
from d4orm_planners.base.planner import Planner
from d4orm_planners.base.planner_registry import make_policy
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.d4orm_c2f.coarse_plan import CoarsePlan, coarse_problem, interpolate
from d4orm_planners.d4orm_c2f.settings import D4ormC2FConfig
from d4orm_planners.d4orm_d.planner import D4ormD, D4ormDConfig
from d4orm_planners.hybrid.planner import Hybrid, HybridConfig, covered_by_discs
from d4orm_planners.mapf.planner import RoadmapSolution


class CoarsePlanning:
    """Plans for the team of an episode.

    Args:
        config: The settings.
        seed: Of the episode.
        last_step: Time steps after which the episode ends; ``None`` if it goes on after robots arrive.

    Attributes:
        planner: Planner of the coarse plans.
    """

    def __init__(self, config: D4ormC2FConfig, seed: int, last_step: int | None) -> None:
        self._config, self._seed, self._last_step = config, seed, last_step
        # Fine plans cannot keep to paths that fit between others to the centimetre. But where the team is stuck there
        # may be no others.
        self.planner, self._thorough = (_coarse_planner(config, reroute=reroute) for reroute in (False, True))

    def warm_start(self, problem: Problem, joint: JointState) -> FloatArray | None:
        """``(H_c, K, m)`` controls of a policy's episode from here, if the coarse plan is to begin with these.

        Raises:
            ValueError: If there is no such policy, or it cannot drive there.
            ImportError: If it needs a library that is not installed.
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
        chosen, guidance = self._planned(coarse, joint.steps, initial, iterations, thorough)
        last = joint.steps if self._last_step is None else self._last_step
        left = (last - joint.steps) // self._config.coarse_factor
        if 0 < left < coarse.horizon and not chosen.failed.any() and not chosen.trajectory.arrived[left].all():
            # It would come too late. Plans that come too late are none, if there are others.
            in_time = coarse.with_state(coarse.start, coarse.goal, horizon=left)
            hurried, other = self._planned(in_time, joint.steps, initial, iterations, thorough)
            if not hurried.failed.any():
                return other
        return guidance

    def _planned(
        self, coarse: Problem, step: int, initial: FloatArray | None, iterations: int, thorough: bool
    ) -> tuple[Candidate, CoarsePlan]:
        """A plan for the discs round the robots, who then move all at once; where there is none, for them themselves.

        Footprints are planned one after another (:mod:`d4orm_planners.manoeuvres`), and the last ones come late.
        """
        team = coarse.team
        if team.shapes and covered_by_discs(coarse):
            discs = coarse.with_state(coarse.start, coarse.goal, team=team.replace(radius=team.radius))
            chosen, plan = self._searched(discs, step, initial, iterations, thorough)
            if not chosen.failed.any():
                return chosen, plan
        return self._searched(coarse, step, initial, iterations, thorough)

    def _searched(
        self, coarse: Problem, step: int, initial: FloatArray | None, iterations: int, thorough: bool
    ) -> tuple[Candidate, CoarsePlan]:
        """The first plan that passes the checks, or the best one."""
        planner = self._thorough if thorough else self.planner
        seed, interval = derived_seed(self._seed, Stream.COARSE_PLAN, step), self._config.check_interval
        start = None if initial is None else initial[: coarse.horizon]
        search = SolveRun(planner, coarse, seed, start, check_interval=interval)
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
        return chosen, CoarsePlan(
            problem=coarse, controls=plan.controls, states=plan.states, path=path, ordered=ordered
        )


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
