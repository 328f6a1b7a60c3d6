"""Receiver of the pages that CRIU dumps, which leaves out pages that equal a `MemoryCopy`.

CRIU can send pages to a *page server* instead of writing them to files. Here the slave is the page
server: it compares pages with the copy while CRIU reads the next ones. So no file contains the
whole memory. The connection is a socket pair that CRIU inherits, so no other process can use it.
"""

from __future__ import annotations

import socket
import struct
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final

import numpy as np

from rosrm.errors import CriuError
from rosrm_criu.engine.copied_pages import (
    IN_PARENT,
    PRESENT,
    CopiedPages,
    Entry,
    encoded,
    new_file,
    split_entry,
)
from rosrm_criu.engine.image import PAGES
from rosrm_criu.engine.memory_copy import PAGE, MemoryCopy, PageRange

#: Request of CRIU: command and flags, number of pages, address, and the image's kind and id.
_REQUEST: Final = struct.Struct("IQQQ")
#: Commands: begin an image, receive pages, report if it has a parent, end the dump (two forms).
_OPEN, _ADD, _HAS_PARENT, _END = 4, 6, 5, (0x1023, 0x1024)
#: Answers: to `_OPEN`, no parent, so CRIU sends all pages; to `_HAS_PARENT`, no; to `_END`, done.
_NO_PARENT, _ZERO = b"\0", struct.pack("i", 0)
#: Names of pagemaps by the kind of the image: of a process, of shared memory.
_NAMES: Final = {1: "pagemap-{}.img", 2: "pagemap-shmem-{}.img"}
_OF_PROCESS: Final = 1
#: Flags of pages: their content follows, also with PE_LAZY (restored on first use).
_LAZY: Final = 2
_FLAGS: Final = (PRESENT, PRESENT | _LAZY)
#: Pages that are received at once, so that they stay in the processor's cache.
_AT_ONCE: Final = 256


def serve(run: Callable[[int], None], directory: Path, copy: MemoryCopy) -> dict[str, int] | None:
    """Receive the pages of a dump, and write those that are not equal in a copy.

    Args:
        run: runs CRIU with the page server at this file descriptor, and raises CriuError.
        directory: of the image.
        copy: of the same processes.

    Returns:
        The bytes of each file that must be in the image before a restore, by path below it. None:
        pages could not be received, and the processes can be dumped again.

    Raises:
        CriuError: CRIU failed.
    """
    ours, theirs = socket.socketpair()
    with ThreadPoolExecutor(1, "page-server") as pool:
        received = pool.submit(_receive, ours, directory, copy)
        try:
            with theirs:
                try:
                    run(theirs.fileno())
                finally:  # ends the receiver, even if a process that CRIU left still has this end
                    theirs.shutdown(socket.SHUT_RDWR)
        except CriuError:
            if isinstance(received.exception(), EOFError | ConnectionError | None):
                raise  # CRIU itself failed, not the receiver
        return received.result() if received.exception() is None else None


def _receive(connection: socket.socket, directory: Path, copy: MemoryCopy) -> dict[str, int]:
    """Answer CRIU's requests; after an error the end of the connection makes the dump fail."""
    sizes: dict[str, int] = {}
    image, number, head = None, 0, memoryview(bytearray(_REQUEST.size))
    with connection:
        while True:
            _fill(head, connection)
            command, pages, address, which = _REQUEST.unpack(head)
            flags, command = divmod(command, 1 << 16)
            if image and command in (_OPEN, *_END):
                sizes |= image.finished()
            if command == _OPEN:
                number += 1
                image = _Image(directory, copy, which, number)
                connection.sendall(_NO_PARENT)
            elif command == _ADD and image and image.which == which and flags in _FLAGS:
                image.add(Entry(PageRange(address, pages), flags), connection)
            elif command == _HAS_PARENT:
                connection.sendall(_ZERO)
            elif command in _END:
                connection.sendall(_ZERO)
                return sizes
            else:
                raise ValueError(f"request {command} with flags {flags} for {which} is unexpected")


class _Image:
    """Pages of a process or of shared memory.

    Args:
        directory: of the image.
        copy: of the processes.
        which: kind and id of the pages, as CRIU sends them.
        number: of the file with the pages.
    """

    def __init__(self, directory: Path, copy: MemoryCopy, which: int, number: int) -> None:
        identity, kind = divmod(which, 1 << 8)
        self.which, self._directory, self._number = which, directory, number
        self._pagemap = directory / PAGES / _NAMES[kind].format(identity)
        self._copied = CopiedPages(copy, identity if kind == _OF_PROCESS else 0)
        self._entries: list[Entry] = []
        self._file = new_file(directory / PAGES / f"pages-{number}.img")
        self._buffer = np.empty((_AT_ONCE, PAGE // 8), np.uint64)

    def add(self, entry: Entry, connection: socket.socket) -> None:
        """Receive pages, and write those that are not equal in the copy."""
        begin, count = entry.page_range
        same = np.empty(count, np.bool_)
        for row in range(0, count, _AT_ONCE):
            pages = self._buffer[: count - row]
            _fill(pages.data.cast("B"), connection)
            equal = self._copied.equal(begin + row * PAGE, pages)
            same[row : row + len(pages)] = equal
            self._file.write(pages[~equal].data)
        self._entries.extend(split_entry(entry, same))

    def finished(self) -> dict[str, int]:
        """Complete the files; return the bytes of those that a restore needs from the copy."""
        self._file.close()
        with new_file(self._pagemap) as file:
            file.write(encoded(self._number, self._entries))
        if all(flags != IN_PARENT for _, flags in self._entries):
            return {}
        return self._copied.as_parent(self._directory)


def _fill(memory: memoryview, connection: socket.socket) -> None:
    """Receive as many bytes as the memory has; raise EOFError if the connection ends before."""
    while memory:
        count = connection.recv_into(memory)
        if not count:
            raise EOFError("CRIU ended before its dump was complete")
        memory = memory[count:]
