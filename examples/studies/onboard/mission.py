"""Settings of the world and every robot: the same for all."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass

import numpy as np

from d4orm_env import Problem, Team, World
from d4orm_env.scenarios import make_problem
from d4orm_planners.d_d4orm.settings import DD4ormConfig
from d4orm_planners.d_d4orm.zenoh_transport import ZenohSettings, ZenohTransport
from d4orm_planners.sampling.d4orm import D4ormConfig

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
        side: Side of the square that they drive in [m].
        horizon: Steps of a plan.
        samples: Of all robots together in an iteration; each draws its share.
        denoising_steps: ``N`` of an iteration.
        iterations: Of a round, at least; where they take longer than real time allows, the clock waits for them.
        think: Ticks that a round of planning is given.
        agree: Ticks from then on until the best plan, which the robots agree on meanwhile, takes over.
        timeout: Seconds that the world waits for a robot's command before it is given up.
        silence: Seconds without a word from the world after which a robot ends.
        namespace: Of the run on the network.
        world: Endpoint that the world listens at for the robots.
        team: Endpoint on which the robots find each other.
    """

    robots: int
    seed: int
    side: float
    horizon: int
    samples: int
    denoising_steps: int
    iterations: int
    think: int
    agree: int
    timeout: float
    silence: float
    namespace: str
    world: str
    team: str

    def __post_init__(self) -> None:
        if self.agree < 3:
            raise ValueError(f"agree is {self.agree}; to end, to announce the best and to settle on one takes 3 ticks")

    @classmethod
    def read(cls, text: str) -> Mission:
        """A mission from what :meth:`written` gave."""
        return cls(**json.loads(text))

    def written(self) -> str:
        """Return the settings as JSON."""
        return json.dumps(asdict(self))

    @property
    def round_ticks(self) -> int:
        """Number of ticks from the beginning of a round until its plan takes over."""
        return self.think + self.agree

    def problem(self) -> Problem:
        """The team of ground robots in the square, with its first goals."""
        team = Team(("velocity2d",) * self.robots)
        # Who follows another one does not touch it when that one stops at once.
        margin = float(np.max(np.asarray(team.max_speed))) * TICK + ROOM
        size = self.side - 2 * (float(np.max(np.asarray(team.radius))) + margin)
        problem = make_problem(
            "random", num_robots=self.robots, model="velocity2d", seed=self.seed, margin=margin, size=size
        )
        half = np.full(2, self.side / 2)
        return problem.replace(world=World(lower=-half, upper=half), horizon=self.horizon, dt=TICK, name="onboard")

    def planning(self) -> DD4ormConfig:
        """The settings of D-D4orm."""
        # Search for shorter paths takes a second an iteration where a round has less.
        samples = D4ormConfig(num_samples=self.samples, num_steps=self.denoising_steps)
        return DD4ormConfig(nodes=self.robots, refinement=samples, engine="cpu", improve=True)

    def join(self, part: str, listen: bool) -> ZenohTransport:
        """An end of the world's network (``"world"``) or of the robots' own (``"team"``)."""
        meeting_point = getattr(self, part)
        where = {"listen": (meeting_point,)} if listen else {"connect": (meeting_point,)}
        return ZenohTransport(ZenohSettings(namespace=f"{self.namespace}/{part}", **where))
