"""Signals that ask a process to stop."""

from __future__ import annotations

import signal
from types import FrameType


class StopSignals:
    """A recorder of SIGINT and SIGTERM, so that a node stops between two scans, never within one.

    Attributes:
        came: The number of the last signal, or None.
    """

    def __init__(self) -> None:
        """Install handlers for both signals."""
        self.came: int | None = None
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._note)

    def _note(self, number: int, _: FrameType | None) -> None:
        self.came = number
