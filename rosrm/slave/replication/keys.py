"""Keys of processes with snapshots on this host, each in a file beside the snapshots.

An instance may continue to run while the slave restarts. The restarted slave reads the key from the
file, so that it never sends a snapshot without encryption. The key is deleted with the snapshots.
"""

from __future__ import annotations

import contextlib
import os
import struct
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Final

from rosrm.keys.derivation import KEY_BYTES
from rosrm.runtime import durable
from rosrm.runtime.private_files import open_private
from rosrm.shortage import exists
from rosrm.snapshots.format import Damaged
from rosrm.snapshots.reader import SLOTS

#: Name of the file, in the directory of the process.
KEY: Final = "key"
#: Number of the instance whose assignment had the key, and the key.
_RECORD: Final = struct.Struct(f"<Q{KEY_BYTES}s")


class StateKeys:
    """The keys of processes on this host.

    Args:
        directory_of: returns the directory of the snapshots of a process.
    """

    def __init__(self, directory_of: Callable[[str], Path]) -> None:
        self._directory_of = directory_of
        self._unsaved: dict[str, bytes] = {}
        self._lock = threading.Lock()

    def put(self, process: str, number: int, key: bytes) -> None:
        """Keep the key of a process until the next `save`, which replaces an earlier key.

        One `save` stores the keys of all processes that start now, in the time of one of them. May
        be called from any thread.

        Args:
            process: name of the process.
            number: of the instance whose assignment has the key.
            key: of the process.
        """
        with self._lock:
            self._unsaved[process] = _RECORD.pack(number, key)

    def save(self, process: str) -> None:
        """Store all keys that `put` has kept.

        Args:
            process: whose error is raised; the keys of others stay kept after an error.

        Raises:
            OSError: the key of this process cannot be written; `of` tries again.
        """
        unsaved = dict(self._unsaved)
        if process not in unsaved:
            return
        for one in unsaved:
            with contextlib.suppress(OSError):  # the write of the file then fails, too
                self._directory_of(one).mkdir(mode=0o700, parents=True, exist_ok=True)
        paths = {str(self._directory_of(one) / KEY): one for one in unsaved}
        faults = durable.replace_all_durably({path: unsaved[one] for path, one in paths.items()})
        with self._lock:
            for path, one in paths.items():
                if path not in faults and self._unsaved.get(one) == unsaved[one]:
                    del self._unsaved[one]
        for path, fault in faults.items():
            if paths[path] == process:
                raise fault

    def of(self, process: str) -> bytes:
        """Return the key of a process; b"": it has none.

        Raises:
            OSError: the file cannot be read, or an unsaved key cannot be written. Otherwise, after
                its restart, this slave would send the snapshots without encryption.
            Damaged: the file holds no key.
        """
        self.save(process)
        record = self._record_of(process)
        return b"" if record is None else record[1]

    def drop(self, process: str, up_to: int) -> None:
        """Delete the key of instances up to a number, unless the node has snapshots here."""
        directory = self._directory_of(process)
        if any(exists(directory / name) for name in SLOTS):
            return
        try:
            record = self._record_of(process)
        except Damaged:
            record = (0, b"")
        if record is not None and record[0] <= up_to:
            self.delete(process)

    def _record_of(self, process: str) -> tuple[int, bytes] | None:
        path = self._directory_of(process) / KEY
        try:
            packed = self._unsaved.get(process) or _content_of(path)
            number, key = _RECORD.unpack(packed)
        except (FileNotFoundError, NotADirectoryError):
            return None
        except struct.error:
            raise Damaged(f"{path} holds no key") from None
        return number, key

    def delete(self, process: str) -> None:
        """Delete the key of a process."""
        directory = self._directory_of(process)
        with self._lock:
            self._unsaved.pop(process, None)
        with contextlib.suppress(OSError):
            for name in (KEY, f"{KEY}.new"):
                (directory / name).unlink(missing_ok=True)
            directory.rmdir()  # fails, as intended, if the directory holds snapshots


def _content_of(path: Path) -> bytes:
    file = open_private(str(path), os.O_RDONLY)
    try:
        return os.read(file, _RECORD.size + 1)
    finally:
        os.close(file)
