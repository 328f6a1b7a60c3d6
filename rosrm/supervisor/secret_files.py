"""Secrets of a process, read from files of this host just before each of its starts.

A value goes into the environment of the started process, and nowhere else: no record, log, status
or message holds it.
"""

from __future__ import annotations

import os
import stat
from typing import Final

from rosrm.supervisor.spawn_error import SpawnError

#: Most bytes of a secret; the kernel refuses a variable of 128 KiB or more.
MOST_BYTES: Final = 1 << 16


def is_exposed(path: str) -> bool:
    """Return True if every user of this host may read a file, or replace its content."""
    try:
        return bool(os.stat(path).st_mode & (stat.S_IROTH | stat.S_IWOTH))
    except (OSError, ValueError):  # ValueError: a path that cannot be encoded
        return False


def read(name: str, path: str) -> str:
    """Return the value of a secret from its file. Raises SpawnError."""
    try:
        content = _content(path)
    except (OSError, ValueError) as error:  # ValueError: a path that cannot be encoded
        reason = getattr(error, "strerror", None) or "no path of a file"
        fault = f"the secret {name} cannot be read: {path!r}: {reason}"
        raise SpawnError.of(fault, error) from None
    if content is None:
        raise SpawnError(f"the secret {name} cannot be read: {path!r} is not a regular file")
    if len(content) > MOST_BYTES:
        raise SpawnError(f"the secret {name} in {path!r} has more than {MOST_BYTES >> 10} KiB")
    if b"\0" in content:
        raise SpawnError(f"the secret {name} in {path!r} has a NUL byte; none is allowed")
    return os.fsdecode(content.removesuffix(b"\n"))


def _content(path: str) -> bytes | None:
    """Return the first bytes of a file, one more than a secret may have; None: it is no file."""
    # Without O_NONBLOCK a FIFO without a writer would stop the supervisor.
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOCTTY)
    with open(descriptor, "rb") as file:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            return None
        return file.read(MOST_BYTES + 1)
