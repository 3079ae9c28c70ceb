"""Add compiled kernels to a wheel, so that whoever installs it compiles nothing.

    python tests/release/warm_wheel.py dist/d4orm_env-*.whl

Makes a wheel of this Python and system beside the given one, with kernels for every level of x86-64 that this processor
is of. It needs what the package needs, and `wheel`.
"""

from __future__ import annotations

import os
import pickle
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from functools import partial
from pathlib import Path

from d4orm_env.engine.kernel_files import SHIPPED, SHIPPED_STAMP, KernelFiles, levels_here


def compile_kernels(package: Path, level: str) -> None:
    """Compile the kernels of an unpacked wheel for a level, into it."""
    folder = package / "d4orm_env" / SHIPPED.name / level
    folder.mkdir(parents=True)
    with tempfile.TemporaryDirectory() as cache:
        chosen = {
            "NUMBA_CPU_NAME": level,
            "NUMBA_CPU_FEATURES": "",
            "NUMBA_CACHE_DIR": cache,
            "PYTHONPATH": str(package),
        }
        command = [sys.executable, "-c", "from d4orm_planners.cli.warmup import warm_up; warm_up()"]
        subprocess.run(command, check=True, cwd=package, env=os.environ | chosen)
        ship(Path(cache), folder)
    kept = list(folder.iterdir())
    print(f"{level}: {len(kept)} files, {sum(path.stat().st_size for path in kept) / 1e6:.0f} MB", flush=True)


def ship(cache: Path, folder: Path) -> None:
    """Put all kernels that are kept below one folder into that of a wheel, under keys without the processor."""
    for index in cache.rglob("*.nbi"):
        with index.open("rb") as file:
            _, (stamp, _) = pickle.load(file), pickle.load(file)
        kept, shipped = (
            KernelFiles(str(path), index.stem, mark) for path, mark in ((index.parent, stamp), (folder, SHIPPED_STAMP))
        )
        for key in kept._load_index():
            sig, _, source_key = key
            shipped.save((sig, source_key), kept.load(key))


def main() -> None:
    wheel = Path(sys.argv[1]).resolve()
    python = f"cp{sys.version_info.major}{sys.version_info.minor}"
    system = sysconfig.get_platform().replace("-", "_").replace(".", "_")
    tags = ["--python-tag", python, "--abi-tag", python, "--platform-tag", system]
    with tempfile.TemporaryDirectory() as folder:
        run = partial(subprocess.run, check=True, cwd=folder)
        run([sys.executable, "-m", "wheel", "unpack", wheel])
        (package,) = Path(folder).iterdir()
        for level in levels_here():
            compile_kernels(package, level)
        run([sys.executable, "-m", "wheel", "pack", package])
        run([sys.executable, "-m", "wheel", "tags", "--remove", *tags, wheel.name])
        (warm,) = Path(folder).glob("*.whl")
        shutil.move(warm, wheel.parent / warm.name)
        print(f"wrote {wheel.parent / warm.name}")


if __name__ == "__main__":
    main()
