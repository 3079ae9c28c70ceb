"""Numbers that the paper gives, as it writes them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from examples.studies.paper.figure import PaperNumbers

D4ORM_SECONDS = {"4": "0.12", "8": "0.13", "12": "0.30", "16": "1.25"}
"""Table II, means."""
IPOPT: PaperNumbers = {
    ("2D Holonomic", "ipopt", "mean_runtime"): {
        "4": "1.12 ± 0.526", "8": "6.33 ± 2.284", "12": "35.32 ± 11.53", "16": "failed",
    },
    ("2D Holonomic", "d4orm", "mean_runtime"): {
        "4": "0.12 ± 0.002", "8": "0.13 ± 0.002", "12": "0.30 ± 0.217", "16": "1.25 ± 1.016",
    },
}  # fmt: skip
"""Table II."""
BIG_TEAMS: PaperNumbers = {
    ("2D Holonomic", "d4orm", "runtime"): D4ORM_SECONDS,
    ("2D Holonomic", "d4orm-c2f", "runtime"): {"16": "about 0.2"},
    ("2D Holonomic", "d4orm-c2f", "step_time"): {"16": "30"},
    ("2D Holo Random", "d4orm-d", "runtime"): {"64": "within 2"},
    ("2D Holo Random, 100", "d4orm-d", "runtime"): {"100": "within 30"},
    ("2D Holo Random", "d4orm-c2f", "runtime"): {"64": "within 2"},
}
"""The paper's figure of the variants."""
COARSENESS = {
    (1, 1): ("0.75", "6.23", "7.23"),
    (2, 1): ("0.37", "6.27", "7.31"),
    (3, 1): ("0.32", "6.35", "7.52"),
    (4, 1): ("0.23", "6.42", "7.62"),
    (1, 5): ("0.57", "6.31", "7.49"),
    (1, 10): ("0.43", "6.36", "7.58"),
}
"""Table III: runtime, travel time and makespan, by coarseness and checks."""
AMSWARM: Mapping[str, Sequence[Sequence[str]]] = {
    "amswarm": (("0.83", "failed", "0.88", "0.81", "failed"), ("9.60", "failed", "9.10", "8.70", "failed"),
                ("10.43", "failed", "11.05", "10.08", "failed")),
    "d4orm": (("0.17", "0.33", "0.76", "1.17", "1.31"), ("7.00", "7.25", "8.10", "8.36", "7.13"),
              ("46.62", "43.29", "44.62", "43.11", "43.08")),
    "d4orm-d": (("0.19", "0.29", "0.33", "0.40", "0.35"), ("7.02", "7.11", "7.77", "8.04", "7.38"),
                ("46.58", "44.01", "43.57", "42.62", "42.33")),
}  # fmt: skip
"""The paper's runtimes, makespans and jerk, by environment."""
