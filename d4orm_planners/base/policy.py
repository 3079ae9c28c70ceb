"""Policies, which act in an ``env.step`` loop from observations and ``env.state()`` alone."""

from __future__ import annotations

import hashlib
import inspect
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, TypeGuard

import numpy as np

from d4orm_env.core.arrays import FloatArray, as_float32, short_repr, usable, whole_number
from d4orm_env.core.problem import Problem
from d4orm_env.core.registry import check_call, required_parameters
from d4orm_env.core.seeds import Stream, generator
from d4orm_env.envs.joint_state import JointState, split_state
from d4orm_planners.base.measured_states import acting_robots, robots_by_agent
from d4orm_planners.base.plan import Plan
from d4orm_planners.base.planner import Planner
from d4orm_planners.base.policy_threads import ATTRIBUTE, driven_alone
from d4orm_planners.base.provenance import attributes
from d4orm_planners.base.settings import CheckedSettings
from d4orm_planners.tracking.goal_drives import drive_to_goal
from d4orm_planners.tracking.steering import limit_controls

if TYPE_CHECKING:
    from pettingzoo import ParallelEnv

Observations = dict[str, FloatArray]  #: By agent
Actions = dict[str, FloatArray]  #: By agent


class Policy(ABC):
    """Something that chooses every robot's control at every step.

    A subclass has :meth:`act`, and a :meth:`reset` if it draws, plans or remembers anything. One object drives one
    episode at a time: calls from several threads that would mix theirs are a RuntimeError.
    """

    #: :class:`~d4orm_planners.base.settings.CheckedSettings` of the policy, of which the constructor then takes an
    #: instance. Without one, settings are keyword arguments of the constructor
    config_class: ClassVar[type[CheckedSettings] | None] = None
    #: By name, settings of ``config_class`` for :func:`~d4orm_planners.make_policy`
    presets: ClassVar[Mapping[str, Mapping[str, object]]] = {}
    problem: Problem  #: Problem of the present episode, from the reset on

    def __init_subclass__(cls, **keywords: object) -> None:
        super().__init_subclass__(**keywords)
        for name in ("reset", "act"):
            if inspect.isfunction(method := vars(cls).get(name)):
                setattr(cls, name, driven_alone(method))

    def __getstate__(self) -> dict[str, object]:
        return {name: value for name, value in vars(self).items() if name != ATTRIBUTE}

    @driven_alone
    def reset(self, env: ParallelEnv, seed: int = 0) -> None:
        """Get ready for an episode that ``env.reset()`` has begun.

        Args:
            env: A :mod:`d4orm_env.navigation_v0` parallel environment, wrapped or not.
            seed: Seeds whatever the policy draws, zero or more.

        Raises:
            RuntimeError: If no episode has begun and the policy needs one.
            ValueError: If that is no environment, or an egocentric one, or no seed.
        """
        whole_number(seed, "seed", 0)
        if not hasattr(getattr(env, "unwrapped", None), "state"):
            raise ValueError(f"env is {short_repr(env)}; give an environment, such as parallel_env(problem=problem)")
        if (options := getattr(env.unwrapped, "options", None)) is not None:
            options.require_physical_units()
        self.problem = env.unwrapped.problem

    @abstractmethod
    def act(self, observations: Observations, state: FloatArray) -> Actions:
        """Controls for the agents in ``observations``.

        Args:
            observations: The environment's observations; their keys are the agents that act.
            state: ``env.state()``; :func:`d4orm_env.envs.joint_state.split_state` takes it apart.

        Returns:
            ``{agent: (m,) float32 control}``. All that come with the package are inside the robot's own limits, so that
            the step, or a real robot, executes them as they are; see :func:`within_limits`.

        Raises:
            RuntimeError: Before the first reset, if the policy needs one, after one that failed, or if another thread
                uses the policy.
            ValueError: If the observations are not by agent of this team, or what the policy reads of them or of the
                state has another size or is not finite.
        """

    def observation_options(self, problem: Problem) -> Mapping[str, object]:
        """Arguments of an environment of this problem on what robots observe; by default it stays as it is."""
        return {}

    def identity(self) -> dict[str, object]:
        """Identity by which a store of trials distinguishes this instance from others of its class, as JSON has it.

        By default the settings in ``config``, if it has any, else its attributes, which are digests unless they are
        numbers or text, without what a reset has left.

        Raises:
            ValueError: If one of these cannot be told from others of its kind, as an open file.
        """
        config = getattr(self, "config", None)
        if isinstance(config, CheckedSettings):
            return self.identity_with(config)
        return {name: value for name, value in attributes(self).items() if name not in (ATTRIBUTE, "problem")}

    @classmethod
    def identity_with(cls, config: CheckedSettings) -> dict[str, object]:
        """The same of an instance with these settings; a subclass adds the content of files that they name."""
        return config.keywords()


class StatePolicy(Policy):
    """A policy that goes by the joint state: a subclass says what the whole team does, by :meth:`_controls`."""

    def reset(self, env: ParallelEnv, seed: int = 0) -> None:
        super().reset(env, seed)
        self._begin(env, seed)

    def act(self, observations: Observations, state: FloatArray) -> Actions:
        robots = acting_robots(self, observations)
        controls = limit_controls(self.problem, self._controls(split_state(self.problem, state)))
        return {agent: controls[robot] for agent, robot in zip(observations, robots)}

    def _begin(self, env: ParallelEnv, seed: int) -> None:
        """Prepare for an episode, beyond looking at the problem."""

    @abstractmethod
    def _controls(self, joint: JointState) -> FloatArray:
        """``(K, m)`` controls of the whole team."""


def robot_indices(agents: Iterable[str]) -> list[int]:
    """Return the numbers of the robots ``"robot_0"``, ..."""
    return [int(agent.rsplit("_", 1)[1]) for agent in agents]


def within_limits(problem: Problem, actions: Actions) -> Actions:
    """Actions as the step executes them: each inside its robot's own limits.

    What is no action of this team, such as one that is not finite, stays as it is: the environment says what is wrong.

    Args:
        problem: Problem of the robots.
        actions: ``(m,)`` controls by agent.
    """
    controls, size = np.zeros((problem.num_robots, problem.control_size), np.float32), (problem.control_size,)
    robots = robots_by_agent(problem.num_robots)
    if not isinstance(actions, Mapping):
        return actions
    for agent, action in actions.items():
        try:
            control = as_float32(action)
        except ValueError:
            return actions
        if agent not in robots or control.shape != size or not usable(control).all():
            return actions
        controls[robots[agent]] = control
    controls = limit_controls(problem, controls)
    return {agent: controls[robots[agent]] for agent in actions}


class FunctionPolicy(Policy):
    """A function ``(observations, state) -> actions``, or ``observation -> action`` of every robot by itself."""

    def __init__(self, function: Callable[..., Any], of_team: bool) -> None:
        self.function, self.of_team = function, of_team

    def act(self, observations: Observations, state: FloatArray) -> Actions:
        acting_robots(self, observations)
        if self.of_team:
            return within_limits(self.problem, self.function(observations, state))
        return within_limits(self.problem, {agent: self.function(seen) for agent, seen in observations.items()})


class OpenLoop(StatePolicy):
    """Plans once at the reset and executes the plan, whatever happens.

    Attributes:
        planner: Planner that makes the plan.
        plan: The plan of the present episode.

    Raises:
        ValueError: If neither or both are given, or one is none; at the reset, if the plan is for another problem.
    """

    name = "open-loop"

    def __init__(
        self, planner: Planner | None = None, plan: Plan | None = None, time_limit: float | None = None
    ) -> None:
        if (planner is None) == (plan is None):
            raise ValueError("an open-loop policy needs either a planner or a plan")
        if not isinstance(planner, Planner | None) or not isinstance(plan, Plan | None):
            given = short_repr(planner if plan is None else plan)
            raise ValueError(
                f"an open-loop policy takes a planner, or plan= of a Plan, as load_plan() reads, not {given}"
            )
        self.planner, self.plan, self.time_limit = planner, plan, time_limit

    def _begin(self, env: ParallelEnv, seed: int) -> None:
        if self.planner is not None:
            limit = env.unwrapped.options.communication_range
            planner = self.planner if limit is None else self.planner.within(limit)
            self.plan = planner.solve(self.problem, seed=seed, time_limit=self.time_limit)
        elif self.plan is not None and self.plan.problem != self.problem:
            raise ValueError(
                "the plan was made for another problem than the environment's; plan for this one, keep one with "
                "randomize_instance=False, or give a Controller, which holds back some of the limits, reserve=0"
            )

    def identity(self) -> dict[str, object]:
        if self.planner is not None:
            return {"planner": self.planner.name, **self.planner.config.keywords(), "time_limit": self.time_limit}
        assert self.plan is not None
        return {"controls": hashlib.sha256(self.plan.controls.tobytes()).hexdigest()}

    def _controls(self, joint: JointState) -> FloatArray:
        assert self.plan is not None
        controls, step = self.plan.controls, joint.steps
        return controls[step] if step < len(controls) else np.zeros_like(controls[0])


class GoToGoal(StatePolicy):
    """Drives straight to the goal and brakes for it, as if it were alone."""

    name = "go-to-goal"

    def _controls(self, joint: JointState) -> FloatArray:
        return drive_to_goal(self.problem, joint.states, joint.goals)


class RandomControls(StatePolicy):
    """Controls drawn uniformly from the box of each robot's limits, and then clipped to what it can do."""

    name = "random"

    def _begin(self, env: ParallelEnv, seed: int) -> None:
        self._generator = generator(seed, Stream.RANDOM_CONTROLS)

    def _controls(self, joint: JointState) -> FloatArray:
        return np.asarray(self._generator.uniform(*self.problem.team.control_bounds), np.float32)


def makes_policy(kind: object) -> TypeGuard[Callable[..., object]]:
    """Check whether something takes settings and makes a policy, rather than acts itself."""
    return isinstance(kind, type) or (not acts(kind) and callable(kind) and required_parameters(kind) == 0)


def acts(thing: object) -> TypeGuard[Policy]:
    """Check whether a thing has what a policy must have."""
    return callable(getattr(thing, "reset", None)) and callable(getattr(thing, "act", None))


def as_policy(thing: Any, owner: str) -> Policy:
    """Wrap what acts itself as a policy. Raises ValueError if it does not."""
    if isinstance(thing, Planner):
        return OpenLoop(thing)
    if acts(thing) and not isinstance(thing, type):
        check_call(thing.act, f"{owner}: act", "observations", "state")
        check_call(thing.reset, f"{owner}: reset", "env", seed=0)
        return thing
    count = required_parameters(thing) if callable(thing) and not isinstance(thing, type) else 0
    if count not in (1, 2):
        remedy = (
            "it must have reset and act, or be a function of (observations, state) or of one robot's observation, "
            "distinguished by their required positional parameters"
        )
        if hasattr(thing, "forward"):
            remedy = "give it as from_torch(module), from d4orm_planners.base.adapters"
        raise ValueError(f"{owner} is {short_repr(thing)}, which does not act; {remedy}")
    return FunctionPolicy(thing, of_team=count == 2)
