"""AMSwarm, the rival of the paper's section VIII-C, as a planner."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field

from d4orm_env.core.problem import Problem
from d4orm_env.core.seeds import Stream
from d4orm_planners.base.planner import Iteration, Planner, PlannerConfig, State
from d4orm_planners.base.settings import Count, NotNegative, Number, Positive, Share, Steps
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.baselines.amswarm.alternation import alternate
from d4orm_planners.baselines.amswarm.swarm import Swarm

Degree = Annotated[Count, Field(ge=5, le=30)]
Lookahead = Annotated[Count, Field(ge=2, le=1000)]
Growth = Annotated[Number, Field(ge=1, le=10)]


@dataclass(frozen=True, kw_only=True)
class AMSwarmConfig(PlannerConfig):
    """Settings of :class:`AMSwarm`; lengths are in steps of the fastest robot at full speed.

    Attributes:
        max_iterations: Runs from start to horizon after which :meth:`Planner.solve` gives up, each with other guesses.
        lookahead: Steps that a motion is planned for, of which the first is driven.
        degree: Of the Bernstein polynomials.
        goal_steps: Steps at the end of a motion that are to be at the goal.
        goal_weight: Weight of their squared distances from it.
        smoothness: Weight of the squared jerk.
        barrier: Share of its distance to a body's reach that a robot may use up in a step; 1 allows all of it.
        lookout: Bodies are minded that are predicted to come this near to the reach; ``None`` minds all.
        clearance: Added to every distance to keep, for what is driven between the steps.
        perturbation: Largest perturbation of every guess, so that symmetric teams do not block themselves.
        penalty: First weight of the constraints.
        growth: Factor by which it grows from one alternation to the next.
        alternations: Of a replanning, at most.
        tolerance: Largest violation, and change of a place, at which a replanning ends.
    """

    max_iterations: Count = 20
    lookahead: Lookahead = 40
    degree: Degree = 10
    goal_steps: Count = 32
    goal_weight: Positive = 1.0
    smoothness: NotNegative = 1e-4
    barrier: Share = 0.25
    lookout: NotNegative | None = 10.0
    clearance: NotNegative = 0.3
    perturbation: NotNegative = 0.5
    penalty: Positive = 2.0
    growth: Growth = 1.05
    alternations: Steps = 100
    tolerance: Positive = 0.05


class AMSwarm(Planner):
    """Receding-horizon planning by alternating minimisation, every robot around what the others planned last.

    Adajania, Zhou, Singh and Schoellig, ICRA 2023. An iteration is one run of the team from start to horizon. The
    method speaks of holonomic robots: those with a heading follow their motions' velocities as well as they can.
    """

    name: ClassVar[str] = "amswarm"
    config_class = AMSwarmConfig
    presets: ClassVar = {
        # The authors' code (utiasDSL/AMSwarm, config_am_swarm.yaml), but for the smoothness, which is of snap there.
        "paper": {
            "lookahead": 30,
            "goal_steps": 15,
            "goal_weight": 7000.0,
            "smoothness": 0.7,
            "barrier": 1.0,
            "lookout": 2.0,
            "clearance": 0.6,
            "penalty": 1.0,
            "growth": 1.3,
            "alternations": 3000,
            "tolerance": 0.1,
        }
    }
    config: AMSwarmConfig

    def iterate(self, search: SolveRun, state: State) -> tuple[State, Iteration]:
        """See :meth:`Planner.iterate`: a run of the whole team."""
        _refuse_polygons(search.problem)
        if search.iteration == 0:
            with search.watch.paused():
                self._compile(search)
        random = np.random.default_rng(search.iteration_seed(Stream.PERTURBATION))
        swarm = Swarm(search.problem, self.config, random)
        controls = swarm.run(search.engine, search.should_stop)
        return state, Iteration(controls, note=f"largest violation planned: {swarm.violation:.3f}")

    def _compile(self, search: SolveRun) -> None:
        """Compile the alternation and the step of such a team, if they are not yet."""
        problem, engine = search.problem, search.engine
        arrived, controls = np.zeros(problem.num_robots, bool), search.current.controls[0]
        engine.step(problem.arrays, np.asarray(problem.start), arrived, controls)
        if not alternate.signatures:
            alone = problem.select([0])
            step = alone.with_state(alone.start, alone.goal, horizon=1)
            Swarm(step, self.config, np.random.default_rng(0)).run(engine, lambda: False)


def _refuse_polygons(problem: Problem) -> None:
    if problem.world.polygons:
        raise ValueError(
            f"the world has {len(problem.world.polygons)} polygons, and planner 'amswarm' knows circles, spheres, "
            f"cylinders and boxes only; give boxes in their place, or use planner 'hybrid'"
        )
