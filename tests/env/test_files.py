"""Writing files: whole or not there, whatever the name is."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from d4orm_env.core.files import replaced_when_done

pytestmark = pytest.mark.skipif(os.name != "posix", reason="names, links and pipes of POSIX")


def write(path: Path, text: str = "new") -> None:
    with replaced_when_done(path) as temporary:
        temporary.write_text(text)


@pytest.mark.parametrize(
    "name", ["plan.npz", "x" * 251 + ".npz", "x" * 255, ".x", "x." + "y" * 253, "\u00e4" * 125 + ".npz", "-o", "a b\nc"]
)
def test_any_name_that_a_file_system_takes(tmp_path: Path, name: str) -> None:
    write(tmp_path / name)
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert (tmp_path / name).read_text() == "new"


@pytest.mark.parametrize("there", [True, False])
def test_a_symbolic_link_stays_one_and_its_file_is_written(tmp_path: Path, there: bool) -> None:
    (tmp_path / "elsewhere").mkdir()
    target = tmp_path / "elsewhere" / "target.npz"
    if there:
        target.write_text("old")
    (tmp_path / "link.npz").symlink_to(Path("elsewhere", "target.npz"))
    (tmp_path / "link to it").symlink_to("link.npz")
    write(tmp_path / "link to it")
    assert (tmp_path / "link.npz").is_symlink()
    assert (tmp_path / "link to it").is_symlink()
    assert target.read_text() == "new"
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["elsewhere", "link to it", "link.npz", "target.npz"]


def test_what_is_no_file_is_refused_and_stays(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe")
    links = {"to a folder": "folder", "loop": "loop", "nowhere": "missing/file", "to a pipe": "pipe"}
    for name, target in links.items():
        (tmp_path / name).symlink_to(target)
    before = sorted(path.name for path in tmp_path.rglob("*"))
    refusals = {
        "folder": "is a folder",
        "to a folder": "is a folder",
        "pipe": "is a device or a pipe",
        "to a pipe": "is a device or a pipe",
        "loop": "[Tt]oo many",
        "nowhere": "folder .*missing does not exist",
        "missing/file": "folder .*missing does not exist",
        "x" * 256: "too long",
    }
    for name, refusal in refusals.items():
        with pytest.raises(OSError, match=refusal):
            write(tmp_path / name)
    assert sorted(path.name for path in tmp_path.rglob("*")) == before


def test_what_is_renamed_is_on_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flushed: list[bytes] = []
    monkeypatch.setattr(os, "fsync", lambda descriptor: flushed.append(os.pread(descriptor, 100, 0)))
    write(tmp_path / "file", "all of it")
    assert flushed == [b"all of it"]


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), ValueError("bad"), KeyboardInterrupt()])
def test_after_an_error_the_file_is_as_before(tmp_path: Path, error: BaseException) -> None:
    def half_written() -> None:
        with replaced_when_done(tmp_path / "file") as temporary:
            temporary.write_text("ne")
            raise error

    write(tmp_path / "file", "old")
    with pytest.raises(type(error)):
        half_written()
    assert [path.read_text() for path in tmp_path.iterdir()] == ["old"]
