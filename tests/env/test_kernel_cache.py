"""Compiled kernels on disk: when they are taken from there, and that no damage and no lack of room ends a start."""

from __future__ import annotations

import base64
import errno
import gc
import hashlib
import importlib.util
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from numba.core import config
from release.warm_wheel import ship

from d4orm_env.engine import caching, kernel_files
from d4orm_env.engine.caching import has_to_be_compiled
from d4orm_env.engine.kernel_files import Turn

KERNEL = """
from os import environ
from d4orm_env.engine.caching import cached_kernel

@cached_kernel(key=environ["KERNEL_KEY"])
def twice(x):
    return 2 * x
"""

CALLER = """
import parts
from parts import Pair, double
from d4orm_env.engine.caching import cached_kernel

@cached_kernel()
def twice(x):
    return double(Pair(x, 0).first) + parts.nothing(x)
"""

PARTS = """
import numpy as np
from typing import NamedTuple
from numba import njit

FACTOR = np.int64(2)

class Pair(NamedTuple):
    first: int
    second: int

@njit
def double(x):
    return FACTOR * x

@njit
def nothing(x):
    def inner():
        return x * 0
    return inner()
"""


DAMAGES: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda content: b"",
    "half": lambda content: content[: len(content) // 2],
    "zeros": lambda content: bytes(len(content)),
    "text": lambda content: b"not a pickle\n" * 100,
    "longer": lambda content: content + b"x",
    # A type that another version knew, of a module that is gone.
    "another version": lambda content: content.replace(b"numba.core.types", b"numba.gone.types"),
    **{
        f"a bit at {share}": lambda content, share=share: flipped(content, int(share * (len(content) - 1)))
        for share in (0.0, 0.1, 0.37, 0.63, 0.9, 1.0)
    },
}


def flipped(content: bytes, place: int) -> bytes:
    return content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :]


def record_digest(content: bytes) -> str:
    return base64.urlsafe_b64encode(hashlib.sha256(content).digest()).decode().rstrip("=")


@pytest.mark.parametrize(
    ("missing", "levels"),
    [
        ((), ("x86-64-v4", "x86-64-v3", "x86-64-v2")),
        (("avx512cd",), ("x86-64-v3", "x86-64-v2")),
        (("avx512cd", "fma"), ("x86-64-v2",)),
        (("fma",), ("x86-64-v2",)),
        (("popcnt",), ()),
    ],
)
def test_levels_of_a_processor(
    monkeypatch: pytest.MonkeyPatch, missing: tuple[str, ...], levels: tuple[str, ...]
) -> None:
    features = {feature: feature not in missing for level in kernel_files.LEVELS.values() for feature in level}
    monkeypatch.setattr(kernel_files, "get_host_cpu_features", lambda: features)
    assert kernel_files.levels_here() == levels


class TestKernelCache:
    @pytest.fixture
    def path(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
        """The file of a kernel, whose cache is beside it."""
        monkeypatch.setattr(config, "CACHE_DIR", "")
        monkeypatch.setenv("KERNEL_KEY", "")
        path = tmp_path / "kernel.py"
        path.write_text(KERNEL)
        return path

    def hits(self, path: Path, key: str = "one version") -> int:
        """Load the kernel as a new process would, call it, and say how often it came from disk."""
        os.environ["KERNEL_KEY"] = key
        module = self.module(path)
        assert module.twice(21) == 42
        return sum(module.twice.stats.cache_hits.values())

    def module(self, path: Path) -> Any:
        spec = importlib.util.spec_from_file_location("kernel", path)
        assert spec is not None
        assert spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module

    @pytest.mark.parametrize(
        ("before", "after"),
        [
            ("np.int64(2)", "np.int64(1 + 1) * np.int64(1)"), ("np.int64(2)", "np.float64(2)"),
            ("FACTOR * x", "x * FACTOR"), ("x * 0", "0 * x"), ("second: int", "other: int"),
            ("@njit\ndef double", "@njit(error_model='numpy')\ndef double"),
        ],
    )  # fmt: skip
    def test_kernels_come_from_disk_until_code_they_call_changes(
        self, path: Path, monkeypatch: pytest.MonkeyPatch, before: str, after: str
    ) -> None:
        monkeypatch.syspath_prepend(path.parent)
        path.write_text(CALLER)
        hits = []
        for text in (PARTS, PARTS, PARTS.replace(before, after), PARTS):
            monkeypatch.delitem(sys.modules, "parts", raising=False)
            monkeypatch.setitem(sys.modules, "parts", ModuleType("parts"))
            exec(text, vars(sys.modules["parts"]))
            hits.append(self.hits(path))
        # The same value by another expression is the same kernel.
        assert hits == [0, 1, int(after.startswith("np.int64")), 1]

    def test_kernels_come_from_disk_until_their_key_changes(self, path: Path) -> None:
        assert self.hits(path, "one version") == 0
        assert self.hits(path, "one version") == 1
        assert self.hits(path, "another version") == 0
        assert self.hits(path, "one version") == 1

    @pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
    @pytest.mark.parametrize("kind", ["nbi", "nbc"])
    def test_what_is_damaged_is_compiled_anew_and_written_again(
        self, path: Path, kind: str, damage: Callable[[bytes], bytes]
    ) -> None:
        assert self.hits(path) == 0
        (file,) = path.parent.rglob(f"*.{kind}")
        damaged = damage(file.read_bytes())
        changed = damaged != file.read_bytes()
        file.write_bytes(damaged)
        assert has_to_be_compiled(self.module(path).twice) == changed
        assert self.hits(path) == 1 - changed
        assert self.hits(path) == 1

    @pytest.mark.parametrize("kind", ["nbi", "nbc"])
    def test_a_folder_in_the_place_of_a_file_is_done_without(self, path: Path, kind: str) -> None:
        self.hits(path)
        (file,) = path.parent.rglob(f"*.{kind}")
        file.unlink()
        file.mkdir()
        assert self.hits(path) == self.hits(path) == 0

    @pytest.mark.parametrize("code", [errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EIO])
    def test_a_kernel_that_cannot_be_kept_is_used_all_the_same(
        self, path: Path, monkeypatch: pytest.MonkeyPatch, code: int
    ) -> None:
        def full(descriptor: int) -> None:
            raise OSError(code, os.strerror(code))

        with monkeypatch.context() as context:
            context.setattr(os, "fsync", full)
            assert self.hits(path) == self.hits(path) == 0
        assert not [*path.parent.rglob("*.nb*"), *path.parent.rglob(".*")]
        assert self.hits(path) == 0
        assert self.hits(path) == 1

    def test_the_data_of_another_key_is_not_taken_for_this_ones(self, path: Path) -> None:
        # As when two processes add to an index at once: both choose the same name for their data.
        self.hits(path, "one version")
        (data,) = path.parent.rglob("*.nbc")
        first = data.read_bytes()
        data.unlink()
        next(path.parent.rglob("*.nbi")).unlink()
        self.hits(path, "another version")
        data.write_bytes(first)
        assert self.hits(path, "another version") == 0
        assert self.hits(path, "another version") == 1

    @pytest.mark.skipif(os.name != "posix", reason="permissions are POSIX's")
    @pytest.mark.parametrize(
        ("home", "mode", "kept"), [("home", 0o755, True), ("home", 0o777, False), ("~", 0o755, False)]
    )
    def test_nothing_is_kept_where_others_can_write_or_nobody_lives(
        self, path: Path, monkeypatch: pytest.MonkeyPatch, home: str, mode: int, kept: bool
    ) -> None:
        monkeypatch.chdir(path.parent)
        (path.parent / "home").mkdir()
        (path.parent / "home").chmod(mode)
        # Where the package cannot be written to, numba takes the folder of the user.
        (path.parent / "__pycache__").write_text("a file")
        monkeypatch.setenv("XDG_CACHE_HOME", home if home == "~" else str(path.parent / home))
        assert self.hits(path) == 0
        assert self.hits(path) == kept
        assert not (path.parent / "~").exists()

    @pytest.fixture
    def shipped(self, path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
        """The folder of a wheel that has the kernel, recorded as what it is, with nothing kept elsewhere."""
        if not kernel_files.levels_here() or "NUMBA_CPU_NAME" in os.environ:
            pytest.skip("wheels have kernels for x86-64 only, and none where a processor is named")
        self.hits(path)
        kernels = tmp_path / "kernels"
        folder = kernels / kernel_files.levels_here()[0]
        folder.mkdir(parents=True)
        ship(path.parent, folder)
        record = {file: record_digest(file.read_bytes()) for file in folder.iterdir()}
        monkeypatch.setattr(kernel_files, "SHIPPED", kernels)
        monkeypatch.setattr(kernel_files, "_record", lambda: record)
        kernel_files.shipped_folder.cache_clear()
        for file in path.parent.glob("__pycache__/*"):
            file.unlink()
        yield folder
        kernel_files.shipped_folder.cache_clear()

    def test_a_wheels_kernels_are_taken(self, path: Path, shipped: Path) -> None:
        assert not has_to_be_compiled(self.module(path).twice)
        assert self.hits(path) == 1
        assert not [*path.parent.glob("__pycache__/*.nb*")]

    def test_those_of_other_sources_are_not(self, path: Path, shipped: Path) -> None:
        assert self.hits(path, "another version") == 0
        assert self.hits(path, "another version") == 1

    @pytest.mark.parametrize("kind", ["nbi", "nbc"])
    def test_nor_are_those_that_the_wheels_record_does_not_list_as_they_are(
        self, path: Path, shipped: Path, kind: str
    ) -> None:
        (file,) = shipped.glob(f"*.{kind}")
        content = file.read_bytes()
        file.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
        assert self.hits(path) == 0

    def test_nor_those_of_another_processor(self, path: Path, shipped: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(kernel_files, "get_host_cpu_features", dict)
        kernel_files.shipped_folder.cache_clear()
        assert self.hits(path) == 0

    def test_without_compiling_nothing_works_and_it_is_said(self, path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(config, "DISABLE_JIT", 1)
        with pytest.raises(ImportError, match="NUMBA_DISABLE_JIT is set"):
            self.hits(path)


@pytest.mark.skipif(os.name != "posix", reason="locks on files are POSIX's")
def test_of_processes_that_need_a_kernel_at_once_one_compiles_it(tmp_path: Path) -> None:
    (tmp_path / "kernels.py").write_text(KERNEL)
    call = "import kernels; kernels.twice(2); print(sum(kernels.twice.stats.cache_hits.values()))"
    environment = os.environ | {"KERNEL_KEY": "", "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    running = [
        subprocess.Popen([sys.executable, "-c", call], cwd=tmp_path, env=environment, stdout=subprocess.PIPE)
        for _ in range(3)
    ]
    assert sorted(process.communicate()[0].split() for process in running) == [[b"0"], [b"1"], [b"1"]]


@pytest.mark.skipif(os.name != "posix", reason="locks on files are POSIX's")
def test_nobody_waits_for_ever_nor_where_nothing_can_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kernel_files, "_PATIENCE", 0.1)
    first, second = Turn(tmp_path / "a.lock"), Turn(tmp_path / "a.lock")
    assert not first.wait()
    assert second.wait()  # given up
    second.end()
    first.end()
    assert not second.wait()
    second.end()
    (tmp_path / "file").touch()
    assert not Turn(tmp_path / "file" / "a.lock").wait()


def test_nothing_is_collected_while_a_kernel_is_compiled_and_everything_afterwards() -> None:
    collecting = []

    def compiled() -> None:
        collecting.append(gc.isenabled())
        raise RuntimeError

    with pytest.raises(RuntimeError):
        caching._compile_once(compiled, None)()
    assert (collecting, gc.isenabled()) == ([False], True)


def test_numbas_registries_are_filled_only_to_compile(tmp_path: Path) -> None:
    (tmp_path / "kernels.py").write_text(KERNEL)
    call = "import sys, kernels; print(kernels.twice(2), 'numba.np.linalg' in sys.modules)"
    for filled in (True, False):
        ran = subprocess.run(
            [sys.executable, "-c", call],
            cwd=tmp_path, env=os.environ | {"KERNEL_KEY": "", "NUMBA_CACHE_DIR": str(tmp_path / "cache")},
            capture_output=True, text=True, check=True,
        )  # fmt: skip
        assert ran.stdout.split() == ["4", str(filled)]
