"""Policies learned by reinforcement, run without the libraries that trained them."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from d4orm_env.core.arrays import FloatArray
from d4orm_env.envs.joint_state import JointState, split_state
from d4orm_planners.base.adapters import SharedPolicy, from_sb3
from d4orm_planners.base.policy import Actions, Observations, Policy, require_reset, robot_indices, within_limits
from d4orm_planners.base.settings import CheckedSettings, PathText
from d4orm_planners.rl.detours import Detours
from d4orm_planners.rl.network import SUFFIX, Network, load_network, range_sensors
from d4orm_planners.tracking.steering import brake_to_dock, goals_along_paths

if TYPE_CHECKING:
    from pettingzoo import ParallelEnv

    from d4orm_env.core.problem import Problem
    from d4orm_env.core.world import World

SHIPPED = Path(__file__).parent / "policies"
SEEN_OBSTACLES = 4
"""Obstacles that the policies that come with the package see."""


@dataclass(frozen=True, kw_only=True)
class LearnedConfig(CheckedSettings):
    """Settings of a learned policy.

    Attributes:
        path: A ``.safetensors`` file of ``d4orm train``, or a ``.zip`` that Stable-Baselines3 saved after training on
            the environment's own observations and actions, each robot's, as through SuperSuit, or the team's, in the
            joint Gymnasium environment. A zip holds pickled Python, which can
            run anything when it is loaded: give only one that you made yourself or trust. By default the policy that
            comes with the package for the robots' model, and for open ground or a world with walls or many obstacles.
        detours: Whether a robot that has learned to head straight for its goal heads along the shortest path round
            robots that have arrived where these are in the way. That is a law beside the network, which goes by the
            joint state; not with a communication range or a line of sight, which hide robots.
        egocentric: Whether a ``.zip`` was trained in ``egocentric`` environments.

    Raises:
        ValueError: If the path ends in something else, or ``egocentric`` comes with one that does not end in ``.zip``.
    """

    path: PathText | None = None
    detours: bool = True
    egocentric: bool = False

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
        return self._actor.network.header.observation_options if isinstance(self._actor, _NetworkActor) else {}

    def _choose(self, problem: Problem) -> None:
        """Act by the file for robots of the team's model in a world like this, or else by the nearest."""
        files, model = self._files(self.config), problem.team.models[0]
        walls = "-walls" if _paths_matter(problem.world) else ""
        stems = (f"{self.name}-{model}{walls}", f"{self.name}-{model}", f"{self.name}{walls}")
        path = next((path for stem in stems if (path := SHIPPED / f"{stem}{SUFFIX}") in files), files[0])
        if path != self._path:
            self._use(path)

    def _use(self, path: Path) -> None:
        self._path, self.training_time = path, None
        if path.suffix == ".zip":
            model = _load_zip(self.name, path)
            self._actor: _NetworkActor | SharedPolicy = from_sb3(model, egocentric=self.config.egocentric)
        else:
            self._actor = _NetworkActor(self.name, path)
            self.training_time = self._actor.network.training_time

    def reset(self, env: ParallelEnv, seed: int = 0) -> None:
        super().reset(env, seed)
        self._choose(self.problem)
        if isinstance(self._actor, SharedPolicy):
            self._actor.reset(env, seed)
            return
        options = env.unwrapped.options
        self._actor.check_rays(range_sensors(options.observed_rays, options.ray_range))
        self._actor.check(self.problem, env.observation_space(env.possible_agents[0]).shape)
        hiding = options.communication_range is not None or options.line_of_sight
        self._detours = Detours(self.problem) if self.config.detours and not hiding else None

    def act(self, observations: Observations, state: FloatArray) -> Actions:
        require_reset(self)
        if not observations:
            return {}
        if isinstance(self._actor, SharedPolicy):
            return self._actor.act(observations, state)
        seen = np.stack([np.asarray(observation, np.float32) for observation in observations.values()])
        robots, joint = robot_indices(observations), split_state(self.problem, state)
        self._look_along_paths(self._actor.network, robots, seen, joint)
        controls = self._actor.network.controls(seen, self.problem.team.control_limits[robots])
        if not self._actor.network.header.brakes:
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


def _paths_matter(world: World) -> bool:
    """Tell a world with more than a few round obstacles, all of which a robot sees: round those it finds by that."""
    return len(world.boxes) + len(world.polygons) > 0 or world.num_obstacles > SEEN_OBSTACLES


class PPO(LearnedPolicy):
    """Proximal policy optimisation (J. Schulman et al., 2017), all robots sharing one network."""

    name = "ppo"


class SAC(LearnedPolicy):
    """Soft actor-critic (T. Haarnoja et al., ICML 2018), all robots sharing one network."""

    name = "sac"


class _NetworkActor:
    """Acts by a policy file."""

    def __init__(self, algorithm: str, path: Path) -> None:
        self.network: Network = load_network(path)
        self.path = path
        if self.network.header.algorithm != algorithm:
            raise ValueError(
                f"policy file {path} was trained by {self.network.header.algorithm}; use make_policy("
                f"{self.network.header.algorithm!r}, path=...)"
            )

    def check(self, problem: Problem, observation_shape: tuple[int, ...]) -> None:
        header, features = self.network.header, self.network.features
        if set(problem.team.models) != {header.model}:
            raise ValueError(
                f"the policy in {self.path.name} was trained for {header.model} robots, and this team has "
                f"{', '.join(sorted(set(problem.team.models)))}; train one for them with 'd4orm train --model'"
            )
        if len(observation_shape) != 1 or self.network.features_for(observation_shape[0]) is None:
            robots = f"observed_robots={header.num_neighbors}" if header.encoder is None else "any observed_robots"
            raise ValueError(
                f"the policy in {self.path.name} was trained for observations of {features.slices.size} numbers, "
                f"and this environment's have shape {observation_shape}; make it with {robots}, "
                f"observed_obstacles={header.num_obstacles}, and do not wrap its observations"
            )

    def check_rays(self, given: str) -> None:
        """Refuse other range sensors than those of the training; their numbers could pass for neighbours."""
        if (trained := self.network.header.range_sensors) != given:
            raise ValueError(
                f"the policy in {self.path.name} was trained with {trained}, and this environment has {given}; make it "
                "as in training"
            )


def _load_zip(algorithm: str, path: Path) -> Any:
    """A model of Stable-Baselines3."""
    try:
        import stable_baselines3
    except ImportError:
        raise ImportError(
            f"a policy in a .zip needs Stable-Baselines3; install it with: pip install 'd4orm-env[rl]' ({path})"
        ) from None
    if not path.is_file():
        raise FileNotFoundError(f"policy file {path} does not exist; give what model.save() wrote")
    try:
        return getattr(stable_baselines3, algorithm.upper()).load(path, device="cpu")
    except Exception as error:  # whatever a foreign file makes its reader raise
        message = " ".join(str(error).split())
        raise ValueError(
            f"policy file {path} is no {algorithm.upper()} model of SB3 ({message}); give what model.save() wrote"
        ) from error
