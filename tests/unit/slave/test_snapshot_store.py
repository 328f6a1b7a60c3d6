"""Snapshots from other hosts: forged, unfinished or too many, they harm no honest sender."""

from __future__ import annotations

import errno
import os
import zlib
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rosrm import shortage
from rosrm.ros.names import token
from rosrm.ros.slave.replication import NotStored
from rosrm.slave.replication import store as stores
from rosrm.slave.replication.encryption import decrypted, encrypted
from rosrm.slave.replication.store import SnapshotStore
from rosrm.snapshots import reader
from rosrm.snapshots.format import Block, TransferPart, checked, encoded_head
from rosrm.snapshots.writer import CopyWriter, SlotWriter
from tests.limits import no_more_files

#: The name that release 0.1.0 gave the directory of the process "map-server".
OLD_NAME = "map_server_651ecfc8"
KEY = bytes(range(32))


class Shelf:
    """A store whose time is set by the test."""

    def __init__(self, root: Path, max_bytes: int = 1_000_000) -> None:
        self.root, self.now = root, 1000.0
        self.store = SnapshotStore(root, max_bytes, lambda: self.now)

    def take(self, part: TransferPart, *, bounded: bool = True) -> str:
        """Offer a part; return the code of its refusal, or ""."""
        refusal: NotStored | None = self.store.take(part, bounded=bounded)
        return "" if refusal is None else refusal.code

    def send(self, process: str, number: int, sequence: int = 1, content: bytes = b"state") -> str:
        """Send a whole snapshot; return the code of the first refusal, or ""."""
        refusals = (self.take(part) for part in parts(process, number, sequence, content))
        return next((code for code in refusals if code), "")

    def age(self, process: str) -> tuple[int, int] | None:
        head = reader.newest_head(self.store.directory(process))
        return None if head is None else head.age


def snapshot(process: str, number: int, sequence: int = 1, content: bytes = b"state") -> bytes:
    block = Block(content, zlib.crc32(content))
    return encoded_head(process, number, sequence, [block]) + content


def parts(
    process: str, number: int, sequence: int = 1, content: bytes = b"state", size: int = 40,
    key: bytes = b"",
) -> list[TransferPart]:  # fmt: skip
    """Return the parts of a snapshot, of `size` bytes each; encrypted, if there is a key."""
    data = snapshot(process, number, sequence, content)
    if key:
        data = encrypted(key, checked(data)[0], data)
    digest = zlib.crc32(data)
    return [
        TransferPart(process, number, sequence, at, len(data), digest, data[at : at + size])
        for at in range(0, len(data), size)
    ]


def open_files() -> int:
    return len(os.listdir("/proc/self/fd"))  # noqa: PTH208 - links to what is gone


@pytest.fixture
def shelf(tmp_path) -> Shelf:
    return Shelf(tmp_path / "kept")


# --- transfers --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "changes",
    [{"total": 10_000_000}, {"total": 1}, {"data": b"x" * 100_000}, {"data": b""}],
    ids=["larger", "smaller", "too much", "nothing"],
)
def test_a_later_part_is_held_to_the_size_that_the_first_one_named(shelf, changes):
    """Nothing is written beyond that size, and the right part still completes the transfer."""
    first, second = parts("p", 7)
    assert shelf.take(first) == ""
    assert shelf.take(second._replace(**changes)) == "order"
    assert (shelf.root / "p" / "copy.new").stat().st_size == len(first.data)
    assert shelf.take(second) == ""
    assert shelf.age("p") == (7, 1)


def test_a_first_part_beyond_its_own_size_is_refused(shelf):
    first = parts("p", 7)[0]
    assert shelf.take(first._replace(total=2)) == "order"
    assert shelf.age("p") is None


def test_a_transfer_that_stops_is_given_up_and_its_file_closed(shelf):
    """The sender may begin again."""
    before = open_files()
    first, second = parts("p", 7)
    assert shelf.take(first) == ""
    shelf.now += stores.INTERRUPTED - 1.0
    shelf.store.end_interrupted(shelf.now)
    assert open_files() == before + 1
    shelf.now += 1.0
    shelf.store.end_interrupted(shelf.now)
    assert open_files() == before
    assert not (shelf.root / "p").exists()
    assert shelf.take(second) == "order"
    assert shelf.send("p", 7) == ""


def test_the_number_of_transfers_is_bounded(shelf):
    """Those under way continue, and the next one begins when one has ended."""
    begun = [parts(f"p{number}", 7) for number in range(stores.MOST_INCOMING + 1)]
    assert [shelf.take(one[0]) for one in begun] == [*[""] * stores.MOST_INCOMING, "full"]
    assert shelf.take(begun[0][1]) == ""
    assert shelf.take(begun[-1][0]) == ""


def test_a_stranger_does_not_end_the_fetch_for_a_start(shelf):
    """The part of another sender has no effect on a snapshot that this host fetches."""
    first, second = parts("p", 7)
    assert shelf.take(first, bounded=False) == ""
    assert shelf.send("p", 8) == "full"
    assert shelf.take(second, bounded=True) == "order"
    assert shelf.take(second, bounded=False) == ""
    assert shelf.age("p") == (7, 1)


def test_the_number_and_bytes_of_replicas_are_bounded(tmp_path, monkeypatch):
    """Small ones count as a block of the disk; a newer replica of a known process has room."""
    monkeypatch.setattr(stores, "MOST_REPLICAS", 3)
    shelf = Shelf(tmp_path / "many")
    assert [shelf.send(f"p{number}", 7) for number in range(4)] == ["", "", "", "full"]
    assert shelf.send("p0", 7, 2) == ""
    small = Shelf(tmp_path / "small", max_bytes=8192)
    assert [small.send(f"p{number}", 7) for number in range(3)] == ["", "", "full"]


def test_a_replica_of_another_process_deletes_nothing(shelf):
    """The name in the file is not the name under which its parts came."""
    writer = SlotWriter(shelf.store.directory("p"), "p", 7)
    writer.write(3, [Block(b"mine", zlib.crc32(b"mine"))])
    writer.close()
    data = snapshot("other", 2**40)
    forged = TransferPart("p", 2**40, 1, 0, len(data), zlib.crc32(data), data)
    assert shelf.take(forged) == "damaged"
    assert shelf.age("p") == (7, 3)


def test_a_number_far_ahead_does_not_displace_the_true_one_for_ever(shelf):
    """A replica that its sender refreshes stays; a forged one is replaced after a minute."""
    assert shelf.send("p", 2**52) == ""
    assert shelf.send("p", 7, 5) == "newer"
    shelf.now += stores.DOUBTFUL_FOR - 1.0
    assert shelf.send("p", 2**52, 2) == ""
    shelf.now += stores.DOUBTFUL_FOR - 1.0
    assert shelf.send("p", 7, 6) == "newer"
    shelf.now += 1.0
    assert shelf.send("p", 7, 7) == ""
    assert shelf.age("p") == (7, 7)


def test_a_doubtful_replica_from_before_the_start_of_the_slave_is_replaced_too(shelf):
    assert shelf.send("p", 2**52) == ""
    later = Shelf(shelf.root)
    assert later.send("p", 7) == "newer"
    later.now += stores.DOUBTFUL_FOR
    assert later.send("p", 7) == ""


def test_the_replica_of_a_successor_is_never_displaced(shelf):
    """An old instance that still runs somewhere sends its snapshots for ever."""
    assert shelf.send("p", 8) == ""
    shelf.now += 1e6
    assert shelf.send("p", 7, 99) == "newer"


@settings(deadline=None, max_examples=300)
@given(st.data())
def test_no_sequence_of_parts_harms_the_transfer_of_another_process(tmp_path_factory, data):
    """Any numbers, in any order, at any time: bounded files, and an honest replica arrives.

    Where a process has a key, no replica is stored that was not encrypted with it.
    """
    numbers = st.sampled_from([0, 1, 7, 8, 40, 2**31, 2**52, 2**62, 2**63, 2**64 - 1])
    shelf = Shelf(tmp_path_factory.mktemp("s") / "kept")
    keyed = data.draw(st.sets(st.sampled_from(["a", "b", "p", "honest"])))
    for process in keyed:
        shelf.store.keys.put(process, 1, KEY)
    before = open_files()
    forged = st.builds(
        TransferPart, st.sampled_from(["a", "b", "p", "", "../x", "\0", "x" * 300]),
        numbers, numbers, numbers, numbers, st.integers(0, 2**32 - 1), st.binary(max_size=50),
    )  # fmt: skip
    honest = [*parts("a", 7), *parts("b", 2**52), *parts("a", 8, content=b"x" * 99)]
    honest += [part for key in (KEY, bytes(32)) for part in parts("a", 9, size=200, key=key)]
    forged |= st.sampled_from(honest)
    for part in data.draw(st.lists(forged, max_size=30)):
        shelf.now += data.draw(st.sampled_from([0.0, 1.0, 29.0, 31.0]))
        shelf.take(part)
        assert open_files() <= before + stores.MOST_INCOMING
    shelf.store.end_interrupted(shelf.now + 100.0)
    assert open_files() == before
    key = KEY if "honest" in keyed else b""
    assert [shelf.take(part) for part in parts("honest", 7, size=200, key=key)] == [""]
    for process in keyed:
        copy = shelf.store.directory(process) / reader.COPY
        assert not copy.exists() or decrypted(KEY, copy)
    assert {path.parent for path in shelf.root.parent.iterdir()} == {shelf.root.parent}


# --- reads ------------------------------------------------------------------------------------


def test_the_memory_for_reads_is_bounded(shelf, monkeypatch):
    """Snapshots that were read longest ago are read from the disk again."""
    monkeypatch.setattr(stores, "_MOST_READ", 5000)
    for number in range(10):
        shelf.send(f"p{number}", 7, content=bytes(1000))
    for number in range(10):
        part = shelf.store.read(f"p{number}", (0, 0), 0, 100)
        assert part is not None
        held = sum(len(one.content) for one in shelf.store._being_read.values())
        assert held <= 5000
    again = shelf.store.read("p0", (7, 1), 100, 10_000)
    assert again is not None
    assert again.is_last


@pytest.mark.parametrize("offset", [2**31, 2**64 - 1])
def test_a_read_beyond_the_end_is_empty(shelf, offset):
    shelf.send("p", 7)
    part = shelf.store.read("p", (7, 1), offset, 2**32 - 1)
    assert part is not None
    assert part.data == b""


# --- a host without descriptors ---------------------------------------------------------------


def test_without_descriptors_replicas_are_refused_and_none_is_reported_as_lost(shelf):
    shelf.send("p", 7)
    with no_more_files():
        assert shelf.send("q", 7) == "full"
        with pytest.raises(OSError, match="Too many open files"):
            shelf.store.scan()
    assert [one.instance.process for one in shelf.store.scan()] == ["p"]
    assert shelf.send("q", 7) == ""


def test_a_directory_that_cannot_be_looked_at_hides_no_other(shelf, monkeypatch):
    """The slave starts, and reports the snapshots of the other processes."""
    shelf.send("p", 7)
    shelf.send("q", 7)

    def failing(path, **how):
        if path == shelf.store.directory("p"):
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return shortage.status(path, **how)

    monkeypatch.setattr(stores, "status", failing)
    assert [one.instance.process for one in shelf.store.scan()] == ["q"]


def test_a_replica_that_cannot_be_checked_without_memory_leaves_no_open_file(shelf, monkeypatch):
    """The sender tries again and again."""

    def lack(*_: object) -> None:
        raise MemoryError

    monkeypatch.setattr(CopyWriter, "check", lack)
    before = open_files()
    with pytest.raises(MemoryError):
        shelf.send("p", 7)
    assert open_files() == before


# --- after an upgrade -------------------------------------------------------------------------


def test_snapshots_of_an_earlier_release_are_found_under_the_new_name(shelf):
    """The old path stays valid for an instance that the supervisor restarts with it."""
    old, new = shelf.root / OLD_NAME, shelf.root / token("map-server")
    assert old != new
    writer = SlotWriter(old, "map-server", 7)
    state = [Block(b"map", zlib.crc32(b"map"))]
    writer.write(5, state)
    assert [one.instance.process for one in shelf.store.scan()] == ["map-server"]
    assert shelf.age("map-server") == (7, 5)
    writer.write(6, state)  # by the instance that still runs
    writer.close()
    assert shelf.age("map-server") == (7, 6)
    restarted = SlotWriter(old, "map-server", 7)
    restarted.write(9, state)
    restarted.close()
    assert [(one.instance.number, one.sequence) for one in shelf.store.scan()] == [(7, 9)]
    assert reader.newest(old, 7)[0] is not None
    shelf.store.drop("map-server", 7)
    assert shelf.store.scan() == ()
    assert list(shelf.root.iterdir()) == []


def test_two_processes_of_one_token_have_directories_of_their_own(shelf):
    """Release 0.1.0 kept both in one directory, where each deleted the other's snapshots."""
    one, other = "robot-1", "robot_1_bd82fad2"
    assert shelf.send(one, 7) == ""
    assert shelf.send(other, 3) == ""
    shelf.store.drop(other, 99)
    assert (shelf.age(one), shelf.age(other)) == ((7, 1), None)
