"""Files without a place on a disk, which may be full or read-only."""

from __future__ import annotations

import os
import tempfile

from rosrm.runtime.private_files import write_all


def memory_file(name: str, content: bytes = b"") -> int:
    """Return the descriptor of a file in memory, which is at its start.

    A filter of system calls may refuse `memfd_create`; then it is a temporary file without a name.

    Raises:
        OSError: neither can be had.
    """
    try:
        file = os.memfd_create(name)
    except OSError:
        with tempfile.TemporaryFile() as temporary:
            file = os.dup(temporary.fileno())
    write_all(file, content)
    os.lseek(file, 0, os.SEEK_SET)
    return file
