"""Benchmark results as JSON and as Markdown tables."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from dataclasses import asdict
from datetime import UTC, datetime
from operator import itemgetter
from pathlib import Path
from typing import Any

from d4orm_env.core.files import replaced_when_done
from d4orm_env.core.lazy import LazyModule
from d4orm_env.engine.choice import resolve_engine
from d4orm_planners.base.provenance import commit, describe_machine, versions
from d4orm_planners.evaluation.measuring import BenchmarkSettings, Measurement, Spread
from d4orm_planners.evaluation.tables import table

jax: Any = LazyModule("jax")

FORMAT = "d4orm-bench-1"
LIBRARIES = ("d4orm-env", "numpy", "numba", "jax", "gymnasium", "pettingzoo")


def circumstances(command: str) -> Measurement:
    """Under which a benchmark runs that begins now: date, command, commit, machine with its load, and libraries."""
    load = list(os.getloadavg()) if hasattr(os, "getloadavg") else None
    accelerator = jax.devices()[0].device_kind if resolve_engine("auto") == "jax" else None
    machine = {**describe_machine(), "accelerator": accelerator, "load_average": load, "libraries": versions(LIBRARIES)}
    date = datetime.now(UTC).isoformat(timespec="seconds")
    return {"date": date, "command": command, "commit": commit(), "machine": machine}


def write_report(
    folder: Path, settings: BenchmarkSettings, begun: Measurement, results: dict[str, list[Measurement]]
) -> tuple[Path, Path]:
    """Write ``bench.json`` and ``bench.md``, and return their paths."""
    document = {"format": FORMAT, **begun, "settings": asdict(settings), **results}
    with replaced_when_done(folder / "bench.json") as path:
        path.write_text(json.dumps(document, indent=1, default=asdict, allow_nan=False) + "\n", encoding="utf-8")
    with replaced_when_done(folder / "bench.md") as path:
        path.write_text(markdown(settings, begun, results), encoding="utf-8")
    return folder / "bench.json", folder / "bench.md"


def markdown(settings: BenchmarkSettings, begun: Measurement, results: dict[str, list[Measurement]]) -> str:
    """The results as Markdown tables. Times are medians, with quartiles in brackets."""
    machine = begun["machine"]
    libraries = ", ".join(f"{name} {version}" for name, version in machine["libraries"].items())
    blocks = [
        f"- date: {begun['date']}\n"
        f"- command: `{begun['command']}`\n"
        f"- commit: {begun['commit'] or 'none'}\n"
        f"- processor: {machine['processor']}, {machine['cores_used']} of {machine['cores']} cores\n"
        + (f"- accelerator: {machine['accelerator']}\n" if machine.get("accelerator") else "")
        + f"- Python {machine['python']}, {libraries}",
        f"M = {settings.num_samples} samples, H = {settings.horizon} steps, {settings.num_steps} denoising steps in an "
        "iteration. Medians, quartiles in brackets.",
    ]
    blocks += [draw(results[section]) for section, draw in _SECTIONS.items() if results.get(section)]
    return "\n\n".join(blocks) + "\n"


def milliseconds(spread: Spread | None) -> str:
    """Median and quartiles in ms; a dash where nothing was measured."""
    if spread is None:
        return "-"
    digits = 1 if spread.median >= 0.01 else 2
    low, high = spread.lower_quartile, spread.upper_quartile
    return f"{spread.median * 1e3:.{digits}f} ({low * 1e3:.{digits}f}-{high * 1e3:.{digits}f})"


def seconds(spread: Spread) -> str:
    return f"{spread.median:.2f} ({spread.lower_quartile:.2f}-{spread.upper_quartile:.2f})"


def _with_reference(rows: list[Measurement]) -> list[Measurement]:
    """Measurements of denoising beside those of plain JAX in the same problem."""
    plain = {(row["model"], row["num_robots"]): row["step"].median for row in rows if row["engine"] == "plain"}
    return [{**row, "plain": plain.get((row["model"], row["num_robots"]))} for row in rows]


def _tabulated(
    title: str, columns: Mapping[str, Callable[[Measurement], object]]
) -> Callable[[list[Measurement]], str]:
    """Draws a table of measurements, with what to write in a column by its name."""

    def draw(rows: list[Measurement]) -> str:
        return table(title, tuple(columns), [[str(text(row)) for text in columns.values()] for row in rows])

    return draw


_DENOISING = _tabulated("Denoising", {
    "model": itemgetter("model"),
    "robots": itemgetter("num_robots"),
    "engine": itemgetter("engine"),
    "rules": itemgetter("rules"),
    "first step, ms": lambda row: milliseconds(row["step"]),
    "iteration, ms": lambda row: milliseconds(row["iteration"]),
    "ns per robot-step": lambda row: f"{row['ns_per_robot_step']:.2f}",
    "ns added per pair check": lambda row: "-" if row["ns_per_pair"] is None else f"{row['ns_per_pair']:.2f}",
    "times plain JAX": lambda row: "-" if row["plain"] is None else f"{row['plain'] / row['step'].median:.1f}",
})  # fmt: skip

_SECTIONS: dict[str, Callable[[list[Measurement]], str]] = {
    "denoising": lambda rows: _DENOISING(_with_reference(rows)),
    "threads": _tabulated("Threads", {
        "robots": itemgetter("num_robots"),
        "threads": itemgetter("threads"),
        "iteration, ms": lambda row: milliseconds(row["iteration"]),
        "on one thread, ms": lambda row: milliseconds(row["one_thread"]),
        "times as fast": lambda row: f"{row['speedup'].median:.2f}",
    }),
    "environments": _tabulated("Environment steps", {
        "environment": itemgetter("environment"),
        "worlds": itemgetter("num_worlds"),
        "robots": itemgetter("num_robots"),
        "boxes": itemgetter("obstacles"),
        "disturbances": itemgetter("disturbances"),
        "env-steps per second": lambda row: f"{row['steps_per_second']:,.0f}",
    }),
    "obstacles": _tabulated("Obstacles, 8 robots, preset paper", {
        "boxes": lambda row: f"{row['obstacles']} {row['where']}",
        "iteration, ms": lambda row: milliseconds(row["iteration"]),
        "times that in the open": lambda row: f"{row['ratio'].median:.2f}",
        "verify(), ms": lambda row: milliseconds(row["verify"]),
    }),
    "index": _tabulated("Index of a map's obstacles", {
        "cells": lambda row: f"{row['cells']} x {row['cells']}",
        "boxes": itemgetter("obstacles"),
        "s": lambda row: f"{row['seconds']:.2f}",
        "MiB": lambda row: f"{row['bytes'] / 2**20:.1f}",
    }),
    "robots": _tabulated("Control loops of D4orm-C2F, and setpoints of a plan at 100 Hz", {
        "model": itemgetter("model"),
        "mode": itemgetter("mode"),
        "robots": itemgetter("num_robots"),
        "loop, ms": lambda row: milliseconds(row["loop"]),
        "95%, ms": lambda row: f"{row['loop_95'] * 1e3:.1f}",
        "largest, ms": lambda row: f"{row['loop'].largest * 1e3:.1f}",
        "loops": lambda row: row["loop"].count,
        "replanned": itemgetter("replanned"),
        "held": itemgetter("held"),
        "plan.sample(), ms": lambda row: milliseconds(row["sample"]),
    }),
    "startup": _tabulated("From the start of a process to its first plan", {
        "problem": lambda row: f"{row['scenario']}, {row['num_robots']} robots",
        "compiling, s": lambda row: f"{row['compiling']:.1f}",
        "process with an empty cache, s": lambda row: f"{row['cold']:.1f}",
        "process with a full cache, s": lambda row: seconds(row["warm"]),
    }),
    "memory": _tabulated("Memory", {
        "robots": itemgetter("num_robots"),
        "after importing, MiB": lambda row: f"{row['imported'] / 2**20:.0f}",
        "peak while planning, MiB": lambda row: f"{row['peak'] / 2**20:.0f}",
    }),
    "plans": _tabulated("First feasible verified plan, circle of 5 m", {
        "robots": itemgetter("num_robots"),
        "engine": itemgetter("engine"),
        "preset": itemgetter("rules"),
        "solved": lambda row: f"{row['solved']} of {row['seeds']}",
        "planning, s": lambda row: seconds(row["seconds"]),
        "slowest, s": lambda row: f"{row['seconds'].largest:.2f}",
        "iterations": lambda row: f"{row['iterations'].median:.1f}",
        "travel time, s": lambda row: f"{row['travel_time'].median:.2f}",
    }),
    "big teams": _tabulated("First plan of the recommended planner", {
        "scenario": itemgetter("scenario"),
        "robots": itemgetter("num_robots"),
        "solved": lambda row: f"{row['solved']} of {row['seeds']}",
        "planning, s": lambda row: seconds(row["seconds"]),
        "slowest, s": lambda row: f"{row['seconds'].largest:.2f}",
        "travel time, s": lambda row: f"{row['travel_time'].median:.2f}",
    }),
    "improvement": _tabulated("Improving a plan in little time", {
        "scenario": itemgetter("scenario"),
        "robots": itemgetter("num_robots"),
        "limit, ms": lambda row: f"{row['limit'] * 1e3:.0f}",
        "took, ms": lambda row: milliseconds(row["seconds"]),
        "better": lambda row: f"{row['gained']} of {row['seeds']}",
        "reward gained": lambda row: f"{row['gain'].median:.4f}",
    }),
    "big loops": _tabulated("Control loops of D4orm-C2F for big teams", {
        "robots": itemgetter("num_robots"),
        "deadline": itemgetter("deadline"),
        "first coarse plan, s": lambda row: f"{row['start']:.1f}",
        "loop, ms": lambda row: milliseconds(row["loop"]),
        "95%, ms": lambda row: f"{row['loop_95'] * 1e3:.0f}",
        "late": itemgetter("late"),
        "contacts": itemgetter("contacts"),
    }),
}  # fmt: skip
