"""MMD as a planner: single-robot diffusion, and conflict-based search over it (CBS, ECBS, xECBS).

The search decides which robot plans again, clear of where it met another. Its tree has motions of a team, their
conflicts, and the constraints that these put on robots.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from typing import Annotated, ClassVar, NamedTuple

import numpy as np
from pydantic import Field

from d4orm_env.core.arrays import BoolArray, FloatArray, Floats, IntArray
from d4orm_env.core.problem import Problem
from d4orm_env.core.seeds import Stream, generator
from d4orm_env.paths.spaces import Space
from d4orm_planners.base.planner import Iteration, Planner, PlannerConfig
from d4orm_planners.base.settings import Count, NotNegative, Number, Samples, ShareOrNone, Steps
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.baselines.mmd.motions import PathSurroundings, guide, motion_kernel
from d4orm_planners.baselines.mmd.path_frame import PathFrame, make_frame, world_space
from d4orm_planners.baselines.mmd.prior import Denoiser
from d4orm_planners.mapf.planner import NoPaths

SLACK = 1 / 75  #: Added to distances when conflicts are sought, for rounding, in radii of the largest robot
PADDING = 2  #: Number of a motion's 64 points by which a constraint outlasts its conflict on either side, as published
Stretch = Annotated[Number, Field(ge=1, le=100)]


@dataclass(frozen=True, kw_only=True)
class MMDConfig(PlannerConfig):
    """Settings of :class:`MMD`."""

    max_iterations: Count = 300  #: Nodes of the constraint tree that are expanded before :meth:`Planner.solve` gives up
    num_samples: Samples = 32  #: Motions of a robot that are denoised together
    num_steps: Steps = 25  #: Denoising steps from noise
    guide_from: ShareOrNone = 0.5  #: Share of the denoising steps, the last ones, that are guided
    guide_steps: Annotated[Count, Field(le=1000)] = 4  #: Of guidance per denoising step
    noise_scale: NotNegative = 0.5  #: Of the noise between denoising steps; 1 is DDPM's
    #: Denoising steps when a robot plans again, from its motions with as much noise as that many steps take away
    #: (MMD-xECBS); ``None`` begins with noise (MMD-ECBS)
    reuse_steps: Count | None = 3
    #: Share of a violation of soft constraints, which are the other robots' paths, that a step of guidance takes away;
    #: 0 leaves them out (MMD-CBS)
    soft_pull: ShareOrNone = 0.5
    constraint_radius: Stretch = 1.2  #: Of constraints, as a multiple of the distance that two robots keep
    #: Distance from obstacles beyond radius and margin that guidance leads to, in steps of the fastest robot at full
    #: speed
    clearance: NotNegative = 0.3
    quickest: Stretch = 1.1  #: Times the shortest time of its path that a motion takes at least
    slowest: Stretch = 3.0  #: And at most; between the two it is drawn

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.slowest < self.quickest:
            raise ValueError(f"slowest is {self.slowest:g}; it must be at least quickest, which is {self.quickest:g}")


def count_conflicts(positions: Floats, others: Floats, distances: Floats) -> IntArray:
    """``(B, 2)`` numbers of other robots that each of some paths conflicts with, and of steps at which it does.

    Paths are ``(B, T, 3)``, the others' ``(S, T, 3)``, and ``distances`` to keep from each ``(S,)`` [m].
    """
    steps = _too_near(positions[:, None] - others, distances[:, None]).sum(axis=2)
    return np.stack([(steps > 0).sum(axis=1), steps.sum(axis=1)], axis=1)


def first_conflict(positions: Floats, distances: Floats) -> tuple[int, int, tuple[int, int]]:
    """Number of pairs in conflict, and the step and the robots of the earliest conflict; robots are -1 for none.

    Paths are ``(K, T, 3)``, and ``distances`` to keep ``(K, K)`` [m].
    """
    one, other = np.tril_indices(len(positions), -1)
    near = _too_near(positions[one] - positions[other], distances[one, other, None])
    if not near.any():
        return 0, positions.shape[1], (-1, -1)
    step = int(near.any(axis=0).argmax())
    pair = int(near[:, step].argmax())
    return int(near.any(axis=1).sum()), step, (int(one[pair]), int(other[pair]))


def _too_near(gaps: Floats, distances: Floats) -> BoolArray:
    """Check which gaps ``(..., 3)`` are no longer than the distances to keep [m]."""
    return gaps[..., 0] ** 2 + gaps[..., 1] ** 2 + gaps[..., 2] ** 2 <= distances**2


class Constraint(NamedTuple):
    """A sphere that one robot's centre has to be out of for some steps."""

    sphere: tuple[float, float, float, float]  #: Centre and radius [m]
    span: tuple[int, int]  #: First and last step


@dataclass(frozen=True, eq=False)
class RobotMotion:
    """Motion of one robot in a node of the tree."""

    motions: FloatArray  #: ``(B, SIZE)`` all that were denoised with it, which the next ones begin with
    controls: FloatArray  #: ``(H, m)``
    positions: Floats  #: ``(H+1, 3)`` [m]
    cost: int  #: Steps until it arrives
    fails: bool  #: Whether it comes too near to an obstacle or does not arrive


@dataclass(frozen=True, order=True)
class TreeNode:
    """A node of the tree; the one to be expanded next is the least."""

    conflicts: int  #: Pairs in conflict, and robots that fail by themselves
    cost: int  #: Sum of the robots' steps until arrival
    number: int  #: Of the node, counted as they are made
    motions: tuple[RobotMotion, ...] = field(compare=False)  #: Of the robots
    constraints: tuple[tuple[Constraint, ...], ...] = field(compare=False)  #: Of each robot
    pair: tuple[int, int] = field(compare=False)  #: Two robots in conflict, or -1
    step: int = field(compare=False)  #: Of their conflict


@dataclass(frozen=True, eq=False)
class Tree:
    """The state of the search: nodes that are not expanded yet, best first, and how many were made."""

    frames: tuple[PathFrame, ...]
    space: Space
    nodes: tuple[TreeNode, ...]
    made: int


class Planning:
    """Planner of one robot around the others of a problem; all that changes is in nodes."""

    def __init__(
        self, problem: Problem, config: MMDConfig, denoiser: Denoiser, frames: tuple[PathFrame, ...], space: Space,
        denoising: Callable[[], AbstractContextManager[None]] = nullcontext,
    ) -> None:  # fmt: skip
        self._problem, self._config, self._denoiser = problem, config, denoiser
        self._frames, self._space, self._denoising = frames, space, denoising
        radius, self._slack = np.asarray(problem.team.radius, np.float64), SLACK * problem.team.largest_radius
        self._distances: Floats = radius[:, None] + radius + problem.margin + self._slack
        self.steps = 0

    def root(self, seeds: list[int], should_stop: Callable[[], bool] = lambda: False) -> TreeNode | None:
        """All motions, each around those that have planned (soft constraints only); ``None`` if it should stop."""
        motions: list[RobotMotion] = []
        for robot, seed in enumerate(seeds):
            if should_stop():
                return None
            motions.append(self._plan(robot, motions, list(range(robot)), (), seed, None))
        return self.node(0, tuple(motions), ((),) * len(seeds))

    def node(
        self, number: int, motions: tuple[RobotMotion, ...], constraints: tuple[tuple[Constraint, ...], ...]
    ) -> TreeNode:
        """A node with its conflicts counted and the first one found."""
        positions = np.stack([motion.positions for motion in motions])
        pairs, step, pair = first_conflict(positions, self._distances)
        failing = sum(motion.fails for motion in motions)
        cost = sum(motion.cost for motion in motions)
        return TreeNode(pairs + failing, cost, number, motions, constraints, pair, step)

    def children(self, node: TreeNode, number: int, seeds: list[int], unlucky: int) -> list[TreeNode]:
        """Return a node's children: for each of two robots in conflict, one in which it keeps clear of where they met.

        In a node without a pair in conflict a robot that fails plans from noise, or if none does, ``unlucky``.
        """
        one, another = node.pair
        if one < 0:
            failing = [robot for robot, motion in enumerate(node.motions) if motion.fails]
            robot = failing[0] if failing else unlucky
            return [self._child(node, number, robot, node.constraints[robot], seeds[0], from_noise=True)]
        added = []
        for count, (robot, other) in enumerate(((one, another), (another, one))):
            own = (*node.constraints[robot], self._constraint(node, robot, other))
            added.append(self._child(node, number + count, robot, own, seeds[count], from_noise=False))
        return added

    def _child(
        self, node: TreeNode, number: int, robot: int, own: tuple[Constraint, ...], seed: int, *, from_noise: bool
    ) -> TreeNode:
        others = [other for other in range(len(node.motions)) if other != robot]
        before = None if from_noise or self._config.reuse_steps is None else node.motions[robot].motions
        motion = self._plan(robot, list(node.motions), others, own, seed, before)
        motions = tuple(motion if k == robot else kept for k, kept in enumerate(node.motions))
        constraints = tuple(own if k == robot else kept for k, kept in enumerate(node.constraints))
        return self.node(number, motions, constraints)

    def _constraint(self, node: TreeNode, robot: int, other: int) -> Constraint:
        """To keep out of a sphere about the middle between two robots for a while."""
        middle = (node.motions[robot].positions[node.step] + node.motions[other].positions[node.step]) / 2
        radius = self._config.constraint_radius * self._distances[robot, other]
        motion = self._frames[robot].quickest * self._config.quickest / self._problem.dt
        padding = max(1, round(PADDING * motion / 64))
        x, y, z = map(float, middle)
        return Constraint((x, y, z, float(radius)), (node.step - padding, node.step + padding))

    def _plan(
        self,
        robot: int,
        motions: list[RobotMotion],
        others: list[int],
        constraints: tuple[Constraint, ...],
        seed: int,
        before: FloatArray | None,
    ) -> RobotMotion:
        """The motion of a robot that conflicts least with these others, of those that were denoised together."""
        config, frame = self._config, self._frames[robot]
        paths = np.stack([motions[other].positions for other in others]) if others else np.empty((0, 1, 3))
        distances = self._distances[robot, others]
        surroundings = PathSurroundings(
            space=self._space,
            clearance=frame.safety_distance + config.clearance * self._problem.stride,
            size=self._problem.team.largest_radius,
            dt=self._problem.dt,
            spheres=np.array([constraint.sphere for constraint in constraints]).reshape(-1, 4),
            spans=np.array([constraint.span for constraint in constraints], np.int64).reshape(-1, 2),
            others=paths,
            radii=distances * config.constraint_radius,
            pull=config.soft_pull,
        )
        with self._denoising():
            denoised, driven, steps = self._denoiser.denoise(robot, frame, surroundings, seed, before)
        self.steps += steps
        counts = count_conflicts(driven.positions, paths, distances)
        fails = (driven.arrivals > self._problem.horizon) | (driven.clearances < frame.safety_distance + self._slack)
        best = int(np.lexsort((driven.arrivals, counts[:, 1], counts[:, 0], fails))[0])
        controls, positions = driven.controls[best].copy(), driven.positions[best].copy()
        return RobotMotion(denoised, controls, positions, int(driven.arrivals[best]), bool(fails[best]))


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
        planning = Planning(problem, self.config, denoiser, state.frames, state.space, search.denoising)
        if not state.nodes:
            root = planning.root(_seeds(search, problem.num_robots), search.should_stop)
            if root is None:
                return state, Iteration(search.current.controls, planning.steps, note="no time for all robots")
            added = [root]
        else:
            failed = np.flatnonzero(search.current.unsolved)
            unlucky = int(failed[0]) if len(failed) else search.iteration % problem.num_robots
            added = planning.children(state.nodes[0], state.made, _seeds(search, 2), unlucky)
        best = min(added)
        state = replace(state, nodes=tuple(sorted([*state.nodes[1:], *added])), made=state.made + len(added))
        controls = np.stack([motion.controls for motion in best.motions], axis=1)
        return state, Iteration(controls, planning.steps, note=f"{best.conflicts} conflicts, {state.made} nodes")


def _begin(search: SolveRun) -> Tree | NoPaths:
    problem, space = search.problem, world_space(search.problem)
    reason = NoPaths.unless_reachable(search)
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
