"""MMD as a planner: single-robot diffusion and conflict-based search."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field

from d4orm_env.core.problem import Problem
from d4orm_env.core.seeds import Stream, generator
from d4orm_planners.base.planner import Iteration, Planner, PlannerConfig
from d4orm_planners.base.settings import Count, NotNegative, Number, Samples, ShareOrNone, Steps
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.baselines.mmd.constraint_tree import Planning, Tree
from d4orm_planners.baselines.mmd.guiding import guide
from d4orm_planners.baselines.mmd.path_frame import make_frame, world_space
from d4orm_planners.baselines.mmd.prior import Denoiser
from d4orm_planners.baselines.mmd.tracking import motion_kernel
from d4orm_planners.mapf.planner import NoPaths

Stretch = Annotated[Number, Field(ge=1, le=100)]
GuideSteps = Annotated[Count, Field(le=1000)]


@dataclass(frozen=True, kw_only=True)
class MMDConfig(PlannerConfig):
    """Settings of :class:`MMD`.

    Attributes:
        max_iterations: Nodes of the constraint tree that are expanded before :meth:`Planner.solve` gives up.
        num_samples: Motions of a robot that are denoised together.
        num_steps: Denoising steps from noise.
        guide_from: Share of the denoising steps, the last ones, that are guided.
        guide_steps: Of guidance per denoising step.
        noise_scale: Of the noise between denoising steps; 1 is DDPM's.
        reuse_steps: Denoising steps when a robot plans again, from its motions with as much noise as that many steps
            take away (MMD-xECBS); ``None`` begins with noise (MMD-ECBS).
        soft_pull: Share of a violation of soft constraints, which are the other robots' paths, that a step of guidance
            takes away; 0 leaves them out (MMD-CBS).
        constraint_radius: Of constraints, as a multiple of the distance that two robots keep.
        clearance: Distance from obstacles beyond radius and margin that guidance leads to, in steps of the fastest
            robot at full speed.
        quickest: Times the shortest time of its path that a motion takes at least.
        slowest: And at most; between the two it is drawn.
    """

    max_iterations: Count = 300
    num_samples: Samples = 32
    num_steps: Steps = 25
    guide_from: ShareOrNone = 0.5
    guide_steps: GuideSteps = 4
    noise_scale: NotNegative = 0.5
    reuse_steps: Count | None = 3
    soft_pull: ShareOrNone = 0.5
    constraint_radius: Stretch = 1.2
    clearance: NotNegative = 0.3
    quickest: Stretch = 1.1
    slowest: Stretch = 3.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.slowest < self.quickest:
            raise ValueError(f"slowest is {self.slowest:g}; it must be at least quickest, which is {self.quickest:g}")


class MMD(Planner):
    """A diffusion model of single robots' motions, guided by constraints, under conflict-based search.

    Reduced from Shaoul, Mishani, Vats, Li and Likhachev, *Multi-Robot Motion Planning with Diffusion Models* (ICLR
    2025). The first iteration gives every robot a motion, and every other one expands a node of the constraint tree.
    """

    name: ClassVar[str] = "mmd"
    config_class = MMDConfig
    presets: ClassVar = {"paper": {"num_samples": 64, "guide_steps": 20, "soft_pull": 0.1, "slowest": 1.1}}
    config: MMDConfig

    def iterate(self, search: SolveRun, state: Tree | NoPaths | None) -> tuple[Tree | NoPaths, Iteration]:
        """See :meth:`Planner.iterate`: all robots' motions at first, then an expansion of the best node."""
        if state is None:
            with search.watch.paused():
                compile_mmd(search.problem)
            state = _begin(search)
        if isinstance(state, NoPaths):
            return state, state.explained(Iteration(search.current.controls))
        problem = search.problem
        denoiser = Denoiser(problem, self.config, search.should_stop)
        planning = Planning(problem, self.config, denoiser, state.frames, state.space)
        if not state.nodes:
            added = [planning.root(_seeds(search, problem.num_robots))]
        else:
            failed = np.flatnonzero(search.current.unsolved)
            unlucky = int(failed[0]) if len(failed) else search.iteration % problem.num_robots
            added = planning.children(state.nodes[0], state.made, _seeds(search, 2), unlucky)
        best = min(added)
        note = f"{best.conflicts} conflicts, {state.made + len(added)} nodes"
        return state.with_nodes(added), Iteration(best.controls, planning.steps, note=note)


def _begin(search: SolveRun) -> Tree | NoPaths:
    """The tree before its root."""
    problem, space = search.problem, world_space(search.problem)
    reason = NoPaths.unless_reachable(problem)
    if reason is not None:
        return reason
    # The first numbers are the robots'.
    turns = generator(search.seed, Stream.SAMPLES, 0, problem.num_robots).uniform(-1, 1, (problem.num_robots, 3))
    frames = [make_frame(problem, robot, space, turn) for robot, turn in enumerate(turns)]
    return Tree(tuple(frame for frame in frames if frame is not None), space, (), 0)


def _seeds(search: SolveRun, count: int) -> list[int]:
    return [search.iteration_seed(Stream.SAMPLES, number) for number in range(count)]


def compile_mmd(problem: Problem) -> None:
    """Compile what the method needs for such a team, if it is not yet."""
    if guide.signatures and all(motion_kernel(name).signatures for name in problem.team.models):
        return
    config = MMDConfig(num_samples=2, num_steps=1, guide_from=1.0, guide_steps=1)
    for robot in {name: number for number, name in enumerate(problem.team.models)}.values():
        twice = problem.select([robot, robot])
        space = world_space(twice)
        frame = make_frame(twice, 0, space, np.ones(3))
        if frame is not None:
            Planning(twice, config, Denoiser(twice, config, lambda: False), (frame, frame), space).root([0, 0])
