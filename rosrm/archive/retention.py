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
    host_rooms: Counter[str] = Counter()
    for source, segment in stored:
        host_rooms[source.host] += segment.room
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
    host_rooms: Counter[str] = Counter()
    for source, segment in stored:
        host_rooms[source.host] += segment.room
    fullest = max(host_rooms.values(), default=0)
    return sum(host_rooms.values()) <= limits.keep and fullest <= limits.keep_host
