"""Damaged log archives: each file is read, left out or refused."""

from __future__ import annotations

import contextlib
import gzip
from pathlib import Path
from tempfile import TemporaryDirectory

import hypothesis.strategies as st
from hypothesis import example, given, settings

from rosrm.archive.reader import LogArchive
from rosrm.archive.retention import ArchiveLimits
from rosrm.archive.writer import ArchiveWriter
from rosrm.errors import Refused
from rosrm.model.rows import LogPart

NAMES = st.sampled_from([
    "p.1.0.0.log", "p.1.0.0.log.times", "p.1.0.0-9.log.gz", "p.1.0.0-9.times.gz",
    "p.1.1.9-3.log.gz", "p.1.0.5-9.log.gz", "p.1.0.18446744073709551615.log",
    "p.1.0.0.log.new", "p.log", "p.1.0.0-.log.gz",
])  # fmt: skip
CONTENT = st.binary(max_size=200).flatmap(lambda text: st.sampled_from([text, gzip.compress(text)]))


@given(
    files=st.dictionaries(NAMES, CONTENT, max_size=6), tail=st.integers(0, 3),
    since=st.sampled_from([0.0, 1.0, 4e9]), offset=st.integers(0, 300),
)  # fmt: skip
@example({"p.1.0.0-9.log.gz": gzip.compress(b"x" * 9)[:-4]}, 0, 0.0, 0)
@example({"p.1.0.0.log": b"\0", "p.1.1.9-3.log.gz": b""}, 0, 0.0, 0)  # an open one is not the last
@settings(max_examples=200, deadline=None)
def test_a_damaged_archive_is_read_or_refused(files, tail, since, offset):
    """The next collector can also continue with the archive."""
    with TemporaryDirectory() as folder:
        directory = Path(folder)
        here = directory / "hosts" / "alpha"
        here.mkdir(parents=True)
        for name, content in files.items():
            (here / name).write_bytes(content)
        with contextlib.suppress(Refused):
            part = LogArchive(directory).read_log("alpha", "p", 1, offset, tail=tail, since=since)
            assert part.next_offset == part.offset + len(part.content)
        writer = ArchiveWriter(directory, ArchiveLimits(1 << 30, 1 << 30))
        for source in [*writer._segments]:
            end = writer.position(source)
            writer.newest_content(source)
            writer.add(source, LogPart(source.number, (), b"more\n", end, end + 5, True, ()))
            assert writer.position(source) == end + 5
