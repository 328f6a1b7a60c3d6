"""Table of hosts: descriptions, readings, reservations, conditions.

`host_arrays.py` holds the values that placement and liveness need of a thousand hosts at once. The
values of single hosts (description, labels) are in `Host`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import Final, Literal, NamedTuple

import numpy as np

from rosrm.core.master.state.devices import DeviceTable, Inventory
from rosrm.core.master.state.host_arrays import (
    BUSY,
    LOAD,
    NO_BOUND,
    USAGE,
    BoolArray,
    FloatArray,
    HostColumns,
    IntArray,
)
from rosrm.core.master.state.links import LinkTable
from rosrm.extensions.plugin_calls import Failing, Plugin
from rosrm.model.devices import Device, HeldDevice
from rosrm.model.values import EMPTY, HostDescription, InstanceId, ProcessSpec

#: An estimated need counts as at most this share of a host's limit. Otherwise an estimate alone
#: could exclude a process from every host. Declared needs have no such bound.
_MOST_GUESSED: Final = 0.5
#: Largest step from one sequence of a host to the next, beyond the cycles that fit into the time
#: since; a larger step is an error or a forgery.
MOST_AHEAD: Final = 1000

#: Shortest period, in seconds, that counts between two readings of a host.
_SHORTEST_PERIOD: Final = 0.01
#: Fields of a description that may change while the slave runs.
CHANGEABLE: Final = ("labels", "resources", "absent", "launchers")


class HostCondition(IntEnum):
    """Liveness of a host; from LOST on, it is away until it registers or rejoins."""

    UP = 0
    SUSPECT = 1
    EXPECTED = 2  # known from the journal, no contact since this master's start
    LOST = 3
    LEFT = 4
    DETACHED = 5  # its slave was stopped and left processes running

    def words(self, *only: HostCondition) -> str:
        """Return a predicate for the condition; "" for UP and conditions not in `only`."""
        return _WORDS.get(self, "") if self in (only or _WORDS) else ""


_WORDS: Final[Mapping[HostCondition, str]] = {
    HostCondition.SUSPECT: "is suspect: its reports are late",
    HostCondition.LOST: "is lost",
    HostCondition.LEFT: "has left",
    HostCondition.DETACHED: "is detached: its slave was stopped and left processes running",
    HostCondition.EXPECTED: "has not reported since the master started",
}


@dataclass(slots=True, eq=False)
class Host:
    """One host: the values that are read for single hosts.

    Attributes:
        column: column of this host in the arrays of `HostTable`.
        has_labels: its labels are known, from its slave or from the journal.
        attributed, shared: resources with this accounting on the host.
        instances: number of each instance that runs on the host or is assigned to it, to the name
            and the spec of its process.
        exceeded_since: resource name to the time since when the host is over this limit.
        over_since: the same, or the later time of the last move off the host.
        over_at: resource name to the time of the last reading over the limit, from the record
            `over_limit` to the record `under_limit`.
        unreached: an assignment to it was given up without an answer, and it has not reported all
            of its instances since: orders may not arrive there, although its messages do.
        drained: the host is draining, and no process that can leave is left on it.
        pruned: the host is left out of listings until it registers.
        recorded_at: kind of a record to its last time, for records that are not repeated at once.
        blocked: cause of an eviction to the last recorded reason why no process could leave.
        left_since: for a host that left or is detached: time at which its slave reported its stop.
        detached_since: for a detached host: time at which its slave was stopped.
        lost_since: for a lost host: time of the loss; for a detached host: end of its lease.
        failing: kind and name of each failing plugin to its failure, as the slave reports. A probe
            has the name of its resource.
    """

    column: int
    name: str
    description: HostDescription
    has_labels: bool = False
    cordoned: bool = False
    draining: bool = False
    drained: bool = False
    unreached: bool = False
    pruned: bool = False
    attributed: frozenset[str] = frozenset()
    shared: frozenset[str] = frozenset()
    instances: dict[int, tuple[str, ProcessSpec]] = field(default_factory=dict)
    exceeded_since: dict[str, float] = field(default_factory=dict)
    over_since: dict[str, float] = field(default_factory=dict)
    over_at: dict[str, float] = field(default_factory=dict)
    recorded_at: dict[str, float] = field(default_factory=dict)
    blocked: dict[str, str] = field(default_factory=dict)
    left_since: float = 0.0
    detached_since: float = 0.0
    lost_since: float = 0.0
    failing: dict[Plugin, Failing] = field(default_factory=dict)

    @property
    def host_id(self) -> int:
        """Return the number under which this host reports; 0 is never used."""
        return self.column + 1

    def enforces(self, settings: tuple[str, ...], cpus: tuple[int, ...]) -> bool:
        """Return True if the host can enforce these settings, and is not known to lack a CPU."""
        own = self.description
        return own.unenforced.keys().isdisjoint(settings) and not (
            own.cpus and set(cpus).difference(own.cpus)
        )


class SavedColumn(NamedTuple):
    """Values that reservations on one host change."""

    column: int
    cells: FloatArray
    processes: int
    devices: Inventory


class HostTable(HostColumns):
    """All known hosts.

    Attributes:
        version: counter of changes that concern many hosts.
        version_without_readings: the same, without the changes by readings.
        newest_registration: time of the newest registration; -inf: none.
        links: measured links between hosts, and the flows across them.
        claims: column of a host on which room is made for a process -> priority of the process.
        noted_over: columns of the hosts whose `over_at` or `over_since` has times.
        touched: columns that assignments and ends have changed since `version` grew.
        devices: devices of each host, and the instances that hold them.
    """

    def __init__(self) -> None:
        super().__init__()
        self.by_name: dict[str, Host] = {}
        self.hosts: list[Host] = []
        self.links = LinkTable()
        self.version = self.version_without_readings = 0
        self.newest_registration = -np.inf
        self.touched: list[int] = []
        self.noted_over: set[int] = set()
        self.devices = DeviceTable()
        self.claims: dict[int, int] = {}
        self._labelled: dict[tuple[str, str | None], BoolArray] = {}
        self._launching: dict[str, BoolArray] = {}
        self._enforcing: dict[tuple[tuple[str, ...], tuple[int, ...]], BoolArray] = {}
        self._listed: list[Host] | None = None

    # --- registration --------------------------------------------------------------------

    def expect(
        self, name: str, now: float = 0.0, *, cordoned: bool = False, draining: bool = False,
        labels: Mapping[str, str] | None = None,
    ) -> Host:  # fmt: skip
        """Add a host before its first contact, so that its number stays across restarts.

        `labels`: those that the host had before the restart; None: unknown.
        """
        described = HostDescription(name, 0, labels=labels or EMPTY)
        host = Host(self.add_column(), name, described, labels is not None)
        self.hosts.append(host)
        self.devices.add_column()
        self.by_name[name] = host
        self._listed = None
        self.last_contact[host.column] = now
        self.condition[host.column] = HostCondition.EXPECTED
        self.set_closed(host, cordoned=cordoned, draining=draining)
        return host

    def register(self, description: HostDescription, now: float) -> Host:
        """Register a host, or the new run of a known host's slave, without readings yet."""
        host = self.by_name.get(description.name) or self.expect(description.name)
        column = host.column
        host.description, host.has_labels, host.pruned = description, True, False
        self._listed = None
        self._set_resources(host)
        self.condition[column] = HostCondition.UP
        self.asking[column] = self.report_due[column] = False
        self.last_contact[column] = self.registered[column] = self.newest_registration = now
        self.bound[column] = description.max_processes or NO_BOUND
        self.period[column], self.read_at[column] = description.period, now
        self.incarnation[column] = description.incarnation
        self.sequence[column] = self.reported[column] = self.status_sequence[column] = 0
        self.refused_since[column] = np.inf
        self.links.forget(column)
        self._labelled.clear()
        self._enforcing.clear()
        self._launching.clear()
        self.set_devices(host, description.devices)
        return host

    def _set_resources(self, host: Host) -> None:
        """Take over the resources of a host, without readings yet."""
        column, described = host.column, host.description.resources
        host.attributed = host.description.accounted("attributed")
        host.shared = host.description.accounted("shared")
        for known in (host.exceeded_since, host.over_since, host.over_at):
            known.clear()
        for resource in described:
            if resource.name not in self.resources:
                self.add_resource(resource.name)
        rows = [self.resources.index(resource.name) for resource in described]
        self.clear_column(column)
        self.row_of_slot[column, : len(rows)] = rows
        self.capacity[rows, column] = [resource.capacity for resource in described]
        self.usage[rows, column] = 0.0
        self.busy[rows, column] = self.load[rows, column]
        self.accepting[column] = False
        self.stale[column] = 0

    def redescribe(self, host: Host, description: HostDescription) -> tuple[str, ...]:
        """Take over what a slave may change while it runs; return the names of what has changed."""
        new = {name: getattr(description, name) for name in CHANGEABLE}
        changed = tuple(
            name for name, value in new.items() if value != getattr(host.description, name)
        )
        if changed:
            host.description = replace(host.description, **new)
            if "resources" in changed:
                self._set_resources(host)
            self._labelled.clear()
            self._launching.clear()
            self.changed()
        return changed

    def prune(self, host: Host) -> None:
        """Remove a host from every listing; its slave may register it later as a new host."""
        host.pruned, host.description = True, HostDescription(host.name, 0)
        host.has_labels = False
        self._listed = None
        limits = host.exceeded_since, host.over_since, host.over_at
        for known in (*limits, host.recorded_at, host.blocked, host.failing):
            known.clear()
        self.incarnation[host.column] = 0
        self.links.forget(host.column)
        self._labelled.clear()
        self._enforcing.clear()
        self._launching.clear()
        self.set_devices(host, ())
        self.set_closed(host, cordoned=False, draining=False)
        self.set_condition(host, HostCondition.LEFT)

    def find(self, host_id: int, incarnation: int) -> Host | None:
        """Return the host with this number and incarnation; None: there is none."""
        column = host_id - 1
        if not 0 <= column < len(self.hosts) or int(self.incarnation[column]) != incarnation:
            return None
        return self.hosts[column]

    def up(self, name: str) -> Host | None:
        """Return the host of a name if it is up."""
        host = self.by_name.get(name)
        return host if host and self.condition_of(host) is HostCondition.UP else None

    def listed(self) -> Sequence[Host]:
        """Return every host that was not pruned; cached, because each decision reads the list."""
        if self._listed is None:
            self._listed = [host for host in self.hosts if not host.pruned]
        return self._listed

    def labelled(self, key: str, value: str | None) -> BoolArray:
        """Return the mask, (H,), of hosts with this label; cached until a host registers.

        `value` None: the hosts without any label of this key.
        """
        known = self._labelled.get((key, value))
        if known is None or len(known) != len(self):
            found = [host.description.labels.get(key) == value for host in self.hosts]
            known = self._labelled[key, value] = np.array(found, np.bool_)
        return known

    def with_unknown_label(self, names: Iterable[str]) -> str:
        """Return the first of some hosts whose labels are not known; "": all are known."""
        hosts = (self.by_name.get(name) for name in names)
        return next((one.name for one in hosts if one and not (one.has_labels or one.pruned)), "")

    def enforcing(self, settings: tuple[str, ...], cpus: tuple[int, ...]) -> BoolArray:
        """Return the mask, (H,), of hosts that can enforce these settings and have these CPUs.

        Cached until a host registers.
        """
        known = self._enforcing.get((settings, cpus))
        if known is None or len(known) != len(self):
            found = [host.enforces(settings, cpus) for host in self.hosts]
            known = self._enforcing[settings, cpus] = np.array(found, np.bool_)
        return known

    def launching(self, launcher: str) -> BoolArray:
        """Return the mask, (H,), of hosts that offer a launcher; cached until a host registers."""
        known = self._launching.get(launcher)
        if known is None or len(known) != len(self):
            found = [launcher in host.description.launchers for host in self.hosts]
            known = self._launching[launcher] = np.array(found, np.bool_)
        return known

    # --- changes -------------------------------------------------------------------------

    def changed(self) -> None:
        """Note that many hosts have changed, which makes earlier rankings void."""
        self.version_without_readings += 1
        self.readings_changed()

    def readings_changed(self) -> None:
        """Note new readings, after which a ranking must judge all hosts again."""
        self.version += 1
        self.touched.clear()

    def set_claims(self, claims: dict[int, int]) -> None:
        """Set for which priorities hosts are reserved while room is made there."""
        if claims != self.claims:
            self.claims = claims
            self.changed()

    def ask(self, host: Host) -> None:
        """Note a request for work; placement also waits for the host's first reading."""
        if not self.asking[host.column]:
            self.asking[host.column] = True
            self.changed()

    def withdraw_request(self, host: Host) -> None:
        """Note that a host no longer requests work."""
        self.asking[host.column] = False
        self.changed()

    def set_condition(self, host: Host, condition: HostCondition) -> None:
        """Set the condition of a host."""
        self.condition[host.column] = condition
        if condition in (HostCondition.LEFT, HostCondition.DETACHED):
            self.asking[host.column] = False
        self.changed()

    def condition_of(self, host: Host) -> HostCondition:
        """Return the condition of a host."""
        return HostCondition(int(self.condition[host.column]))

    def set_closed(self, host: Host, *, cordoned: bool, draining: bool) -> None:
        """Cordon, drain or reopen a host."""
        host.cordoned, host.draining, host.drained = cordoned, draining, False
        self.closed[host.column] = cordoned or draining
        self.changed()

    def set_bound(self, host: Host, bound: int) -> None:
        """Set the highest number of processes on a host, reserved ones included."""
        if int(self.bound[host.column]) != bound:
            self.bound[host.column] = bound
            self.touched.append(host.column)

    def set_devices(self, host: Host, devices: tuple[Device, ...]) -> None:
        """Replace the devices of a host; instances keep what they hold."""
        if host.description.devices != devices:
            host.description = replace(host.description, devices=devices)
        self.devices[host.column] = replace(self.devices[host.column], devices=devices)
        self.changed()

    def hold(self, host: Host, instance: InstanceId, held: tuple[HeldDevice, ...]) -> None:
        """Note that an instance holds these devices of a host and no others."""
        before = self.devices[host.column]
        if (held or before.held) and before.held.get(instance, ()) != held:
            self.devices[host.column] = before.with_held(instance, held)

    def saved(self, host: Host) -> SavedColumn:
        """Return what reservations on a host change, for `restore`."""
        column = host.column
        cells, processes = self.cells[:, :, column].copy(), int(self.processes[column])
        return SavedColumn(column, cells, processes, self.devices[column])

    def restore(self, saved: SavedColumn) -> None:
        """Undo all reservations on a host since it was saved, without any rounding."""
        self.devices[saved.column] = saved.devices
        self.cells[:, :, saved.column] = saved.cells
        self.set_processes(saved.column, saved.processes)
        self.touched.append(saved.column)

    def free(self, host: Host, share: FloatArray) -> None:
        """Take the share, (R,), of one process off the usage of a host, for a trial."""
        self.cells[USAGE, :, host.column] -= share
        self.add_reservation(host, np.zeros(len(share)), processes=-1)
        self.set_accepting(host.column, accepting=True)

    def set_accepting(self, column: int, *, accepting: bool) -> None:
        """Set whether a host is under its limits, for a trial."""
        if bool(self.accepting[column]) is not accepting:
            self.accepting[column] = accepting
            self.readings_changed()

    def touch(self, host: Host) -> None:
        """Note that something else than the reservations of one host has changed."""
        self.touched.append(host.column)

    def add_reservation(self, host: Host, amount: FloatArray, processes: int = 0) -> None:
        """Add to the reservations and process count of one host; negative values release.

        `amount` is (R',) fractions, R' at most the resources known now.
        """
        column = host.column
        cell = self.cells[:, : len(amount), column]
        load = cell[LOAD]
        load += amount
        if processes <= 0:
            np.maximum(load, 0.0, out=load)  # rounding may leave less than 0
        np.add(cell[USAGE], load, out=cell[BUSY])
        if processes:
            self.set_processes(column, int(self.processes[column]) + processes)
        self.touched.append(column)

    # --- queries -------------------------------------------------------------------------

    def fractions(
        self, amounts: Mapping[str, float], estimated: frozenset[str] = frozenset()
    ) -> FloatArray:
        """Return base-unit amounts as fractions, (R, H), of each host's capacity.

        inf where a host has no such resource; 0 there for an estimated amount.
        """
        return self._fractions(slice(0, len(self)), amounts, estimated)

    def fractions_of(
        self, host: Host, amounts: Mapping[str, float], estimated: frozenset[str] = frozenset()
    ) -> FloatArray:
        """Return base-unit amounts as fractions, (R,), of one host, as `fractions` does."""
        one = slice(host.column, host.column + 1)
        return self._fractions(one, amounts, estimated)[:, 0]

    def _fractions(
        self, columns: slice, amounts: Mapping[str, float], estimated: frozenset[str]
    ) -> FloatArray:
        need = np.zeros((len(self.resources), columns.stop - columns.start))
        for row, name in enumerate(self.resources):
            amount = amounts.get(name, 0.0)
            if amount <= 0.0:
                continue
            is_guess, capacity = name in estimated, self.capacity[row, columns]
            part = np.divide(amount, capacity, out=need[row])
            if is_guess:
                np.fmin(part, _MOST_GUESSED * self.limit[row, columns], out=part)
            part[np.isnan(capacity)] = 0.0 if is_guess else np.inf
        return need

    def without_reading(self) -> BoolArray:
        """Return the mask, (H,), of hosts with unknown limits: no reading in their slave's run."""
        # A refused reading has marked every resource of the host as stale.
        unread = (self.sequence == 0) & (self.stale == 0)
        return np.asarray((self.incarnation == 0) | unread)

    def about_to_ask(self, since: float) -> IntArray:
        """Return the hosts that registered after a time and will ask for their first work."""
        if self.newest_registration <= since:
            return np.empty(0, np.int64)
        young = (self.registered > since) & (self.condition == HostCondition.UP) & ~self.closed
        if not young.any():
            return np.flatnonzero(young)
        silent = self.without_reading() | (self.accepting & ~self.asking)
        return np.flatnonzero(young & silent)

    def having(self, conditions: Sequence[HostCondition]) -> BoolArray:
        """Return the mask, (H,), of hosts with one of some conditions."""
        wanted = np.zeros(len(HostCondition), np.bool_)
        wanted[list(conditions)] = True
        return wanted[self.condition]  # much faster than np.isin

    def any_having(self, conditions: Sequence[HostCondition]) -> bool:
        """Return True if any host is in one of these conditions; fast if all hosts are up."""
        if not np.count_nonzero(self.condition):  # UP is 0
            return len(self) > 0 and HostCondition.UP in conditions
        return bool(self.having(conditions).any())

    def silent_hosts(self) -> list[int]:
        """Return the ids of hosts that have reported and are silent now."""
        return [int(column) + 1 for column in np.flatnonzero(self.having(_SILENT))]

    def why_unreachable(self, host: Host) -> str:
        """Return why a host cannot be reached, without its name; "" if it can."""
        return self.condition_of(host).words(*_NO_ANSWER)

    def stale_resources(self, host: Host) -> Sequence[str]:
        """Return the limited resources of a host whose reading is stale."""
        bits = int(self.stale[host.column])
        described = host.description.resources
        return [resource.name for slot, resource in enumerate(described) if bits >> slot & 1]

    def set_ceilings(self, ceilings: Mapping[str, float]) -> None:
        """Set the highest limit that any host may have, by resource."""
        if ceilings == self.ceilings:
            return
        self.ceilings = dict(ceilings)
        self.apply_ceilings(slice(None))
        self.changed()

    def over_limit(self, column: int) -> list[str]:
        """Return the resources whose reading is at or over the limit of a host."""
        over = _over(self.usage[:, column], self.limit[:, column])
        return [self.resources[row] for row in np.flatnonzero(over)]

    def hosts_over_limit(self) -> IntArray:
        """Return the columns of the hosts that are up and at or over any limit."""
        over = _over(self.usage, self.limit).any(axis=0)
        return np.flatnonzero(over & (self.condition == HostCondition.UP))

    def statuses_missing(self) -> IntArray:
        """Return the columns of hosts with missing statuses, shown by a reading or after a loss."""
        behind = (self.reported > self.status_sequence) | self.report_due
        return np.flatnonzero(behind & (self.condition == HostCondition.UP))

    def statuses_ahead(self) -> IntArray:
        """Return the columns of hosts that, by their reading, have sent fewer batches than came."""
        ahead = (self.status_sequence > self.reported) & (self.reported > 0)
        return np.flatnonzero(ahead & (self.condition == HostCondition.UP))

    def set_report_due(self, host: Host, *, report_due: bool) -> None:
        """Set whether a host gets no work until it has reported all of its instances."""
        if bool(self.report_due[host.column]) is not report_due:
            self.report_due[host.column] = report_due
            self.changed()

    def note_statuses(
        self, host: Host, sequence: int, now: float
    ) -> Literal["late", "next", "after a gap", "far ahead"]:
        """Note the sequence of a status batch, and return its place in the order of batches.

        A batch far ahead of the last one and of the host's readings is not the host's: noted, it
        would hide all batches that the host sends.
        """
        newest = int(self.status_sequence[host.column])
        if sequence <= newest:
            return "late"
        known = max(newest, int(self.reported[host.column]))
        if newest and sequence - known > MOST_AHEAD + self.readings_since(now)[host.column]:
            return "far ahead"
        self.status_sequence[host.column] = sequence
        self.last_contact[host.column] = now
        return "next" if sequence == newest + 1 else "after a gap"

    def readings_since(self, now: float) -> FloatArray:
        """Return twice the number, (H,), of readings that hosts may have sent since the newest."""
        elapsed: FloatArray = 2.0 * (now - self.read_at) / np.maximum(self.period, _SHORTEST_PERIOD)
        return elapsed

    def is_accepting(self, host: Host) -> bool:
        """Return True if a host is under all its limits and has requested work."""
        return bool(self.accepting[host.column] and self.asking[host.column])


def _over(usage: FloatArray, limit: FloatArray) -> BoolArray:
    """Return the mask of usage at or over its limit; False for a limit of 1 and a usage of NaN."""
    return np.asarray((usage >= limit) & (limit < 1.0))


#: Conditions of hosts that have reported and are silent now.
_SILENT: Final = (HostCondition.SUSPECT, HostCondition.LOST, HostCondition.DETACHED)
_NO_ANSWER: Final = (HostCondition.LOST, HostCondition.DETACHED, HostCondition.EXPECTED)
