"""Lock of the state directory of a master or slave: one process holds it at a time."""

from __future__ import annotations

import contextlib
import fcntl
import logging
import os
from collections.abc import Iterator
from glob import glob
from pathlib import Path
from typing import Final, TextIO

from rosrm.errors import ConfigError, Refused
from rosrm.runtime.private_files import make_private_directory, open_private
from rosrm.wording import reason_of

#: Bytes of the pid in the lock, which are written in place: on a full disk the room of a shortened
#: file may be taken at once.
_PID_BYTES: Final = 20

_log = logging.getLogger("rosrm")

#: Locks of this process. A plugin may fork, and the child would hold them after the end of this
#: process, because both share the open file.
_locks: Final[set[int]] = set()


def _close_locks() -> None:
    for lock in _locks:
        with contextlib.suppress(OSError):
            os.close(lock)


os.register_at_fork(after_in_child=_close_locks)


@contextlib.contextmanager
def closed_in_forks(lock: int) -> Iterator[None]:
    """Close the descriptor of a locked file in each process that this one forks."""
    _locks.add(lock)
    try:
        yield
    finally:
        _locks.discard(lock)


@contextlib.contextmanager
def only_one(directory: Path, role: str, *, code: str, remedy: str) -> Iterator[int]:
    """Lock a state directory for one process of a role on this machine; yield the descriptor.

    Args:
        directory: created if it is missing; an existing one that is open to others is tightened.
        role: "master" or "slave".
        code: error code of the refusal.
        remedy: settings that allow a second process beside the first; "" if none do.

    Raises:
        Refused: another process holds the directory; the message names its pid.
        ConfigError: the directory cannot be used.
    """
    try:
        former = make_private_directory(directory)
        lock = os.fdopen(
            open_private(str(directory / f"{role}.lock"), os.O_RDWR | os.O_CREAT), "r+"
        )
    except OSError as error:
        raise ConfigError(
            f"the state directory {directory} cannot be used: {reason_of(error)}; give this {role} "
            f"another `state:`"
        ) from None
    if former:
        _log.warning(
            "the state directory %s had mode %04o, open to other users; it has 0700 now",
            directory, former,
        )  # fmt: skip
    with lock, closed_in_forks(lock.fileno()):
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise Refused(_refusal(lock, directory, role, remedy), code) from None
        with contextlib.suppress(OSError):  # a full disk: only a refusal's message lacks the pid
            os.pwrite(lock.fileno(), str(os.getpid()).ljust(_PID_BYTES).encode(), 0)
        yield lock.fileno()


def _refusal(lock: TextIO, directory: Path, role: str, remedy: str) -> str:
    """Return why a directory is locked, with the pids of the processes that have the lock."""
    pid = lock.read().strip()
    if pid.isdigit() and os.path.exists(f"/proc/{pid}"):  # noqa: PTH110 - as short as it can be
        other = remedy and f", or give this one {remedy}"
        return f"a {role} runs already on {directory}: pid {pid}. Stop it first{other}"
    holders = ", ".join(map(str, _holders(lock))) or "unknown"
    return (
        f"the {role} of {directory} has ended (pid {pid or 'unknown'}), but a process that it "
        f"started holds its lock: pid {holders}. End that process first"
    )


def _holders(lock: TextIO) -> list[int]:
    """Return the pids of other processes that have the file open, as far as they can be read."""
    own = os.fstat(lock.fileno())
    found = set()
    for path in glob("/proc/[0-9]*/fd/*"):  # noqa: PTH207 - thousands of paths
        with contextlib.suppress(OSError, ValueError):
            state, pid = os.stat(path), int(path.split("/")[2])  # noqa: PTH116 - as above
            if (state.st_dev, state.st_ino) == (own.st_dev, own.st_ino) and pid != os.getpid():
                found.add(pid)
    return sorted(found)
