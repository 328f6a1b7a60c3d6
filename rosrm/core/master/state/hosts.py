"""The hosts: what they say of themselves, what is promised to them, and who may be given work.

What placement and liveness need of a thousand hosts at once stands in `host_arrays.py`; what is
asked of one host at a time (its description, its labels) lives in `Host` beside them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Final

import numpy as np

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
from rosrm.extensions.plugin_calls import Failing, Plugin
from rosrm.model.values import HostDescription
from rosrm.wording import counted

#: An estimate, unlike a declared need, fills at most this part of a host's limit: a guess alone
#: must not keep a process off every host for ever.
_MOST_GUESSED: Final = 0.5


class HostCondition(IntEnum):
    """How well a host is heard."""

    UP = 0
    SUSPECT = 1
    LOST = 2
    LEFT = 3
    EXPECTED = 4  # known from the journal, not heard since this master's start
    DETACHED = 5  # its slave was stopped and left processes running

    def words(self, *only: HostCondition) -> str:
        """Return how a host that is not up stands, without its name; "": in none of `only`."""
        return _WORDS.get(self, "") if self in (only or _WORDS) else ""


_WORDS: Final[Mapping[HostCondition, str]] = {
    HostCondition.SUSPECT: "is suspect: its reports are late",
    HostCondition.LOST: "is lost",
    HostCondition.LEFT: "has left",
    HostCondition.DETACHED: "is detached: its slave was stopped and left processes running",
    HostCondition.EXPECTED: "has not come back since the master started",
}


@dataclass(slots=True, eq=False)
class Host:
    """What is asked of one host at a time.

    Attributes:
        column: of this host in the arrays of `HostTable`.
        instances: numbers of the instances that it holds or was promised.
        over_since: resource name to the time since when it is over its limit.
        over_at: resource name to the time at which it was last seen over its limit; of those whose
            excess is on record, and whose end is not.
        drained: it is draining, and no process is left on it that can leave.
        pruned: it is in no listing, until it registers.
        told: kind of a record that is not repeated at once, to when it was made.
        blocked: why nothing could leave it, by what was to be relieved: as last recorded.
        detached_since: time at which its slave was stopped, while it is detached.
        lost_since: time at which it was lost, while it is; of a detached host the time at which its
            lease ends.
        failing: kind and name of the plugins that fail there, as the slave reports. A probe goes by
            the resource that it reads.
    """

    column: int
    description: HostDescription
    cordoned: bool = False
    draining: bool = False
    drained: bool = False
    pruned: bool = False
    instances: set[int] = field(default_factory=set)
    over_since: dict[str, float] = field(default_factory=dict)
    over_at: dict[str, float] = field(default_factory=dict)
    told: dict[str, float] = field(default_factory=dict)
    blocked: dict[str, str] = field(default_factory=dict)
    detached_since: float = 0.0
    lost_since: float = 0.0
    failing: dict[Plugin, Failing] = field(default_factory=dict)

    @property
    def host_id(self) -> int:
        """The number under which this host reports; 0 is never given."""
        return self.column + 1

    @property
    def name(self) -> str:
        """The name of the host."""
        return self.description.name


class HostTable(HostColumns):
    """Every known host.

    Attributes:
        version: grows with every change that touches many hosts.
        touched: columns that single assignments and ends have changed since `version` grew.
    """

    def __init__(self) -> None:
        super().__init__()
        self.by_name: dict[str, Host] = {}
        self.hosts: list[Host] = []
        self.version = 0
        self.touched: list[int] = []
        self._labelled: dict[tuple[str, str], BoolArray] = {}
        self._listed: list[Host] | None = None

    # --- registration --------------------------------------------------------------------

    def expect(
        self, name: str, now: float = 0.0, *, cordoned: bool = False, draining: bool = False
    ) -> Host:
        """Give a host its column before it is heard, so that its number stays across restarts."""
        host = Host(self.add_column(), HostDescription(name, 0))
        self.hosts.append(host)
        self.by_name[name] = host
        self._listed = None
        self.heard[host.column] = now
        self.condition[host.column] = HostCondition.EXPECTED
        self.set_closed(host, cordoned=cordoned, draining=draining)
        return host

    def register(self, description: HostDescription, now: float) -> Host:
        """Take in a host, or a new run of a known one; its readings are still to come."""
        host = self.by_name.get(description.name) or self.expect(description.name)
        column = host.column
        host.description, host.pruned = description, False
        self._listed = None
        host.over_since.clear()
        host.over_at.clear()
        for resource in description.resources:
            if resource.name not in self.resources:
                self.add_resource(resource.name)
        rows = [self.resources.index(resource.name) for resource in description.resources]
        self.clear_column(column)
        self.row_of_slot[column, : len(rows)] = rows
        self.capacity[rows, column] = [resource.capacity for resource in description.resources]
        self.usage[rows, column] = 0.0
        self.busy[rows, column] = self.load[rows, column]
        self.condition[column] = HostCondition.UP
        self.asking[column] = self.accepting[column] = self.untold[column] = False
        self.stale[column] = 0
        self.heard[column] = self.registered[column] = now
        self.bound[column] = description.max_processes or NO_BOUND
        self.period[column] = description.period
        self.incarnation[column] = description.incarnation
        self.sequence[column] = self.reported[column] = self.status_sequence[column] = 0
        self._labelled.clear()
        self.changed()
        return host

    def prune(self, host: Host) -> None:
        """Leave a host out of every listing until its slave registers, then as a new host."""
        host.pruned, host.description = True, HostDescription(host.name, 0)
        self._listed = None
        for known in (host.over_since, host.over_at, host.told, host.blocked, host.failing):
            known.clear()
        self.incarnation[host.column] = 0
        self._labelled.clear()
        self.set_closed(host, cordoned=False, draining=False)
        self.set_condition(host, HostCondition.LEFT)

    def find(self, host_id: int, incarnation: int) -> Host | None:
        """The host of this number, if it is this run of it."""
        column = host_id - 1
        if not 0 <= column < len(self.hosts) or int(self.incarnation[column]) != incarnation:
            return None
        return self.hosts[column]

    def listed(self) -> Sequence[Host]:
        """Return every host that was not pruned; kept, because each decision asks for them."""
        if self._listed is None:
            self._listed = [host for host in self.hosts if not host.pruned]
        return self._listed

    def labelled(self, key: str, value: str) -> BoolArray:
        """(H,) True: the host has this label; kept until a host registers."""
        known = self._labelled.get((key, value))
        if known is None or len(known) != len(self):
            found = [host.description.labels.get(key) == value for host in self.hosts]
            known = self._labelled[key, value] = np.array(found, np.bool_)
        return known

    # --- what changes --------------------------------------------------------------------

    def changed(self) -> None:
        """Many hosts changed: rankings made before are void."""
        self.version += 1
        self.touched.clear()

    def ask(self, host: Host) -> None:
        """The host asked for work. Its readings say how much: before the first it is given none."""
        if not self.asking[host.column]:
            self.asking[host.column] = True
            self.changed()

    def set_condition(self, host: Host, condition: HostCondition) -> None:
        """Note how well a host is heard."""
        self.condition[host.column] = condition
        if condition in (HostCondition.LEFT, HostCondition.DETACHED):
            self.asking[host.column] = False
        self.changed()

    def condition_of(self, host: Host) -> HostCondition:
        """How well a host is heard."""
        return HostCondition(int(self.condition[host.column]))

    def set_closed(self, host: Host, *, cordoned: bool, draining: bool) -> None:
        """Cordon, drain or reopen a host."""
        host.cordoned, host.draining, host.drained = cordoned, draining, False
        self.closed[host.column] = cordoned or draining
        self.changed()

    def set_bound(self, host: Host, bound: int) -> None:
        """How many processes a host may hold or be promised from now on."""
        if int(self.bound[host.column]) != bound:
            self.bound[host.column] = bound
            self.touched.append(host.column)

    def charge(self, host: Host, amount: FloatArray, processes: int = 0) -> None:
        """Add to (or, negative, take from) the in-flight load and process count of one host.

        `amount` is (R',) fractions, R' at most the resources known now.
        """
        column = host.column
        cell = self.cells[:, : len(amount), column]
        load = cell[LOAD]
        load += amount
        if processes <= 0:
            np.maximum(load, 0.0, out=load)  # what is left of a sum may be below 0 by rounding
        np.add(cell[USAGE], load, out=cell[BUSY])
        self.processes[column] += processes
        self.touched.append(column)

    # --- what is asked -------------------------------------------------------------------

    def fractions(
        self, amounts: Mapping[str, float], estimated: frozenset[str] = frozenset()
    ) -> FloatArray:
        """(R, H): base-unit amounts as fractions of each host's capacity.

        inf where a host has no such resource, and 0 there for an amount that is only estimated.
        """
        return self._fractions(slice(0, len(self)), amounts, estimated)

    def fractions_of(
        self, host: Host, amounts: Mapping[str, float], estimated: frozenset[str] = frozenset()
    ) -> FloatArray:
        """(R,): as `fractions`, for one host."""
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
            part = np.divide(amount, self.capacity[row, columns], out=need[row])
            if name in estimated:
                np.fmin(part, _MOST_GUESSED * self.limit[row, columns], out=part)
                absent = 0.0
            else:
                absent = np.inf
            part[np.isnan(self.capacity[row, columns])] = absent
        return need

    def open(self) -> BoolArray:
        """(H,) True: may be given work now, room and number of processes aside."""
        return np.asarray(
            (self.condition == HostCondition.UP) & self.asking & self.accepting
            & ~self.closed & ~self.untold & (self.stale == 0)
        )  # fmt: skip

    def why_closed(self, column: int) -> str:
        """Why a host may not be given work now, its room aside; "" if it may."""
        host = self.hosts[column]
        away = self.why_away(column)
        if away:
            return away
        if self.condition[column] == HostCondition.SUSPECT:
            return f"it {HostCondition.SUSPECT.words()}"
        if self.processes[column] >= self.bound[column]:
            most = counted(int(self.bound[column]), "process", "processes")
            return f"it accepts no more than {most} now"
        if self.stale[column]:
            return f"its reading of {', '.join(self.stale_resources(host))} is stale"
        if not self.accepting[column]:
            over = self.over_limit(column)
            return (
                f"it is over its limit of {', '.join(over)}"
                if over
                else "its slave accepts no work now"
            )
        if self.untold[column]:
            return "it was lost, and has not reported its processes yet"
        if not self.asking[column]:
            return "it has not asked for work yet"
        return ""

    def without_reading(self) -> BoolArray:
        """(H,) True: no reading of this run has come, so that the limits are unknown."""
        # A reading that was refused has marked all that the host reads as stale.
        unread = (self.sequence == 0) & (self.stale == 0)
        return np.asarray((self.incarnation == 0) | unread)

    def about_to_ask(self, since: float) -> IntArray:
        """Columns of hosts that registered after a time and will ask for their first work."""
        young = (self.registered > since) & (self.condition == HostCondition.UP) & ~self.closed
        if not young.any():
            return np.flatnonzero(young)
        silent = self.without_reading() | (self.accepting & ~self.asking)
        return np.flatnonzero(young & silent)

    def unheard(self) -> list[int]:
        """Numbers of the hosts that have reported, and have been silent for a moment or longer."""
        silent = np.isin(self.condition, _SILENT)
        return [int(column) + 1 for column in np.flatnonzero(silent)]

    def away(self) -> BoolArray:
        """(H,) True: gets no work until somebody brings it back: lost, left, cordoned, drained."""
        return np.asarray(self.closed | np.isin(self.condition, _GONE))

    def why_unreachable(self, host: Host) -> str:
        """Return why a host cannot be reached, without its name; "" if it can."""
        return self.condition_of(host).words(*_NO_ANSWER)

    def why_away(self, column: int) -> str:
        """Why a host is away, or may be; "" if it is there."""
        host = self.hosts[column]
        condition = self.condition_of(host)
        if condition is not HostCondition.SUSPECT and (words := condition.words()):
            return f"it {words}"
        if host.draining or host.cordoned:
            return "it is being drained" if host.draining else "it is cordoned"
        return ""

    def stale_resources(self, host: Host) -> Sequence[str]:
        """Names of the limited resources of a host whose reading is stale."""
        bits = int(self.stale[host.column])
        described = host.description.resources
        return [resource.name for slot, resource in enumerate(described) if bits >> slot & 1]

    def over_limit(self, column: int) -> list[str]:
        """Names of the resources whose reading is at or over the limit of a host."""
        over = _over(self.usage[:, column], self.limit[:, column])
        return [self.resources[row] for row in np.flatnonzero(over)]

    def hosts_over_limit(self) -> IntArray:
        """Columns of the hosts that are up and at or over any limit."""
        over = _over(self.usage, self.limit).any(axis=0)
        return np.flatnonzero(over & (self.condition == HostCondition.UP))

    def statuses_missing(self) -> IntArray:
        """Columns of hosts from which statuses are missing, by their own word or since a loss."""
        behind = (self.reported > self.status_sequence) | self.untold
        return np.flatnonzero(behind & (self.condition == HostCondition.UP))

    def set_untold(self, host: Host, *, untold: bool) -> None:
        """A host that was lost has come back, or has said what it holds."""
        if bool(self.untold[host.column]) is not untold:
            self.untold[host.column] = untold
            self.changed()

    def note_statuses(self, host: Host, sequence: int, now: float) -> bool | None:
        """Take note of a status batch.

        Returns:
            None: it is older than what is known; True: it is the next; False: one before it was
            missed.
        """
        newest = int(self.status_sequence[host.column])
        if sequence <= newest:
            return None
        self.status_sequence[host.column] = sequence
        self.heard[host.column] = now
        return sequence == newest + 1

    def is_accepting(self, host: Host) -> bool:
        """Under all its limits, and it has asked."""
        return bool(self.accepting[host.column] and self.asking[host.column])


def _over(usage: FloatArray, limit: FloatArray) -> BoolArray:
    """True: at or over its limit. A limit of 1 is none; NaN, no such resource, is over nothing."""
    return np.asarray((usage >= limit) & (limit < 1.0))


#: Of hosts that reported before, and do not now.
_SILENT: Final = (HostCondition.SUSPECT, HostCondition.LOST, HostCondition.DETACHED)
_NO_ANSWER: Final = (HostCondition.LOST, HostCondition.DETACHED, HostCondition.EXPECTED)
_GONE: Final = (HostCondition.LOST, HostCondition.LEFT, HostCondition.DETACHED)
