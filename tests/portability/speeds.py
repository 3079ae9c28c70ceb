"""Times of the benchmark under the instruction sets of several processors, in turn on this machine.

python tests/portability/speeds.py [arguments of d4orm bench, by default --quick]

Prints a Markdown table: each row's median in seconds on the newest processor that this machine can be, and for the
others how many times as long it took.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Any

from processors import Processor, environment, here

sys.path.append(str(Path(__file__).parents[1] / "release"))
from bench_compare import ROOT, ROUNDS, bench, medians


def main(arguments: list[str]) -> None:
    """Measure them in turn, once more before that to compile."""
    with tempfile.TemporaryDirectory() as folder:
        processors = {processor: environment(processor, f"{folder}/{processor.cpu}") for processor in here()}
        reports: dict[Processor, list[dict[str, Any]]] = {processor: [] for processor in processors}
        for _ in range(ROUNDS + 1):
            for processor in (*reports,):
                reports[processor].append(bench(ROOT, Path(folder, "out"), arguments, processors[processor]))
            reports = dict(reversed(reports.items()))  # none is always the first
    times = {processor: medians(reports[processor][1:]) for processor in processors}
    *others, newest = times
    print("| what |", " | ".join([f"{newest.cpu} [s]", *(other.cpu for other in others)]), "|")
    print("|---" * (2 + len(others)) + "|")
    for what, seconds in times[newest].items():
        ratios = (f"{times[other][what] / seconds:.2f}" for other in others if what in times[other])
        print("|", " | ".join([what, f"{seconds:.4g}", *ratios]), "|")


if __name__ == "__main__":
    main(sys.argv[1:] or ["--quick"])
