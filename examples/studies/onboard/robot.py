"""One robot: it drives its row of the team's plan, and plans the next one with the others meanwhile.

    python -m examples.studies.onboard.robot MISSION ROBOT LOG

where MISSION is a file. Everything that decides which plan is executed follows from what the world tells all robots in
every tick, so that all of them execute the same one.
"""

from __future__ import annotations

import json
import logging
import signal
import sys
import time
from pathlib import Path

import numpy as np
from examples.studies.onboard.course import Course, goals_to_plan_for, present_problem, warm_start
from examples.studies.onboard.mission import END, Command, Mission, Tick, decode, encode
from examples.studies.onboard.thinking import Agenda, Log, Round

from d4orm_env.envs.joint_state import JointState, split_state
from d4orm_planners.d_d4orm.transport import Transport
from d4orm_planners.engine.sampling_types import get_sampling_engine

LOOK = 0.5
"""Longest time between two looks at the clock [s]."""


class Robot:
    """A robot from tick to tick; ``team`` is the network for candidates."""

    def __init__(self, mission: Mission, number: int, team: Transport, log: Log) -> None:
        self._mission, self._number, self._team, self._log = mission, number, team, log
        self._problem = mission.problem()
        self._engine = get_sampling_engine("cpu", 1)
        self._course = Course.standing(self._problem, 0, self._problem.start)
        self._round: Round | None = None
        self._former: Round | None = None
        self._rounds = 0
        self._lost: list[int] = []
        self._ballot: Course | None = None

    def prepare(self) -> None:
        """Compile whatever is not yet, before time counts."""
        planner = self._mission.planning().node_planners(self._mission.robots)[self._number]
        planner.solve(self._problem, max_iterations=1)

    def answer(self, tick: Tick) -> Command:
        """Return the command of a tick."""
        joint = split_state(self._problem, tick.state)
        self._log.tick = tick.number
        self._heed_stops(joint, tick.lost)
        if self._round is not None and tick.number >= self._round.agenda.takeover:
            self._take_over(tick)
        if self._round is None:
            self._begin_round(joint)
        self._choose(tick)
        control = self._course.controls_at(tick.number)[self._number]
        ballot, reward = ("", 0.0) if self._ballot is None else (self._ballot.digest, self._ballot.reward)
        return Command(tick.number, self._number, [float(u) for u in control], ballot, reward, self._course.digest)

    def end(self) -> None:
        if self._round is not None:
            self._round.end(self._mission.timeout)

    def _heed_stops(self, joint: JointState, lost: list[int]) -> None:
        """Stop robots in danger when another stands or is elsewhere than planned, and begin to plan anew."""
        if lost == self._lost and not self._course.is_left(joint.steps, joint.states, self._problem.dimension):
            return
        self._lost = lost
        self._course = self._course.with_stops(self._problem, self._engine, joint, lost)
        self._log.note("stops", plan=self._course.digest)
        self._drop_round()

    def _take_over(self, tick: Tick) -> None:
        """Execute the new plan if every robot has announced the same one; else go on with what there is."""
        assert self._round is not None
        ballots = {tick.ballots[robot] for robot in range(self._mission.robots) if robot not in self._lost}
        course = self._ballot
        if course is not None and ballots == {course.digest}:
            self._course = course
            self._log.note("takes over", plan=course.digest, solved=1)
        else:
            self._log.note("keeps", plan=self._course.digest)
        self._drop_round()

    def _drop_round(self) -> None:
        if self._round is not None:
            self._round.end(self._mission.timeout / 3)
        self._former, self._round, self._ballot = self._round, None, None

    def _begin_round(self, joint: JointState) -> None:
        """Plan if the plan under way is not for the present goals."""
        goals = goals_to_plan_for(self._problem, joint, self._lost)
        takeover = joint.steps + self._mission.round_ticks
        then = self._course.states_at(takeover)
        stays = np.isin(np.arange(len(goals)), self._lost) | (goals != joint.goals).any(axis=1)
        goals[stays] = then[stays, : self._problem.dimension]
        if (goals == self._course.goals).all():
            return
        self._rounds += 1
        self._log.round = self._rounds
        self._log.note("begins")
        problem = present_problem(self._problem, then, goals, self._lost)
        # Where nothing has changed since a round in vain, its work is gone on with.
        guess = None if self._former is None else self._former.progress_on(problem)
        if guess is None:
            guess = warm_start(self._course, problem, takeover)
        members = [robot for robot in range(self._mission.robots) if robot not in self._lost]
        self._log.members = members
        agenda = Agenda(self._rounds, tuple(members), takeover, problem, guess)
        self._round = Round(agenda, self._mission, self._number, self._engine, self._team, self._log.observe)

    def _choose(self, tick: Tick) -> None:
        """Announce the best plan known when thinking is over, and then the best of those that all have announced."""
        if self._round is None:
            return
        left, wait = self._round.agenda.takeover - tick.number, self._mission.timeout / 3
        if left == self._mission.agree:
            self._round.enough(wait)
        elif left == 2:
            self._round.settle(wait)
            self._announce(self._round.best())
        elif left == 1:
            announced = [(tick.rewards[robot], -robot) for robot in self._round.agenda.members if tick.ballots[robot]]
            if announced:
                _, robot = max(announced)
                self._announce(self._round.named(tick.ballots[-robot], wait))

    def _announce(self, course: Course | None) -> None:
        self._ballot = course
        self._log.note("announces", plan="" if course is None else course.digest)


def drive(mission: Mission, number: int, robot: Robot, world: Transport) -> None:
    """Answer the world until it ends, has been silent for too long, or has given this robot up."""
    heard, last, answer = time.perf_counter(), -1, b""
    while time.perf_counter() - heard < mission.silence:
        for data in world.collect(LOOK):
            tick = decode(data, Tick)
            if tick is None:
                continue
            heard = time.perf_counter()
            # Others that were given up, or a gap: this robot does not know the team's plan any more.
            if tick == END or number in tick.lost or tick.number > last + 1:
                return
            if tick.number == last + 1:
                last, answer = tick.number, encode(robot.answer(tick))
            if tick.number == last:
                world.publish(answer)


def main() -> None:
    path, number, log_path = sys.argv[1:]
    mission, own = Mission(**json.loads(Path(path).read_text())), int(number)
    # Ctrl-C is for the one that started the robots, and the world tells them when it is over.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Candidates that come too late for their round are counted, not worth a line each.
    logging.getLogger("d4orm_planners.d_d4orm").setLevel(logging.ERROR)
    team = mission.join("team", listen=own == 0)
    world = mission.join("world", listen=False)
    try:
        with Log(Path(log_path), own) as log:
            robot = Robot(mission, own, team, log)
            robot.prepare()
            try:
                drive(mission, own, robot, world)
            finally:
                robot.end()
    finally:
        world.close()
        team.close()


if __name__ == "__main__":
    main()
