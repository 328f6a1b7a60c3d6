"""Checksums in the manifest of an image, of each file and of the manifest itself."""

from __future__ import annotations

import json
import os
import tempfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosrm.errors import CriuError
from rosrm_criu.engine import image
from rosrm_criu.engine.image import HeldFile, Manifest, MappedFile

#: A large file of memory pages, a small file of CRIU, and a file that follows the process.
FILES: Mapping[str, bytes] = {
    "criu/pages-1.img": bytes(range(256)) * 16, "criu/pstree.img": b"magicnum\x0c\0\0\0\x08\x01",
    "files/0": b"1\n2\n3\n",
}  # fmt: skip

MANIFEST = Manifest(
    "brain", 3, "robot", 1700000000.25, "4.2.1", "6.18.0", "x86_64", 4711, (4711, 4712),
    ("/a/\udc80.log",), "/a", "", "/usr/bin/python3",
    (HeldFile("/a/count", 6, 0o644, False, "files/0"),), (MappedFile("/lib/c.so", 9, 0o755),),
)  # fmt: skip


@contextmanager
def written(
    files: Mapping[str, bytes] = FILES, manifest: Manifest = MANIFEST, *, checksums: bool = True
) -> Iterator[Path]:
    """Yield the directory of a complete image."""
    with tempfile.TemporaryDirectory() as folder:
        directory = Path(folder, "image")
        image.create(directory)
        (directory / image.COPIES).mkdir(mode=0o700)
        for name, content in files.items():
            (directory / name).write_bytes(content)
        made = image.file_checksums(directory, files) if checksums else {}
        sizes = image.file_sizes(directory)
        image.write(directory, replace(manifest, sizes=sizes, checksums=made))
        yield directory


def checked(directory: Path) -> Manifest:
    """Check an image like the shim does before it runs CRIU."""
    manifest = image.read(directory)
    image.check_contents(directory, manifest)
    return manifest


@given(
    st.text(min_size=1), st.floats(0, 1e12), st.lists(st.integers(1, 1 << 22)),
    st.lists(st.text(min_size=1)),
)  # fmt: skip
def test_a_manifest_is_read_as_it_was_written(process, made_at, ids, logs):
    """A manifest with any names and numbers is read back equal, and its checksum matches."""
    told = replace(MANIFEST, process=process, made_at=made_at, ids=tuple(ids), logs=tuple(logs))
    with written({}, told) as directory:
        assert checked(directory) == told


def test_a_whole_image_passes():
    """An intact image passes, with the size and CRC-32 of each file."""
    with written() as directory:
        manifest = checked(directory)
        assert manifest.checksums == {name: zlib.crc32(data) for name, data in FILES.items()}
        assert manifest.sizes == {name: len(data) for name, data in FILES.items()}


def test_a_file_of_many_pieces_has_the_checksum_of_the_whole(monkeypatch):
    """A file that is read in several pieces, the last one shorter, has the whole's checksum."""
    monkeypatch.setattr(image, "_PIECE", 100)
    with written() as directory:
        assert checked(directory).checksums["criu/pages-1.img"] == zlib.crc32(
            FILES["criu/pages-1.img"]
        )


@given(st.data(), st.sampled_from(sorted(FILES)), st.integers(0, 7))
def test_any_flipped_bit_of_a_file_is_named(data, name, bit):
    """A change that keeps the size is found by checksum; the error names file and remedy."""
    position = data.draw(st.integers(0, len(FILES[name]) - 1))
    with written() as directory:
        changed = bytearray(FILES[name])
        changed[position] ^= 1 << bit
        (directory / name).write_bytes(changed)
        wanted = f"{directory} is damaged: {name} has changed .* `rosrm restart brain`"
        with pytest.raises(CriuError, match=wanted):
            checked(directory)


def test_a_file_that_has_gone_since_is_named():
    """A file that vanishes between the size check and the checksum is named in the error."""
    with written() as directory:
        manifest = image.read(directory)
        (directory / "criu/pstree.img").unlink()
        with pytest.raises(CriuError, match=r"damaged: criu/pstree\.img: No such file"):
            image.check_contents(directory, manifest)


def test_a_wrong_size_says_what_to_do():
    """A wrong size gives the same advice as a wrong checksum."""
    with written() as directory:
        (directory / "files/0").write_bytes(b"1\n")
        with pytest.raises(CriuError, match=r"2 bytes instead of 6.* `rosrm restart brain`"):
            checked(directory)


@given(st.data(), st.integers(1, 255))
def test_a_changed_byte_of_the_manifest_changes_nothing_or_is_refused(data, difference):
    """A changed manifest is refused, because another path or pid would restore another process."""
    with written() as directory:
        path, before = directory / image.MANIFEST, checked(directory)
        changed = bytearray(path.read_bytes())
        changed[data.draw(st.integers(0, len(changed) - 1))] ^= difference
        path.write_bytes(changed)
        with suppress(CriuError):
            assert checked(directory) == before


def test_without_checksums_sizes_alone_are_looked_at():
    """An image of a migration has no checksums, because the transfer has one; sizes are checked."""
    with written(checksums=False) as directory:
        assert checked(directory).checksums == {}
        (directory / "criu/pstree.img").unlink()
        with pytest.raises(CriuError, match=r"pstree\.img: No such file or directory$"):
            checked(directory)


def as_before(directory: Path, **values: object) -> None:
    """Write a manifest of format 1, which had no checksums, with some other values."""
    told: dict[str, Any] = asdict(image.read(directory))
    del told["checksums"]
    (directory / image.MANIFEST).write_text(json.dumps({"format": 1, **told, **values}))


def test_an_old_manifest_is_read():
    """A checkpoint from the time before checksums can be restored."""
    with written() as directory:
        before = checked(directory)
        as_before(directory)
        assert checked(directory) == replace(before, checksums={})


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"format": 3}, "has format 3; this rosrm reads format 2"),
        ({"format": 2}, "damaged: manifest.json: no 'checksum'"),
        ({"format": 2, "checksum": 7}, "damaged: manifest.json: it has changed since"),
        ({"checksum": 7}, "damaged: manifest.json: unknown checksum"),
        ({"pid": "one"}, "damaged: manifest.json: pid: int is required, not 'one'"),
        ({"sizes": {"criu/x": "1"}}, "sizes.criu/x: int is required, not '1'"),
        ({"sizes": {"../secret": 1}}, "'../secret' does not lie in the image"),
    ],
)
def test_a_manifest_of_another_form_is_refused(values, said):
    """An invalid manifest is refused with a message that names the fault."""
    with written() as directory:
        as_before(directory, **values)
        with pytest.raises(CriuError, match=said):
            image.read(directory)


def test_checksums_lie_in_the_image_too():
    """A checksum of a path outside the image is refused, so that no such file is read."""
    with written() as directory:
        image.write(directory, replace(image.read(directory), checksums={"../secret": 1}))
        with pytest.raises(CriuError, match=r"'\.\./secret' does not lie in"):
            image.read(directory)


@pytest.mark.parametrize("name", ["", "manifest.json", "criu", "criu/pstree.img", "files/0"])
def test_what_is_open_to_others_is_refused(name):
    """The memory of a process may hold keys, and another user could have changed it."""
    with written() as directory:
        (directory / name).chmod((directory / name).stat().st_mode | 0o040)
        with pytest.raises(CriuError, match=r"open to others: its mode has to be 0[67]00"):
            image.read(directory)


@pytest.mark.parametrize("name", ["manifest.json", "criu", "criu/pstree.img"])
def test_a_link_in_an_image_is_refused(name, tmp_path):
    with written() as directory:
        path = directory / name
        path.rename(tmp_path / "away")
        path.symlink_to(tmp_path / "away")
        with pytest.raises(CriuError, match="is a link, or belongs to another user"):
            image.read(directory)


def test_an_image_of_another_user_is_refused(monkeypatch):
    with written() as directory:
        monkeypatch.setattr("os.geteuid", lambda: 12345)
        if directory.stat().st_uid == 0:
            os.chown(directory, 54321, -1)
        with pytest.raises(CriuError, match="belongs to another user"):
            image.read(directory)
