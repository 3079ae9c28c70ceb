"""Tuned settings of D4orm and its rivals: the preset ``"tuned"``.

From ``python -m examples.studies tune_rivals --candidates 27 --seeds 4``: 27 settings each, the preset ``"paper"``
among them, on four teams of 8 and 16 robots with seeds from 100 on. A third of the settings went on to twice the
seeds, and a third of these to four times as many. The trials are in
``examples/studies/data/tuning.parquet``, the table in ``docs/tables/tuning.md``. A method
whose preset was best keeps it.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

TUNED: Mapping[str, Mapping[str, object]] = MappingProxyType({
    "mppi": {},
    "cem": {"sigma": 0.352, "elite_fraction": 0.013, "adapt_variance": True, "sigma_floor": 0.0218, "num_steps": 50,
            "clip_between_iterations": True},
    "mbd": {"num_steps": 1000, "temperature": 0.323, "beta_start": 2.22e-4, "beta_end": 4.24e-2},
    "i-mbd": {"temperature": 0.31, "beta_start": 8.38e-4, "beta_end": 2.7e-2, "num_steps": 50,
              "clip_between_iterations": True},
    "d4orm": {"temperature": 0.495, "beta_start": 1.55e-5, "beta_end": 2.03e-2, "num_steps": 50,
              "clip_between_iterations": False},
})  # fmt: skip
"""Differences from the preset ``"paper"``, by planner."""
