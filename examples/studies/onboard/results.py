"""Results: tables, an animation, and the timeline as a picture, from the records of the world and the robots."""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from examples.common import film
from examples.studies.onboard.thinking import COLUMNS
from examples.studies.onboard.world import Record
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from d4orm_env import Problem
from d4orm_env.render.panels import robot_colors

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


def authors_of(rows: Sequence[Row]) -> dict[str, int]:
    """Return the robot that computed each plan first, by the plan's digest."""
    found: dict[str, int] = {}
    for row in rows:
        if row["event"] == "computed":
            found.setdefault(row["plan"], row["robot"])
    return found


def run_row(record: Record, rows: Sequence[Row], dt: float) -> Row:
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
        "ticks answered late": sum(seconds > dt for seconds in record.answered),
        "messages": len(sent),
        "kB sent": f"{sum(row['bytes'] for row in sent) / 1000:.0f}",
    }


def robot_rows(record: Record, rows: Sequence[Row]) -> list[Row]:
    made = authors_of(rows)
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


def pictures(problem: Problem, record: Record, seconds: float) -> list[Any]:
    """Images of the first seconds, one for every tick; robots that were given up are pale."""
    steps = min(record.steps, round(seconds / problem.dt))
    lost = [np.isin(np.arange(problem.num_robots), record.lost[step]) for step in range(steps)]
    captions = [
        f"{joint.steps * problem.dt:.1f} s    {np.sum(record.reached[: step + 1])} goals reached"
        + (f"    {given_up.sum()} given up" if given_up.any() else "")
        for step, (joint, given_up) in enumerate(zip(record.joints[1:], lost))
    ]
    return film(problem, record.joints[1 : steps + 1], lost, record.collided[:steps], captions)


def _median(values: Any) -> str:
    return f"{np.median(values):.0f}" if len(values) else ""


INK, FAINT = "#1F2937", "#B8BEC7"
HEIGHT = 0.5
"""Height of a bar, where robots are 1 apart."""


def draw(rows: Sequence[Row], num_robots: int, seconds: float) -> Any:
    """Draw a timeline: above the round with the most to see, below the first seconds of the run."""
    figure, (above, below) = plt.subplots(
        2, 1, figsize=(9.5, 2.4 + 0.75 * num_robots), layout="constrained", height_ratios=(1.25, 1)
    )
    number = telling_round(rows)
    if number is None:
        above.text(0.5, 0.5, "no round has ended", ha="center", transform=above.transAxes)
    else:
        draw_round(above, rows, number, num_robots)
    draw_run(below, rows, num_robots, seconds)
    return figure


def telling_round(rows: Sequence[Row]) -> int | None:
    """The round with the most to see: of those whose plan was taken over, that with the most choices of another's."""
    agreed = {row["round"] for row in rows if row["event"] == "takes over"}
    choices = Counter(
        row["round"] for row in rows if row["event"] == "selected" and row["of"] != row["robot"] and row["round"] > 1
    )
    return max(agreed, key=lambda number: (choices[number], -number), default=None)


def draw_round(axes: Any, rows: Sequence[Row], number: int, num_robots: int) -> None:
    """Bars for iterations, lines for messages; the black ones are the candidates that were gone on from."""
    own = [row for row in rows if row["round"] == number]
    start = min(row["time"] for row in own if row["event"] == "begins")
    colors = robot_colors(num_robots)
    made = authors_of(rows)

    def ms(seconds: float) -> float:
        return 1000 * (seconds - start)

    _draw_messages(axes, own, ms)
    for row in own:
        if row["event"] == "computed":
            span = [(ms(row["time"]), ms(row["until"]) - ms(row["time"]))]
            axes.broken_barh(
                span, (row["robot"] - HEIGHT / 2, HEIGHT), zorder=2, facecolor=colors[row["robot"]], edgecolor="white",
                hatch=None if row["solved"] else "////",
            )  # fmt: skip
    first = {event: {} for event in ("announces", "takes over")}
    for row in own:
        if row["event"] in first and row["plan"]:
            first[row["event"]].setdefault(row["robot"], ms(row["time"]))
    for robot, time in first["announces"].items():
        axes.plot(time, robot, "D", color="white", mec=INK, ms=5, zorder=6)
    for robot, time in first["takes over"].items():
        axes.plot(time, robot, ">", color=INK, ms=7, zorder=6)
    authors = {made.get(row["plan"]) for row in own if row["event"] == "takes over"}
    author = f"robot {authors.pop()}" if len(authors) == 1 and None not in authors else "an unknown robot"
    title = f"Round {number}: the plan of {author} is taken over"
    axes.set(xlabel="time since the round began [ms]", ylabel="robot", title=title)
    _rows_of(axes, num_robots)
    _explain_round(axes)


def _draw_messages(axes: Any, own: Sequence[Row], ms: Callable[[float], float]) -> None:
    """A line for every message of a round that was received, black where its candidate was gone on from."""
    sent = {(row["robot"], row["message"]): row for row in own if row["event"] == "sent"}
    told: set[tuple[int, str]] = set()
    for row in own:
        message = sent.get((row["of"], row["message"])) if row["event"] in ("received", "selected") else None
        if message is None or row["of"] == row["robot"]:
            continue
        if row["event"] == "received":
            # That a plan is told again is not shown.
            if (row["robot"], row["plan"]) not in told:
                axes.plot(
                    [ms(message["time"]), ms(row["time"])], [row["of"], row["robot"]], color=FAINT, lw=0.7, zorder=1
                )
            told.add((row["robot"], row["plan"]))
        else:
            axes.plot([ms(message["time"]), ms(row["time"])], [row["of"], row["robot"]], color=INK, lw=1.4, zorder=4)
            axes.plot(ms(row["time"]), row["robot"], "o", color=INK, ms=3.5, zorder=5)


def _explain_round(axes: Any) -> None:
    """The legend of a round."""
    axes.legend(
        handles=[
            Patch(facecolor="#6B7280", label="computing"),
            Patch(facecolor="#6B7280", edgecolor="white", hatch="////", label="no solution yet"),
            Line2D([], [], color=FAINT, label="candidate sent"),
            Line2D([], [], color=INK, marker="o", ms=3.5, label="gone on from"),
            Line2D([], [], color="white", marker="D", mec=INK, ms=5, label="announces"),
            Line2D([], [], color="none", marker=">", mfc=INK, mec=INK, ms=7, label="takes over"),
        ],
        ncols=6, loc="upper center", bbox_to_anchor=(0.5, -0.16), fontsize=8,
    )  # fmt: skip


def draw_run(axes: Any, rows: Sequence[Row], num_robots: int, seconds: float) -> None:
    """Draw what every robot computed, when it reached a goal, and when plans were taken over."""
    colors = robot_colors(num_robots)
    shown = [row for row in rows if 0 <= row["time"] <= seconds]
    for row in shown:
        if row["event"] == "computed":
            span = [(row["time"], row["until"] - row["time"])]
            axes.broken_barh(span, (row["robot"] - HEIGHT / 2, HEIGHT), color=colors[row["robot"]], lw=0, zorder=2)
        elif row["event"] == "reaches its goal":
            axes.plot(row["time"], row["robot"], "*", color="white", mec=INK, ms=9, mew=0.8, zorder=4)
        elif row["event"] == "is given up":
            axes.plot(row["time"], row["robot"], "X", color="#D0021B", ms=9, zorder=5)
    for number in sorted({row["round"] for row in shown if row["event"] == "takes over"}):
        times = [row["time"] for row in shown if row["event"] == "takes over" and row["round"] == number]
        axes.axvline(float(np.median(times)), color=FAINT, lw=1, zorder=1)
    axes.set(xlabel="time since the start [s]", ylabel="robot", xlim=(0, seconds))
    _rows_of(axes, num_robots)
    axes.legend(
        handles=[
            Patch(facecolor="#6B7280", label="computing"),
            Line2D([], [], color="none", marker="*", mfc="white", mec=INK, ms=9, label="goal reached, a new one given"),
            Line2D([], [], color=FAINT, label="a plan is taken over"),
            Line2D([], [], color="none", marker="X", mfc="#D0021B", mec="#D0021B", ms=8, label="given up"),
        ],
        ncols=4, loc="upper center", bbox_to_anchor=(0.5, -0.2), fontsize=8,
    )  # fmt: skip


def _rows_of(axes: Any, num_robots: int) -> None:
    axes.set(yticks=range(num_robots), ylim=(num_robots - 0.4, -0.6))
    axes.grid(axis="y", visible=False)
