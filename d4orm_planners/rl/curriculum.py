"""Curriculum: a learner's tasks, and their order."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Stage:
    """One part of a training, at whose end there is a checkpoint.

    Attributes:
        num_robots: Team size.
        scenario: Scenario name.
        steps: Robot-steps to take.
    """

    num_robots: int
    scenario: str
    steps: int


def team_sizes(num_robots: int) -> tuple[int, ...]:
    """1, 2, 4, ... below ``num_robots``, and ``num_robots``."""
    return (*(2**i for i in range((num_robots - 1).bit_length())), num_robots)


def common_batch(sizes: tuple[int, ...], wanted: int) -> int:
    """The most robots up to ``wanted`` that make whole worlds of every size; at least one world of each."""
    unit = math.lcm(*sizes)
    return max(wanted // unit, 1) * unit


def make_stages(num_robots: int, scenario: str, steps: int, unit: int, count: int, gradual: bool) -> tuple[Stage, ...]:
    """The stages of a training.

    Teams grow, and every size gets as many steps of whole worlds as any other. Instances are random ones; where another
    scenario is asked for, every other stage of the full team is about that.

    Args:
        num_robots: Size of the full team.
        scenario: Scenario to learn.
        steps: Robot-steps in all, rounded up to whole units.
        unit: Robot-steps that are taken between two updates.
        count: Stages at most.
        gradual: Whether there are smaller teams first.
    """
    units = math.ceil(steps / unit)
    count = min(count, units)
    sizes = team_sizes(num_robots) if gradual else (num_robots,)
    turns = np.cumsum(sizes) / sum(sizes)
    stages = []
    for index in range(count):
        size = sizes[int(np.searchsorted(turns, (index + 0.5) / count))]
        name = scenario if size == num_robots and index % 2 == 0 else "random"
        length = units * (index + 1) // count - units * index // count
        stages.append(Stage(size, name, length * unit))
    return tuple(stages)
