"""Copy of the memory of running processes, made before they are stopped for their dump.

The processes write to their memory during the copy, so a page of the copy may never have existed in
this form. Therefore `copied_pages` uses only pages that are equal to those of the later dump.
"""

from __future__ import annotations

import mmap
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from io import FileIO
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rosrm.supervisor.procfs import inner_pid

PAGE: Final = mmap.PAGESIZE
#: Pages that are compared at once, so that the results stay in the processor's cache.
_AT_ONCE: Final = 64
#: Folder below a copy with the pages that were copied once more.
CHANGES: Final = "changes"
#: Areas with less anonymous memory are not copied, because each one costs time in the dump.
_LEAST: Final = 256 << 10
#: Bytes per read of memory, and of address space whose pages are looked up at once.
_PIECE: Final = 1 << 20
_SPAN: Final = 1 << 28
#: Bits of an entry in /proc/PID/pagemap: in memory, swapped, and of a file or shared.
_HELD: Final = np.uint64(0b11 << 62)
_OF_FILE: Final = np.uint64(1 << 61)
#: First line of an area in /proc/PID/smaps.
_AREA: Final = re.compile(r"([0-9a-f]+)-([0-9a-f]+) ")


class PageRange(NamedTuple):
    """Range of adjacent pages in the address space of a process.

    Attributes:
        begin: address of the first page.
        pages: number of pages.
    """

    begin: int
    pages: int

    @property
    def end(self) -> int:
        """Return the address after the last page."""
        return self.begin + self.pages * PAGE


@dataclass(frozen=True)
class MemoryCopy:
    """Copied pages of processes.

    Attributes:
        directory: contains the file `file_name(pid)` of each process, with its pages in order.
        ranges: the copied pages of each process, by ascending address. The keys are pids in the
            namespaces of the processes.
        changed: which of these pages were copied once more, into the folder `CHANGES`, whose pages
            replace the former ones; empty: none were.
    """

    directory: Path
    ranges: Mapping[int, Sequence[PageRange]]
    changed: Mapping[int, NDArray[np.bool_]] = field(default_factory=dict)


def pages_in(path: Path) -> NDArray[np.uint64]:
    """Return the pages of a file as a matrix, one page in each row; raise OSError."""
    size = path.stat().st_size
    flat = np.asarray(np.memmap(path, np.uint64, "r")) if size else np.empty(0, np.uint64)
    return flat.reshape(-1, PAGE // 8)


def equal_pages(some: NDArray[np.uint64], others: NDArray[np.uint64]) -> NDArray[np.bool_]:
    """Return the mask of the pages that are equal to the other page in the same row."""
    equal = np.empty(len(some), np.bool_)
    for row in range(0, len(some), _AT_ONCE):
        part = slice(row, row + _AT_ONCE)
        equal[part] = (some[part] == others[part]).all(axis=1)
    return equal


def file_name(pid: int) -> str:
    """Return the name of the file with the copied pages of a process."""
    return f"pages-{pid}.img"


def size_of(pids: Iterable[int]) -> int:
    """Return the bytes that a copy of processes has; raise OSError if one has ended."""
    return sum(anonymous for pid in pids for _, _, anonymous in _areas(pid))


def copy(pids: Iterable[int], directory: Path, check: Callable[[], None]) -> MemoryCopy:
    """Copy the memory of running processes.

    Args:
        pids: of the processes.
        directory: a new one.
        check: called again and again; may raise an error to end the copy.

    Raises:
        OSError: a process has ended, its memory may not be read, or the disk is full.
    """
    directory.mkdir(mode=0o700, parents=True)
    return MemoryCopy(directory, {inner_pid(pid): _copy_one(pid, directory, check) for pid in pids})


def _copy_one(pid: int, directory: Path, check: Callable[[], None]) -> list[PageRange]:
    copied: list[PageRange] = []
    with _opened(pid, directory / file_name(inner_pid(pid))) as (file, memory, pagemap):
        for begin, end, _ in _areas(pid):
            for found in _held(pagemap, begin, end):
                size = 0
                for piece in _pieces(memory, found):
                    check()
                    file.write(piece)
                    size += len(piece)
                if size:
                    copied.append(PageRange(found.begin, size // PAGE))
    return copied


def copy_changes(former: MemoryCopy, pids: Iterable[int], check: Callable[[], None]) -> MemoryCopy:
    """Copy once more the pages of running processes that have changed since their copy.

    Pages that are new since then are left to the dump.

    Args:
        former: the copy.
        pids: of the processes; those without a copy are left out.
        check: called again and again; may raise an error to end the copy.

    Raises:
        OSError: a process has ended, its memory may not be read, or the disk is full.
    """
    (former.directory / CHANGES).mkdir(mode=0o700)
    known = {inner_pid(pid): pid for pid in pids}
    changed = {
        inner: _copy_changes_of(pid, inner, former, check)
        for inner, pid in known.items()
        if inner in former.ranges
    }
    return replace(former, ranges={pid: former.ranges[pid] for pid in changed}, changed=changed)


def _copy_changes_of(
    pid: int, inner: int, former: MemoryCopy, check: Callable[[], None]
) -> NDArray[np.bool_]:
    """Write the changed pages of one process; return the mask of them among those of the copy."""
    before, row = pages_in(former.directory / file_name(inner)), 0
    changed = np.zeros(len(before), np.bool_)
    path = former.directory / CHANGES / file_name(inner)
    with _opened(pid, path) as (file, memory, pagemap):
        for copied in former.ranges[inner]:
            for found in _held(pagemap, copied.begin, copied.end):
                at = row + (found.begin - copied.begin) // PAGE
                for piece in _pieces(memory, found):
                    check()
                    pages = np.frombuffer(piece, np.uint64).reshape(-1, PAGE // 8)
                    after = at + len(pages)
                    changed[at:after] = ~equal_pages(pages, before[at:after])
                    file.write(pages[changed[at:after]].data)
                    at = after
            row += copied.pages
    return changed


@contextmanager
def _opened(pid: int, path: Path) -> Iterator[tuple[FileIO, int, int]]:
    """Yield a new file, and the descriptors of a process's memory and pagemap."""
    path.touch(mode=0o600, exist_ok=False)
    with (
        path.open("wb", buffering=0) as file,
        Path(f"/proc/{pid}/mem").open("rb", buffering=0) as memory,
        Path(f"/proc/{pid}/pagemap").open("rb", buffering=0) as pagemap,
    ):
        yield file, memory.fileno(), pagemap.fileno()


def _areas(pid: int) -> Iterator[tuple[int, int, int]]:
    """Yield begin, end and anonymous bytes of the large areas of a process; raise OSError.

    An area that grows while the kernel lists it is listed twice. Its pages must be in one area
    only, because CRIU would restore its first copy of a page, whichever copy the dump equals.
    """
    begin = end = listed = 0
    for line in Path(f"/proc/{pid}/smaps").read_text(errors="replace").splitlines():
        if found := _AREA.match(line):
            begin, end = (int(number, 16) for number in found.groups())
        elif line.startswith("Anonymous:") and (size := int(line.split()[1]) << 10) >= _LEAST:
            yield max(begin, listed), end, size
            listed = max(listed, end)


def _held(pagemap: int, begin: int, end: int) -> Iterator[PageRange]:
    """Yield the pages of an area that exist and are in no file."""
    for start in range(begin, end, _SPAN):
        size = (min(end, start + _SPAN) - start) // PAGE * 8
        entries = np.frombuffer(os.pread(pagemap, size, start // PAGE * 8), np.uint64)
        held = ((entries & _HELD) != 0) & ((entries & _OF_FILE) == 0)
        edges = np.flatnonzero(np.diff(held, prepend=False, append=False)).tolist()
        for first, after in zip(edges[::2], edges[1::2], strict=True):
            yield PageRange(start + first * PAGE, after - first)


def _pieces(memory: int, pages: PageRange) -> Iterator[bytes]:
    """Yield whole pages from the beginning of a range, up to one that has been unmapped since."""
    at = pages.begin
    while at < pages.end:
        try:
            piece = os.pread(memory, min(_PIECE, pages.end - at), at)
        except OSError:
            return
        piece = piece[: len(piece) // PAGE * PAGE]
        if not piece:
            return
        yield piece
        at += len(piece)
