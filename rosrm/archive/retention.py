"""Bounds of a log archive: which segments are removed. Pure."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import NamedTuple

from rosrm.archive.layout import Segment, Source


class ArchiveLimits(NamedTuple):
    """Limits of a log archive.

    Attributes:
        keep: bytes on the disk of all hosts.
        keep_host: bytes on the disk of each host.
        segments: files of all hosts, which bound the memory of the collector.
    """

    keep: int
    keep_host: int
    segments: int = 100_000


def excess(
    stored: Iterable[tuple[Source, Segment]], limits: ArchiveLimits
) -> list[tuple[Source, Segment]]:
    """Return the closed segments to remove: the oldest of a host beyond its bound, then of all."""
    stored = list(stored)
    host_rooms = _host_rooms(stored)
    room, removed = sum(host_rooms.values()), []
    closed = sorted((one for one in stored if not one[1].is_open), key=lambda one: one[1].time)
    staying = []
    for source, segment in closed:
        if host_rooms[source.host] > limits.keep_host:
            host_rooms[source.host] -= segment.room
            room -= segment.room
            removed.append((source, segment))
        else:
            staying.append((source, segment))
    number = len(stored) - len(removed)
    for source, segment in staying:
        if room <= limits.keep and number <= limits.segments:
            break
        number -= 1
        room -= segment.room
        removed.append((source, segment))
    return removed


def is_within(stored: Iterable[tuple[Source, Segment]], limits: ArchiveLimits) -> bool:
    """Return True if an archive exceeds none of its bounds."""
    rooms = _host_rooms(stored).values()
    return sum(rooms) <= limits.keep and max(rooms, default=0) <= limits.keep_host


def _host_rooms(stored: Iterable[tuple[Source, Segment]]) -> Counter[str]:
    """Return the bytes on the disk of each host."""
    rooms: Counter[str] = Counter()
    for source, segment in stored:
        rooms[source.host] += segment.room
    return rooms
