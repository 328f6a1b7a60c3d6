"""Arrays of the values of all hosts: one column per host, one row per resource.

The arrays grow by doubling and are never rebuilt. They are planes of one block of memory, so that
the values of a few hosts are copied in one step.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from rosrm.model.values import RESOURCE_SLOTS

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]

#: Planes of the block, and their values for a host that has no such resource.
USAGE, LOAD, LIMIT, CAPACITY, BUSY, OWN_LIMIT = range(6)
_ABSENT: Final = (np.nan, 0.0, 1.0, np.nan, np.nan, 1.0)

#: Added to the score for each process of a host: of equal scores, the host with fewer processes is
#: picked, then the one that registered first.
TIE: Final = 1e-9
#: Number of processes that means "no bound".
NO_BOUND: Final = 2**62


class HostColumns:
    """Arrays are (R, H) or (H,): resources R, hosts H, in order of registration.

    Attributes:
        resources: names of the rows.
        usage: (R, H) newest reading, fraction; NaN where a host has no such resource.
        load: (R, H) reservations of instances that the readings do not show yet, fraction.
        own_limit: (R, H) fraction by the host's settings; 1 where it has no such resource.
        limit: (R, H) fraction in force: `own_limit`, or the ceiling of the resource, if lower.
        ceilings: resource to the highest limit that any host may have.
        capacity: (R, H) base units; NaN where a host has no such resource.
        busy: (R, H) usage + load.
        condition: (H,) HostCondition.
        asking: (H,) the host has requested work since its registration.
        accepting: (H,) the host is under all its limits, by its newest reading.
        closed: (H,) cordoned or draining.
        report_due: (H,) the host was lost or did not answer an assignment, and has not reported
            its instances since.
        stale: (H,) bit i: the reading of slot i, which has a limit, is stale.
        last_contact: (H,) time of the newest message.
        read_at: (H,) time of the newest reading, or of the registration.
        registered: (H,) time of the registration.
        period: (H,) seconds between two readings.
        processes: (H,) number of processes on the host or reserved for it.
        ties: (H,) `TIE` times `processes`.
        bound: (H,) highest number of processes.
        incarnation: (H,) incarnation of the slave.
        sequence: (H,) sequence of the newest reading.
        reported: (H,) sequence of the newest status batch that the slave has sent.
        status_sequence: (H,) sequence of the newest status batch that has arrived.
        refused_since: (H,) time since when every reading is out of order; inf: the last was not.
        row_of_slot: (H, RESOURCE_SLOTS) slot of a message -> row here; -1: not in use.
    """

    def __init__(self) -> None:
        self.resources: tuple[str, ...] = ()
        self.ceilings: Mapping[str, float] = {}
        self._columns_in_use = 0
        self._allocate(rows=0, columns=4)
        self._trim()

    def __len__(self) -> int:
        return self._columns_in_use

    def _allocate(self, rows: int, columns: int) -> None:
        self._cells = np.empty((len(_ABSENT), rows, columns))
        self._cells[:] = np.reshape(_ABSENT, (-1, 1, 1))
        self._lines: dict[str, Any] = {
            "condition": np.zeros(columns, np.int8),
            "asking": np.zeros(columns, np.bool_),
            "accepting": np.zeros(columns, np.bool_),
            "closed": np.zeros(columns, np.bool_),
            "report_due": np.zeros(columns, np.bool_),
            "stale": np.zeros(columns, np.uint32),
            "last_contact": np.zeros(columns),
            "read_at": np.zeros(columns),
            "registered": np.full(columns, -np.inf),
            "period": np.zeros(columns),
            "processes": np.zeros(columns, np.int64),
            "ties": np.zeros(columns),
            "bound": np.full(columns, NO_BOUND, np.int64),
            "incarnation": np.zeros(columns, np.uint64),
            "sequence": np.zeros(columns, np.uint64),
            "reported": np.zeros(columns, np.uint64),
            "status_sequence": np.zeros(columns, np.uint64),
            "refused_since": np.full(columns, np.inf),
            "row_of_slot": np.full((columns, RESOURCE_SLOTS), -1, np.int64),
        }

    def add_column(self) -> int:
        """Add a column for one more host, and return it."""
        if self._columns_in_use == self._cells.shape[2]:
            cells, lines = self._cells, self._lines
            self._allocate(len(self.resources), 2 * self._columns_in_use)
            self._cells[:, :, : self._columns_in_use] = cells
            for name, line in lines.items():
                self._lines[name][: self._columns_in_use] = line
        self._columns_in_use += 1
        self._trim()
        return self._columns_in_use - 1

    def add_resource(self, name: str) -> None:
        """Add a row; no host has this resource yet."""
        self.resources = (*self.resources, name)
        row = np.empty((len(_ABSENT), 1, self._cells.shape[2]))
        row[:] = np.reshape(_ABSENT, (-1, 1, 1))
        self._cells = np.concatenate([self._cells, row], axis=1)
        self._trim()

    def set_own_limit(self, rows: IntArray | int, columns: IntArray, limits: FloatArray) -> None:
        """Set limits by the settings of hosts; the ceilings stay in force."""
        self.own_limit[rows, columns] = limits
        self.limit[rows, columns] = limits
        if self.ceilings:
            self.apply_ceilings(columns)

    def apply_ceilings(self, columns: IntArray | slice) -> None:
        """Set the limits of hosts that are in force from their own limits and the ceilings."""
        for row, name in enumerate(self.resources):
            own = self.own_limit[row, columns]
            ceiling = self.ceilings.get(name, 1.0)
            has_it = ~np.isnan(self.capacity[row, columns])
            self.limit[row, columns] = np.where(has_it, np.minimum(own, ceiling), own)

    def _trim(self) -> None:
        """Set the arrays as views of the columns in use; called only when the shape changes."""
        self.cells: FloatArray = self._cells[:, :, : self._columns_in_use]
        self.usage: FloatArray = self.cells[USAGE]
        self.load: FloatArray = self.cells[LOAD]
        self.limit: FloatArray = self.cells[LIMIT]
        self.capacity: FloatArray = self.cells[CAPACITY]
        self.busy: FloatArray = self.cells[BUSY]
        self.own_limit: FloatArray = self.cells[OWN_LIMIT]
        used = {name: line[: self._columns_in_use] for name, line in self._lines.items()}
        self.condition: npt.NDArray[np.int8] = used["condition"]
        self.asking: BoolArray = used["asking"]
        self.accepting: BoolArray = used["accepting"]
        self.closed: BoolArray = used["closed"]
        self.report_due: BoolArray = used["report_due"]
        self.stale: npt.NDArray[np.uint32] = used["stale"]
        self.last_contact: FloatArray = used["last_contact"]
        self.read_at: FloatArray = used["read_at"]
        self.registered: FloatArray = used["registered"]
        self.period: FloatArray = used["period"]
        self.processes: IntArray = used["processes"]
        self.ties: FloatArray = used["ties"]
        self.bound: IntArray = used["bound"]
        self.incarnation: npt.NDArray[np.uint64] = used["incarnation"]
        self.sequence: npt.NDArray[np.uint64] = used["sequence"]
        self.reported: npt.NDArray[np.uint64] = used["reported"]
        self.status_sequence: npt.NDArray[np.uint64] = used["status_sequence"]
        self.refused_since: FloatArray = used["refused_since"]
        self.row_of_slot: IntArray = used["row_of_slot"]

    def set_processes(self, column: int, processes: int) -> None:
        """Set the number of processes of a host."""
        self.processes[column], self.ties[column] = processes, TIE * processes

    def clear_column(self, column: int) -> None:
        """Clear a column before its host registers its resources again; reservations stay."""
        for plane in (USAGE, LIMIT, CAPACITY, BUSY, OWN_LIMIT):
            self.cells[plane, :, column] = _ABSENT[plane]
        self.row_of_slot[column] = -1
