"""Readings of a slave: published on change, and at least once per beat period of the master.

A reading is published in its cycle if it brings news. These are: a limit is reached or left, the
slave starts or stops accepting work, a probe is late, the number of processes changes, there is a
batch of statuses, or a usage has moved by `RESOLUTION`. Cycles without news are counted in the next
message, after at most one beat period of the master, so both sides hear from each other that often.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

import numpy as np
import numpy.typing as npt

from rosrm.ros.reading_codec import LAYOUT, MOST_QUIET, encode, flags
from rosrm.version import PROTOCOL_VERSION

#: Part of a resource's capacity by which a usage must have moved to be published at once.
RESOLUTION: Final = 0.01

#: Facts compared as one with the last message: accepting, processes, present, stale, statuses.
_Facts = tuple[bool, int, int, int, int]


class Reporter:
    """The readings of one slave.

    Args:
        send: publishes a serialised `ResourceInfo`.
        period: seconds from one cycle to the next.
    """

    def __init__(self, send: Callable[[bytes], None], incarnation: int, period: float) -> None:
        self._send = send
        self._period = period
        self._every = 1
        self._unpublished = 0
        self._row = np.zeros((), LAYOUT)
        self._row["protocol_version"] = PROTOCOL_VERSION
        self._row["incarnation"] = incarnation
        self._facts: _Facts = (False, 0, 0, 0, 0)
        self._published: _Facts | None = None
        self._published_usage = self._published_limit = np.zeros(0, np.float32)
        self._published_over = np.zeros(0, np.bool_)

    def begin(self, host_id: int, beat_period: float) -> None:
        """Start reporting to a master that accepted this host; the next reading is always sent."""
        self._row["host_id"] = host_id
        # The summand rounds up, because three periods of 0.1 s are slightly less than 0.3 s.
        self._every = min(max(1, int(beat_period / self._period + 1e-6)), MOST_QUIET + 1)
        self._published = None

    def note_master(self, beat: int) -> None:
        """Store the newest received beat of the master, ns, for the next reading."""
        self._row["master_beat"] = beat

    def cycle(
        self, usage: npt.NDArray[np.float32], limit: npt.NDArray[np.float32], facts: _Facts
    ) -> None:
        """Enter one cycle of the slave; send its reading if that brings news or is due."""
        row = self._row
        row["sequence"] += 1
        row["usage"], row["limit"] = usage, limit
        self._facts = facts
        self._unpublished += 1
        if self._unpublished >= self._every or self._has_news(usage, limit):
            self.publish()

    def _has_news(self, usage: npt.NDArray[np.float32], limit: npt.NDArray[np.float32]) -> bool:
        """Return True if a decision may differ between this reading and the last published one."""
        if self._facts != self._published:
            return True
        return bool(
            (np.abs(usage - self._published_usage) >= RESOLUTION).any()
            or ((usage >= limit) != self._published_over).any()
            or (limit != self._published_limit).any()
        )

    def publish(self) -> None:
        """Send the newest reading, unless it has been sent."""
        if not self._unpublished:
            return
        row = self._row
        accepting, row["processes"], row["present"], row["stale"], statuses = self._facts
        row["status_sequence"] = statuses
        row["flags"] = flags(accepting=accepting, quiet=self._unpublished - 1)
        row["beat"] = time.monotonic_ns()
        self._unpublished = 0
        self._published = self._facts
        self._published_usage, self._published_limit = row["usage"].copy(), row["limit"].copy()
        self._published_over = self._published_usage >= self._published_limit
        self._send(encode(row))
