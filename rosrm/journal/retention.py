"""Bounds on the event record, in events and in bytes; refusals have a share of their own.

Anybody on the network can cause refusals. So they may fill a tenth of the record at most, and a
flood of them deletes no event about processes and hosts.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

from rosrm.model.event_kinds import EventKind

#: Kinds of events that a stranger can cause.
_REFUSALS: Final = (EventKind.PEER_REFUSED, EventKind.HOST_REFUSED, EventKind.READING_REFUSED)
_IS_REFUSAL: Final = f"kind IN ({', '.join(repr(str(kind)) for kind in _REFUSALS)})"
#: The record is this many times as large as the share of refusals.
_SHARE: Final = 10
#: Excess at which old events are deleted: in events, and as a part of the bytes.
_EXCESS: Final = 1000
_EXCESS_PART: Final = 64
#: Events until a deletion that failed is tried again.
_TRY_AGAIN: Final = 1000
#: Bytes of an event beside its texts.
_EACH: Final = 40
_SIZE: Final = f"{_EACH} + length(process) + length(host) + length(message) + length(facts)"

#: Columns of the table `record`, in order.
Row = tuple[int, float, float, str, str, str, str, str]


@dataclass(slots=True)
class _Bound:
    """Bound on the events that meet a condition, and their current number and size."""

    where: str
    keep: int
    keep_bytes: int
    count: int = 0
    size: int = 0

    @property
    def is_exceeded(self) -> bool:
        excess = self.keep_bytes // _EXCESS_PART
        return self.count >= self.keep + _EXCESS or self.size > self.keep_bytes + excess

    @property
    def is_kept(self) -> bool:
        return self.count <= self.keep and self.size <= self.keep_bytes

    def add(self, count: int, size: int) -> None:
        self.count += count
        self.size += size


class Retention:
    """Deletes the oldest events of a journal beyond its bounds.

    Args:
        database: with the table `record`.
        keep_events: newest events kept.
        keep_bytes: most bytes of their texts.

    Attributes:
        is_exceeded: old events exceed a bound, so `delete` has something to do.
    """

    def __init__(self, database: sqlite3.Connection, keep_events: int, keep_bytes: int) -> None:
        self._database = database
        self._all = _Bound("1", keep_events, keep_bytes)
        self._refusals = _Bound(_IS_REFUSAL, keep_events // _SHARE, keep_bytes // _SHARE)
        self.is_exceeded = False
        self._bounds = (self._refusals, self._all)
        self._pause = 0
        self._is_first = True  # short runs would add up to any excess
        held = database.execute(
            f"SELECT {_IS_REFUSAL}, count(*), sum({_SIZE}) FROM record GROUP BY 1"  # noqa: S608 - fixed words
        )
        for is_refusal, count, size in held.fetchall():
            self._count(bool(is_refusal), int(count), int(size))

    def add(self, rows: Iterable[Row]) -> None:
        """Count new events."""
        for row in rows:
            self._count(row[3] in _REFUSALS, 1, _EACH + sum(map(len, row[4:])))
            self._pause -= 1
        self.is_exceeded = self._pause <= 0 and any(map(self._exceeds, self._bounds))
        self._is_first = self._is_first and (self.is_exceeded or self._pause > 0)

    def delete(self) -> None:
        """Delete old events beyond the bounds.

        A deletion that fails is tried again later, because the new events are durable already.
        """
        if not self.is_exceeded:
            return
        self.is_exceeded = False
        try:
            for bound in self._bounds:
                if self._exceeds(bound):
                    self._delete(bound)
            self._is_first = False
        except sqlite3.Error:
            self._pause = _TRY_AGAIN

    def _exceeds(self, bound: _Bound) -> bool:
        return bound.is_exceeded or (self._is_first and not bound.is_kept)

    def _count(self, is_refusal: bool, count: int, size: int) -> None:
        self._all.add(count, size)
        if is_refusal:
            self._refusals.add(count, size)

    def _delete(self, bound: _Bound) -> None:
        """Delete the oldest events of a bound until it is kept, but never the newest event.

        The newest one holds the number from which the next master continues.
        """
        before = [(one.count, one.size) for one in (self._all, self._refusals)]
        newest = self._database.execute("SELECT max(sequence) FROM record").fetchone()[0]
        last = 0
        oldest_first = self._database.execute(
            f"SELECT sequence, {_IS_REFUSAL}, {_SIZE} FROM record "  # noqa: S608 - fixed words
            f"WHERE {bound.where} AND sequence < ? ORDER BY sequence",
            (newest,),
        )
        for sequence, is_refusal, size in oldest_first:
            if bound.is_kept:
                break
            self._count(bool(is_refusal), -1, -size)
            last = sequence
        oldest_first.close()
        try:
            self._database.execute(
                f"DELETE FROM record WHERE {bound.where} AND sequence <= ?",  # noqa: S608 - likewise
                (last,),
            )
        except sqlite3.Error:
            for one, (count, size) in zip((self._all, self._refusals), before, strict=True):
                one.count, one.size = count, size
            raise
