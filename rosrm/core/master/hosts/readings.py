"""Storage of readings: a batch of a thousand hosts in a few numpy calls."""

from __future__ import annotations

from typing import Final

import numpy as np

from rosrm.core.master.events import ReadingsReceived
from rosrm.core.master.state.host_arrays import BoolArray, FloatArray, IntArray
from rosrm.core.master.state.hosts import MOST_AHEAD, HostTable
from rosrm.model.values import ABSURD_USAGE, RESOURCE_SLOTS

#: Seconds for which every reading of a host is out of order, after which the stored sequence counts
#: as wrong: a single forged reading must not silence a host for good.
_WRONG_AFTER: Final = 3.0
_SLOT_BITS: Final = np.left_shift(np.uint32(1), np.arange(RESOURCE_SLOTS, dtype=np.uint32))


def take_readings(table: HostTable, readings: ReadingsReceived, now: float) -> BoolArray:
    """Store a batch of readings.

    A reading older than the stored one arrived late and is dropped, and so is one far ahead of it.
    An invalid reading is dropped too, but it renews the last contact of its host and makes the
    host's stored reading stale.

    Returns:
        (N,) True where a reading was refused: unknown host, former run of its slave, a value that
        is NaN, negative or above `ABSURD_USAGE`, or a sequence that is far ahead.
    """
    columns = readings.host_id - 1
    known = (columns >= 0) & (columns < len(table))
    at = np.where(known, columns, 0)
    if len(table):
        known &= table.incarnation[at] == readings.incarnation
    sane = (
        (readings.usage >= 0.0) & (readings.usage <= ABSURD_USAGE)
        & (readings.limit >= 0.0) & (readings.limit <= 1.0)
    ).all(axis=1)  # fmt: skip
    if not known.any():
        return np.asarray(~known)
    fresh = known & _in_order(table, readings, at, now)
    late = known & ~fresh
    table.refused_since[at[fresh]] = np.inf
    table.refused_since[at[late]] = np.minimum(table.refused_since[at[late]], now)
    table.last_contact[at[fresh]] = table.read_at[at[fresh]] = now
    table.sequence[at[fresh]] = readings.sequence[fresh]
    table.reported[at[fresh]] = readings.status_sequence[fresh]
    table.stale[at[fresh & ~sane]] = _SLOT_BITS.sum()
    _store(table, readings, at, fresh & sane)
    table.readings_changed()
    far_ahead = late & (readings.sequence > table.sequence[at])
    return np.asarray(~(known & sane) | far_ahead)


def _in_order(
    table: HostTable, readings: ReadingsReceived, columns: IntArray, now: float
) -> BoolArray:
    """Return the mask of readings that follow the stored ones, or replace a wrong sequence."""
    before = table.sequence[columns]
    step = readings.sequence - before  # unsigned: an older reading is very far ahead
    most = MOST_AHEAD + table.readings_since(now)[columns]
    is_wrong = now - table.refused_since[columns] >= _WRONG_AFTER
    return np.asarray((before == 0) | (step <= most) | is_wrong)


def _store(
    table: HostTable, readings: ReadingsReceived, columns: IntArray, good: BoolArray
) -> None:
    at, stale = columns[good], readings.stale[good]
    if not len(at):
        return
    usage, limit = readings.usage[good], readings.limit[good]
    rows = table.row_of_slot[at]
    if (rows == rows[0]).all():
        _store_alike(table, rows[0], at, usage, limit)
    else:
        used = rows >= 0
        where = np.broadcast_to(at[:, None], rows.shape)[used]
        table.usage[rows[used], where] = usage[used]
        table.set_own_limit(rows[used], where, limit[used])
    np.add(table.usage, table.load, out=table.busy)
    if stale.any():  # a stale reading excludes the host only if the resource has a limit
        stale = stale & ((limit < 1.0) * _SLOT_BITS).sum(axis=1, dtype=np.uint32)
    table.stale[at] = stale
    table.accepting[at] = readings.accepting[good]


def _store_alike(
    table: HostTable, rows: IntArray, columns: IntArray, usage: FloatArray, limit: FloatArray
) -> None:
    """Store readings of hosts that all have the same resources in the same slots (common case)."""
    for slot, row in enumerate(rows):
        if row >= 0:
            table.usage[row, columns] = usage[:, slot]
            table.set_own_limit(row, columns, limit[:, slot])
