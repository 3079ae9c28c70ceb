"""Success against noise on the controls: D4orm-C2F, the plan of D4orm-D executed open loop, ORCA, driving straight.

    python examples/robustness_plot.py --trials 20

The trials are kept in a folder beside the table, so a second call with more of them runs only those that are missing.
ORCA is left out where ``pyrvo`` is not installed. See docs/robustness.md for what is counted.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from importlib.util import find_spec
from typing import Any

from outputs import COLOURS, argument_parser, count, plt, save_figure, save_table

from d4orm_planners.evaluation.robustness import robustness
from d4orm_planners.evaluation.summary import SuccessRate

COLOUR = {"d4orm-c2f": COLOURS["d4orm"], "d4orm-d": COLOURS["mppi"], "orca": COLOURS["cem"], "goal": "#7F7F7F"}
LABEL = {"d4orm-c2f": "D4orm-C2F", "d4orm-d": "D4orm-D, open loop", "orca": "ORCA", "goal": "straight to the goal"}
MARKER = {"d4orm-c2f": "o", "d4orm-d": "s", "orca": "^", "goal": "x"}

SETTINGS = {"d4orm-c2f": {"refine": "sync"}}
"""Refinement in the background would make the result depend on how busy the machine is."""

NOISE = (0.0, 0.1, 0.2, 0.5, 1.0, 2.0, 4.0, 8.0)
"""Standard deviations [m/s^2] of the noise on accelerations of at most 1 m/s^2."""


def draw(rates: Sequence[SuccessRate], out: Any) -> None:
    """Success rates with their 95% confidence intervals; the levels of noise are evenly spaced."""
    figure, axes = plt.subplots(figsize=(5.6, 3.6), layout="constrained")
    levels = sorted({rate.noise for rate in rates})
    for number, (policy, colour) in enumerate(COLOUR.items()):
        line = [rate for rate in rates if rate.policy == policy]
        if not line:
            continue
        # Side by side, or intervals would hide each other.
        places = [levels.index(rate.noise) + 0.07 * (number - 1.5) for rate in line]
        reach = [[rate.rate - rate.lower for rate in line], [rate.upper - rate.rate for rate in line]]
        style = {"color": colour, "marker": MARKER[policy], "label": LABEL[policy]}
        axes.errorbar(places, [rate.rate for rate in line], reach, **style, elinewidth=0.8, capsize=2, clip_on=False)
    axes.set_xticks(range(len(levels)), [f"{level:g}" for level in levels])
    axes.set(xlabel="standard deviation of the control noise [m/s²]", ylabel="success rate", ylim=(0, 1))
    figure.legend(loc="outside upper center", ncols=2)
    save_figure(figure, out / "robustness_plot.png")


def main() -> None:
    """Run the trials that are missing, and write the table and the plot."""
    parser = argument_parser(__doc__)
    parser.add_argument("--trials", type=count, default=10, help="per policy and level of noise")
    parser.add_argument("--robots", type=count, default=8)
    parser.add_argument("--noise", type=float, nargs="+", default=NOISE)
    parser.add_argument("--workers", type=count, default=None, help="processes; as many as there are cores by default")
    arguments = parser.parse_args()
    noise, trials, robots = arguments.noise, arguments.trials, arguments.robots
    if arguments.quick:
        noise, trials, robots = (0.0, 0.5), 2, 4
    policies: dict[str, dict[str, Any]] = {
        policy: SETTINGS.get(policy, {}) for policy in COLOUR if policy != "orca" or find_spec("pyrvo")
    }
    rates = robustness(
        policies,
        arguments.out / "robustness_trials",
        scenarios=["circle"],
        robots=[robots],
        noise=noise,
        trials=trials,
        workers=arguments.workers or (1 if arguments.quick else os.cpu_count()),
        progress=lambda what, done, total: print(f"{done} of {total} trials ({what})", flush=True),
    )
    rows = [
        {
            "policy": rate.policy,
            "noise [m/s^2]": f"{rate.noise:g}",
            "success": f"{rate.successes} of {rate.trials}",
            "95% interval": f"{rate.lower:.0%} to {rate.upper:.0%}",
            "contact": rate.contacts,
            "not in time": rate.late,
            "travel time [s]": "" if rate.travel_time is None else f"{rate.travel_time:.2f}",
        }
        for rate in rates
    ]
    save_table(rows, arguments.out / "robustness_plot.csv")
    draw(rates, arguments.out)


if __name__ == "__main__":
    main()
