"""Decoder of `resource_info`: one numpy call decodes a thousand messages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from rosrm.core.master.events import ReadingsReceived
from rosrm.model.values import RESOURCE_SLOTS
from rosrm.ros.reading_codec import ACCEPTING, QUIET_SHIFT
from rosrm.version import PROTOCOL_VERSION

#: Layout of a message. The counts `usages` and `limits` are `RESOURCE_SLOTS`.
LAYOUT: Final = np.dtype(
    [
        ("header", "S4"),
        ("protocol_version", "<u2"), ("flags", "<u2"), ("host_id", "<u4"),
        ("incarnation", "<u8"), ("sequence", "<u8"), ("beat", "<u8"), ("master_beat", "<u8"),
        ("status_sequence", "<u8"),
        ("processes", "<u4"), ("present", "<u4"), ("stale", "<u4"),
        ("usages", "<u4"), ("usage", "<f4", (RESOURCE_SLOTS,)),
        ("limits", "<u4"), ("limit", "<f4", (RESOURCE_SLOTS,)),
    ]
)  # fmt: skip
#: The same without fields, because numpy copies rows with fields one field at a time.
_ROW: Final = np.dtype((np.void, LAYOUT.itemsize))


@dataclass(frozen=True, slots=True)
class Runs:
    """Accounts of each run of a slave in a batch, in parallel arrays (R,).

    Attributes:
        host_id, incarnation: identify the run.
        first: sequence of the earliest cycle in its messages.
        sequence, beat: of its newest message; the beat in ns.
        cycles: of the slave, that its messages in this batch account for.
    """

    host_id: npt.NDArray[np.int64]
    incarnation: npt.NDArray[np.uint64]
    first: npt.NDArray[np.int64]
    sequence: npt.NDArray[np.int64]
    beat: npt.NDArray[np.uint64]
    cycles: npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Decoded:
    """A batch of messages.

    Attributes:
        readings: the newest of each run of a host; None: the batch has none.
        runs: parallel to the readings, row by row.
        refusals: one line for each kind of refused message.
        received: messages of this protocol version.
    """

    readings: ReadingsReceived | None = None
    runs: Runs | None = None
    refusals: tuple[str, ...] = ()
    received: int = 0


def decode(messages: Sequence[bytes]) -> Decoded:
    """Decode serialised messages, oldest first.

    Messages of another size, byte order or protocol version are refused, never misread.
    """
    fit = [raw for raw in messages if len(raw) == LAYOUT.itemsize and raw[1] == 1]
    rows = np.frombuffer(b"".join(fit), LAYOUT)
    right = (rows["usages"] == RESOURCE_SLOTS) & (rows["limits"] == RESOURCE_SLOTS)
    if not right.all():
        rows = rows[right]
    refusals = []
    if len(rows) < len(messages):
        refusals.append("a resource_info of another size than ours: another version of rosrm?")
    if not len(rows):
        return Decoded(refusals=tuple(refusals))
    ours = rows["protocol_version"] == PROTOCOL_VERSION
    if not ours.all():
        refusals += [
            f"a resource_info of protocol version {version}; this side speaks {PROTOCOL_VERSION}"
            for version in np.unique(rows["protocol_version"][~ours])
        ]
        rows = rows[ours]
        if not len(rows):
            return Decoded(refusals=tuple(refusals))
    order, begins, ends = _by_run(rows)
    newest = rows.view(_ROW)[order[ends]].view(LAYOUT)
    runs = _runs(rows, order, begins, newest)
    return Decoded(_event(newest), runs, tuple(refusals), len(rows))


def _by_run(
    rows: npt.NDArray[np.void],
) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Group rows by run, so that a former run's late messages do not hide the present run's.

    Returns:
        The order of the rows by run of a slave, oldest first in each. The positions in this order
        of the first and of the last row of each run.
    """
    run = rows["host_id"].astype(np.uint64) << np.uint64(32)
    run |= rows["incarnation"] & np.uint64(0xFFFFFFFF)
    order = run.argsort(kind="stable")
    run = run[order]
    is_bound = np.ones(len(rows) + 1, np.bool_)
    is_bound[1:-1] = run[1:] != run[:-1]
    return order, is_bound[:-1].nonzero()[0], is_bound[1:].nonzero()[0]


def _runs(
    rows: npt.NDArray[np.void], order: npt.NDArray[np.intp], begins: npt.NDArray[np.intp],
    newest: npt.NDArray[np.void],
) -> Runs:  # fmt: skip
    sequence = rows["sequence"][order].astype(np.int64)
    spans = (rows["flags"][order] >> QUIET_SHIFT).astype(np.int64) + 1
    return Runs(
        host_id=newest["host_id"].astype(np.int64),
        incarnation=newest["incarnation"].copy(),
        first=sequence[begins] - spans[begins] + 1,
        sequence=newest["sequence"].astype(np.int64),
        beat=newest["beat"].copy(),
        cycles=np.add.reduceat(spans, begins),
    )


def _event(rows: npt.NDArray[np.void]) -> ReadingsReceived:
    return ReadingsReceived(
        host_id=rows["host_id"].astype(np.int64),
        incarnation=rows["incarnation"].astype(np.uint64),
        sequence=rows["sequence"].astype(np.uint64),
        status_sequence=rows["status_sequence"].astype(np.uint64),
        accepting=(rows["flags"] & ACCEPTING).astype(np.bool_),
        stale=rows["stale"].astype(np.uint32),
        usage=rows["usage"].astype(np.float64),
        limit=rows["limit"].astype(np.float64),
    )
