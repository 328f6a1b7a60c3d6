"""Comparison of the pages of a dump with a `MemoryCopy`, which becomes the parent of the image.

CRIU's images may have a parent: an image of the same processes in the folder `parent`. A page that
is marked as in the parent is restored from there. All bytes of the pages are compared, so the
kernel need not track written pages.
"""

from __future__ import annotations

import re
import struct
from bisect import bisect_right
from collections.abc import Iterable, Iterator, Sequence
from io import BufferedWriter
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rosrm.errors import CriuError
from rosrm.shortage import is_directory, is_file, names
from rosrm_criu.engine import protobuf
from rosrm_criu.engine.image import GRANDPARENT, PARENT
from rosrm_criu.engine.memory_copy import (
    CHANGES,
    PAGE,
    MemoryCopy,
    PageRange,
    equal_pages,
    file_name,
    pages_in,
)

#: Flags of CRIU's pagemap_entry: PE_PARENT (the pages are in the parent image), PE_PRESENT (the
#: pages are in the file of pages).
IN_PARENT, PRESENT = 1, 4
#: Name of a file with copied pages.
_COPY: Final = re.compile(r"pages-\d+\.img", re.ASCII)

#: First bytes of a pagemap of CRIU.
_MAGIC: Final = struct.pack("<II", 0x54564319, 0x56084025)
#: Field numbers of a pagemap_entry. The number of pages is in a field of 32 or of 64 bits.
_ADDRESS, _COUNT_32, _FLAGS, _COUNT = 1, 2, 4, 5


class Entry(NamedTuple):
    """Range of pages of an image, with the flags of CRIU.

    Attributes:
        page_range: the addresses of the pages.
        flags: see `IN_PARENT` and `PRESENT`.
    """

    page_range: PageRange
    flags: int


def encoded(file: int, entries: Iterable[Entry]) -> bytes:
    """Return the content of a file `pagemap-PID.img`.

    Args:
        file: number of the file with the pages.
        entries: the pages in the order of that file, by ascending address.
    """
    messages = [
        protobuf.encoded_number(1, file),
        *(
            protobuf.encoded_number(_ADDRESS, pages.begin)
            + protobuf.encoded_number(_COUNT_32, 0)
            + protobuf.encoded_number(_FLAGS, flags)
            + protobuf.encoded_number(_COUNT, pages.pages)
            for pages, flags in entries
        ),
    ]
    return _MAGIC + b"".join(struct.pack("<I", len(message)) + message for message in messages)


class CopiedPages:
    """Copied pages of one process, for comparison with those of its dump.

    Args:
        copy: of all processes.
        pid: of the process. Without a copy of it, no page is equal.
    """

    def __init__(self, copy: MemoryCopy, pid: int) -> None:
        self._pid = pid
        self._layers = list(_layers(copy, pid))

    def equal(self, address: int, pages: NDArray[np.uint64]) -> NDArray[np.bool_]:
        """Return the mask of the dumped pages that equal the copied page of their address.

        Args:
            address: of the first page.
            pages: one in each row.
        """
        equal = np.zeros(len(pages), np.bool_)
        for layer in reversed(self._layers):  # a newer copy of a page replaces the older one
            layer.compare(PageRange(address, len(pages)), pages, equal)
        return equal

    def as_parent(self, directory: Path) -> dict[str, int]:
        """Make the copy the parent of an image; return the size of each copied file by path."""
        for layer in self._layers:
            (directory / layer.folder).mkdir(mode=0o700, exist_ok=True)
            with new_file(directory / layer.folder / f"pagemap-{self._pid}.img") as file:
                file.write(encoded(self._pid, layer.entries))
        return {
            f"{layer.folder}/{file_name(self._pid)}": layer.pages.nbytes for layer in self._layers
        }


class _Layer:
    """Copy of the pages of a process, in the form of a parent image.

    Args:
        folder: in the image.
        file: with the pages.
        entries: the pages by ascending address; those that are not in the file are in the parent of
            this image.
    """

    def __init__(self, folder: str, file: Path, entries: Sequence[Entry]) -> None:
        self.folder, self.pages, self.entries = folder, pages_in(file), entries
        self._copied = [one.page_range for one in entries if one.flags == PRESENT]
        self._begins = [one.begin for one in self._copied]
        self._rows = [0, *accumulate(one.pages for one in self._copied)]
        if self._rows[-1] != len(self.pages):
            raise ValueError(f"{file} has another number of pages than its ranges")

    def compare(
        self, dumped: PageRange, pages: NDArray[np.uint64], equal: NDArray[np.bool_]
    ) -> None:
        """Mark each dumped page with a copy here as equal or not; leave the other marks."""
        at = max(bisect_right(self._begins, dumped.begin) - 1, 0)
        while at < len(self._copied) and self._copied[at].begin < dumped.end:
            copied = self._copied[at]
            low, high = max(dumped.begin, copied.begin), min(dumped.end, copied.end)
            if low < high:
                here = slice((low - dumped.begin) // PAGE, (high - dumped.begin) // PAGE)
                there = self._rows[at] + (low - copied.begin) // PAGE
                part = self.pages[there : there + (high - low) // PAGE]
                equal[here] = equal_pages(pages[here], part)
            at += 1


def _layers(copy: MemoryCopy, pid: int) -> Iterator[_Layer]:
    """Yield the copies of a process, newest first."""
    if not copy.ranges.get(pid):
        return
    whole, folder = [Entry(one, PRESENT) for one in copy.ranges[pid]], PARENT
    if copy.changed:
        pages = copy.directory / CHANGES / file_name(pid)
        yield _Layer(folder, pages, list(_split(whole, ~copy.changed[pid])))
        folder = GRANDPARENT
    yield _Layer(folder, copy.directory / file_name(pid), whole)


def _split(entries: Iterable[Entry], same: NDArray[np.bool_]) -> Iterator[Entry]:
    """Split entries like `split_entry`, with one mask for the pages of all."""
    row = 0
    for entry in entries:
        yield from split_entry(entry, same[row : row + entry.page_range.pages])
        row += entry.page_range.pages


def split_entry(entry: Entry, same: NDArray[np.bool_]) -> Iterator[Entry]:
    """Split an entry into ranges of pages that are in the parent, by the mask, and others."""
    (begin, pages), flags = entry
    edges = [0, *(np.flatnonzero(np.diff(same)) + 1).tolist(), pages]
    for first, after in pairwise(edges):
        if first < after:
            part = PageRange(begin + first * PAGE, after - first)
            yield Entry(part, IN_PARENT if same[first] else flags)


def new_file(path: Path) -> BufferedWriter:
    """Return a new file of an image, open for writing; raise OSError if it exists."""
    path.touch(mode=0o600, exist_ok=False)
    return path.open("wb")


def move_into_parent(directory: Path, copies: Path) -> None:
    """Move received copies into the parent of a received image, if it has one; raise OSError.

    The copies of processes without pages in the parent stay: small ones, and those that have ended.
    """
    sources = [copies / CHANGES, copies] if is_directory(directory / GRANDPARENT) else [copies]
    for source, folder in zip(sources, (PARENT, GRANDPARENT), strict=False):
        for pagemap in names(directory / folder):
            if not (pagemap.startswith("pagemap-") and pagemap.endswith(".img")):
                continue
            name = pagemap.replace("pagemap", "pages")
            (source / name).rename(directory / folder / name)


def check_files(directory: Path) -> None:
    """Raise CriuError if a received directory contains anything but copied pages."""
    for path in directory.iterdir():
        if not (is_file(path) and _COPY.fullmatch(path.name)):
            raise CriuError("the copy contains other files than pages-PID.img: refused")
