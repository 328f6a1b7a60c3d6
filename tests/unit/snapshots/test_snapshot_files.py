"""Snapshot files: whole, torn, damaged, older and newer ones, after any end of their writer."""

from __future__ import annotations

import contextlib
import errno
import os
import stat
import zlib
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rosrm.runtime import durable
from rosrm.snapshots import reader
from rosrm.snapshots.format import MOST_CYCLES, Block, Damaged, decoded, encoded_head
from rosrm.snapshots.writer import CopyWriter, SlotWriter, drop_snapshots, drop_torn


def blocks(*contents: bytes) -> list[Block]:
    return [Block(data, zlib.crc32(data)) for data in contents]


def write_copy(directory: Path, data: bytes) -> None:
    copy = CopyWriter(directory)
    copy.append(data)
    head = decoded(data).head
    copy.check(head.process, head.age)
    copy.finish()


def write(directory: Path, sequence: int, *contents: bytes, instance: int = 7) -> bool:
    writer = SlotWriter(directory, "counter", instance)
    try:
        return writer.write(sequence, blocks(*contents))
    finally:
        writer.close()


def newest(directory: Path, up_to: int = 99):
    found, _ = reader.newest(directory, up_to)
    return None if found is None else (found.head.age, found.blocks)


CONTENTS = st.lists(st.binary(max_size=200), min_size=1, max_size=4)


@given(contents=CONTENTS, sequence=st.integers(0, MOST_CYCLES - 1), name=st.text(max_size=20))
def test_what_is_written_is_read(contents, sequence, name):
    """Name, instance, sequence and every block are equal, bit by bit."""
    parts = blocks(*contents)
    data = encoded_head(name, 3, sequence, parts) + b"".join(contents)
    read = decoded(data)
    assert (read.head.process, read.head.instance, read.head.sequence) == (name, 3, sequence)
    assert list(read.blocks) == contents
    assert read.head.size == len(data)


@given(contents=CONTENTS, data=st.data())
def test_no_change_goes_unseen(contents, data):
    """One changed byte anywhere, or a file that ends too early, is detected."""
    parts = blocks(*contents)
    whole = encoded_head("counter", 3, 5, parts) + b"".join(contents)
    at = data.draw(st.integers(0, len(whole) - 1))
    other = data.draw(st.integers(1, 255))
    with pytest.raises(Damaged):
        decoded(whole[:at])
    with pytest.raises(Damaged):
        decoded(whole[:at] + bytes([whole[at] ^ other]) + whole[at + 1 :])


@given(garbage=st.binary(max_size=300))
def test_a_file_that_is_no_snapshot_is_refused(garbage):
    with pytest.raises(Damaged):
        decoded(garbage)


@pytest.mark.parametrize(
    ("instance", "sequence"), [(2**64 - 1, 1), (7, 2**64 - 1), (MOST_CYCLES, 0), (0, MOST_CYCLES)]
)
def test_a_number_that_would_overflow_is_refused(instance, sequence):
    """The node would continue to count from there."""
    parts = blocks(b"state")
    with pytest.raises(Damaged, match="no instance has such a number"):
        decoded(encoded_head("counter", instance, sequence, parts) + b"state")


@pytest.mark.parametrize("size", [2**64 - 1, 2**63, 2**31])
def test_a_block_of_an_absurd_size_is_refused_without_memory_for_it(size):
    class Claimed(bytes):
        def __len__(self) -> int:
            return min(size, 2**63 - 1)

    head = encoded_head("counter", 7, 1, [Block(Claimed(), 0)])
    with pytest.raises(Damaged, match="larger than a state can be"):
        decoded(head)


def test_a_replica_of_another_process_or_age_replaces_nothing(tmp_path):
    """A sender must not bring a state under a name or number that its parts did not have."""
    write(tmp_path, 5, b"mine")
    data = encoded_head("other", 2**40, 9, blocks(b"forged")) + b"forged"
    for process, age in (("counter", (2**40, 9)), ("other", (7, 9))):
        copy = CopyWriter(tmp_path)
        copy.append(data)
        with pytest.raises(Damaged, match="it is a state of other#"):
            copy.check(process, age)
        copy.abandon()
    assert newest(tmp_path, up_to=2**41) == ((7, 5), (b"mine",))
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(reader.SLOTS)


def test_the_newest_counts(tmp_path):
    """The newest is by instance first, then by sequence; the slots are used in turn."""
    for sequence in (1, 2, 3):
        write(tmp_path, sequence, b"a%d" % sequence)
    assert newest(tmp_path) == ((7, 3), (b"a3",))
    write(tmp_path, 1, b"b", instance=8)
    assert newest(tmp_path) == ((8, 1), (b"b",))
    assert newest(tmp_path, up_to=7) == ((7, 3), (b"a3",))


def test_a_newer_instance_is_never_overwritten(tmp_path):
    """The write of an old instance that still runs returns False and changes nothing."""
    old = SlotWriter(tmp_path, "counter", 7)
    assert old.write(1, blocks(b"old"))
    write(tmp_path, 10, b"new", instance=8)
    write(tmp_path, 11, b"new", instance=8)
    assert not old.write(2, blocks(b"old"))
    old.close()
    assert newest(tmp_path) == ((8, 11), (b"new",))


class Killed(BaseException):
    """Stand for the death of the process."""


@settings(deadline=None, max_examples=200)
@given(st.lists(st.integers(0, 3000), min_size=2, max_size=6), st.integers(0, 12_000))
def test_killed_at_any_byte_a_whole_state_is_left(tmp_path_factory, sizes, bytes_left):
    """The snapshot is that of the last complete write, or the one being written."""
    directory = tmp_path_factory.mktemp("k")
    left = bytes_left
    real = os.pwritev

    def pwritev(file, buffers, at):
        nonlocal left
        data = b"".join(buffers)[:left]
        left -= len(data)
        if data:
            real(file, [data], at)
        if left == 0:
            raise Killed
        return len(data)

    done = 0
    with pytest.MonkeyPatch.context() as patch, contextlib.suppress(Killed):
        patch.setattr(os, "pwritev", pwritev)
        for number, size in enumerate(sizes, start=1):
            write(directory, number, bytes([number]) * size, b"x")
            done = number
    found = newest(directory)
    if found is None:
        assert done == 0
    else:
        (_, sequence), (first, second) = found
        assert sequence in (done, done + 1)
        assert (first, second) == (bytes([sequence]) * sizes[sequence - 1], b"x")
        write(directory, 100, b"next")  # the next start continues from that snapshot
        assert newest(directory) == ((7, 100), (b"next",))


def test_a_damaged_newest_leaves_the_older_one_and_is_named(tmp_path):
    """The next write replaces the damaged snapshot, not the last whole one."""
    write(tmp_path, 1, b"first")
    write(tmp_path, 2, b"second")
    damaged = tmp_path / reader.SLOTS[1]
    content = damaged.read_bytes()
    damaged.write_bytes(content[:-1] + b"?")
    found, faults = reader.newest(tmp_path, 99)
    assert found is not None
    assert found.head.sequence == 1
    assert len(faults) == 1
    assert str(damaged) in faults[0]
    write(tmp_path, 3, b"third")
    assert reader.read(tmp_path / reader.SLOTS[0]).head.sequence == 1


def test_a_full_disk_leaves_the_newest_state(tmp_path, monkeypatch):
    """The writer gets an OSError; the old snapshot stays, and later writes succeed again."""
    writer = SlotWriter(tmp_path, "counter", 7)
    writer.write(1, blocks(b"first"))
    real = os.pwritev

    def full(file, buffers, at):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "pwritev", full)
    with pytest.raises(OSError, match="No space"):
        writer.write(2, blocks(b"second"))
    assert newest(tmp_path) == ((7, 1), (b"first",))
    monkeypatch.setattr(os, "pwritev", real)
    assert writer.write(3, blocks(b"third"))
    writer.close()
    assert newest(tmp_path) == ((7, 3), (b"third",))


def test_files_are_the_owners_alone_and_do_not_stay_large(tmp_path):
    """This holds under any umask; a snapshot that has become small frees its room."""
    directory = tmp_path / "counter"
    old = os.umask(0)
    try:
        for sequence in range(4):
            write(directory, sequence, bytes(1_000_000) if sequence < 2 else b"small")
        write_copy(directory, reader.newest_content(directory)[1])
    finally:
        os.umask(old)
    assert stat.S_IMODE(directory.stat().st_mode) == 0o700
    for path in directory.iterdir():
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        assert path.stat().st_size < 1000


def test_a_copy_from_another_host_counts_like_a_state_of_ones_own(tmp_path):
    """The replica counts until a newer instance has written a snapshot."""
    there, here = tmp_path / "there", tmp_path / "here"
    write(there, 5, b"state")
    found = reader.newest_content(there)
    assert found is not None
    write_copy(here, found[1])
    assert newest(here) == ((7, 5), (b"state",))
    write(here, 1, b"mine", instance=9)
    assert newest(here) == ((9, 1), (b"mine",))


def test_dropped_are_the_states_of_older_instances_alone(tmp_path):
    """Snapshots of newer instances stay; an empty directory is removed."""
    directory = tmp_path / "counter"
    write(directory, 5, b"old")
    write(directory, 1, b"new", instance=9)
    assert not drop_snapshots(directory, 8)
    assert newest(directory) == ((9, 1), (b"new",))
    assert drop_snapshots(directory, 9)
    assert not directory.exists()


def test_a_writer_whose_files_were_deleted_writes_new_ones(tmp_path):
    """The snapshot of a former instance may be dropped while the new one runs."""
    directory = tmp_path / "counter"
    write(directory, 5, b"old", instance=7)
    writer = SlotWriter(directory, "counter", 9)
    assert drop_snapshots(directory, 8)
    assert writer.write(1, blocks(b"new"))
    assert newest(directory) == ((9, 1), (b"new",))
    assert writer.write(2, blocks(b"newer"))
    drop_snapshots(directory, 8)
    assert writer.write(3, blocks(b"newest"))
    writer.close()
    assert newest(directory) == ((9, 3), (b"newest",))


def test_links_are_not_followed(tmp_path):
    """Write access to the directory must not allow writes to another file."""
    victim = tmp_path / "victim"
    victim.write_bytes(b"precious")
    directory = tmp_path / "counter"
    directory.mkdir()
    (directory / reader.SLOTS[0]).symlink_to(victim)
    with pytest.raises(OSError, match="symbolic"):
        write(directory, 1, b"state")
    assert victim.read_bytes() == b"precious"


def test_a_file_that_cannot_be_read_is_not_dropped(tmp_path) -> None:
    """It may be of a later instance."""
    (tmp_path / "state.0").mkdir()  # reading it fails as with a disk that fails
    (tmp_path / "state.1").write_bytes(b"damaged")
    with pytest.raises(OSError, match="directory"):
        drop_snapshots(tmp_path, 7)
    assert (tmp_path / "state.0").exists()


# --- after a loss of power --------------------------------------------------------------------


def test_a_new_header_without_its_content_hides_no_complete_snapshot(tmp_path):
    """A replica that is older than the torn slot counts again, too."""
    for sequence in (1, 2):
        write(tmp_path, sequence, b"content %d" % sequence)
    older, newer = sorted(tmp_path.iterdir(), key=lambda path: reader.head_of(path).age)
    newer.write_bytes(newer.read_bytes().replace(b"content", b"former "))
    assert drop_torn(tmp_path) == [newer]
    assert drop_torn(tmp_path) == []
    assert reader.newest_head(tmp_path).age == newest(tmp_path)[0] == (7, 1)
    older.write_bytes(older.read_bytes()[:-1])
    assert drop_torn(tmp_path) == [older]
    assert reader.newest_head(tmp_path) is None


def test_a_slot_that_is_being_written_is_not_torn(tmp_path, monkeypatch):
    write(tmp_path, 1, b"old")
    (slot,) = (path for path in tmp_path.iterdir() if path.stat().st_size)

    def written_meanwhile(path):
        os.utime(path, ns=(0, path.stat().st_mtime_ns + 1))
        raise Damaged("half of it is new")

    monkeypatch.setattr("rosrm.snapshots.writer.content_of", written_meanwhile)
    assert drop_torn(tmp_path) == []
    assert slot.exists()


def test_a_replica_is_on_the_disk_before_it_replaces_the_earlier_one(tmp_path, monkeypatch):
    done = []
    monkeypatch.setattr(durable, "sync", lambda _: done.append("synced"))
    monkeypatch.setattr(Path, "replace", lambda *_: done.append("replaced"))
    write_copy(tmp_path, encoded_head("counter", 7, 1, blocks(b"x")) + b"x")
    assert done == ["synced", "replaced"]
