"""Policies learned by reinforcement, run without the libraries that trained them."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from d4orm_env.core.arrays import FloatArray, IntArray
from d4orm_env.core.problem import Problem
from d4orm_env.envs.joint_state import JointState, split_state
from d4orm_planners.base.adapters import SharedPolicy, from_sb3
from d4orm_planners.base.measured_states import acting_robots, stacked_observations
from d4orm_planners.base.policy import Actions, Observations, Policy, within_limits
from d4orm_planners.base.settings import CheckedSettings, PathText
from d4orm_planners.rl.network import SUFFIX, Network, load_network, range_sensors
from d4orm_planners.tracking.goal_drives import brake_to_dock
from d4orm_planners.tracking.steering import goals_along_paths

if TYPE_CHECKING:
    from pettingzoo import ParallelEnv

SHIPPED = Path(__file__).parent / "policies"
SEEN_OBSTACLES = 4  #: Obstacles that the policies that come with the package see


@dataclass(frozen=True, kw_only=True)
class LearnedConfig(CheckedSettings):
    """Settings of a learned policy.

    Raises:
        ValueError: If the path ends in something else, or ``egocentric`` comes with one that does not end in ``.zip``.
    """

    #: A ``.safetensors`` file of ``d4orm train``, or a ``.zip`` that Stable-Baselines3 saved after training on the
    #: environment's own observations and actions, each robot's, as through SuperSuit, or the team's, in the joint
    #: Gymnasium environment. A zip holds pickled Python, which can run anything when it is loaded: give only one that
    #: you made yourself or trust. By default the policy that comes with the package for the robots' model, and for open
    #: ground or a world with walls or many obstacles.
    path: PathText | None = None
    #: Whether a robot that has learned to head straight for its goal heads along the shortest path round robots that
    #: have arrived where these are in the way. That is a law beside the network, which goes by the joint state; not
    #: with a communication range or a line of sight, which hide robots.
    detours: bool = True
    egocentric: bool = False  #: Whether a ``.zip`` was trained in ``egocentric`` environments

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.path is not None and Path(self.path).suffix not in (SUFFIX, ".zip"):
            raise ValueError(f"path {self.path!r} must end in {SUFFIX} (of 'd4orm train') or .zip (of SB3)")
        if self.egocentric and (self.path is None or Path(self.path).suffix != ".zip"):
            raise ValueError("egocentric is of a .zip of SB3; other policy files tell themselves, so leave it out")


class LearnedPolicy(Policy):
    """Base of PPO and SAC policies: every robot by itself maps what it observes to its most likely control.

    Attributes:
        training_time: Seconds of training behind what acts now, where its file tells; else ``None``.

    Raises:
        ValueError: If the file is no policy, or one of another algorithm.
        OSError: If it cannot be read.
        ImportError: For a ``.zip``, if Stable-Baselines3 is not installed.
    """

    name: ClassVar[str]
    config_class: ClassVar[type[CheckedSettings] | None] = LearnedConfig

    def __init__(self, config: LearnedConfig | None = None) -> None:
        self.config = config or LearnedConfig()
        self._use(self._files(self.config)[0])

    @classmethod
    def identity_with(cls, config: CheckedSettings) -> dict[str, object]:
        """The settings, and the digest of the files: another training has other weights under the same name."""
        assert isinstance(config, LearnedConfig)
        # Where there is none, every trial will say so.
        contents = [file.read_bytes() for file in cls._files(config) if file.is_file()]
        return {**config.keywords(), "file": hashlib.sha256(b"".join(contents)).hexdigest() if contents else None}

    @classmethod
    def _files(cls, config: LearnedConfig) -> list[Path]:
        """The one that is asked for, or all that come with the package; of these the first one is for most models."""
        if config.path is not None:
            return [Path(config.path)]
        return [SHIPPED / f"{cls.name}{SUFFIX}", *sorted(SHIPPED.glob(f"{cls.name}-*{SUFFIX}"))]

    def observation_options(self, problem: Problem) -> Mapping[str, object]:
        """As in training, where the policy is a file of this package."""
        self._choose(problem)
        return self._actor.header.observation_options if isinstance(self._actor, Network) else {}

    def _choose(self, problem: Problem) -> None:
        """Act by the file for robots of the team's model in a world like this, or else by the nearest."""
        files, model, world = self._files(self.config), problem.team.models[0], problem.world
        # More than a few round obstacles, all of which a robot sees: round those it finds by that.
        paths_matter = len(world.boxes) + len(world.polygons) > 0 or world.num_obstacles > SEEN_OBSTACLES
        walls = "-walls" if paths_matter else ""
        stems = (f"{self.name}-{model}{walls}", f"{self.name}-{model}", f"{self.name}{walls}")
        path = next((path for stem in stems if (path := SHIPPED / f"{stem}{SUFFIX}") in files), files[0])
        if path != self._path:
            self._use(path)

    def _use(self, path: Path) -> None:
        self._path, self.training_time = path, None
        if path.suffix == ".zip":
            model = _load_zip(self.name, path)
            self._actor: Network | SharedPolicy = from_sb3(model, egocentric=self.config.egocentric)
            return
        network = load_network(path)
        if (algorithm := network.header.algorithm) != self.name:
            raise ValueError(f"policy file {path} was trained by {algorithm}; use make_policy({algorithm!r}, path=...)")
        self._actor, self.training_time = network, network.training_time

    def reset(self, env: ParallelEnv, seed: int = 0) -> None:
        super().reset(env, seed)
        self._choose(self.problem)
        if isinstance(self._actor, SharedPolicy):
            self._actor.reset(env, seed)
            return
        options = env.unwrapped.options
        given, trained = range_sensors(options.observed_rays, options.ray_range), self._actor.header.range_sensors
        if trained != given:  # whose numbers could pass for neighbours
            raise ValueError(
                f"the policy in {self._path.name} was trained with {trained}, and this environment has {given}; make "
                "it as in training"
            )
        self._seen_shape, self._layout = env.observation_space(env.possible_agents[0]).shape, env.unwrapped.layout
        self._check_team(self._actor, self._seen_shape)
        hiding = options.communication_range is not None or options.line_of_sight
        self._detours = Detours(self.problem) if self.config.detours and not hiding else None

    def _check_team(self, network: Network, observation_shape: tuple[int, ...]) -> None:
        """Refuse robots, and observations, of another kind than those of the training."""
        header, models = network.header, set(self.problem.team.models)
        if models != {header.model}:
            raise ValueError(
                f"the policy in {self._path.name} was trained for {header.model} robots, and this team has "
                f"{', '.join(sorted(models))}; train one for them with 'd4orm train --model'"
            )
        fitted = self._as_trained(network, np.zeros((1, *observation_shape), np.float32)).shape[1:]
        if len(fitted) != 1 or network.features_for(fitted[0]) is None:
            robots = f"observed_robots={header.num_neighbors}" if header.encoder is None else "any observed_robots"
            raise ValueError(
                f"the policy in {self._path.name} was trained for observations of {network.features.slices.size} "
                f"numbers, and this environment's have shape {observation_shape}; make it with {robots}, "
                f"observed_obstacles={header.num_obstacles}, and do not wrap its observations"
            )

    def _as_trained(self, network: Network, seen: FloatArray) -> FloatArray:
        """Return observations ``(N, D)`` with goal headings, zeros where there are none, or without, as in training."""
        if seen.shape[1:] != (self._layout.size,):  # of a wrapper
            return seen
        return self._layout.with_goal_headings(seen, network.features.slices.goal_headings)

    def act(self, observations: Observations, state: FloatArray) -> Actions:
        robots = acting_robots(self, observations)
        if not observations:
            return {}
        if isinstance(self._actor, SharedPolicy):
            return self._actor.act(observations, state)
        seen = self._as_trained(self._actor, stacked_observations(observations, self._seen_shape))
        joint = split_state(self.problem, state)
        self._look_along_paths(self._actor, robots, seen, joint)
        controls = self._actor.controls(seen, self.problem.team.control_limits[robots])
        if not self._actor.header.brakes:
            controls = brake_to_dock(self.problem, robots, controls, joint)
        return within_limits(self.problem, dict(zip(observations, controls)))

    def _look_along_paths(self, network: Network, robots: list[int], seen: FloatArray, joint: JointState) -> None:
        """Change the goals in ``seen`` ``(N, D)``: as in training, by the map that all have, or round arrived robots.

        Where a robot is follows from its goal and where it sees that.
        """
        features = network.features_for(seen.shape[1])
        assert features is not None, "reset has checked the observations"
        positions, own = joint.goals.copy(), features.slices.own.goal
        positions[robots] -= seen[:, own]
        if network.header.shortest_paths:
            heads = goals_along_paths(self.problem, positions, joint.goals)
        elif self._detours is not None and joint.arrived.any():
            heads = self._detours.goals(joint, positions)
        else:
            return
        elsewhere = (heads != joint.goals).any(axis=1)[robots]
        seen[elsewhere, own] = (heads - positions)[robots][elsewhere]


class PPO(LearnedPolicy):
    """Proximal policy optimisation (J. Schulman et al., 2017), all robots sharing one network."""

    name = "ppo"


class SAC(LearnedPolicy):
    """Soft actor-critic (T. Haarnoja et al., ICML 2018), all robots sharing one network."""

    name = "sac"


class Detours:
    """Shortest paths round arrived robots, in one episode.

    A robot without memory that heads straight for its goal stops behind others that have arrived. A path is found when
    a robot first needs it, and again when another one has arrived.
    """

    def __init__(self, problem: Problem) -> None:
        self._problem, self._radius = problem, problem.team.radius
        self._arrived = np.zeros(problem.num_robots, np.bool_)
        self._alone: dict[int, Problem] = {}

    def goals(self, joint: JointState, positions: FloatArray) -> FloatArray:
        """``(K, d)`` where robots at ``positions`` ``(K, d)`` head [m]: to goals, or by paths round arrived ones."""
        if (joint.arrived != self._arrived).any():
            self._arrived, self._alone, world = joint.arrived, {}, self._problem.world
            balls = np.column_stack([joint.states[self._arrived, : world.dimension], self._radius[self._arrived]])
            kind = "circles" if world.dimension == 2 else "spheres"
            self._world = world.replace(**{kind: np.concatenate([world.balls, balls])})
        heads = joint.goals.copy()
        for robot in self._blocked(joint, positions).tolist():
            if robot not in self._alone:
                one = self._problem.select([robot])
                start = joint.states[[robot], : one.state_size]
                self._alone[robot] = one.with_state(start, joint.goals[[robot]], world=self._world)
            heads[robot] = goals_along_paths(self._alone[robot], positions[[robot]], joint.goals[[robot]])[0]
        return heads

    def _blocked(self, joint: JointState, positions: FloatArray) -> IntArray:
        """Numbers of the robots that an arrived one is in the way of."""
        arrived, ahead = self._arrived, joint.goals - positions
        offsets = joint.states[arrived, : self._problem.dimension] - positions[:, None]
        along = (
            np.einsum("kd,knd->kn", ahead, offsets)
            / np.maximum((ahead * ahead).sum(axis=1), np.finfo(np.float32).tiny)[:, None]
        )
        distances = np.linalg.norm(offsets - np.clip(along, 0, 1)[..., None] * ahead[:, None], axis=2)
        safety_distance = self._radius[:, None] + self._radius[arrived] + self._problem.margin
        return np.flatnonzero((distances < safety_distance).any(axis=1) & ~arrived)


def _load_zip(algorithm: str, path: Path) -> Any:
    try:
        import stable_baselines3
    except ImportError:
        raise ImportError(
            f"a policy in a .zip needs Stable-Baselines3; install it with: pip install 'd4orm-env[rl]' ({path})"
        ) from None
    if not path.is_file():
        below = "".join(f", as {found}" for found in sorted(path.parent.glob(f"*/{path.name}"))[-1:])
        raise FileNotFoundError(f"policy file {path} does not exist; give what model.save() wrote{below}")
    try:
        return getattr(stable_baselines3, algorithm.upper()).load(path, device="cpu")
    except Exception as error:  # whatever a foreign file makes its reader raise
        message = " ".join(str(error).split())
        raise ValueError(
            f"policy file {path} is no {algorithm.upper()} model of SB3 ({message}); give what model.save() wrote"
        ) from error
