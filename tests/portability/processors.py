"""Plan under the instruction sets of several processors, in fresh processes, and compare with `digests.json`.

A processor is emulated as far as software chooses by it: numba compiles for it, NumPy and the C library take the
versions of their functions that they would take there. Exit status 1 if a plan differs.

    python tests/portability/processors.py [--quick]
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

from llvmlite import binding

HERE = Path(__file__).parent


class Processor(NamedTuple):
    """A processor by what software knows of it.

    Attributes:
        cpu: LLVM's name.
        needs: A feature that this machine must have for its instructions to run.
        without: Features that NumPy and the C library must do without.
    """

    cpu: str
    needs: str
    without: str


AVX512 = "X86_V4 AVX512_ICL AVX512_SPR"
PROCESSORS = {
    "x86_64": (
        Processor("generic", "sse2", f"X86_V3 {AVX512}"),
        Processor("x86-64-v2", "sse4.2", f"X86_V3 {AVX512}"),
        Processor("haswell", "avx2", AVX512),
        Processor("skylake-avx512", "avx512f", ""),
    ),
    "aarch64": (Processor("generic", "neon", ""), Processor("neoverse-n1", "lse", "")),
}
GLIBC = {"X86_V3": "-AVX2,-AVX,-FMA,-FMA4", AVX512: "-AVX512F,-AVX512VL,-AVX512BW,-AVX512DQ"}


def environment(processor: Processor, cache: str) -> dict[str, str]:
    """Variables under which a process believes to be on this processor."""
    masked = ",".join(flags for names, flags in GLIBC.items() if names in processor.without)
    return os.environ | {
        "NUMBA_CPU_NAME": processor.cpu,
        "NUMBA_CPU_FEATURES": "",
        "NUMBA_CACHE_DIR": cache,
        "NPY_DISABLE_CPU_FEATURES": processor.without,
        "GLIBC_TUNABLES": f"glibc.cpu.hwcaps={masked}",
        # NumPy warns of features that it could not have used anyway.
        "PYTHONWARNINGS": "ignore::ImportWarning,ignore::RuntimeWarning",
    }


def plan_on(processor: Processor) -> dict[str, str]:
    """Digests of the plans that a process makes which believes to be on this processor."""
    with tempfile.TemporaryDirectory() as cache:
        command = [sys.executable, str(HERE / "plans.py"), *sys.argv[1:]]
        output = subprocess.run(command, env=environment(processor, cache), stdout=subprocess.PIPE, check=True)
    return json.loads(output.stdout)


def here() -> list[Processor]:
    """Those that this machine can be, the oldest first; of others it is said that they are left out."""
    features, found = binding.get_host_cpu_features(), []
    for processor in PROCESSORS.get(platform.machine(), ()):
        if features.get(processor.needs, processor.needs in ("neon", "sse2")):
            found.append(processor)
        else:
            print(f"{processor.cpu}: this machine has no {processor.needs}, left out")
    return found


def main() -> int:
    """Compare them all, and return how many differ."""
    expected = json.loads((HERE / "digests.json").read_text())
    if platform.machine() not in PROCESSORS:
        print(f"no processors to emulate on {platform.machine()}; nothing compared")
    failures, emulated = 0, here()
    # They compile for most of the time, each on one core.
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for processor, found in zip(emulated, pool.map(plan_on, emulated)):
            different = [name for name, value in found.items() if value != expected[name]]
            failures += bool(different)
            print(
                f"{processor.cpu}: {len(found)} plans, "
                + (f"different: {', '.join(different)}" if different else "the same")
            )
    return failures


if __name__ == "__main__":
    sys.exit(min(main(), 1))
