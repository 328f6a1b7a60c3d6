"""Size of a whole listing: its rows are bounded one by one, and clients take 16 MiB in all.

Otherwise the long reasons of one user's processes would refuse the listings of everybody.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from math import inf
from typing import Final

from rosrm.model.applications import ApplicationRow
from rosrm.model.rows import EventRow, ProcessRow
from rosrm.model.sizes import size_of
from rosrm.model.values import EMPTY

#: Bytes of all texts of one kind in a listing. `rosrm explain` and `rosrm ps NAME` show them whole.
_MOST: Final = 4 << 20


def short_processes(rows: Sequence[ProcessRow]) -> Sequence[ProcessRow]:
    """Return rows whose longest reasons are cut, if all reasons together are too large."""
    most = _level(_size(row.reason) for row in rows)
    return rows if most == inf else [replace(row, reason=_cut(row.reason, most)) for row in rows]


def short_applications(rows: Sequence[ApplicationRow]) -> Sequence[ApplicationRow]:
    """Return rows whose longest reasons, also those of their processes, are cut likewise."""
    most = _level(_size(text) for row in rows for text in (row.reason, *row.pending.values()))
    if most == inf:
        return rows
    return [
        replace(
            row,
            reason=_cut(row.reason, most),
            pending={name: _cut(text, most) for name, text in row.pending.items()},
        )
        for row in rows
    ]


def short_events(rows: Sequence[EventRow]) -> Sequence[EventRow]:
    """Return rows whose longest messages are cut, and the largest facts left out, likewise."""
    most = _level(_size(row.message) for row in rows)
    facts = _level(size_of(row.facts) for row in rows)
    if most == facts == inf:
        return rows
    return [
        replace(
            row,
            message=_cut(row.message, most),
            facts=row.facts if size_of(row.facts) <= facts else EMPTY,
        )
        for row in rows
    ]


def _level(sizes: Iterable[int]) -> float:
    """Return the size to which larger ones are cut so that all fit; infinity: all fit."""
    ascending, left = sorted(sizes), _MOST
    for index, size in enumerate(ascending):
        level = left // (len(ascending) - index)
        if size > level:
            return level
        left -= size
    return inf


def _size(text: str) -> int:
    return len(text) if text.isascii() else len(text.encode(errors="replace"))


def _cut(text: str, most: float) -> str:
    if _size(text) <= most:
        return text
    return text.encode(errors="replace")[: int(most)].decode(errors="ignore")
