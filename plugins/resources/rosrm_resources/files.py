"""Small kernel files that are read ten times a second, so they are kept open."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

#: Processes whose files are kept open; those beyond are opened anew, to stay far from the usual
#: bound of 1,024 descriptors.
_KEPT_PROCESSES: Final = 128


class KeptFile:
    """A file of /proc or /sys that each read gives anew from its beginning.

    Args:
        path: of the file.
        size: bytes of interest.
    """

    def __init__(self, path: Path, size: int = 8192) -> None:
        self._descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        self._size = size

    def read(self) -> bytes:
        """Its content now."""
        return os.pread(self._descriptor, self._size, 0)

    def close(self) -> None:
        """Close it; no read may follow."""
        os.close(self._descriptor)


class ProcessFiles:
    """One file of /proc/PID for each of some processes that come and go.

    Args:
        proc: where the process file system is mounted.
        name: of the file below /proc/PID.
    """

    def __init__(self, proc: Path, name: str) -> None:
        self._proc = str(proc)
        self._name = name
        self._kept: dict[int, int] = {}
        self._pids: Sequence[int] = ()

    def read(self, pids: Sequence[int]) -> Iterator[tuple[int, bytes]]:
        """Each process that still lives, with the content of its file."""
        if pids != self._pids:
            self._pids = pids
            self._drop(set(self._kept) - set(pids))
        for pid in pids:
            content = self._read_one(pid)
            if content:
                yield pid, content

    def close(self) -> None:
        """Close all that is kept."""
        self._drop(set(self._kept))

    def _read_one(self, pid: int) -> bytes:
        """The content; nothing where the process has ended."""
        descriptor = self._kept.get(pid)
        if descriptor is not None:
            try:
                return os.pread(descriptor, 1024, 0)
            except ProcessLookupError:
                # That process has ended; its number may already be another's.
                self._drop({pid})
        try:
            descriptor = os.open(f"{self._proc}/{pid}/{self._name}", os.O_RDONLY | os.O_CLOEXEC)
        except (FileNotFoundError, ProcessLookupError):
            return b""
        self._kept[pid] = descriptor
        try:
            return os.pread(descriptor, 1024, 0)
        except ProcessLookupError:
            return b""
        finally:
            if len(self._kept) > _KEPT_PROCESSES:
                self._drop({pid})

    def _drop(self, pids: set[int]) -> None:
        for pid in pids:
            os.close(self._kept.pop(pid))
