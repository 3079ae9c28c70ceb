"""Several scenarios and team sizes trained on at once, so that none is forgotten over another."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np

from d4orm_env.core.arrays import BoolArray
from d4orm_env.core.files import parse_yaml
from d4orm_env.core.goal_poses import goal_speeds
from d4orm_env.core.problem import Problem
from d4orm_env.disturbances.disturbance_registry import disturbances_at
from d4orm_env.scenarios import make_problem
from d4orm_env.scenarios.problems import find_scenario, unknown_argument
from d4orm_planners.rl.robot_vec_env import RobotVecEnv, SharedVecEnv

_PERTURBED = "d4orm_planners.rl.perturbed_scenarios:perturbed"
_CLUTTER = "d4orm_planners.rl.perturbed_scenarios:clutter"
_DISTURB = "disturb."
MIXTURES: Mapping[str, tuple[str, ...]] = MappingProxyType({
    "crowds": (
        "random 2", "random 4", "random 8", "random 8 max_observed=4", "random 16 size=7.07",
        "random 16 size=7.07 max_observed=4", "random 16", "random 32 size=9", f"{_PERTURBED} 4", f"{_PERTURBED} 8",
        f"{_PERTURBED} 8 shift=0.05", f"{_PERTURBED} 12", f"{_PERTURBED} 16 shrink=0.05 max_observed=4",
        f"{_PERTURBED} 16 shrink=0", "circle 8", "circle 16", f"{_PERTURBED} 8 base=four_obstacles",
        f"{_PERTURBED} 8 base=four_obstacles shift=0.1 max_observed=4", "four_obstacles 8",
        f"{_PERTURBED} 12 base=swap", f"{_CLUTTER} 8", f"{_CLUTTER} 8 positions=1 obstacles=10",
    ),
    "dense_crowds": (
        "random 4 max_observed=4", "random 8", "random 8 max_observed=4", "random 8 max_observed=4",
        "random 16 size=7.07", "random 16 size=7.07 max_observed=4", "random 16 size=7.07 max_observed=4", "random 16",
        "random 32 size=9 max_observed=4", f"{_PERTURBED} 8 max_observed=4",
        f"{_PERTURBED} 16 shrink=0.05 max_observed=4", "circle 8 max_observed=4", "circle 16",
        f"{_PERTURBED} 8 base=four_obstacles max_observed=4", f"{_PERTURBED} 12 base=swap", f"{_CLUTTER} 8",
        f"{_CLUTTER} 8 positions=1 obstacles=10",
    ),
    "walls": (
        "rooms 4", "rooms 8", "rooms 8", "rooms 8 disturb.control_noise=0.2", "rooms 8 max_observed=4",
        "rooms 8 max_observed=4", "rooms 16", "forest 8", "warehouse 8 max_observed=4", "maze 4", "random 8",
        "random 8 max_observed=4", "random 8 max_observed=4 disturb.delay=2", "random 16 size=7.07",
        "random 16 size=7.07 max_observed=4", "random 16", "random 16 max_observed=4", "random 32 size=10",
        "circle 16 disturb.control_noise=0.2", f"{_PERTURBED} 8 base=four_obstacles max_observed=4",
        f"{_PERTURBED} 16 shrink=0.05 max_observed=4",
    ),
})  # fmt: skip
"""Mixtures by name; ``walls`` is for robots that look along their paths."""


@dataclass(frozen=True)
class TrainTask:
    """One part of a mixture."""

    scenario: str  #: Name, file or import path
    num_robots: int  #: Size of its teams
    settings: Mapping[str, object]  #: Arguments of the scenario
    max_observed: int | None = None  #: Number of observed robots shown at most; ``None`` is all
    #: Levels by name, see :func:`~d4orm_env.disturbances.disturbance_registry.disturbances_at`
    disturbances: Mapping[str, object] = field(default_factory=dict)

    @classmethod
    def parse(cls, text: str) -> TrainTask:
        """Parse a scenario, a team size, and settings ``name=value``, separated by blanks; ValueError for all else.

        ``max_observed=4`` and ``disturb.delay=2``, with any disturbance's name and level, are among the settings.
        """
        scenario, *rest = text.split() or [""]
        if not rest or not rest[0].isdecimal() or not 1 <= int(rest[0]) <= 1000:
            raise ValueError(f"mixture has {text!r}; it must be a scenario and a team size, as 'random 8 size=4'")
        settings: dict[str, object] = {}
        for word in rest[1:]:
            name, separator, value = word.partition("=")
            if not separator or not name or not value or name in settings:
                raise ValueError(f"mixture has {text!r}, in which {word!r} is no new setting of the form name=value")
            settings[name] = parse_yaml(value)
        max_observed = settings.pop("max_observed", None)
        if max_observed is not None and (not isinstance(max_observed, int) or max_observed < 0):
            raise ValueError(f"mixture has {text!r}, in which max_observed must be a whole number of zero or more")
        for name in ("num_robots", "seed", "model"):
            if name in settings:
                raise ValueError(f"mixture has {text!r}, in which {name!r} has no place")
        disturbances = {
            name.removeprefix(_DISTURB): settings.pop(name) for name in list(settings) if name.startswith(_DISTURB)
        }
        try:
            disturbances_at(disturbances)
        except ValueError as error:
            raise ValueError(f"mixture has {text!r}: {error}") from None
        complaint = unknown_argument(scenario, settings)
        if complaint:
            raise ValueError(f"mixture has {text!r}: {complaint}")
        return cls(scenario, int(rest[0]), settings, max_observed, disturbances)

    def problem(self, seed: int, model: str | None = None) -> Problem:
        """An instance with robots of that model; ``None`` is the scenario's own. Robots dock at any speed by default.

        A robot that explores hardly ever comes to rest at a goal, and a policy that has not learned to brake is braked.
        """
        problem = make_problem(self.scenario, self.num_robots, seed, model=model, **self.settings)
        usual = goal_speeds(problem.team, problem.dt, None)
        said = "goal_speed" in self.settings or (problem.goal_speed != usual).any()
        return problem if said else problem.replace(goal_speed=np.inf)

    def draws(self, model: str | None = None) -> bool:
        return find_scenario(self.scenario).draws or self.problem(0, model) != self.problem(1, model)

    def worlds(
        self,
        max_observed: Sequence[int | None],
        seed: int,
        instances: Instances,
        model: str | None = None,
        **options: Any,
    ) -> RobotVecEnv:
        """Worlds to train in, one per value of ``max_observed``, from this seed on, with ``instances`` to draw."""
        if self.disturbances:
            options["disturbances"] = disturbances_at(self.disturbances)
        return RobotVecEnv(
            len(max_observed), self.num_robots, instances, seed=seed, max_observed=max_observed,
            randomize_instance=self.draws(model), **options,
        )  # fmt: skip

    def validation(self, count: int, seed: int, model: str | None = None, **options: Any) -> RobotVecEnv:
        """Worlds to judge by, a new instance for each; one is enough where nothing differs. Arguments as above."""
        shown = [self.max_observed] * (count if self.disturbances or self.draws(model) else 1)
        instances = Instances(partial(self.problem, model=model), None, {})
        return self.worlds(shown, seed, instances, model, **options)


class Instances:
    """A scenario ``seed -> Problem`` of these seeds, or all (``None``), whose instances are kept in ``drawn``."""

    def __init__(self, draw: Callable[[int], Problem], seeds: Sequence[int] | None, drawn: dict[int, Problem]) -> None:
        self._draw, self._seeds, self._drawn = draw, seeds, drawn

    def __call__(self, seed: int, num_robots: int) -> Problem:
        """The instance that this number stands for."""
        own = seed if self._seeds is None else self._seeds[seed % len(self._seeds)]
        if own not in self._drawn:
            self._drawn[own] = self._draw(own)
        return self._drawn[own]


def parse_mixture(texts: Sequence[str]) -> tuple[TrainTask, ...]:
    """The parts of a mixture: texts as :meth:`TrainTask.parse` takes them, and names of :data:`MIXTURES`."""
    return tuple(TrainTask.parse(part) for text in texts for part in MIXTURES.get(text.strip(), (text,)))


def gather_parts(tasks: Sequence[TrainTask], counts: Sequence[int]) -> list[tuple[TrainTask, list[int | None]]]:
    """Parts that differ in ``max_observed`` only as one, since each takes its time to step, with that of its worlds."""
    gathered: list[tuple[TrainTask, list[int | None]]] = []
    for task, count in zip(tasks, counts, strict=True):
        own = replace(task, max_observed=None)
        if own not in [other for other, _ in gathered]:
            gathered.append((own, []))
        max_observed = next(max_observed for other, max_observed in gathered if other == own)
        max_observed.extend([task.max_observed] * count)
    return gathered


class MixedVecEnv(SharedVecEnv):
    """The robots of several :class:`RobotVecEnv`, worlds counted through; ValueError if these do not go together."""

    def __init__(self, parts: Sequence[RobotVecEnv]) -> None:
        first, self.parts = parts[0], tuple(parts)
        models = sorted({part.problem.team.models[0] for part in parts})
        if len(models) > 1 or any(part.features != first.features for part in parts):
            raise ValueError(f"the mixture has robots of {', '.join(models)}; one policy is learned for one model")
        self.features, self.problem, self.shortest_paths = first.features, first.problem, first.shortest_paths
        self.num_worlds = sum(part.num_worlds for part in parts)
        super().__init__(sum(part.num_envs for part in parts), first.observation_space, first.action_space)

    @property
    def acted(self) -> BoolArray:
        return np.concatenate([part.acted for part in self.parts])

    @property
    def finished(self) -> list[tuple[int, bool, float]]:
        offsets = np.cumsum([0, *(part.num_worlds for part in self.parts)]).tolist()
        return [(offset + world, *how) for offset, part in zip(offsets, self.parts) for world, *how in part.finished]

    def close(self) -> None:
        for part in self.parts:
            part.close()

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        return [seed for part in self.parts for seed in part.seed(seed)]
