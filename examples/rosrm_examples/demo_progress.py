"""Progress of a live drive: the scans that were mapped so far."""

from __future__ import annotations

from typing import Final

from rosrm_examples.observer import Observer

#: Seconds without a pose and without an action after which nothing more is expected.
_QUIET_S: Final = 10.0


class Progress:
    """The number of mapped scans, as an observer of the SLAM received their poses.

    Attributes:
        mapped: number of scans.
    """

    def __init__(self, observer: Observer) -> None:
        self.mapped = 0
        self._observer = observer
        self._elapsed = 0.0
        self._quiet_since = 0.0

    def look(self, elapsed: float) -> None:
        """Count the scans, `elapsed` seconds after the beginning."""
        self._elapsed = elapsed
        received = len(self._observer.received)
        if received > self.mapped:
            self.mapped = received
            self.note_action()

    def note_action(self) -> None:
        """Let the time without a pose begin now."""
        self._quiet_since = self._elapsed

    def has_ended(self, scans: int) -> bool:
        """Return True if so many scans are mapped, or no more are expected."""
        return self.mapped >= scans or self.is_quiet()

    def is_quiet(self) -> bool:
        """Return True if no more scans are expected."""
        return self._elapsed - self._quiet_since >= _QUIET_S
