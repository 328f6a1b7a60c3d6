"""Table of pending orders: the purpose of each order without an answer yet."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from math import inf
from typing import Final, Literal

from rosrm.core.master.commands import OrderId
from rosrm.model.values import Amendment, InstanceId


@dataclass(frozen=True, slots=True)
class MigrationStep:
    """The order is that of the current step of a process's migration."""

    process: str


@dataclass(frozen=True, slots=True)
class ImageRemoval:
    """The order removes an unwanted checkpoint image.

    Attributes:
        number: number of the dumped instance.
    """

    number: int


@dataclass(frozen=True, slots=True)
class Replication:
    """The order places or drops a replica of a process's snapshot."""

    process: str


@dataclass(frozen=True, slots=True)
class CapabilityQuery:
    """The order checks whether a migration strategy works on a host."""

    strategy: str
    host: str


@dataclass(frozen=True, slots=True)
class PeriodicCheckpoint:
    """The order makes a periodic checkpoint of an instance, or removes all of an ended one."""

    number: int


@dataclass(frozen=True, slots=True)
class LinkMeasurement:
    """The order measures the links of a host."""

    host: str


@dataclass(frozen=True, slots=True)
class Reload:
    """The order reloads the settings of a host."""

    host: str


@dataclass(frozen=True, slots=True)
class InstanceAmendment:
    """The order changes an instance that runs on."""

    instance: InstanceId
    amendment: Amendment


@dataclass(frozen=True, slots=True)
class Restart:
    """The order restarts an instance in place."""

    instance: InstanceId


Purpose = (
    MigrationStep
    | InstanceAmendment
    | ImageRemoval
    | Replication
    | CapabilityQuery
    | PeriodicCheckpoint
    | LinkMeasurement
    | Reload
    | Restart
)

#: Purposes with their own series of numbers, because they depend on optional plugins or are
#: no decisions: a replay without them must give all other orders the same numbers.
_SERIES: Final[dict[type, Literal["replication", "capability", "periodic", "links"]]] = {
    Replication: "replication",
    CapabilityQuery: "capability",
    PeriodicCheckpoint: "periodic",
    LinkMeasurement: "links",
}


#: Seconds beyond the execution of an order, after which its answer is not expected any more. The
#: network layer reports a missing answer much sooner.
_PATIENCE: Final = 60.0


@dataclass(slots=True)
class _Pending:
    purpose: Purpose
    seconds: float
    expires: float = inf


class PendingOrders:
    """Purposes of the unanswered orders of this master; orders of a former master have none.

    The network layer reports each order without an answer. An order of which it reports nothing at
    all expires, so that nothing waits for its answer for ever.

    Attributes:
        pending: unanswered orders with a purpose.
    """

    def __init__(self) -> None:
        self.pending: dict[OrderId, _Pending] = {}
        self._unstamped: list[OrderId] = []
        self._numbers = Counter[str]()

    def add(self, purpose: Purpose | None = None, seconds: float = 0.0) -> OrderId:
        """Return the id of a new order; the answer to an order without a purpose is ignored.

        `seconds`: time for which a slave may execute the order.
        """
        series = _SERIES.get(type(purpose), "")
        self._numbers[series] += 1
        number = self._numbers[series]
        order: OrderId = (series, number) if series else number
        if purpose is not None:
            self.pending[order] = _Pending(purpose, seconds)
            self._unstamped.append(order)
        return order

    def __iter__(self) -> Iterator[tuple[OrderId, Purpose]]:
        return ((order, one.purpose) for order, one in self.pending.items())

    def pop(self, order: OrderId) -> Purpose | None:
        """Remove an answered order and return its purpose; None: the order has none."""
        pending = self.pending.pop(order, None)
        return None if pending is None else pending.purpose

    def expired(self, now: float) -> list[OrderId]:
        """Return the orders whose answer is not expected any more."""
        for order in self._unstamped:
            if order in self.pending:
                self.pending[order].expires = now + self.pending[order].seconds + _PATIENCE
        self._unstamped.clear()
        return [order for order, pending in self.pending.items() if now >= pending.expires]
