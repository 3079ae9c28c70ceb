"""Results: tables and an animation from the records of the world and the robots."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from examples.studies.onboard.log import COLUMNS
from examples.studies.onboard.world import Record

from d4orm_env import Problem
from d4orm_env.render import FrameRenderer

Row = dict[str, Any]


def timeline(record: Record, logs: Sequence[Path]) -> list[Row]:
    """All events of all robots and of the world in the order of time, in seconds since the first tick."""
    rows: list[Row] = []
    for path in logs:
        with path.open(newline="") as file:
            # A robot that was killed may have left half a line.
            rows += [row for row in csv.DictReader(file, restval=None) if None not in row.values()]
    start = record.began[0] if record.began else 0.0
    for row in rows:
        row["time"], row["until"] = float(row["time"]) - start, float(row["until"]) - start
        row |= {name: int(row[name]) for name in ("tick", "round", "robot")}
        row |= {name: int(row[name]) for name in ("of", "message", "bytes", "solved") if row[name]}
    empty = dict.fromkeys(COLUMNS, "")
    lost: set[int] = set()
    for step in range(record.steps):
        now = record.began[step] + record.answered[step] - start
        events = [("reaches its goal", robot) for robot in np.flatnonzero(record.reached[step])]
        events += [("touches", robot) for robot in np.flatnonzero(record.collided[step])]
        events += [("is given up", robot) for robot in record.lost[step] if robot not in lost]
        lost |= set(record.lost[step])
        rows += [
            empty | {"time": now, "until": now, "tick": step + 1, "robot": int(robot), "event": event}
            for event, robot in events
        ]
    return sorted(rows, key=lambda row: row["time"])


def makers(rows: Sequence[Row]) -> dict[str, int]:
    """Return the robot that computed each plan first, by the plan's digest."""
    found: dict[str, int] = {}
    for row in rows:
        if row["event"] == "computed":
            found.setdefault(row["plan"], row["robot"])
    return found


def run_row(record: Record, rows: Sequence[Row], dt: float) -> Row:
    """The run in figures."""
    by_event = {event: [row for row in rows if row["event"] == event] for event in {row["event"] for row in rows}}
    computing = 1000 * np.array([row["until"] - row["time"] for row in by_event.get("computed", [])])
    sent = by_event.get("sent", [])
    ends = [row for event in ("takes over", "keeps") for row in by_event.get(event, [])]
    agreed = {row["round"] for row in by_event.get("takes over", [])}
    return {
        "robots": len(record.reached[0]),
        "simulated [s]": f"{record.steps * dt:.1f}",
        "wall clock [s]": f"{record.wall:.1f}",
        "goals reached": record.goals_reached,
        "goals per robot-minute": f"{60 * record.goals_reached / max(np.size(record.reached) * dt, dt):.2f}",
        "robot-steps in contact": int(np.sum(record.collided)),
        "robots given up": len(record.lost[-1]),
        "ticks with different plans": sum(len(plans) > 1 for plans in record.executing),
        "rounds ended": len({row["round"] for row in ends}),
        "plans taken over": len(agreed),
        "iteration, median [ms]": _median(computing),
        "iteration, 95th percentile [ms]": f"{np.percentile(computing, 95):.0f}" if len(computing) else "",
        "tick answered, median [ms]": _median(1000 * np.array(record.answered)),
        "tick answered, slowest [ms]": f"{1000 * max(record.answered, default=0):.0f}",
        "messages": len(sent),
        "kB sent": f"{sum(row['bytes'] for row in sent) / 1000:.0f}",
    }


def robot_rows(record: Record, rows: Sequence[Row]) -> list[Row]:
    """Each robot in figures."""
    made = makers(rows)
    taken = {row["plan"] for row in rows if row["event"] == "takes over"}
    table = []
    for robot in range(len(record.reached[0])):
        own = [row for row in rows if row["robot"] == robot]
        computed = [row for row in own if row["event"] == "computed"]
        sent = [row for row in own if row["event"] == "sent"]
        table.append(
            {
                "robot": robot,
                "goals reached": int(np.sum(record.reached, axis=0)[robot]),
                "steps in contact": int(np.sum(record.collided, axis=0)[robot]),
                "iterations": len(computed),
                "time computing": f"{sum(row['until'] - row['time'] for row in computed) / record.wall:.0%}",
                "messages sent": len(sent),
                "kB sent": f"{sum(row['bytes'] for row in sent) / 1000:.0f}",
                "candidates received": sum(row["event"] == "received" for row in own),
                "chose another's": sum(row["event"] == "selected" and row["of"] != robot for row in own),
                "of its plans executed": sum(made.get(plan) == robot for plan in taken),
                "given up": "yes" if robot in record.lost[-1] else "",
            }
        )
    return table


def film(problem: Problem, record: Record, seconds: float) -> list[Any]:
    """Images of the first seconds, one for every tick; robots that were given up are pale."""
    renderer = FrameRenderer(problem, (520, 540))
    frames = []
    for step in range(min(record.steps, round(seconds / problem.dt))):
        joint = record.joints[step + 1]
        trail = np.stack([past.states[:, :2] for past in record.joints[max(step - 25, 0) : step + 2]])
        lost = np.isin(np.arange(problem.num_robots), record.lost[step])
        goals = int(np.sum(record.reached[: step + 1]))
        note = f"    {lost.sum()} given up" if lost.any() else ""
        caption = f"{joint.steps * problem.dt:.1f} s    {goals} goals reached{note}"
        frames.append(renderer.draw(joint.states, lost, record.collided[step], joint.goals, trail, caption=caption))
    renderer.close()
    return frames


def _median(values: Any) -> str:
    return f"{np.median(values):.0f}" if len(values) else ""
