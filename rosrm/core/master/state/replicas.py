"""The books of kept states: which host keeps which, by the slaves' own word. Nothing is durable.

What one host says is complete: it replaces all that it said before.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from math import inf
from typing import Final

from rosrm.core.master.state.hosts import HostCondition, HostTable
from rosrm.extensions.contracts import CheckpointChoice, CheckpointPolicy
from rosrm.model.values import EMPTY, KeptState

_IN_REACH: Final = frozenset({HostCondition.UP, HostCondition.SUSPECT})


@dataclass(frozen=True, slots=True)
class Holding:
    """The newest state of a process on one host.

    Attributes:
        number: of the instance whose state it is.
        sequence: cycles that it covers.
        size: bytes.
        since: when this master learned of it.
    """

    number: int
    sequence: int
    size: int
    since: float

    @property
    def age(self) -> tuple[int, int]:
        """The larger, the newer."""
        return self.number, self.sequence


class Holdings:
    """Process to host to what it keeps."""

    def __init__(self) -> None:
        self._of: dict[str, dict[str, Holding]] = {}
        self._on: dict[str, set[str]] = {}

    def replace(self, host: str, states: Iterable[KeptState], now: float) -> None:
        """A host says all that it keeps."""
        told = {state.instance.process: state for state in states}
        for process in self._on.get(host, set()) - told.keys():
            self._forget(process, host)
        for process, state in told.items():
            known = self._of.setdefault(process, {})
            before = known.get(host)
            if before is None or before.age != (state.instance.number, state.sequence):
                known[host] = Holding(state.instance.number, state.sequence, state.size, now)
        self._on[host] = set(told)

    def _forget(self, process: str, host: str) -> None:
        known = self._of[process]
        del known[host]
        if not known:
            del self._of[process]

    def of(self, process: str) -> Mapping[str, Holding]:
        """By host; empty where none is known."""
        return self._of.get(process, EMPTY)

    def hosts_of(self, process: str, since: int) -> tuple[str, ...]:
        """Where states of instances from a number on lie, the newest first."""
        known = self._of.get(process)
        if known is None:
            return ()
        found = [(one.age, name) for name, one in known.items() if one.number >= since]
        return tuple(name for _, name in sorted(found, key=lambda one: one[0], reverse=True))

    def processes(self) -> list[str]:
        """All of which a state is kept anywhere."""
        return list(self._of)


@dataclass(slots=True)
class Told:
    """What a slave was ordered to do with the state of an instance.

    Attributes:
        number: of the instance.
        incarnation: of the slave.
        chosen: the policy has chosen so since the master started. False: it gives no answer, and
            the hosts are those that keep a state already.
        taken: it has said yes.
    """

    number: int
    incarnation: int
    choice: CheckpointChoice
    order: int
    at: float
    chosen: bool = True
    taken: bool = False


@dataclass(slots=True)
class Keeping:
    """What is known of kept states.

    Attributes:
        policy: that chooses where states are kept; None: on their own hosts alone.
        policy_name: in the configuration.
        holdings: which host keeps which.
        told: what the slave of each process was ordered last.
        orders: process of each order without an answer.
        next_order: their numbers are apart from those of all else: a record that is replayed
            without the policy must not number its orders otherwise.
        dropped_at: when a host was last told to drop what it keeps of a process.
        removed: stateful processes that were removed, each with a number above those of all its
            instances.
        waiting: processes that are still to be looked at in this round.
        looked: time of the last look.
    """

    policy: CheckpointPolicy | None = None
    policy_name: str = ""
    holdings: Holdings = field(default_factory=Holdings)
    told: dict[str, Told] = field(default_factory=dict)
    orders: dict[int, str] = field(default_factory=dict)
    next_order: int = 1 << 40
    dropped_at: dict[tuple[str, str], float] = field(default_factory=dict)
    removed: dict[str, int] = field(default_factory=dict)
    waiting: list[str] = field(default_factory=list)
    looked: float = -inf

    def order_id(self) -> int:
        """A number for an order about kept states."""
        self.next_order += 1
        return self.next_order

    def in_reach(self, process: str, since: int, hosts: HostTable) -> tuple[str, ...]:
        """Hosts that are heard and keep a state of an instance from a number on, newest first.

        Before them those that were to be given one, and have said nothing of it yet: it may have
        come there since they spoke, and is newer than all else then.
        """
        known = self.holdings.hosts_of(process, since)
        told = self.told.get(process)
        asked = told.choice.hosts if told is not None and told.number >= since else ()
        return tuple(
            name
            for name in (*(name for name in asked if name not in known), *known)
            if name in hosts.by_name and hosts.condition_of(hosts.by_name[name]) in _IN_REACH
        )
