"""Storage of readings: a batch of a thousand hosts in a few numpy calls."""

from __future__ import annotations

from typing import Final

import numpy as np

from rosrm.core.master.events import ReadingsReceived
from rosrm.core.master.state.host_arrays import BoolArray, FloatArray, IntArray
from rosrm.core.master.state.hosts import HostTable
from rosrm.model.values import ABSURD_USAGE, RESOURCE_SLOTS

_SLOT_BITS: Final = np.left_shift(np.uint32(1), np.arange(RESOURCE_SLOTS, dtype=np.uint32))


def take_readings(table: HostTable, readings: ReadingsReceived, now: float) -> BoolArray:
    """Store a batch of readings.

    A reading older than the stored one arrived late and is dropped. An invalid reading is dropped
    too, but it renews the last contact of its host and makes the host's stored reading stale.

    Returns:
        (N,) True where a reading was refused: unknown host, former run of its slave, or a value
        that is NaN, negative or above `ABSURD_USAGE`.
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
    if known.any():
        fresh = known & (readings.sequence >= table.sequence[at])
        table.last_contact[at[fresh]] = now
        table.stale[at[fresh & ~sane]] = _SLOT_BITS.sum()
        _store(table, readings, at, fresh & sane)
        table.changed()
    return np.asarray(~(known & sane))


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
        table.limit[rows[used], where] = limit[used]
    np.add(table.usage, table.load, out=table.busy)
    if stale.any():  # a stale reading excludes the host only if the resource has a limit
        stale = stale & ((limit < 1.0) * _SLOT_BITS).sum(axis=1, dtype=np.uint32)
    table.stale[at] = stale
    table.accepting[at] = readings.accepting[good]
    table.sequence[at] = readings.sequence[good]
    table.reported[at] = readings.status_sequence[good]


def _store_alike(
    table: HostTable, rows: IntArray, columns: IntArray, usage: FloatArray, limit: FloatArray
) -> None:
    """Store readings of hosts that all have the same resources in the same slots (common case)."""
    for slot, row in enumerate(rows):
        if row >= 0:
            table.usage[row, columns] = usage[:, slot]
            table.limit[row, columns] = limit[:, slot]
