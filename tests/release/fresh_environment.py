"""Install a wheel into a fresh environment of each Python that is here, and run there what the README begins with.

    python tests/release/fresh_environment.py dist/d4orm_env-*.whl python3.11 python3.12 python3.13

Needs nothing but pip. Prints how many packages were installed, their size, and how long the first program takes from
cold, with all kernels to compile.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent
README = HERE.parents[1] / "README.md"


def answers(python: str) -> bool:
    """Return whether there is an interpreter of that name, other than a stand-in for one."""
    try:
        return subprocess.run([python, "--version"], capture_output=True, check=False).returncode == 0
    except FileNotFoundError:
        return False


def first_program() -> str:
    """The first program of the README."""
    return README.read_text(encoding="utf-8").split("```python\n")[1].partition("```")[0]


def installed(python: str, wheel: str, folder: Path) -> Path:
    """Make an environment without pip in ``folder``, install the wheel, and return its interpreter."""
    subprocess.run([python, "-m", "venv", "--without-pip", folder], check=True)
    fresh = folder / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    subprocess.run([sys.executable, "-m", "pip", "--python", fresh, "install", "--quiet", wheel], check=True)
    return fresh


def size_of(environment: Path) -> tuple[int, float]:
    """Number of packages in an environment, and the size of its files [MB]."""
    files = [path for path in environment.rglob("*") if path.is_file() and not path.is_symlink()]
    return len(list(environment.rglob("*.dist-info"))), sum(path.stat().st_size for path in files) / 1e6


def try_out(python: str, wheel: str, folder: Path) -> None:
    """Install the wheel for this interpreter and run both programs, or end with an error."""
    fresh = installed(python, wheel, folder / "environment")
    packages, megabytes = size_of(folder / "environment")
    print(f"{python}: {packages} packages, {megabytes:.0f} MB", flush=True)
    began = time.perf_counter()
    # Isolated: neither the folder at hand nor PYTHONPATH stands before what was installed.
    subprocess.run([fresh, "-I", "-c", first_program()], cwd=folder, check=True)
    print(f"{python}: the first program took {time.perf_counter() - began:.0f} s from cold", flush=True)
    subprocess.run([fresh, "-I", HERE / "bare.py"], cwd=folder, check=True)


def main() -> None:
    wheel, *names = sys.argv[1:]
    pythons = [name for name in names if answers(name)]
    if not pythons:
        sys.exit(f"none of {', '.join(names)} is here")
    for python in pythons:
        with tempfile.TemporaryDirectory() as folder:
            try_out(python, str(Path(wheel).resolve()), Path(folder))


if __name__ == "__main__":
    main()
