"""Model of what a disk holds after a loss of power."""

import random

import pytest

from benchmarks.crash.disk import Disk, FileSystem
from benchmarks.crash.recording import Call


def calls(*lines):
    """Return calls: `O 1 a`, `W 1 0 text`, `F 1`, `R a b`, `U a`, `M 1 a`."""
    for line in lines:
        kind, *words = line.split()
        if kind in "OM":
            yield Call(kind, 0, int(words[0]), 0, words[1], b"")
        elif kind == "W":
            yield Call(kind, 0, int(words[0]), int(words[1]), "", words[2].encode())
        elif kind == "F":
            yield Call(kind, 0, int(words[0]), 0, "", b"")
        else:
            yield Call(kind, 0, 0, 0, words[0], (words[1:] or [""])[0].encode())


def states(kind, *lines):
    """Return the different states after some calls, each as a tuple of its files."""
    disk = Disk(kind, {})
    for call in calls(*lines):
        disk.apply(call)
    found = disk.states(random.Random(1), 500)
    return {tuple(sorted(state.entries.items())) for state in found}


@pytest.fixture(params=FileSystem, ids=lambda kind: kind.value)
def kind(request):
    return request.param


def test_a_new_file_may_be_missing_or_have_a_part_of_its_content(kind):
    found = states(kind, "O 1 a", "W 1 0 text")
    assert {(), (("a", b""),), (("a", b"te"),), (("a", b"text"),)} == found


def test_what_was_synced_is_there(kind):
    assert states(kind, "O 1 a", "W 1 0 text", "F 1") == {(("a", b"text"),)}


def test_an_append_may_be_missing_or_zeros(kind):
    found = states(kind, "O 1 a", "W 1 0 ab", "F 1", "W 1 2 cd")
    assert found == {(("a", content),) for content in (b"ab", b"abc", b"abcd", b"ab\0\0")}


def test_a_rename_without_a_sync_keeps_the_old_or_the_new_name(kind):
    """The new content is there with ext4 only, because the rename replaces a file."""
    found = states(kind, "O 1 a", "W 1 0 old", "F 1", "O 2 n", "W 2 0 new", "R n a")
    named = {dict(files)["a"] for files in found if "n" not in dict(files)}
    assert b"old" in named
    assert b"new" in named
    assert (b"" in named) == (kind is FileSystem.XFS)


def test_a_sync_of_another_file_forces_earlier_names(kind):
    """XFS writes its log up to the last change of that file, ext4 all of it."""
    found = states(kind, "O 1 a", "F 1", "O 2 b", "U a", "F 2")
    gone = {"a" not in dict(files) for files in found}
    assert gone == ({True} if kind is FileSystem.EXT4 else {True, False})


def test_a_sync_of_a_directory_forces_its_names(kind):
    found = states(kind, "M 9 d", "O 1 d/a", "F 1", "R d/a d/b", "F 9")
    assert found == {(("d", None), ("d/b", b""))}


def test_a_renamed_directory_takes_its_files(kind):
    found = states(kind, "M 9 d", "O 1 d/a", "W 1 0 x", "F 1", "F 9", "R d e")
    assert found == {(("d", None), ("d/a", b"x")), (("e", None), ("e/a", b"x"))}
