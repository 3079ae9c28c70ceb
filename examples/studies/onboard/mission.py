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
    """The settings of one run.

    Attributes:
        robots: Number of robots.
        seed: Of starts, goals and planning.
        samples: Of all robots together in an iteration; each draws its share.
        timeout: Seconds that the world waits for a robot's command before it is given up.
        namespace: Of the run on the network.
        world: Endpoint that the world listens at for the robots.
        team: Endpoint on which the robots find each other.
        side: Side of the square that they drive in [m].
        horizon: Steps of a plan.
        denoising_steps: ``N`` of an iteration.
        iterations: Of a round, at least; where they take longer than real time allows, the clock waits for them.
        think: Ticks that a round of planning is given.
        agree: Ticks from then on until the best plan, which the robots agree on meanwhile, takes over; at least 3: to
            end, to announce the best and to settle on one.
        silence: Seconds without a message from the world after which a robot ends.
    """

    robots: int
    seed: int
    samples: int
    timeout: float
    namespace: str
    world: str
    team: str
    side: float = 4.0
    horizon: int = 80
    denoising_steps: int = 50
    iterations: int = 2
    think: int = 7
    agree: int = 3
    silence: float = 30.0

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
    """Message of the world to all robots.

    Attributes:
        number: Ticks since the start; -1 for the last message, which ends the run.
        state: The joint state, see :mod:`d4orm_env.envs.joint_state`.
        lost: Robots that have been given up; they stand where they stopped.
        ballots: Plan that each robot announced last as its choice, ``""`` for none.
        rewards: Rewards of those.
    """

    number: int
    state: list[float]
    lost: list[int]
    ballots: list[str]
    rewards: list[float]
    kind: Literal["Tick"] = "Tick"
    __pydantic_config__ = _STRICT


@dataclass(frozen=True)
class Command:
    """Message of a robot in a tick.

    Attributes:
        number: The tick.
        robot: Its number.
        control: ``(m,)``.
        ballot: Digest of the plan that it would take over next, ``""`` for none.
        reward: Its reward.
        executing: Digest of the plan that it executes.
    """

    number: int
    robot: int
    control: list[float]
    ballot: str
    reward: float
    executing: str
    kind: Literal["Command"] = "Command"
    __pydantic_config__ = _STRICT


END = Tick(-1, [], [], [], [])

Message = TypeVar("Message", Tick, Command)


def encode(message: Tick | Command) -> bytes:
    """A message as bytes."""
    return json.dumps(asdict(message)).encode()


def decode(data: bytes, kind: type[Message]) -> Message | None:
    """A message of that kind; ``None`` for one of another kind, or anything else."""
    try:
        return TypeAdapter(kind).validate_json(data) if len(data) <= MAX_BYTES else None
    except ValidationError:
        return None
