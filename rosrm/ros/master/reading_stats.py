"""Statistics of slaves' readings: received cycles, missed cycles, age of the oldest reading.

A slave counts its cycles (`sequence`), and each message states how many of them it covers. So the
next message reveals lost ones, and quiet cycles do not count as lost. A late message that arrives
after all no longer counts as missed.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import numpy.typing as npt

from rosrm.core.master.state.hosts import MOST_AHEAD
from rosrm.ros.master.reading_decoder import Runs

#: Seconds of silence after which a host's reading is no longer expected.
_GONE: Final = 10.0
_FIRST_ROOM: Final = 16
_NS: Final = 1e-9
#: Seconds by which a beat may be ahead of the time that has passed since the one before. An order
#: with a beat that is still to come for its slave would be stale.
_BEAT_AHEAD: Final = 10.0
#: Seconds for which all beats of a slave are too far ahead, after which they count.
_SUSPENDED: Final = 3.0


class ReadingStats:
    """Received cycles, missed cycles and newest beats, by host id.

    Attributes:
        cycles: of all slaves, covered by messages since the start.
        missed: of all slaves, covered by no message.
        beat: (H,) newest beat of the last registered run, ns; 0: none was received yet.
    """

    def __init__(self) -> None:
        self.cycles = 0
        self.missed = 0
        self._room(_FIRST_ROOM)

    def _room(self, hosts: int) -> None:
        self.beat: npt.NDArray[np.uint64] = np.zeros(hosts, np.uint64)
        self._incarnation: npt.NDArray[np.uint64] = np.zeros(hosts, np.uint64)
        self._sequence: npt.NDArray[np.int64] = np.zeros(hosts, np.int64)
        self._last_contact: npt.NDArray[np.float64] = np.full(hosts, -np.inf)
        self._ahead_since: npt.NDArray[np.float64] = np.full(hosts, np.inf)

    def begin(self, host_id: int, incarnation: int) -> None:
        """Start the count of a newly registered run with its first message."""
        if host_id >= len(self.beat):
            self._grow(2 * host_id)
        self._incarnation[host_id] = incarnation
        self._sequence[host_id] = self.beat[host_id] = 0
        self._last_contact[host_id] = -np.inf

    def _grow(self, hosts: int) -> None:
        kept: tuple[npt.NDArray[Any], ...] = (
            self.beat, self._incarnation, self._sequence, self._last_contact, self._ahead_since
        )  # fmt: skip
        self._room(hosts)
        into = (
            self.beat, self._incarnation, self._sequence, self._last_contact, self._ahead_since
        )  # fmt: skip
        for line, before in zip(into, kept, strict=True):
            line[: len(before)] = before

    def forget(self, host_id: int) -> None:
        """Stop expecting readings of a host that left."""
        if host_id < len(self.beat):
            self._last_contact[host_id] = -np.inf

    def take(self, runs: Runs, now: float) -> npt.NDArray[np.int64]:
        """Enter a batch, skip unregistered runs, and return the ids of the hosts that reported."""
        known = (runs.host_id > 0) & (runs.host_id < len(self.beat))
        at = np.where(known, runs.host_id, 0)
        known &= self._incarnation[at] == runs.incarnation
        at, sequence, cycles = at[known], runs.sequence[known], runs.cycles[known]
        before = self._sequence[at]
        # No cycle before the first message of a run was expected, nor any after an absurd step.
        step = sequence - np.where(before, before, runs.first[known] - 1)
        absurd = np.abs(step) > MOST_AHEAD
        self.cycles += int(cycles.sum())
        self.missed += int(np.where(absurd, 0, np.maximum(step, 0) - cycles).sum())
        newer = (sequence > before) | absurd
        self._sequence[at[newer]] = sequence[newer]
        self._take_beats(at, runs.beat[known], now)
        self._last_contact[at] = now
        return at

    def _take_beats(
        self, at: npt.NDArray[np.int64], beats: npt.NDArray[np.uint64], now: float
    ) -> None:
        """Enter beats, except those that the clocks of the slaves cannot have reached.

        If all beats of a slave are like that for a while, this machine was suspended.
        """
        before, passed = self.beat[at], now - self._last_contact[at]
        ahead = np.where(beats > before, beats - before, np.uint64(0)) * _NS
        since = np.minimum(self._ahead_since[at], now)
        taken = (before == 0) | (ahead <= passed + _BEAT_AHEAD) | (now - since >= _SUSPENDED)
        self._ahead_since[at] = np.where(taken, np.inf, since)
        self.beat[at[taken]] = beats[taken]

    def ages(self, now: float) -> tuple[int, float]:
        """Return the number of reporting hosts, and the greatest age of a newest reading, s."""
        age = now - self._last_contact
        age = age[age < _GONE]
        return (len(age), float(age.max())) if len(age) else (0, 0.0)
