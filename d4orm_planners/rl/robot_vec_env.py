"""The batched environment as Stable-Baselines3 wants it: every robot of every world is one of its environments."""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices

from d4orm_env.core.arrays import BoolArray, FloatArray, IntArray, as_float32
from d4orm_env.core.observation_layout import ObservationSlices
from d4orm_env.core.problem import Problem
from d4orm_env.envs.features import Features
from d4orm_env.envs.rewards import RewardFunction
from d4orm_env.envs.team_step import Info
from d4orm_env.envs.vector_env import NavigationVectorEnv
from d4orm_env.scenarios.problems import ScenarioLike


class SharedVecEnv(VecEnv):
    """Base of environments whose robots share their worlds, so that none can be had by itself."""

    render_mode = None
    parts: Sequence[RobotVecEnv]  #: Environments that it consists of, which are itself where it is one
    seconds = 0.0  #: Time spent so far on stepping and on what episodes begin with, such as drawing instances

    def reset(self) -> FloatArray:
        """Begin an episode in every world; the seed counts once."""
        begin = time.perf_counter()
        encoded = self._encoded([part.begin() for part in self.parts])
        features = np.concatenate([part.show(*own)[0] for part, own in zip(self.parts, encoded, strict=True)])
        self.seconds += time.perf_counter() - begin
        return features

    def step_async(self, actions: FloatArray) -> None:
        self._actions = as_float32(actions)

    def step_wait(self) -> tuple[FloatArray, FloatArray, BoolArray, list[Info]]:
        begin = time.perf_counter()
        frames = np.concatenate([part.frames for part in self.parts])
        controls = self.parts[0].features.decode(self._actions, frames, self._all_limits)
        split = np.split(controls, np.cumsum([part.num_envs for part in self.parts])[:-1])
        encoded = self._encoded([part.drive(own) for part, own in zip(self.parts, split, strict=True)])
        outcomes = (part.conclude(*own) for part, own in zip(self.parts, encoded, strict=True))
        features, rewards, dones, infos = zip(*outcomes, strict=True)
        self.seconds += time.perf_counter() - begin
        flat = [info for listed in infos for info in listed]
        return np.concatenate(features), np.concatenate(rewards), np.concatenate(dones), flat

    @cached_property
    def _all_limits(self) -> FloatArray:
        return np.concatenate([part.limits for part in self.parts])

    def _encoded(self, seen: list[FloatArray]) -> list[tuple[FloatArray, FloatArray]]:
        """Features and frames of what the robots of each part see: all at once, for each call takes its time."""
        features, frames = self.parts[0].encoded(np.concatenate(seen))
        ends = np.cumsum([len(own) for own in seen])[:-1]
        return list(zip(np.split(features, ends), np.split(frames, ends), strict=True))

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[object]:
        return [getattr(self, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: object, indices: VecEnvIndices = None) -> None:
        raise AttributeError(f"{attr_name!r} cannot be set: the robots of all worlds share one environment")

    def env_method(
        self, method_name: str, *args: object, indices: VecEnvIndices = None, **kwargs: object
    ) -> list[object]:
        raise AttributeError(f"{method_name!r} cannot be called: the robots of all worlds share one environment")

    def env_is_wrapped(self, wrapper_class: type[gymnasium.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        return [False] * len(list(self._get_indices(indices)))


class RobotVecEnv(SharedVecEnv):
    """``B`` worlds of ``K`` robots as ``B * K`` environments that share one policy; one kernel call per step.

    Environment ``b * K + k`` is robot ``k`` of world ``b``. Observations are the :class:`Features` ``(B * K, F)``,
    actions ``(B * K, m)`` in ``[-1, 1]``. A robot's episode ends when it arrives (terminated) or its world is out of
    time (truncated, ``infos[i]["TimeLimit.truncated"]``); ``infos[i]["terminal_observation"]`` is what it saw last, and
    ``is_success`` says whether it arrived without ever touching anything. An arrived robot then stays in its world
    until that begins anew, when all have arrived or time is up: meanwhile its observation and reward are zero, its
    action is ignored, and :attr:`acted` is ``False``. What happens then is nothing to learn from.

    The instances and episodes of world ``b`` are those of ``navigation_v0.parallel_env`` reset with seed ``seed + b``.

    Args:
        num_worlds: ``B``.
        num_robots: ``K``.
        scenario: As for :class:`d4orm_env.navigation_v0.parallel_env`, like ``**kwargs``. One model for all robots.
        seed: Of the first world.
        reward: The reward to learn from, as in :class:`~d4orm_env.envs.options.EnvOptions`.
        max_observed: Number of observed robots shown at most, the others being marked absent; ``None`` is all. Or
            that of each world.
        shortest_paths: Whether robots see their goals along their shortest paths, see :meth:`Features.along`, and
            are paid for progress along these.
        goal_headings: Bodies whose goal headings robots see, zeros where the problem has none; ``None`` is as many as
            it has.
        **kwargs: Further arguments of :class:`d4orm_env.envs.vector_env.NavigationVectorEnv`.

    Attributes:
        frames: ``(B * K, 2)`` in which the robots act now, see :meth:`Features.encode`.

    Raises:
        ValueError: For a bad argument, or a team of mixed models.
    """

    def __init__(
        self,
        num_worlds: int,
        num_robots: int,
        scenario: ScenarioLike = "random",
        *,
        seed: int = 0,
        reward: str | RewardFunction = "training",
        max_observed: int | Sequence[int | None] | None = None,
        shortest_paths: bool = False,
        goal_headings: int | None = None,
        **kwargs: Any,
    ) -> None:
        kwargs |= {"reward": reward, "observed_path": shortest_paths, "autoreset_mode": "SameStep"}
        if shortest_paths:
            kwargs["progress"] = "path"
        self._env = NavigationVectorEnv(num_worlds, scenario, num_robots, **kwargs)
        problem, layout = self._env.problem, self._env.layout
        _check_learnable(problem)
        self.problem = problem
        sizes = layout.dimension, layout.num_neighbors, layout.num_obstacles
        turns = layout.goal_headings if goal_headings is None else goal_headings
        slices = ObservationSlices(*sizes, num_rays=layout.num_rays, goal_headings=turns)
        self.features = Features.of(slices, problem.team.models[0])
        self.shortest_paths = shortest_paths
        self.num_worlds = num_worlds
        self._shape = (num_worlds, problem.num_robots)
        self._hidden = self._unobserved(
            [max_observed] * num_worlds if max_observed is None or isinstance(max_observed, int) else max_observed
        )
        count = num_worlds * problem.num_robots
        self.limits = np.tile(problem.team.control_limits, (num_worlds, 1))  #: ``(B * K, m)`` largest controls
        self._seed: int | None = seed
        self.acted = np.ones(count, np.bool_)  #: ``(B * K,)`` bool: which robots acted in the last step
        self.finished: list[tuple[int, bool, float]] = []  #: ``(world, success, travel_time)`` of worlds just ended
        self.parts = (self,)
        bound = np.full(self.features.size, 10, np.float32)
        m = problem.control_size
        super().__init__(count, Box(-bound, bound), Box(-np.ones(m, np.float32), np.ones(m, np.float32)))

    def begin(self) -> FloatArray:
        """Begin an episode in every world; what the robots see ``(B * K, .)``, for :meth:`encoded`."""
        observations, infos = self._env.reset(seed=self._seed)
        self._seed = None
        self._acting = ~infos["arrived"]
        self._touched = infos["collided"].copy()
        self._return = np.zeros(self._shape)
        self._length = np.zeros(self._shape, np.int64)
        self._finishing = np.empty((0, 2), np.int64)
        return self._masked(observations, [])

    def drive(self, controls: FloatArray) -> FloatArray:
        """Observations ``(B * K + E, .)`` after a step with controls ``(B * K, m)`` in physical units, for
        :meth:`encoded`.

        After all others come the ``E`` whose episodes have ended, who saw that last.
        """
        observations, _, terminated, truncated, infos = self._env.step(controls.reshape(self._shape[0], -1))
        ended, acting = terminated | truncated, self._acting
        now = {name: infos[name] for name in ("arrived", "collided")}
        self.finished = []
        if ended.any():
            final, metrics = infos["final_info"], infos["final_info"]["metrics"]
            now = {name: np.where(ended[:, None], final[name], value) for name, value in now.items()}
            self.finished = [
                (int(world), bool(metrics["success"][world]), float(metrics["travel_time"][world]))
                for world in np.flatnonzero(ended)
            ]
        self._rewards = self._env.robot_rewards * acting
        self.acted = acting.ravel()
        self._touched |= now["collided"] & acting
        self._return += self._rewards
        self._length += acting
        self._arrived = now["arrived"]
        # The slot of an arrived robot ends with its world, so that the next episode begins afresh.
        self._dones = np.where(acting, self._arrived, False) | ended[:, None]
        self._acting = (acting & ~self._arrived) | ended[:, None]
        self._finishing = np.argwhere(self._dones & acting)
        last = [
            (infos["final_obs"][b] if ended[b] else observations[b]).reshape(self._shape[1], -1)[k]
            for b, k in self._finishing
        ]
        return self._masked(observations, last)

    def encoded(self, seen: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Features ``(N, F)`` and frames ``(N, 2)`` of what robots of any such worlds see ``(N, .)``."""
        if self.shortest_paths:
            slices = self.features.slices
            seen, path, parts = seen[:, : slices.size].copy(), slices.paths(seen), slices.path
            self.features.along(seen, path[:, parts.direction], path[:, parts.length][:, 0])
        return self.features.encode(seen)

    def show(self, features: FloatArray, frames: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Features that the robots are shown, and those that the ones whose episodes have ended are."""
        count = self.num_envs
        self.frames = frames[:count]
        features[:count][~self._acting.ravel()] = 0
        return features[:count], features[count:]

    def conclude(
        self, features: FloatArray, frames: FloatArray
    ) -> tuple[FloatArray, FloatArray, BoolArray, list[Info]]:
        """Return the result of a step, with the features and frames of what :meth:`drive` returned."""
        shown, terminal = self.show(features, frames)
        robot_infos, dones = self._robot_infos(self._finishing, terminal, self._arrived), self._dones
        for values in (self._touched, self._return, self._length):
            values[dones] = 0
        return shown, self._rewards.ravel().astype(np.float32), dones.ravel(), robot_infos

    def _masked(self, observations: FloatArray, last: list[FloatArray]) -> FloatArray:
        """Return what the robots are to see now, and what those whose episodes have ended saw last."""
        seen = observations.reshape(self.num_envs, -1)
        seen = np.concatenate([seen, last]) if last else seen
        seen = self._env.layout.with_goal_headings(seen, self.features.slices.goal_headings)
        if self._hidden.any():
            seen, ended = seen if last else seen.copy(), self._finishing @ [self._shape[1], 1]
            self.features.slices.neighbors(seen)[np.concatenate([self._hidden, self._hidden[ended]])] = 0
        return seen

    def _unobserved(self, max_observed: Sequence[int | None]) -> BoolArray:
        """``(B * K, N)`` which of the observed robots each robot is not shown, by what those of each world are."""
        observed = self.features.slices.num_neighbors
        shown = np.repeat([observed if most is None else most for most in max_observed], self._shape[1])
        return np.arange(observed) >= shown[:, None]

    def _robot_infos(self, finishing: IntArray, terminal: FloatArray, arrived: BoolArray) -> list[Info]:
        """Empty but for robots whose episode has just ended, ``(N, 2)`` world and robot."""
        robot_infos: list[Info] = [{} for _ in range(self.num_envs)]
        for (b, k), features in zip(finishing, terminal):
            robot_infos[b * self._shape[1] + k] = {
                "terminal_observation": features,
                "TimeLimit.truncated": not arrived[b, k],
                "is_success": bool(arrived[b, k] and not self._touched[b, k]),
                "episode": {"r": float(self._return[b, k]), "l": int(self._length[b, k]), "t": 0.0},
            }
        return robot_infos

    def close(self) -> None:
        self._env.close()

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        self._seed = seed
        return [seed] * self.num_envs


def _check_learnable(problem: Problem) -> None:
    if not problem.docks:
        raise ValueError("arrival is 'stay', and one robot's episode ends where it docks; train with arrival='dock'")
    if len(models := set(problem.team.models)) > 1:
        raise ValueError(
            f"the team mixes {', '.join(sorted(models))}; one policy is learned for robots of one model, so give model="
        )
