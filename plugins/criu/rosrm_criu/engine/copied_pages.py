"""Removal of those pages from a dump that are equal in a `MemoryCopy`, which was sent before.

CRIU's images may have a parent: an image of the same processes in the folder `parent`. A page that
is marked as in the parent is restored from there. Here the parent is the copy, and pages are equal
if all their bytes are, so the kernel need not track written pages.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import struct
from bisect import bisect_right
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rosrm.errors import CriuError
from rosrm_criu.engine import protobuf
from rosrm_criu.engine.image import GRANDPARENT, PAGES, PARENT
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
#: pages are in the file of pages), PE_LAZY (they may be restored on their first use).
_IN_PARENT, _PRESENT, _LAZY = 1, 4, 2
#: Most pages that are compared or written between two calls of `check`.
_AT_ONCE: Final = 16384
#: A dump with fewer equal pages than one of so many stays whole, because it is sent sooner so.
_LEAST_EQUAL: Final = 8
_NEW: Final = ".new"
#: Name of a file with copied pages.
_COPY: Final = re.compile(r"pages-\d+\.img", re.ASCII)

#: Field numbers of a pagemap_entry. The number of pages is in a field of 32 or of 64 bits.
_ADDRESS, _COUNT_32, _FLAGS, _COUNT = 1, 2, 4, 5


class Entry(NamedTuple):
    """Range of pages of an image, with the flags of CRIU.

    Attributes:
        page_range: the addresses of the pages.
        flags: see `_IN_PARENT`.
    """

    page_range: PageRange
    flags: int


@dataclass(frozen=True)
class Pagemap:
    """File `pagemap-PID.img`: the pages of one process.

    Attributes:
        magic: the first bytes of the file.
        file: number of the file with the pages.
        entries: the pages in the order of that file, by ascending address.
    """

    magic: bytes
    file: int
    entries: Sequence[Entry]

    @classmethod
    def decoded(cls, data: bytes) -> Pagemap:
        """Return the content of a file; raise ValueError if a part of it is unknown."""
        head, *others = protobuf.messages(data)
        file = _numbers(head, {1})[1]
        return cls(data[: protobuf.MAGIC], file, [_entry(message) for message in others])

    def encoded(self) -> bytes:
        """Return the content of the file."""
        messages = [
            protobuf.encoded_number(1, self.file),
            *(
                protobuf.encoded_number(_ADDRESS, pages.begin)
                + protobuf.encoded_number(_COUNT_32, 0)
                + protobuf.encoded_number(_FLAGS, flags)
                + protobuf.encoded_number(_COUNT, pages.pages)
                for pages, flags in self.entries
            ),
        ]
        sized = (struct.pack("<I", len(message)) + message for message in messages)
        return self.magic + b"".join(sized)


def _entry(message: bytes) -> Entry:
    values = _numbers(message, {_ADDRESS, _COUNT_32, _FLAGS, _COUNT})
    flags = values[_FLAGS]
    if flags not in (_PRESENT, _PRESENT | _LAZY):
        raise ValueError(f"an entry has the flags {flags}")
    count = values.get(_COUNT) or values[_COUNT_32]
    return Entry(PageRange(values[_ADDRESS], count), flags)


def _numbers(message: bytes, known: Collection[int]) -> dict[int, int]:
    """Return the fields of a message; raise ValueError for an unknown field or a field of bytes."""
    values = {}
    for number, value, _ in protobuf.fields(message):
        if number not in known or isinstance(value, bytes):
            raise ValueError(f"the field {number} is unknown")
        values[number] = value
    return values


def remove_copied_pages(
    directory: Path, copy: MemoryCopy, check: Callable[[], None]
) -> dict[str, int]:
    """Remove the pages from a dump that are equal in a copy, and mark them as in the parent.

    The former files of pages stay in the directory of the copy until that is removed. To free them
    takes a while, and the node is frozen.

    Args:
        directory: of the image.
        copy: of the same processes.
        check: called again and again; may raise an error to end the comparison.

    Returns:
        The bytes of each file that must be in the image before a restore, by path below it.

    Raises:
        ValueError, KeyError: the dump has a form that is unknown here.
        OSError: a file cannot be read or written. After any error the dump is as before.
    """
    images = directory / PAGES
    try:
        sizes: dict[str, int] = {}
        for pid, ranges in copy.ranges.items():
            if ranges and (images / f"pagemap-{pid}.img").exists():
                sizes |= _prepare(directory, copy, pid, check)
    except BaseException:  # any error, also of `check`: the dump must stay as it was
        shutil.rmtree(directory / PARENT, ignore_errors=True)
        for path in images.glob(f"*{_NEW}"):
            path.unlink()
        raise
    for path in images.glob(f"*{_NEW}"):
        path.replace(path.with_suffix(""))
    return sizes


def _prepare(
    directory: Path, copy: MemoryCopy, pid: int, check: Callable[[], None]
) -> dict[str, int]:
    """Write the new files of one process; return the bytes of the files of its copied pages."""
    images, name = directory / PAGES, f"pagemap-{pid}.img"
    pagemap = Pagemap.decoded((images / name).read_bytes())
    pages = f"pages-{pagemap.file}.img"
    dumped, ranges = pages_in(images / pages), [one.page_range for one in pagemap.entries]
    same, layers = np.zeros(len(dumped), np.bool_), list(_layers(copy, pid))
    for _, file, entries in reversed(layers):  # a newer copy of a page replaces the older one
        copied = [one.page_range for one in entries if one.flags == _PRESENT]
        mark_same_pages(same, ranges, copied, dumped, pages_in(file), check)
    if same.sum() * _LEAST_EQUAL < len(same):
        return {}
    entries = list(split_entries(pagemap.entries, same))
    _write(images / f"{name}{_NEW}", [Pagemap(pagemap.magic, pagemap.file, entries).encoded()])
    _write(images / f"{pages}{_NEW}", _changed(entries, dumped, check))
    for folder, _, own in layers:
        (directory / folder).mkdir(mode=0o700, exist_ok=True)
        _write(directory / folder / name, [Pagemap(pagemap.magic, pid, own).encoded()])
    with contextlib.suppress(OSError):  # no hard links here, or a repeated dump of this attempt
        os.link(images / pages, copy.directory / f"dumped-{pages}")
    return {f"{folder}/{file.name}": file.stat().st_size for folder, file, _ in layers}


def _layers(copy: MemoryCopy, pid: int) -> Iterator[tuple[str, Path, list[Entry]]]:
    """Yield the copies of a process, newest first: folder in the image, pages, and entries."""
    whole, folder = [Entry(one, _PRESENT) for one in copy.ranges[pid]], PARENT
    if copy.changed:
        pages = copy.directory / CHANGES / file_name(pid)
        yield folder, pages, list(split_entries(whole, ~copy.changed[pid]))
        folder = GRANDPARENT
    yield folder, copy.directory / file_name(pid), whole


def mark_same_pages(
    same: NDArray[np.bool_],
    dumped: Iterable[PageRange],
    copied: Sequence[PageRange],
    pages: NDArray[np.uint64],
    copy: NDArray[np.uint64],
    check: Callable[[], None],
) -> None:
    """Mark which dumped pages are equal to the copied page of their address, if there is one.

    Args:
        same: marks of the dumped pages.
        dumped: ranges of the dump, in the order of its pages.
        copied: ranges of the copy, in the order of its pages and by ascending address.
        pages: of the dump, one in each row.
        copy: the copied pages, one in each row.
        check: called again and again; may raise an error.

    Raises:
        ValueError: the number of pages is not that of the ranges.
    """
    begins = [one.begin for one in copied]
    rows = [0, *accumulate(one.pages for one in copied)]
    row = 0
    for one in dumped:
        at = max(bisect_right(begins, one.begin) - 1, 0)
        while at < len(copied) and copied[at].begin < one.end:
            low, high = max(one.begin, copied[at].begin), min(one.end, copied[at].end)
            there = rows[at] + (low - copied[at].begin) // PAGE
            begin, end = row + (low - one.begin) // PAGE, row + (high - one.begin) // PAGE
            for here in range(begin, end, _AT_ONCE):
                check()
                after = min(here + _AT_ONCE, end)
                part = copy[there + here - begin : there + after - begin]
                same[here:after] = equal_pages(pages[here:after], part)
            at += 1
        row += one.pages
    if (row, rows[-1]) != (len(pages), len(copy)):
        raise ValueError("the files have another number of pages than their ranges")


def split_entries(entries: Iterable[Entry], same: NDArray[np.bool_]) -> Iterator[Entry]:
    """Yield the entries of a dump, split into pages that are in the parent and others."""
    row = 0
    for (begin, pages), flags in entries:
        marks = same[row : row + pages]
        edges = [0, *(np.flatnonzero(np.diff(marks)) + 1).tolist(), pages]
        for first, after in pairwise(edges):
            if first < after:
                part = PageRange(begin + first * PAGE, after - first)
                yield Entry(part, _IN_PARENT if marks[first] else flags)
        row += pages


def _changed(
    entries: Iterable[Entry], pages: NDArray[np.uint64], check: Callable[[], None]
) -> Iterator[memoryview]:
    """Yield the pages that are not in the parent."""
    row = 0
    for one, flags in entries:
        after = row + one.pages
        for begin in range(row, after if flags != _IN_PARENT else row, _AT_ONCE):
            check()
            yield pages[begin : min(begin + _AT_ONCE, after)].data
        row = after


def _write(path: Path, pieces: Iterable[bytes | memoryview]) -> None:
    path.touch(mode=0o600, exist_ok=False)
    with path.open("wb") as file:
        for piece in pieces:
            file.write(piece)


def move_into_parent(directory: Path, copies: Path) -> None:
    """Move received copies into the parent of a received image, if it has one; raise OSError.

    The copies of processes without pages in the parent stay: small ones, and those that have ended.
    """
    sources = [copies / CHANGES, copies] if (directory / GRANDPARENT).is_dir() else [copies]
    for source, folder in zip(sources, (PARENT, GRANDPARENT), strict=False):
        for pagemap in (directory / folder).glob("pagemap-*.img"):
            name = pagemap.name.replace("pagemap", "pages")
            (source / name).rename(directory / folder / name)


def check_files(directory: Path) -> None:
    """Raise CriuError if a received directory contains anything but copied pages."""
    for path in directory.iterdir():
        if not (path.is_file() and _COPY.fullmatch(path.name)):
            raise CriuError("the copy contains other files than pages-PID.img: refused")
