"""The disturbances of a batch of worlds, of which a single environment is one, in the middle of their episodes."""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from functools import reduce
from inspect import signature
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from d4orm_env.core.arrays import SMALLEST, BoolArray, FloatArray, as_float32, read_only, short_repr
from d4orm_env.core.observation_layout import ObservationLayout
from d4orm_env.core.problem import Problem
from d4orm_env.core.registry import check_call
from d4orm_env.disturbances.disturbance import AnyDisturbance, Disturbance, DisturbanceEffect, Memory, Observed, Scene
from d4orm_env.disturbances.draws import Ahead, Draws, Keys, Steps, episode_keys

Worlds = NDArray[np.intp]

_FLOAT32 = np.dtype(np.float32)


class _Purpose(IntEnum):
    """Purposes that a disturbance draws for; the numbers are part of what a seed means, so append."""

    BEGIN = 0
    COMMAND = 1
    MOVE = 2
    SEE = 3
    OBSERVE = 4


T = TypeVar("T")


@dataclass(eq=False)
class _ActiveDisturbance:
    """A disturbance at work: its stream of random numbers, what it draws by purpose, and what it remembers."""

    disturbance: AnyDisturbance
    stream: int
    draws: dict[_Purpose, Draws] = field(default_factory=dict)
    memory: Memory = field(default=())

    def __post_init__(self) -> None:
        #: A user's, whose results are looked at; those of this package are tested.
        self.foreign = not type(self.disturbance).__module__.startswith("d4orm_env.")
        if self.foreign:
            _check_methods(type(self.disturbance))

    def remember(self, memory: Memory, worlds: Worlds, first: bool = False) -> None:
        """Keep what is remembered of some worlds; the first time of all."""
        if first:
            self.memory = memory
        else:
            for past, new in zip(self.memory, memory, strict=True):
                past[worlds] = new

    def memory_of(self, worlds: Worlds) -> Memory:
        """A copy of what is remembered of some worlds."""
        parts = [values[worlds] for values in self.memory]
        make = getattr(type(self.memory), "_make", tuple)
        return make(parts)

    def effect(self, memory: Memory, scene: Scene) -> DisturbanceEffect:
        """Its effect on the worlds of a scene, of which it remembers this."""
        effect, (count, robots, d) = self.disturbance.effect(memory, scene), scene.goal.shape
        if self.foreign:
            wanted = ((count, robots, d), (count, robots), (count, robots), (count, None, 2 * d + 1))
            if not isinstance(effect, DisturbanceEffect) or not all(map(_fits, effect, wanted)):
                shapes = ", ".join(f"{name} {shape}" for name, shape in zip(DisturbanceEffect._fields, wanted))
                raise self.wrong("effect", effect, f"a DisturbanceEffect of None or arrays, {shapes}")
        return effect

    def wrong(self, method: str, returned: object, expected: str) -> ValueError:
        """The error for what a method of the disturbance returned."""
        name = type(self.disturbance).__name__
        return ValueError(f"disturbance {name}: {method} returned {short_repr(returned)}; expected {expected}")

    def has(self, method: str) -> bool:
        """Check whether it overrides a method."""
        return getattr(type(self.disturbance), method) is not getattr(Disturbance, method)


class DisturbedWorlds:
    """Disturbances in the order in which they act, none of them negligible, with the memory of ``B`` worlds of a
    problem.

    Attributes:
        bodies: ``(B, N, 2 d + 1)`` moving obstacles, see :class:`DisturbanceEffect`.
        alters_limits: Whether any changes the robots' limits.
    """

    def __init__(
        self, disturbances: Sequence[AnyDisturbance], problem: Problem, num_worlds: int, max_cycles: int
    ) -> None:
        self.problem, self.max_cycles = problem, max_cycles
        occurrences: Counter[str] = Counter()
        self._all: list[_ActiveDisturbance] = []
        for disturbance in disturbances:
            name = type(disturbance).__name__
            # By name and not by order, so that each draws the same whatever others there are.
            self._all.append(_ActiveDisturbance(disturbance, zlib.crc32(f"{name}/{occurrences[name]}".encode())))
            occurrences[name] += 1
        self._commanding, self._moving, self._seeing, self._observing, self._effective = (
            [one for one in self._all if one.has(method)] for method in ("command", "move", "see", "observe", "effect")
        )
        self.alters_limits = any(one.has("limits") for one in self._all)
        self._keys: Keys = np.zeros((num_worlds, 2), np.uint32)
        self.bodies: FloatArray = np.zeros((num_worlds, 0, 2 * problem.dimension + 1), np.float32)
        self._bringing: list[_ActiveDisturbance] = []
        self._begun = False
        self._ahead: Ahead | None = {} if num_worlds == 1 else None

    @property
    def alters_sight(self) -> bool:
        """True if what is seen may differ from the true state of the robots."""
        return bool(self._seeing or self._observing or self.bodies.shape[1])

    def true_limits(self, limits: FloatArray) -> FloatArray:
        """``(K, L)`` what limits truly are, read-only."""
        for one in self._all:
            changed = _checked(one.disturbance.limits(limits), limits.shape, one, "limits")
            if one.foreign and (changed < SMALLEST).any():
                raise one.wrong("limits", changed[changed < SMALLEST], f"numbers of at least {SMALLEST:g}")
            limits = self._both_ways(limits, changed)
        return read_only(np.array(limits, np.float32))

    def _both_ways(self, before: FloatArray, after: FloatArray) -> FloatArray:
        """``(K, L)`` limits after a change; those of the other way, which it left as they were, change by as much."""
        limits = after.copy()
        for robot, model in enumerate(self.problem.team.robot_models):
            for column, own in model.lower_limits:
                if after[robot, own] == before[robot, own]:
                    limits[robot, own] *= after[robot, column] / before[robot, column]
        return limits

    def scene(
        self,
        start: FloatArray,
        goal: FloatArray,
        states: FloatArray,
        controls: FloatArray,
        arrived: BoolArray,
        steps: Steps,
    ) -> Scene:
        """The worlds as they are; arguments as the attributes of :class:`Scene`."""
        return Scene(self.problem, self.max_cycles, start, goal, states, controls, arrived, steps, self.bodies)

    def begin(self, worlds: Worlds, seeds: Sequence[int], start: FloatArray, goal: FloatArray) -> None:
        """Begin the episodes of worlds ``(b,)``, the first time of all, from ``(b, K, n)`` to ``(b, K, d)`` [m].

        Seeds are what each has drawn from its environment's generator, from 0 to ``2**63 - 1``.
        """
        self._keys[worlds] = keys = episode_keys(seeds)
        if self._ahead is not None:
            self._ahead.clear()
        count, robots = start.shape[:2]
        still = np.zeros((count, robots, self.problem.control_size), np.float32)
        none, new = np.zeros((count, 0, 2 * self.problem.dimension + 1), np.float32), np.zeros(count, np.int64)
        scene = self.scene(start, goal, start, still, np.zeros((count, robots), np.bool_), new)._replace(bodies=none)
        # Those that bring bodies come first, for others see them.
        for one in sorted(self._all, key=lambda one: one not in self._effective):
            memory = one.disturbance.begin(scene, Draws(keys, scene.steps, one.stream, _Purpose.BEGIN))
            if not (isinstance(memory, tuple) and all(np.shape(part)[:1] == (count,) for part in memory)):
                raise one.wrong(
                    "begin", memory, f"a NamedTuple of arrays, each with a row for every one of {count} worlds"
                )
            one.remember(memory, worlds, first=not self._begun)
            bodies = one.effect(memory, scene).bodies
            if bodies is not None:
                if not self._begun:
                    self._bringing.append(one)
                scene = scene._replace(bodies=np.concatenate([scene.bodies, bodies], axis=1))
        if not self._begun:
            self.bodies = scene.bodies
        else:
            self.bodies[worlds] = scene.bodies
        self._begun = True

    def act(self, scene: Scene, controls: FloatArray) -> tuple[FloatArray, FloatArray]:
        """States ``(B, K, n)`` and controls ``(B, K, m)`` that a step truly begins from, of those commanded."""
        for one in self._commanding:
            wanted = one.disturbance.command(controls, one.memory, scene, self._draws(one, scene, _Purpose.COMMAND))
            controls = _checked(wanted, controls.shape, one, "command")
        states = scene.states
        for one in self._moving:
            moved = one.disturbance.move(states, controls, one.memory, scene, self._draws(one, scene, _Purpose.MOVE))
            states, controls = _all_checked(moved, (states, controls), one, "move")
        if states is not scene.states and scene.standing.any():
            states = np.where(scene.standing[..., None], scene.states, states)
        if self.bodies.shape[1]:
            effects = (one.effect(one.memory, scene).bodies for one in self._bringing)
            present = [bodies for bodies in effects if bodies is not None]
            self.bodies = present[0] if len(present) == 1 else np.concatenate(present, axis=1)
        return states, controls

    def effect(self, scene: Scene) -> DisturbanceEffect:
        """Return the joint effect of all up to now."""
        effects = [one.effect(one.memory, scene) for one in self._effective]
        return DisturbanceEffect(
            pushed=_together(np.add, [effect.pushed for effect in effects]),
            stalled=_together(np.logical_or, [effect.stalled for effect in effects]),
            lost=_together(np.logical_or, [effect.lost for effect in effects]),
            bodies=self.bodies,
        )

    def see(self, scene: Scene, worlds: Worlds | None = None) -> Observed:
        """Return the view of all worlds, or of some, as they are in ``scene``, which is always of all."""
        part = scene if worlds is None else scene.of(worlds)
        seen = Observed(part.states, part.controls, part.bodies)
        for one in self._seeing:
            memory = one.memory if worlds is None else one.memory_of(worlds)
            draws = self._draws(one, scene, _Purpose.SEE)
            draws = draws if worlds is None else draws.of(worlds)
            seen = Observed(*_all_checked(one.disturbance.see(seen, memory, part, draws), seen, one, "see"))
            if worlds is not None:
                one.remember(memory, worlds)
        return seen

    def observe(
        self, observations: FloatArray, layout: ObservationLayout, scene: Scene, worlds: Worlds | None = None
    ) -> FloatArray:
        """``(B, K, D)`` observations of what is seen in all worlds of a scene, or in some, as robots make them."""
        for one in self._observing:
            draws = self._draws(one, scene, _Purpose.OBSERVE)
            made = one.disturbance.observe(observations, layout, draws if worlds is None else draws.of(worlds))
            observations = _checked(made, observations.shape, one, "observe")
        if self._observing:
            observations = np.clip(observations, layout.low, layout.high)
        return observations

    def _draws(self, one: _ActiveDisturbance, scene: Scene, purpose: _Purpose) -> Draws:
        draws = one.draws.get(purpose)
        if draws is None:
            one.draws[purpose] = draws = Draws(self._keys, scene.steps, one.stream, purpose, self._ahead)
        draws.turn_to(scene.steps)
        return draws


def _check_methods(kind: type[AnyDisturbance]) -> None:
    """Check that what a class overrides can be called as what it inherits."""
    for name in ("check", "slack", "begin", "limits", "command", "move", "see", "observe", "effect"):
        own, inherited = getattr(kind, name), getattr(Disturbance, name)
        if own is not inherited:
            check_call(own, f"disturbance {kind.__name__}: {name}", *signature(inherited).parameters)


def _fits(part: ArrayLike | None, wanted: tuple[int | None, ...]) -> bool:
    """Check whether something is ``None`` or of a shape, in which ``None`` is any length."""
    shape = np.shape(part) if part is not None else wanted
    return len(shape) == len(wanted) and all(want in (None, have) for want, have in zip(wanted, shape))


def _together(join: Callable[[T, T], T], parts: Sequence[T | None]) -> T | None:
    """Join the effects of several disturbances; ``None`` if there is none."""
    done = [part for part in parts if part is not None]
    return reduce(join, done) if done else None


def _checked(values: ArrayLike, shape: tuple[int, ...], one: _ActiveDisturbance, method: str) -> FloatArray:
    """Return a disturbance's result as float32, its shape and numbers checked."""
    try:
        array = values if isinstance(values, np.ndarray) and values.dtype == _FLOAT32 else as_float32(values)
    except ValueError:
        raise one.wrong(method, values, f"numbers of shape {shape}") from None
    if array.shape != shape:
        name = type(one.disturbance).__name__
        raise ValueError(f"disturbance {name}: {method} returned shape {array.shape}; expected {shape}")
    if one.foreign and not np.isfinite(array).all():
        raise one.wrong(method, array[~np.isfinite(array)], "finite numbers")
    return array


def _all_checked(
    values: object, like: tuple[FloatArray, ...], one: _ActiveDisturbance, method: str
) -> list[FloatArray]:
    """:func:`_checked` of all results of a method that returns several, of the shapes of these."""
    if not (isinstance(values, tuple | list) and len(values) == len(like)):
        raise one.wrong(method, values, f"{len(like)} arrays")
    return [_checked(value, old.shape, one, method) for value, old in zip(values, like, strict=True)]
