"""Benchmark results as JSON and as Markdown tables."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path

from d4orm_env.core.files import replaced_when_done
from d4orm_planners._machine import describe_machine, versions
from d4orm_planners.benchmark.benchmark import BenchmarkSettings
from d4orm_planners.benchmark.timing import Row, Spread
from d4orm_planners.evaluation.report import table

FORMAT = "d4orm-bench-1"
LIBRARIES = ("d4orm-env", "numpy", "numba", "jax", "gymnasium", "pettingzoo")


def circumstances(command: str) -> Row:
    """Under which a benchmark runs that begins now: date, command, machine with its load, and libraries."""
    load = list(os.getloadavg()) if hasattr(os, "getloadavg") else None
    machine = {**describe_machine(), "load_average": load, "libraries": versions(LIBRARIES)}
    return {"date": datetime.now(UTC).isoformat(timespec="seconds"), "command": command, "machine": machine}


def write_report(
    folder: Path, settings: BenchmarkSettings, begun: Row, results: dict[str, list[Row]]
) -> tuple[Path, Path]:
    """Write ``bench.json`` and ``bench.md``.

    Args:
        folder: Where to.
        settings: Of the benchmark.
        begun: What :func:`circumstances` said at its beginning.
        results: By section, see :func:`~d4orm_planners.benchmark.benchmark.run_parts`.

    Returns:
        The two paths.

    Raises:
        OSError: If the folder does not exist or cannot be written to.
    """
    document = {"format": FORMAT, **begun, "settings": asdict(settings), **results}
    with replaced_when_done(folder / "bench.json") as path:
        path.write_text(json.dumps(document, indent=1, default=asdict, allow_nan=False) + "\n", encoding="utf-8")
    with replaced_when_done(folder / "bench.md") as path:
        path.write_text(markdown(settings, begun, results), encoding="utf-8")
    return folder / "bench.json", folder / "bench.md"


def markdown(settings: BenchmarkSettings, begun: Row, results: dict[str, list[Row]]) -> str:
    """The results as Markdown tables. Times are medians, with quartiles in brackets."""
    machine = begun["machine"]
    libraries = ", ".join(f"{name} {version}" for name, version in machine["libraries"].items())
    blocks = [
        f"- date: {begun['date']}\n- command: `{begun['command']}`\n- processor: {machine['processor']}, "
        f"{machine['cores_used']} of {machine['cores']} cores\n- Python {machine['python']}, {libraries}",
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
    """Median and quartiles in s."""
    return f"{spread.median:.2f} ({spread.lower_quartile:.2f}-{spread.upper_quartile:.2f})"


def _denoising(rows: list[Row]) -> str:
    plain = {(row["model"], row["num_robots"]): row["step"].median for row in rows if row["engine"] == "plain"}
    lines = []
    for row in rows:
        reference = plain.get((row["model"], row["num_robots"]))
        pair = row["ns_per_pair"]
        lines.append((
            row["model"],
            str(row["num_robots"]),
            row["engine"],
            row["rules"],
            milliseconds(row["step"]),
            milliseconds(row["iteration"]),
            f"{row['ns_per_robot_step']:.2f}",
            "-" if pair is None else f"{pair:.2f}",
            "-" if reference is None else f"{reference / row['step'].median:.1f}",
        ))  # fmt: skip
    header = ("model", "robots", "engine", "rules", "first step, ms", "iteration, ms", "ns per robot-step",
              "ns added per pair check", "times plain JAX")  # fmt: skip
    return table("Denoising", header, lines)


def _environments(rows: list[Row]) -> str:
    lines = [
        (
            row["environment"],
            str(row["num_worlds"]),
            str(row["num_robots"]),
            str(row["obstacles"]),
            str(row["disturbances"]),
            f"{row['steps_per_second']:,.0f}",
        )
        for row in rows
    ]
    header = ("environment", "worlds", "robots", "boxes", "disturbances", "env-steps per second")
    return table("Environment steps", header, lines)


def _obstacles(rows: list[Row]) -> str:
    lines = [
        (
            f"{row['obstacles']} {row['where']}",
            milliseconds(row["iteration"]),
            f"{row['ratio'].median:.2f}",
            milliseconds(row["verify"]),
        )
        for row in rows
    ]
    header = ("boxes", "iteration, ms", "times that in the open", "verify(), ms")
    return table("Obstacles, 8 robots, preset paper", header, lines)


def _index(rows: list[Row]) -> str:
    lines = [
        (
            f"{row['cells']} x {row['cells']}",
            str(row["obstacles"]),
            f"{row['seconds']:.2f}",
            f"{row['bytes'] / 2**20:.1f}",
        )
        for row in rows
    ]
    return table("Index of a map's obstacles", ("cells", "boxes", "s", "MiB"), lines)


def _startup(rows: list[Row]) -> str:
    lines = [(str(row["num_robots"]), f"{row['compiling']:.1f}", f"{row['cold']:.1f}", seconds(row["warm"]))
             for row in rows]  # fmt: skip
    header = ("robots", "compiling, s", "process with an empty cache, s", "process with a full cache, s")
    return table("From the start of a process to its first plan", header, lines)


def _memory(rows: list[Row]) -> str:
    lines = [(str(row["num_robots"]), f"{row['imported'] / 2**20:.0f}", f"{row['peak'] / 2**20:.0f}") for row in rows]
    return table("Memory", ("robots", "after importing, MiB", "peak while planning, MiB"), lines)


def _plans(rows: list[Row]) -> str:
    lines = [
        (
            str(row["num_robots"]),
            row["rules"],
            f"{row['solved']} of {row['seeds']}",
            seconds(row["seconds"]),
            f"{row['seconds'].largest:.2f}",
            f"{row['iterations'].median:.1f}",
            f"{row['travel_time'].median:.2f}",
        )
        for row in rows
    ]
    header = ("robots", "preset", "solved", "planning, s", "slowest, s", "iterations", "travel time, s")
    return table("First feasible verified plan, circle of 5 m", header, lines)


_SECTIONS: dict[str, Callable[[list[Row]], str]] = {
    "denoising": _denoising,
    "environments": _environments,
    "obstacles": _obstacles,
    "index": _index,
    "startup": _startup,
    "memory": _memory,
    "plans": _plans,
}
