"""A simulation that goes on by a clock in a thread of its own, and that others may look at and change meanwhile.

The thread plans and steps; only the simulated clock waits for it. Changes are put into a queue and made between
two steps: the team then goes on from where it is, and the policy plans anew. Where several policies drive side by side,
each has a team of its own in the same world, and whatever is changed is changed for all.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from d4orm_env.core.errors import describe, first_line
from d4orm_env.core.problem import Problem
from d4orm_env.core.summary_line import count
from d4orm_env.disturbances.disturbance_registry import disturbances_at
from d4orm_env.render.replay import Replay
from d4orm_planners.base.planner_registry import make_policy, setting_names
from d4orm_planners.base.policy import Policy
from d4orm_planners.play.command_queue import MOST_WAITING, Command, CommandQueue
from d4orm_planners.play.edits import Edit, followed
from d4orm_planners.play.scene_frame import Frame, Status
from d4orm_planners.play.viewport import EpisodeOptions, Viewport

_IDLE = 0.1
_MOST_EDITING = 0.25
"""Seconds from one step to the next after which no other change is begun; the clock goes on first."""

HORIZON = "predict_horizon"
"""Setting of policies that look ahead."""

MOST_LANES = 6


class Session:
    """A team in its world, driven by a policy, or by several side by side.

    Args:
        problem: The scene to begin with.
        policies: Names of what drives; of :func:`~d4orm_planners.list_policies`.
        seed: Of the policies, of what goes wrong, and of new goals.
        lifelong: Whether robots go on to new goals.

    Attributes:
        failure: Error that ended the thread, if it was not :meth:`close`.

    Raises:
        ValueError: If there is no such policy, or it cannot drive there.
    """

    def __init__(self, problem: Problem, *policies: str, seed: int = 0, lifelong: bool = False) -> None:
        self._loaded, self._names = problem, policies or ("d4orm-c2f",)
        self._terms, self._levels = EpisodeOptions(seed, lifelong), dict[str, float]()
        self._policies: dict[tuple[str, int | None], Policy] = {}
        self._horizon: int | None = None
        self._commands = CommandQueue()
        self._paused, self._steps_wanted, self._speed = False, 0, 1.0
        self._status = Status(0, 0, 0.0, 0.0, problem.dt, "planning", "", 0)
        self._frames: tuple[Frame, ...] = ()
        self._lanes: tuple[Viewport, ...] = ()
        self.failure: BaseException | None = None
        self._thread = threading.Thread(target=self._live, name="d4orm-play", daemon=True)
        self._begin([problem] * len(self._names), afresh=True)

    @property
    def frames(self) -> tuple[Frame, ...]:
        """The present moment of all that drive, in their order."""
        return self._frames

    @property
    def frame(self) -> Frame:
        """The present moment of the first that drives."""
        return self._frames[0]

    @property
    def policies(self) -> tuple[str, ...]:
        """Names of what drives."""
        return self._names

    @property
    def levels(self) -> Mapping[str, float]:
        """Disturbances, by name and level."""
        return self._levels

    @property
    def scene(self) -> Problem:
        """The scene as the first that drives has it now, for a file: where the robots are is where they start."""
        frame = self.frame
        return frame.problem.with_state(frame.states, frame.goals)

    @property
    def recorded_steps(self) -> int:
        """Number of steps since team, world or policies last changed."""
        return len(self._lanes[0].recording) - 1

    def replay(self) -> Replay:
        """Return a replay since team, world or policies last changed, side by side."""
        lanes = self._lanes
        scene = lanes[0].scene
        motions = [lane.recording.motion(lane.name) for lane in lanes]
        return Replay(f"{scene.name}, {count(scene.num_robots, 'robot')} by {', '.join(self._names)}", tuple(motions))

    def start(self) -> None:
        """Let the clock run."""
        self._thread.start()

    def close(self) -> None:
        """Stop the clock and wait for the thread."""
        self._commands.close()
        if self._thread.is_alive():
            self._thread.join()

    def refuse(self, reason: str) -> None:
        """Say why a request is refused."""

        def make() -> None:
            raise ValueError(reason)

        self._post(make, "refusal")

    def edit(self, edit: Edit, lane: int = 0) -> None:
        """Change the scene between two steps; what cannot be is left, and the next frame's message says why.

        Args:
            edit: The change.
            lane: Number of the team that it goes by, where several drive side by side; all others follow.
        """

        def make() -> None:
            before = [one.scene for one in self._lanes]
            leader = min(lane, len(before) - 1)
            after = edit(before[leader])
            scenes = [
                after if index == leader else followed(before[leader], after, other, self._names[index])
                for index, other in enumerate(before)
            ]
            self._begin(scenes, afresh=after.team is not before[0].team or after.world is not before[0].world)

        self._post(make)

    def push(self, robot: int | None, velocity: ArrayLike, lane: int = 0) -> None:
        """Give a robot a velocity on top of its own at the next step's beginning, in all that drive side by side.

        The policies are not told, and have to find out.

        Args:
            robot: Its number; ``None`` is the one that is farthest from its goal.
            velocity: ``(d,)`` [m/s].
            lane: Whose robot has to be under way, and counts as the farthest.
        """

        def make() -> None:
            given = np.asarray(velocity, np.float32)
            leader = self._lanes[min(lane, len(self._lanes) - 1)]
            chosen = leader.farthest if robot is None else robot
            leader.push(chosen, given)
            for other in self._lanes:
                if other is not leader and not other.docked[chosen]:
                    other.push(chosen, given)
            self._show(self._state)

        self._post(make)

    def load(self, make_scene: Callable[[], Problem], seed: int = 0) -> None:
        """Begin anew with another scene."""

        def make() -> None:
            scene = make_scene()
            self._begin([scene] * len(self._names), terms=replace(self._terms, seed=seed), afresh=True)
            self._loaded = scene

        self._post(make)

    def reset(self) -> None:
        """Begin the scene anew that was loaded last."""
        self._post(lambda: self._begin([self._loaded] * len(self._names), afresh=True))

    def choose(self, *policies: str) -> None:
        """Let other policies drive on from here, side by side; one that comes in begins where the first is."""

        def make() -> None:
            if policies == self._names:
                return
            if not 1 <= len(set(policies)) == len(policies) <= MOST_LANES:
                raise ValueError(f"{len(policies)} policies are chosen; choose 1 to {MOST_LANES}, each once")
            scenes = {lane.name: lane.scene for lane in self._lanes}
            self._begin([scenes.get(name, self._lanes[0].scene) for name in policies], names=policies, afresh=True)

        self._post(make, "policies")

    def set_horizon(self, steps: int) -> None:
        """Set the steps that a policy which predicts looks ahead; others have no such setting."""

        def make() -> None:
            former, self._horizon = self._horizon, steps
            try:
                self._begin_here()
            except Exception:
                self._horizon = former
                raise

        self._post(make, "horizon")

    def set_lifelong(self, lifelong: bool) -> None:
        """Set whether robots that arrive go on to new goals."""
        self._post(lambda: self._begin_here(replace(self._terms, lifelong=lifelong)), "lifelong")

    def disturb(self, levels: Mapping[str, float]) -> None:
        """Set the disturbances from the next step on.

        Args:
            levels: Names and levels of :func:`~d4orm_env.disturbances.disturbance_registry.disturbances_at`.
        """

        def make() -> None:
            if levels != self._levels:
                self._begin_here(replace(self._terms, disturbances=disturbances_at(levels)))
                self._levels = dict(levels)

        self._post(make, "disturbances")

    def pause(self, paused: bool) -> None:
        """Stop the clock, or let it run."""

        def make() -> None:
            self._paused, self._steps_wanted = paused, 0
            self._show(self._state)

        self._post(make, "paused")

    def step(self) -> None:
        """Stop the clock after one step."""

        def make() -> None:
            self._paused, self._steps_wanted = True, 1

        self._post(make, "step")

    def set_speed(self, speed: float) -> None:
        """Set how many times faster than real time the clock runs."""
        self._speed = min(max(float(speed), 0.05), 50.0)

    def _post(self, command: Command, setting: str | None = None) -> None:
        self._commands.put(command, setting)

    def _live(self) -> None:
        try:
            due = time.perf_counter()
            while not self._commands.closed:
                if self._obey():
                    due = time.perf_counter()
                if self._state != "running" and not self._steps_wanted:
                    self._commands.wait(_IDLE)
                    due = time.perf_counter()
                    continue
                left = due - time.perf_counter()
                if left > 0 and not self._steps_wanted:
                    self._commands.wait(left)
                    continue
                self._steps_wanted = 0
                due = max(due, time.perf_counter() - self._pace) + self._pace
                self._advance_or_pause()
        except BaseException as error:
            self.failure = error

    def _advance_or_pause(self) -> None:
        """One step; where there is none, such as without room for a lifelong goal, a pause that says why."""
        try:
            if any(not lane.finished for lane in self._lanes):
                for lane in self._lanes:
                    lane.advance()
                self._status = replace(self._status, time=self._status.time + self._lanes[0].scene.dt)
                self._show(self._state, moved=True)
        except Exception as error:  # of policies, whatever they are
            self._paused = True
            self._show(self._state, _told(error))

    def _obey(self) -> bool:
        """Do what was asked for meanwhile, or some of it if that takes long; whether there was anything."""
        begin, obeyed = time.perf_counter(), False
        while time.perf_counter() - begin < _MOST_EDITING and (command := self._commands.take()) is not None:
            obeyed = True
            self._status = replace(self._status, message="")
            try:
                command()
            except Exception as error:  # nothing that anybody asks for ends the session
                self._say_refused(1, _told(error))
        if dropped := self._commands.dropped():
            self._say_refused(dropped, f"{dropped} changes are left, as {MOST_WAITING} were waiting; make them slower")
        return obeyed

    def _say_refused(self, changes: int, reason: str) -> None:
        self._status = replace(self._status, refused=self._status.refused + changes)
        self._show(self._state, reason)

    @property
    def _pace(self) -> float:
        return self.frame.problem.dt / self._speed

    @property
    def _state(self) -> str:
        if self._paused:
            return "paused"
        return "arrived" if all(lane.finished for lane in self._lanes) else "running"

    def _begin_here(self, terms: EpisodeOptions | None = None) -> None:
        """Go on from the present states."""
        self._begin([lane.scene for lane in self._lanes], terms=terms)

    def _begin(
        self,
        scenes: Sequence[Problem],
        names: tuple[str, ...] | None = None,
        terms: EpisodeOptions | None = None,
        afresh: bool = False,
    ) -> None:
        """Go on from scenes, one for each policy: episodes of their own, which the policies plan for.

        What fails leaves everything as it was.
        """
        names, terms = names or self._names, terms or self._terms
        recordings = [None] * len(names) if afresh else [lane.recording for lane in self._lanes]
        if self._frames:
            self._show("planning")
        try:
            lanes = tuple(
                Viewport(name, self._driver(name), scene, terms, recording)
                for name, scene, recording in zip(names, scenes, recordings, strict=True)
            )
        except Exception:
            for lane in self._lanes:  # what drove until now may have forgotten where it was
                lane.regain()
            raise
        self._lanes, self._names, self._terms = lanes, names, terms
        if afresh:
            self._status = replace(self._status, generation=self._status.generation + 1, time=0.0)
        self._show(self._state, moved=True)

    def _driver(self, name: str) -> Policy:
        """The policy of a name, made when it is first needed: some hold threads, so there is one of each."""
        horizon = self._horizon if HORIZON in setting_names(name) else None
        if (name, horizon) not in self._policies:
            settings = {} if horizon is None else {HORIZON: horizon}
            self._policies[name, horizon] = make_policy(name, **settings)
        return self._policies[name, horizon]

    def _show(self, state: str, message: str | None = None, moved: bool = False) -> None:
        """Make frames of the present; without another message the last one stays."""
        dt = self._lanes[0].scene.dt
        self._status = replace(
            self._status,
            number=self._status.number + 1,
            since=time.perf_counter() if moved else self._status.since,
            pace=dt / self._speed,
            state=state,
            message=self._status.message if message is None else message,
        )
        self._frames = tuple(lane.frame(self._status) for lane in self._lanes)


def _told(error: Exception) -> str:
    """An error for people; with its kind where it was not written for them."""
    return first_line(error) if isinstance(error, ValueError | RuntimeError | ImportError) else describe(error)
