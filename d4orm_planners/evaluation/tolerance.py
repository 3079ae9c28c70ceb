"""How much of a disturbance a policy stands."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from d4orm_planners.evaluation.summary import SuccessRate

THRESHOLD = 0.9


@dataclass(frozen=True, kw_only=True)
class Tolerance:
    """At which level of a disturbance the success of a policy falls below a threshold.

    Attributes:
        label: What the policy with its settings was called.
        scenario: Scenario name.
        num_robots: Team size.
        model: Models of the team.
        control_noise_std: Standard deviation of the execution noise, in the controls' units.
        disturbance: What went wrong, such as ``"push.speed"``.
        stands: The last level before that, in the order in which they were given; ``None`` if it fails at the first.
        fails: The first level with a success rate below the threshold; ``None`` if it stands all.
        threshold: The threshold.
    """

    label: str
    scenario: str
    num_robots: int
    model: str
    control_noise_std: float
    disturbance: str
    stands: float | None
    fails: float | None
    threshold: float

    @property
    def text(self) -> str:
        """In a word: ``"4"``, or ``"over 4"`` where it stands the last level, 4."""
        return f"{self.fails:g}" if self.fails is not None else f"over {self.stands:g}"


def tolerances(rates: Iterable[SuccessRate], threshold: float = THRESHOLD) -> list[Tolerance]:
    """One for every policy, scenario, team size, level of noise and disturbance, in order of appearance.

    Args:
        rates: Those of one policy and disturbance from harmless to bad; those without a disturbance are passed over.
        threshold: Success rate that is asked for.
    """
    lines: dict[tuple[object, ...], list[SuccessRate]] = {}
    for rate in rates:
        if rate.disturbance:
            key = (rate.label, rate.scenario, rate.num_robots, rate.model, rate.control_noise_std, rate.disturbance)
            lines.setdefault(key, []).append(rate)
    return [_tolerance(line, threshold) for line in lines.values()]


def _tolerance(line: Sequence[SuccessRate], threshold: float) -> Tolerance:
    failing = next((place for place, rate in enumerate(line) if rate.rate < threshold), len(line))
    first = line[0]
    return Tolerance(
        label=first.label,
        scenario=first.scenario,
        num_robots=first.num_robots,
        model=first.model,
        control_noise_std=first.control_noise_std,
        disturbance=first.disturbance,
        stands=line[failing - 1].level if failing else None,
        fails=line[failing].level if failing < len(line) else None,
        threshold=threshold,
    )
