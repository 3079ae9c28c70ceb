"""What tuning found for D4orm and its rivals: the preset ``"tuned"``.

From ``examples/tune_rivals.py --candidates 9 --seeds 1``: 9 settings each, the preset ``"paper"`` among them, on four
teams of 8 and 16 robots with seeds from 100 on. A third of the settings went on to twice the seeds, and a third of
these to four times as many. The trials are in ``data/tuning.parquet``, the table in ``docs/tables/tuning.md``. A method
whose preset was best keeps it.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

TUNED: Mapping[str, Mapping[str, object]] = MappingProxyType({
    "mppi": {},
    "cem": {"sigma": 0.352, "elite_fraction": 0.013, "adapt_variance": True, "sigma_floor": 0.0218, "num_steps": 50,
            "clip_between_iterations": True},
    "mbd": {"num_steps": 1000},
    "i-mbd": {},
    "d4orm": {"temperature": 0.472, "beta_start": 1.49e-5, "beta_end": 8.53e-3, "num_steps": 100,
              "clip_between_iterations": True},
})  # fmt: skip
"""By planner, what differs from the preset ``"paper"``."""
