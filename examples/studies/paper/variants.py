"""Methods of the paper with one thing about them changed or counted, for studies that ask what it does."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from unittest.mock import patch

from d4orm_env.core.arrays import FloatArray
from d4orm_env.envs.joint_state import JointState
from d4orm_planners.base.planner import Iteration
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.baselines import ipopt
from d4orm_planners.d4orm_c2f.receding_horizon import D4ormC2F


class ForgetfulC2F(D4ormC2F):
    """D4orm-C2F whose control loops begin with no controls, but for the coarse plan's in the first one."""

    def _base(self, joint: JointState) -> FloatArray:
        base = self._window.no_controls()
        self._tracker.fresh_start(base)
        return base


class CountedIpopt(ipopt.Ipopt):
    """IPOPT whose own iterations are told as denoising steps, those without collisions left out."""

    def iterate(self, search: SolveRun, state: ipopt.WarmStart) -> tuple[ipopt.WarmStart, Iteration]:
        stopper, solves, calls = ipopt._stopper, 0, 0

        def counted(sizes: dict[str, int], keep: Callable[[object], None], ends: Callable[[], bool]) -> object:
            nonlocal solves
            solves += 1

            def kept(values: object) -> None:
                nonlocal calls
                calls += 1
                keep(values)

            return stopper(sizes, kept, ends)

        with patch.object(ipopt, "_stopper", counted):
            state, iteration = super().iterate(search, state)
        # IPOPT also calls before the first iteration of each solve.
        return state, replace(iteration, denoising_steps=calls - solves)
