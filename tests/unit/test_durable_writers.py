"""Files that survive a loss of power (docs/reference/state-files.md) are on the disk in time.

Each case calls a real writer, whose files must be on the disk when the writer returns.
"""

from __future__ import annotations

import os
import socket
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rosrm.artifacts.cache import ArtifactCache
from rosrm.artifacts.pack import Archive
from rosrm.artifacts.store import ArtifactStore
from rosrm.config.first_name import keep_name
from rosrm.core.master.state.journal_gap import JournalGap
from rosrm.journal.sqlite import SqliteJournal
from rosrm.keys import key_files
from rosrm.master.journal_writer import JournalWriter
from rosrm.master.runtime import MasterRuntime
from rosrm.model.artifacts import Artifact
from rosrm.model.values import InstanceId
from rosrm.slave.launch import command
from rosrm.slave.replication.store import SnapshotStore
from rosrm.snapshots.format import Block, TransferPart
from rosrm.snapshots.writer import SlotWriter
from rosrm_criu.engine import image
from rosrm_criu.executors import checkpoint

ONE = InstanceId("one", 1)
MANIFEST = image.Manifest("one", 1, "h", 1.0, "4.2", "k", "x86_64", 1, (), (), "", "", "")


class Disk:
    """Record of the files and names below a directory that were forced to the disk.

    As on ext4 and XFS, each sync forces the content of its file, and all names up to then.
    """

    def __init__(self, root: Path, patch: pytest.MonkeyPatch) -> None:
        self._root = root
        self._contents: set[tuple[int, ...]] = set()
        self._names: dict[Path, int] = {}
        for name in ("fsync", "fdatasync"):
            patch.setattr(os, name, self._noted(getattr(os, name)))

    def _noted(self, call: Callable[[int], None]) -> Callable[[int], None]:
        def force(file: int) -> None:
            call(file)
            self._contents.add(_content_of(os.fstat(file)))
            self._names = {path: path.lstat().st_ino for path in self._root.rglob("*")}

        return force

    def lacks(self) -> list[str]:
        """Return the files that a loss of power would leave without their name or content."""
        files = {path: path.stat() for path in self._root.rglob("*") if path.is_file()}
        return sorted(
            str(path.relative_to(self._root))
            for path, status in files.items()
            if self._names.get(path) != status.st_ino or _content_of(status) not in self._contents
        )


def _content_of(status: os.stat_result) -> tuple[int, ...]:
    return status.st_ino, status.st_size, status.st_mtime_ns


def files_of_an_instance(root: Path) -> None:
    """Write the files as for a supervisor of an earlier version, which does not write them."""
    command.write_files({str(root / "logs" / name): "content" for name in ("one.1.key", "yaml")})


def artifact_of_a_host(root: Path) -> None:
    source = root.with_name("source")
    source.mkdir()
    (source / "model").write_bytes(b"weights" * 100)
    archive = Archive(source)
    cache = ArtifactCache(root, 1 << 20)
    incoming = cache.begin(Artifact("model", archive.digest, archive.size), [])
    incoming.write(archive.part(0, archive.size))
    cache.finish(incoming)


def artifact_of_the_master(root: Path) -> None:
    source = root.with_name("source")
    source.write_bytes(b"weights" * 100)
    archive = Archive(source)
    store = ArtifactStore(root, 1 << 20, lambda: 0.0)
    for content in (b"", archive.part(0, archive.size)):
        store.take("ada", archive.digest, archive.size, 0, content, keep=frozenset())


def first_name(root: Path) -> None:
    keep_name(root, socket.gethostname())


def keys(root: Path) -> None:
    key_files.make_secret(root)


def key_of_replicas(root: Path) -> None:
    keys = SnapshotStore(root, 1 << 20).keys
    keys.put("one", 1, b"k" * 32)
    keys.save("one")


def opened_replica(root: Path) -> None:
    """Open a replica, as before a successor on another host starts from it."""
    source, here = SnapshotStore(root.with_name("source"), 1 << 20), SnapshotStore(root, 1 << 20)
    source.keys.put("one", 1, b"k" * 32)
    writer = SlotWriter(source.directory("one"), "one", 1)
    writer.write(5, [Block(b"state", zlib.crc32(b"state"))])
    head, content, digest = source.newer_than("one", (0, 0)) or (None, b"", 0)
    assert head is not None
    part = TransferPart("one", 1, 5, 0, len(content), digest, content)
    assert here.take(part, bounded=True) is None
    here.keys.put("one", 2, b"k" * 32)
    assert here.open_replica("one", 2) == ""


def start_of_a_master(root: Path) -> None:
    master: Any = MasterRuntime.__new__(MasterRuntime)
    path = root / "journal.sqlite"
    master._journal = SqliteJournal(path)
    master._writer = JournalWriter(master._journal, path)
    master._stay_in_contact = lambda: None
    master._config = SimpleNamespace(name="m", record=SimpleNamespace(directory=Path()), state=root)
    master._recorder, last = None, master._last_run()
    master._state = SimpleNamespace(epoch=1, journal_gap=JournalGap())
    master._begin_run(last, 0.0)


def image_of_criu(root: Path) -> None:
    """Make an image, after which the process is killed."""

    def dump(_: object, __: int, directory: Path, **___: object) -> image.Manifest:
        image.create(directory)
        (directory / "criu" / "pages-1.img").write_bytes(b"memory")
        sizes = image.file_sizes(directory)
        made = replace(MANIFEST, sizes=sizes, checksums=image.file_checksums(directory, sizes))
        image.write(directory, made)
        return made

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(checkpoint, "find", lambda: None)
        patch.setattr(checkpoint.dump, "dump", dump)
        checkpoint.keep(
            {
                "process": "one", "source": 1, "destination": 0, "attempt": "a", "timeout": 5.0,
                "here": {
                    "host": "h", "state": str(root), "pids": {"one#1": os.getpid()},
                    "instances": ["one#1"],
                },
            }
        )  # fmt: skip


#: Functions that write, with the files that SQLite alone forces to the disk, or makes again, and
#: those without content.
WRITERS = {
    files_of_an_instance: (), artifact_of_a_host: (), artifact_of_the_master: (),
    first_name: (), keys: ("keys.lock",), key_of_replicas: (), opened_replica: (),
    image_of_criu: (), start_of_a_master: ("journal.sqlite", "journal.sqlite-shm"),
}  # fmt: skip


@pytest.mark.parametrize("writer", WRITERS, ids=lambda one: one.__name__)
def test_what_a_writer_promises_is_on_the_disk(writer, tmp_path, monkeypatch) -> None:
    root = tmp_path / "root"
    root.mkdir(mode=0o700)
    disk = Disk(root, monkeypatch)
    writer(root)
    assert len(list(root.iterdir())) > 0
    assert disk.lacks() == list(WRITERS[writer])
