"""Latency of commands: which of those sent before is it that the robots report to have executed."""

from __future__ import annotations

import numpy as np

from d4orm_env.core.arrays import BoolArray, FloatArray
from d4orm_env.core.team import Team

MOST = 10
"""Steps late that commands may be and still be recognised."""

DECAY = 0.98
"""Share of a difference that is left after a time step."""

BETTER = 0.5
"""A lateness is believed once commands that late differ less than this share from those executed."""


class Lateness:
    """Remembers the commands that were sent, and compares them with those executed.

    Args:
        team: Robots that are sent commands.
        known: Steps late that commands are known to be, or ``None`` to find out.

    Attributes:
        steps: Their latency.
    """

    def __init__(self, team: Team, known: int | None) -> None:
        self._units = team.control_units
        self._known = known is not None
        self.steps = known or 0
        # Before the first there were none, which is as if they were zero.
        self._sent = [np.zeros_like(self._units)] * (max(MOST, self.steps) + 1)
        self._apart = np.zeros(MOST + 1)

    @property
    def under_way(self) -> list[FloatArray]:
        """Commands ``(K, m)`` each that are still to be executed, the next one first."""
        return self._sent[-self.steps :] if self.steps else []

    def observe(self, executed: FloatArray, going: BoolArray) -> FloatArray:
        """``(K, m)`` the commands that should have been executed in the last step.

        Args:
            executed: ``(K, m)`` those that were.
            going: ``(K,)`` whose tell anything: docked robots execute none.
        """
        if not self._known:
            sent = np.stack(self._sent[: -MOST - 2 : -1])
            self._apart = DECAY * self._apart + (((sent - executed) / self._units)[:, going] ** 2).sum(axis=(1, 2))
            best = int(self._apart.argmin())
            if self._apart[best] < BETTER * self._apart[self.steps]:
                self.steps = best
        return self._sent[-1 - self.steps]

    def send(self, controls: FloatArray) -> FloatArray:
        """Remember commands ``(K, m)``, inside the limits; those ``(K, m)`` that are executed now."""
        self._sent = [*self._sent[1:], controls]
        return self._sent[-1 - self.steps]
