"""Removal of pages from a dump that a `MemoryCopy` has too, so that they are not sent again.

CRIU's images may have a parent: an image of the same processes in the folder `parent`. A page that
is marked as in the parent is restored from there. Here the parent is the copy, and pages are equal
if all their bytes are, so the kernel need not track written pages.
"""

from __future__ import annotations

import re
import shutil
import struct
from bisect import bisect_right
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rosrm_criu.engine import protobuf
from rosrm_criu.engine.image import PAGES, PARENT
from rosrm_criu.engine.memory_copy import PAGE, MemoryCopy, Run, file_name

#: Flags of a pagemap_entry: its pages are in the parent; its pages follow in the file of pages.
_IN_PARENT, _PRESENT, _LAZY = 1, 4, 2
#: Pages that are compared at once, so that the results stay in the processor's cache.
_AT_ONCE: Final = 64
_NEW: Final = ".new"
#: Name of a file with copied pages.
_COPY: Final = re.compile(r"pages-\d+\.img", re.ASCII)

#: Fields of a pagemap_entry: the number of pages has one of 32 and one of 64 bits.
_ADDRESS, _COUNT_32, _FLAGS, _COUNT = 1, 2, 4, 5


class Entry(NamedTuple):
    """Adjacent pages of an image, with the flags of CRIU.

    Attributes:
        run: the pages.
        flags: see `_IN_PARENT`.
    """

    run: Run
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
                protobuf.encoded_number(_ADDRESS, run.begin)
                + protobuf.encoded_number(_COUNT_32, 0)
                + protobuf.encoded_number(_FLAGS, flags)
                + protobuf.encoded_number(_COUNT, run.pages)
                for run, flags in self.entries
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
    return Entry(Run(values[_ADDRESS], count), flags)


def _numbers(message: bytes, known: Collection[int]) -> dict[int, int]:
    """Return the fields of a message; raise ValueError for an unknown one or one of bytes."""
    values = {}
    for number, value, _ in protobuf.fields(message):
        if number not in known or isinstance(value, bytes):
            raise ValueError(f"the field {number} is unknown")
        values[number] = value
    return values


def leave_out(directory: Path, copy: MemoryCopy) -> dict[str, int]:
    """Remove the copied pages from a dump, and mark them as in the parent.

    Args:
        directory: of the image.
        copy: of the same processes.

    Returns:
        The bytes of each file that must be in the image before a restore, by path below it.

    Raises:
        ValueError, KeyError: the dump has a form that is unknown here.
        OSError: a file cannot be read or written. After any error the dump is as before.
    """
    images, parent = directory / PAGES, directory / PARENT
    parent.mkdir(mode=0o700)
    try:
        sizes = {
            f"{PARENT}/{file_name(pid)}": _prepare(images, parent, copy, pid)
            for pid, runs in copy.runs.items()
            if runs and (images / f"pagemap-{pid}.img").exists()
        }
    except BaseException:
        shutil.rmtree(parent)
        for path in images.glob(f"*{_NEW}"):
            path.unlink()
        raise
    for path in images.glob(f"*{_NEW}"):
        path.replace(path.with_suffix(""))
    return sizes


def _prepare(images: Path, parent: Path, copy: MemoryCopy, pid: int) -> int:
    """Write the new files of one process; return the bytes of its copied pages."""
    name, runs = f"pagemap-{pid}.img", copy.runs[pid]
    pagemap = Pagemap.decoded((images / name).read_bytes())
    pages = f"pages-{pagemap.file}.img"
    dumped, before = _pages(images / pages), _pages(copy.directory / file_name(pid))
    same = same_pages([one.run for one in pagemap.entries], runs, dumped, before)
    entries = list(divided(pagemap.entries, same))
    _write(images / f"{name}{_NEW}", [Pagemap(pagemap.magic, pagemap.file, entries).encoded()])
    _write(images / f"{pages}{_NEW}", _changed(entries, dumped))
    own = Pagemap(pagemap.magic, pid, [Entry(run, _PRESENT) for run in runs])
    _write(parent / name, [own.encoded()])
    return before.nbytes


def _pages(path: Path) -> NDArray[np.uint64]:
    """Return the pages of a file, one a row."""
    size = path.stat().st_size
    flat = np.asarray(np.memmap(path, np.uint64, "r")) if size else np.empty(0, np.uint64)
    return flat.reshape(-1, PAGE // 8)


def same_pages(
    runs: Iterable[Run], copied: Sequence[Run], pages: NDArray[np.uint64], copy: NDArray[np.uint64]
) -> NDArray[np.bool_]:
    """Return for each page of a dump whether the copy has the same content at its address.

    Args:
        runs: of the dump, in the order of its pages.
        copied: of the copy, in the order of its pages and by ascending address.
        pages: of the dump, one a row.
        copy: the copied pages, one a row.

    Raises:
        ValueError: the number of pages is not that of the runs.
    """
    same = np.zeros(len(pages), np.bool_)
    begins = [run.begin for run in copied]
    rows = [0, *accumulate(run.pages for run in copied)]
    row = 0
    for run in runs:
        at = max(bisect_right(begins, run.begin) - 1, 0)
        while at < len(copied) and copied[at].begin < run.end:
            low, high = max(run.begin, copied[at].begin), min(run.end, copied[at].end)
            there = rows[at] + (low - copied[at].begin) // PAGE
            begin, end = row + (low - run.begin) // PAGE, row + (high - run.begin) // PAGE
            for here in range(begin, end, _AT_ONCE):
                after = min(here + _AT_ONCE, end)
                part = copy[there + here - begin : there + after - begin]
                same[here:after] = (pages[here:after] == part).all(axis=1)
            at += 1
        row += run.pages
    if (row, rows[-1]) != (len(pages), len(copy)):
        raise ValueError("the files have another number of pages than their lists")
    return same


def divided(entries: Iterable[Entry], same: NDArray[np.bool_]) -> Iterator[Entry]:
    """Yield the entries of a dump, divided into pages that are in the parent and others."""
    row = 0
    for (begin, pages), flags in entries:
        marks = same[row : row + pages]
        edges = [0, *(np.flatnonzero(np.diff(marks)) + 1).tolist(), pages]
        for first, after in pairwise(edges):
            if first < after:
                run = Run(begin + first * PAGE, after - first)
                yield Entry(run, _IN_PARENT if marks[first] else flags)
        row += pages


def _changed(entries: Iterable[Entry], pages: NDArray[np.uint64]) -> Iterator[memoryview]:
    """Yield the pages that are not in the parent."""
    row = 0
    for run, flags in entries:
        if flags != _IN_PARENT:
            yield pages[row : row + run.pages].data
        row += run.pages


def _write(path: Path, pieces: Iterable[bytes | memoryview]) -> None:
    path.touch(mode=0o600, exist_ok=False)
    with path.open("wb") as file:
        for piece in pieces:
            file.write(piece)


def put_in_place(directory: Path, copies: Path) -> None:
    """Move received copies into a received image, if it refers to them; raise OSError."""
    parent = directory / PARENT
    if parent.is_dir():
        for path in copies.iterdir():
            path.rename(parent / path.name)


def are_copies(directory: Path) -> bool:
    """Return True if a received directory contains copied pages alone."""
    return all(path.is_file() and _COPY.fullmatch(path.name) for path in directory.iterdir())
