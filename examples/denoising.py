"""Denoising steps of studies' trials, and the share of the time that they took, as rows and columns tell them."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from d4orm_planners.base.plan import IterationRecord
from d4orm_planners.evaluation.store import Trial


def steps_to_solution(trial: Trial) -> int | None:
    """Denoising steps until the first solution; ``None`` if there is none or, in rows of older versions, not told."""
    first = next((best for best in trial.progress if best.solved), None)
    if first is not None and first.steps is not None:
        return first.steps
    return steps_spent(trial) if trial.status == "solved" else None


def denoising_time_share(trial: Trial) -> float | None:
    """Share of the time to the first solution, or to the last better plan, that denoising took, where it is told."""
    first = next((best for best in trial.progress if best.solved), None)
    told = trial.denoising_time_share if first is None else 0.0 if first.steps == 0 else first.denoising
    # A planner without such steps tells of none.
    return 0.0 if told is None and _iteration_steps(json.loads(trial.config)) is None else told


def denoising_time_shares(trials: Sequence[Trial]) -> list[float]:
    """:func:`denoising_time_share` of all plans; where some do not tell it of those that were timed.

    Without a step it is 0 without timing too, but a mean over these and a few others would be too low.
    """
    plans = [trial for trial in trials if trial.progress]
    shares = [denoising_time_share(trial) for trial in plans]
    if None in shares:
        shares = [
            share for trial, share in zip(plans, shares) if any(best.denoising is not None for best in trial.progress)
        ]
    return [share for share in shares if share is not None]


def denoising_of(history: Sequence[IterationRecord]) -> dict[str, float | None]:
    """For the row of a solve: denoising steps to its first solution, or all, and the share of the time they took."""
    if not history:
        return {"denoising_steps": 0, "denoising_time_share": 0.0}
    last = next((record for record in history if record.solved), history[-1])
    seconds = last.denoising_time
    return {
        "denoising_steps": last.denoising_steps,
        "denoising_time_share": None if seconds is None else seconds / last.wall_time,
    }


def text_of_told(values: Sequence[float | None], text: Callable[[Sequence[float]], str]) -> str:
    """The text of the values that are told, with their number where that is not all; a dash where none is."""
    told = [value for value in values if value is not None]
    return f"{text(told)}{told_of(len(told), len(values))}" if told else "-"


def told_of(told: int, total: int) -> str:
    """What stands behind a number that only so many of the trials tell."""
    return "" if told == total else f" ({told} of {total})"


def denoising_columns(rows: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Median of the denoising steps, and mean share of the time that they took, of the rows that tell them."""
    steps, shares = ([row.get(name) for row in rows] for name in ("denoising_steps", "denoising_time_share"))
    return {
        "denoising steps": text_of_told(steps, lambda told: f"{np.median(told):g}"),
        "denoising, time": text_of_told(shares, lambda told: f"{np.mean(told):.0%}"),
    }


def loop_steps(trial: Trial) -> int | None:
    """Denoising steps in a loop of a controller, 0 of one that makes none; ``None`` of a plan."""
    return None if trial.status else _iteration_steps(json.loads(trial.config)) or 0


def steps_spent(trial: Trial) -> int | None:
    """Denoising steps of a whole trial, 0 of planners that make none; ``None`` where they are not known."""
    config = json.loads(trial.config)
    if not trial.iterations or "repair_steps" in config:  # whose iterations are of two lengths
        return None
    return trial.iterations * (_iteration_steps(config) or 0)


def penalised_steps(trial: Trial, factor: int = 2) -> int:
    """:func:`steps_to_solution`, and so many times all the steps that there were where it found none (PAR-2)."""
    steps, config = steps_to_solution(trial), json.loads(trial.config)
    return factor * (_iteration_steps(config) or 0) * int(config["max_iterations"]) if steps is None else steps


def step_columns(trials: Sequence[Trial]) -> dict[str, int]:
    """Mean denoising steps, where a trial without a solution counts twice its budget (PAR-2) or once (restricted)."""
    means = [round(float(np.mean([penalised_steps(trial, factor) for trial in trials]))) for factor in (2, 1)]
    return {"steps": means[0], "restricted": means[1]}


def _iteration_steps(config: Mapping[str, Any]) -> int | None:
    """Denoising steps of an iteration with these settings; ``None`` where there are none."""
    steps = config.get("check_every") or config.get("num_steps")
    return None if steps is None else int(steps)
