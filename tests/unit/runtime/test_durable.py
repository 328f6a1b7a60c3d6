"""Order in which state reaches the disk."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path
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
    """Directories follow what is in them; links have no content of their own."""
    inner = tmp_path / "new" / "inner"
    inner.mkdir(parents=True)
    (inner / "file").write_bytes(b"x")
    (tmp_path / "new" / "link").symlink_to("/nowhere")
    durable.rename_durably(str(tmp_path / "new"), str(tmp_path / "kept"))
    assert calls == [
        "fsync file", "fsync inner", "fsync new", "rename kept", f"fsync {tmp_path.name}",
    ]  # fmt: skip


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
