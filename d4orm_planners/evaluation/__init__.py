"""Comparing policies: studies of trials, their store, and what they come to."""

from __future__ import annotations

from d4orm_planners.evaluation.comparison import paired, survival
from d4orm_planners.evaluation.robustness import write_disturbances, write_robustness
from d4orm_planners.evaluation.store import TrialStore
from d4orm_planners.evaluation.summary import success_by

__all__ = ["TrialStore", "paired", "success_by", "survival", "write_disturbances", "write_robustness"]
