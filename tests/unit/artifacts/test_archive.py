"""Archives of artifacts: digests, what they may contain, and unpacking of what is not trusted."""

from __future__ import annotations

import io
import os
import socket
import tarfile
import tracemalloc

import pytest

from rosrm.artifacts.pack import Archive
from rosrm.artifacts.unpack import is_intact, remove, unpack
from rosrm.errors import ConfigError, Refused, TransferError


def content_of(archive: Archive, size: int = 1000) -> bytes:
    parts = []
    while (offset := sum(map(len, parts))) < archive.size:
        parts.append(archive.part(offset, size))
    return b"".join(parts)


@pytest.fixture
def saved(tmp_path):
    """Return a function that saves an archive, and returns its file."""

    def save(source) -> object:
        path = tmp_path / "saved.tar"
        path.write_bytes(content_of(Archive(source)))
        return path

    return save


@pytest.fixture
def tar(tmp_path):
    """Return a function that writes entries, which need not be allowed, into a tar file."""

    def write(*entries: tarfile.TarInfo) -> object:
        path = tmp_path / "any.tar"
        with tarfile.open(path, "w") as file:
            for entry in entries:
                file.addfile(entry, io.BytesIO(bytes(entry.size)))
        return path

    return write


def entry(name: str, kind: bytes = tarfile.REGTYPE, **fields) -> tarfile.TarInfo:
    made = tarfile.TarInfo(name)
    made.type = kind
    for field, value in fields.items():
        setattr(made, field, value)
    return made


def test_the_digest_depends_on_names_contents_and_the_right_to_execute_alone(source):
    """Times, owners and caches of Python do not change the digest; all else does."""
    first = Archive(source).digest
    os.utime(source / "run.sh", (1, 1))
    (source / "lib" / "data.bin").chmod(0o600)
    (source / "__pycache__").mkdir()
    (source / "__pycache__" / "run.pyc").write_text("any")
    assert Archive(source).digest == first
    (source / "run.sh").chmod(0o644)
    second = Archive(source).digest
    (source / "run.sh").rename(source / "start.sh")
    third = Archive(source).digest
    (source / "start.sh").write_text("#!/bin/ss\n")
    assert len({first, second, third, Archive(source).digest}) == 4


def test_a_directory_arrives_as_it_was(source, saved, tmp_path):
    """Contents, links and rights to execute are the same, and nothing can be written."""
    unpack(saved(source), tmp_path / "new")
    new = tmp_path / "new" / "content"
    assert (new / "lib" / "newest").read_bytes() == (source / "lib" / "data.bin").read_bytes()
    assert str((new / "lib" / "newest").readlink()) == "data.bin"
    paths = (new, new / "run.sh", new / "lib" / "data.bin")
    modes = [oct(path.stat().st_mode & 0o777) for path in paths]
    assert modes == ["0o555", "0o555", "0o444"]
    remove(tmp_path / "new")
    assert not new.parent.exists()


def test_a_single_file_arrives_even_through_a_link(source, saved, tmp_path):
    """The value of an artifact may be a link; its target is sent."""
    unpack(saved(source / "lib" / "newest"), tmp_path / "new")
    assert (tmp_path / "new" / "content").read_bytes() == (source / "lib/data.bin").read_bytes()


@pytest.mark.parametrize("size", [1, 511, 5000, 10**7])
def test_parts_of_any_size_make_the_archive(source, size):
    """The parts in order are the bytes of which the digest was computed."""
    archive = Archive(source / "run.sh") if size == 1 else Archive(source)
    assert content_of(archive, size) == content_of(archive)


def test_a_part_can_be_read_again(source):
    """A part that was lost, and the whole archive after a restart of the master, are sent again."""
    archive = Archive(source)
    whole = content_of(archive)
    for offset in (70_000, 70_000, 100, 300_000, 0):
        assert archive.part(offset, 10_000) == whole[offset : offset + 10_000]


@pytest.mark.parametrize(
    ("place", "target", "says"),
    [("lib/away", "/etc/passwd", "absolute"), ("lib/away", "../../x", "outside"),
     ("away", "../source-2/x", "outside")],
)  # fmt: skip
def test_a_link_that_leaves_the_directory_is_refused(source, place, target, says):
    """Such a link would name another file on the host."""
    (source / place).symlink_to(target)
    with pytest.raises(ConfigError, match=rf"away: a link .* {says}"):
        Archive(source)


def test_what_is_no_file_is_refused(source, tmp_path):
    """Devices, pipes and sockets have no contents to send."""
    os.mkfifo(source / "pipe")
    with pytest.raises(ConfigError, match="pipe: neither a file, a directory nor a link"):
        Archive(source)
    with socket.socket(socket.AF_UNIX) as one:
        one.bind(str(tmp_path / "s"))
        with pytest.raises(ConfigError, match="neither a file nor a directory"):
            Archive(tmp_path / "s")


def test_a_missing_file_is_named(tmp_path):
    """The message names the path."""
    with pytest.raises(ConfigError, match="none: there is no such file or directory"):
        Archive(tmp_path / "none")


def test_a_file_that_changed_is_not_sent(source):
    """Another size is noticed by the sender, before the digest at the master."""
    archive = Archive(source)
    (source / "lib" / "data.bin").write_bytes(b"new")
    with pytest.raises(Refused, match=r"data.bin changed while it was sent: run the command again"):
        content_of(archive)


@pytest.mark.parametrize(
    ("entries", "says"),
    [
        ([entry("content/../../x", size=3)], "has '..'"),
        ([entry("/content/x", size=3)], "outside"),
        ([entry("other", size=3)], "outside"),
        ([entry("content", tarfile.CHRTYPE)], "neither a file"),
        ([entry("content", tarfile.SYMTYPE, linkname="x")], "neither a file"),
        ([entry("content", tarfile.DIRTYPE), entry("content/a", tarfile.LNKTYPE, linkname="b")],
         "neither a file"),
        ([entry("content", tarfile.DIRTYPE), entry("content/a", tarfile.SYMTYPE, linkname="/b")],
         "absolute"),
        ([entry("content", tarfile.DIRTYPE), entry("content/a", tarfile.SYMTYPE, linkname="../b")],
         "outside"),
        ([entry("content/a", size=3)], "no sound archive"),
        ([entry("content", size=3), entry("content", size=3)], "no sound archive"),
    ],
)  # fmt: skip
def test_an_archive_with_a_forbidden_entry_is_refused(entries, says, tar, tmp_path):
    """Nothing is written outside of the directory."""
    with pytest.raises(TransferError, match=says):
        unpack(tar(*entries), tmp_path / "new")
    outside = {path.name for path in tmp_path.iterdir()}
    assert outside == {"any.tar", "new"}


def test_a_sparse_file_is_refused(tar, tmp_path):
    """A short archive could fill the disk."""
    path = tar(entry("content", size=3))
    header = entry("content", tarfile.GNUTYPE_SPARSE).tobuf(tarfile.GNU_FORMAT)
    path.write_bytes(header + bytes(2048))
    with pytest.raises(TransferError, match="neither a file"):
        unpack(path, tmp_path / "new")


def test_links_that_lead_out_together_are_refused(tar, tmp_path):
    """Each of both links alone seems to stay inside."""
    entries = [
        *(entry(name, tarfile.DIRTYPE) for name in ("content", "content/p", "content/p/q")),
        entry("content/p/q/up", tarfile.SYMTYPE, linkname="../.."),
        entry("content/p/q/out", tarfile.SYMTYPE, linkname="up/.."),
    ]
    with pytest.raises(TransferError, match="leads out"):
        unpack(tar(*entries), tmp_path / "new")


def test_a_file_that_is_no_archive_is_refused(tmp_path):
    """Also one that is cut short."""
    (tmp_path / "any").write_bytes(b"x" * 5000)
    with pytest.raises(TransferError, match="no sound archive"):
        unpack(tmp_path / "any", tmp_path / "new")


def test_a_change_of_unpacked_contents_is_noticed(source, saved, tmp_path):
    """A process can make a file writable, and change it."""
    unpack(saved(source), tmp_path / "new")
    assert is_intact(tmp_path / "new")
    data = tmp_path / "new" / "content" / "lib" / "data.bin"
    data.chmod(0o644)
    data.write_bytes(b"other")
    data.chmod(0o444)
    assert not is_intact(tmp_path / "new")


LARGE = 100 * 2**20


def peak_of_unpacking(path, directory) -> int:
    """Return the most bytes that unpacking an archive takes, which is refused."""
    tracemalloc.start()
    try:
        with pytest.raises(TransferError):
            unpack(path, directory)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    "kind",
    [
        tarfile.XHDTYPE, tarfile.XGLTYPE, tarfile.SOLARIS_XHDTYPE, tarfile.GNUTYPE_LONGNAME,
        tarfile.GNUTYPE_LONGLINK,
    ],
)  # fmt: skip
def test_a_long_header_is_refused_before_it_is_read(tmp_path, kind):
    """A header of hundreds of megabytes would stay in the memory of each slave."""
    path = tmp_path / "any.tar"
    path.write_bytes(entry("content", kind, size=LARGE).tobuf(tarfile.GNU_FORMAT))
    os.truncate(path, LARGE + 2048)
    assert peak_of_unpacking(path, tmp_path / "new") < 2**20


@pytest.mark.parametrize("version", ["1.0", "0.1", "0.0"])
def test_the_map_of_a_sparse_file_is_not_read(tmp_path, version):
    """The map of a sparse file may be as long as the archive, so it is not read."""
    major, minor = version.split(".")
    records = {"GNU.sparse.major": major, "GNU.sparse.minor": minor, "GNU.sparse.name": "content"}
    if version == "0.1":
        records = {"GNU.sparse.map": "0,1", "GNU.sparse.size": "1"}
    if version == "0.0":
        records = {"GNU.sparse.size": "1", "GNU.sparse.numblocks": "1"}
    made = entry("content", size=LARGE, pax_headers=records)
    path = tmp_path / "any.tar"
    path.write_bytes(made.tobuf(tarfile.PAX_FORMAT) + b"99999999\n" + b"1\n" * 1000)
    os.truncate(path, LARGE + 2048)
    assert peak_of_unpacking(path, tmp_path / "new") < 2**20


def test_the_blocks_of_an_old_sparse_header_are_not_read(tmp_path):
    """A chain of header blocks, each of which announces another one, is refused."""
    header = bytearray(entry("content", tarfile.GNUTYPE_SPARSE).tobuf(tarfile.GNU_FORMAT))
    header[482] = 1
    header[148:156] = b"%06o\0 " % (256 + sum(header[:148]) + sum(header[156:512]))
    block = bytearray(512)
    block[504] = 1
    path = tmp_path / "any.tar"
    path.write_bytes(bytes(header) + bytes(block) * 20_000)
    assert peak_of_unpacking(path, tmp_path / "new") < 2**20


def test_many_entries_with_long_headers_take_little_memory(tmp_path):
    """Entries are not kept once they are unpacked."""
    path = tmp_path / "any.tar"
    with tarfile.open(path, "w", format=tarfile.PAX_FORMAT) as file:
        for number in range(2000):
            made = entry(f"content/{number}", pax_headers={"comment": "x" * 15_000})
            file.addfile(made if number else entry("content", tarfile.DIRTYPE), io.BytesIO())
        file.addfile(entry("other"), io.BytesIO())
    assert peak_of_unpacking(path, tmp_path / "new") < 3 * 2**20


def test_headers_that_only_announce_headers_are_refused(tmp_path):
    """A chain of headers that announce headers could be as long as the archive."""
    header = entry("content", tarfile.GNUTYPE_LONGNAME, size=1).tobuf(tarfile.GNU_FORMAT)
    path = tmp_path / "any.tar"
    path.write_bytes((header[:512] + b"x".ljust(512, b"\0")) * 20_000)
    assert peak_of_unpacking(path, tmp_path / "new") < 20 * 2**20
