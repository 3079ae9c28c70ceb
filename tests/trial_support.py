"""Rows of a store of trials, for tests of what is made of them."""

from __future__ import annotations

from typing import Any

from d4orm_planners.evaluation.store import Trial


def trial(seed: int = 0, **changes: Any) -> Trial:
    """A success of D4orm with two robots on the circle, unless changed."""
    key = {"policy": "d4orm", "config": "{}", "problem": "abc", "control_noise_std": 0.0, "seed": seed}
    team = {"label": "d4orm", "scenario": "circle", "num_robots": 2, "model": "holonomic2d", "dt": 0.1}
    outcome = {"success": True, "arrived": 2, "travel_time": 5.0, "steps": 60, "wall_time": 0.5}
    return Trial(**{**key, **team, **outcome, **changes})
