"""One of the policies that drive the same scene side by side: its team, in an episode that goes on and is recorded.

A frame of it is what the page shows.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray
from d4orm_env.core.gaps import nearest
from d4orm_env.core.portable import NUMPY_OPS
from d4orm_env.core.problem import Problem
from d4orm_env.core.trajectory import Trajectory
from d4orm_env.disturbances.disturbance import AnyDisturbance
from d4orm_env.disturbances.robot_faults import pushed
from d4orm_env.envs.joint_state import JointState, split_state
from d4orm_env.render.replay import ReplayMotion, motion
from d4orm_planners.base.episode import open_env
from d4orm_planners.base.planner_registry import setting_names
from d4orm_planners.base.policy import Policy
from d4orm_planners.play.edits import check_robot

MOST_STEPS = 6000  #: Ten minutes at the usual time step; what is older is forgotten
MOST_CYCLES = 10_000_000  #: Steps of an episode that ends only when it is changed
HORIZON = "predict_horizon"  #: Setting of policies that look ahead


@dataclass(frozen=True)
class Status:
    """Common status of all that drive side by side."""

    generation: int  #: Counts changes of team, world and policies
    number: int  #: Counts moments
    time: float  #: Simulated seconds since the scene was made
    since: float  #: ``time.perf_counter()`` when this moment began
    pace: float  #: Seconds from one step to the next at this speed
    state: str  #: ``"running"``, ``"paused"``, ``"planning"`` or ``"arrived"``
    message: str  #: Last error, for people
    refused: int  #: Counts what was asked for and could not be


@dataclass(frozen=True, eq=False)
class Frame:
    """A moment of a team that a policy drives: read by the page while the session goes on."""

    status: Status  #: Common status
    policy: str  #: Name of what drives
    problem: Problem  #: Team and world; its start and goals are those of the last change
    states: FloatArray  #: ``(K, n)`` now
    before: FloatArray  #: ``(K, d)`` positions a step ago [m]
    goals: FloatArray  #: ``(K, d)`` [m]
    arrived: BoolArray  #: ``(K,)``
    collided: BoolArray  #: ``(K,)``
    loop: float  #: Seconds that the policy took for this step
    replanned: float  #: Seconds that it took to plan after the last change
    closest: float  #: Least distance between surfaces [m], negative in contact
    plan: FloatArray | None  #: ``(P, K, d)`` where the policy has just planned to lead the team, if it says so
    guidance: FloatArray | None  #: ``(P, K, d)`` the coarse plan that it follows, likewise
    subgoals: FloatArray | None  #: ``(K, d)`` what it heads for next, likewise
    bodies: FloatArray  #: ``(N, 2 d + 1)`` position [m], velocity [m/s] and radius [m] of what is no robot

    def positions(self, now: float) -> FloatArray:
        """``(K, d)`` where to draw the robots at a time of ``time.perf_counter()``: on their way here."""
        return self.before + self._share(now) * (self.states[:, : self.problem.dimension] - self.before)

    def body_positions(self, now: float) -> FloatArray:
        """``(N, d)`` likewise for what is no robot."""
        d = self.problem.dimension
        return self.bodies[:, :d] - (1 - self._share(now)) * np.float32(self.problem.dt) * self.bodies[:, d : 2 * d]

    def _share(self, now: float) -> np.float32:
        """Return the share of the step before this moment that has been shown."""
        status = self.status
        return np.float32(min(max((now - status.since) / max(status.pace, 1e-3), 0.0), 1.0))


class EpisodeBuffer:
    """Steps since team, world or policies last changed; one thread may add while others make replays."""

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self._snapshots: deque[tuple[np.ndarray, ...]] = deque(maxlen=MOST_STEPS)
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._snapshots)

    def add(self, *snapshot: np.ndarray) -> None:
        """Remember a snapshot: states ``(K, n)``, goals ``(K, d)``, ``(K,)`` who has arrived, collided and come too
        close, and ``(N, 2 d + 1)`` what moves about and is no robot.
        """
        with self._lock:
            self._snapshots.append(snapshot)

    def motion(self, policy: str) -> ReplayMotion:
        with self._lock:
            problem, snapshots = self._problem, list(self._snapshots)
        *stacked, around = zip(*snapshots, strict=True)
        states, goals, arrived, collided, violated = map(np.stack, stacked)
        steps = len(snapshots) - 1
        trajectory = Trajectory(
            states=states,
            positions=states[..., : problem.dimension],
            controls=np.zeros((steps, problem.num_robots, problem.control_size), np.float32),
            rewards=np.zeros((steps, problem.num_robots), np.float32),
            arrived=arrived,
            collided=collided,
            margin_violated=violated,
        )
        bodies = np.zeros((len(snapshots), max(map(len, around)), 2 * problem.dimension + 1), np.float32)
        for row, present in zip(bodies, around):
            row[: len(present)] = present
        return motion(problem, trajectory, f"{policy}, {steps * problem.dt:.1f} s", goals=goals, bodies=bodies)


@dataclass(frozen=True)
class EpisodeOptions:
    """Common options of all that drive side by side."""

    seed: int = 0
    lifelong: bool = False
    observation: Mapping[str, Any] = field(default_factory=dict)
    disturbances: Sequence[AnyDisturbance] = ()
    horizon: int | None = None  #: Steps that policies which predict look ahead, if not their own number

    def settings(self, policy: str) -> dict[str, int]:
        return {} if self.horizon is None or HORIZON not in setting_names(policy) else {HORIZON: self.horizon}


class Viewport:
    """A policy that drives a scene."""

    def __init__(
        self, name: str, policy: Policy, scene: Problem, options: EpisodeOptions, recording: EpisodeBuffer | None = None
    ) -> None:
        self.name, self._policy, self._scene, self._seed = name, policy, scene, options.seed
        # A robot stalls within the scene's usual duration, after which this episode goes on all the same.
        self._env = open_env(
            scene, policy=policy, max_cycles=scene.horizon, lifelong=options.lifelong,
            disturbances=options.disturbances, **options.observation,
        )  # fmt: skip
        self._observations, _ = self._env.reset(seed=options.seed)
        self._env.max_cycles = MOST_CYCLES
        begin = time.perf_counter()
        self.regain()
        self._replanned, self._loop = time.perf_counter() - begin, 0.0
        self._before = scene.start[:, : scene.dimension]
        self.recording = EpisodeBuffer(scene) if recording is None else recording  #: Recording up to now
        self._remember()

    def regain(self) -> None:
        """Have the policy plan for this episode, which it has not seen or has forgotten for another."""
        self._policy.reset(self._env, seed=self._seed)

    @property
    def finished(self) -> bool:
        return not self._env.agents

    @property
    def arrived(self) -> BoolArray:
        """``(K,)`` bool: at the goal for good."""
        return self._joint.arrived & self._scene.docks

    @property
    def farthest(self) -> int:
        """Number of the robot that is farthest from its goal."""
        joint = self._joint
        return int(np.argmax(np.linalg.norm(joint.goals - joint.states[:, : self._scene.dimension], axis=1)))

    @property
    def scene(self) -> Problem:
        """The scene as it is now: where the robots are is where they start, at rest or under way."""
        joint = self._joint
        return self._scene.with_state(joint.states, joint.goals)

    def advance(self) -> None:
        if self.finished:
            return
        before = self._joint.states[:, : self._scene.dimension]
        acting = {agent: self._observations[agent] for agent in self._env.agents}
        begin = time.perf_counter()
        actions = self._policy.act(acting, self._env.state())
        self._loop = time.perf_counter() - begin
        self._observations, *_ = self._env.step(actions)
        self._before = before
        self._remember()

    def push(self, robot: int, velocity: FloatArray) -> None:
        """Give a robot a velocity ``(d,)`` [m/s] on top of its own, which the policy is not told of.

        As with :class:`~d4orm_env.disturbances.Push`, none becomes faster than it may be. One at its goal for good is
        refused.
        """
        joint, problem = self._joint, self._scene
        check_robot(problem, robot)
        if self.arrived[robot]:
            raise ValueError(f"robot_{robot} of {self.name} has docked; push one that is under way")
        given = np.zeros((1, problem.num_robots, problem.dimension), np.float32)
        given[0, robot] = velocity
        states = pushed(problem, joint.states[None].copy(), given)[0]
        own, limits = tuple(states[robot]), tuple(problem.team.limits[robot])
        within = problem.team.robot_models[robot].functions.limit_state(own, limits, NUMPY_OPS)
        states[robot, : len(within)] = within
        self._observations, _ = self._env.set_state(states)

    def frame(self, status: Status) -> Frame:
        joint, coarse = self._joint, getattr(self._policy, "guidance", None)
        return Frame(
            status=status,
            policy=self.name,
            problem=self._scene,
            states=joint.states,
            before=self._before,
            goals=joint.goals,
            arrived=joint.arrived,
            collided=np.array(self._env.last_step.collided),
            loop=self._loop,
            replanned=self._replanned,
            closest=nearest(self._scene, joint.states),
            plan=_plan(self._policy, joint.steps),
            guidance=None if coarse is None else np.asarray(coarse.path, np.float32),
            subgoals=getattr(self._policy, "subgoals", None),
            bodies=self._bodies,
        )

    @property
    def _joint(self) -> JointState:
        """The truth, whatever the policy is told of it."""
        return split_state(self._scene, self._env.true_state())

    @property
    def _bodies(self) -> FloatArray:
        """``(N, 2 d + 1)`` what moves about and is no robot."""
        bodies = self._env.effect().bodies
        return np.zeros((0, 2 * self._scene.dimension + 1), np.float32) if bodies is None else np.array(bodies[0])

    def _remember(self) -> None:
        joint, last = self._joint, self._env.last_step
        self.recording.add(joint.states, joint.goals, joint.arrived, last.collided, last.margin_violated, self._bodies)


def _plan(policy: object, steps: int) -> FloatArray | None:
    """``(P, K, d)`` where a policy that predicts, or executes a plan, leads the team after so many steps."""
    predicted, whole = getattr(policy, "predicted", None), getattr(policy, "plan", None)
    if predicted is not None:
        return np.asarray(predicted, np.float32)
    return None if whole is None else np.asarray(whole.trajectory.positions[steps:], np.float32)
