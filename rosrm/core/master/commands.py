"""Commands of the master's core to its runtime, in the imperative.

The runtime writes all `Record` and `Intent` of one batch to the journal before it carries out
anything else of that batch: intent is durable before it is acted on.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from rosrm.model.applications import PlannedAction
from rosrm.model.orders import Order, StartInstance, StopInstance
from rosrm.model.plan import HandoffPhase
from rosrm.model.records import Intent, Record
from rosrm.model.values import Assignment, InstanceId

#: Id of an order, unique within one run of the master: its number, or its series and number
#: (`PendingOrders`).
OrderId = int | tuple[str, int]
#: Code of a refused request.
RefusalCode = Literal["denied", "invalid", "journal", "name_taken", "quota", "unknown"]


@dataclass(frozen=True, slots=True)
class Assign:
    """Send an assignment to a host that has requested work."""

    host_id: int
    assignment: Assignment


@dataclass(frozen=True, slots=True)
class SendOrder:
    """Send an order to one slave; `OrderAnswered` follows, also when no answer arrives."""

    order_id: OrderId
    host_id: int
    order: Order


@dataclass(frozen=True, slots=True)
class Withdraw:
    """Withdraw an assignment.

    An assignment that the slave has not fetched yields `AssignmentWithdrawn`. For a fetched one,
    `if_fetched` is sent to the slave, which then never starts the instance or stops it.
    """

    order_id: OrderId
    host_id: int
    instance: InstanceId

    @property
    def if_fetched(self) -> SendOrder:
        """Return the order to stop the instance."""
        return SendOrder(self.order_id, self.host_id, StopInstance(self.instance))


@dataclass(frozen=True, slots=True)
class Redeliver:
    """Order the start of a fetched assignment, because the message that carried it may be lost.

    An assignment that the slave has not fetched stays open: it can be withdrawn without an order.
    """

    order_id: OrderId
    host_id: int
    assignment: Assignment

    @property
    def if_fetched(self) -> SendOrder:
        """Return the order to start the instance."""
        return SendOrder(self.order_id, self.host_id, StartInstance(self.assignment))


@dataclass(frozen=True, slots=True)
class PublishStateConfig:
    """Publish the phase of a handoff on `state_config`, for its source and destination.

    Attributes:
        source, destination: instance numbers.
        source_node, destination_node: fully qualified names of their nodes.
    """

    process: str
    phase: HandoffPhase
    source: int
    destination: int
    source_node: str
    destination_node: str


@dataclass(frozen=True, slots=True)
class ReadSettings:
    """Read the file of the master again; `SettingsRead` follows with this request."""

    request: int


@dataclass(frozen=True, slots=True)
class Reply:
    """Answer a request that came with an event; `code` is "" unless the request is refused.

    Attributes:
        actions: actions that follow, or would follow, on the processes of applications.
    """

    request: int
    accepted: bool = True
    code: Literal[RefusalCode, ""] = ""
    message: str = ""
    host_id: int = 0
    host: str = ""
    actions: tuple[PlannedAction, ...] = ()


Command = (
    Assign
    | Withdraw
    | Redeliver
    | SendOrder
    | PublishStateConfig
    | ReadSettings
    | Reply
    | Record
    | Intent
)
