"""Definition of an environment: its problem or its scenario's instances, and its options checked.

Then the problems of a batch of worlds as the engines read them, shortest paths in them, and range sensors.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from d4orm_env.core.arrays import FloatArray, Floats, frozen_array, whole_number
from d4orm_env.core.goal_poses import goal_headings
from d4orm_env.core.observation_layout import BoundsSlack, ObservationLayout
from d4orm_env.core.problem import Problem
from d4orm_env.core.problem_arrays import ProblemArrays
from d4orm_env.disturbances.disturbance import total_slack
from d4orm_env.disturbances.disturbed_worlds import DisturbedWorlds
from d4orm_env.engine.types import OWN_ARRAYS, WorldBatch
from d4orm_env.envs.features import Features
from d4orm_env.envs.inputs import checked_cycles
from d4orm_env.envs.lifelong import fresh_goal, given_goal, goal_region
from d4orm_env.envs.options import EnvOptions
from d4orm_env.envs.rewards import find_reward, paper_reward
from d4orm_env.paths.shortest_paths import ahead_in_each

if TYPE_CHECKING:
    from d4orm_env.engine.cpu import CpuEngine


_MAX_OBSERVED = 10_000
_OPEN_WORLD_EXTENT = 1000.0
_WORLD_ARRAYS = ("boxes", "triangles", "bounds")
"""Arrays that may differ between the worlds of a batch, at the price of a kernel call for each world."""


class EnvSetup:
    """Options of an environment for the problem, or the instances of a scenario, that its episodes run.

    Args:
        options: Options of the environment.
        num_instances: Choose among so many instances, drawn at first; ``None`` draws a new one each time.
        batched: Whether the instances are to share all but starts, goals and obstacles.
        slack: Room that the spaces of a problem need in addition to that of the disturbances.

    Attributes:
        problem: The problem, or the instance that the spaces are made for.
        region: ``(2, d)`` box that holds every start and goal [m].
        max_cycles: Steps until truncation.
        disturbances: Those that change anything.
        slack: Room beyond the limits of the robots that the spaces need.
        lifelong: Whether robots that arrive get fresh goals.
        next_goal: What gives them these.
        reward: The reward function; ``None`` for the paper's, which the engines compute.
        along_paths: Whether distances of rewards are lengths of shortest paths.
        layout: Layout of one robot's observation, before it becomes features.
        features: What robots are shown instead, if they are egocentric.
    """

    def __init__(
        self,
        options: EnvOptions,
        num_instances: int | None = None,
        *,
        batched: bool = False,
        slack: Callable[[Problem], BoundsSlack] = lambda problem: BoundsSlack(),
    ) -> None:
        self.problem, self._redraw = options.instances()
        problem = self.problem
        self.max_cycles = checked_cycles(problem.horizon if options.max_cycles is None else options.max_cycles)
        self.disturbances = options.disturbances_of(problem)
        self.slack = total_slack(self.disturbances, problem).joined(slack(problem))
        self.lifelong = options.lifelong is not False
        self.next_goal = partial(given_goal, options.lifelong) if callable(options.lifelong) else fresh_goal
        if self.lifelong and not np.isnan(problem.goal_heading).all():
            raise ValueError("lifelong mode draws goals without headings; leave goal_heading out")
        # In an open world the two are the same.
        self.along_paths = options.progress == "path" and problem.world.num_obstacles > 0
        self.reward = find_reward(options.reward) or (paper_reward if self.along_paths else None)
        self.layout = ObservationLayout.for_problem(
            problem,
            num_neighbors=whole_number(options.observed_robots, "observed_robots", 0, _MAX_OBSERVED),
            num_obstacles=whole_number(options.observed_obstacles, "observed_obstacles", 0, _MAX_OBSERVED),
            observed_path=options.observed_path,
            slack=self.slack,
            num_rays=whole_number(options.observed_rays, "observed_rays", 0, _MAX_OBSERVED),
            ray_range=options.ray_range,
            communication_range=options.communication_range,
            line_of_sight=options.line_of_sight,
        )
        self.features = Features.of_team(self.layout, problem.team) if options.egocentric else None
        if self.along_paths:
            problem.shortest_paths.check_reachable()
        self.region = self._region()
        self._prepare_instances(num_instances, batched, differ=not options.stochastic)

    def _region(self) -> FloatArray:
        region = goal_region(self.problem)
        if self.redraws and self.problem.world.lower is None:
            # Nothing but the scenario bounds its instances in an open world, so leave ample room.
            extent = max(_OPEN_WORLD_EXTENT, 10 * float(np.abs(region).max()))
            region = np.array([[-extent], [extent]], np.float32).repeat(self.problem.dimension, axis=1)
        return region

    def _prepare_instances(self, num_instances: int | None, batched: bool, differ: bool) -> None:
        if num_instances is not None and not self.redraws:
            raise ValueError(
                f"num_instances is {num_instances!r} without randomize_instance, or for a scenario that draws nothing "
                "at random; leave it out"
            )
        self._num_instances = None if num_instances is None else whole_number(num_instances, "num_instances", 1)
        self._batched = batched
        self._pool: list[Problem] = []
        if batched and self.redraws and differ:
            self.draw(np.random.default_rng(0))  # to see what differs

    def __setstate__(self, state: dict[str, object]) -> None:
        # NumPy unpickles read-only arrays as writable ones, for which the engine would have to compile anew.
        self.__dict__ |= state
        low, high = (frozen_array(bound, "bounds", (None,)) for bound in (self.layout.low, self.layout.high))
        self.layout = replace(self.layout, low=low, high=high)

    @property
    def observation_bounds(self) -> tuple[FloatArray, FloatArray]:
        """``(D,)`` lowest and highest of what one robot is shown; features ``(F,)`` are of order one."""
        if self.features is None:
            return self.layout.low, self.layout.high
        bound = self.features.bound(self.layout, self.problem.team)
        return -bound, bound

    @property
    def action_bounds(self) -> tuple[FloatArray, FloatArray]:
        """``(K, m)`` lowest and highest actions."""
        low, high = self.problem.team.control_bounds
        return (low, high) if self.features is None else (-np.ones_like(low), np.ones_like(high))

    @property
    def draws(self) -> bool:
        """True if anything is random in an episode."""
        return bool(self.disturbances) or self.redraws or self.lifelong

    @property
    def redraws(self) -> bool:
        """True if every episode has an instance of its own."""
        return self._redraw is not None

    def forget(self) -> None:
        """Draw other instances to choose among, when the next one is asked for."""
        self._pool = []

    def choose(self, random: np.random.Generator) -> Problem:
        """The instance of an episode: a new one, or one of ``num_instances``."""
        if self._num_instances is None:
            return self.draw(random)
        if not self._pool:
            self._pool = [self.draw(random) for _ in range(self._num_instances)]
        return self._pool[int(random.integers(self._num_instances))]

    def draw(self, random: np.random.Generator) -> Problem:
        """A new instance of the scenario, refused if the spaces or the batch of the first one do not hold it."""
        assert self._redraw is not None
        drawn, old, region = self._redraw(seed=int(random.integers(2**31))), self.problem, self.region
        points = np.concatenate([drawn.start[:, : old.dimension], drawn.goal])
        team, former = drawn.team, old.team
        same = (team.models, team.shapes) == (former.models, former.shapes)
        same = same and np.array_equal(team.control_limits, former.control_limits)
        if not same or (points < region[0]).any() or (points > region[1]).any():
            raise ValueError(
                f"the instance drawn from scenario {drawn.name!r} has another team or lies outside "
                f"{region.tolist()} m, where the state space ends; use a scenario whose seed changes positions only"
            )
        if goal_headings(drawn) != self.layout.goal_headings:
            raise ValueError(
                f"instances of scenario {drawn.name!r} differ in whether any robot has a goal heading, or goal hitch "
                "angles, by which observations differ; give them to some robot of every instance, or to none"
            )
        if self.along_paths:
            drawn.shortest_paths.check_reachable()
        own = {*OWN_ARRAYS, *_WORLD_ARRAYS, "grid", "footprints"}
        names = [name for name in drawn.arrays._fields if name not in own] if self._batched else ()
        differing = self.differing(drawn, names)
        if differing:
            raise ValueError(
                f"instances of scenario {drawn.name!r} differ in their {', '.join(differing)}, and worlds of a batch "
                "share all but starts, goals and obstacles; use vectorization_mode='sync'"
            )
        return drawn

    def differing(self, problem: Problem, names: Iterable[str]) -> list[str]:
        """Those arrays by ``names`` in which a problem is another than the first."""
        one, other = problem.arrays, self.problem.arrays
        return [name for name in names if not np.array_equal(getattr(one, name), getattr(other, name))]


class WorldProblems:
    """The problem of each of ``B`` worlds.

    Attributes:
        all: ``B`` problems.
        seen: Arrays that robots are observed with, of each.
        true: Arrays that they are stepped with, of each, as disturbances leave the limits.
        alike: Whether those of the first do for all, in one kernel call.
    """

    def __init__(self, setup: EnvSetup, disturbed: DisturbedWorlds, num_worlds: int) -> None:
        self._setup, self._disturbed = setup, disturbed
        self.all = [setup.problem] * num_worlds
        self.seen, self.true = ([arrays] * num_worlds for arrays in self._arrays_of(setup.problem))
        self.alike = True

    def __setstate__(self, state: dict[str, object]) -> None:
        # NumPy unpickles read-only arrays as writable ones, for which the engine would have to compile anew.
        self.__dict__ |= state
        self.seen, self.true = map(list, zip(*map(self._arrays_of, self.all)))

    def begin(self, world: int, random: np.random.Generator, worlds: WorldBatch) -> None:
        """Give a world of ``worlds`` the start and the goals of its next episode, of a problem drawn if any is."""
        problem = self.all[world]
        if self._setup.redraws:
            problem = self.all[world] = self._setup.choose(random)
            self.seen[world], self.true[world] = self._arrays_of(problem)
            if len(self.all) == 1:
                self._disturbed.problem = problem
            else:
                self.alike &= not self._setup.differing(problem, _WORLD_ARRAYS)
        worlds.start[world], worlds.goal[world] = problem.start, problem.goal
        worlds.inverse[world] = problem.arrays.inverse_initial_distance

    def sense_ranges(
        self, engine: CpuEngine, batch: WorldBatch, out: FloatArray, worlds: NDArray[np.intp] | None = None
    ) -> None:
        """Fill the rays of the observations ``out`` ``(b, K, D)`` of some worlds, or of all, as these truly are."""
        layout = self._setup.layout
        if not layout.num_rays:
            return
        rows = slice(None) if worlds is None else worlds
        state, bodies = batch.state[rows], batch.bodies[rows]
        if self.alike:
            engine.cast_rays(self.true[0], layout, state, bodies, out)
            return
        for row, world in enumerate(range(len(out)) if worlds is None else worlds):
            one = slice(row, row + 1)
            engine.cast_rays(self.true[world], layout, state[one], bodies[one], out[one])

    def _arrays_of(self, problem: Problem) -> tuple[ProblemArrays, ProblemArrays]:
        seen = problem.arrays_to_observe(self._setup.layout.num_obstacles)
        true = seen
        if self._disturbed.alters_limits:
            true = true._replace(limits=self._disturbed.true_limits(seen.limits))
        if self._setup.lifelong:
            # A goal radius that nothing is within: a robot under way to its next goal neither docks nor stops.
            true = true._replace(squared_goal_radius=np.float32(-1))
        return seen, true


class WorldPaths:
    """Paths of ``B`` worlds to the goals, as they were last looked for; ``one_world`` where all are one.

    Attributes:
        direction: ``(B, K, d)`` unit vectors.
        length: ``(B, K)`` [m].
    """

    def __init__(self, problems: Sequence[Problem], *, one_world: bool) -> None:
        self._problems, self._one_world = problems, one_world
        shape = len(problems), problems[0].num_robots
        self.direction: Floats = np.zeros((*shape, problems[0].dimension))
        self.length: Floats = np.zeros(shape)

    @property
    def first_length(self) -> Floats:
        """``(B, K)`` length of the paths from the starts [m]."""
        return np.stack([problem.shortest_paths.length for problem in self._problems])

    def update(self, worlds: NDArray[np.intp], states: FloatArray) -> None:
        """Look for the paths in some worlds, where the robots are in ``states`` ``(B, K, n)``."""
        self.direction[worlds], self.length[worlds] = self.look(worlds, states[worlds])

    def look(self, worlds: NDArray[np.intp], states: FloatArray) -> tuple[Floats, Floats]:
        """Directions ``(b, K, d)`` and lengths ``(b, K)`` of paths in some worlds, from ``states`` ``(b, K, n)``."""
        positions = states[..., : self.direction.shape[-1]]
        if self._one_world:
            return self._problems[0].shortest_paths.ahead(positions)
        return ahead_in_each([self._problems[world].shortest_paths for world in worlds], positions)
