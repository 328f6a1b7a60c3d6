"""Index of snapshots and their replicas, as reported by slaves. Not persisted.

Each report of a host is complete and replaces the former report.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from itertools import islice
from math import inf
from typing import Final

from rosrm.core.master.commands import OrderId
from rosrm.core.master.state.backoff import Backoff
from rosrm.core.master.state.hosts import HostCondition, HostTable
from rosrm.core.newest import Newest
from rosrm.extensions.contracts import CheckpointChoice, CheckpointPolicy
from rosrm.model.description_checks import name_fault
from rosrm.model.values import EMPTY, SnapshotReport

#: Maximum number of snapshots of one host that count.
_MOST_OF_HOST: Final = 10_000
#: Removed processes whose replicas are dropped when a host returns with one.
_MOST_REMOVED: Final = 10_000
_IN_REACH: Final = frozenset({HostCondition.UP, HostCondition.SUSPECT})


@dataclass(frozen=True, slots=True)
class Replica:
    """The newest snapshot of a process on one host.

    Attributes:
        number: number of the instance that wrote it.
        sequence: number of cycles that it covers.
        size: size in bytes.
        since: time of the first report of it to this master.
    """

    number: int
    sequence: int
    size: int
    since: float

    @property
    def age(self) -> tuple[int, int]:
        """Return a key that is larger for newer snapshots."""
        return self.number, self.sequence


class ReplicaIndex:
    """Index of snapshots: process to host to the newest snapshot there."""

    def __init__(self) -> None:
        self._of: dict[str, dict[str, Replica]] = {}
        self._on: dict[str, set[str]] = {}

    def replace(self, host: str, states: Iterable[SnapshotReport], now: float) -> None:
        """Replace the snapshots of a host by its report."""
        reported = {
            state.instance.process: state
            for state in islice(states, _MOST_OF_HOST)
            if not name_fault(state.instance.process, "process")
        }
        for process in self._on.get(host, set()) - reported.keys():
            self._remove(process, host)
        for process, state in reported.items():
            known = self._of.setdefault(process, {})
            before = known.get(host)
            if before is None or before.age != (state.instance.number, state.sequence):
                known[host] = Replica(state.instance.number, state.sequence, state.size, now)
        self._on[host] = set(reported)

    def _remove(self, process: str, host: str) -> None:
        known = self._of[process]
        del known[host]
        if not known:
            del self._of[process]

    def of(self, process: str) -> Mapping[str, Replica]:
        """Return the snapshots of a process by host; empty where none is known."""
        return self._of.get(process, EMPTY)

    def hosts_of(self, process: str, since: int) -> tuple[str, ...]:
        """Return the hosts with snapshots of instances numbered `since` or higher, newest first."""
        known = self._of.get(process)
        if known is None:
            return ()
        found = [name for name, one in known.items() if one.number >= since]
        return tuple(sorted(found, key=lambda name: known[name].age, reverse=True))

    def processes(self) -> list[str]:
        """Return all processes with a snapshot anywhere."""
        return list(self._of)


@dataclass(slots=True)
class ReplicationOrder:
    """The last order to a slave about replicas of an instance's snapshot.

    Attributes:
        number: number of the instance.
        incarnation: incarnation of the slave.
        by_policy: True: the policy has chosen the hosts since the master started. False: it gives
            no answer, and the hosts are those that already have a replica.
        accepted: the slave has accepted the order.
        backoff: of the order, until the slave accepts it.
    """

    number: int
    incarnation: int
    choice: CheckpointChoice
    order: OrderId
    backoff: Backoff
    by_policy: bool = True
    accepted: bool = False


@dataclass(slots=True)
class ReplicationState:
    """State of snapshot replication.

    Attributes:
        policy: chooses the hosts of replicas; None: snapshots stay on their own hosts alone.
        policy_name: name of the policy in the configuration.
        replicas: index of snapshots by process and host.
        last_orders: process name to the last order to its slave.
        drops: process, host and number of an instance to the back-off of the order to drop the
            replica of it.
        removed: name of each removed stateful process to a number above those of its instances.
        waiting: processes still to be reviewed in this round.
        reviewed_at: time of the last review.
    """

    policy: CheckpointPolicy | None = None
    policy_name: str = ""
    replicas: ReplicaIndex = field(default_factory=ReplicaIndex)
    last_orders: dict[str, ReplicationOrder] = field(default_factory=dict)
    drops: dict[tuple[str, str, int], Backoff] = field(default_factory=dict)
    removed: Newest[str, int] = field(default_factory=lambda: Newest(_MOST_REMOVED))
    waiting: list[str] = field(default_factory=list)
    reviewed_at: float = -inf

    def in_reach(
        self, process: str, since: int, hosts: HostTable, ran_on: str = ""
    ) -> tuple[str, ...]:
        """Return the hosts in reach with a snapshot of an instance numbered `since` or higher.

        The newest reported snapshot comes after two that may be newer, and not reported yet: that
        of the host on which the last instance ran, and those of the hosts that should get a
        replica.

        Args:
            ran_on: name of the host on which the last instance ran; "": unknown.
        """
        known = self.replicas.hosts_of(process, since)
        unreported = (name for name in self._chosen(process, since) if name not in known)
        return tuple(
            name
            for name in dict.fromkeys((ran_on, *unreported, *known))
            if name in hosts.by_name and hosts.condition_of(hosts.by_name[name]) in _IN_REACH
        )

    def _chosen(self, process: str, since: int) -> tuple[str, ...]:
        """Return the hosts that should get a replica."""
        last = self.last_orders.get(process)
        return last.choice.hosts if last is not None and last.number >= since else ()

    def newest_instance(self, process: str, host: str) -> int:
        """Return the number of the newest instance whose snapshot a host may have; 0: of none."""
        known = self.replicas.of(process).get(host)
        if known is not None:
            return known.number
        last = self.last_orders.get(process)
        return last.number if last is not None and host in last.choice.hosts else 0
