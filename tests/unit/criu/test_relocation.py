"""Changes of paths in CRIU's images, and of nothing else."""

from __future__ import annotations

import errno
import os
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosrm.errors import CriuError
from rosrm_criu.engine import relocation


def varint(number: int) -> bytes:
    out = bytearray()
    while number >= 0x80:
        out.append(number & 0x7F | 0x80)
        number >>= 7
    return bytes(out) + bytes([number])


def field(number: int, value: int | bytes) -> bytes:
    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    return varint(number << 3 | 2) + varint(len(value)) + value


def image_of(*paths: str, rest: bytes = b"") -> bytes:
    """Return a files.img like CRIU's; `rest` is a message of another kind of file."""
    regular = field(1, 7) + field(2, 1 << 40) + field(5, field(1, 3))
    messages = [
        field(1, 1) + field(2, 7) + field(3, regular + field(6, path.encode())) for path in paths
    ]
    messages.append(field(1, 4) + field(9, rest))
    return b"magicnum" + b"".join(struct.pack("<I", len(one)) + one for one in messages)


def test_only_paths_at_and_below_the_directory_are_changed(tmp_path):
    """A path that only begins with the same letters, and text of other files, stay unchanged."""
    images = tmp_path / "criu"
    images.mkdir()
    before = image_of("/a/work", "/a/work/x", "/a/working", "/b", rest=b"/a/work")
    (images / "files.img").write_bytes(before)
    (images / "core-1.img").write_bytes(b"/a/work")
    long = "/" + "long" * 100
    with relocation.images(images, "/a/work", long) as changed:
        wanted = image_of(long, f"{long}/x", "/a/working", "/b", rest=b"/a/work")
        assert (changed / "files.img").read_bytes() == wanted
        assert (changed / "core-1.img").read_bytes() == b"/a/work"
        assert changed.stat().st_mode & 0o777 == 0o700
    assert (images / "files.img").read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["criu"]


@pytest.mark.parametrize(("old", "new"), [("", "/new"), ("/old", ""), ("/same", "/same")])
def test_what_is_the_same_here_is_left_alone(tmp_path, old, new):
    """Equal or unknown directories need no copy of the image."""
    with relocation.images(tmp_path, old, new) as changed:
        assert changed == tmp_path


@pytest.mark.parametrize(
    "data", [b"magicnum\x05", b"magicnum\x02\0\0\0\x1a\xff", b"magicnum\1\0\0\0\7"]
)
def test_an_image_that_is_none_is_refused(tmp_path, data):
    """A truncated image, or one of another format, is refused as damaged."""
    images = tmp_path / "criu"
    images.mkdir()
    (images / "files.img").write_bytes(data)
    with (
        pytest.raises(CriuError, match=r"files\.img is damaged"),
        relocation.images(images, "/a", "/b"),
    ):
        pass


@given(st.lists(st.sampled_from(["a", "b", "work"]), max_size=4))
def test_moved_there_and_back_is_the_same(names):
    """A path survives a change to another directory and back, as in a chain of migrations."""
    path = "/home/work/" + "/".join(names)
    there = relocation.moved(path, "/home/work", "/other/place")
    assert there.startswith("/other/place")
    assert relocation.moved(there, "/other/place", "/home/work") == path


def test_paths_are_changed_on_a_file_system_without_hard_links(tmp_path, monkeypatch):
    """The other files of the image are copied then."""
    images = tmp_path / "criu"
    images.mkdir()
    (images / "files.img").write_bytes(b"magicnum")
    (images / "pages-1.img").write_bytes(b"memory")

    def refuse(*_: object) -> None:
        raise PermissionError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "link", refuse)
    with relocation.images(images, "/old", "/new") as changed:
        assert (changed / "pages-1.img").read_bytes() == b"memory"
