"""A simulation that goes on by a clock in a thread of its own, and that others may look at and change meanwhile.

The thread plans and steps; nobody waits for it but the simulated clock. Changes are put into a queue and made between
two steps: the team then goes on from where it is, and the policy plans anew.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from d4orm_env import navigation_v0
from d4orm_env.core.arrays import FloatArray
from d4orm_env.core.errors import first_line
from d4orm_env.core.problem import Problem
from d4orm_env.joint_state import JointState, split_state
from d4orm_env.render.replay import Replay
from d4orm_planners.play.edits import Edit
from d4orm_planners.play.frame import Frame, closest_approach, guidance
from d4orm_planners.play.recording import Recording, compared
from d4orm_planners.policy import Policy
from d4orm_planners.registry import make_policy, setting_names

MOST_CYCLES = 10_000_000
_IDLE = 0.1

HORIZON = "predict_horizon"
"""Setting of policies that look ahead."""


class Session:
    """A team in its world, driven by a policy.

    Args:
        problem: The scene to begin with.
        policy: Name of what drives; one of :func:`~d4orm_planners.list_policies`.
        seed: Of the policy, and of new goals.
        lifelong: Whether robots go on to new goals.

    Attributes:
        failure: What ended the thread, if it was not :meth:`close`.
    """

    def __init__(self, problem: Problem, policy: str = "d4orm-c2f", seed: int = 0, lifelong: bool = False) -> None:
        self._scene, self._policy_name, self._seed, self._lifelong = problem, policy, seed, lifelong
        self._policies: dict[tuple[str, int | None], Policy] = {}
        self._horizon: int | None = None
        self._commands: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._wake, self._closing = threading.Event(), threading.Event()
        self._paused, self._steps_wanted, self._speed = False, 0, 1.0
        self._generation = self._number = 0
        self._frame: Frame
        self._env: navigation_v0.parallel_env
        self._policy: Policy
        self._message = ""
        self.failure: BaseException | None = None
        self._thread = threading.Thread(target=self._live, name="d4orm-play", daemon=True)
        self._begin(problem, new_scene=True)

    @property
    def frame(self) -> Frame:
        """The present moment."""
        return self._frame

    @property
    def policy(self) -> str:
        """Name of what drives."""
        return self._policy_name

    @property
    def scene(self) -> Problem:
        """The scene as it is now, for a file: where the robots are is where they start, at rest or under way."""
        frame = self._frame
        return frame.problem.resumed_at(frame.states, frame.goals)

    @property
    def recording(self) -> Recording:
        """What happened since team or world last changed."""
        return self._recording

    def start(self) -> None:
        """Let the clock run."""
        self._thread.start()

    def close(self) -> None:
        """Stop the clock and wait for the thread."""
        self._closing.set()
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join()

    def edit(self, edit: Edit) -> None:
        """Change the scene between two steps; what cannot be is left, and the next frame's message says why."""

        def make() -> None:
            scene = edit(self.scene)
            old = self._frame.problem
            self._begin(scene, new_scene=scene.team is not old.team or scene.world is not old.world)

        self._post(make)

    def load(self, make_scene: Callable[[], Problem], seed: int = 0) -> None:
        """Begin anew with another scene."""

        def make() -> None:
            scene, former = make_scene(), self._seed
            self._seed = seed
            try:
                self._begin(scene, new_scene=True)
            except Exception:
                self._seed = former
                raise
            self._scene = scene

        self._post(make)

    def reset(self) -> None:
        """Begin the scene anew that was loaded last."""
        self._post(lambda: self._begin(self._scene, new_scene=True))

    def choose(self, policy: str) -> None:
        """Let another policy drive on from here."""

        def make() -> None:
            former, self._policy_name = self._policy_name, policy
            try:
                self._begin(self.scene, new_scene=False)
            except Exception:
                self._policy_name = former
                raise

        self._post(make)

    def set_horizon(self, steps: int) -> None:
        """How many steps a policy that predicts looks ahead; others have no such setting."""

        def make() -> None:
            former, self._horizon = self._horizon, steps
            try:
                self._begin(self.scene, new_scene=False)
            except Exception:
                self._horizon = former
                raise

        self._post(make)

    def compare(self, policies: Sequence[str], done: Callable[[Replay], object]) -> None:
        """Let several policies do the scene that was loaded last, with the same seed; the clock waits meanwhile.

        Args:
            policies: Names.
            done: What is called with them side by side.
        """

        def make() -> None:
            self._frame = replace(self._frame, state="planning")
            replay = compared(self._scene, policies, self._seed)
            self._show(self._frame.before, state=self._state)
            done(replay)

        self._post(make)

    def set_lifelong(self, lifelong: bool) -> None:
        """Whether robots that arrive go on to new goals."""

        def make() -> None:
            self._lifelong = lifelong
            self._begin(self.scene, new_scene=False)

        self._post(make)

    def pause(self, paused: bool) -> None:
        """Stop the clock, or let it run."""

        def make() -> None:
            self._paused, self._steps_wanted = paused, 0
            self._show(self._frame.before, state=self._state)

        self._post(make)

    def step(self) -> None:
        """Stop the clock after one step."""

        def make() -> None:
            self._paused, self._steps_wanted = True, 1

        self._post(make)

    def set_speed(self, speed: float) -> None:
        """How many times faster than real time the clock runs."""
        self._speed = min(max(float(speed), 0.05), 50.0)

    def _post(self, command: Callable[[], None]) -> None:
        self._commands.put(command)
        self._wake.set()

    def _live(self) -> None:
        try:
            due = time.perf_counter()
            while not self._closing.is_set():
                if self._obey():
                    due = time.perf_counter()
                if self._state != "running" and not self._steps_wanted:
                    self._wake.wait(_IDLE)
                    self._wake.clear()
                    due = time.perf_counter()
                    continue
                left = due - time.perf_counter()
                if left > 0 and not self._steps_wanted:
                    self._wake.wait(left)
                    self._wake.clear()
                    continue
                self._steps_wanted = 0
                due = max(due, time.perf_counter() - self._pace) + self._pace
                self._advance_or_pause()
        except BaseException as error:
            self.failure = error

    def _advance_or_pause(self) -> None:
        """One step; where there is none, such as without room for a lifelong goal, a pause that says why."""
        try:
            self._advance()
        except (ValueError, RuntimeError) as error:
            self._message, self._paused = first_line(error), True
            self._show(self._frame.before, state=self._state)

    def _obey(self) -> bool:
        """Do what was asked for meanwhile; whether there was anything."""
        obeyed = False
        while not self._commands.empty():
            obeyed, self._message = True, ""
            try:
                self._commands.get()()
            except (ValueError, RuntimeError, ImportError) as error:
                self._message = first_line(error)
                self._show(self._frame.before, state=self._state)
        return obeyed

    @property
    def _pace(self) -> float:
        return self._frame.problem.dt / self._speed

    @property
    def _state(self) -> str:
        if self._paused:
            return "paused"
        return "running" if self._env.agents else "arrived"

    def _begin(self, scene: Problem, new_scene: bool) -> None:
        """Go on from a scene: an episode of its own, which the policy plans for."""
        env = navigation_v0.parallel_env(problem=scene, lifelong=self._lifelong, max_cycles=MOST_CYCLES)
        observations, _ = env.reset(seed=self._seed)
        if self._number:
            self._frame = replace(self._frame, state="planning")
        begin = time.perf_counter()
        policy = self._driver()
        try:
            policy.reset(env, seed=self._seed)
        except Exception:
            if self._number:  # what drove until now may have forgotten where it was
                self._policy.reset(self._env, seed=self._seed)
            raise
        self._replanned, self._loop = time.perf_counter() - begin, 0.0
        self._env, self._observations, self._policy = env, observations, policy
        if new_scene:
            self._generation += 1
            self._time = 0.0
            self._recording = Recording(scene)
        self._problem = scene
        self._remember()
        self._show(scene.start[:, : scene.dimension], state=self._state)

    def _driver(self) -> Policy:
        """The policy that drives, made when it is first needed: some hold threads, so there is one of each."""
        name = self._policy_name
        horizon = self._horizon if HORIZON in setting_names(name) else None
        if (name, horizon) not in self._policies:
            settings = {} if horizon is None else {HORIZON: horizon}
            self._policies[name, horizon] = make_policy(name, **settings)
        return self._policies[name, horizon]

    def _advance(self) -> None:
        """One step of the policy and of the world."""
        if not self._env.agents:
            return
        before = self._frame.states[:, : self._problem.dimension]
        acting = {agent: self._observations[agent] for agent in self._env.agents}
        begin = time.perf_counter()
        actions = self._policy.act(acting, self._env.state())
        self._loop = time.perf_counter() - begin
        self._observations, *_ = self._env.step(actions)
        self._time += self._problem.dt
        self._remember()
        self._show(before, state=self._state)

    @property
    def _joint(self) -> JointState:
        return split_state(self._problem, self._env.state())

    def _remember(self) -> None:
        joint, last = self._joint, self._env.last_step
        self._recording.add(joint.states, joint.goals, joint.arrived, last.collided, last.margin_violated)

    def _show(self, before: FloatArray, state: str) -> None:
        """Make a frame of the present."""
        joint, last = self._joint, self._env.last_step
        self._number += 1
        self._frame = Frame(
            problem=self._problem,
            generation=self._generation,
            number=self._number,
            states=joint.states,
            before=before,
            goals=joint.goals,
            arrived=joint.arrived,
            collided=np.array(last.collided),
            time=self._time,
            since=time.perf_counter(),
            pace=self._problem.dt / self._speed,
            loop=self._loop,
            replanned=self._replanned,
            closest=closest_approach(self._problem, joint.states),
            guidance=guidance(self._policy, joint.steps),
            subgoals=getattr(self._policy, "subgoals", None),
            state=state,
            message=self._message,
        )
