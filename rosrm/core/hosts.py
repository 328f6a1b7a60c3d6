"""The hosts as standing arrays: one column a host, one row a resource, never rebuilt.

What placement and liveness need of a thousand hosts at once lives here; what is asked of one host
at a time (its description, its labels) lives in `Host` beside it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Final

import numpy as np
import numpy.typing as npt

from rosrm.core.events import ReadingsReceived
from rosrm.core.model import RESOURCE_SLOTS, HostDescription

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

#: A usage above this is no measurement but a mistake (a CPU reading of 1.2 can be real).
ABSURD_USAGE: Final = 64.0

_GROWTH: Final = 2


class HostCondition(IntEnum):
    """How well a host is heard."""

    UP = 0
    SUSPECT = 1
    LOST = 2
    LEFT = 3
    EXPECTED = 4  # known from the journal, not heard since this master's start


@dataclass(slots=True)
class Host:
    """What is asked of one host at a time.

    Attributes:
        column: of this host in the arrays of `HostTable`.
        instances: numbers of the instances that it holds or was promised.
        over_since: resource name to the time since when it is over its limit.
    """

    column: int
    description: HostDescription
    cordoned: bool = False
    draining: bool = False
    instances: set[int] = field(default_factory=set)
    over_since: dict[str, float] = field(default_factory=dict)
    told: dict[str, float] = field(default_factory=dict)

    @property
    def host_id(self) -> int:
        """The number under which this host reports; 0 is never given."""
        return self.column + 1

    @property
    def name(self) -> str:
        """The name of the host."""
        return self.description.name


class HostTable:
    """Every known host. Arrays are (R, H) or (H,): resources R, hosts H, in order of registration.

    Attributes:
        usage: (R, H) newest reading, fraction; 0 where a host has no such resource.
        load: (R, H) promised to instances that do not show in the readings yet, fraction.
        limit: (R, H) fraction; 1 where a host has no such resource.
        capacity: (R, H) base units; 0 where a host has no such resource.
        condition: (H,) HostCondition.
        asking: (H,) it has asked for work since it came up.
        accepting: (H,) its newest reading says that it is under all its limits.
        closed: (H,) cordoned or draining.
        stale: (H,) any reading of a limited resource is stale.
        heard: (H,) time of the newest message.
        processes, max_processes: (H,) held or promised; bound (0: none).
        version: grows with every change that touches many hosts.
        touched: columns that single assignments have changed since `version` grew.
    """

    def __init__(self) -> None:
        self.resources: tuple[str, ...] = ()
        self.by_name: dict[str, Host] = {}
        self.hosts: list[Host] = []
        self.version = 0
        self.touched: list[int] = []
        self._allocate(rows=0, columns=4)

    # --- shape ---------------------------------------------------------------------------

    def _allocate(self, rows: int, columns: int) -> None:
        self._usage = np.zeros((rows, columns))
        self._load = np.zeros((rows, columns))
        self._limit = np.ones((rows, columns))
        self._capacity = np.zeros((rows, columns))
        self._condition = np.zeros(columns, np.int8)
        self._asking = np.zeros(columns, np.bool_)
        self._accepting = np.zeros(columns, np.bool_)
        self._closed = np.zeros(columns, np.bool_)
        self._stale = np.zeros(columns, np.uint32)
        self._heard = np.zeros(columns)
        self._processes = np.zeros(columns, np.int64)
        self._max_processes = np.zeros(columns, np.int64)
        self._incarnation = np.zeros(columns, np.uint64)
        self._sequence = np.zeros(columns, np.uint64)
        self._reported = np.zeros(columns, np.uint64)
        self._status_sequence = np.zeros(columns, np.uint64)
        # Slot of a message -> row here; the row past the last is a bin for slots not in use.
        self._row_of_slot = np.full((columns, RESOURCE_SLOTS), -1, np.int64)

    def _grow_columns(self) -> None:
        old = dict(self.__dict__)
        columns = len(self._condition) * _GROWTH
        used = len(self.hosts)
        self._allocate(len(self.resources), columns)
        for name in _ARRAYS:
            fresh, kept = getattr(self, name), old[name]
            if name in _BY_RESOURCE:
                fresh[:, :used] = kept[:, :used]
            else:
                fresh[:used] = kept[:used]

    def _add_resource(self, name: str) -> None:
        self.resources = (*self.resources, name)
        for array, fill in (("_usage", 0.0), ("_load", 0.0), ("_limit", 1.0), ("_capacity", 0.0)):
            kept: FloatArray = getattr(self, array)
            row = np.full((1, kept.shape[1]), fill)
            setattr(self, array, np.concatenate([kept, row]))

    def __len__(self) -> int:
        return len(self.hosts)

    @property
    def usage(self) -> FloatArray:
        return self._usage[:, : len(self.hosts)]

    @property
    def load(self) -> FloatArray:
        return self._load[:, : len(self.hosts)]

    @property
    def limit(self) -> FloatArray:
        return self._limit[:, : len(self.hosts)]

    @property
    def capacity(self) -> FloatArray:
        return self._capacity[:, : len(self.hosts)]

    @property
    def condition(self) -> npt.NDArray[np.int8]:
        return self._condition[: len(self.hosts)]

    @property
    def heard(self) -> FloatArray:
        return self._heard[: len(self.hosts)]

    @property
    def processes(self) -> npt.NDArray[np.int64]:
        return self._processes[: len(self.hosts)]

    # --- registration --------------------------------------------------------------------

    def expect(self, name: str, *, cordoned: bool = False) -> Host:
        """Give a host its column before it is heard, so that its number stays across restarts."""
        if len(self.hosts) == len(self._condition):
            self._grow_columns()
        host = Host(len(self.hosts), HostDescription(name, 0), cordoned=cordoned)
        self.hosts.append(host)
        self.by_name[name] = host
        self._condition[host.column] = HostCondition.EXPECTED
        self._closed[host.column] = cordoned
        return host

    def register(self, description: HostDescription, now: float) -> Host:
        """Take in a host, or a new run of a known one; its readings are still to come."""
        host = self.by_name.get(description.name) or self.expect(description.name)
        column = host.column
        host.description = description
        host.over_since.clear()
        for resource in description.resources:
            if resource.name not in self.resources:
                self._add_resource(resource.name)
        rows = [self.resources.index(resource.name) for resource in description.resources]
        self._row_of_slot[column] = -1
        self._row_of_slot[column, : len(rows)] = rows
        self._capacity[:, column] = 0.0
        self._capacity[rows, column] = [resource.capacity for resource in description.resources]
        self._usage[:, column] = 0.0
        self._limit[:, column] = 1.0
        self._condition[column] = HostCondition.UP
        self._asking[column] = self._accepting[column] = False
        self._stale[column] = 0
        self._heard[column] = now
        self._max_processes[column] = description.max_processes
        self._incarnation[column] = description.incarnation
        self._sequence[column] = self._reported[column] = self._status_sequence[column] = 0
        self.changed()
        return host

    def find(self, host_id: int, incarnation: int) -> Host | None:
        """The host of this number, if it is this run of it."""
        column = host_id - 1
        if not 0 <= column < len(self.hosts) or int(self._incarnation[column]) != incarnation:
            return None
        return self.hosts[column]

    # --- what changes --------------------------------------------------------------------

    def changed(self) -> None:
        """Many hosts changed: rankings made before are void."""
        self.version += 1
        self.touched.clear()

    def apply(self, readings: ReadingsReceived, now: float) -> BoolArray:
        """Take in a batch of readings.

        Returns:
            (N,) True where a reading was refused: an unknown or former host, NaN, a negative or
            absurd value. Nothing of a refused reading is used.
        """
        columns = readings.host_id - 1
        known = (columns >= 0) & (columns < len(self.hosts))
        safe = np.where(known, columns, 0)
        known &= self._incarnation[safe] == readings.incarnation
        sane = (
            (readings.usage >= 0.0) & (readings.usage <= ABSURD_USAGE)
            & (readings.limit >= 0.0) & (readings.limit <= 1.0)
        ).all(axis=1)  # fmt: skip
        good = known & sane
        self._store(readings, columns, good, now)
        return np.asarray(~good)

    def _store(
        self, readings: ReadingsReceived, columns: npt.NDArray[np.int64], good: BoolArray, now: float
    ) -> None:
        rows_used = columns[good]
        rows = self._row_of_slot[rows_used]
        used = rows >= 0
        where = np.broadcast_to(rows_used[:, None], rows.shape)[used]
        self._usage[rows[used], where] = readings.usage[good][used]
        self._limit[rows[used], where] = readings.limit[good][used]
        self._stale[rows_used] = readings.stale[good]
        self._accepting[rows_used] = readings.accepting[good]
        self._sequence[rows_used] = readings.sequence[good]
        self._reported[rows_used] = readings.status_sequence[good]
        self._heard[rows_used] = now
        self.changed()

    def ask(self, host: Host) -> None:
        """The host asked for work; a request also says that it is under its limits."""
        column = host.column
        if not (self._asking[column] and self._accepting[column]):
            self._asking[column] = self._accepting[column] = True
            self.changed()

    def set_condition(self, host: Host, condition: HostCondition) -> None:
        self._condition[host.column] = condition
        if condition is HostCondition.LEFT:
            self._asking[host.column] = False
        self.changed()

    def condition_of(self, host: Host) -> HostCondition:
        return HostCondition(int(self._condition[host.column]))

    def set_closed(self, host: Host, *, cordoned: bool, draining: bool) -> None:
        """Cordon, drain or reopen a host."""
        host.cordoned, host.draining = cordoned, draining
        self._closed[host.column] = cordoned or draining
        self.changed()

    def charge(self, host: Host, amount: FloatArray, processes: int = 0) -> None:
        """Add to (or, negative, take from) the in-flight load and process count of one host.

        Args:
            amount: (R',) fractions, R' at most the resources known now.
        """
        column = host.column
        load = self._load[: len(amount), column]
        np.maximum(load + amount, 0.0, out=load)
        self._processes[column] += processes
        self.touched.append(column)

    # --- what is asked -------------------------------------------------------------------

    def fractions(self, amounts: Mapping[str, float]) -> FloatArray:
        """(R, H): base-unit amounts as fractions of each host's capacity; inf where it has none."""
        need = np.zeros((len(self.resources), len(self.hosts)))
        for name, amount in amounts.items():
            if amount > 0.0 and name in self.resources:
                row = self.resources.index(name)
                with np.errstate(divide="ignore"):
                    need[row] = amount / self._capacity[row, : len(self.hosts)]
        return need

    def fractions_of(self, host: Host, amounts: Mapping[str, float]) -> FloatArray:
        """(R,): as `fractions`, for one host."""
        need = np.zeros(len(self.resources))
        for row, name in enumerate(self.resources):
            amount = amounts.get(name, 0.0)
            if amount > 0.0:
                capacity = self._capacity[row, host.column]
                need[row] = amount / capacity if capacity > 0.0 else np.inf
        return need

    def taking(self) -> BoolArray:
        """(H,) True: may be given work now, its room aside."""
        used = slice(0, len(self.hosts))
        slots = (self._max_processes[used] == 0) | (
            self._processes[used] < self._max_processes[used]
        )
        return np.asarray(
            (self._condition[used] == HostCondition.UP)
            & self._asking[used] & self._accepting[used]
            & ~self._closed[used] & (self._stale[used] == 0) & slots
        )  # fmt: skip

    def takes(self, column: int) -> bool:
        """As `taking`, for one host."""
        return self.why_closed(column) == ""

    def why_closed(self, column: int) -> str:
        """Why a host may not be given work now, its room aside; "" if it may."""
        host = self.hosts[column]
        condition = self.condition_of(host)
        if condition is not HostCondition.UP:
            return _CONDITION_REASON[condition]
        if host.draining or host.cordoned:
            return "it is being drained" if host.draining else "it is cordoned"
        if self._max_processes[column] and self._processes[column] >= self._max_processes[column]:
            return f"it holds its most processes, {self._max_processes[column]}"
        if self._stale[column]:
            return f"its reading of {', '.join(self.stale_resources(column))} is stale"
        if not self._accepting[column]:
            over = self.over_limit(column)
            return f"it is over its limit of {', '.join(over)}" if over else "it takes no work now"
        if not self._asking[column]:
            return "it has not asked for work yet"
        return ""

    def stale_resources(self, column: int) -> Sequence[str]:
        """Names of the resources of a host whose reading is stale."""
        described = self.hosts[column].description.resources
        bits = int(self._stale[column])
        return [resource.name for slot, resource in enumerate(described) if bits >> slot & 1]

    def over_limit(self, column: int) -> list[str]:
        """Names of the resources whose reading is at or over the limit of a host."""
        over = (self._usage[:, column] >= self._limit[:, column]) & (self._capacity[:, column] > 0)
        return [self.resources[row] for row in np.flatnonzero(over)]

    def hosts_over_limit(self) -> npt.NDArray[np.int64]:
        """Columns of the hosts that are up and at or over any limit."""
        used = slice(0, len(self.hosts))
        over = (self.usage >= self.limit) & (self.capacity > 0)
        return np.flatnonzero(over.any(axis=0) & (self._condition[used] == HostCondition.UP))

    def statuses_missing(self) -> npt.NDArray[np.int64]:
        """Columns of hosts that say they sent statuses which have not come."""
        used = slice(0, len(self.hosts))
        behind = self._reported[used] > self._status_sequence[used]
        return np.flatnonzero(behind & (self._condition[used] == HostCondition.UP))

    def note_statuses(self, host: Host, sequence: int, now: float) -> bool:
        """Take note of a status batch; False: one before it was missed."""
        expected = int(self._status_sequence[host.column]) + 1
        self._status_sequence[host.column] = max(sequence, expected - 1)
        self._heard[host.column] = now
        return sequence <= expected

    def is_accepting(self, host: Host) -> bool:
        """Under all its limits, and it has asked."""
        return bool(self._accepting[host.column] and self._asking[host.column])


_CONDITION_REASON: Final = {
    HostCondition.SUSPECT: "it has been silent for a moment",
    HostCondition.LOST: "it is lost",
    HostCondition.LEFT: "it has left",
    HostCondition.EXPECTED: "it has not come back since the master started",
}

_BY_RESOURCE: Final = ("_usage", "_load", "_limit", "_capacity")
_ARRAYS: Final = (
    *_BY_RESOURCE, "_condition", "_asking", "_accepting", "_closed", "_stale", "_heard",
    "_processes", "_max_processes", "_incarnation", "_sequence", "_reported", "_status_sequence",
    "_row_of_slot",
)  # fmt: skip
