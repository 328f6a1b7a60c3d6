"""Failures of a spawn, as `spawn`, `secret_files`, `confinement` and `adoption` raise them."""

from __future__ import annotations

import errno
from typing import Final

from rosrm.shortage import SHORTAGE

#: Errors that may pass: the same spawn is tried again where the restart policy allows.
TRANSIENT: Final = SHORTAGE | {errno.EAGAIN, errno.ETXTBSY, errno.EIO}


def is_transient(cause: BaseException) -> bool:
    """Return True if an error may pass, so it tells nothing about this host."""
    return isinstance(cause, MemoryError) or getattr(cause, "errno", None) in TRANSIENT


class SpawnError(Exception):
    """The process cannot be started; the text says what was tried, where, and what is wrong.

    Only the first line is the reason: details such as a whole PATH go into further lines.

    Attributes:
        transient: the same spawn may succeed later. Otherwise this host counts as one that cannot
            start the process.
    """

    def __init__(self, message: str, *, transient: bool = False) -> None:
        super().__init__(message)
        self.transient = transient

    @classmethod
    def of(cls, message: str, cause: BaseException) -> SpawnError:
        """Return the failure of a spawn by another error, which may be transient."""
        return cls(message, transient=is_transient(cause))


class ScheduleRefused(SpawnError):
    """The process may not have the real-time scheduling."""
