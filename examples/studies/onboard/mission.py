"""Settings of the world and every robot, the same for all, and their messages in every tick."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import Literal, TypeVar

import numpy as np
from pydantic import ConfigDict, TypeAdapter, ValidationError

from d4orm_env import Problem, Team, World
from d4orm_env.scenarios import make_problem
from d4orm_planners.d4orm_d.planner import D4ormDConfig
from d4orm_planners.d_d4orm.planner import DD4ormConfig
from d4orm_planners.d_d4orm.zenoh_transport import ZenohSettings, ZenohTransport

TICK = 0.1
"""Time step of the world and of plans [s]."""

ROOM = 0.05
"""Gap that is left when a robot stops while the one behind it drives on for a tick [m]."""


@dataclass(frozen=True, kw_only=True)
class Mission:
    """The settings of one run."""

    robots: int  #: Number of robots
    seed: int  #: Of starts, goals and planning
    samples: int  #: Of all robots together in an iteration; each draws its share
    timeout: float  #: Seconds that the world waits for a robot's command before it is given up
    namespace: str  #: Of the run on the network
    world: str  #: Endpoint that the world listens at for the robots
    team: str  #: Endpoint on which the robots find each other
    side: float = 4.0  #: Side of the square that they drive in [m]
    horizon: int = 80  #: Steps of a plan
    denoising_steps: int = 50  #: ``N`` of an iteration
    iterations: int = 2  #: Of a round, at least; where they take longer than real time allows, the clock waits for them
    think: int = 7  #: Ticks that a round of planning is given
    #: Ticks from then on until the best plan, which the robots agree on meanwhile, takes over; at least 3: to end, to
    #: announce the best and to settle on one
    agree: int = 3
    silence: float = 30.0  #: Seconds without a message from the world after which a robot ends

    @property
    def round_ticks(self) -> int:
        """Number of ticks from the beginning of a round until its plan takes over."""
        return self.think + self.agree

    def problem(self) -> Problem:
        """The team of ground robots in the square, with its first goals."""
        team = Team(("velocity2d",) * self.robots)
        # A robot that follows another one does not touch it when that one stops at once.
        margin = float(np.max(np.asarray(team.max_speed))) * TICK + ROOM
        size = self.side - 2 * (float(np.max(np.asarray(team.radius))) + margin)
        problem = make_problem(
            "random", num_robots=self.robots, model="velocity2d", seed=self.seed, margin=margin, size=size
        )
        half = np.full(2, self.side / 2)
        return problem.replace(world=World(lower=-half, upper=half), horizon=self.horizon, dt=TICK, name="onboard")

    def planning(self) -> DD4ormConfig:
        """The settings of D-D4orm."""
        # Search for shorter paths takes a second an iteration where a round has less. Denoising of the whole team alone
        # stays at what fails, round after round.
        samples = D4ormDConfig(num_samples=self.samples, num_steps=self.denoising_steps)
        return DD4ormConfig(nodes=self.robots, refinement=samples, engine="cpu", improve=True)

    def join(self, part: str, listen: bool) -> ZenohTransport:
        """An end of the world's network (``"world"``) or of the robots' own (``"team"``)."""
        meeting_point = getattr(self, part)
        where = {"listen": (meeting_point,)} if listen else {"connect": (meeting_point,)}
        return ZenohTransport(ZenohSettings(namespace=f"{self.namespace}/{part}", **where))


MAX_BYTES = 2**20


_STRICT = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)
"""Messages are checked when they are read: nothing is unpickled, and nothing else is taken for one."""


@dataclass(frozen=True)
class Tick:
    """Message of the world to all robots."""

    number: int  #: Ticks since the start; -1 for the last message, which ends the run
    state: list[float]  #: The joint state, see :mod:`d4orm_env.envs.joint_state`
    lost: list[int]  #: Robots that have been given up; they stand where they stopped
    ballots: list[str]  #: Plan that each robot announced last as its choice, ``""`` for none
    rewards: list[float]  #: Rewards of those
    kind: Literal["Tick"] = "Tick"
    __pydantic_config__ = _STRICT


@dataclass(frozen=True)
class Command:
    """Message of a robot in a tick."""

    number: int  #: The tick
    robot: int  #: Its number
    control: list[float]  #: ``(m,)``
    ballot: str  #: Digest of the plan that it would take over next, ``""`` for none
    reward: float  #: Its reward
    executing: str  #: Digest of the plan that it executes
    kind: Literal["Command"] = "Command"
    __pydantic_config__ = _STRICT


END = Tick(-1, [], [], [], [])

Message = TypeVar("Message", Tick, Command)


def encode(message: Tick | Command) -> bytes:
    return json.dumps(asdict(message)).encode()


def decode(data: bytes, kind: type[Message]) -> Message | None:
    """A message of that kind; ``None`` for one of another kind, or anything else."""
    try:
        return TypeAdapter(kind).validate_json(data) if len(data) <= MAX_BYTES else None
    except ValidationError:
        return None
