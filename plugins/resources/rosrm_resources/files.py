"""Kernel files that stay open, because they are read ten times a second."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

#: Most processes whose files stay open. Files of further processes are opened for each read, to
#: stay far below the usual limit of 1,024 descriptors.
_MOST_OPEN_PROCESSES: Final = 128


class OpenFile:
    """Open file of /proc or /sys; each read returns the current content from its beginning.

    Args:
        path: of the file.
        size: bytes of interest.
    """

    def __init__(self, path: Path, size: int = 8192) -> None:
        self._descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        self._size = size

    def read(self) -> bytes:
        """Return the current content."""
        return os.pread(self._descriptor, self._size, 0)

    def close(self) -> None:
        """Close the file; no read may follow."""
        os.close(self._descriptor)


class ProcessFiles:
    """One file of /proc/PID for each process of a changing set.

    Args:
        proc: mount point of the process file system.
        name: of the file below /proc/PID.
        size: bytes of interest.
    """

    def __init__(self, proc: Path, name: str, size: int = 1024) -> None:
        self._proc = str(proc)
        self._name = name
        self._size = size
        self._descriptors: dict[int, int] = {}
        self._pids: Sequence[int] = ()

    def read(self, pids: Sequence[int]) -> Iterator[tuple[int, bytes]]:
        """Yield each live process with the content of its file."""
        if pids != self._pids:
            self._pids = pids
            self._drop(set(self._descriptors) - set(pids))
        for pid in pids:
            content = self._read_one(pid)
            if content:
                yield pid, content

    def close(self) -> None:
        """Close all open files."""
        self._drop(set(self._descriptors))

    def _read_one(self, pid: int) -> bytes:
        """Return the content of one file; b"" if the process has ended."""
        descriptor = self._descriptors.get(pid)
        if descriptor is not None:
            try:
                return os.pread(descriptor, self._size, 0)
            except ProcessLookupError:
                # That process has ended, and the kernel may have reused its pid.
                self._drop({pid})
        try:
            descriptor = os.open(f"{self._proc}/{pid}/{self._name}", os.O_RDONLY | os.O_CLOEXEC)
        except (FileNotFoundError, ProcessLookupError):
            return b""
        self._descriptors[pid] = descriptor
        try:
            return os.pread(descriptor, self._size, 0)
        except ProcessLookupError:
            return b""
        finally:
            if len(self._descriptors) > _MOST_OPEN_PROCESSES:
                self._drop({pid})

    def _drop(self, pids: set[int]) -> None:
        for pid in pids:
            os.close(self._descriptors.pop(pid))
