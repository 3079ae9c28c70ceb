"""The loop that MPPI, CEM, MBD, i-MBD and D4orm share: propose, sample and score, weight, update (paper, Algorithm 1).

After every step the new mean is the weighted mean of the samples. For the denoising methods this is Algorithm 1
exactly: substituting the score estimate of line 5 into line 6 gives ``U_{i-1} = sqrt(alpha_bar_{i-1}) * U_bar``, and
line 3 of the next step samples around ``U_{i-1} / sqrt(alpha_bar_{i-1}) = U_bar``. A method is therefore a schedule of
standard deviations, a rule for the weights, and where an iteration starts.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from d4orm_env.core import portable
from d4orm_env.core.arrays import FloatArray, Floats
from d4orm_env.core.problem import Problem
from d4orm_env.core.seeds import Stream
from d4orm_env.core.team import Team
from d4orm_planners.base.candidate import Groups, components, team_conflicts
from d4orm_planners.base.planner import Iteration, Planner, State
from d4orm_planners.base.solve import SolveRun
from d4orm_planners.base.working_plan import WorkingPlan, approach_goals
from d4orm_planners.engine.sampling_types import SamplingRules, SamplingTask
from d4orm_planners.sampling.settings import DenoisingConfig, SamplingConfig, alpha_bar
from d4orm_planners.sampling.weights import GroupWeights

SHORT = 5.0  #: Length below which paths are short, in distances that two robots keep between their centres
SLACK, SLACK_GROWTH = 2.0, 0.2  #: First horizon of the samples, in times of the drive, and its growth per iteration


def on_short_paths(task: SamplingTask, search: SolveRun) -> SamplingTask:
    """The task itself, unless all robots' paths are short: then one of fewer steps, with rewards for such paths.

    A detour round another robot costs little on a long path. On a short one it costs nearly as much as driving through
    the other, as the reward counts distances relative to the path, and most steps come after the arrival. Samples of
    short paths therefore look no farther ahead than driving and evading take, and distances count relative to a path on
    which evading is cheap.

    Where goals are not absorbing all steps count, and it is the task itself too.
    """
    problem = task.problem
    reference = SHORT * (2 * float(np.max(problem.team.girth)) + problem.margin)
    lengths = np.linalg.norm(problem.goal - problem.start[:, : problem.dimension], axis=1).astype(np.float64)
    if problem.num_robots == 1 or not problem.docks or lengths.max() >= reference:
        return task
    if problem.world.num_obstacles:
        with search.watch.paused():  # it may compile
            lengths = np.asarray(problem.shortest_paths.length, np.float64)
        if lengths.max() >= reference:
            return task
    slack = SLACK + SLACK_GROWTH * search.iteration
    horizon = min(problem.horizon, math.ceil(slack * float(drive_times(problem, lengths).max()) / problem.dt))
    part = problem.with_state(problem.start, problem.goal, horizon=horizon)
    base, factor = np.ascontiguousarray(task.base[:horizon]), task.first_factor[:horizon]
    return replace(task, problem=part, base=base, noise_factor=factor, reference_distance=reference)


def drive_times(problem: Problem, lengths: Floats) -> Floats:
    """``(K,)`` times from rest to rest along paths of these lengths ``(K,)`` [s], a quarter turn included."""
    team = problem.team
    speed, acceleration = np.float64(team.max_speed), np.float64(team.max_acceleration)
    inert = np.array([not model.first_order for model in team.robot_models])
    peak = np.where(inert, np.minimum(speed, np.sqrt(acceleration * lengths)), speed)
    rates = np.array([model.turn_rate(limits) for model, limits in zip(team.robot_models, team.limits)])
    turn = np.where(rates > 0, math.pi / 2 / np.where(rates > 0, rates, 1.0), 0.0)
    # It turns while it gains speed. A robot that starts at its goal has no peak.
    return lengths / np.where(peak > 0, peak, 1.0) + np.maximum(np.where(inert, peak / acceleration, 0.0), turn)


@dataclass(frozen=True, eq=False)
class NextStep:
    """State from which a run of the sampling loop would go on."""

    mean: FloatArray  #: ``(H, K, m)`` mean of the samples
    noise_factor: FloatArray  #: ``(H, K, m)`` factors on their standard deviation


class SamplingPlanner(Planner):
    """A planner whose iteration is one run of the sampling loop over the whole team."""

    config: SamplingConfig

    @abstractmethod
    def noise_scale(self) -> FloatArray:
        """``(N,)`` standard deviation of the samples at every step of an iteration."""

    @abstractmethod
    def rules(self) -> SamplingRules:
        """The method's weights, and how it adapts its noise."""

    @abstractmethod
    def initial(self, search: SolveRun) -> tuple[FloatArray, FloatArray]:
        """``(base, mean)``, each ``(H, K, m)``: samples are drawn around ``mean`` on top of ``base``."""

    def task(self, search: SolveRun, base: FloatArray) -> SamplingTask:
        credit = self.config.credit
        if credit == "alternate":
            credit = "team" if search.iteration % 2 else "robot"
        elif credit == "group":  # the rules sum the robots' rewards
            credit = "robot"
        return SamplingTask(
            search.problem, base, credit=credit, penalty=self.config.penalty,
            penalty_per_pair=self.config.penalty_per_pair,
        )  # fmt: skip

    def num_samples(self, search: SolveRun) -> int:
        """``M`` of this iteration."""
        del search
        return self.config.num_samples

    def stages(self, search: SolveRun) -> list[tuple[FloatArray, int]]:
        """The steps of an iteration, in parts that each have their number of samples: ``(noise scale, M)``."""
        return [(self.noise_scale(), self.num_samples(search))]

    def iterate(self, search: SolveRun, state: State) -> tuple[State, Iteration]:
        return state, self.run(search)

    def run(self, search: SolveRun) -> Iteration:
        base, mean = self.initial(search)
        return self.sampled(search, self.task(search, base), self.credited(search), mean, self.stages(search))[0]

    def credited(self, search: SolveRun) -> SamplingRules:
        """The rules, with weights by groups where these have the credit."""
        rules = self.rules()
        if self.config.credit != "group":
            return rules
        return rules._replace(weights=GroupWeights(rules.weights, conflict_groups(search)))

    def sampled(
        self,
        search: SolveRun,
        task: SamplingTask,
        rules: SamplingRules,
        mean: FloatArray,
        stages: Sequence[tuple[FloatArray, int]],
    ) -> tuple[Iteration, NextStep]:
        """One run of the sampling loop for this task, around ``mean`` ``(H, K, m)`` on top of the task's base."""
        controls = np.zeros_like(task.base)
        if self.config.short_paths:
            task = on_short_paths(task, search)
        horizon = task.problem.horizon
        mean = np.ascontiguousarray(mean[:horizon])
        num_steps = excluded = 0
        factor: float | FloatArray = task.first_factor
        for stage, (noise_scale, num_samples) in enumerate(stages):
            seed = search.iteration_seed(Stream.SAMPLES, stage)
            result = search.denoise(task, rules, mean, noise_scale, num_samples, seed)
            mean, num_steps, excluded = result.mean, num_steps + len(result.rewards), excluded + result.excluded
            factor = result.noise_factor
        following = NextStep(np.zeros_like(controls), np.ones_like(controls))
        following.mean[:horizon], following.noise_factor[:horizon] = mean, factor
        controls[:horizon] = task.base + mean
        return Iteration(self.braking(search, controls), num_steps, excluded), following

    def braking(self, search: SolveRun, controls: FloatArray) -> FloatArray:
        """``(H, K, m)`` the controls, with final approaches where robots must slow down at their goals, or turn."""
        poses = np.isfinite(search.problem.goal_speed) | ~np.isnan(search.problem.goal_heading)
        if not (self.config.final_approach and poses.any()):
            return controls
        trajectory = search.engine.rollout(search.problem, controls)
        team = WorkingPlan(search, trajectory)
        approach_goals(team, np.arange(search.problem.num_robots), search.problem, trajectory)
        return team.controls


def conflict_groups(search: SolveRun) -> Groups:
    """Groups of robots that conflict with each other in the present candidate, directly or through others."""
    problem = search.problem
    positions = search.current.trajectory.positions
    return components(team_conflicts(problem, positions))


class DenoisingPlanner(SamplingPlanner):
    """A planner whose noise follows the diffusion schedule, and whose weights are a softmax."""

    config: DenoisingConfig

    def noise_scale(self) -> FloatArray:
        return self.config.noise_scale(self.config.num_steps)

    def rules(self) -> SamplingRules:
        return SamplingRules(self.config.weights)

    def first_mean(self, noise: FloatArray) -> FloatArray:
        """``U_N / sqrt(alpha_bar_N)``, around which the first step draws its samples if it starts from ``noise``."""
        final = alpha_bar(self.config.num_steps, self.config.beta_start, self.config.beta_end)[-1]
        return noise / np.float32(np.sqrt(final))


def standard_normal(search: SolveRun, team: Team, num_steps: int, number: int = 0) -> FloatArray:
    """``(H, K, m)`` standard normal controls of a team, in its units, for the start of a run of this iteration."""
    generator = np.random.default_rng(search.iteration_seed(Stream.DEFORMATION_START, number))
    return portable.standard_normal(generator, (num_steps, *team.control_units.shape)) * team.control_units
