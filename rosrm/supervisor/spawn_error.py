"""Failures of a spawn, as `spawn`, `secret_files` and `adoption` raise them."""

from __future__ import annotations


class SpawnError(Exception):
    """The process cannot be started; the text says what was tried, where, and what is wrong.

    Only the first line is the reason: details such as a whole PATH go into further lines.

    Attributes:
        transient: the same spawn may succeed later.
    """

    def __init__(self, message: str, *, transient: bool = False) -> None:
        super().__init__(message)
        self.transient = transient


class ScheduleRefused(SpawnError):
    """The process may not have the real-time scheduling."""
