"""Readings of a slave: published on change, and at least once per beat period of the master.

A reading is published in its cycle if it brings news. These are: a limit is reached or left, the
slave starts or stops accepting work, a probe is late, the number of processes changes, there is a
batch of statuses, or a usage has moved by `RESOLUTION`. Cycles without news are counted in the next
message, after at most one beat period of the master, so both sides hear from each other that often.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Sequence
from typing import Final

from rosrm import clocks
from rosrm.ros.reading_codec import MOST_QUIET, Reading, encode, flags

#: Part of a resource's capacity by which a usage must have moved to be published at once.
RESOLUTION: Final = 0.01

#: Facts compared as one with the last message: accepting, processes, present, stale, statuses.
_Facts = tuple[bool, int, int, int, int]
#: Index of `present` in `_Facts`.
_PRESENT: Final = 2


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
        self._reading = Reading(incarnation=incarnation)
        self._facts: _Facts = (False, 0, 0, 0, 0)
        self._published: _Facts | None = None
        self._published_usage: Sequence[float] = ()
        self._published_limit: Sequence[float] = ()

    def begin(self, host_id: int, beat_period: float) -> None:
        """Start reporting to a master that accepted this host; the next reading is always sent."""
        self._reading.host_id = host_id
        # The summand rounds up, because three periods of 0.1 s are slightly less than 0.3 s.
        self._every = min(max(1, int(beat_period / self._period + 1e-6)), MOST_QUIET + 1)
        self._published = None

    def note_master(self, beat: int) -> None:
        """Store the newest received beat of the master, ns, for the next reading."""
        self._reading.master_beat = beat

    def cycle(self, usage: array[float], limit: array[float], facts: _Facts) -> None:
        """Enter one cycle of the slave; send its reading if that brings news or is due.

        Args:
            usage, limit: single-precision fractions by slot.
        """
        self._reading.sequence += 1
        self._reading.usage, self._reading.limit = usage, limit
        self._facts = facts
        self._unpublished += 1
        if self._unpublished >= self._every or self._has_news(usage, limit):
            self.publish()

    def _has_news(self, usage: array[float], limit: array[float]) -> bool:
        """Return True if a decision may differ between this reading and the last published one."""
        if self._facts != self._published or limit != self._published_limit:
            return True
        slots = usage[: self._facts[_PRESENT].bit_length()]  # the usage of all others is 0
        return any(
            abs(now - before) >= RESOLUTION or (now >= most) != (before >= most)
            for now, before, most in zip(slots, self._published_usage, limit, strict=False)
        )

    def publish(self) -> None:
        """Send the newest reading, unless it has been sent."""
        if not self._unpublished:
            return
        one = self._reading
        accepting, one.processes, one.present, one.stale, one.status_sequence = self._facts
        one.flags = flags(accepting=accepting, quiet=self._unpublished - 1)
        one.beat = clocks.boot_time_ns()
        self._unpublished = 0
        self._published = self._facts
        self._published_usage, self._published_limit = one.usage, one.limit
        self._send(encode(one))
