"""Table of pending orders: the purpose of each order without an answer yet."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
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


class PendingOrders:
    """Purposes of the unanswered orders of this master; orders of a former master have none."""

    def __init__(self) -> None:
        self._purposes: dict[OrderId, Purpose] = {}
        self._numbers = Counter[str]()

    def add(self, purpose: Purpose | None = None) -> OrderId:
        """Return the id of a new order; the answer to an order without a purpose is ignored."""
        series = _SERIES.get(type(purpose), "")
        self._numbers[series] += 1
        number = self._numbers[series]
        order: OrderId = (series, number) if series else number
        if purpose is not None:
            self._purposes[order] = purpose
        return order

    def pop(self, order: OrderId) -> Purpose | None:
        """Remove an answered order and return its purpose; None: the order has none."""
        return self._purposes.pop(order, None)
