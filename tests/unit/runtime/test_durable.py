"""Order in which state reaches the disk."""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Callable
from pathlib import Path
from threading import Barrier
from typing import Any

import pytest

from rosrm import threads
from rosrm.runtime import durable
from tests.waiting import PATIENCE


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return the syncs and renames that follow, with the names of their files."""
    found: list[str] = []

    def noted(call: Callable[..., Any], name: Callable[..., str]) -> Callable[..., Any]:
        def noting(*arguments: Any, **options: Any) -> Any:
            found.append(f"{call.__name__} {name(*arguments)}")
            return call(*arguments, **options)

        return noting

    def of_descriptor(file: int) -> str:
        return Path(f"/proc/self/fd/{file}").readlink().name

    for name in ("fsync", "fdatasync"):
        monkeypatch.setattr(os, name, noted(getattr(os, name), of_descriptor))
    for name in ("replace", "rename"):
        monkeypatch.setattr(os, name, noted(getattr(os, name), lambda *paths: Path(paths[-1]).name))
    return found


def test_a_file_is_on_the_disk_before_its_name_and_its_name_at_the_end(
    tmp_path: Path, calls: list[str]
) -> None:
    path = tmp_path / "state"
    durable.replace_durably(str(path), b"new")
    assert calls == ["fsync state.new", "replace state", f"fsync {tmp_path.name}"]
    assert path.read_bytes() == b"new"
    assert path.stat().st_mode & 0o777 == 0o600


def test_all_in_a_directory_is_on_the_disk_before_it_is_renamed(
    tmp_path: Path, calls: list[str]
) -> None:
    """Directories follow all files, in any order; links have no content of their own."""
    inner = tmp_path / "new" / "inner"
    inner.mkdir(parents=True)
    (inner / "file").write_bytes(b"x")
    (tmp_path / "new" / "link").symlink_to("/nowhere")
    durable.rename_durably(str(tmp_path / "new"), str(tmp_path / "kept"))
    assert calls[0] == "fsync file"
    assert sorted(calls[1:3]) == ["fsync inner", "fsync new"]
    assert calls[3:] == ["rename kept", f"fsync {tmp_path.name}"]


def test_appended_content_is_on_the_disk(tmp_path: Path, calls: list[str]) -> None:
    path = tmp_path / "log"
    path.write_bytes(b"one\n")
    durable.append_durably(str(path), b"two\n")
    assert path.read_bytes() == b"one\ntwo\n"
    assert calls == ["fdatasync log"]


def test_content_that_the_disk_refuses_is_taken_back(tmp_path: Path, monkeypatch) -> None:
    """Its size would say that it is stored, and a loss of power would leave zeros."""
    path = tmp_path / "log"
    path.write_bytes(b"one\n")

    def fail(_: int) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(os, "fdatasync", fail)
    with pytest.raises(OSError, match="Input/output error"):
        durable.append_durably(str(path), b"two\n")
    assert path.read_bytes() == b"one\n"


@pytest.mark.parametrize("kind", ["tree", "files"])
def test_files_are_forced_to_the_disk_together(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    """Each sync of a file waits here until there are four; a sync of a directory does not."""
    together, fsync = Barrier(4), os.fsync

    def sync(file: int) -> None:
        if stat.S_ISREG(os.fstat(file).st_mode):
            together.wait(PATIENCE)
        fsync(file)

    monkeypatch.setattr(os, "fsync", sync)
    paths = [tmp_path / "a" / name for name in "1234"]
    paths[0].parent.mkdir()
    if kind == "files":
        assert durable.replace_all_durably({str(path): b"new" for path in paths}) == {}
        assert [path.read_bytes() for path in paths] == 4 * [b"new"]
    else:
        for path in paths:
            path.touch()
        durable.rename_durably(str(tmp_path / "a"), str(tmp_path / "b"))
        assert (tmp_path / "b" / "4").exists()


def test_a_file_that_cannot_be_replaced_holds_up_no_other(tmp_path: Path) -> None:
    bad = {str(tmp_path / "missing" / "file"): FileNotFoundError, str(tmp_path): IsADirectoryError}
    faults = durable.replace_all_durably({**dict.fromkeys(bad, b"x"), str(tmp_path / "ok"): b"x"})
    assert {path: type(fault) for path, fault in faults.items()} == bad
    assert [path.name for path in tmp_path.iterdir()] == ["ok"]
    assert not Path(f"{tmp_path}.new").exists()


@pytest.mark.parametrize(
    "sync",
    [
        lambda path: durable.replace_durably(path, b"new"),
        lambda path: durable.append_durably(path, b"more"),
        lambda path: durable.rename_durably(path, f"{path}.kept"),
        durable.sync,
        lambda path: durable.sync_directory(str(Path(path).parent)),
    ],
)  # fmt: skip
def test_a_sync_in_a_thread_that_keeps_a_lease_is_logged_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, sync: Callable[[str], None]
) -> None:
    """Other threads may sync, and so may this one before and after its loop."""
    path = tmp_path / "state"

    def repeat() -> None:
        for _ in range(2):
            path.write_bytes(b"old")
            sync(str(path))

    repeat()
    with durable.lease_kept_here():
        other = threads.start(repeat, "other")
        other.join(PATIENCE)
        assert not caplog.records
        repeat()
    repeat()
    (message,) = caplog.messages
    assert message.startswith(f"{__file__}:")
    assert durable.SYNC_IN_LOOP in message
