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
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from d4orm_env.core.errors import describe, first_line
from d4orm_env.core.problem import Problem
from d4orm_env.core.summary_line import count
from d4orm_env.disturbances.disturbance_registry import disturbances_at
from d4orm_env.render.replay import Replay
from d4orm_planners.base.planner_registry import make_policy
from d4orm_planners.play.edits import MOST_WAITING, CommandQueue, Edit, followed, queued
from d4orm_planners.play.viewport import EpisodeOptions, Frame, Status, Viewport

_IDLE = 0.1
_MOST_EDITING = 0.25  #: Seconds after a step from which no other change is begun; the clock goes first
MOST_VIEWPORTS = 6


class Session:
    """A team in its world, driven by ``policies``, side by side if several, under disturbances of ``levels`` by name.

    ValueError if there is no such policy, or it cannot drive there.
    """

    def __init__(
        self, problem: Problem, *policies: str, seed: int = 0, lifelong: bool = False, **observation: Any
    ) -> None:
        self._loaded, self.policies = problem, policies or ("d4orm-c2f",)
        self._options, self.levels = EpisodeOptions(seed, lifelong, observation), dict[str, float]()
        self._driver = cache(make_policy)  # some hold threads, so there is one of each
        self.commands = CommandQueue()  #: What was asked for by methods that wait for the next step
        self._paused, self._steps_wanted, self._speed = False, 0, 1.0
        self._status = Status(0, 0, 0.0, 0.0, problem.dt, "planning", "", 0)
        self.frames: tuple[Frame, ...] = ()  #: The present moment of all that drive, in their order
        self._viewports: tuple[Viewport, ...] = ()
        self.failure: BaseException | None = None  #: Error that ended the thread, if it was not :meth:`close`
        self._thread = threading.Thread(target=self._live, name="d4orm-play", daemon=True)
        self._begin([problem] * len(self.policies), afresh=True)

    @property
    def frame(self) -> Frame:
        """The present moment of the first that drives."""
        return self.frames[0]

    @property
    def scene(self) -> Problem:
        """The scene as the first that drives has it now, for a file: where the robots are is where they start."""
        frame = self.frame
        return frame.problem.with_state(frame.states, frame.goals)

    @property
    def busy(self) -> bool:
        """True while changes wait or are made."""
        return not self.commands.empty or self.frame.status.state == "planning"

    def replay(self) -> Replay:
        """Return a replay since team, world or policies last changed, side by side."""
        viewports = self._viewports
        scene = viewports[0].scene
        motions = [viewport.recording.motion(viewport.name) for viewport in viewports]
        return Replay(f"{scene.name}, {count(scene.num_robots, 'robot')} by {', '.join(self.policies)}", tuple(motions))

    def start(self) -> None:
        self._thread.start()

    def close(self) -> None:
        """Stop the clock and wait for the thread."""
        self.commands.close()
        if self._thread.is_alive():
            self._thread.join()

    @queued("refusal")
    def refuse(self, reason: str) -> None:
        raise ValueError(reason)

    @queued()
    def edit(self, edit: Edit, viewport: int = 0) -> None:
        """Change the scene between two steps, as the team of this viewport has it; all others follow.

        What cannot be is left, and the next frame's message says why.
        """
        before = [one.scene for one in self._viewports]
        leader = min(viewport, len(before) - 1)
        after = edit(before[leader])
        scenes = [
            after if index == leader else followed(before[leader], after, other, self.policies[index])
            for index, other in enumerate(before)
        ]
        self._begin(scenes, afresh=after.team is not before[0].team or after.world is not before[0].world)

    @queued()
    def push(self, robot: int | None, velocity: ArrayLike, viewport: int = 0) -> None:
        """Give a robot a velocity ``(d,)`` on top of its own at the next step's beginning [m/s], in all that drive side
        by side.

        ``None`` is the one of this viewport that is farthest from its goal. The policies are not told, and have to find
        out.
        """
        given = np.asarray(velocity, np.float32)
        leader = self._viewports[min(viewport, len(self._viewports) - 1)]
        chosen = leader.farthest if robot is None else robot
        leader.push(chosen, given)
        for other in self._viewports:
            if other is not leader and not other.arrived[chosen]:
                other.push(chosen, given)
        self._show(self._state)

    @queued()
    def load(self, make_scene: Callable[[], Problem], seed: int = 0) -> None:
        scene = make_scene()
        self._begin([scene] * len(self.policies), options=replace(self._options, seed=seed), afresh=True)
        self._loaded = scene

    @queued()
    def reset(self) -> None:
        """Begin the scene anew that was loaded last."""
        self._begin([self._loaded] * len(self.policies), afresh=True)

    @queued("policies")
    def choose(self, *policies: str) -> None:
        """Let other policies drive on from here, side by side; one that comes in begins where the first is."""
        if policies == self.policies:
            return
        if not 1 <= len(set(policies)) == len(policies) <= MOST_VIEWPORTS:
            raise ValueError(f"{len(policies)} policies are chosen; choose 1 to {MOST_VIEWPORTS}, each once")
        scenes = {viewport.name: viewport.scene for viewport in self._viewports}
        self._begin([scenes.get(name, self._viewports[0].scene) for name in policies], names=policies, afresh=True)

    @queued("horizon")
    def set_horizon(self, steps: int) -> None:
        """Set the steps that a policy which predicts looks ahead; others have no such setting."""
        self._begin(options=replace(self._options, horizon=steps))

    @queued("lifelong")
    def set_lifelong(self, lifelong: bool) -> None:
        self._begin(options=replace(self._options, lifelong=lifelong))

    @queued("disturbances")
    def disturb(self, levels: Mapping[str, float]) -> None:
        """Set the disturbances by name and level, from the next step on."""
        if levels != self.levels:
            self._begin(options=replace(self._options, disturbances=disturbances_at(levels)))
            self.levels = dict(levels)

    @queued("paused")
    def pause(self, paused: bool) -> None:
        self._paused, self._steps_wanted = paused, 0
        self._show(self._state)

    @queued("step")
    def step(self) -> None:
        """Stop the clock after one step."""
        self._paused, self._steps_wanted = True, 1

    def set_speed(self, speed: float) -> None:
        """Set how many times faster than real time the clock runs."""
        self._speed = min(max(float(speed), 0.05), 50.0)

    def _live(self) -> None:
        try:
            due = time.perf_counter()
            while not self.commands.closed:
                if self._obey():
                    due = time.perf_counter()
                if self._state != "running" and not self._steps_wanted:
                    self.commands.wait(_IDLE)
                    due = time.perf_counter()
                    continue
                left = due - time.perf_counter()
                if left > 0 and not self._steps_wanted:
                    self.commands.wait(left)
                    continue
                self._steps_wanted = 0
                pace = self.frame.problem.dt / self._speed
                due = max(due, time.perf_counter() - pace) + pace
                self._advance_or_pause()
        except BaseException as error:
            self.failure = error

    def _advance_or_pause(self) -> None:
        """One step; where there is none, such as without room for a lifelong goal, a pause that says why."""
        try:
            if any(not viewport.finished for viewport in self._viewports):
                for viewport in self._viewports:
                    viewport.advance()
                self._status = replace(self._status, time=self._status.time + self._viewports[0].scene.dt)
                self._show(self._state, moved=True)
        except Exception as error:  # of policies, whatever they are
            self._paused = True
            self._say_refused(1, _told(error))

    def _obey(self) -> bool:
        """Do what was asked for meanwhile, or some of it if that takes long; whether there was anything."""
        begin, obeyed = time.perf_counter(), False
        while time.perf_counter() - begin < _MOST_EDITING and (command := self.commands.take()) is not None:
            obeyed = True
            self._status = replace(self._status, message="")
            try:
                command()
            except Exception as error:  # no request of a viewer ends the session
                self._say_refused(1, _told(error))
        if dropped := self.commands.dropped():
            self._say_refused(dropped, f"{dropped} changes are left, as {MOST_WAITING} were waiting; make them slower")
        return obeyed

    def _say_refused(self, changes: int, reason: str) -> None:
        self._status = replace(self._status, refused=self._status.refused + changes)
        self._show(self._state, reason)

    @property
    def _state(self) -> str:
        if self._paused:
            return "paused"
        return "arrived" if all(viewport.finished for viewport in self._viewports) else "running"

    def _begin(
        self,
        scenes: Sequence[Problem] | None = None,
        names: tuple[str, ...] | None = None,
        options: EpisodeOptions | None = None,
        afresh: bool = False,
    ) -> None:
        """Go on from scenes, one for each policy, or from here: episodes of their own, which the policies plan for.

        What fails leaves everything as it was.
        """
        names, options = names or self.policies, options or self._options
        scenes = [viewport.scene for viewport in self._viewports] if scenes is None else scenes
        recordings = [None] * len(names) if afresh else [viewport.recording for viewport in self._viewports]
        if self.frames:
            self._show("planning")
        try:
            viewports = tuple(
                Viewport(name, self._driver(name, **options.settings(name)), scene, options, recording)
                for name, scene, recording in zip(names, scenes, recordings, strict=True)
            )
        except Exception:
            for viewport in self._viewports:  # what drove until now may have forgotten where it was
                viewport.regain()
            raise
        self._viewports, self.policies, self._options = viewports, names, options
        if afresh:
            self._status = replace(self._status, generation=self._status.generation + 1, time=0.0)
        self._show(self._state, moved=True)

    def _show(self, state: str, message: str | None = None, moved: bool = False) -> None:
        """Make frames of the present; without another message the last one stays."""
        dt = self._viewports[0].scene.dt
        self._status = replace(
            self._status,
            number=self._status.number + 1,
            since=time.perf_counter() if moved else self._status.since,
            pace=dt / self._speed,
            state=state,
            message=self._status.message if message is None else message,
        )
        self.frames = tuple(viewport.frame(self._status) for viewport in self._viewports)


def _told(error: Exception) -> str:
    """An error for people; with its kind where it was not written for them."""
    return first_line(error) if isinstance(error, ValueError | RuntimeError | ImportError) else describe(error)
